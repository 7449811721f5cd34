"""Overlapping surfaces, such as a building part on its building's wall or a road on the ground:
each point of them scatters once.

Shadow rays occlude a surface that lies more than `RAY_OFFSET_M` behind another. Nearer surfaces
count as one here, represented by the smaller face, which has more detail.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from isac_rt.propagation.clutter.cells import Cells
from isac_rt.propagation.segments.geometry import RAY_OFFSET_M
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import over_triangle

PARALLEL = 0.999
"""Least cosine between the normals of faces that may be one surface: others cross in a strip of
some centimetres."""
TOUCH_M = 1e-6
"""Largest overlap of faces that only share an edge [m]."""
PAIRS_AT_ONCE = 1_000_000
"""Pairs of faces in one batch, about 0.2 GB."""


def lies_twice(cells: Cells, city: CityMesh) -> np.ndarray:
    """Mark the cells (N,) whose point lies on another scattering face too, which represents it."""
    # points by face, ascending in x, so that each pair of faces tests a slice of them
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
        face = slice(begin[lower], begin[lower + 1])
        near = face.start + np.arange(*np.searchsorted(points[face, 0], [low, high]))
        covered[order[near]] |= _inside(points[near], corners[upper], normals[upper])
    return covered


def _inside(points: np.ndarray, corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Mark the points (N, 3) within `RAY_OFFSET_M` of a triangle (3, 3), above or below it."""
    near = np.abs((points - corners[0]) @ normal) <= RAY_OFFSET_M
    return near & over_triangle(points, corners, normal)


def _lower_first(
    corners: np.ndarray, areas: np.ndarray, normals: np.ndarray
) -> Iterator[tuple[int, int]]:
    """Yield pairs of faces (F, 3, 3) that overlap in one plane, the larger first: the second one
    scatters. Rounded areas, then coordinates decide, and never the order of the faces."""
    in_order = np.lexsort((*np.sort(corners, axis=1).reshape(-1, 9).T, areas.round(6)))
    rank = np.argsort(in_order)
    for pairs in _boxes_that_meet(corners):
        a, b = (faces[_overlap(corners, normals, *pairs)] for faces in pairs)
        swapped = rank[a] < rank[b]
        yield from zip(
            np.where(swapped, b, a).tolist(), np.where(swapped, a, b).tolist(), strict=True
        )


def _boxes_that_meet(corners: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of faces (F, 3, 3) whose bounding boxes are within `RAY_OFFSET_M`, in batches."""
    # sweep along x: a face meets those after it that begin before it ends
    low, high = corners.min(axis=1), corners.max(axis=1) + RAY_OFFSET_M
    order = np.argsort(low[:, 0], kind="stable")
    count = np.searchsorted(low[order, 0], high[order, 0], "right") - np.arange(len(order)) - 1
    batch = np.cumsum(count) // PAIRS_AT_ONCE
    for rows in np.split(np.arange(len(order)), np.flatnonzero(np.diff(batch)) + 1):
        first = np.repeat(rows, count[rows])
        step = np.arange(len(first)) - np.repeat(np.cumsum(count[rows]) - count[rows], count[rows])
        a, b = order[first], order[first + 1 + step]
        meet = ((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)
        yield a[meet], b[meet]


def _overlap(corners: np.ndarray, normals: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mark the pairs (P,) of faces `a` and `b` that are parallel, within `RAY_OFFSET_M` of one
    plane, and overlap beyond an edge."""
    height = np.einsum("pi,pki->pk", normals[a], corners[b] - corners[a, :1])
    out = (height.min(axis=1) <= RAY_OFFSET_M) & (height.max(axis=1) >= -RAY_OFFSET_M)
    out &= np.abs((normals[a] * normals[b]).sum(axis=1)) > PARALLEL
    # separating-axis test: no side of either has the other face wholly outside
    for face, tested in ((a, b), (b, a)):
        for k in range(3):
            side = corners[face, (k + 1) % 3] - corners[face, k]
            inward = np.cross(normals[face], side)
            inward /= np.linalg.norm(inward, axis=1, keepdims=True)
            along = np.einsum("pi,pki->pk", inward, corners[tested] - corners[face, k, None])
            out &= along.max(axis=1) > TOUCH_M
    return out
