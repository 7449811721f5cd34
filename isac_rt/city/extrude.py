"""Polygons to closed buildings, and the ground under them. Pure geometry; the sources call it."""

from __future__ import annotations

from collections.abc import Sequence

import mapbox_earcut
import numpy as np
import shapely
from numpy.typing import NDArray

from isac_rt.city.materials import CityError, MaterialUse
from isac_rt.city.mesh import Surface

COLLINEAR = 1e-9
"""A corner this close to the line through its neighbours is dropped: the triangulation would skip it, the walls would not. [m]"""


def polygons_of(geometry: shapely.Geometry, what: str) -> list[shapely.Polygon]:
    """The valid polygons of a geometry, with repair where that keeps an area.

    Raises
    ------
    CityError  If no area can be recovered.
    """
    if not shapely.is_valid(geometry):
        why = shapely.is_valid_reason(geometry)
        geometry = shapely.make_valid(geometry)
        if not geometry.area > 0:
            raise CityError(f"{what}: the polygon is not valid ({why}) and repair leaves no area; redraw or remove it")
    parts = [p for p in shapely.get_parts(geometry, return_index=False) if p.geom_type in ("Polygon", "MultiPolygon")]
    polygons = [q for p in parts for q in shapely.get_parts(p) if q.area > 0]
    if not polygons:
        raise CityError(f"{what}: the polygon has no area; redraw or remove it")
    return [shapely.geometry.polygon.orient(shapely.force_2d(p)) for p in polygons]


def _corners(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """The ring without its closing point and without points on straight edges."""
    points = ring[:-1]
    while len(points) > 3:
        before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
        along, to = after - before, points - before
        length = np.hypot(along[:, 0], along[:, 1])
        off = np.abs(along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]) / np.maximum(length, COLLINEAR)
        straight = np.flatnonzero(off <= COLLINEAR)
        if not len(straight):
            break
        points = np.delete(points, straight[0], axis=0)  # one at a time: neighbours change
    return points


def triangulate(rings: Sequence[NDArray[np.float64]]) -> NDArray[np.int64]:
    """Triangles of a polygon with holes.

    Parameters
    ----------
    rings : sequence of (N, 2) float64
        Open rings, the outer one first.

    Returns
    -------
    triangles : (T, 3) int64
        Indices into the concatenated rings, counter-clockwise.
    """
    points = np.concatenate(rings)
    ends = np.cumsum([len(r) for r in rings]).astype(np.uint32)
    centred = np.ascontiguousarray(points - points.mean(axis=0))
    triangles = np.asarray(mapbox_earcut.triangulate_float64(centred, ends), dtype=np.int64).reshape(-1, 3)
    a, b, c = (centred[triangles[:, k]] for k in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles[turn < 0] = triangles[turn < 0][:, ::-1]
    return triangles


def ring_area(ring: NDArray[np.float64]) -> float:
    """Signed area of an open ring, positive counter-clockwise. [m^2]"""
    x, y = (ring - ring[0]).T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)


def building(
    polygon: shapely.Polygon, base: float, top: float, wall: MaterialUse, roof: MaterialUse, floor: MaterialUse, what: str
) -> list[Surface]:
    """A closed prism over a polygon: walls, roof and floor, normals outward.

    Parameters
    ----------
    polygon : shapely.Polygon
        Valid; holes become courtyards. [m]
    base, top : float
        Heights of floor and roof. [m]
    wall, roof, floor : MaterialUse
    what : str
        For messages.
    """
    polygon = shapely.geometry.polygon.orient(polygon)  # outer ring counter-clockwise, holes clockwise
    rings = [_corners(shapely.get_coordinates(r)) for r in (polygon.exterior, *polygon.interiors)]
    rings = [rings[0], *(r for r in rings[1:] if abs(ring_area(r)) > 0)]
    plan = np.concatenate(rings)
    num = len(plan)
    vertices = np.concatenate([np.column_stack([plan, np.full(num, z)]) for z in (base, top)])
    cap = triangulate(rings)
    a, b, c = (plan[cap[:, k]] for k in range(3))
    covered = np.sum((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / 2
    if abs(covered - polygon.area) > 1e-6 * polygon.area:
        raise CityError(f"{what}: its roof cannot be triangulated ({covered:.6g} of {polygon.area:.6g} m2 covered); simplify the outline")
    start = np.cumsum([0] + [len(r) for r in rings[:-1]])
    here = np.arange(num)
    nxt = np.concatenate([s + np.roll(np.arange(len(r)), -1) for s, r in zip(start, rings, strict=True)])
    walls = np.concatenate([np.column_stack([here, nxt, nxt + num]), np.column_stack([here, nxt + num, here + num])])
    return [Surface(vertices, walls, wall), Surface(vertices, cap + num, roof), Surface(vertices, cap[:, ::-1], floor)]


def ground(low: NDArray[np.float64], high: NDArray[np.float64], margin: float, height: float, material: MaterialUse) -> Surface:
    """A rectangle under everything, facing up.

    Parameters
    ----------
    low, high : (2,) float64
        Corners of what stands on it. [m]
    margin : float
        Added on each side. [m]
    height : float
        [m]
    material : MaterialUse
    """
    (x_0, y_0), (x_1, y_1) = low - margin, high + margin
    vertices = np.array([[x_0, y_0, height], [x_1, y_0, height], [x_1, y_1, height], [x_0, y_1, height]])
    return Surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), material)
