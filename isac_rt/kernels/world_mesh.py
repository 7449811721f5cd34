"""Kernels of `isac_rt.world.city.mesh`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from isac_rt.kernels.jit import jit

FACES_PER_BATCH = 64
"""Faces that are asked for a plane at once: most are nowhere near it."""


@jit
def group_planes(corners: NDArray, normals: NDArray, offsets: NDArray, tolerance: float) -> NDArray:
    """Plane id per face; faces come sorted by falling area."""
    count = len(corners)
    plane = np.full(count, -1, dtype=np.int64)
    left = np.arange(count)
    # one corner decides most
    x, y, z = corners[:, 0, 0].copy(), corners[:, 0, 1].copy(), corners[:, 0, 2].copy()
    num_open, num_planes = count, 0
    for seed in range(count):
        if plane[seed] >= 0:
            continue
        plane[seed] = num_planes
        num_open -= 1
        nx, ny, nz = normals[seed]
        d = offsets[seed]
        for start in range(0, left.size, FACES_PER_BATCH):
            some = slice(start, start + FACES_PER_BATCH)
            if not _count_near(x[some], y[some], z[some], nx, ny, nz, d, 2 * tolerance):
                continue
            for face in left[some]:
                if plane[face] >= 0:
                    continue
                inside = True
                for k in range(3):
                    a, b, c = corners[face, k]
                    inside = inside and abs(nx * a + ny * b + nz * c - d) <= tolerance
                if inside:
                    plane[face] = num_planes
                    num_open -= 1
        num_planes += 1
        if 8 * num_open < 7 * left.size:
            still = plane[left] < 0
            left, x, y, z = left[still], x[still], y[still], z[still]
    return plane


@jit(fast=True)  # type: ignore[untyped-decorator]  # numba has no types
def _count_near(
    x: NDArray, y: NDArray, z: NDArray, nx: float, ny: float, nz: float, d: float, most: float
) -> int:
    """Count the points near a plane up to rounding; the compiler vectorises it."""
    count = 0
    for i in range(x.size):
        count += abs(nx * x[i] + ny * y[i] + nz * z[i] - d) <= most
    return count
