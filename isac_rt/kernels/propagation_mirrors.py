"""Kernels of `isac_rt.propagation.clutter.mirrors`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit

APART = 0.01
"""A point this near to the plane of a mirror [m] does not show in it: it lies on the wall, or in
its corner."""


@jit
def on_the_wall(points, place, normal, offset, corners):
    """Points on the viewer's side of a mirror whose way to it meets one of its triangles, and
    where."""
    above = (normal * place).sum() - offset
    which, where = [0 for _ in range(0)], [0.0 for _ in range(0)]
    low, high = np.empty(3), np.empty(3)
    for k in range(3):
        low[k], high[k] = corners[:, :, k].min() - 1e-6, corners[:, :, k].max() + 1e-6
    foot = place - above * normal
    for i in range(points.shape[0]):
        up = points[i, 0] * normal[0] + points[i, 1] * normal[1] + points[i, 2] * normal[2] - offset
        if up * above <= 0 or abs(up) < APART or abs(above) < APART:
            continue
        share = above / (above + up)
        x = foot[0] + share * (points[i, 0] - up * normal[0] - foot[0])
        y = foot[1] + share * (points[i, 1] - up * normal[1] - foot[1])
        z = foot[2] + share * (points[i, 2] - up * normal[2] - foot[2])
        if x < low[0] or x > high[0] or y < low[1] or y > high[1] or z < low[2] or z > high[2]:
            continue
        for t in range(corners.shape[0]):
            if _inside(x, y, z, corners[t], normal):
                which.append(i)
                where.append(x)
                where.append(y)
                where.append(z)
                break
    return np.array(which, np.int32), np.array(where).reshape(-1, 3)


@jit(inline=True)
def _inside(x, y, z, corners, normal):
    """Return whether a point of the plane is in a triangle of either winding; seams belong to both
    sides."""
    least, most = np.inf, -np.inf
    for k in range(3):
        a, b = corners[k], corners[(k + 1) % 3]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        px, py, pz = x - a[0], y - a[1], z - a[2]
        turn = (
            (ey * pz - ez * py) * normal[0]
            + (ez * px - ex * pz) * normal[1]
            + (ex * py - ey * px) * normal[2]
        )
        least, most = min(least, turn), max(most, turn)
    return least >= -1e-9 or most <= 1e-9
