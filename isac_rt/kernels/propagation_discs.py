"""Kernel of `isac_rt.propagation.segments.discs`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit


@jit
def near(starts, ends, before, total, positions, radii, spared, wavelength, reach):
    """Find the path segments (K,) that pass a disc (N,) within reach of its edge.

    Returns
    -------
    segment and disc of each pass, distance of the disc's centre and distance along the path [m]
    """
    which, disc = [0 for _ in range(0)], [0 for _ in range(0)]
    off, along = [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for i in range(len(total)):
        sx, sy, sz = ends[i, 0] - starts[i, 0], ends[i, 1] - starts[i, 1], ends[i, 2] - starts[i, 2]
        square = sx * sx + sy * sy + sz * sz
        row = i if len(spared) > 1 else 0
        for n in range(len(radii)):
            wx, wy = positions[n, 0] - starts[i, 0], positions[n, 1] - starts[i, 1]
            wz, radius = positions[n, 2] - starts[i, 2], radii[n]
            dot = sx * wx + sy * wy + sz * wz
            if dot <= 0 or dot >= square or spared[row, n]:
                continue
            away = wx * wx + wy * wy + wz * wz
            across = away - dot * dot / square
            # a Fresnel unit is at most that of an endless path
            edge = radius + reach * np.sqrt(wavelength * (before[i] + np.sqrt(away) + radius) / 2)
            if across > edge * edge:
                continue
            at = before[i] + dot / np.sqrt(square)
            first, rest = max(at, radius), max(total[i] - at, radius)
            h = np.sqrt(max(across, 0.0))
            if h - radius < reach * np.sqrt(wavelength * first * rest / (2 * (first + rest))):
                which.append(i)
                disc.append(n)
                off.append(h)
                along.append(at)
    return np.array(which, np.int64), np.array(disc, np.int64), np.array(off), np.array(along)
