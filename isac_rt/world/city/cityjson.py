"""CityJSON 1.x and 2.0: the surfaces of the highest level of detail, or footprints where there is
nothing above level 0."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field

from isac_rt import scenario
from isac_rt.world.city.extrude import check_corners, triangulate
from isac_rt.world.city.files import Items, Part
from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface, check_coordinates

_GROUND_TYPES = (
    "TINRelief LandUse Road Railway WaterBody PlantCover TransportSquare Waterway".split()
)
_Triple = tuple[float, float, float]
_Boundary = Items[Items[Annotated[int, Field(ge=0, lt=2**31)]]]


class _Kind(Part):
    type: str | None = None


class _Semantics(Part):
    surfaces: tuple[_Kind, ...] = ()
    values: list[Any] | None = None


class _Geometry(Part):
    lod: Annotated[float, Field(strict=False)] = 0.0
    semantics: _Semantics | None = None


class _Surfaces(_Geometry):
    type: Literal["MultiSurface", "CompositeSurface"]
    boundaries: Items[_Boundary]
    depth: ClassVar[int] = 0
    """How many lists lie around the list of surfaces."""


class _Solid(_Geometry):
    type: Literal["Solid"]
    boundaries: Items[Items[_Boundary]]
    depth: ClassVar[int] = 1


class _Solids(_Geometry):
    type: Literal["MultiSolid", "CompositeSolid"]
    boundaries: Items[Items[Items[_Boundary]]]
    depth: ClassVar[int] = 2


class _NoSurface(_Geometry):
    type: Literal["MultiPoint", "MultiLineString", "GeometryInstance"]


_Surfaced = _Surfaces | _Solid | _Solids


class _Object(Part):
    type: str | None = None
    attributes: dict[str, Any] | None = None
    children: tuple[str, ...] = ()
    geometry: tuple[Annotated[_Surfaced | _NoSurface, Field(discriminator="type")], ...] = ()


class _Transform(Part):
    scale: _Triple
    translate: _Triple


class CityJson(Part):
    """What is read of a CityJSON file."""

    type: Literal["CityJSON"]
    transform: _Transform | None = None
    vertices: Items[_Triple]
    CityObjects: dict[str, _Object] = Field({})


@dataclass
class CityModel:
    """What a CityJSON file holds, in its own coordinates.

    Parameters
    ----------
    outlines : list of (geometry, height, label)
        Footprints to extrude; height [m] or None.
    bases : list of float
        Height of each footprint. [m]
    surfaces : list of Surface
    terrain : bool
        Whether the file brings its own ground.
    """

    outlines: list[tuple[shapely.Geometry, float | None, str]] = field(default_factory=list)
    bases: list[float] = field(default_factory=list)
    surfaces: list[Surface] = field(default_factory=list)
    terrain: bool = False


def parse_height(value: Any, what: str) -> float | None:
    """A height property as metres: a number, or text such as ``12.5`` or ``12.5 m``; None if there
    is none.

    Raises
    ------
    CityError  If it is anything else, not positive or not finite.
    """
    if value is None or (isinstance(value, str) and not value.strip()):
        return None
    text = value.strip().removesuffix("m") if isinstance(value, str) else value
    try:
        number = math.nan if isinstance(text, bool) else float(text)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not 0 < number < math.inf:
        raise CityError(f"{what}: height {value!r} is not a positive number of metres; correct it")
    return number


def _flat(boundaries: list, values: Any, depth: int) -> Iterator[tuple[list, int | None]]:
    """Each surface (a list of rings) with its semantic index, through `depth` outer lists."""
    for i, item in enumerate(boundaries):
        value = values[i] if isinstance(values, list) and i < len(values) else None
        if depth:
            yield from _flat(item, value, depth - 1)
        else:
            yield item, value if isinstance(value, int) else None


def triangulate_planar(rings: list[NDArray[np.float64]]) -> NDArray[np.int64]:
    """Triangles of a planar polygon in space, with holes, in its own plane, keeping its
    orientation.

    Parameters
    ----------
    rings : list of (N, 3) float64
        Open rings, the outer one first. [m]

    Returns
    -------
    triangles : (T, 3) int64
        Indices into the concatenated rings; none if the outer ring has no area.
    """
    outer = rings[0] - rings[0][0]
    normal = (
        np.cross(outer, np.roll(outer, -1, axis=0)).sum(axis=0) / 2
    )  # Newell: twice the area vector, halved
    area = np.linalg.norm(normal)
    if not area > 0:
        return np.zeros((0, 3), dtype=np.int64)
    normal /= area
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    basis = np.column_stack([across, np.cross(normal, across)])
    return triangulate([(ring - rings[0][0]) @ basis for ring in rings])


def _material(city: scenario.City, semantic: str | None, object_type: str) -> str:
    if object_type in _GROUND_TYPES or semantic in ("GroundSurface", "OuterFloorSurface"):
        return city.ground_material
    return (
        city.roof_material
        if semantic in ("RoofSurface", "OuterCeilingSurface")
        else city.wall_material
    )


def _corners(
    rings: _Boundary, vertices: NDArray[np.float64], what: str
) -> list[NDArray[np.float64]]:
    """The rings' corners; the outer ring first, or nothing if it has no area."""
    check_corners(sum(len(ring) for ring in rings), what)
    highest = max((max(ring, default=0) for ring in rings), default=0)
    if highest >= len(vertices):
        raise CityError(
            f"{what}: a boundary names vertex {highest} of {len(vertices)}; check the file with a "
            "CityJSON validator"
        )
    return [vertices[ring] for ring in rings if len(ring) >= 3]


def _surfaces(
    geometry: _Surfaced,
    vertices: NDArray[np.float64],
    city: scenario.City,
    object_type: str,
    what: str,
) -> Iterator[Surface]:
    semantics = geometry.semantics or _Semantics()
    kinds = [surface.type for surface in semantics.surfaces]
    for rings, value in _flat(geometry.boundaries, semantics.values, geometry.depth):
        corners = _corners(rings, vertices, what)
        if corners:
            semantic = kinds[value] if value is not None and 0 <= value < len(kinds) else None
            use = MaterialUse(_material(city, semantic, object_type))
            yield Surface(np.concatenate(corners), triangulate_planar(corners), use)


def _footprint(
    geometry: _Surfaced, vertices: NDArray[np.float64], what: str
) -> tuple[shapely.Geometry, float] | None:
    """The plan and the lowest height of surfaces, if they have any."""
    found = [
        _corners(r, vertices, what) for r, _ in _flat(geometry.boundaries, None, geometry.depth)
    ]
    rings = [corners for corners in found if corners]
    if not rings:
        return None
    polygons = [shapely.Polygon(r[0][:, :2], [c[:, :2] for c in r[1:]]) for r in rings]
    return shapely.MultiPolygon(polygons), min(float(c[:, 2].min()) for r in rings for c in r)


def read_cityjson(
    document: CityJson, city: scenario.City, name: str, notes: list[str]
) -> CityModel:
    """The surfaces and footprints of a CityJSON file.

    Parameters
    ----------
    document : CityJson
    city : scenario.City
        Materials, and the attribute with heights; `measuredHeight` is looked for besides it.
    name : str
        For messages.
    notes : list of str
        Grows.
    """
    vertices = np.array(document.vertices, dtype=np.float64).reshape(-1, 3)
    if document.transform is not None:
        vertices = vertices * document.transform.scale + document.transform.translate
    check_coordinates(vertices, f"{name}: vertices")
    model, skipped, objects = CityModel(), 0, document.CityObjects
    detailed = {key for key, item in objects.items() if any(g.lod >= 1 for g in item.geometry)}
    for key, item in objects.items():
        what, kind = f"{name}: object {key}", str(item.type)
        usable = [g for g in item.geometry if not isinstance(g, _NoSurface)]
        skipped += len(item.geometry) - len(usable)
        if not usable:
            continue
        best = max(usable, key=lambda geometry: geometry.lod)
        if best.lod >= 1 or kind in _GROUND_TYPES:
            model.surfaces += _surfaces(best, vertices, city, kind, what)
            model.terrain |= kind == "TINRelief"
        elif not detailed.intersection(item.children):
            attributes = item.attributes or {}
            height = parse_height(
                attributes.get(city.height_property, attributes.get("measuredHeight")), what
            )
            plan = _footprint(best, vertices, what)
            if plan is not None:
                model.outlines.append((plan[0], height, what))
                model.bases.append(plan[1])
    if skipped:
        notes.append(f"{skipped} CityJSON geometries that are no surfaces left out")
    return model
