"""Commands on one scenario and on what a run of it wrote."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isac_rt.cli.arguments import (
    FrameNumber,
    InputProblem,
    Overrides,
    ScenarioFile,
    check_frame,
    check_names,
)
from isac_rt.cli.console import Report, err, out, say, say_table, with_progress, working
from isac_rt.cli.interruption import ending_soon_after_interrupt

if TYPE_CHECKING:
    from isac_rt.results.recorder import Results
    from isac_rt.scenario.tree import Scenario


def run(
    scenario: ScenarioFile,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the results.", show_default="runs/NAME"),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="Frames to simulate.", show_default="the scenario's")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of all randomness.", show_default="the scenario's")
    ] = None,
    snapshots: Annotated[
        int, typer.Option(min=1, help="Frames whose maps and paths are kept.")
    ] = 3,
    check_budget: Annotated[
        bool,
        typer.Option(
            "--check-budget",
            help="Measure the error of omitted paths on sampled frames; into summary.json.",
        ),
    ] = False,
    restart: Annotated[
        bool,
        typer.Option("--restart", help="Discard the frames that a stopped run saved in DIR."),
    ] = False,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Overwrite the results of another scenario in DIR."),
    ] = False,
    overrides: Overrides = None,
) -> None:
    """Simulate a scenario and write results, figures and a report. After a stop the same command
    resumes it."""
    from isac_rt.kernels.jit import use_whole_registers
    from isac_rt.scenario.file import load

    use_whole_registers()
    loaded = load(scenario, overrides or (), frames, seed)
    folder = out if out is not None else Path("runs") / loaded.name
    from isac_rt.results.files import check_folder
    from isac_rt.simulation.resume import check_replaces_nothing, sole_use

    check_folder(folder)
    with sole_use(folder), ending_soon_after_interrupt(folder):
        if not overwrite:
            check_replaces_nothing(folder, loaded)
        _run(loaded, folder, snapshots, check_budget, restart)
    say(f"results in {folder}: report.html, results.nc, summary.json, scenario.yaml, figures/")


def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder of the scenario and its results.")
    ] = Path("isac_rt_demo"),
) -> None:
    """Simulate a small scenario in a street canyon; needs no file. The scenario is written next to
    its results, to be changed and run again."""
    from isac_rt.cli.starter import write_starter

    scenario = out / "demo.yaml"
    if not scenario.exists():
        write_starter(scenario)
    run(scenario, out / "results", frames=12, overwrite=True)
    say(f"next: change {scenario}, of which 12 frames were run, then isac-rt run {scenario}")


def _run(loaded: Scenario, folder: Path, snapshots: int, check_budget: bool, restart: bool) -> None:
    from isac_rt.results.files import save

    with working("loading the program"):
        from isac_rt.kernels.jit import compilations_logged
        from isac_rt.results.provenance import run_content
        from isac_rt.simulation import simulate
        from isac_rt.simulation.resume import Resume
        from isac_rt.simulation.setup import link_budgets, prepare
        from isac_rt.world.area import city_digest

        city = city_digest(loaded.city, loaded.folder)
    resume = Resume(folder, run_content(loaded, snapshots, city))
    if restart:
        resume.remove()
    resume.check()
    with compilations_logged(), working("setting up"):
        setup = prepare(loaded, digest=city)
        budget = link_budgets(setup)
    _say_city(setup.city.notes)
    _say_coverage(asdict(setup.coverage))
    _say_budget(budget)
    if resume.begun:
        err().print(f"resuming after the frames saved in {resume.file}", soft_wrap=True)

    def simulated(report: Report) -> Results:
        def progress(done: int, total: int) -> None:
            report(done, total)
            if done < total:  # while receivers are at work
                _drawing()

        with compilations_logged():
            return simulate.run(
                loaded, setup=setup, progress=progress, snapshots=snapshots, resume=resume
            )

    results = with_progress(simulated, "frames", loaded.frames)
    if check_budget:
        from isac_rt.simulation.audit import check

        with working("measuring what was left out"):
            results.summary["fidelity"]["checked"] = check(setup)
    save(results, folder)
    with working("figures and report"):
        make_figures, write_report = _drawing()
        pictures = make_figures(results, folder, setup.city)
        write_report(results, folder, pictures, setup.city)
    resume.remove()
    _say_summary(results)


def _drawing() -> tuple[Callable[..., list[Path]], Callable[..., Path]]:
    """Load the functions that draw figures and write the report, at the first call."""
    from isac_rt.views.figures import make_figures
    from isac_rt.views.report import write_report

    return make_figures, write_report


def _say_city(notes: Sequence[str]) -> None:
    """Print what was assumed of the city and left out of its file."""
    say(*(f"city: {note}" for note in notes))


def _say_coverage(seen: Mapping[str, Any]) -> None:
    """Print the coverage of the radar, from `isac_rt.simulation.coverage.Coverage`."""
    from isac_rt.views.tables import coverage_tables

    limits, words, outside = coverage_tables(seen)
    say_table(limits.columns, limits.rows)
    out().print(words)
    if outside.rows:
        say_table(outside.columns, outside.rows)


def _say_budget(rows: list[Any]) -> None:
    """The link budget as `isac_rt.frame.level.LinkBudget` rows."""
    heads = "link budget, reference, distance [m], received [dBm], noise [dBm], SNR [dB], gain [dB]"
    made = []
    for row in rows:
        link, reference, *values = astuple(row)
        made.append((link.replace("->", " to "), reference, *(f"{v:.1f}" for v in values)))
    say_table([*heads.split(", "), "processed [dB]"], made)


_PLAN_WORDS = (
    "Errors are estimated on a few frames. rad: phase of a path; dB: omitted power over the noise "
    "of a range-Doppler cell of one antenna; relative: share of the samples. Plane wavefront: "
    "curvature neglected; straight flight: acceleration within the frame neglected. Too weak: "
    "together with all others in its range cell; out of reach: beat frequency above the IF filter."
)
"""Explanation of the table of the plan."""


def _say_summary(results: Results) -> None:
    from isac_rt.views import tables

    summary = results.summary
    shown = (
        tables.data_table(summary),
        *(
            table(summary, group)
            for group in ("targets", "terminals")
            for table in (tables.hit_table, tables.bound_table, tables.rmse_table)
        ),
        tables.side_by_side(summary),
    )
    for table in shown:
        if table.rows:
            say_table(table.columns, table.rows)
            say("")
    for name, block in summary["links"].items():
        _say_causes(
            f"{tables.link_words(name)}: of {block['in_view']} target-frames in view",
            block["losses"],
        )
        _say_causes(
            f"{tables.link_words(name)}: of {tables.number(block['false_tracks_per_frame'])} false "
            "tracks per frame",
            block["false_tracks"],
        )
        if moving := block["object_tracks_per_frame"]:
            say(f"{tables.link_words(name)}: {tables.number(moving)} tracks per frame of objects")
    out().print(tables.legend(*shown))
    outcomes = ", ".join(
        f"{n:,} {kind.replace('_', ' ')}" for kind, n in summary["paths"].items() if n
    )
    seconds = summary["timing_s"]
    spent = f"{tables.number(seconds['total'])} s of processor time"
    say(f"paths: {outcomes}; {spent}, {tables.number(seconds['wall']['total'])} s elapsed")


def _say_causes(whole: str, parts: Mapping[str, float]) -> None:
    """Print the parts of a whole that are not zero, by cause."""
    from isac_rt.views.tables import number

    if counted := [f"{number(n)} {cause.replace('_', ' ')}" for cause, n in parts.items() if n]:
        say(f"{whole}: {', '.join(counted)}")


def plan(
    scenario: ScenarioFile,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    overrides: Overrides = None,
) -> None:
    """Show coverage, link budgets, modelled and omitted effects and their estimated errors. Traces
    a few frames only."""
    from isac_rt.scenario.file import load

    loaded = load(scenario, overrides or ())
    with ending_soon_after_interrupt(Path()), working("tracing a few frames"):
        from isac_rt.simulation.audit import make_plan
        from isac_rt.simulation.setup import link_budgets, prepare

        setup = prepare(loaded)
        planned, budget = make_plan(setup), link_budgets(setup)
    if as_json:
        beside = {"city": setup.city.record(), "link_budget": [asdict(row) for row in budget]}
        typer.echo(json.dumps(planned | beside, indent=1))
    else:
        _say_city(setup.city.notes)
        _say_coverage(planned["coverage"])
        _say_budget(budget)
        _say_plan(planned)


def _say_plan(planned: dict[str, Any]) -> None:
    """The plan of `isac_rt.simulation.audit.make_plan`."""

    def error(item: dict[str, Any]) -> str:
        value = item["estimate"]
        return "" if value is None else f"{value:.2g} {item['unit']}" if value else "none"

    rows = [
        (
            item["what"],
            item["link"].replace("->", " to "),
            item["modelled"],
            item["left_out"],
            error(item),
        )
        for item in planned["items"]
    ]
    say_table(("", "link", "modelled", "left out", "error"), rows, numbers=False)
    out().print(_PLAN_WORDS)
    settled = {
        "phase error at most [rad]": planned["max_phase_error_rad"],
        "weakest [dB under the noise of a cell]": planned["weakest_path_db"],
        "reach [m]": planned["reach_m"],
    }
    message = ", ".join(f"{name}: {value}" for name, value in settled.items() if value is not None)
    say(f"preset {planned['preset']}; {message}")


def paths(
    scenario: ScenarioFile,
    frame: FrameNumber,
    out: Annotated[Path, typer.Option(metavar="FILE.nc", help="NetCDF file to write.")],
    overrides: Overrides = None,
) -> None:
    """Write the propagation paths of one frame, all links, as NetCDF."""
    from isac_rt.scenario.file import load

    loaded = load(scenario, overrides or ())
    check_frame(loaded, frame)
    with ending_soon_after_interrupt(out.parent), working("tracing"):
        from isac_rt.results.provenance import provenance
        from isac_rt.simulation.setup import trace
        from isac_rt.views.interchange import write_ledger

        found = trace(loaded, frame)
        carriers = {n: (u.radio or loaded.radio).carrier_hz for n, u in loaded.swarm.items()}
        write_ledger(found, out, carriers, provenance(loaded))
    kinds = next(iter(found.values())).counts() if found else ()
    say_table(
        ["link", *(kind.replace("_", " ") for kind in kinds)],
        [(f"{tx} to {rx}", *map(str, p.counts().values())) for (tx, rx), p in found.items()],
    )


def view(
    scenario: ScenarioFile,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A .png picture, or an .html page with a 3-D scene.",
            show_default="SCENARIO.html",
        ),
    ] = None,
    frame: FrameNumber = 0,
    overrides: Overrides = None,
) -> None:
    """Render the city, the swarm and the paths of a frame."""
    out = out or Path(f"{scenario.stem}.html")
    if out.suffix not in (".png", ".html"):
        raise InputProblem(f"--out {out}: a view is a .png picture or an .html page; name it so")
    from isac_rt.scenario.file import load

    loaded = load(scenario, overrides or ())
    check_frame(loaded, frame)
    with ending_soon_after_interrupt(out.parent), working("tracing and drawing"):
        import numpy as np

        from isac_rt.simulation.setup import prepare, trace
        from isac_rt.views.render import view_scene, write_view

        setup = prepare(loaded)
        found = trace(loaded, frame, setup=setup)
        times = np.linspace(setup.timetable.epoch(0), setup.timetable.epoch(loaded.frames - 1), 60)
        scene = setup.city, setup.swarm, times, setup.timetable.epoch(frame), found
        if out.suffix == ".html":
            from isac_rt.views.scene import scene_3d, write_page

            write_page(scene_3d(*scene), out)
        else:
            write_view(view_scene(*scene), out)
    say(out)


def animate(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of a run with --snapshots 20 or more.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A .gif or an .mp4.", show_default="DIR/run.gif"),
    ] = None,
    observer: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Link whose map is shown.", show_default="the first"),
    ] = None,
    rate: Annotated[float, typer.Option(min=0.1, max=60, help="Frames per second.")] = 5.0,
) -> None:
    """Animate a run: the swarm with tracks beside a range-Doppler map."""
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
    number = names.index(observer) if observer else 0
    with ending_soon_after_interrupt(folder), working("drawing"):
        write_animation(results, target, number, city_of(results.scenario), rate)
    say(target)


def figures(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run.")],
    form: Annotated[str, typer.Option("--as", metavar="FORM", help="png, svg or pdf.")] = "pdf",
    style: Annotated[
        str,
        typer.Option(help="screen; wide: 7.16 inch, two columns of a journal; column: 3.5 inch."),
    ] = "wide",
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder of the figures.", show_default="DIR/figures_STYLE"
        ),
    ] = None,
) -> None:
    """Draw the figures of a run for a paper. PDF, SVG or PNG, with maps of every snapshot."""
    from isac_rt.results.files import open_results

    results = open_results(folder)
    target = out if out is not None else folder / f"figures_{style}"
    with ending_soon_after_interrupt(target), working("drawing"):
        from isac_rt.simulation.setup import city_of
        from isac_rt.views.figures import FORMS, STYLES, redraw

        check_names([form], FORMS, "form")
        check_names([style], list(STYLES), "style")
        files = redraw(results, target, city_of(results.scenario), form, style)
    for file in files:
        say(file)


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run.")],
    form: Annotated[
        str,
        typer.Option(
            "--as",
            metavar="FORMAT",
            help="csv: tables; mat: MATLAB; pcd, rosbag (ROS 2): point clouds; glb: 3-D scene; "
            "stonesoup: detections. IF samples of all frames and links: npy, mat_samples, sigmf, "
            "or bin (raw data of a DCA1000).",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the files.", show_default="DIR/export"),
    ] = None,
    frame: Annotated[
        int | None, typer.Option(min=0, help="Frame, of IF samples.", show_default="all")
    ] = None,
    link: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Link, of IF samples.", show_default="all"),
    ] = None,
) -> None:
    """Write a run for other programs. IF samples are simulated anew."""
    from isac_rt.results.files import open_results
    from isac_rt.views import export as exports
    from isac_rt.views.samples import SAMPLE_FORMATS

    check_names([form], [*exports.FORMATS, *SAMPLE_FORMATS], "format")
    if form not in SAMPLE_FORMATS and (frame is not None or link is not None):
        raise InputProblem(
            f"--frame and --link are of IF samples, --as {', '.join(SAMPLE_FORMATS)}; leave them "
            "out"
        )

    results = open_results(folder)
    target = out if out is not None else folder / "export"
    with ending_soon_after_interrupt(target):
        from isac_rt.simulation.setup import city_of

        if form in SAMPLE_FORMATS:
            files = _samples(results, form, target, frame, link)
        else:
            with working("exporting"):
                files = exports.write(results, form, target, lambda: city_of(results.scenario))
    for file in files:
        say(file)


def _samples(
    results: Results, form: str, folder: Path, frame: int | None, observer: str | None
) -> list[Path]:
    """Write the IF samples of some frames and links, simulated anew."""
    from isac_rt.frame.link import Link
    from isac_rt.simulation.setup import prepare
    from isac_rt.views.samples import write_samples

    d = results.dataset
    names = [str(name) for name in d.observer.values]
    if observer is not None:
        check_names([observer], names, "link")
    if frame is not None:
        check_frame(results.scenario, frame)
    frames = range(d.sizes["frame"]) if frame is None else [frame]
    wanted = [k for k, name in enumerate(names) if observer in (None, name)]
    fell_back = [f for f in frames if d.fell_back.values[f, wanted].any()]
    if fell_back:
        raise InputProblem(
            f"--frame {fell_back[0]}: its transmitter fell back to the conventional "
            "schedule, which only the run itself knows; choose another frame"
        )
    setup = prepare(results.scenario)
    links = [Link(str(d.transmitter.values[k]), str(d.receiver.values[k])) for k in wanted]

    def write(report: Report) -> list[Path]:
        return write_samples(setup, frames, links, form, folder, report)

    return list(with_progress(write, "frames", len(frames)))
