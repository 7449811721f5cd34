"""What the command line writes: text, tables, and a bar while something takes long. Nothing of it
is markup, so that "range [m]" keeps its unit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

Report = Callable[..., None]
"""`report(done, total, note)` moves a bar; the note is optional."""


def out() -> Console:
    """What a command answers."""
    console = Console(markup=False, highlight=False, emoji=False)
    if not console.is_terminal:
        console.width = 140  # in a file or a pipe there is no edge to wrap at
    return console


def err() -> Console:
    """What it says besides: progress and warnings."""
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
        found = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
        for i, title in enumerate(titles):
            if i and numbers:
                title = title if wide else title.replace(" ", "\n")
                found.add_column(title, justify="right", no_wrap=True)
            else:
                found.add_column(title, overflow="fold", no_wrap=wide)
        for row in rows:
            found.add_row(*row)
        return found

    console = out()
    wide = made(True)
    needs = console.measure(wide, options=console.options.update(max_width=10_000)).maximum
    console.print(wide if needs <= console.width else made(False))


def with_progress(work: Callable[[Report], Any], what: str, steps: int | None = None) -> Any:
    """Do `work(report)` with a bar on stderr."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn(what, markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err()) as bar:
        task = bar.add_task(what, total=steps, note="")

        def report(done: int, total: int | None, note: str = "") -> None:
            bar.update(task, completed=done, total=total, note=note)

        return work(report)
