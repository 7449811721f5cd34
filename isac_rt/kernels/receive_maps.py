"""Tones, range-Doppler maps, and the background of their cells."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import (
    PART,
    backwards,
    load_part,
    splat_part,
    store,
    zip_high,
    zip_low,
)

ROWS = 24
"""Range cells of an antenna, all groups' chirps, that stay in the second-level cache."""


@jit(borrows=True)
def make_maps(flat, shape, ends, index, factors, workspace, maps, buffer, power):
    """`isac_rt.receive.maps.make_maps`; unsigned places, so that no index is checked for its sign.

    An operator is a real matrix before the DFT, so that its rows of opposite bins are conjugates.
    With a + j b such a row and x + j y the samples, both bins follow from a x, b x, a y and b y:
    half of the multiplications. A block of bins stays in the first-level cache for some rows, and
    what is made of these in `workspace`.
    """
    num_rx, num_rows, num_chirps = shape[1:]
    size, operators = factors.shape[0] * PART, factors.reshape(-1)
    for rx in range(num_rx):
        for first in range(0, num_rows, ROWS):
            last = min(first + ROWS, num_rows)
            for tx in range(ends.size - 1):
                # bins of an antenna's chirps, block by block, three rows at once
                sent = index[ends[tx] : ends[tx + 1]]
                for block in range(factors.shape[0]):
                    at = (block * factors.shape[1] + ends[tx]) * 2 * PART
                    for i in range(first, last, 3):
                        rows = i, min(i + 1, last - 1), min(i + 2, last - 1)
                        samples = flat, rx * num_rows, 2 * num_chirps
                        _three_rows(
                            samples, rows, sent, operators, at, workspace, first, (size, block)
                        )
                # bins in order, and the power added
                lines = maps[tx, rx, first:last] if maps.shape[0] else buffer[: last - first]
                for i in range(last - first):
                    made = workspace[4 * i * size : 4 * (i + 1) * size]
                    _join_bins(made.view(np.complex64), lines[i])
                _add_power(power[first:last], lines)


@jit(borrows=True)
def _three_rows(samples, rows, index, operators, at, workspace, first, part):
    """A block of bins and the opposite ones, of three rows at once: their twelve sums, both factors
    and a sample's two parts fill the registers of a processor that has sixteen."""
    flat, before, step = samples
    r0, r1, r2 = (
        np.uint64((before + rows[0]) * step),
        np.uint64((before + rows[1]) * step),
        np.uint64((before + rows[2]) * step),
    )
    zero, imag = splat_part(np.float32(0)), np.uint64(1)
    ax0, bx0, ay0, by0 = zero, zero, zero, zero
    ax1, bx1, ay1, by1 = zero, zero, zero, zero
    ax2, bx2, ay2, by2 = zero, zero, zero, zero
    for s in range(index.size):
        p, a, b = index[s], load_part(operators, at), load_part(operators, at + PART)
        x, y = flat[r0 + p], flat[r0 + p + imag]
        ax0, bx0, ay0, by0 = ax0 + a * x, bx0 + b * x, ay0 + a * y, by0 + b * y
        x, y = flat[r1 + p], flat[r1 + p + imag]
        ax1, bx1, ay1, by1 = ax1 + a * x, bx1 + b * x, ay1 + a * y, by1 + b * y
        x, y = flat[r2 + p], flat[r2 + p + imag]
        ax2, bx2, ay2, by2 = ax2 + a * x, bx2 + b * x, ay2 + a * y, by2 + b * y
        at += 2 * PART
    _keep_both(workspace, rows[0] - first, part, ax0, bx0, ay0, by0)
    _keep_both(workspace, rows[1] - first, part, ax1, bx1, ay1, by1)
    _keep_both(workspace, rows[2] - first, part, ax2, bx2, ay2, by2)


@jit(inline=True)
def _keep_both(workspace, row, part, ax, bx, ay, by):
    """Write a block of bins to a row's part of `workspace`, and the opposite bins, the lowest
    first, at its end."""
    size, block = part
    begin = 4 * row * size + 2 * block * PART
    end = 4 * (row + 1) * size - 2 * (block + 1) * PART
    re, im = ax - by, bx + ay  # (a + j b)(x + j y)
    store(workspace, begin, zip_low(re, im))
    store(workspace, begin + PART, zip_high(re, im))
    re, im = backwards(ax + by), backwards(ay - bx)  # (a - j b)(x + j y)
    store(workspace, end, zip_low(re, im))
    store(workspace, end + PART, zip_high(re, im))


@jit(borrows=True)
def _join_bins(made, line):
    """Bins in FFT order from what `_keep_both` wrote, the last of which is bin 0 again."""
    half, before = line.size // 2 + 1, made.size - 1 - line.size
    for k in range(half):
        line[k] = made[k]
    for k in range(half, line.size):
        line[k] = made[before + k]


# no fused products: which of two is fused the compiler may decide anew, and bits would differ
# between processes
@jit(borrows=True)
def _add_power(power, values):
    """power += |values|^2 of two matrices, float32 and complex64."""
    for i in range(power.shape[0]):
        for j in range(power.shape[1]):
            power[i, j] += values[i, j].real ** 2 + values[i, j].imag ** 2


@jit
def background(power, keep, sides, guard, half, least, out):
    """`isac_rt.receive.cfar.fill_background`."""
    num_rows, num_bins = power.shape
    # sums of the first 0, 1, ... rows over the bins about each
    total = np.zeros((num_rows + 1, num_bins))
    held = np.zeros((num_rows + 1, num_bins), np.int64)
    for r in range(num_rows):
        value, count = 0.0, 0
        for p in range(-half, num_bins + half):
            if keep[r, p % num_bins]:
                value += power[r, p % num_bins]
                count += 1
            if p >= half:
                total[r + 1, p - half] = total[r, p - half] + value
                held[r + 1, p - half] = held[r, p - half] + count
                last = (p - 2 * half) % num_bins
                if keep[r, last]:
                    value -= power[r, last]
                    count -= 1
    for r in range(num_rows):
        for p in range(num_bins):
            level = -np.inf
            for side in range(2):
                rows = sides[r, side]
                first = r + guard + 1 if side else r - guard - rows
                if rows > 0:
                    cells = held[first + rows, p] - held[first, p]
                    if cells >= least * rows * (2 * half + 1):
                        mean = (total[first + rows, p] - total[first, p]) / max(cells, 1)
                        level = max(level, mean)
            out[r, p] = level if level > -np.inf else np.inf
