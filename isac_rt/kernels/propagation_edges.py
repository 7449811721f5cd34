"""Kernels of `isac_rt.propagation.segments.edges`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit

MOST_TRIED = 24
"""Edges near a path, the shortest detours first, that are tried."""


@jit(inline=True)
def _off(position, source, ahead, length):
    """Square of the distance of a place from the straight way of a length from a source."""
    x, y, z = position[0] - source[0], position[1] - source[1], position[2] - source[2]
    along = min(max(x * ahead[0] + y * ahead[1] + z * ahead[2], 0.0), length)
    x, y, z = x - along * ahead[0], y - along * ahead[1], z - along * ahead[2]
    return x * x + y * y + z * z


@jit
def near(edges, source, sink, reach):
    """Silhouette edges near a path: detours [m] (at most `reach`, shortest first), points on the
    edges, directions away from what they bound."""
    start, span, wings, middle, halves, blocks, centre, radius = edges
    ahead = sink - source
    length = np.sqrt((ahead**2).sum())
    ahead = ahead / length
    aside = (
        np.sqrt(reach * (reach + 2 * length)) / 2
    )  # half the width of the ellipsoid of all points within reach
    detours, which, where = [0.0 for _ in range(0)], [0 for _ in range(0)], [0.0 for _ in range(0)]
    near = [0 for _ in range(0)]
    for b in range(blocks.shape[0]):
        if _off(centre[b], source, ahead, length) <= (radius[b] + aside + reach) ** 2:
            for i in blocks[b]:
                if (
                    i >= 0
                    and _off(middle[i], source, ahead, length) <= (halves[i] + aside + reach) ** 2
                ):
                    near.append(i)
    for i in sorted(near):
        half = halves[i]
        unit = span[i] / (2 * half)
        a, b = source - start[i], sink - start[i]
        sa, sb = (a * unit).sum(), (b * unit).sum()
        pa, pb = np.sqrt(max((a * a).sum() - sa**2, 0.0)), np.sqrt(max((b * b).sum() - sb**2, 0.0))
        if pa + pb < 1e-9:
            continue
        t = min(
            max((sa * pb + sb * pa) / (pa + pb), 0.0), 2 * half
        )  # Fermat: equal angles with the edge
        point = start[i] + t * unit
        detour = (
            np.sqrt(((point - source) ** 2).sum()) + np.sqrt(((point - sink) ** 2).sum()) - length
        )
        if detour > reach:
            continue
        normal = np.cross(unit, ahead)
        size = np.sqrt((normal**2).sum())
        if size < 1e-6:
            continue
        left, right = (
            ((wings[i, 0] - start[i]) * normal).sum(),
            ((wings[i, 1] - start[i]) * normal).sum(),
        )
        if left * right <= 0:
            continue
        detours.append(detour)
        which.append(i)
        where.append(t if left < 0 else -t - 1e-300)
    order = np.argsort(np.array(detours))[:MOST_TRIED]
    out = np.empty(order.size), np.empty((order.size, 3)), np.empty((order.size, 3))
    for row in range(order.size):
        i, t = which[order[row]], where[order[row]]
        unit = span[i] / np.sqrt((span[i] ** 2).sum())
        normal = np.cross(unit, ahead)
        out[0][row] = detours[order[row]]
        out[1][row] = start[i] + abs(t) * unit
        out[2][row] = normal / np.sqrt((normal**2).sum()) * (-1.0 if t < 0 else 1.0)
    return out
