"""Kernels of `isac_rt.propagation.legs.rays`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit

LIFT = 2e-3
"""Rays start this far from the surface and end as far before the viewer [m]; float32 corners and
rays are good to a tenth of it."""
SURE, GRAZING = 1e-2, 2e-2
"""A triangle surely stops a ray that meets it this far inside [m] and at this sine or more: in
float32 rays are good to 0.05 mm in a city."""


@jit(borrows=True)
def hides(sides, row, box, places, points, out):
    """Note in `out` whether the triangle of each point (N, 3), -1: none, surely hides it from all
    places: from the corners of the box (8, 3) about them, and so from all within, or else from one
    by one."""
    for k in range(row.size):
        if row[k] >= 0:
            side = sides[row[k]]
            out[k] = _hidden_from(side, points[k], box) or _hidden_from(side, points[k], places)


@jit(inline=True)
def _hidden_from(side, point, places):
    """Return whether a triangle surely occludes a point from all places: their rays do not graze
    it, and meet it farther than `SURE` inside its sides and from both ends, even if they leave the
    point `LIFT` aside. Each condition is linear or convex in the place, so it holds between places
    where it holds."""
    x, y, z = point
    (ax, ay, az, a), (bx, by, bz, b), (cx, cy, cz, c), (dx, dy, dz, d) = side
    level = x * ax + y * ay + z * az - a
    across, before = -np.sign(level), abs(level)
    one, two, three = (
        x * bx + y * by + z * bz - b,
        x * cx + y * cy + z * cz - c,
        x * dx + y * dy + z * dz - d,
    )
    hidden = before > SURE
    for n in range(len(places)):
        if not hidden:
            break
        px, py, pz = places[n]
        after = across * (px * ax + py * ay + pz * az - a)
        length = np.sqrt((px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2)
        least = SURE * (before + after) + LIFT * length
        hidden = (
            after > LIFT + SURE
            and before + after > GRAZING * length
            and one * after + (px * bx + py * by + pz * bz - b) * before > least
            and two * after + (px * cx + py * cy + pz * cz - c) * before > least
            and three * after + (px * dx + py * dy + pz * dz - d) * before > least
        )
    return hidden
