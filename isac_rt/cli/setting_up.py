"""Commands before the first run: `doctor`, `schema`, `new`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from isac_rt.cli.arguments import InputProblem
from isac_rt.cli.console import say, say_table, working


def doctor() -> None:
    """Print back end, LLVM, memory and threads, and what to install."""
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
    """Print the JSON Schema of the scenario, for editors."""
    from isac_rt.cli.starter import schema_text

    typer.echo(schema_text(), nl=False)


def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="The scenario to write.")],
    footprints: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Buildings: GeoJSON, CityJSON, GeoPackage, Shapefile, OpenStreetMap.",
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(metavar="EPSG:N", help="Coordinate system of a file that states none."),
    ] = None,
    terrain: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Heights of the ground, a GeoTIFF.")
    ] = None,
) -> None:
    """Write a commented scenario to start from, in a street canyon or among your own buildings.
    Adds the schema for editors and, among buildings, a picture."""
    if footprints is None and (crs or terrain):
        raise InputProblem("--crs and --terrain are of --footprints; give it too")
    with working("writing the scenario"):
        from isac_rt.cli.starter import OwnCity, write_picture, write_starter

        own = None if footprints is None else OwnCity(footprints, crs, terrain)
        files, notes = write_starter(file, own), tuple[str, ...]()
    if own is not None:
        with working("drawing the scene"):
            picture, notes = write_picture(file)
            files.append(picture)
    say(*files, *notes)
