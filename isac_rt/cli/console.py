"""Output of the command line: text, tables, and a bar for long work. Text is never read as markup,
so that "range [m]" keeps its unit."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

Report = Callable[..., None]
"""`report(done, total, note)` moves a bar; the note is optional."""

EVERY_S, SOON_S = 10.0, 1.0
"""Where no terminal shows a bar a line comes at least and at most so often [s]."""


def out() -> Console:
    """Write a command's answer."""
    console = Console(markup=False, highlight=False, emoji=False)
    if not console.is_terminal:
        console.width = 140  # in a file or a pipe there is no edge to wrap at
    return console


def err() -> Console:
    """Write progress and warnings."""
    return Console(stderr=True, markup=False, highlight=False, emoji=False)


def say(*lines: object) -> None:
    """Print lines that a terminal may wrap, but not this program."""
    for line in lines:
        out().print(str(line), soft_wrap=True)


def say_table(
    titles: Sequence[str], rows: Sequence[Sequence[str | Text]], numbers: bool = True
) -> None:
    """Print a table: its first column holds words, the others numbers unless said otherwise. Where
    it is too wide for the terminal, words wrap and the titles of numbers stand in several lines."""

    def made(wide: bool) -> Table:
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
        for i, title in enumerate(titles):
            if i and numbers:
                title = title if wide else title.replace(" ", "\n")
                table.add_column(title, justify="right", no_wrap=True)
            else:
                table.add_column(title, overflow="fold", no_wrap=wide, min_width=9)
        for row in rows:
            table.add_row(*row)
        return table

    console = out()
    wide = made(True)
    needs = console.measure(wide, options=console.options.update(max_width=10_000)).maximum
    console.print(wide if needs <= console.width else made(False))


@contextmanager
def working(what: str) -> Iterator[None]:
    """Say on stderr what is being done, and the steps of it that the program logs: beside a spinner
    on a terminal, else in lines (`_Lines`)."""
    console = err()
    if not console.is_terminal:
        with _Lines(what) as lines, _logged(lines.note):
            yield
        return
    with (
        console.status(Text(what)) as status,
        _logged(lambda step: status.update(Text(f"{what}: {step}"))),
    ):
        yield


def with_progress(work: Callable[[Report], Any], what: str, steps: int | None = None) -> Any:
    """Do `work(report)` with a bar on stderr, or with lines where there is no terminal."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    if not err().is_terminal:
        with _Lines(what, steps) as lines, _logged(lines.note):
            return work(lines.move)
    columns = (
        TextColumn(what, markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}", markup=False),
    )
    with Progress(*columns, console=err()) as bar:
        task, pace = bar.add_task(what, total=steps, note="", left=""), _Pace()

        def report(done: int, total: int | None, note: str = "") -> None:
            pace.move(done)
            bar.update(task, completed=done, total=total, note=note, left=pace.left(total))

        def step(text: str) -> None:
            pace.interrupt()
            bar.update(task, note=text)

        with _logged(step):
            return work(report)


class _Pace:
    """The time left, from what was done since the last logged step: what took its time once, such
    as compiling, says nothing of the rest."""

    def __init__(self) -> None:
        self._begun: tuple[int, float] | None = None
        self._done = 0

    def interrupt(self) -> None:
        """Begin anew with the next part that is done."""
        self._begun = None

    def move(self, done: int) -> None:
        """Take up that so many parts are done."""
        self._done = done
        if self._begun is None:
            self._begun = done, time.monotonic()

    def left(self, total: int | None) -> str:
        """The time left in words; empty where nothing was done without interruption."""
        if self._begun is None or not total or not self._begun[0] < self._done < total:
            return ""
        first, since = self._begun
        seconds = (time.monotonic() - since) * (total - self._done) / (self._done - first)
        return f"about {seconds:.0f} s left"


class _Lines:
    """Progress as lines: at once, at the end, and in between at least every `EVERY_S`; steps that
    are logged less than `SOON_S` after a line wait for the next."""

    def __init__(self, what: str, total: int | None = None) -> None:
        self._what, self._done, self._total, self._step = what, 0, total, ""
        self._begun, self._lock, self._pace = time.monotonic(), threading.Lock(), _Pace()
        self._ended = threading.Event()
        self._repeat = threading.Thread(target=self._go_on, daemon=True)

    def __enter__(self) -> _Lines:
        self._say()
        self._repeat.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._repeat.join()

    def note(self, step: str) -> None:
        """A step has begun, or goes on."""
        if step == self._step:
            return
        self._step = step
        self._pace.interrupt()
        if time.monotonic() - self._said >= SOON_S:
            self._say()

    def move(self, done: int, total: int | None, note: str = "") -> None:
        """So much is done; the end is said at once."""
        self._done, self._total, self._step = done, total, note
        self._pace.move(done)
        if done == total:
            self._say()

    def _go_on(self) -> None:
        while not self._ended.wait(max(self._said + EVERY_S - time.monotonic(), 0.1)):
            if time.monotonic() - self._said >= EVERY_S:
                self._say()

    def _say(self) -> None:
        with self._lock:
            self._said = time.monotonic()
            passed = self._said - self._begun
            parts = [f"{self._done} of {self._total}"] if self._total else []
            parts += [self._step] if self._step else []
            parts += [f"{passed:.0f} s"] if passed >= 1 else []
            parts += [left] if (left := self._pace.left(self._total)) else []
            message = f"{self._what}: {', '.join(parts)}" if parts else self._what
            err().print(message, soft_wrap=True)


@contextmanager
def _logged(say: Callable[[str], None]) -> Iterator[None]:
    """Hand the steps that the program logs to `say`."""

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            say(record.getMessage())

    logger, handler = logging.getLogger("isac_rt"), Handler(logging.INFO)
    before = logger.level
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)
