"""Commands before the first run: `doctor`, `schema`, `new`."""

from __future__ import annotations

from enum import StrEnum
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


class Shape(StrEnum):
    """Formations of the targets of a new scenario."""

    line = "line"
    column = "column"
    cross = "cross"


def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="The scenario to write.")],
    city: Annotated[
        str | None,
        typer.Option(
            "--city",
            "--footprints",
            metavar="FILE|NAME",
            help="Buildings (GeoJSON, CityJSON, GeoPackage, Shapefile, OpenStreetMap), a mesh, "
            "Mitsuba's XML, blocks for a generated grid, or a scene of Sionna RT such as munich.",
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(metavar="EPSG:N", help="Coordinate system of a map that states none."),
    ] = None,
    terrain: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Heights of the ground, a GeoTIFF.")
    ] = None,
    formation: Annotated[
        Shape | None,
        typer.Option(help="Targets abreast, in one column, or in two crossing columns."),
    ] = None,
    uavs: Annotated[
        int | None, typer.Option(min=1, max=40, help="Targets of the formation.", show_default="10")
    ] = None,
    sensor: Annotated[
        str | None, typer.Option(metavar="NAME", help="Plain FMCW sensor, such as awr1843.")
    ] = None,
) -> None:
    """Write a commented scenario to start from, in a street canyon or over your own city. Adds the
    schema for editors and, over a city, a picture."""
    if city is None and (crs or terrain):
        raise InputProblem("--crs and --terrain are of --city; give it too")
    if formation is None and uavs is not None:
        raise InputProblem("--uavs is of --formation line, column or cross; give it too")
    with working("writing the scenario"):
        from isac_rt.cli.starter import Wanted, write_picture, write_starter
        from isac_rt.scenario.sensors import SENSORS

        if sensor is not None and sensor.lower() not in SENSORS:
            raise InputProblem(f"--sensor {sensor}: there are {', '.join(SENSORS)}")
        shape = formation.value if formation else None
        wanted = Wanted(city, crs, terrain, shape, uavs or 10, sensor and sensor.lower())
        files, notes = write_starter(file, wanted), tuple[str, ...]()
    if city is not None:
        with working("drawing the scene"):
            image, notes = write_picture(file)
            files.append(image)
    say(*files, *notes)
