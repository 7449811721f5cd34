"""Range transforms of sixteen chirps side by side, with what comes before and after them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.kernels import fourier as lanefft
from isac_rt.kernels.fourier import ROW
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, load, splat, store, stream, transpose, zip_high, zip_low


class Tables(NamedTuple):
    """Work space: sixteen chirps, their factors h, their factors g, and their powers."""

    table: np.ndarray
    factors: np.ndarray
    phasors: np.ndarray
    added: np.ndarray
    tapered: np.ndarray


@jit(borrows=True)
def transform(samples, factor, phasor, powers, out, radices, twiddles, lane_order, at, work):
    """`isac_rt.receive.spectrum.fill_cells`."""
    table, factors, phasors, added, tapered = work
    num_rx, num_chirps, size = samples.shape[0], samples.shape[1], lane_order.size
    lines = samples.reshape(num_rx * num_chirps, 2 * size)
    zero = np.int64(0)  # a bare 0 has what it is given to compiled for 0 too
    for first in range(0, num_chirps, LANES):
        count = min(LANES, num_chirps - first)
        _fill(factor, zero, first, count, factors)
        for i in range(phasors.size // ROW):
            for lane in range(count):
                phasors[i * ROW + lane], phasors[i * ROW + LANES + lane] = (
                    phasor[i, 2 * (first + lane)],
                    phasor[i, 2 * (first + lane) + 1],
                )
        added[:], tapered[:] = 0.0, 0.0
        for r in range(num_rx):
            _fill(lines, r * num_chirps, first, count, table)
            _multiply(table, factors)
            lanefft.transform(table, zero, size, radices, twiddles)
            if added.size:
                _add_power(table, lane_order, added)
            if tapered.size:
                _add_tapered(table, lane_order, tapered)
            _write(table, at, phasors, first, count, out[r])
        _unload(added, first, count, powers[0])
        _unload(tapered, first, count, powers[1])


@jit(borrows=True)
def _fill(lines, offset, first, count, table):
    """Row n of the table: sample n of the chirps `first` to `first + count`; 16 numbers of 16
    chirps are turned over at a time."""
    lanes = lines.shape[1]
    flat = lines.reshape(-1)
    for n in range(0, lanes, LANES):
        for lane in range(count):
            store(table, (n + lane) * LANES, load(flat, (offset + first + lane) * lanes + n))
        for lane in range(count, LANES):
            table[(n + lane) * LANES : (n + lane + 1) * LANES] = 0.0
        transpose(table, n * LANES)


@jit(borrows=True)
def _multiply(table, factors):
    for i in range(0, table.size, ROW):
        a, b, c, d = (
            load(table, i),
            load(table, i + LANES),
            load(factors, i),
            load(factors, i + LANES),
        )
        store(table, i, a * c - b * d)
        store(table, i + LANES, a * d + b * c)


@jit(borrows=True)
def _add_power(table, lane_order, added):
    for k in range(lane_order.size):
        a, b = load(table, lane_order[k]), load(table, lane_order[k] + LANES)
        store(added, k * LANES, load(added, k * LANES) + (a * a + b * b))


@jit(borrows=True)
def _add_tapered(table, lane_order, added):
    half, quarter, last = splat(np.float32(0.5)), splat(np.float32(0.25)), lane_order[-1]
    before, before_im = load(table, last), load(table, last + LANES)
    a, b = load(table, lane_order[0]), load(table, lane_order[0] + LANES)
    for k in range(lane_order.size):
        after = lane_order[k + 1] if k + 1 < lane_order.size else lane_order[0]
        c, d = load(table, after), load(table, after + LANES)
        re = half * a - quarter * (before + c)
        im = half * b - quarter * (before_im + d)
        store(added, k * LANES, load(added, k * LANES) + (re * re + im * im))
        before, before_im, a, b = a, b, c, d


@jit(borrows=True)
def _unload(added, first, count, power):
    """Add what chirps `first` to `first + count` have to their `power`."""
    for k in range(added.size // LANES):
        for lane in range(count):
            power[first + lane, k] += added[k * LANES + lane]


@jit
def _write(table, at, phasors, first, count, out):
    """out[i, first + l] = the cells, times g where there is one; past the caches where whole cache
    lines are written, which are not read from memory first then."""
    flat, width, buffer = out.reshape(-1), out.shape[1], np.empty(ROW, np.float32)
    whole = out.ctypes.data % 64 == 0 and width % LANES == 0
    for i in range(at.size):
        a, b = load(table, at[i]), load(table, at[i] + LANES)
        if phasors.size:
            c, d = load(phasors, i * ROW), load(phasors, i * ROW + LANES)
            a, b = a * c - b * d, a * d + b * c
        to = i * width + 2 * first
        if whole and count % (LANES // 2) == 0:
            stream(flat, to, zip_low(a, b))
            if count == LANES:
                stream(flat, to + LANES, zip_high(a, b))
        elif count == LANES:
            store(flat, to, zip_low(a, b))
            store(flat, to + LANES, zip_high(a, b))
        else:
            store(buffer, 0, zip_low(a, b))
            store(buffer, LANES, zip_high(a, b))
            flat[to : to + 2 * count] = buffer[: 2 * count]
