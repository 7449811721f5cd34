"""Inverse Fourier transform down the rows of a table whose columns are 16 channels, in place, all
channels at once.

A row is 16 real and 16 imaginary parts. The channels are the lanes, so no butterfly needs a
shuffle, and a table of 1280 rows (160 KB) stays in the second-level cache. Decimation in frequency;
the result is left in digit-reversed order (`order`): who reads it picks its rows.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, PART, load_part, store

ROW = 32  # float32 numbers in a row
NEAR = 256
"""Rows that stay in the first-level cache (32 KB)."""
_C3 = np.float32(np.cos(2 * np.pi / 3))
_S3 = np.float32(np.sin(2 * np.pi / 3))
_C8 = np.float32(np.sqrt(0.5))
_C5, _D5 = np.float32(np.cos(2 * np.pi / 5)), np.float32(np.cos(4 * np.pi / 5))
_S5, _T5 = np.float32(np.sin(2 * np.pi / 5)), np.float32(np.sin(4 * np.pi / 5))


@lru_cache(maxsize=16)
def plan(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radices, twiddle factors and row order of a transform of `size` = 2^a 3^b 5^c rows.

    Returns
    -------
    radices : (S,) int64, first stage first
    twiddles : float32, for each stage of length L and radix r: exp(+j 2 pi i k/L), i < L/r, k = 1
        .. r-1 (real, imaginary)
    order : (size,) int64, the row that holds output k
    """
    # factors: 5 and 3, then 8 as often as possible with some 4, or 2
    left, radices = size, []
    for r in (5, 3):
        while left % r == 0:
            radices.append(r)
            left //= r
    twos = left.bit_length() - 1
    if left != 1 << twos:
        raise ValueError(f"a lane transform of {size} rows: only factors 2, 3 and 5 can be done")
    fours = -twos % 3
    radices += [2] if twos == 1 else [4] * fours + [8] * ((twos - 2 * fours) // 3)
    parts, order, length, rest = (
        [np.zeros(0, np.complex64)],
        np.zeros(size, np.int64),
        size,
        np.arange(size),
    )
    # twiddles stage by stage; the digit-reversed place of each output
    for r in radices:
        i, k = np.arange(length // r)[:, None], np.arange(1, r)[None, :]
        parts.append(np.exp(2j * np.pi * i * k / length).astype(np.complex64).ravel())
        order += rest % r * (length // r)
        rest, length = rest // r, length // r
    return np.array(radices, np.int64), np.concatenate(parts).view(np.float32), order


@jit(inline=True)
def _put(table, at, re, im, twiddles, t):
    """Store re + j im times a twiddle factor."""
    c, s = twiddles[t], twiddles[t + 1]
    store(table, at, c * re - s * im)
    store(table, at + 16, s * re + c * im)


@jit(inline=True)
def _two(table, at, step, twiddles, t):
    ar, ai, br, bi = (
        load_part(table, at),
        load_part(table, at + 16),
        load_part(table, at + step),
        load_part(table, at + step + 16),
    )
    store(table, at, ar + br)
    store(table, at + 16, ai + bi)
    _put(table, at + step, ar - br, ai - bi, twiddles, t)


@jit(inline=True)
def _three(table, at, step, twiddles, t):
    ar, ai = load_part(table, at), load_part(table, at + 16)
    br, bi = load_part(table, at + step), load_part(table, at + step + 16)
    cr, ci = load_part(table, at + 2 * step), load_part(table, at + 2 * step + 16)
    sr, si, dr, di = br + cr, bi + ci, _S3 * (br - cr), _S3 * (bi - ci)
    mr, mi = ar + _C3 * sr, ai + _C3 * si
    store(table, at, ar + sr)
    store(table, at + 16, ai + si)
    _put(table, at + step, mr - di, mi + dr, twiddles, t)
    _put(table, at + 2 * step, mr + di, mi - dr, twiddles, t + 2)


@jit(inline=True)
def _quarters(ar, ai, br, bi, cr, ci, dr, di):
    """Outputs 0, 2, 1 and 3 of a transform of four rows."""
    pr, pi, mr, mi = ar + cr, ai + ci, ar - cr, ai - ci
    qr, qi, nr, ni = br + dr, bi + di, br - dr, bi - di
    return pr + qr, pi + qi, pr - qr, pi - qi, mr - ni, mi + nr, mr + ni, mi - nr


@jit(inline=True)
def _four(table, at, step, twiddles, t):
    ar, ai = load_part(table, at), load_part(table, at + 16)
    br, bi = load_part(table, at + step), load_part(table, at + step + 16)
    cr, ci = load_part(table, at + 2 * step), load_part(table, at + 2 * step + 16)
    dr, di = load_part(table, at + 3 * step), load_part(table, at + 3 * step + 16)
    ar, ai, cr, ci, br, bi, dr, di = _quarters(ar, ai, br, bi, cr, ci, dr, di)
    store(table, at, ar)
    store(table, at + 16, ai)
    _put(table, at + step, br, bi, twiddles, t)
    _put(table, at + 2 * step, cr, ci, twiddles, t + 2)
    _put(table, at + 3 * step, dr, di, twiddles, t + 4)


@jit(inline=True)
def _eight(table, at, step, twiddles, t):
    ar, ai = load_part(table, at), load_part(table, at + 16)
    br, bi = load_part(table, at + step), load_part(table, at + step + 16)
    cr, ci = load_part(table, at + 2 * step), load_part(table, at + 2 * step + 16)
    dr, di = load_part(table, at + 3 * step), load_part(table, at + 3 * step + 16)
    er, ei = load_part(table, at + 4 * step), load_part(table, at + 4 * step + 16)
    fr, fi = load_part(table, at + 5 * step), load_part(table, at + 5 * step + 16)
    gr, gi = load_part(table, at + 6 * step), load_part(table, at + 6 * step + 16)
    hr, hi = load_part(table, at + 7 * step), load_part(table, at + 7 * step + 16)
    ar, ai, er, ei = ar + er, ai + ei, ar - er, ai - ei
    br, bi, fr, fi = br + fr, bi + fi, br - fr, bi - fi
    cr, ci, gr, gi = cr + gr, ci + gi, cr - gr, ci - gi
    dr, di, hr, hi = dr + hr, di + hi, dr - hr, di - hi
    ar, ai, cr, ci, br, bi, dr, di = _quarters(ar, ai, br, bi, cr, ci, dr, di)
    store(table, at, ar)
    store(table, at + 16, ai)
    _put(table, at + 2 * step, br, bi, twiddles, t + 2)
    _put(table, at + 4 * step, cr, ci, twiddles, t + 6)
    _put(table, at + 6 * step, dr, di, twiddles, t + 10)
    fr, fi = _C8 * (fr - fi), _C8 * (fr + fi)  # an eighth of a turn
    gr, gi = np.float32(-1) * gi, gr
    hr, hi = -_C8 * (hr + hi), _C8 * (hr - hi)
    er, ei, gr, gi, fr, fi, hr, hi = _quarters(er, ei, fr, fi, gr, gi, hr, hi)
    _put(table, at + step, er, ei, twiddles, t)
    _put(table, at + 3 * step, fr, fi, twiddles, t + 4)
    _put(table, at + 5 * step, gr, gi, twiddles, t + 8)
    _put(table, at + 7 * step, hr, hi, twiddles, t + 12)


@jit(inline=True)
def _five(table, at, step, twiddles, t):
    ar, ai = load_part(table, at), load_part(table, at + 16)
    br, bi = load_part(table, at + step), load_part(table, at + step + 16)
    cr, ci = load_part(table, at + 2 * step), load_part(table, at + 2 * step + 16)
    dr, di = load_part(table, at + 3 * step), load_part(table, at + 3 * step + 16)
    er, ei = load_part(table, at + 4 * step), load_part(table, at + 4 * step + 16)
    pr, pi, mr, mi = br + er, bi + ei, br - er, bi - ei
    qr, qi, nr, ni = cr + dr, ci + di, cr - dr, ci - di
    store(table, at, ar + pr + qr)
    store(table, at + 16, ai + pi + qi)
    c, d, s, u = _C5, _D5, _S5, _T5
    xr, xi, yr, yi = ar + c * pr + d * qr, ai + c * pi + d * qi, s * mr + u * nr, s * mi + u * ni
    _put(table, at + step, xr - yi, xi + yr, twiddles, t)
    _put(table, at + 4 * step, xr + yi, xi - yr, twiddles, t + 6)
    xr, xi, yr, yi = ar + d * pr + c * qr, ai + d * pi + c * qi, u * mr - s * nr, u * mi - s * ni
    _put(table, at + 2 * step, xr - yi, xi + yr, twiddles, t + 2)
    _put(table, at + 3 * step, xr + yi, xi - yr, twiddles, t + 4)


@jit(borrows=True)
def _stage(table, first, length, radix, twiddles, t):
    """One stage of the transform of `length` rows from float `first`."""
    step = length // radix * ROW
    if radix == 8:
        for at in range(first, first + step, ROW):
            for lane in range(0, LANES, PART):
                _eight(table, at + lane, step, twiddles, t)
            t += 14
    elif radix == 4:
        for at in range(first, first + step, ROW):
            for lane in range(0, LANES, PART):
                _four(table, at + lane, step, twiddles, t)
            t += 6
    elif radix == 2:
        for at in range(first, first + step, ROW):
            for lane in range(0, LANES, PART):
                _two(table, at + lane, step, twiddles, t)
            t += 2
    elif radix == 5:
        for at in range(first, first + step, ROW):
            for lane in range(0, LANES, PART):
                _five(table, at + lane, step, twiddles, t)
            t += 8
    else:
        for at in range(first, first + step, ROW):
            for lane in range(0, LANES, PART):
                _three(table, at + lane, step, twiddles, t)
            t += 4


@jit(borrows=True)
def transform(table, first, size, radices, twiddles):
    """sum_g x_g exp(+j 2 pi g k/size) of the rows from float `first` of the flat `table`, in place,
    in the order of `plan`.

    Once a stage has left parts of at most `NEAR` rows, each part is finished before the next is
    begun: all its other stages find it in the first-level cache.
    """
    length, t, done = size, np.int64(0), 0  # a bare 0 has `_stage` compiled for 0 too
    while done < radices.size and length > NEAR:
        radix = radices[done]
        for part in range(first, first + size * ROW, length * ROW):
            _stage(table, part, length, radix, twiddles, t)
        length //= radix
        t += 2 * (radix - 1) * length
        done += 1
    for near in range(first, first + size * ROW, length * ROW):
        short, u = length, t
        for radix in radices[done:]:
            for part in range(near, near + length * ROW, short * ROW):
                _stage(table, part, short, radix, twiddles, u)
            short //= radix
            u += 2 * (radix - 1) * short
