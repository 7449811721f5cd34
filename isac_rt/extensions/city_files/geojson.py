"""GeoJSON, also with a feature in each line, as features of a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import shapely
from pydantic import Field, TypeAdapter, ValidationError
from pydantic_core import from_json

from isac_rt.extensions.city_files.buildings import Feature
from isac_rt.world.city.files import Items, Part, first_error
from isac_rt.world.city.materials import CityError

_Position = Annotated[Items[float], Field(min_length=2)]
_Rings = Items[Annotated[Items[_Position], Field(min_length=3)]]
BAD_AT_FIRST = 100
"""So many bad features before good ones end the reading."""


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


class _Line(Part):
    type: Literal["LineString"]
    coordinates: Items[_Position]

    def shape(self) -> shapely.Geometry:
        """A way that is closed is an area."""
        plan = [position[:2] for position in self.coordinates]
        closed = len(plan) > 3 and plan[0] == plan[-1]
        return shapely.Polygon(plan) if closed else shapely.Polygon()


class _Other(Part):
    type: Literal["Point", "MultiPoint", "MultiLineString"]

    def shape(self) -> shapely.Geometry:
        return shapely.Polygon()


class _Collection(Part):
    type: Literal["GeometryCollection"]
    geometries: Items[_Geometry]

    def shape(self) -> shapely.Geometry:
        return shapely.GeometryCollection([part.shape() for part in self.geometries])


_Geometry = Annotated[
    _Polygon | _MultiPolygon | _Line | _Other | _Collection, Field(discriminator="type")
]


class _Feature(Part):
    type: Literal["Feature"]
    id: str | int | None = None
    geometry: _Geometry | None = None
    properties: dict[str, Any] | None = None

    def shape(self) -> shapely.Geometry:
        return shapely.Polygon() if self.geometry is None else self.geometry.shape()


_Item = Annotated[
    _Feature | _Polygon | _MultiPolygon | _Line | _Other | _Collection, Field(discriminator="type")
]
_ITEM: TypeAdapter[_Item] = TypeAdapter(_Item)


class _Document(Part):
    """A GeoJSON file; its features are looked at one by one, for one of thousands may be bad."""

    type: str
    features: list[Any] | None = None
    crs: Any = None

    def named_crs(self) -> str:
        """Return what the `crs` member names, "" if nothing."""
        inside = self.crs.get("properties") if isinstance(self.crs, dict) else None
        said = inside.get("name") if isinstance(inside, dict) else None
        return said if isinstance(said, str) else ""


def by_lines(data: bytes) -> bytes:
    """A file with a feature in each line as one collection."""
    lines = (line.strip(b"\x1e \t\r") for line in data.split(b"\n"))
    return b'{"type": "FeatureCollection", "features": [' + b",".join(filter(None, lines)) + b"]}"


def read_geojson(data: bytes, name: str, notes: list[str]) -> tuple[list[Feature], str]:
    """The features of a GeoJSON file and what it says of its coordinate reference system.

    Features that are none are left out and counted.

    Raises
    ------
    CityError  If most of them are.
    """
    try:
        tree = from_json(data)
        if isinstance(tree, dict) and "elements" in tree:
            raise CityError(
                f"{name}: is JSON of the Overpass API; export GeoJSON, or: osmtogeojson {name} > "
                "buildings.geojson"
            )
        document = _Document.model_validate(tree)
    except ValidationError as error:
        raise CityError(f"{name}: {first_error(error)}; give GeoJSON with polygons") from None
    except (ValueError, RecursionError) as error:
        raise CityError(f"{name}: is no JSON ({error}); give GeoJSON or CityJSON") from None
    if document.features is None and document.type == "FeatureCollection":
        raise CityError(f"{name}: a FeatureCollection without features; give GeoJSON with polygons")
    items = [tree] if document.features is None else document.features
    found, bad = list[Feature](), list[str]()
    for i, item in enumerate(items):
        try:
            found.append(_feature(item, i, name))
        except (CityError, RecursionError) as problem:
            bad.append(str(problem))
        if len(bad) > BAD_AT_FIRST + len(found):
            break
    tell_bad(bad, len(found), notes)
    return found, document.named_crs()


def _feature(item: Any, number: int, name: str) -> Feature:
    what = f"{name}: feature {number}"
    try:
        read = _ITEM.validate_python(item)
    except ValidationError as error:
        raise CityError(f"{what}: {first_error(error)}; correct or remove it") from None
    properties = (read.properties or {}) if isinstance(read, _Feature) else {}
    number_or_name = properties.get("@id") or (read.id if isinstance(read, _Feature) else None)
    if isinstance(number_or_name, str | int):
        what = f"{name}: {number_or_name}"
    try:
        return Feature(read.shape(), properties, what)
    except (ValueError, shapely.errors.ShapelyError) as error:
        raise CityError(
            f"{what}: its coordinates cannot be read ({error}); rings are lists of [x, y]"
        ) from None


def tell_bad(bad: Sequence[str], good: int, notes: list[str]) -> None:
    """Say how many features were left out because something is wrong with them.

    Raises
    ------
    CityError  If there are more of these than good ones.
    """
    if len(bad) > good:
        raise CityError(bad[0])
    if bad:
        notes.append(f"{len(bad)} of {len(bad) + good} footprints left out; the first: {bad[0]}")
