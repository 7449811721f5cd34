"""Surfaces that lie twice: a building part on its building's wall, a road on the ground. Each point
of them scatters once.

Rays tell two surfaces apart that are farther than `LIFT` from each other: the front one hides the
other. Nearer ones are taken for one surface here, of which the smaller face counts: it describes
the place in more detail.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from isac_rt.propagation.clutter.cells import Cells
from isac_rt.propagation.legs.geometry import LIFT
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import over_triangle

PARALLEL = 0.999
"""Cosine between the normals of faces that may be one surface: steeper ones cross in a strip of
some centimetres."""
TOUCH_M = 1e-6
"""Faces that overlap by less only share an edge. [m]"""
PAIRS_AT_ONCE = 1_000_000


def lies_twice(cells: Cells, city: CityMesh) -> np.ndarray:
    """(N,) whether another face that scatters too covers the point of a cell, and counts there."""
    faces, row = np.unique(cells.face, return_inverse=True)
    corners, normals = city.corners[faces], city.normals[faces]
    order = np.lexsort((cells.points[:, 0], row))
    points, begin = cells.points[order], np.searchsorted(row[order], np.arange(len(faces) + 1))
    covered = np.zeros(len(cells), bool)
    for hidden, cover in _hidden_first(corners, city.areas[faces], normals):
        low, high = corners[cover, :, 0].min() - LIFT, corners[cover, :, 0].max() + LIFT
        of = slice(begin[hidden], begin[hidden + 1])
        some = of.start + np.arange(*np.searchsorted(points[of, 0], [low, high]))
        covered[order[some]] |= _inside(points[some], corners[cover], normals[cover])
    return covered


def _inside(points: np.ndarray, corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(N,) whether points (N, 3) lie within `LIFT` of a triangle (3, 3), over its area."""
    near = np.abs((points - corners[0]) @ normal) <= LIFT
    return near & over_triangle(points, corners, normal)


def _hidden_first(
    corners: np.ndarray, areas: np.ndarray, normals: np.ndarray
) -> Iterator[tuple[int, int]]:
    """Pairs of faces (F, 3, 3) that overlap in one plane: the one that does not count, the one that
    does. Rounded areas and coordinates decide, not the order of the faces."""
    in_order = np.lexsort((*np.sort(corners, axis=1).reshape(-1, 9).T, areas.round(6)))
    rank = np.argsort(in_order)
    for one, other in _boxes_that_meet(corners):
        meet = _overlap(corners, normals, one, other)
        one, other = one[meet], other[meet]
        swapped = rank[one] < rank[other]
        yield from zip(
            np.where(swapped, other, one).tolist(),
            np.where(swapped, one, other).tolist(),
            strict=True,
        )


def _boxes_that_meet(corners: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of faces (F, 3, 3) whose boxes come within `LIFT` of each other, in batches: each with
    those that begin, along x, before it ends."""
    low, high = corners.min(axis=1), corners.max(axis=1) + LIFT
    order = np.argsort(low[:, 0], kind="stable")
    count = np.searchsorted(low[order, 0], high[order, 0], "right") - np.arange(len(order)) - 1
    batch = np.cumsum(count) // PAIRS_AT_ONCE
    for rows in np.split(np.arange(len(order)), np.flatnonzero(np.diff(batch)) + 1):
        each = np.repeat(rows, count[rows])
        step = np.arange(len(each)) - np.repeat(np.cumsum(count[rows]) - count[rows], count[rows])
        one, other = order[each], order[each + 1 + step]
        meet = ((low[one] <= high[other]) & (low[other] <= high[one])).all(axis=1)
        yield one[meet], other[meet]


def _overlap(
    corners: np.ndarray, normals: np.ndarray, one: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """(P,) which pairs of faces are parallel, come within `LIFT` of one plane, and overlap by more
    than an edge: no side of either parts them."""
    height = np.einsum("pi,pki->pk", normals[one], corners[other] - corners[one, :1])
    out = (height.min(axis=1) <= LIFT) & (height.max(axis=1) >= -LIFT)
    out &= np.abs((normals[one] * normals[other]).sum(axis=1)) > PARALLEL
    for this, that in ((one, other), (other, one)):
        for k in range(3):
            side = corners[this, (k + 1) % 3] - corners[this, k]
            inward = np.cross(normals[this], side)
            inward /= np.linalg.norm(inward, axis=1, keepdims=True)
            along = np.einsum("pi,pki->pk", inward, corners[that] - corners[this, k, None])
            out &= along.max(axis=1) > TOUCH_M
    return out
