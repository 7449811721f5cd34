r"""Range transforms of many chirps at once: the FFTs of a reception, with what comes before and
after them in the same pass.

.. math:: Y[r, i, p] = g[i, p] \sum_n h[p, n]\, s[r, p, n]\, e^{-j 2 \pi c_i n / N}

Sixteen chirps lie side by side in a table that stays in the second-level cache from the first
factor to the last (`isac_rt.kernels.fourier`); the samples are read once and only the cells that
are wanted are written. `transform_plain` is the same by `scipy.fft`: the oracle, and what is used
for an N that is no product of 8 and twos, threes and fives.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.fft

from isac_rt.kernels import fourier as lanefft
from isac_rt.kernels.fourier import ROW
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import (
    LANES,
    aligned,
    load,
    splat,
    store,
    stream,
    transpose,
    zip_high,
    zip_low,
)


def transform(
    samples: np.ndarray,
    factor: np.ndarray,
    cells: np.ndarray,
    out: np.ndarray,
    *,
    turn: np.ndarray | None = None,
    power: np.ndarray | None = None,
    tapered: np.ndarray | None = None,
) -> None:
    """Cells of the range spectra of one group (module docstring).

    Parameters
    ----------
    samples : (L_rx, P, N) complex64
    factor : (P, N) complex64, h: window, derotation
    cells : (rows,) int, c, modulo N
    out : (L_rx, rows, P) complex64, filled with Y; soonest from an address that is a multiple of 64
        (`isac_rt.kernels.vector.new_memory`)
    turn : (rows, P) complex64, g; None: 1
    power : (P, N) float32, to which sum_r |spectrum|^2 is added over all cells, without g
    tapered : likewise of the samples under Hann's window, which takes half of a cell less a quarter
        of both neighbours
    """
    size = samples.shape[-1]
    try:
        radices, twiddles, order = lanefft.plan(size)
    except ValueError:
        size = 0
    if size == 0 or size % 8:
        transform_plain(samples, factor, cells, out, turn=turn, power=power, tapered=tapered)
        return
    place = order[-np.arange(size) % size] * ROW  # the lane transform turns the other way
    turns = np.zeros((0, 1), np.complex64) if turn is None else turn
    none = np.zeros((0, size), np.float32)
    powers = none if power is None else power, none if tapered is None else tapered
    sizes = size, size, len(turns), *(len(wanted) and size // 2 for wanted in powers)
    _transform(
        _floats(samples),
        _floats(factor),
        _floats(turns),
        powers,
        out.view(np.float32),
        radices,
        twiddles,
        place,
        place[np.asarray(cells) % size],
        _Tables(*(aligned(rows * ROW) for rows in sizes)),
    )


class _Tables(NamedTuple):
    """Work space: sixteen chirps, their factors h, their factors g, and their powers."""

    table: np.ndarray
    factors: np.ndarray
    turns: np.ndarray
    added: np.ndarray
    tapered: np.ndarray


def _floats(values: np.ndarray) -> np.ndarray:
    """Complex values as float32 with real and imaginary parts in turn."""
    return np.ascontiguousarray(values, np.complex64).view(np.float32)


def transform_plain(
    samples: np.ndarray,
    factor: np.ndarray,
    cells: np.ndarray,
    out: np.ndarray,
    *,
    turn: np.ndarray | None = None,
    power: np.ndarray | None = None,
    tapered: np.ndarray | None = None,
) -> None:
    """`transform` with `scipy.fft`, for any N."""
    for r, one in enumerate(samples):
        spectrum = scipy.fft.fft(one * factor, axis=1, workers=1, overwrite_x=True)
        if power is not None:
            power += spectrum.real**2 + spectrum.imag**2
        if tapered is not None:
            beside = np.roll(spectrum, 1, axis=1) + np.roll(spectrum, -1, axis=1)
            tapered += np.abs(spectrum / 2 - beside / 4) ** 2
        out[r] = spectrum[:, np.asarray(cells) % samples.shape[-1]].T
        if turn is not None:
            out[r] *= turn


@jit(borrows=True)
def _transform(samples, factor, turn, powers, out, radices, twiddles, place, at, work):
    """`transform`; complex arrays as `_floats`."""
    table, factors, turns, added, tapered = work
    num_rx, num_chirps, size = samples.shape[0], samples.shape[1], place.size
    lines = samples.reshape(num_rx * num_chirps, 2 * size)
    for first in range(0, num_chirps, LANES):
        count = min(LANES, num_chirps - first)
        _fill(factor, 0, first, count, factors)
        for i in range(turns.size // ROW):
            for lane in range(count):
                turns[i * ROW + lane], turns[i * ROW + LANES + lane] = (
                    turn[i, 2 * (first + lane)],
                    turn[i, 2 * (first + lane) + 1],
                )
        added[:], tapered[:] = 0.0, 0.0
        for r in range(num_rx):
            _fill(lines, r * num_chirps, first, count, table)
            _multiply(table, factors)
            lanefft.transform(table, 0, size, radices, twiddles)
            if added.size:
                _add_power(table, place, added)
            if tapered.size:
                _add_tapered(table, place, tapered)
            _write(table, at, turns, first, count, out[r])
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
def _add_power(table, place, added):
    for k in range(place.size):
        a, b = load(table, place[k]), load(table, place[k] + LANES)
        store(added, k * LANES, load(added, k * LANES) + (a * a + b * b))


@jit(borrows=True)
def _add_tapered(table, place, added):
    half, quarter, last = splat(np.float32(0.5)), splat(np.float32(0.25)), place[-1]
    before, before_im = load(table, last), load(table, last + LANES)
    a, b = load(table, place[0]), load(table, place[0] + LANES)
    for k in range(place.size):
        after = place[k + 1] if k + 1 < place.size else place[0]
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
def _write(table, at, turns, first, count, out):
    """out[i, first + l] = the cells, times g where there is one; past the caches where whole cache
    lines are written, which are not read from memory first then."""
    flat, width, spare = out.reshape(-1), out.shape[1], np.empty(ROW, np.float32)
    whole = out.ctypes.data % 64 == 0 and width % LANES == 0
    for i in range(at.size):
        a, b = load(table, at[i]), load(table, at[i] + LANES)
        if turns.size:
            c, d = load(turns, i * ROW), load(turns, i * ROW + LANES)
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
            store(spare, 0, zip_low(a, b))
            store(spare, LANES, zip_high(a, b))
            flat[to : to + 2 * count] = spare[: 2 * count]
