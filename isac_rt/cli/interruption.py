"""Ctrl-C, SIGTERM and SIGHUP: the process ends soon, whatever it is doing, and says what of its
work is kept."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_GRACE = 1.2
"""After Ctrl-C a run may tidy up for so long [s]; then the process ends."""
ENDING = (signal.SIGTERM, signal.SIGHUP)


class Terminated(BaseException):
    """SIGTERM or SIGHUP, by its number: unwinds as Ctrl-C does, so that temporary files are taken
    away."""


@contextmanager
def ending_soon_after_interrupt(folder: Path) -> Iterator[None]:
    """Make Ctrl-C, SIGTERM and SIGHUP end the process within `_GRACE` even inside a long native
    call, leaving no half-written file. Whatever ends it, say which frames `folder` keeps.

    Python runs its own handler only between byte codes; the wake-up pipe is written by the C
    handler at once, and a thread waits for it. Only the main thread may give a signal its default
    action back, and that one is busy; blocking the signals until a thread waits for them would
    hand the block down to all child processes. So the thread ends the process by `os._exit`, with
    the status that a shell reports after the signal.
    """
    from isac_rt.simulation.resume import FILE, ResumeError
    from isac_rt.storage import abandon

    saved = folder / FILE
    receive, send = os.pipe()
    os.set_blocking(send, False)

    def wait() -> None:
        while (received := os.read(receive, 1)) and received[0] not in (signal.SIGINT, *ENDING):
            pass
        os.close(receive)
        if not received:
            return
        time.sleep(_GRACE)
        abandon()
        _say_kept(saved)
        say_interrupted()
        os._exit(128 + received[0])

    before = signal.set_wakeup_fd(send, warn_on_full_buffer=False)
    # one that is ignored stays so: nohup
    asked = [s for s in ENDING if signal.getsignal(s) is not signal.SIG_IGN]
    defaults = [signal.signal(s, _terminated) for s in asked]
    threading.Thread(target=wait, daemon=True).start()
    hook, sys.unraisablehook = sys.unraisablehook, _unraised
    try:
        yield
    except BaseException as problem:
        if not isinstance(problem, ResumeError):
            _say_kept(saved)
        raise
    finally:
        sys.unraisablehook = hook
        signal.set_wakeup_fd(before)
        for number, default in zip(asked, defaults, strict=True):
            signal.signal(number, default)
        os.close(send)


def _terminated(number: int, *_: Any) -> None:
    raise Terminated(number)


def _unraised(what: Any) -> None:
    """A stop that Python cannot raise where it is, as while an object is taken away: `wait` ends
    the process."""
    if not issubclass(what.exc_type, KeyboardInterrupt | Terminated):
        sys.__unraisablehook__(what)


def say_interrupted() -> None:
    """The last word of a process that was stopped."""
    _say("interrupted")


def _say_kept(file: Path) -> None:
    if file.exists():
        _say(f"{file} keeps the frames so far; the same command resumes after them")


def _say(text: str) -> None:
    with suppress(OSError, ValueError):  # its terminal may be gone
        sys.stderr.write(f"\n{text}\n")
        sys.stderr.flush()
