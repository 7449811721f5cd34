"""Paths over two of many planes, by images."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit

EDGE = 0.3
"""How far beyond the edge of a face a reflection is still taken for possible [m]: the planes of a
corner need not meet exactly."""
LEAST_RANGE = 1.0
"""Half of the shortest path that counts [m]."""


@jit
def met(start, end, normals, offsets, low, high, first, last, reach):
    """`images.met` of the city receivers: planes that cannot make a path of a length that counts
    are left out before any point is found."""
    pairs, places, count = np.empty((64, 2), np.int64), np.empty((64, 3, 3)), 0
    once, at_j, A, B = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    before = np.array([_dot(normals[j], end) - offsets[j] for j in last])
    x, y, z = normals[last].T.copy()
    of_last, beyond = offsets[last], np.empty(last.size)
    some = np.empty(last.size, np.int64)
    for i in first:
        n, d = normals[i], offsets[i]
        s, base2 = _dot(n, start) - d, 0.0
        for c in range(3):  # the start's image in i
            once[c] = start[c] - 2 * s * n[c]
            base2 += (once[c] - end[c]) ** 2
        for k in range(last.size):
            beyond[k] = x[k] * once[0] + y[k] * once[1] + z[k] * once[2] - of_last[k]
        # a mirror between two points makes the square of the way between them longer by four times
        # the product of their distances from it
        least = max((2 * LEAST_RANGE) ** 2 - base2, 0.0) / 4
        most, chosen = (reach**2 - base2) / 4, 0
        for k in range(last.size):  # without branches
            some[chosen] = k
            chosen += least < beyond[k] * before[k] < most
        for k in some[:chosen]:
            j = last[k]
            if i == j:
                continue
            for c in range(3):  # the image of the image in j
                at_j[c] = once[c] - 2 * beyond[k] * normals[j, c]
            # from the image behind j to the end before it
            share = beyond[k] / (beyond[k] + before[k])
            if not _within(at_j, end, share, low[j], high[j], B):
                continue
            height = _dot(n, B) - d
            if not height * s > -EDGE * abs(s):
                continue
            if not _within(once, B, s / (s + height), low[i], high[i], A):
                continue
            if count == len(pairs):
                pairs = np.concatenate((pairs, np.empty_like(pairs)))
                places = np.concatenate((places, np.empty_like(places)))
            pairs[count, 0], pairs[count, 1] = i, j
            places[count, 0], places[count, 1], places[count, 2] = A, B, at_j
            count += 1
    return pairs[:count], places[:count]


@jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def _within(a, b, share, low, high, out):
    """Return whether the point at a share of the segment from a to b, put into `out`, is in a box
    or within `EDGE` of it."""
    for c in range(3):
        out[c] = a[c] + (b[c] - a[c]) * share
        if not low[c] - EDGE <= out[c] <= high[c] + EDGE:
            return False
    return True
