"""Medians of powers, by halving the range of their bits: numbers that are not negative are ordered
as their bits are, so that counts, which need no branches, find them to the last bit."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, load, not_above, splat, store


def medians(powers: np.ndarray) -> np.ndarray:
    """(...) float32, `numpy.median` of each line of powers (..., n), none negative."""
    lines = np.ascontiguousarray(powers, np.float32).reshape(-1, powers.shape[-1])
    out = np.empty(len(lines), np.float32)
    _medians(lines, out)
    return out.reshape(powers.shape[:-1])


def median(powers: np.ndarray) -> float:
    """`numpy.median` of float32 powers, none negative."""
    return float(medians(powers.reshape(-1)))


@jit
def _medians(lines, out):
    pivot, lanes = np.empty(1, np.float32), np.empty(LANES, np.float32)
    bits, rank = pivot.view(np.int32), (lines.shape[1] - 1) // 2
    for i in range(len(lines)):
        line, low = lines[i], np.int64(0)
        pivot[0] = line.max()
        high = np.int64(bits[0])
        while low < high:  # the least number that more than `rank` others are not above
            middle = (low + high) // 2
            bits[0] = middle
            if _not_above(line, pivot[0], lanes) > rank:
                high = middle
            else:
                low = middle + 1
        bits[0] = low
        least, following = pivot[0], pivot[0]
        if line.size % 2 == 0 and _not_above(line, least, lanes) == rank + 1:
            following = np.float32(np.inf)
            for value in line:
                following = min(following, value if value > least else np.float32(np.inf))
        out[i] = (least + following) / np.float32(2)


@jit(borrows=True)
def _not_above(line, most, lanes):
    """How many numbers of a line are not above one; `lanes` is work space."""
    value, zero = splat(most), splat(np.float32(0))
    a, b, c, d = zero, zero, zero, zero
    whole = line.size // (4 * LANES) * (4 * LANES)
    for k in range(0, whole, 4 * LANES):  # four sums, so that none waits for the last addition
        a = a + not_above(load(line, k), value)
        b = b + not_above(load(line, k + LANES), value)
        c = c + not_above(load(line, k + 2 * LANES), value)
        d = d + not_above(load(line, k + 3 * LANES), value)
    store(lanes, 0, (a + b) + (c + d))
    count = lanes.sum()
    for k in range(whole, line.size):
        count += np.float32(line[k] <= most)
    return count
