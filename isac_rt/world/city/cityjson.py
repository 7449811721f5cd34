"""CityJSON 1.x and 2.0: the surfaces of the highest level of detail, or footprints where there is
nothing above level 0."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from isac_rt import scenario
from isac_rt.world.city.extrude import triangulate
from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface

_GROUND_TYPES = (
    "TINRelief LandUse Road Railway WaterBody PlantCover TransportSquare Waterway".split()
)
_DEPTH = {
    "MultiSurface": 0,
    "CompositeSurface": 0,
    "Solid": 1,
    "MultiSolid": 2,
    "CompositeSolid": 2,
}
"""How many lists lie around the list of surfaces."""


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
    number = value
    if isinstance(value, str):
        try:
            number = float(value.strip().removesuffix("m").strip())
        except ValueError:
            raise CityError(
                f"{what}: height {value!r} is not a number of metres; correct it"
            ) from None
    if (
        isinstance(number, bool)
        or not isinstance(number, int | float)
        or not math.isfinite(number)
        or number <= 0
    ):
        raise CityError(f"{what}: height {value!r} is not a positive number of metres; correct it")
    return float(number)


def _vertices(document: dict[str, Any], name: str) -> NDArray[np.float64]:
    try:
        vertices = np.array(document["vertices"], dtype=np.float64).reshape(-1, 3)
        transform = document.get("transform")
        if transform is not None:
            vertices = vertices * np.array(transform["scale"], dtype=np.float64) + np.array(
                transform["translate"], dtype=np.float64
            )
    except (KeyError, TypeError, ValueError) as error:
        raise CityError(
            f"{name}: `vertices` or `transform` cannot be read ({error}); check the file with a "
            "CityJSON validator"
        ) from None
    return vertices


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


def _surfaces(
    geometry: dict[str, Any],
    vertices: NDArray[np.float64],
    city: scenario.City,
    object_type: str,
    what: str,
) -> list[Surface]:
    semantics = geometry.get("semantics") or {}
    kinds = [s.get("type") for s in semantics.get("surfaces", [])]
    found = []
    for rings, value in _flat(
        geometry["boundaries"], semantics.get("values"), _DEPTH[geometry["type"]]
    ):
        corners = [vertices[np.array(ring, dtype=np.int64)] for ring in rings if len(ring) >= 3]
        if not corners:
            continue
        if not all(np.isfinite(c).all() for c in corners):
            raise CityError(f"{what}: a coordinate is NaN or infinite; correct it")
        semantic = kinds[value] if value is not None and 0 <= value < len(kinds) else None
        use = MaterialUse(_material(city, semantic, object_type))
        found.append(Surface(np.concatenate(corners), triangulate_planar(corners), use))
    return found


def _footprint(
    geometry: dict[str, Any], vertices: NDArray[np.float64]
) -> tuple[shapely.Geometry, float]:
    polygons, lowest = [], np.inf
    for rings, _ in _flat(geometry["boundaries"], None, 0):
        corners = [vertices[np.array(ring, dtype=np.int64)] for ring in rings]
        lowest = min(lowest, *(float(c[:, 2].min()) for c in corners))
        polygons.append(shapely.Polygon(corners[0][:, :2], [c[:, :2] for c in corners[1:]]))
    return shapely.MultiPolygon(polygons), lowest


def _level(geometry: dict[str, Any]) -> float:
    return float(geometry.get("lod", 0))


def read_cityjson(
    document: dict[str, Any], city: scenario.City, name: str, notes: list[str]
) -> CityModel:
    """The surfaces and footprints of a CityJSON file.

    Parameters
    ----------
    document : dict
        The parsed file.
    city : scenario.City
        Materials, and the attribute with heights; `measuredHeight` is looked for besides it.
    name : str
        For messages.
    notes : list of str
        Grows.
    """
    vertices, model, skipped = _vertices(document, name), CityModel(), 0
    objects = document.get("CityObjects", {})
    detailed = {
        key
        for key, item in objects.items()
        if any(_level(g) >= 1 for g in item.get("geometry", []))
    }
    for key, item in objects.items():
        what, kind = f"{name}: object {key}", str(item.get("type"))
        usable = [g for g in item.get("geometry", []) if g.get("type") in _DEPTH]
        skipped += len(item.get("geometry", [])) - len(usable)
        if not usable:
            continue
        best = max(usable, key=_level)
        try:
            if _level(best) >= 1 or kind in _GROUND_TYPES:
                model.surfaces += _surfaces(best, vertices, city, kind, what)
                model.terrain |= kind == "TINRelief"
            elif not detailed.intersection(item.get("children", [])):
                attributes = item.get("attributes") or {}
                height = parse_height(
                    attributes.get(city.height_property, attributes.get("measuredHeight")), what
                )
                shape, base = _footprint(best, vertices)
                model.outlines.append((shape, height, what))
                model.bases.append(base)
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise CityError(
                f"{what}: its geometry cannot be read ({error}); check the file with a CityJSON "
                "validator"
            ) from None
    if skipped:
        notes.append(f"{skipped} CityJSON geometries that are no surfaces left out")
    return model
