"""Progress bar of a run, on a terminal or in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[int, int], None]
"""Called with the frames done and the frames in all."""


@contextmanager
def followed(progress: Progress | bool | None, total: int) -> Iterator[Progress | None]:
    """Yield the function to be called after every frame. True: a bar on a terminal or in a
    notebook, removed at the end, and None elsewhere."""
    if progress is not True:
        yield progress or None
        return
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_jupyter:
        yield from _in_notebook(total)
    elif console.is_terminal:
        from rich.progress import Progress as Bar

        with Bar(console=console, transient=True) as bar:
            task = bar.add_task("frames", total=total)
            yield lambda done, total: bar.update(task, completed=done, total=total)
    else:
        yield None


def _in_notebook(total: int) -> Iterator[Progress]:
    """Yield a progress that moves a bar of HTML, which needs no widgets."""
    from IPython.display import HTML, display

    def bar(done: int, total: int) -> HTML:
        return HTML(f"frames <progress value={done} max={total}></progress> {done} of {total}")

    shown = display(bar(0, total), display_id=True)
    yield lambda done, total: shown.update(bar(done, total))
    shown.update(HTML(""))
