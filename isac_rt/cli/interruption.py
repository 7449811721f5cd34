"""Ctrl-C and SIGTERM: the process ends soon, whatever it is doing, and says what of its work is
kept."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_GRACE = 1.2
"""After Ctrl-C a run may tidy up for so long [s]; then the process ends."""


class Terminated(BaseException):
    """SIGTERM: unwinds as Ctrl-C does, so that temporary files are taken away."""


@contextmanager
def ending_soon_after_interrupt(folder: Path) -> Iterator[None]:
    """Make Ctrl-C and SIGTERM end the process within `_GRACE` even inside a long native call,
    leaving no half-written file in `folder`.

    Python runs its own handler only between byte codes; the wake-up pipe is written by the C
    handler at once, and a thread waits for it.
    """
    from isac_rt.simulation.resume import FILE

    kept = folder / FILE
    receive, send = os.pipe()
    os.set_blocking(send, False)

    def wait() -> None:
        while (heard := os.read(receive, 1)) and heard[0] not in (signal.SIGINT, signal.SIGTERM):
            pass
        os.close(receive)
        if not heard:
            return
        time.sleep(_GRACE)
        for partial in folder.rglob(f".*.{os.getpid()}.tmp"):
            partial.unlink(missing_ok=True)
        _say_kept(kept)
        say_interrupted()
        os._exit(128 + heard[0])

    before = signal.set_wakeup_fd(send, warn_on_full_buffer=False)
    default = signal.signal(signal.SIGTERM, _terminated)
    threading.Thread(target=wait, daemon=True).start()
    try:
        yield
    except (KeyboardInterrupt, Terminated):
        _say_kept(kept)
        raise
    finally:
        signal.set_wakeup_fd(before)
        signal.signal(signal.SIGTERM, default)
        os.close(send)


def _terminated(*_: Any) -> None:
    raise Terminated


def say_interrupted() -> None:
    """The last word of a process that was stopped."""
    sys.stderr.write("\ninterrupted\n")
    sys.stderr.flush()


def _say_kept(file: Path) -> None:
    if file.exists():
        sys.stderr.write(f"\n{file} keeps the frames so far; the same command goes on after them\n")
