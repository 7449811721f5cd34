"""A command that is given something without end: one message, soon, in little memory."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

MAX_S = 5.0
MAX_BYTES = 2**30
_PROGRAM = """
import json, resource, subprocess, sys
done = subprocess.run(sys.argv[1:], capture_output=True, text=True, timeout=60)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
seconds = used.ru_utime + used.ru_stime
print(json.dumps([done.returncode, done.stderr, seconds, 1024 * used.ru_maxrss]))
"""


def bounded_command(arguments: Sequence[str], folder: Path) -> str:
    """The message of `isac-rt` with arguments that it refuses; processor time and memory, of all
    processes that it starts, are held against `MAX_S` and `MAX_BYTES`."""
    command = [sys.executable, "-m", "isac_rt.cli.cli", *arguments]
    asked = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *command], capture_output=True, text=True, cwd=folder
    )
    status, said, seconds, memory = json.loads(asked.stdout)
    assert status == 2, said
    assert "Traceback" not in said
    assert seconds < MAX_S, said
    assert memory < MAX_BYTES, said
    return said
