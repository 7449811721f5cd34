"""What the command line writes: plain tables, and a bar while something takes long."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table


def out() -> Console:
    """What a command answers."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = 140  # in a file or a pipe there is no edge to wrap at
    return console


def err() -> Console:
    """What it says besides: progress and warnings."""
    return Console(stderr=True, highlight=False)


def with_progress(work: Any, what: str, steps: int | None = None) -> Any:
    """Do `work(report)` with a bar on stderr; `report(done, total)` moves it."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err()) as bar:
        task = bar.add_task(what, total=steps)
        return work(lambda done, total: bar.update(task, completed=done, total=total))


def table(*titles: str, justify: Any = "right") -> Table:
    """An empty table; its first column is on the left."""
    found = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for i, title in enumerate(titles):
        found.add_column(title, justify="left" if i == 0 else justify, no_wrap=i == 0)
    return found
