"""A commented scenario to start from: `isac-rt new FILE`."""

from __future__ import annotations

import json
import os
import re
from importlib import resources
from pathlib import Path

from isac_rt.results.files import ResultsError
from isac_rt.scenario.environment import City
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.tree import json_schema
from isac_rt.storage import write_whole
from isac_rt.world.city import load_city

SCHEMA = "scenario.schema.json"
_CANYON = """\
  source: canyon                  # others: builtin, mitsuba, mesh, footprints, blocks
  street_width_m: 24
  building_height_m: 18
  street_length_m: 120"""
_BUILDINGS = """\
  source: footprints
  file: {file}
  height_property: height         # of each building in the file [m]
  default_height_m: 10            # where there is none"""
_PLACES = ((-4.3, -30.1), (3.1, 14.7), (4.9, -9.3), (-3.7, 1.9))


def schema_text() -> str:
    """JSON Schema of a scenario, for editors."""
    return json.dumps(json_schema(), indent=1) + "\n"


def starter_text(
    name: str,
    footprints: str | None = None,
    centre: tuple[float, float] = (0.0, 0.0),
    height: float = 12.0,
) -> str:
    """The scenario as YAML.

    Parameters
    ----------
    name : of the scenario; what a name may not hold becomes _
    footprints : a GeoJSON or CityJSON file of buildings, relative to the scenario's folder; None
        for a street canyon
    centre : where the swarm flies, in the city's coordinates [m]
    height : of the swarm [m]
    """
    text = resources.files("isac_rt.cli").joinpath("starter.yaml").read_text(encoding="utf-8")
    city = _CANYON if footprints is None else _BUILDINGS.format(file=json.dumps(footprints))
    values = {"NAME": re.sub(r"[^A-Za-z0-9_-]", "_", name)[:100], "CITY": city, "Z": f"{height:g}"}
    for i, (x, y) in enumerate(_PLACES):
        values |= {f"X{i}": f"{centre[0] + x:.1f}", f"Y{i}": f"{centre[1] + y:.1f}"}
    for key, value in values.items():
        text = text.replace(f"@{key}@", value)
    return text


def write_starter(
    file: str | Path, footprints: str | Path | None = None
) -> tuple[list[Path], tuple[str, ...]]:
    """Write the scenario, and beside it the schema that it names; neither replaces a scenario that
    is there.

    Returns
    -------
    the files, and what was assumed of the buildings, in words

    Raises
    ------
    ResultsError  If the scenario is there already.
    isac_rt.storage.StorageError  If it cannot be written.
    isac_rt.world.city.CityError  If the footprints are not what they should be.
    """
    file = Path(file)
    if file.exists():
        raise ResultsError(f"{file} is there already; choose another name or remove it")
    notes: tuple[str, ...] = ()
    if footprints is None:
        text = starter_text(file.stem)
    elif not Path(footprints).is_file():
        raise ResultsError(
            f"--footprints {footprints}: there is no such file; give a GeoJSON or CityJSON file"
        )
    else:
        named = os.path.relpath(footprints, file.parent)
        centre, height, notes = _above(named, file.parent)
        text = starter_text(file.stem, named, centre, height)
    write_whole(file, text)
    write_whole(file.with_name(SCHEMA), schema_text())
    return [file, file.with_name(SCHEMA)], notes


def _above(footprints: str, folder: Path) -> tuple[tuple[float, float], float, tuple[str, ...]]:
    """The middle of the buildings, a height ten metres over the highest, in the city's coordinates
    [m], and what was assumed of them."""
    city = load_city(
        City(source="footprints", file=footprints, ground_margin_m=0.0),
        folder,
        Radio().carrier_hz,
        (0.0, 0.0, 0.0),
    )
    corners = city.corners + city.origin
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    return (
        (float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2),
        float(high[2]) + 10.0,
        city.notes,
    )
