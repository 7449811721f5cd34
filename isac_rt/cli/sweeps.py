"""The command that runs sweeps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isac_rt.cli.arguments import InputProblem
from isac_rt.cli.console import Report, say, with_progress, working
from isac_rt.cli.interruption import ending_soon_after_interrupt

if TYPE_CHECKING:
    from isac_rt.sweep.definition import Plan

Workers = Annotated[
    int | None,
    typer.Option(min=1, help="Processes.", show_default="one per core, as memory allows"),
]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Run on this Dask scheduler instead.")
]


def sweep(
    file: Annotated[
        Path | None, typer.Argument(metavar="SWEEP", help="The sweep, a YAML file.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the outcomes.", show_default="runs/NAME"),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    max_points: Annotated[
        int, typer.Option(min=1, help="Largest number of points accepted.")
    ] = 100_000,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Run failed points again.")
    ] = False,
    status: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Print the progress of the sweep in DIR and exit."),
    ] = None,
) -> None:
    """Run a parameter sweep. After a stop the same command computes the missing points."""
    if (file is None) == (status is None):
        raise InputProblem(
            "isac-rt sweep needs either a sweep file or --status DIR; give one of them"
        )
    if file is None:
        _say_status(Path(str(status)))
        return
    from isac_rt.results.files import check_folder
    from isac_rt.sweep import load_sweep, run_sweep

    plan = load_sweep(file, max_points)
    folder = out if out is not None else Path("runs") / plan.sweep.name
    check_folder(folder)
    with ending_soon_after_interrupt(folder):
        _on_workers(
            "points",
            partial(
                run_sweep,
                plan,
                folder,
                workers=workers,
                scheduler=scheduler,
                retry_failed=retry_failed,
            ),
        )
        _finish(plan, folder)


def _on_workers(what: str, run: Callable[..., Any]) -> Any:
    """Run points with a bar; a scheduler that is lost on the way is one message, exit 1."""
    from isac_rt.sweep import SchedulerLost

    def counting(report: Report) -> Any:
        return run(
            progress=lambda done, failed, total: report(done + failed, total, f"{failed} failed")
        )

    try:
        return with_progress(counting, what)
    except SchedulerLost as lost:
        typer.echo(lost, err=True)
        raise typer.Exit(1) from None


def _finish(plan: Plan, folder: Path) -> None:
    """The dataset and the figures of a sweep's outcomes, and where they are."""
    from isac_rt.sweep import Outcomes, assemble, save_dataset
    from isac_rt.views.figures import make_sweep_figures

    with working("dataset and figures"):
        dataset = assemble(plan, Outcomes(folder))
        save_dataset(dataset, folder)
        wanted = [(f.quantity, f.against, f.by) for f in plan.sweep.figures]
        make_sweep_figures(dataset, wanted, folder)
    _say_status(folder)
    say(f"outcomes in {folder}: sweep.nc (isac_rt.open_sweep reads it, finished or not), figures/")


def _say_status(folder: Path) -> None:
    from isac_rt.sweep import status

    state = status(folder)
    left = state.total - state.done - state.failed
    say(f"{state.done} of {state.total} points done, {state.failed} failed, {left} to do")
    say(*(f"  failed at {place}: {error.splitlines()[0]}" for place, error in state.errors))
    if state.failed:
        say("  --retry-failed runs them again")
    for count, cause in (
        (state.other_version, "by another version of isac_rt or of its packages"),
        (state.other_scenario, "for other values of the scenario or of its files"),
    ):
        if count:
            say(f"  {count} more in the folder were computed {cause} and are not used")


def dataset(
    file: Annotated[Path, typer.Argument(metavar="DATASET", help="The data set, a YAML file.")],
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the data set.", show_default="runs/NAME"),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Simulate random scenes as a data set for machine learning. Keeps what its file names (maps,
    spectra, paths, labels, ...); after a stop the same command computes the missing scenes."""
    from isac_rt.results.files import check_folder

    with working("drawing the scenes"):
        from isac_rt.sweep import load_dataset, run_dataset

        plan = load_dataset(file)
    folder = out if out is not None else Path("runs") / plan.data.name
    check_folder(folder)
    with ending_soon_after_interrupt(folder):
        card = _on_workers(
            "scenes", partial(run_dataset, plan, folder, workers=workers, scheduler=scheduler)
        )
    counts = {name: (len(shards), sum(shards.values())) for name, shards in card["splits"].items()}
    message = ", ".join(f"{name}: {s} scenes, {n:,} samples" for name, (s, n) in counts.items())
    say(f"{message}; {card['bytes'] / 1e6:,.1f} MB, {card['scenes_failed']} scenes failed")
    spent = card["processor_s"]
    if total := spent.pop("total", 0.0):
        parts = (f"{name} {seconds / total:.0%}" for name, seconds in spent.items())
        say(f"processor time {total:,.0f} s: {', '.join(parts)}")
    say(f"data set in {folder}: SPLIT/NUMBER.tar (WebDataset), card.json, croissant.json")
