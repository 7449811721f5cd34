"""Building footprints with heights: GeoJSON and CityJSON, in metres or in longitude and
latitude."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from isac_rt import scenario
from isac_rt.world.city.cityjson import parse_height, read_cityjson
from isac_rt.world.city.extrude import building, ground, polygons_of
from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface

LONLAT_FOOTPRINT = 0.05
"""No building is this many degrees across (5 km), and hardly any is this few metres."""
_POLYGONAL = ("Polygon", "MultiPolygon", "GeometryCollection")


def is_lonlat(boxes: NDArray[np.float64]) -> bool:
    """Whether footprints look like degrees.

    Parameters
    ----------
    boxes : (B, 4) float64
        West, south, east, north of each footprint, in the file's unit.
    """
    west, south, east, north = boxes.T
    in_range = west.min() >= -180 and east.max() <= 180 and south.min() >= -90 and north.max() <= 90
    return bool(in_range and np.median(np.maximum(east - west, north - south)) < LONLAT_FOOTPRINT)


def projection(lon: float, lat: float) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Longitude and latitude (N, 2) [degrees] to metres east and north of a point: azimuthal
    equidistant, WGS 84.

    Distances from the centre are exact; elsewhere they are off by about (r / 6400 km)^2 / 6: 1e-8
    at 2 km.
    """
    import pyproj

    plane = pyproj.Proj(proj="aeqd", lon_0=lon, lat_0=lat, ellps="WGS84")

    def to_metres(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.column_stack(plane(points[:, 0], points[:, 1]))

    return to_metres


def _placed(
    boxes: NDArray[np.float64], coordinates: str, name: str, notes: list[str]
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
    """The projection that a file needs; None if it is in metres already."""
    if coordinates == "metres" or (coordinates == "auto" and not is_lonlat(boxes)):
        return None
    if boxes[:, [1, 3]].min() < -90 or boxes[:, [1, 3]].max() > 90:
        worst = float(boxes[:, [1, 3]].flat[np.argmax(np.abs(boxes[:, [1, 3]]))])
        raise CityError(
            f"{name}: latitude {worst:g} is beyond 90 degrees; longitude and latitude are swapped "
            "(GeoJSON has longitude first), or the file is in metres: city.coordinates: metres"
        )
    if boxes[:, [0, 2]].min() < -180 or boxes[:, [0, 2]].max() > 180:
        raise CityError(
            f"{name}: a longitude is beyond 180 degrees; if the file is in metres, set "
            "city.coordinates: metres"
        )
    lon, lat = (boxes[:, [0, 1]].min(axis=0) + boxes[:, [2, 3]].max(axis=0)) / 2
    notes.append(
        f"world origin at longitude {lon:.7f}, latitude {lat:.7f} degrees (azimuthal equidistant, "
        "WGS 84)"
    )
    return projection(float(lon), float(lat))


def _geojson(
    document: dict[str, Any], key: str, name: str, notes: list[str]
) -> list[tuple[shapely.Geometry, float | None, str]]:
    """Geometry, height and label of each polygonal feature."""
    kind = document.get("type")
    features = document.get("features") if kind == "FeatureCollection" else [document]
    if kind not in ("FeatureCollection", "Feature", *_POLYGONAL) or not isinstance(features, list):
        raise CityError(
            f"{name}: type {kind!r} is neither GeoJSON with polygons nor CityJSON; give a "
            "FeatureCollection of polygons"
        )
    found: list[tuple[shapely.Geometry, float | None, str]] = []
    skipped = 0
    for i, feature in enumerate(features):
        what = f"{name}: feature {i}"
        if not isinstance(feature, dict):
            raise CityError(f"{what}: is {str(feature)[:40]}, not a GeoJSON feature; remove it")
        geometry = feature.get("geometry") if feature.get("type") == "Feature" else feature
        if not isinstance(geometry, dict) or geometry.get("type") not in _POLYGONAL:
            skipped += 1
            continue
        try:
            shape = shapely.force_2d(shapely.geometry.shape(geometry))
        except (
            LookupError,
            ValueError,
            TypeError,
            AttributeError,
            shapely.errors.ShapelyError,
        ) as error:
            raise CityError(
                f"{what}: its coordinates cannot be read ({error}); rings are lists of [x, y]"
            ) from None
        if shape.is_empty:
            skipped += 1
            continue
        if not np.isfinite(shapely.get_coordinates(shape)).all():
            raise CityError(f"{what}: a coordinate is NaN or infinite; correct it")
        properties = feature.get("properties")
        height = properties.get(key) if isinstance(properties, dict) else None
        found.append((shape, parse_height(height, what), what))
    if skipped:
        notes.append(f"{skipped} features without a polygon left out")
    return found


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file, or a CityError that says where it is broken."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CityError(
            f"{path.name}: not readable as JSON ({error}); give GeoJSON or CityJSON"
        ) from None
    if not isinstance(document, dict):
        raise CityError(
            f"{path.name}: holds a {type(document).__name__}, not an object; give GeoJSON or "
            "CityJSON"
        )
    return document


def _extruded(
    city: scenario.City,
    outlines: Sequence[tuple[shapely.Geometry, float | None, str]],
    base: float,
    bases: Sequence[float],
    notes: list[str],
) -> list[Surface]:
    wall, roof, floor = (
        MaterialUse(m) for m in (city.wall_material, city.roof_material, city.ground_material)
    )
    surfaces: list[Surface] = []
    for (shape, height, what), foot in zip(outlines, bases, strict=True):
        top = foot + (city.default_height_m if height is None else height)
        for polygon in polygons_of(shape, what):
            surfaces += building(polygon, base, top, wall, roof, floor, what)
    missing = sum(height is None for _, height, _ in outlines)
    if missing:
        notes.append(
            f"{missing} of {len(outlines)} footprints without {city.height_property!r}: "
            f"{city.default_height_m:g} m assumed"
        )
    return surfaces


def footprints(city: scenario.City, path: Path) -> tuple[list[Surface], list[str]]:
    """Closed buildings and a ground from a GeoJSON or CityJSON file.

    GeoJSON stands on z = 0. CityJSON keeps its heights; its ground plane lies at its lowest point,
    and what is extruded reaches down to it. Longitude and latitude are projected about the middle
    of the data, which becomes the world's origin; metres stay as they are.

    Returns
    -------
    surfaces : list of Surface
        World coordinates.
    notes : list of str

    Raises
    ------
    CityError
    """
    document, notes = read_json(path), list[str]()
    solids: list[Surface] = []
    terrain = False
    if document.get("type") == "CityJSON":
        model = read_cityjson(document, city, path.name, notes)
        outlines, bases, solids, terrain = (
            model.outlines,
            model.bases,
            model.surfaces,
            model.terrain,
        )
    else:
        outlines = _geojson(document, city.height_property, path.name, notes)
        bases = [0.0] * len(outlines)
    if not outlines and not solids:
        raise CityError(f"{path.name}: there is no polygon in it; give building footprints")
    points = [shapely.bounds(shape) for shape, _, _ in outlines]
    points += [
        np.concatenate([s.vertices[:, :2].min(axis=0), s.vertices[:, :2].max(axis=0)])
        for s in solids
    ]
    to_metres = _placed(np.array(points), city.coordinates, path.name, notes)
    if to_metres is not None:
        outlines = [
            (shapely.transform(shape, to_metres), height, what) for shape, height, what in outlines
        ]
        solids = [
            Surface(
                np.column_stack([to_metres(s.vertices[:, :2]), s.vertices[:, 2]]),
                s.faces,
                s.material,
            )
            for s in solids
        ]
    lowest = min([*bases, *(float(s.vertices[:, 2].min()) for s in solids)])
    surfaces = solids + _extruded(city, outlines, lowest, bases, notes)
    plan = np.concatenate([s.vertices[:, :2] for s in surfaces])
    if not terrain:
        floor = MaterialUse(city.ground_material)
        surfaces.append(
            ground(plan.min(axis=0), plan.max(axis=0), city.ground_margin_m, lowest, floor)
        )
    return surfaces, notes
