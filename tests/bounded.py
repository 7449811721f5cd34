"""A command that is given something without end: one message, soon, in little memory."""

from __future__ import annotations

import io
import os
import resource
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing import connection, get_context
from pathlib import Path

MAX_S = 5.0
MAX_BYTES = 2**30
_PROCESSES = get_context("forkserver")
_PROCESSES.set_forkserver_preload(
    ["isac_rt.cli.cli", "isac_rt.extensions.hardware", "isac_rt.results.files", "isac_rt.sweep"]
)
"""Each command has a process of its own, in which what all of them load is there already."""


def _given(arguments: Sequence[str], folder: Path, answer: connection.Connection) -> None:
    from isac_rt.cli.cli import main

    os.chdir(folder)
    said = io.StringIO()
    with redirect_stderr(said), redirect_stdout(io.StringIO()):
        status = main(list(arguments))
    used = [resource.getrusage(of) for of in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    seconds = sum(one.ru_utime + one.ru_stime for one in used)
    answer.send((status, said.getvalue(), seconds, 1024 * max(one.ru_maxrss for one in used)))


def bounded_command(arguments: Sequence[str], folder: Path) -> str:
    """The message of `isac-rt` with arguments that it refuses; processor time and memory, of all
    processes that it starts, are held against `MAX_S` and `MAX_BYTES`."""
    here, there = _PROCESSES.Pipe(duplex=False)
    process = _PROCESSES.Process(target=_given, args=(arguments, folder, there))
    process.start()
    there.close()
    assert here.poll(60), "no answer"
    status, said, seconds, memory = here.recv()
    process.join()
    assert status == 2, said
    assert "Traceback" not in said
    assert seconds < MAX_S, said
    assert memory < MAX_BYTES, said
    return said
