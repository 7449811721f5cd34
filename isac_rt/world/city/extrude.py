"""Polygons to closed buildings, and the ground under them. Pure geometry; the sources call it."""

from __future__ import annotations

from collections.abc import Sequence

import mapbox_earcut
import numpy as np
import shapely
from numpy.typing import NDArray

from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface

MAX_CORNERS = 10_000
"""Of one polygon: triangulation takes a time that grows with their square, 1 s here."""
MAX_CROSSINGS = 100
"""Of one polygon with itself; GEOS repairs some 2000 in a second."""


def check_corners(count: int, what: str) -> None:
    """Refuse a polygon of too many corners."""
    if count > MAX_CORNERS:
        raise CityError(
            f"{what}: a polygon of {count} corners, more than {MAX_CORNERS}; simplify or split it"
        )


def _crosses_often(geometry: shapely.Geometry) -> bool:
    """Whether the rings meet themselves or others more often than can be repaired."""
    rings = shapely.get_rings(shapely.get_parts(shapely.get_parts(geometry)))
    points, ring = shapely.get_coordinates(rings, return_index=True)
    ends = np.stack([points[:-1], points[1:]], axis=1)[ring[1:] == ring[:-1]]
    segments = shapely.linestrings(ends)
    tree, found = shapely.STRtree(segments), 0
    for start in range(0, len(segments), 100):
        block = segments[start : start + 100]
        found += tree.query(block, predicate="intersects").shape[1] - 3 * len(block)
        if found > 2 * MAX_CROSSINGS:  # each is found from both segments
            return True
    return False


def polygons_of(geometry: shapely.Geometry, what: str) -> list[shapely.Polygon]:
    """The valid polygons of a geometry, with repair where that keeps an area.

    Raises
    ------
    CityError  If no area can be recovered.
    """
    check_corners(shapely.get_num_coordinates(geometry), what)
    if not shapely.is_valid(geometry):
        if _crosses_often(geometry):
            raise CityError(
                f"{what}: the polygon meets itself more than {MAX_CROSSINGS} times; redraw or "
                "remove it"
            )
        why = shapely.is_valid_reason(geometry)
        geometry = shapely.make_valid(geometry)
        if not geometry.area > 0:
            raise CityError(
                f"{what}: the polygon is not valid ({why}) and repair leaves no area; redraw or "
                "remove it"
            )
    parts = [
        p
        for p in shapely.get_parts(geometry, return_index=False)
        if p.geom_type in ("Polygon", "MultiPolygon")
    ]
    polygons = [q for p in parts for q in shapely.get_parts(p) if q.area > 0]
    if not polygons:
        raise CityError(f"{what}: the polygon has no area; redraw or remove it")
    return [shapely.remove_repeated_points(shapely.force_2d(p)) for p in polygons]


def _cap(polygon: shapely.Polygon, plan: NDArray[np.float64]) -> NDArray[np.int64]:
    """Counter-clockwise triangles of a polygon over the corners `plan` of its rings, using every
    one of them.

    Constrained Delaunay: ear clipping may pass over a corner on a straight edge, and the roof would
    not meet the wall there.
    """
    pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    corners = np.array([shapely.get_coordinates(t)[:3] for t in pieces])
    known, first = np.unique(plan, axis=0, return_index=True)
    place = {point: int(i) for point, i in zip(map(tuple, known.tolist()), first, strict=True)}
    triangles = np.array([[place[tuple(p)] for p in t] for t in corners.tolist()], dtype=np.int64)
    flipped = _turn(corners) < 0
    triangles[flipped] = triangles[flipped][:, ::-1]
    return triangles


def _turn(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the signed area of plane triangles (T, 3, 2). [m^2]"""
    a, b, c = np.moveaxis(corners, 1, 0)
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


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
    triangles = np.asarray(
        mapbox_earcut.triangulate_float64(centred, ends), dtype=np.int64
    ).reshape(-1, 3)
    flipped = _turn(centred[triangles]) < 0
    triangles[flipped] = triangles[flipped][:, ::-1]
    return triangles


def building(
    polygon: shapely.Polygon,
    base: float,
    top: float,
    wall: MaterialUse,
    roof: MaterialUse,
    floor: MaterialUse,
    what: str,
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
    polygon = shapely.geometry.polygon.orient(
        polygon
    )  # outer ring counter-clockwise, holes clockwise
    rings = [shapely.get_coordinates(r)[:-1] for r in (polygon.exterior, *polygon.interiors)]
    plan = np.concatenate(rings)
    num = len(plan)
    vertices = np.concatenate([np.column_stack([plan, np.full(num, z)]) for z in (base, top)])
    cap = _cap(polygon, plan)
    covered = _turn(plan[cap]).sum() / 2
    if abs(covered - polygon.area) > 1e-6 * polygon.area:
        raise CityError(
            f"{what}: its roof cannot be triangulated ({covered:.6g} of {polygon.area:.6g} m2 "
            "covered); simplify the outline"
        )
    start = np.cumsum([0] + [len(r) for r in rings[:-1]])
    here = np.arange(num)
    nxt = np.concatenate(
        [s + np.roll(np.arange(len(r)), -1) for s, r in zip(start, rings, strict=True)]
    )
    walls = np.concatenate(
        [np.column_stack([here, nxt, nxt + num]), np.column_stack([here, nxt + num, here + num])]
    )
    return [
        Surface(vertices, walls, wall),
        Surface(vertices, cap + num, roof),
        Surface(vertices, cap[:, ::-1], floor),
    ]


def ground(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    margin: float,
    height: float,
    material: MaterialUse,
) -> Surface:
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
    vertices = np.array(
        [[x_0, y_0, height], [x_1, y_0, height], [x_1, y_1, height], [x_0, y_1, height]]
    )
    return Surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), material)
