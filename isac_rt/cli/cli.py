"""The command line. Commands import what they need when they run, so that ``isac-rt --help`` is
quick.

Exit 0: done; 2: the input or the machine will not do, in one message; 130: interrupted; 1: anything
else.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

import isac_rt
from isac_rt.cli.console import err as _err
from isac_rt.cli.console import out as _out
from isac_rt.cli.console import table as _table
from isac_rt.cli.console import with_progress as _with_progress
from isac_rt.cli.interruption import Terminated, ending_soon_after_interrupt, say_interrupted
from isac_rt.runtime import UserError

if TYPE_CHECKING:
    from isac_rt.results.recorder import Results
    from isac_rt.scenario.tree import Scenario

DEBUG = "ISAC_RT_DEBUG"

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

ScenarioFile = Annotated[
    Path, typer.Argument(metavar="SCENARIO", help="The scenario, a YAML file.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Replace a key, as in radio.groups=2."),
]
FrameNumber = Annotated[int, typer.Option("--frame", min=0, help="Number of the frame.")]


def _print_versions(wanted: bool) -> None:
    if wanted:
        from isac_rt.results.provenance import versions

        under = ", ".join(
            f"{name} {number}" for name, number in versions().items() if name != "isac_rt"
        )
        typer.echo(f"isac-rt {isac_rt.__version__} ({under})")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_versions, is_eager=True, help="Print the versions and end."
        ),
    ] = False,
) -> None:
    """Integrated sensing and communication of a UAV swarm over a ray-traced city."""


class InputProblem(UserError):
    """A command's arguments do not fit the scenario."""


def _load(
    file: Path,
    overrides: Sequence[str] | None = None,
    frames: int | None = None,
    seed: int | None = None,
) -> Scenario:
    from isac_rt.scenario.file import load

    return load(file, overrides or (), frames, seed)


@app.command()
def run(
    scenario: ScenarioFile,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where the results go; default runs/NAME."),
    ] = None,
    frames: Annotated[int | None, typer.Option("--frames", help="Simulate so many frames.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Replace the scenario's seed.")] = None,
    snapshots: Annotated[
        int,
        typer.Option("--snapshots", min=1, help="Frames of which maps and path ledger are kept."),
    ] = 3,
    check_budget: Annotated[
        bool,
        typer.Option(
            "--check-budget",
            help="Afterwards measure what was left out on sampled frames; into summary.json.",
        ),
    ] = False,
    overrides: Overrides = None,
) -> None:
    """Simulate a scenario: results, summary, figures and a report."""
    loaded = _load(scenario, overrides, frames, seed)
    folder = out if out is not None else Path("runs") / loaded.name
    with ending_soon_after_interrupt(folder):
        _run(loaded, folder, snapshots, check_budget)
    _out().print(
        f"results in {folder}: report.html, results.nc, summary.json, scenario.yaml, figures/",
        soft_wrap=True,
    )


def _run(loaded: Scenario, folder: Path, snapshots: int, check_budget: bool) -> None:
    from isac_rt.results.files import check_folder, save

    check_folder(folder)
    from isac_rt.simulation import simulate
    from isac_rt.simulation.content import run_content
    from isac_rt.simulation.resume import Unfinished
    from isac_rt.simulation.setup import link_budgets, prepare

    with _err().status("setting up"):
        setup = prepare(loaded)
        budget = link_budgets(setup)
    _print_budget(budget)
    unfinished = Unfinished(folder, run_content(loaded, snapshots))
    if unfinished.begun:
        _err().print(f"going on after the frames in {unfinished.file}", soft_wrap=True)
    results = _with_progress(
        lambda report: simulate.run(
            loaded, setup=setup, progress=report, snapshots=snapshots, unfinished=unfinished
        ),
        "frames",
        loaded.frames,
    )
    if check_budget:
        from isac_rt.simulation.audit import check

        with _err().status("measuring what was left out"):
            results.summary["fidelity"]["checked"] = check(setup)
    save(results, folder)
    with _err().status("figures and report"):
        from isac_rt.views.figures import make_figures
        from isac_rt.views.report import write_report

        write_report(results, folder, make_figures(results, folder, setup.city))
    unfinished.remove()
    _print_summary(results)


@app.command()
def plan(
    scenario: ScenarioFile,
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
    receivers: Annotated[
        bool, typer.Option("--receivers", help="Time the reception of one frame too.")
    ] = False,
    overrides: Overrides = None,
) -> None:
    """What a run will model, what it leaves out, and the estimated error and time of each; traces a
    few frames only."""
    loaded = _load(scenario, overrides)
    with ending_soon_after_interrupt(Path()), _err().status("tracing a few frames"):
        from isac_rt.simulation.audit import make_plan
        from isac_rt.simulation.setup import prepare

        found = make_plan(prepare(loaded), receivers)
    if json:
        from json import dumps

        typer.echo(dumps(found, indent=1))
        return
    _print_plan(found, loaded.frames)


def _print_plan(found: dict[str, Any], frames: int) -> None:
    """The plan of `isac_rt.simulation.audit.make_plan`."""
    table = _table("", "link", "modelled", "left out", "error", "s/frame", justify="left")
    for item in found["items"]:
        value = item["estimate"]
        error = "" if value is None else f"{value:.2g} {item['unit']}" if value else "none"
        seconds = "" if item["seconds"] is None else f"{item['seconds']:.3f}"
        table.add_row(
            item["what"],
            item["link"].replace("->", " to "),
            item["modelled"],
            item["left_out"],
            error,
            seconds,
        )
    _out().print(table)
    settled = {
        "phase error at most [rad]": found["max_phase_error_rad"],
        "weakest [dB under the noise of a cell]": found["weakest_path_db"],
        "reach [m]": found["reach_m"],
    }
    said = ", ".join(f"{name}: {value}" for name, value in settled.items() if value is not None)
    total = sum(found["seconds_per_frame"].values()) * frames
    stages = ", ".join(found["seconds_per_frame"])
    _out().print(
        f"preset {found['preset']}; {said}; about {total:.0f} s for {frames} frames of {stages}"
    )


@app.command()
def paths(
    scenario: ScenarioFile,
    frame: FrameNumber,
    out: Annotated[Path, typer.Option("--out", metavar="FILE.nc", help="Where the ledger goes.")],
    overrides: Overrides = None,
) -> None:
    """Write the path ledger of a frame, all links."""
    loaded = _load(scenario, overrides)
    _check_frame(loaded, frame)
    with ending_soon_after_interrupt(out.parent), _err().status("tracing"):
        from isac_rt.simulation.setup import trace
        from isac_rt.views.interchange import write_ledger

        found = trace(loaded, frame)
        write_ledger(found, out, loaded)
    table = _table(
        "link", *(k.replace("_", " ") for k in next(iter(found.values())).counts()) if found else ()
    )
    for (tx, rx), p in found.items():
        table.add_row(f"{tx} to {rx}", *map(str, p.counts().values()))
    _out().print(table)


@app.command()
def view(
    scenario: ScenarioFile,
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="FILE", help="A .png, or an .html page with the scene to turn about."
        ),
    ],
    frame: FrameNumber = 0,
    overrides: Overrides = None,
) -> None:
    """Render the city, the swarm and the paths of a frame."""
    if out.suffix not in (".png", ".html"):
        raise InputProblem(f"--out {out}: a view is a .png picture or an .html page; name it so")
    loaded = _load(scenario, overrides)
    _check_frame(loaded, frame)
    with ending_soon_after_interrupt(out.parent), _err().status("tracing and drawing"):
        import numpy as np

        from isac_rt.simulation.setup import prepare, trace
        from isac_rt.views.render import view_scene, write_view

        setup = prepare(loaded)
        found = trace(loaded, frame, setup=setup)
        times = np.linspace(setup.timetable.epoch(0), setup.timetable.epoch(loaded.frames - 1), 60)
        scene = setup.city, setup.swarm, times, setup.timetable.epoch(frame), found
        if out.suffix == ".html":
            from isac_rt.views.interactive import scene_3d, write_page

            write_page(scene_3d(*scene), out)
        else:
            write_view(view_scene(*scene), out)
    _out().print(f"{out}", soft_wrap=True)


@app.command()
def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Tables, figures and claims; none: list them."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Smaller samples: at most 2 minutes each on 2 cores.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Where the files go; default runs/reproduction/NAME."
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all randomness.")] = 20260,
) -> None:
    """Run the paper's tables, figures and claims again and judge them."""
    from isac_rt.studies.paper import TITLES
    from isac_rt.studies.paper import names as experiments

    if not names:
        table = _table("name", "what it shows", justify="left")
        for name in experiments():
            table.add_row(name, TITLES[name])
        _out().print(table)
        return
    if unknown := [name for name in names if name not in experiments()]:
        raise InputProblem(
            f"{', '.join(unknown)}: no such table or figure; choose from {', '.join(experiments())}"
        )
    for name in dict.fromkeys(names):
        folder = out if out is not None else Path("runs") / "reproduction" / name
        with ending_soon_after_interrupt(folder):
            _reproduce(name, folder, quick, seed)


def _reproduce(name: str, folder: Path, quick: bool, seed: int) -> None:
    from isac_rt.results.files import check_folder

    check_folder(folder)
    from isac_rt.studies.paper import experiment
    from isac_rt.studies.paper.montecarlo import kept_in
    from isac_rt.studies.paper.outcome import write

    with kept_in(folder / "frames"):
        outcome = _with_progress(lambda report: experiment(name)(quick, seed, report), name)
    files = write(outcome, folder)
    table = _table(name, "verdict", "finding", justify="left")
    table.columns[0].no_wrap = False
    colours = {"holds": "green", "holds under a condition": "yellow", "does not hold": "red"}
    for v in outcome.verdicts:
        table.add_row(v.claim, f"[{colours[v.verdict]}]{v.verdict}[/]", escape(v.finding))
    _out().print(table)
    _out().print(f"in {folder}: {', '.join(file.name for file in files)}", soft_wrap=True)


@app.command()
def sweep(
    file: Annotated[
        Path | None, typer.Argument(metavar="SWEEP", help="The sweep, a YAML file.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Where the outcomes go; default runs/NAME."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Processes; default one per core, as memory allows."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="A Dask scheduler to use instead."),
    ] = None,
    max_points: Annotated[
        int, typer.Option("--max-points", min=1, help="Refuse a sweep with more points.")
    ] = 100_000,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Run points again that failed.")
    ] = False,
    status: Annotated[
        Path | None,
        typer.Option("--status", metavar="DIR", help="Only say how far the sweep in DIR is."),
    ] = None,
) -> None:
    """Run a sweep, or what is missing of it: the same command again goes on."""
    if (file is None) == (status is None):
        raise InputProblem(
            "isac-rt sweep needs either a sweep file or --status DIR; give one of them"
        )
    if status is not None:
        _print_status(status)
        return
    assert file is not None
    from isac_rt.results.files import check_folder
    from isac_rt.sweep import SchedulerLost, load_sweep, run_sweep

    plan = load_sweep(file, max_points)
    folder = out if out is not None else Path("runs") / plan.sweep.name
    check_folder(folder)
    with ending_soon_after_interrupt(folder):
        try:
            _with_points(
                lambda report: run_sweep(
                    plan,
                    folder,
                    workers=workers,
                    scheduler=scheduler,
                    retry_failed=retry_failed,
                    progress=report,
                )
            )
        except SchedulerLost as lost:
            sys.stderr.write(f"{lost}\n")
            raise typer.Exit(1) from None
        _finish_sweep(plan, folder)


def _finish_sweep(plan: Any, folder: Path) -> None:
    """The dataset and the figures of a sweep's outcomes, and where they are."""
    from isac_rt.sweep import Outcomes, assemble, save_dataset
    from isac_rt.views.figures import make_sweep_figures

    with _err().status("dataset and figures"):
        dataset = assemble(plan, Outcomes(folder))
        save_dataset(dataset, folder)
        wanted = [(f.quantity, f.against, f.by) for f in plan.sweep.figures]
        make_sweep_figures(dataset, wanted, folder)
    _print_status(folder)
    _out().print(
        f"outcomes in {folder}: sweep.nc (isac_rt.open_sweep reads it, finished or not), figures/",
        soft_wrap=True,
    )


def _with_points(work: Any) -> None:
    """Do `work(report)` with a bar on stderr; `report(done, failed, total)` moves it."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("points"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[failed]} failed"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(elapsed_when_finished=False),
    )
    with Progress(*columns, console=_err()) as bar:
        task = bar.add_task("points", total=None, failed=0)
        work(
            lambda done, failed, total: bar.update(
                task, completed=done + failed, total=total, failed=failed
            )
        )


def _print_status(folder: Path) -> None:
    from isac_rt.sweep import status

    found = status(folder)
    left = found.total - found.done - found.failed
    _out().print(
        f"{found.done} of {found.total} points done, {found.failed} failed, {left} to do",
        soft_wrap=True,
    )
    for index, error in found.errors:
        _out().print(
            f"  failed at {list(index)}: {error.splitlines()[0]}", soft_wrap=True, markup=False
        )
    if found.failed:
        _out().print("  --retry-failed runs them again", soft_wrap=True)


@app.command()
def validate(
    quick: Annotated[
        bool, typer.Option("--quick", help="The quick selection: within a minute on 2 cores.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Write validation.json and validation.md there."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the table as JSON.")
    ] = None,
    only: Annotated[
        str,
        typer.Option(
            "--only", metavar="WORDS", help="Only cases with these words in group or name."
        ),
    ] = "",
) -> None:
    """Hold every physical and numerical claim of the program against an independent truth."""
    from isac_rt.results.files import check_folder
    from isac_rt.studies.validation import all_cases
    from isac_rt.studies.validation.table import write_json, write_markdown

    cases = [
        case for case in all_cases(quick) if only.lower() in f"{case.group} {case.name}".lower()
    ]
    if not cases:
        raise InputProblem(
            f"--only {only}: no case has these words in its group or name; leave it out to see "
            "them all"
        )
    for folder in {
        file for file in (out, json_file.parent if json_file else None) if file is not None
    }:
        check_folder(folder)
    with ending_soon_after_interrupt(out if out is not None else Path("runs")):
        verdicts = _validate(cases)
    if out is not None:
        write_json(verdicts, out / "validation.json")
        write_markdown(verdicts, out / "validation.md")
    if json_file is not None:
        write_json(verdicts, json_file)
    if any(v.passed is False for v in verdicts):
        raise typer.Exit(1)


def _validate(cases: list[Any]) -> list[Any]:
    """Run cases with a bar, print their table, return the verdicts."""
    from isac_rt.studies.validation import run_case
    from isac_rt.studies.validation.table import STATES, shown

    verdicts: list[Any] = []

    def work(report: Any) -> None:
        for number, case in enumerate(cases, start=1):
            verdicts.append(run_case(case))
            report(number, len(cases))

    _with_progress(work, "cases", len(cases))
    table = _table("case", "group", "error", "bound", "unit", "", "s")
    colours = {True: "green", False: "red", None: "yellow"}
    for v in verdicts:
        words = f"[{colours[v.passed]}]{STATES[v.passed]}[/]"
        table.add_row(
            escape(v.case.name),
            v.case.group,
            shown(v.error),
            shown(v.case.bound),
            v.case.unit,
            words,
            f"{v.seconds:.1f}",
        )
    _out().print(table)
    for v in verdicts:
        if v.note and v.passed is not True:
            _out().print(f"{v.case.name}: {v.note}", markup=False, soft_wrap=True)
    counts = {word: sum(v.passed is state for v in verdicts) for state, word in STATES.items()}
    _out().print(
        f"{counts['passes']} cases pass, {counts['FAILS']} fail, {counts['left out']} left out"
    )
    return verdicts


@app.command()
def bench(
    stages: Annotated[
        list[str] | None,
        typer.Argument(metavar="[STAGE]...", help="From synthesis to hermespy; all by default."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes only.")] = False,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where tables and figures go.")
    ] = Path("runs/bench"),
    json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the rows to a file too.")
    ] = None,
    fit: Annotated[
        Path | None,
        typer.Option("--fit", metavar="FILE", help="Only fit accuracy.cost_model to this machine."),
    ] = None,
) -> None:
    """Speed against error, method by method, in floors of the same run."""
    if fit is not None:
        return _fit(fit)
    from isac_rt.results.files import check_folder, write_text
    from isac_rt.studies.bench import report

    chosen = stages or report.stages()
    if unknown := [name for name in chosen if name not in report.stages()]:
        raise InputProblem(
            f"{', '.join(unknown)}: no such stage; choose from {', '.join(report.stages())}"
        )
    check_folder(out)
    with ending_soon_after_interrupt(out):
        found = _with_progress(
            lambda moved: report.measure(list(dict.fromkeys(chosen)), quick, moved),
            "stages",
            len(chosen),
        )
        files = report.write(found, out)
        if json is not None:
            from json import dumps

            write_text(json, dumps(found, indent=1) + "\n")
    table = _table("method", "size", "cost [floors]", "error")
    for row in found["rows"]:
        error = "" if row["error"] is None else f"{row['error']:.2g}"
        table.add_row(
            f"{row['kind']}: {row['method']}",
            f"{row['size']:,} {row.get('unit', '')}",
            f"{row['cost']:.3g}",
            error,
        )
    _out().print(table)
    for name, reason in found["left_out"].items():
        _out().print(f"{name} left out: {reason}", soft_wrap=True)
    _out().print(f"in {out}: {', '.join(file.name for file in files)}", soft_wrap=True)


def _fit(file: Path) -> None:
    """Measure what the methods of synthesis cost here, for accuracy.cost_model of a scenario."""
    from json import dumps

    from isac_rt.results.files import check_folder, write_text
    from isac_rt.studies.bench.fit import fit

    check_folder(file.parent)
    found = _with_progress(lambda moved: fit(progress=moved), "repeats")
    write_text(file, dumps(found, indent=1) + "\n")
    table = _table("method", "chirp [us]", "path [ns]", "deviation [%]")
    for name, row in found["methods"].items():
        table.add_row(
            name,
            f"{row['chirp_ns'] / 1000:.3g}",
            f"{row['path_ns']:.3g}",
            f"{100 * row['deviation']:.2g}",
        )
    _out().print(table)
    _out().print(f"{file}: name it in accuracy.cost_model of a scenario", soft_wrap=True)


@app.command()
def doctor() -> None:
    """Back end, LLVM, memory, threads, and what to install."""
    from isac_rt.runtime import doctor as look

    checks = look()
    table = _table("", "found", "to do", justify="left")
    for check in checks:
        table.add_row(
            f"[green]ok[/] {check.name}" if check.ok else f"[red]no[/] {check.name}",
            check.found,
            "" if check.ok else check.remedy,
        )
    _out().print(table)
    if not all(check.ok for check in checks):
        raise typer.Exit(2)


@app.command()
def schema() -> None:
    """JSON Schema of the scenario, for editors."""
    from isac_rt.cli.starter import schema_text

    typer.echo(schema_text(), nl=False)


@app.command()
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="The scenario to write.")],
    footprints: Annotated[
        Path | None,
        typer.Option("--footprints", metavar="FILE", help="Buildings, as GeoJSON or CityJSON."),
    ] = None,
) -> None:
    """Write a commented scenario to start from, over a street canyon or over one's own buildings,
    and the schema for editors."""
    from isac_rt.cli.starter import write_starter

    files, notes = write_starter(file, footprints)
    for line in [*files, *notes]:
        _out().print(f"{line}", soft_wrap=True)


@app.command()
def animate(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="What `isac-rt run --snapshots N` wrote.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="A .gif or an .mp4; default DIR/run.gif."),
    ] = None,
    observer: Annotated[
        str | None, typer.Option("--observer", metavar="NAME", help="Whose map; default the first.")
    ] = None,
    rate: Annotated[
        float, typer.Option("--rate", min=0.1, max=60, help="Pictures per second.")
    ] = 5.0,
) -> None:
    """Draw a run as a moving picture: the swarm with tracks, and a range-Doppler map, in step."""
    from isac_rt.results.files import open_results

    results = open_results(folder)
    names = [str(name) for name in results.dataset.observer.values]
    if observer is not None and observer not in names:
        raise InputProblem(
            f"--observer {observer}: no such observer in {folder}; choose from {', '.join(names)}"
        )
    from isac_rt.simulation.setup import city_of
    from isac_rt.views.animate import write_animation

    target = out if out is not None else folder / "run.gif"
    with ending_soon_after_interrupt(folder), _err().status("drawing"):
        write_animation(
            results,
            target,
            names.index(observer) if observer else 0,
            city_of(results.scenario),
            rate,
        )
    _out().print(f"{target}", soft_wrap=True)


def _check_frame(scenario: Scenario, frame: int) -> None:
    if frame >= scenario.frames:
        raise InputProblem(
            f"--frame {frame}: {scenario.name} has frames 0 to {scenario.frames - 1}; choose one "
            "of these or set frames higher"
        )


def _print_budget(rows: Sequence[Any]) -> None:
    """The link budget as `isac_rt.frame.level.LinkBudget` rows."""
    table = _table(
        "link budget",
        "reference",
        "distance [m]",
        "received [dBm]",
        "noise [dBm]",
        "SNR [dB]",
        "gain [dB]",
        "processed [dB]",
    )
    for b in rows:
        values = (
            b.distance_m,
            b.received_dbm,
            b.noise_dbm,
            b.snr_db,
            b.processing_gain_db,
            b.processed_snr_db,
        )
        table.add_row(b.link.replace("->", " to "), b.reference, *(f"{v:.1f}" for v in values))
    _out().print(table)


def _print_summary(results: Results) -> None:
    from isac_rt.views.report import number, per_terminal, rmse_table

    for part in (per_terminal(results.summary), rmse_table(results.summary)):
        keep = [
            i
            for i, title in enumerate(part.columns)
            if title not in ("Role", "Matched", "Matched, tracked")
        ]
        table = _table(*(part.columns[i] for i in keep))
        for row in part.rows:
            table.add_row(*(row[i] for i in keep))
        _out().print(table)
    found = ", ".join(
        f"{n:,} {kind.replace('_', ' ')}" for kind, n in results.summary["paths"].items() if n
    )
    _out().print(f"paths: {found}; {number(results.summary['timing_s']['total'])} s")


def _say_warning(message: Warning | str, category: type[Warning], *_: Any) -> None:
    if category.__module__.startswith("isac_rt"):
        _err().print(f"[yellow]warning[/] {message}", soft_wrap=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    warnings.showwarning = _say_warning  # type: ignore[assignment]
    try:
        status = app(
            args=None if arguments is None else list(arguments),
            prog_name="isac-rt",
            standalone_mode=False,
        )
        if status == 130:  # what typer makes of Ctrl-C
            say_interrupted()
        return status if isinstance(status, int) else 0
    except KeyboardInterrupt:
        say_interrupted()
        return 130
    except Terminated:
        say_interrupted()
        return 128 + signal.SIGTERM
    except Exception as problem:
        if os.environ.get(DEBUG):
            traceback.print_exc()
        if hasattr(problem, "exit_code"):  # typer's own: usage errors, exits and aborts
            text = problem.format_message() if hasattr(problem, "format_message") else ""
            if text:
                sys.stderr.write(f"{text} (see isac-rt --help)\n")
            return int(problem.exit_code)
        if isinstance(problem, UserError):
            sys.stderr.write(f"{problem}\n")
            return 2
        sys.stderr.write(
            f"{type(problem).__name__}: {problem} (this is a fault of isac_rt; {DEBUG}=1 shows "
            "where)\n"
        )
        return 1


if __name__ == "__main__":
    sys.exit(main())
