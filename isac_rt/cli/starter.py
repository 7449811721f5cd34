"""A commented scenario to start from: `isac-rt new FILE`."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
import yaml

from isac_rt.cli.siting import Formation, Site, site_of
from isac_rt.results.files import ResultsError
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import unfolded
from isac_rt.scenario.tree import json_schema
from isac_rt.storage import write_whole
from isac_rt.world.city import CityMesh, load_city
from isac_rt.world.city.georeference import GeoReference, local_origin, plane_about
from isac_rt.world.city.meshfiles import MESHES, point_in_file
from isac_rt.world.city.mitsuba_xml import builtin_path
from isac_rt.world.settings import City

SCHEMA = "scenario.schema.json"
_CANYON = """\
  source: canyon                  # others: blocks, builtin, mitsuba, mesh, footprints
  street_width_m: 24
  building_height_m: 18
  street_length_m: 120"""
_DURATION_S, _TARGET_SPEED, _SPACING_M = 2.0, 4.0, 4.0
"""Flights are looked at for so long; speed [m/s] and spacing [m] of targets in formation."""
DRAWN_M = 400.0
"""So much of a city is drawn about the swarm."""
FAR_M = 10e3
"""Coordinates of a file that are larger are moved to an origin."""


@dataclass(frozen=True)
class Wanted:
    """Choices for a new scenario.

    Parameters
    ----------
    city : str, optional
        File of buildings, of a mesh or of Mitsuba, or the name of a scene of Sionna RT; None: a
        street canyon. `blocks` is a grid of blocks.
    crs, terrain : optional
        Coordinate reference system of a map that does not say it, GeoTIFF of heights.
    formation : str, optional
        `line`, `column` or `cross` of `uavs` targets; None: one target on a curve.
    sensor : str, optional
        Plain FMCW sensor in place of terminals with data.
    """

    city: str | None = None
    crs: str | None = None
    terrain: Path | None = None
    formation: str | None = None
    uavs: int = 10
    sensor: str | None = None


def schema_text() -> str:
    """JSON Schema of a scenario, for editors."""
    return json.dumps(json_schema(), indent=1) + "\n"


def _swarm(wanted: Wanted) -> dict[str, dict[str, Any]]:
    """Return the swarm about the origin, heading to +y: two terminals that look at each other, and
    targets between them."""
    half, targets = _targets(wanted)
    far, near = (-30.1, 14.7) if wanted.formation is None else (-half - 20.3, half + 15.3)
    terminals = {
        "AT": ("active", [-4.3, far, 0.0], [0.0, 4.0, 0.0], [0, 1, 0]),
        "PT1": ("passive", [3.1, near, 0.0], [0.0, 2.0, 0.0], [0, -1, 0]),
    }
    if wanted.sensor:
        del terminals["PT1"]
    keys = "role", "position_m", "velocity_mps", "boresight"
    return {name: dict(zip(keys, uav, strict=True)) for name, uav in terminals.items()} | targets


def _targets(wanted: Wanted) -> tuple[float, dict[str, dict[str, Any]]]:
    """Return half the length of the targets' formation [m], and the targets."""
    if wanted.formation is None:
        curve = [(0, [4.9, -9.3, 0.0]), (2, [-3.7, 1.9, 0.0])]
        waypoints = [{"time_s": time, "position_m": geo} for time, geo in curve]
        return 0.0, {"U1": {"role": "target", "waypoints": waypoints}}
    crossing = wanted.uavs // 2 if wanted.formation == "cross" else 0
    begun = -_TARGET_SPEED * _DURATION_S / 2
    half = _SPACING_M * (wanted.uavs - crossing - 1) / 2

    def group(count: int, geo: list[float], velocity: list[float]) -> dict[str, Any]:
        uav = {"role": "target", "position_m": geo, "velocity_mps": velocity}
        shape = "line" if wanted.formation == "line" else "column"
        size = {"shape": shape, "spacing_m": _SPACING_M, "count": count}
        return uav | ({"formation": size} if count > 1 else {})

    ahead = 0.0 if wanted.formation == "line" else half
    targets = {"U": group(wanted.uavs - crossing, [0.0, begun + ahead, 0.0], [0, _TARGET_SPEED, 0])}
    if crossing:  # between the others, and higher
        side = begun + _SPACING_M * crossing / 2
        targets["V"] = group(crossing, [side, 0.0, 2.0], [_TARGET_SPEED, 0, 0])
    return half, targets


def _flights(swarm: dict[str, dict[str, Any]]) -> Formation:
    """Return the straight lines of all UAVs."""
    starts, ends = [], []
    for uav in unfolded(swarm).values():
        first, *_, last = uav.get("waypoints") or [uav] * 2
        velocity = np.array(uav.get("velocity_mps", (0, 0, 0)), float)
        starts.append(first["position_m"])
        ends.append(last["position_m"] + velocity * _DURATION_S)
    return Formation(np.array(starts, float), np.array(ends, float))


def _swarm_text(swarm: dict[str, dict[str, Any]], site: Site) -> str:
    """Return the swarm at a site as YAML."""

    def at_site(key: str, value: Any) -> Any:
        if key == "position_m":
            return site.place(np.array([value], float))[0].round(1).tolist()
        if key in ("velocity_mps", "boresight"):
            return (site.rotate(np.array([value], float))[0].round(3) + 0.0).tolist()
        if key == "waypoints":
            return [{name: at_site(name, v) for name, v in one.items()} for one in value]
        return value

    tree = {name: {key: at_site(key, v) for key, v in uav.items()} for name, uav in swarm.items()}
    dumped = yaml.safe_dump(tree, default_flow_style=None, sort_keys=False, width=200)
    return indent(dumped, "  ").rstrip()


def starter_text(name: str, wanted: Wanted, city: str = _CANYON, site: Site | None = None) -> str:
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
    values |= {"SWARM": _swarm_text(_swarm(wanted), site), "SENSOR": f"{wanted.sensor}"}
    other = ("sensor",) if wanted.sensor is None else ("receiver_preset", "modulation", "noise")
    for key in other:  # with the lines that belong to it
        text = re.sub(rf"^{key}:.*\n(?:  .*\n)*\n?", "", text, flags=re.MULTILINE)
    for key, value in values.items():
        text = text.replace(f"@{key}@", value)
    return text


def write_starter(file: str | Path, wanted: Wanted = Wanted()) -> list[Path]:
    """Write the scenario, and beside it the schema that it names. No scenario that is there is
    replaced, and no picture where `write_picture` will draw one.

    Returns
    -------
    the files

    Raises
    ------
    ResultsError  If the scenario or the picture is there already.
    isac_rt.storage.StorageError  If it cannot be written.
    isac_rt.world.city.CityError  If the city is not what it should be.
    """
    file = Path(file)
    for made in (file, *([] if wanted.city is None else [file.with_suffix(".png")])):
        if made.exists():
            raise ResultsError(f"{made} is there already; choose another name or remove it")
    write_whole(file, _over(wanted, file))
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
    image = file.with_suffix(".png")
    write_view(view_scene(city, swarm, times, 0.0, {}), image)
    return image, city.notes


def _keys(wanted: Wanted, folder: Path) -> dict[str, str]:
    """Return the keys of a city that a file or a name stands for.

    Raises
    ------
    ResultsError, isac_rt.world.city.CityError  If there is no such file or scene.
    """
    path = Path(str(wanted.city))
    suffix = path.suffix.lower()
    named = not path.is_file() and not suffix and path.name == wanted.city
    for option, one in (("city", None if named else path), ("terrain", wanted.terrain)):
        if one is not None and not one.is_file():
            raise ResultsError(f"--{option} {one}: there is no such file; give one")
    source = "mitsuba" if suffix == ".xml" else "mesh" if suffix in MESHES else "footprints"
    if (named or source != "footprints") and (wanted.crs or wanted.terrain):
        raise ResultsError(f"--crs and --terrain are of maps, not of {path.name}; leave them out")
    if named and path.name == "blocks":
        return {"source": "blocks"}
    if named:
        builtin_path(path.name)  # refuses what is none
        return {"source": "builtin", "name": path.name}
    keys = {"source": source, "file": os.path.relpath(path, folder)}
    if wanted.crs is not None:
        keys["crs"] = wanted.crs
    if wanted.terrain is not None:
        keys["terrain"] = os.path.relpath(wanted.terrain, folder)
    return keys


def _over(wanted: Wanted, file: Path) -> str:
    """The scenario over a city, where the swarm has room."""
    flights = _flights(_swarm(wanted))
    if wanted.city is None:
        if wanted.formation is None:
            return starter_text(file.stem, wanted)
        canyon = City.model_validate(yaml.safe_load(_CANYON))
        city = load_city(canyon, file.parent, Radio().carrier_hz, (0.0, 0.0, 0.0))
        return starter_text(file.stem, wanted, site=site_of(city, flights))
    keys = _keys(wanted, file.parent)
    node = City.model_validate(keys)
    city = load_city(node, file.parent, Radio().carrier_hz, (0.0, 0.0, 0.0))
    site = site_of(city, flights)
    lines = [f"  {key}: {v if key == 'source' else _quoted(v)}" for key, v in keys.items()]
    geo = GeoReference("", (0.0, 0.0, 0.0)) if node.source == "mesh" else city.georeference
    if geo is not None and _is_far(city, geo):
        geo, site = _local(geo, site, city)
        origin = np.array(geo.origin)
        if node.source == "mesh":
            origin = point_in_file(node, Path(keys["file"]), origin)
        x, y, z = origin.tolist()
        lines.append(f"  origin: [{x!r}, {y!r}, {z:g}]  # of the world, in coordinates of the file")
    if node.source == "blocks":
        lines += ["  # blocks_x, blocks_y, block_size_m, street_width_m, building_height_m, ..."]
    if node.source == "footprints":
        lines += ["  height_property: height         # of each building in the file [m]"]
        lines += ["  default_height_m: 10            # where neither it nor storeys are known"]
    return starter_text(file.stem, wanted, "\n".join(lines), site)


def _quoted(text: str) -> str:
    """A word of YAML, whatever a path has in it."""
    return str(yaml.safe_dump(text, default_style='"', allow_unicode=True, width=10**9)).strip()


def _is_far(city: CityMesh, geo: GeoReference) -> bool:
    """Return whether world coordinates are those of a plane about the middle, or far from their
    origin."""
    return bool(geo.plane) or float(np.abs(city.bounds() + city.origin).max()) > FAR_M


def _local(geo: GeoReference, site: Site, city: CityMesh) -> tuple[GeoReference, Site]:
    """The place with its origin near a site, on the ground, and the site there."""
    below = city.corners[..., 2] + city.origin[2]
    near = np.linalg.norm((city.corners + city.origin - site.middle)[..., :2], axis=-1) < FAR_M / 10
    level = float(np.quantile(below[near], 0.05)) if near.any() else 0.0
    origin = local_origin(geo, np.append(site.middle[:2], level))
    plane = plane_about(origin[0], origin[1]) if geo.plane and geo.is_lonlat else geo.plane
    if geo.plane and not geo.is_lonlat:
        origin = (geo.origin[0], geo.origin[1], origin[2])
    there = replace(geo, origin=origin, plane=plane)
    middle = there.to_world(geo.to_file(site.middle[None]))[0]
    return there, replace(site, middle=middle)
