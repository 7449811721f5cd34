"""Commands that judge the program and the paper: `reproduce`, `validate`, `bench`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from isac_rt.cli.arguments import InputProblem, Quick, check_names
from isac_rt.cli.console import say, say_table, with_progress
from isac_rt.cli.interruption import ending_soon_after_interrupt


def reproduce(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Tables, figures and claims; none: list them."),
    ] = None,
    quick: Quick = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where the files go; default runs/reproduction/NAME."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all randomness.")] = 20260,
    seeds: Annotated[
        int | None, typer.Option(min=1, max=1000, help="Flights of each place, for city.")
    ] = None,
) -> None:
    """Run the paper's tables, figures and claims again and judge them."""
    from isac_rt.studies.paper import TITLES
    from isac_rt.studies.paper import names as experiments

    if not names:
        rows = [(name, TITLES[name]) for name in experiments()]
        say_table(("name", "what it shows"), rows, numbers=False)
        return
    check_names(names, experiments(), "table or figure")
    if seeds is not None and set(names) != {"city"}:
        raise InputProblem("--seeds goes with city alone; leave it out for other experiments")
    for name in dict.fromkeys(names):
        folder = out if out is not None else Path("runs") / "reproduction" / name
        with ending_soon_after_interrupt(folder):
            _reproduce(name, folder, quick, seed, seeds)


def _reproduce(name: str, folder: Path, quick: bool, seed: int, seeds: int | None) -> None:
    from isac_rt.results.files import check_folder

    check_folder(folder)
    from isac_rt.studies.paper import experiment
    from isac_rt.studies.paper.city_flights import repeated
    from isac_rt.studies.paper.montecarlo import kept_in
    from isac_rt.studies.paper.outcome import write

    with kept_in(folder / "frames"), repeated(seeds):
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
    from isac_rt.studies.validation import run_case
    from isac_rt.studies.validation.table import STATES, shown

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
        typer.Argument(metavar="STAGE", help="From synthesis to hermespy; all by default."),
    ] = None,
    quick: Quick = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where tables and figures go.")] = Path(
        "runs/bench"
    ),
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the rows to a file too.")
    ] = None,
    fit: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Only fit accuracy.cost_model to this machine."),
    ] = None,
) -> None:
    """Speed against error, method by method. Cost is in floors: one floor is the processor time to
    fill one cube of samples and transform it once, measured in the same run."""
    if fit is not None:
        return _fit(fit)
    from isac_rt.results.files import check_folder
    from isac_rt.storage import write_whole
    from isac_rt.studies.bench import command, report

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


def _fit(file: Path) -> None:
    """Measure what the methods of synthesis cost here, for accuracy.cost_model of a scenario."""
    from isac_rt.results.files import check_folder
    from isac_rt.storage import write_whole
    from isac_rt.studies.bench.fit import fit

    check_folder(file.parent)
    found = with_progress(lambda moved: fit(progress=moved), "repeats")
    write_whole(file, json.dumps(found, indent=1) + "\n")
    rows = [
        (
            name,
            f"{row['chirp_ns'] / 1000:.3g}",
            f"{row['path_ns']:.3g}",
            f"{100 * row['deviation']:.2g}",
        )
        for name, row in found["methods"].items()
    ]
    say_table(("method", "chirp [us]", "path [ns]", "deviation [%]"), rows)
    say(f"{file}: name it in accuracy.cost_model of a scenario")
