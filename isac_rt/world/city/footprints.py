"""Building footprints with heights: GeoJSON and CityJSON, in metres or in longitude and
latitude."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field, RootModel

from isac_rt import scenario
from isac_rt.world.city.cityjson import CityJson, CityModel, parse_height, read_cityjson
from isac_rt.world.city.extrude import building, ground, polygons_of
from isac_rt.world.city.files import JSON_FACTOR, Items, Part, parsed, read_bytes
from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface, check_coordinates

LONLAT_FOOTPRINT = 0.05
"""No building is this many degrees across (5 km), and hardly any is this few metres."""


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


_Position = Annotated[Items[float], Field(min_length=2)]
_Rings = Items[Annotated[Items[_Position], Field(min_length=3)]]


def _polygon(rings: _Rings) -> shapely.Polygon:
    plan = [[position[:2] for position in ring] for ring in rings]
    return shapely.Polygon(plan[0], plan[1:]) if plan else shapely.Polygon()


class _Polygon(Part):
    type: Literal["Polygon"]
    coordinates: _Rings

    def shape(self) -> shapely.Geometry:
        return _polygon(self.coordinates)


class _MultiPolygon(Part):
    type: Literal["MultiPolygon"]
    coordinates: Items[_Rings]

    def shape(self) -> shapely.Geometry:
        return shapely.MultiPolygon([_polygon(rings) for rings in self.coordinates])


class _Other(Part):
    type: Literal["Point", "MultiPoint", "LineString", "MultiLineString"]

    def shape(self) -> shapely.Geometry:
        return shapely.Polygon()


class _Collection(Part):
    type: Literal["GeometryCollection"]
    geometries: Items[_Geometry]

    def shape(self) -> shapely.Geometry:
        return shapely.GeometryCollection([part.shape() for part in self.geometries])


_Geometry = Annotated[_Polygon | _MultiPolygon | _Other | _Collection, Field(discriminator="type")]


class _Feature(Part):
    type: Literal["Feature"]
    geometry: _Geometry | None = None
    properties: dict[str, Any] | None = None

    def shape(self) -> shapely.Geometry:
        return shapely.Polygon() if self.geometry is None else self.geometry.shape()


_Item = Annotated[
    _Feature | _Polygon | _MultiPolygon | _Other | _Collection, Field(discriminator="type")
]


class _FeatureCollection(Part):
    type: Literal["FeatureCollection"]
    features: Items[_Item]


class _Map(RootModel):
    """GeoJSON or CityJSON."""

    root: Annotated[
        _FeatureCollection | _Feature | _Polygon | _MultiPolygon | _Collection | CityJson,
        Field(discriminator="type"),
    ]


def _geojson(
    features: Sequence[_Item], key: str, name: str, notes: list[str]
) -> list[tuple[shapely.Geometry, float | None, str]]:
    """Geometry, height and label of each polygonal feature."""
    found: list[tuple[shapely.Geometry, float | None, str]] = []
    for i, feature in enumerate(features):
        what = f"{name}: feature {i}"
        try:
            shape = feature.shape()
        except (ValueError, shapely.errors.ShapelyError) as error:
            raise CityError(
                f"{what}: its coordinates cannot be read ({error}); rings are lists of [x, y]"
            ) from None
        if not shape.is_empty:
            properties = feature.properties if isinstance(feature, _Feature) else None
            found.append((shape, parse_height((properties or {}).get(key), what), what))
    if len(found) < len(features):
        notes.append(f"{len(features) - len(found)} features without a polygon left out")
    return found


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
    data, notes = read_bytes(path, JSON_FACTOR), list[str]()
    document = parsed(data, _Map, path.name, "give GeoJSON with polygons, or CityJSON").root
    model = CityModel()
    if isinstance(document, CityJson):
        model = read_cityjson(document, city, path.name, notes)
    else:
        features = document.features if isinstance(document, _FeatureCollection) else [document]
        model.outlines = _geojson(features, city.height_property, path.name, notes)
        model.bases = [0.0] * len(model.outlines)
    outlines, bases, solids = model.outlines, model.bases, model.surfaces
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
    for shape, _, what in outlines:
        check_coordinates(shapely.get_coordinates(shape), what)
    lowest = min([*bases, *(float(s.vertices[:, 2].min()) for s in solids)])
    surfaces = solids + _extruded(city, outlines, lowest, bases, notes)
    plan = np.concatenate([s.vertices[:, :2] for s in surfaces])
    if not model.terrain:
        floor = MaterialUse(city.ground_material)
        surfaces.append(
            ground(plan.min(axis=0), plan.max(axis=0), city.ground_margin_m, lowest, floor)
        )
    return surfaces, notes
