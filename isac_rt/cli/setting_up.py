"""Commands before the first run: `doctor`, `schema`, `new`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from isac_rt.cli.console import say, say_table, working


def doctor() -> None:
    """Back end, LLVM, memory, threads, and what to install."""
    with working("looking at the machine"):
        from isac_rt import runtime

        checks = runtime.doctor()
    rows = [
        (
            Text.assemble(("ok", "green") if check.ok else ("no", "red"), f" {check.name}"),
            check.found,
            "" if check.ok else check.remedy,
        )
        for check in checks
    ]
    say_table(("", "found", "to do"), rows, numbers=False)
    if not all(check.ok for check in checks):
        raise typer.Exit(2)


def schema() -> None:
    """JSON Schema of the scenario, for editors."""
    from isac_rt.cli.starter import schema_text

    typer.echo(schema_text(), nl=False)


def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="The scenario to write.")],
    footprints: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Buildings, as GeoJSON or CityJSON.")
    ] = None,
) -> None:
    """Write a commented scenario to start from, over a street canyon or over your own buildings,
    and the schema for editors."""
    with working("writing the scenario"):
        from isac_rt.cli.starter import write_starter

        files, notes = write_starter(file, footprints)
    say(*files, *notes)
