"""Runs pytest or a program again and again for `mutation.py`, each time in a child of one process
that has the libraries loaded.

Reads lines of JSON {"arguments": [...] of pytest or "program": text, "limit": seconds, "log": file}
and answers each with a line: the exit status, or -1 when the time was up. What is tested is loaded
by the child, never here.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
import traceback
from importlib import import_module

import pytest

LIBRARIES = (
    "numpy scipy.fft scipy.stats scipy.optimize scipy.ndimage scipy.interpolate "
    "scipy.spatial numba xarray pydantic yaml hypothesis"
)


def in_child(order: dict, log: str) -> None:
    """Does not return."""
    os.setsid()
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1)
    os.dup2(out, 2)
    status: int = 70
    try:
        if "program" in order:
            exec(order["program"], {"__name__": "__main__"})
            status = 0
        else:
            status = int(pytest.main(order["arguments"]))
        sys.stdout.flush()
    except Exception:
        traceback.print_exc()
    finally:
        os._exit(status)


def run(order: dict, limit: float, log: str) -> int:
    """Exit status of one run."""
    child = os.fork()
    if child == 0:
        in_child(order, log)
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return 70 if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -1


if __name__ == "__main__":
    for name in LIBRARIES.split():
        import_module(name)
    for line in sys.stdin:
        order = json.loads(line)
        print(run(order, order["limit"], order["log"]), flush=True)
