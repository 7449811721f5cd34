"""Overlapping surfaces, such as a building part on its building's wall or a road on the ground:
each point of them scatters once.

Of surfaces farther apart than `RAY_OFFSET_M`, shadow rays see the front one alone. Nearer ones
count as one surface here, represented by the smaller face, which has more detail.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from isac_rt.propagation.clutter.cells import Cells
from isac_rt.propagation.segments.geometry import RAY_OFFSET_M
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import over_triangle

PARALLEL = 0.999
"""Cosine between the normals of faces that may be one surface: steeper ones cross in a strip of
some centimetres."""
TOUCH_M = 1e-6
"""Faces that overlap by less only share an edge. [m]"""
PAIRS_AT_ONCE = 1_000_000


def lies_twice(cells: Cells, city: CityMesh) -> np.ndarray:
    """Mark the cells (N,) whose point another scattering face covers and represents."""
    faces, row = np.unique(cells.face, return_inverse=True)
    corners, normals = city.corners[faces], city.normals[faces]
    order = np.lexsort((cells.points[:, 0], row))
    points, begin = cells.points[order], np.searchsorted(row[order], np.arange(len(faces) + 1))
    covered = np.zeros(len(cells), bool)
    for lower, upper in _lower_first(corners, city.areas[faces], normals):
        low, high = (
            corners[upper, :, 0].min() - RAY_OFFSET_M,
            corners[upper, :, 0].max() + RAY_OFFSET_M,
        )
        of = slice(begin[lower], begin[lower + 1])
        some = of.start + np.arange(*np.searchsorted(points[of, 0], [low, high]))
        covered[order[some]] |= _inside(points[some], corners[upper], normals[upper])
    return covered


def _inside(points: np.ndarray, corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Mark the points (N, 3) within `RAY_OFFSET_M` of a triangle (3, 3), over its area."""
    near = np.abs((points - corners[0]) @ normal) <= RAY_OFFSET_M
    return near & over_triangle(points, corners, normal)


def _lower_first(
    corners: np.ndarray, areas: np.ndarray, normals: np.ndarray
) -> Iterator[tuple[int, int]]:
    """Yield pairs of faces (F, 3, 3) that overlap in one plane: the lower left out, the upper kept.
    Rounded areas and coordinates decide, not the order of the faces."""
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
    """Yield pairs of faces (F, 3, 3) whose boxes are within `RAY_OFFSET_M`, in batches, by a sweep
    along x."""
    low, high = corners.min(axis=1), corners.max(axis=1) + RAY_OFFSET_M
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
    """Mark the pairs (P,) that are parallel, within `RAY_OFFSET_M` of one plane, and overlap beyond
    an edge (separating-axis test over the sides of both)."""
    height = np.einsum("pi,pki->pk", normals[one], corners[other] - corners[one, :1])
    out = (height.min(axis=1) <= RAY_OFFSET_M) & (height.max(axis=1) >= -RAY_OFFSET_M)
    out &= np.abs((normals[one] * normals[other]).sum(axis=1)) > PARALLEL
    for this, that in ((one, other), (other, one)):
        for k in range(3):
            side = corners[this, (k + 1) % 3] - corners[this, k]
            inward = np.cross(normals[this], side)
            inward /= np.linalg.norm(inward, axis=1, keepdims=True)
            along = np.einsum("pi,pki->pk", inward, corners[that] - corners[this, k, None])
            out &= along.max(axis=1) > TOUCH_M
    return out
