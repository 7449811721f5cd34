"""What acts on the samples of a cube, chirp by chirp, in one pass through its memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.hardware.oscillator import OVERSAMPLING, Record, cubic
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import (
    LANES,
    aligned,
    cos_sin_exact,
    floor,
    load,
    splat,
    store,
    swap_pairs,
    zip_high,
    zip_low,
)
from isac_rt.signal.noise import add_stream


@jit(fast=True)
def _add_phases(out, values, first, weight, scale):
    """Add scale times the cubic through `values` to each row of `out`: place n of row i lies after
    the value first[i] + 2 n."""
    for i in range(out.shape[0]):
        at, row = first[i] - 1, out[i]
        a, b, c, d = (
            scale * weight[i, 0],
            scale * weight[i, 1],
            scale * weight[i, 2],
            scale * weight[i, 3],
        )
        for n in range(row.shape[0]):
            k = at + 2 * n
            row[n] += a * values[k] + b * values[k + 1] + c * values[k + 2] + d * values[k + 3]


def add_phases(out: np.ndarray, record: Record, begin: np.ndarray, sign: float) -> None:
    """Add the phase of an oscillator to rows of samples, in cycles.

    Parameters
    ----------
    out : (R, N) float64 [cycles], added to
    begin : (R,) time of the first sample of each row [s]; the others follow at the IF's rate
    sign : 1 or -1
    """
    assert OVERSAMPLING == 2
    place = (begin - record.start) / record.step
    first = np.floor(place).astype(np.int64)
    weight = cubic(place - first)
    _add_phases(out, record.values, first, weight, sign / (2 * np.pi))


@jit(fast=True)
def _phasors(out, cycles):
    """exp(j 2 pi cycles), interleaved, of flat arrays whose length is a multiple of 16."""
    for at in range(0, cycles.shape[0], LANES):
        x = load(cycles, at)
        c, s = cos_sin_exact(x - floor(x + splat(0.5)))
        store(out, 2 * at, zip_low(c, s))
        store(out, 2 * at + LANES, zip_high(c, s))


def phasors(cycles: np.ndarray) -> np.ndarray:
    """exp(j 2 pi cycles) of float64, complex64, to 1e-7."""
    size = -(-cycles.size // LANES) * LANES
    flat = cycles.ravel()
    if size > flat.size:
        flat = np.concatenate([flat, np.zeros(size - flat.size)])
    out = aligned(2 * size)
    _phasors(out, flat)
    return out[: 2 * cycles.size].view(np.complex64).reshape(cycles.shape)


@jit(fast=True)
def _turn_row(flat, at, plain, crossed):
    """Multiply one chirp's samples, interleaved from flat[at], by complex factors: their real parts
    twice each, and minus and plus their imaginary parts."""
    size = plain.shape[0]
    whole = size - size % LANES
    for i in range(0, whole, LANES):
        x = load(flat, at + i)
        store(flat, at + i, x * load(plain, i) + swap_pairs(x) * load(crossed, i))
    for i in range(whole, size, 2):
        re, im = flat[at + i], flat[at + i + 1]
        flat[at + i] = re * plain[i] + im * crossed[i]
        flat[at + i + 1] = im * plain[i + 1] + re * crossed[i + 1]


class Work(NamedTuple):
    """What one pass through the samples does, in this order; arrays without rows: nothing.

    Attributes
    ----------
    reads, first, before : (T, 2 N) float32 weights with which samples are read at other places,
        each twice; the first of the neighbours (`isac_rt.hardware.sweep.read_at`); factors as below
        that bring their band to the middle first
    factors : (M P, 2 N) float32, complex factors of each chirp's samples, interleaved
    elements : (L_rx, 2 N) float32, the same of each element's
    power, key : of the noise per sample [W] (0: none), and its stream
    saturation : power at which the amplifier saturates [W]
    mixing : (7,) float32: I of I, I of Q, Q of I, Q of Q, the constant, the share of Q that is
        kept (0 or 1), and whether any of these acts
    step, most : of the converters [sqrt(W)], and half their number of steps; 0: none
    """

    reads: np.ndarray
    first: int
    before: np.ndarray
    factors: np.ndarray
    elements: np.ndarray
    power: float
    key: np.ndarray
    saturation: float
    mixing: np.ndarray
    step: float
    most: float


@jit(fast=True)
def _spread_row(row, plain, crossed):
    """Factors as `_turn_row` wants them."""
    for n in range(row.shape[0] // 2):
        plain[2 * n] = plain[2 * n + 1] = row[2 * n]
        crossed[2 * n], crossed[2 * n + 1] = -row[2 * n + 1], row[2 * n + 1]


@jit(fast=True)
def _read_row(flat, at, reads, first, padded):
    """Read one chirp's samples at other places; beyond its ends there are none."""
    taps, size = reads.shape[0], reads.shape[1] // LANES * LANES
    length = reads.shape[1]
    margin = -2 * first
    for i in range(length):
        padded[margin + i] = flat[at + i]
    weights = reads.reshape(-1)
    for i in range(0, size, LANES):
        total = splat(np.float32(0))
        for tap in range(taps):
            total = total + load(weights, tap * length + i) * load(padded, i + 2 * tap)
        store(flat, at + i, total)
    for i in range(size, length):
        own = np.float32(0)
        for tap in range(taps):
            own += weights[tap * length + i] * padded[i + 2 * tap]
        flat[at + i] = own


@jit(fast=True)
def _compress(own, saturation):
    """Rapp's amplifier with p = 2."""
    scale = np.float32(1.0 / saturation)
    for n in range(own.shape[0] // 2):
        re, im = own[2 * n], own[2 * n + 1]
        z = (re * re + im * im) * scale
        gain = np.float32(1) / np.sqrt(np.sqrt(np.float32(1) + z * z))
        own[2 * n], own[2 * n + 1] = re * gain, im * gain


@jit(fast=True)
def _mix(own, mixing):
    """Quadrature errors, constant, and Q kept or not."""
    a, b, c, d, constant, kept = (
        mixing[0],
        mixing[1],
        mixing[2],
        mixing[3],
        mixing[4],
        mixing[5],
    )
    for n in range(own.shape[0] // 2):
        re, im = own[2 * n], own[2 * n + 1]
        own[2 * n] = a * re + b * im + constant
        own[2 * n + 1] = kept * (c * re + d * im + constant)


@jit(fast=True)
def _quantise(own, step, most):
    """The middle of each value's step, within `most` steps on both sides of zero."""
    inverse, half, low = np.float32(1.0 / step), np.float32(0.5), np.float32(-most)
    width, high = np.float32(step), np.float32(most - 1)
    for i in range(own.shape[0]):
        x = np.floor(own[i] * inverse)
        x = low if x < low else x
        x = high if x > high else x
        own[i] = (x + half) * width


@jit(fast=True)
def _pass(flat, shape, work, room):
    """Do it chirp by chirp, while the chirp's samples lie in the first cache."""
    groups, elements, chirps, num_samples = shape
    size = 2 * num_samples
    plain, crossed, padded = room[0], room[1], room[2 + 2 * elements]
    for r in range(work.elements.shape[0]):
        _spread_row(work.elements[r], room[2 + 2 * r], room[3 + 2 * r])
    for m in range(groups):
        for p in range(chirps):
            if work.factors.shape[0]:
                _spread_row(work.factors[m * chirps + p], plain, crossed)
            if work.reads.shape[0]:
                _spread_row(work.before[m * chirps + p], room[-2], room[-1])
            for r in range(elements):
                at = size * ((m * elements + r) * chirps + p)
                own = flat[at : at + size]
                if work.reads.shape[0]:
                    _turn_row(flat, at, room[-2][:size], room[-1][:size])
                    _read_row(flat, at, work.reads, work.first, padded)
                if work.factors.shape[0]:
                    _turn_row(flat, at, plain[:size], crossed[:size])
                if work.elements.shape[0]:
                    _turn_row(flat, at, room[2 + 2 * r][:size], room[3 + 2 * r][:size])
                if work.power > 0:
                    power = np.float32(work.power)
                    add_stream(own, power, work.key[0], work.key[1], np.uint64(at // 2))
                if work.saturation < np.inf:
                    _compress(own, work.saturation)
                if work.mixing[6] > 0:
                    _mix(own, work.mixing)
                if work.step > 0:
                    _quantise(own, work.step, work.most)
                    if work.mixing[5] == 0:
                        own[1::2] = np.float32(0)


def finish(samples: np.ndarray, work: Work) -> None:
    """Do to samples (M, L_rx, P, N) complex64, in place, what hardware does behind antennas."""
    size = 2 * samples.shape[3] + 4 * max(-work.first, 0) + LANES
    room = np.zeros((5 + 2 * samples.shape[1], size), np.float32)
    _pass(samples.reshape(-1).view(np.float32), samples.shape, work, room)


def rows_of(factors: np.ndarray | None) -> np.ndarray:
    """Complex factors (..., N) as rows for `Work`."""
    if factors is None:
        return np.zeros((0, 0), np.float32)
    flat = np.ascontiguousarray(factors, np.complex64)
    return flat.reshape(-1, factors.shape[-1]).view(np.float32)
