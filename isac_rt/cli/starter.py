"""A commented scenario to start from: `isac-rt new FILE`."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np
import yaml

from isac_rt.cli.siting import Formation, Site, site_of
from isac_rt.results.files import ResultsError
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.tree import json_schema
from isac_rt.storage import write_whole
from isac_rt.world.city import CityMesh, load_city
from isac_rt.world.city.place import Place, local_origin, plane_about
from isac_rt.world.settings import City

SCHEMA = "scenario.schema.json"
_CANYON = """\
  source: canyon                  # others: builtin, mitsuba, mesh, footprints, blocks
  street_width_m: 24
  building_height_m: 18
  street_length_m: 120"""
_PLACES = ((-4.3, -30.1), (3.1, 14.7), (4.9, -9.3), (-3.7, 1.9))
_SPEEDS = (4.0, 2.0)
_DURATION_S = 2.0
"""Places of AT and PT1, first and last place of U1, about the site; speeds of AT and PT1 ahead."""
DRAWN_M = 400.0
"""So much of a city is drawn about the swarm."""
FAR_M = 10e3
"""Coordinates of a file that are larger are moved to an origin."""


@dataclass(frozen=True)
class OwnCity:
    """Buildings of one's own.

    Parameters
    ----------
    footprints : path
    crs : str, optional
        Coordinate reference system, where the file does not say it.
    terrain : path, optional
        GeoTIFF of heights.
    """

    footprints: Path
    crs: str | None = None
    terrain: Path | None = None


def schema_text() -> str:
    """JSON Schema of a scenario, for editors."""
    return json.dumps(json_schema(), indent=1) + "\n"


def _formation() -> Formation:
    """The flights of `_PLACES` about a site."""
    starts = np.array([[x, y, 0.0] for x, y in _PLACES[:3]])
    ends = np.array([starts[0], starts[1], [*_PLACES[3], 0.0]])
    ends[:2, 1] += np.array(_SPEEDS) * _DURATION_S
    return Formation(starts, ends)


def starter_text(name: str, city: str = _CANYON, site: Site | None = None) -> str:
    """The scenario as YAML.

    Parameters
    ----------
    name : of the scenario; what a name may not hold becomes _
    city : keys of its city
    site : where the swarm flies; by default in the street canyon
    """
    site = Site(np.array([0.0, 0.0, 12.0]), 0.0) if site is None else site
    text = resources.files("isac_rt.cli").joinpath("starter.yaml").read_text(encoding="utf-8")
    values = {"NAME": re.sub(r"[^A-Za-z0-9_-]", "_", name)[:100], "CITY": city}
    places = site.place(np.array([[x, y, 0.0] for x, y in _PLACES]))
    values |= {f"P{i}": ", ".join(f"{v:.1f}" for v in place) for i, place in enumerate(places)}
    for i, (speed, ahead) in enumerate(zip(_SPEEDS, (1.0, -1.0), strict=True)):
        vectors = site.turn(np.array([[0.0, speed, 0.0], [0.0, ahead, 0.0]]))
        for key, vector in zip("VB", vectors, strict=True):
            values[f"{key}{i}"] = ", ".join(f"{round(v, 3) + 0.0:g}" for v in vector)
    for key, value in values.items():
        text = text.replace(f"@{key}@", value)
    return text


def write_starter(file: str | Path, own: OwnCity | None = None) -> list[Path]:
    """Write the scenario, and beside it the schema that it names. No scenario that is there is
    replaced, and no picture where `write_picture` will draw one.

    Returns
    -------
    the files

    Raises
    ------
    ResultsError  If the scenario or the picture is there already.
    isac_rt.storage.StorageError  If it cannot be written.
    isac_rt.world.city.CityError  If the footprints are not what they should be.
    """
    file = Path(file)
    for made in (file, *([] if own is None else [file.with_suffix(".png")])):
        if made.exists():
            raise ResultsError(f"{made} is there already; choose another name or remove it")
    write_whole(file, starter_text(file.stem) if own is None else _over(own, file))
    write_whole(file.with_name(SCHEMA), schema_text())
    return [file, file.with_name(SCHEMA)]


def write_picture(file: Path) -> tuple[Path, tuple[str, ...]]:
    """Draw the city and the swarm of a scenario beside it.

    Returns
    -------
    the picture, and what was assumed of the city, in words
    """
    from isac_rt.scenario.file import load
    from isac_rt.simulation.setup import city_of, swarm_of
    from isac_rt.views.render import view_scene, write_view

    scenario = load(file)
    city, swarm = city_of(scenario, DRAWN_M), swarm_of(scenario)
    times = np.linspace(0.0, _DURATION_S, 30)
    picture = file.with_suffix(".png")
    write_view(view_scene(city, swarm, times, 0.0, {}), picture)
    return picture, city.notes


def _over(own: OwnCity, file: Path) -> str:
    """The scenario over buildings of one's own."""
    for option, path in (("footprints", own.footprints), ("terrain", own.terrain)):
        if path is not None and not path.is_file():
            raise ResultsError(f"--{option} {path}: there is no such file; give one")
    keys = {"file": os.path.relpath(own.footprints, file.parent)}
    if own.crs is not None:
        keys["crs"] = own.crs
    if own.terrain is not None:
        keys["terrain"] = os.path.relpath(own.terrain, file.parent)
    node = City.model_validate({"source": "footprints", **keys})
    city = load_city(node, file.parent, Radio().carrier_hz, (0.0, 0.0, 0.0))
    site = site_of(city, _formation())
    lines = ["  source: footprints", *(f"  {key}: {_quoted(v)}" for key, v in keys.items())]
    if city.place is not None and _is_far(city, city.place):
        place, site = _local(city.place, site, city)
        x, y, z = place.origin
        lines.append(f"  origin: [{x!r}, {y!r}, {z:g}]  # of the world, in coordinates of the file")
    lines += ["  height_property: height         # of each building in the file [m]"]
    lines += ["  default_height_m: 10            # where neither it nor storeys are known"]
    return starter_text(file.stem, "\n".join(lines), site)


def _quoted(text: str) -> str:
    """A word of YAML, whatever a path has in it."""
    return str(yaml.safe_dump(text, default_style='"', allow_unicode=True, width=10**9)).strip()


def _is_far(city: CityMesh, place: Place) -> bool:
    """Return whether world coordinates are those of a plane about the middle, or far from their
    origin."""
    return bool(place.plane) or float(np.abs(city.bounds() + city.origin).max()) > FAR_M


def _local(place: Place, site: Site, city: CityMesh) -> tuple[Place, Site]:
    """The place with its origin near a site, on the ground, and the site there."""
    below = city.corners[..., 2] + city.origin[2]
    near = np.linalg.norm((city.corners + city.origin - site.middle)[..., :2], axis=-1) < FAR_M / 10
    level = float(np.quantile(below[near], 0.05)) if near.any() else 0.0
    origin = local_origin(place, np.append(site.middle[:2], level))
    plane = plane_about(origin[0], origin[1]) if place.plane and place.is_lonlat else place.plane
    if place.plane and not place.is_lonlat:
        origin = (place.origin[0], place.origin[1], origin[2])
    there = replace(place, origin=origin, plane=plane)
    middle = there.to_world(place.to_file(site.middle[None]))[0]
    return there, replace(site, middle=middle)
