"""Cities from maps: footprints with heights, and buildings with surfaces of their own, in metres or
in any other coordinates, on their ground."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from isac_rt.extensions.city_files.buildings import Outline, buildings, moved
from isac_rt.extensions.city_files.cityjson import CityModel, is_sequence, read_cityjson
from isac_rt.extensions.city_files.extrude import building, polygons_of, roofed
from isac_rt.extensions.city_files.geojson import by_lines, read_geojson, tell_bad
from isac_rt.extensions.city_files.tables import TABLES, read_table
from isac_rt.extensions.city_files.terrain import (
    Ground,
    Plan,
    feet_of,
    flat,
    lowered,
    of_raster,
    of_relief,
)
from isac_rt.extensions.city_files.terrain import through_feet as ground_through
from isac_rt.world import settings
from isac_rt.world.city.files import JSON_FACTOR, read_bytes, unpacked
from isac_rt.world.city.georeference import GeoReference, crs_name, georeference_of
from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface, check_coordinates
from isac_rt.world.city.prism import Finish

STRAY = 20.0
"""Farther from the middle than so many times nine of ten, and `STRAY_M`, is a stray footprint."""
STRAY_M = 30e3
_ALONG_M = 20.0
"""Along walls the ground is looked at so often."""
SEEN_LOWERED_M = 0.5
"""Buildings that go down to the ground by more are counted."""


def _model(city: settings.City, path: Path, notes: list[str]) -> CityModel:
    """Return the content of a file, in its own coordinates."""
    if path.suffix.lower() in TABLES:
        features, crs = read_table(path, city.layer)
        return CityModel(crs, buildings(features, city, path.name, notes))
    data = unpacked(read_bytes(path, JSON_FACTOR), path.name, JSON_FACTOR)
    data = data.removeprefix(b"\xef\xbb\xbf")
    if data.lstrip()[:1] == b"<":
        raise CityError(_REMEDY_XML.format(path.name))
    if is_sequence(data) or b'"CityJSON"' in data:
        return read_cityjson(data, city, path.name, notes)
    lines = path.suffix.lower() in (".geojsonl", ".geojsons", ".ndjson", ".jsonl")
    features, crs = read_geojson(by_lines(data) if lines else data, path.name, notes)
    return CityModel(crs, buildings(features, city, path.name, notes))


_REMEDY_XML = (
    "{0}: is XML; CityGML becomes CityJSON by: citygml-tools to-cityjson {0} (OpenStreetMap's XML "
    "is read where its name ends in .osm)"
)


def _boxes(model: CityModel) -> NDArray[np.float64]:
    """West, south, east, north of all that a file holds."""
    boxes = [shapely.bounds(outline.shape) for outline in model.outlines]
    for solid in model.solids:
        plan = solid.vertices[:, :2]
        boxes.append(np.concatenate([plan.min(axis=0), plan.max(axis=0)]))
    return np.array(boxes).reshape(-1, 4)


def _without_strays(model: CityModel, bad: list[str]) -> CityModel:
    """The model without outlines that lie where no place is, or far from all others."""
    if not model.outlines:
        return model
    boxes = np.array([shapely.bounds(outline.shape) for outline in model.outlines])
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    away = np.abs(middle - np.median(middle, axis=0)).max(axis=1)
    usual = float(np.quantile(away, 0.9))
    degrees = np.abs(boxes).max(axis=1).mean() <= 360
    stray = away > max(STRAY * usual, STRAY_M / 1e5 if degrees else STRAY_M)
    kept = []
    for outline, far in zip(model.outlines, stray.tolist(), strict=True):
        try:
            check_coordinates(shapely.get_coordinates(outline.shape), outline.what)
        except CityError as problem:
            bad.append(str(problem))
            continue
        if far:
            bad.append(f"{outline.what}: lies far from all others; correct or remove it")
        else:
            kept.append(outline)
    return CityModel(model.crs, kept, model.solids)


def _georeference(
    city: settings.City, model: CityModel, name: str, notes: list[str]
) -> GeoReference:
    """Where a city lies, by the scenario, the file, or the size of its numbers."""
    crs = ""
    if city.crs is not None:
        crs = crs_name(city.crs) or ""
        if not crs:
            raise CityError(
                f"city.crs {city.crs!r} is no coordinate reference system; write EPSG:2056, or "
                "what it is"
            )
    elif model.crs:
        crs = crs_name(model.crs) or ""
        if not crs:
            notes.append(f"coordinate reference system {model.crs[:80]!r} of the file is unknown")
    return georeference_of(_boxes(model), crs, city.coordinates, city.origin, name)


def _moved(model: CityModel, geo: GeoReference) -> CityModel:
    """The same in world coordinates."""
    z = geo.origin[2]
    outlines = [
        replace(
            moved(outline, shapely.transform(outline.shape, geo.to_world)),
            foot=None if outline.foot is None else outline.foot - z,
        )
        for outline in model.outlines
    ]
    if not model.solids:
        return CityModel(model.crs, outlines)
    vertices = geo.to_world(np.concatenate([solid.vertices for solid in model.solids]))
    ends = np.cumsum([len(solid.vertices) for solid in model.solids])[:-1]
    solids = [
        replace(solid, vertices=own)
        for solid, own in zip(model.solids, np.split(vertices, ends), strict=True)
    ]
    return CityModel(model.crs, outlines, solids)


def _ground(
    city: settings.City,
    model: CityModel,
    terrain: Path | None,
    geo: GeoReference,
    notes: list[str],
) -> Ground:
    """Return the ground that the city stands on."""
    boxes = _boxes(model)
    plan = Plan(
        boxes[:, :2].min(axis=0),
        boxes[:, 2:].max(axis=0),
        city.ground_margin_m,
        MaterialUse(city.ground_material),
    )
    relief = [solid for solid in model.solids if solid.kind == "TINRelief"]
    if terrain is not None:
        return of_raster(plan, terrain, geo, notes)
    if relief:
        return of_relief(relief)
    _, feet = feet_of(model.solids)
    grounded = [outline for outline in model.outlines if outline.foot is not None]
    centres = [(*shapely.get_coordinates(o.shape.centroid)[0], o.foot) for o in grounded]
    feet = np.concatenate([feet, np.array(centres, dtype=np.float64).reshape(-1, 3)])
    if len(feet):
        return ground_through(plan, feet, notes)
    lowest = min((float(solid.vertices[:, 2].min()) for solid in model.solids), default=0.0)
    return flat(plan, lowest if model.solids else -geo.origin[2])


def _extruded(
    outline: Outline, base: Ground, default: float, finish: Finish, plain: Counter[str]
) -> list[Surface]:
    """A building over a footprint."""
    polygons = polygons_of(outline.shape, outline.what)
    step = max(_ALONG_M, sum(p.length for p in polygons) / 100)
    floor = base.under(shapely.get_coordinates(shapely.segmentize(polygons, step)))
    foot = floor if outline.foot is None else outline.foot
    height = default if outline.height is None else outline.height
    low = floor if not outline.above else foot + outline.above
    top = foot + height
    if not top > low:
        raise CityError(
            f"{outline.what}: its lowest point is {outline.above:g} m high and its top {height:g} m"
        )
    surfaces: list[Surface] = []
    for polygon in polygons:
        made, roof = None, outline.roof
        if roof.shape in ("gabled", "hipped", "pyramidal"):
            made = roofed(polygon, (low, top), (roof.shape, roof.height, roof.across), finish)
        if made is None and roof.shape != "flat":
            plain[roof.shape] += 1
        surfaces += made or building(polygon, low, top, finish, outline.what)
    return surfaces


def _raised(
    city: settings.City, outlines: Sequence[Outline], base: Ground, bad: list[str], notes: list[str]
) -> list[Surface]:
    """Buildings over all footprints; bad ones are left out."""
    finish = Finish(
        MaterialUse(city.wall_material),
        MaterialUse(city.roof_material),
        MaterialUse(city.ground_material),
    )
    surfaces, good, plain = list[Surface](), 0, Counter[str]()
    for outline in outlines:
        try:
            surfaces += _extruded(outline, base, city.default_height_m, finish, plain)
            good += 1
        except CityError as problem:
            bad.append(str(problem))
        if len(bad) > 100 + good:
            break
    tell_bad(bad, good, notes)
    if plain:
        said = ", ".join(f"{count} {shape[:30]}" for shape, count in plain.most_common(8))
        notes.append(f"roofs drawn flat, at their full height: {said}")
    missing = sum(outline.height is None for outline in outlines)
    if missing:
        notes.append(
            f"{missing} of {len(outlines)} footprints without {city.height_property!r}: "
            f"{city.default_height_m:g} m assumed"
        )
    return surfaces


def located(
    city: settings.City, path: Path, notes: list[str], bad: list[str]
) -> tuple[CityModel, GeoReference]:
    """Return what a map's file holds, in its own coordinates, and where it lies.

    Raises
    ------
    CityError
    """
    model = _without_strays(_model(city, path, notes), bad)
    if not model.outlines and not model.solids:
        raise CityError(
            bad[0] if bad else f"{path.name}: there is no polygon in it; give building footprints"
        )
    return model, _georeference(city, model, path.name, notes)


def footprints(
    city: settings.City, path: Path, terrain: Path | None = None
) -> tuple[list[Surface], list[str], GeoReference]:
    """Closed buildings and a ground from a map.

    GeoJSON and tables stand on z = 0, or on the terrain. CityJSON keeps its heights, and what
    stands on the ground reaches down to it.

    Returns
    -------
    surfaces : list of Surface
        World coordinates.
    notes : list of str
    geo : Place

    Raises
    ------
    CityError
    """
    notes, bad = list[str](), list[str]()
    model, geo = located(city, path, notes, bad)
    model = _moved(model, geo)
    base = _ground(city, model, terrain, geo, notes)
    if geo.crs or any(geo.origin):
        notes.append(geo.words())
    surfaces = _raised(city, model.outlines, base, bad, notes)
    if base.surface is not None:
        surfaces.append(base.surface)
    return [*_solids(model, base, terrain is not None, notes), *surfaces], notes, geo


def _solids(model: CityModel, base: Ground, replaced: bool, notes: list[str]) -> list[Surface]:
    """Return the parts that have surfaces of their own, down to the ground."""
    on_ground = feet_of(model.solids)[0]
    down = dict(zip(map(id, on_ground), lowered(on_ground, base), strict=True))
    surfaces, deep = list[Surface](), list[float]()
    for solid in model.solids:
        if replaced and solid.kind == "TINRelief":
            continue
        grounded, by = down.get(id(solid), (solid, 0.0))
        surfaces += grounded.surfaces()
        deep += [by] if by > SEEN_LOWERED_M else []
    if deep:
        notes.append(
            f"{len(deep)} buildings reach down to the ground, by {np.median(deep):.1f} m in the "
            f"median and up to {max(deep):.1f} m"
        )
    return surfaces
