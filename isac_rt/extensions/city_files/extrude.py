"""Polygons to closed buildings, and the ground under them. Pure geometry; the sources call it."""

from __future__ import annotations

from collections.abc import Sequence

import mapbox_earcut
import numpy as np
import shapely
from numpy.typing import NDArray

from isac_rt.world.city.materials import CityError
from isac_rt.world.city.mesh import Surface
from isac_rt.world.city.prism import Finish, prism

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
    """Return whether the rings meet themselves or others more often than can be repaired."""
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
    parts = shapely.get_parts(geometry)
    flat = [p for p in parts if p.geom_type in ("Polygon", "MultiPolygon")]
    polygons = [q for p in flat for q in shapely.get_parts(p) if q.area > 0]
    if not polygons:
        raise CityError(f"{what}: the polygon has no area; redraw or remove it")
    return [shapely.remove_repeated_points(shapely.force_2d(p)) for p in polygons]


def _cap(polygon: shapely.Polygon, plan: NDArray[np.float64]) -> NDArray[np.int64]:
    """Counter-clockwise triangles of a polygon over the corners `plan` of its rings, using every
    one of them.

    Constrained Delaunay: ear clipping may pass over a corner on a straight edge, and the roof would
    not meet the wall there.
    """
    pieces = shapely.constrained_delaunay_triangles(polygon)
    corners = shapely.get_coordinates(pieces).reshape(-1, 4, 2)[:, :3]
    vertex: dict[tuple[float, ...], int] = {}
    for i, point in enumerate(plan.tolist()):
        vertex.setdefault(tuple(point), i)
    triangles = np.array([[vertex[tuple(p)] for p in t] for t in corners.tolist()], dtype=np.int64)
    flipped = _doubled_area(corners) < 0
    triangles[flipped] = triangles[flipped][:, ::-1]
    return triangles


def _doubled_area(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the signed area of plane triangles (T, 3, 2). [m^2]"""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
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
    flipped = _doubled_area(centred[triangles]) < 0
    triangles[flipped] = triangles[flipped][:, ::-1]
    return triangles


def building(
    polygon: shapely.Polygon,
    base: float,
    top: float,
    finish: Finish,
    what: str,
) -> list[Surface]:
    """A closed prism over a polygon: walls, roof and floor, normals outward.

    Parameters
    ----------
    polygon : shapely.Polygon
        Valid; holes become courtyards. [m]
    base, top : float
        Heights of floor and roof. [m]
    finish : Finish
    what : str
        For messages.
    """
    polygon = shapely.geometry.polygon.orient(
        polygon
    )  # outer ring counter-clockwise, holes clockwise
    rings = [shapely.get_coordinates(r)[:-1] for r in (polygon.exterior, *polygon.interiors)]
    plan = np.concatenate(rings)
    cap = _cap(polygon, plan)
    covered = _doubled_area(plan[cap]).sum() / 2
    if abs(covered - polygon.area) > 1e-6 * polygon.area:
        raise CityError(
            f"{what}: its roof cannot be triangulated ({covered:.6g} of {polygon.area:.6g} m2 "
            "covered); simplify the outline"
        )
    return prism(rings, cap, base, top, finish)


SQUARE_SHARE = 0.85
"""Of its smallest rectangle a plan with four corners fills at least this to carry a ridge."""
STRAIGHT_M = 0.2
"""Corners that stand out of a straight wall by less than this do not count."""
USUAL_PITCH = 2 / 3
"""Height of a roof over half of its span, where nobody says: 34 degrees."""
MOST_OF_HEIGHT = 0.6
"""A roof of unknown height takes no more of a building's."""


def quadrangle(polygon: shapely.Polygon) -> NDArray[np.float64] | None:
    """The four corners (4, 2) of a plan that is nearly a rectangle, counter-clockwise, a longer
    side first; None of any other."""
    plain = shapely.simplify(shapely.geometry.polygon.orient(polygon), STRAIGHT_M)
    corners = shapely.get_coordinates(plain.exterior)[:-1]
    if len(plain.interiors) or len(corners) != 4:
        return None
    if plain.area < SQUARE_SHARE * shapely.minimum_rotated_rectangle(plain).area:
        return None
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return corners if sides[0] + sides[2] >= sides[1] + sides[3] else np.roll(corners, -1, axis=0)


def _crown(
    polygon: shapely.Polygon, shape: str, across: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
    """Corners (N, 2), ridge (1 or 2, 2) and half of the span [m] of a roof; None if the plan is not
    simple enough for it."""
    if shape == "pyramidal":
        convex = shapely.convex_hull(polygon).area <= polygon.area * (1 + 1e-3)
        if len(polygon.interiors) or not convex:
            return None
        corners = shapely.get_coordinates(shapely.geometry.polygon.orient(polygon).exterior)[:-1]
        middle = shapely.get_coordinates(polygon.centroid)
        return corners, middle, float(np.linalg.norm(corners - middle, axis=1).min())
    corners_or_none = quadrangle(polygon)
    if corners_or_none is None:
        return None
    corners = np.roll(corners_or_none, -1, axis=0) if across else corners_or_none
    ends = np.stack([corners[[3, 0]].mean(axis=0), corners[[1, 2]].mean(axis=0)])
    half = float(np.linalg.norm(corners[[0, 1]] - corners[[3, 2]], axis=1).mean()) / 2
    if shape == "hipped":
        along = ends[1] - ends[0]
        length = float(np.linalg.norm(along))
        if length <= 2.2 * half:  # nothing of the ridge is left
            return corners, ends.mean(axis=0, keepdims=True), half
        ends = ends + np.array([[1.0], [-1.0]]) * along * half / length
    return corners, ends, half


def roofed(
    polygon: shapely.Polygon,
    heights: tuple[float, float],
    roof: tuple[str, float | None, bool],
    finish: Finish,
) -> list[Surface] | None:
    """A closed building with a gabled, hipped or pyramidal roof; None if its plan is not simple
    enough for one.

    Parameters
    ----------
    polygon : shapely.Polygon
    heights : (floor, ridge) [m]
    roof : (shape, height [m] or None, whether the ridge runs across the longer side)
    finish : Finish
    """
    shape, own, across = roof
    found = _crown(polygon, shape, across)
    base, top = heights
    if found is None:
        return None
    plan, ridge, half = found
    if own is None:
        own = min(half * USUAL_PITCH, MOST_OF_HEIGHT * (top - base))
    eaves = top - min(own, top - base)
    n = len(plan)
    layers = [np.column_stack([p, np.full(len(p), z)]) for p, z in ((plan, base), (plan, eaves))]
    vertices = np.concatenate([*layers, np.column_stack([ridge, np.full(len(ridge), top)])])
    here, after = np.arange(n), np.roll(np.arange(n), -1)
    walls = [
        np.column_stack([here, after, after + n]),
        np.column_stack([here, after + n, here + n]),
    ]
    first, last = 2 * n, 2 * n + len(ridge) - 1
    if len(ridge) == 1:
        slopes, ends = np.column_stack([here + n, after + n, np.full(n, first)]), None
    else:
        slopes = np.array(
            [(n, n + 1, last), (n, last, first), (n + 2, n + 3, first), (n + 2, first, last)]
        )
        ends = np.array([(n + 1, n + 2, last), (n + 3, n, first)])
    if ends is not None and shape == "gabled":
        walls.append(ends)
    elif ends is not None:
        slopes = np.concatenate([slopes, ends])
    floor = _cap(shapely.Polygon(plan), plan)
    return [
        Surface(vertices, np.concatenate(walls), finish.wall),
        Surface(vertices, slopes, finish.roof),
        Surface(vertices, floor[:, ::-1], finish.floor),
    ]
