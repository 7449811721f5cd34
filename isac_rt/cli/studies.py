"""Commands that judge the program and the paper: `reproduce`, `validate`, `bench`. What they run
stands outside the package, in a checkout: `reproduce/`, `tests/truths/` and `benchmarks/`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

import isac_rt
from isac_rt.cli.arguments import InputProblem, Quick, check_names
from isac_rt.cli.console import say, say_table, with_progress
from isac_rt.cli.interruption import ending_soon_after_interrupt
from isac_rt.runtime import UserError


def _from_checkout(folder: str) -> None:
    """Let Python find the packages in a folder of the checkout that this package runs from.

    Raises
    ------
    UserError  If the package was installed from a wheel.
    """
    root = Path(isac_rt.__file__).resolve().parents[1]
    if not all((root / name).exists() for name in ("pyproject.toml", "reproduce", folder)):
        raise UserError(
            "reproduce, validate and bench run in a checkout of isac_rt, and this is an installed "
            f"package; unpack the source distribution of version {isac_rt.__version__} and run "
            "make setup there"
        )
    sys.path[:0] = [str(root / folder), str(root)] if folder == "tests" else [str(root)]


def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Tables, figures and claims; without any: list them."),
    ] = None,
    quick: Quick = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder of the files.", show_default="runs/reproduction/NAME"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 20260,
    seeds: Annotated[
        int | None, typer.Option(min=1, max=1000, help="Flights at each place, for city, flights.")
    ] = None,
    scenes: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Scenes, for flights; by default drawn.")
    ] = None,
) -> None:
    """Reproduce tables, figures and claims of the paper, with verdicts."""
    _from_checkout("reproduce")
    from reproduce import TITLES
    from reproduce import names as experiments

    if not names:
        rows = [(name, TITLES[name]) for name in experiments()]
        say_table(("name", "what it shows"), rows, numbers=False)
        return
    check_names(names, experiments(), "table or figure")
    for option, value, fits in (("seeds", seeds, "city flights"), ("scenes", scenes, "flights")):
        if value is not None and not set(names) <= set(fits.split()):
            raise InputProblem(f"--{option} is only for {fits}; leave it out for other experiments")
    for name in dict.fromkeys(names):
        folder = out if out is not None else Path("runs") / "reproduction" / name
        with ending_soon_after_interrupt(folder):
            _reproduce(name, folder, quick, seed, seeds, scenes)


def _reproduce(name: str, folder: Path, quick: bool, seed: int, *asked: Any) -> None:
    from isac_rt.results.files import check_folder

    check_folder(folder)
    from reproduce import experiment
    from reproduce.city_flights import repeated
    from reproduce.montecarlo import kept_in
    from reproduce.outcome import write

    with kept_in(folder / "frames"), repeated(*asked):
        outcome = with_progress(lambda report: experiment(name)(quick, seed, report), name)
    files = write(outcome, folder)
    colours = {"holds": "green", "holds under a condition": "yellow", "does not hold": "red"}
    rows = [(v.claim, Text(v.verdict, colours[v.verdict]), v.finding) for v in outcome.verdicts]
    say_table((name, "verdict", "finding"), rows, numbers=False)
    say(f"in {folder}: {', '.join(file.name for file in files)}")


def validate(
    quick: Quick = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write validation.json and validation.md there."),
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the table as JSON.")
    ] = None,
    only: Annotated[
        str, typer.Option(metavar="WORDS", help="Only cases with these words in group or name.")
    ] = "",
) -> None:
    """Check every physical and numerical claim against an independent truth."""
    _from_checkout("tests")
    from truths import all_cases
    from truths.table import write_json, write_markdown

    from isac_rt.results.files import check_folder

    cases = [
        case for case in all_cases(quick) if only.lower() in f"{case.group} {case.name}".lower()
    ]
    if not cases:
        raise InputProblem(
            f"--only {only}: no case has these words in its group or name; leave it out to see "
            "them all"
        )
    if out is not None:
        check_folder(out)
    if json_file is not None:
        check_folder(json_file.parent)
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
    from truths import run_case
    from truths.table import STATES, shown

    verdicts: list[Any] = []

    def work(report: Any) -> None:
        for number, case in enumerate(cases, start=1):
            verdicts.append(run_case(case))
            report(number, len(cases))

    with_progress(work, "cases", len(cases))
    colours = {True: "green", False: "red", None: "yellow"}
    rows = [
        (
            v.case.name,
            v.case.group,
            shown(v.error),
            shown(v.case.bound),
            v.case.unit,
            Text(STATES[v.passed], colours[v.passed]),
            f"{v.seconds:.1f}",
        )
        for v in verdicts
    ]
    say_table(("case", "group", "error", "bound", "unit", "", "s"), rows)
    say(*(f"{v.case.name}: {v.note}" for v in verdicts if v.note and v.passed is not True))
    counts = {word: sum(v.passed is state for v in verdicts) for state, word in STATES.items()}
    say(f"{counts['passes']} cases pass, {counts['FAILS']} fail, {counts['left out']} left out")
    return verdicts


def bench(
    stages: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="STAGE",
            help="synthesis, moving, receive, trace, clutter, end-to-end, dataset, hermespy.",
        ),
    ] = None,
    quick: Quick = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of tables and figures.")] = Path(
        "runs/bench"
    ),
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the rows to a file too.")
    ] = None,
) -> None:
    """Measure speed against error of each method. Cost is in floors: one floor is the processor
    time to fill one cube of samples and transform it once, measured in the same run."""
    _from_checkout("benchmarks")
    from benchmarks import command, report
    from isac_rt.results.files import check_folder
    from isac_rt.storage import write_whole

    chosen = list(dict.fromkeys(stages or report.stages()))
    check_names(chosen, report.stages(), "stage")
    check_folder(out)
    with ending_soon_after_interrupt(out):
        found = with_progress(
            lambda moved: report.measure(chosen, quick, moved), "stages", len(chosen)
        )
        files = report.write(found, out)
        if json_file is not None:
            write_whole(json_file, json.dumps(found, indent=1) + "\n")
    rows = [
        (
            f"{row['kind']}: {row['method']}",
            f"{row['size']:,} {row.get('unit', '')}",
            f"{row['cost']:.3g}",
            "" if row["error"] is None else f"{row['error']:.2g}",
        )
        for row in found["rows"]
    ]
    say_table(("method", "size", "cost [floors]", "error"), rows)
    say(*(f"{row['method']}: {row['also']}" for row in found["rows"] if row["kind"] == "datasets"))
    say("one floor: to fill one cube of samples and transform it once, measured in this run")
    if found["commands"]:
        lines = [line.strip("| ").split(" | ") for line in command.markdown(found["commands"])]
        say_table(lines[0], lines[2:])
    say(*(f"{name} left out: {reason}" for name, reason in found["left_out"].items()))
    say(f"in {out}: {', '.join(file.name for file in files)}")
