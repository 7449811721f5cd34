"""What acts on the samples of a cube, chirp by chirp, in one pass through its memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.hardware.oscillator import OVERSAMPLING, Record, cubic
from isac_rt.kernels.jit import jit
from isac_rt.kernels.signal_noise import add_stream
from isac_rt.kernels.vector import (
    LANES,
    aligned,
    cos_sin,
    cos_sin_exact,
    even_twice,
    evens,
    floor,
    load,
    narrow,
    odd_twice,
    odds,
    splat,
    store,
    swap_pairs,
    zip_high,
    zip_low,
)


@jit(fast=True)
def _add_phase(row, values, first, weight):
    """Add the cubic through `values` to a row: its place n lies after the value first + 2 n."""
    a, b, c, d = weight[0], weight[1], weight[2], weight[3]
    at = first - 1
    whole = row.shape[0] - row.shape[0] % LANES
    for n in range(0, whole, LANES):
        k = at + 2 * n
        low, high = load(values, k), load(values, k + LANES)
        here = load(row, n) + splat(a) * evens(low, high) + splat(b) * odds(low, high)
        low, high = load(values, k + 2), load(values, k + 2 + LANES)
        store(row, n, here + splat(c) * evens(low, high) + splat(d) * odds(low, high))
    for n in range(whole, row.shape[0]):
        k = at + 2 * n
        row[n] += a * values[k] + b * values[k + 1] + c * values[k + 2] + d * values[k + 3]


@jit(fast=True)
def _add_phases(out, values, first, weight):
    """The same to each row of `out`."""
    for i in range(out.shape[0]):
        _add_phase(out[i], values, first[i], weight[i])


def places_of(record: Record, begin: np.ndarray, sign: float) -> tuple[np.ndarray, np.ndarray]:
    """Where rows of samples that begin at times (R,) [s] lie in an oscillator's phase.

    Returns
    -------
    first : (R,) the value before the first sample
    weight : (R, 4) of the cubic through those around it, in cycles, with the sign
    """
    assert OVERSAMPLING == 2
    place = (begin - record.start) / record.step
    first = np.floor(place).astype(np.int64)
    return first, cubic(place - first) * (sign / (2 * np.pi))


def add_phases(out: np.ndarray, record: Record, begin: np.ndarray, sign: float) -> None:
    """Add the phase of an oscillator to rows of samples, in cycles.

    Parameters
    ----------
    out : (R, N) float64 [cycles], added to
    begin : (R,) time of the first sample of each row [s]; the others follow at the IF's rate
    sign : 1 or -1
    """
    _add_phases(out, record.values, *places_of(record, begin, sign))


@jit(fast=True)
def _phasors(out, cycles):
    """exp(j 2 pi cycles), interleaved, of flat arrays whose length is a multiple of 16."""
    for at in range(0, cycles.shape[0], LANES):
        x = load(cycles, at)
        c, s = cos_sin(narrow(x - floor(x + splat(0.5))))
        store(out, 2 * at, zip_low(c, s))
        store(out, 2 * at + LANES, zip_high(c, s))


def phasors(cycles: np.ndarray) -> np.ndarray:
    """exp(j 2 pi cycles) of float64, complex64, to 2e-6."""
    size = -(-cycles.size // LANES) * LANES
    flat = cycles.ravel()
    if size > flat.size:
        flat = np.concatenate([flat, np.zeros(size - flat.size)])
    out = aligned(2 * size)
    _phasors(out, flat)
    return out[: 2 * cycles.size].view(np.complex64).reshape(cycles.shape)


class Turns(NamedTuple):
    """The complex factor of each chirp's samples that all receive elements share; arrays without
    elements: nothing of the kind.

    Attributes
    ----------
    records : phases of the receiver's and the transmitter's oscillator [rad]
    first : (R, 2) of each chirp the value before its first sample, in either record
    weight : (R, 2, 4) of the cubic through those around it, divided by 2 pi, with the sign
    always : (N,) float64 the same in all chirps [cycles]
    place, beat : (N,) places of the samples, (R,) cycles per sample by which they turn
    sent : (A, 2 W) float32 complex gains of each transmit antenna, interleaved
    antenna, begin : (R,) which of them, and where in it, each chirp begins
    gain : (2 N,) float32 complex gain of all chirps
    """

    records: tuple[np.ndarray, np.ndarray]
    first: np.ndarray
    weight: np.ndarray
    always: np.ndarray
    place: np.ndarray
    beat: np.ndarray
    sent: np.ndarray
    antenna: np.ndarray
    begin: np.ndarray
    gain: np.ndarray

    def of_rows(self, every: int) -> Turns:
        """Those of one chirp in `every`."""
        rows = ("first", "weight", "beat", "antenna", "begin")
        return self._replace(**{name: getattr(self, name)[::every] for name in rows})


NOTHING = np.zeros(0)
NO_ROWS = np.zeros((0, 0), np.float32)
NO_TURNS = Turns(
    (NOTHING, NOTHING),
    np.zeros((0, 2), np.int64),
    np.zeros((0, 2, 4)),
    NOTHING,
    NOTHING,
    NOTHING,
    NO_ROWS,
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros(0, np.float32),
)


class Work(NamedTuple):
    """What one pass through the samples does, in this order; arrays without rows: nothing.

    Attributes
    ----------
    taps, shift : (1 + T, 2) and (2 N,) float32, with which samples are read at places nearby, each
        of these twice (`isac_rt.hardware.sweep.short_read`)
    reads, first : (T, 2 N) float32 weights with which samples are read farther away, each twice;
        the first of the neighbours (`isac_rt.hardware.sweep.read_at`)
    beat : (M P,) cycles per sample by which they are turned back before, their band to the middle
    turns : of each chirp
    elements : (L_rx, 2 N) float32, complex factors of each element's samples, interleaved
    power, key : of the noise per sample [W] (0: none), and its stream
    saturation : power at which the amplifier saturates [W]; 0: never
    mixing : (7,) float32: I of I, I of Q, Q of I, Q of Q, the constant, the share of Q that is
        kept (0 or 1), and whether any of these acts
    step, most : of the converters [sqrt(W)], and half their number of steps; 0: none
    """

    taps: np.ndarray
    shift: np.ndarray
    reads: np.ndarray
    first: int
    beat: np.ndarray
    turns: Turns
    elements: np.ndarray
    power: float
    key: np.ndarray
    saturation: float
    mixing: np.ndarray
    step: float
    most: float


class _Room(NamedTuple):
    """Memory of the pass: phases of a chirp [cycles], its factors and those that turn it back, one
    chirp with the neighbours beyond its ends, phasors of 16 blocks, the
    places within one, and the signs of a complex product."""

    cycles: np.ndarray
    factor: np.ndarray
    back: np.ndarray
    padded: np.ndarray
    starts: np.ndarray
    places: np.ndarray
    signs: np.ndarray


@jit(inline=True)
def _product(x, f, signs):
    """Complex products of interleaved numbers, eight at once."""
    return x * even_twice(f) + swap_pairs(x) * (odd_twice(f) * signs)


@jit(fast=True)
def _turn(out, at, samples, row, signs):
    """Samples, interleaved, times as many complex factors: to `out` from `at` on."""
    sign = load(signs, 0)
    size = samples.shape[0]
    whole = size - size % LANES
    for i in range(0, whole, LANES):
        store(out, at + i, _product(load(samples, i), load(row, i), sign))
    for i in range(whole, size, 2):
        re, im, c, s = samples[i], samples[i + 1], row[i], row[i + 1]
        out[at + i], out[at + i + 1] = re * c - im * s, re * s + im * c


@jit(fast=True)
def _turn_twice(out, row, other, signs):
    """Multiply `out` by two rows of complex factors."""
    sign = load(signs, 0)
    size = out.shape[0]
    whole = size - size % LANES
    for i in range(0, whole, LANES):
        x = _product(load(out, i), load(row, i), sign)
        store(out, i, _product(x, load(other, i), sign))
    for i in range(whole, size, 2):
        c = row[i] * other[i] - row[i + 1] * other[i + 1]
        s = row[i] * other[i + 1] + row[i + 1] * other[i]
        re, im = out[i], out[i + 1]
        out[i], out[i + 1] = re * c - im * s, re * s + im * c


@jit(fast=True)
def _tone(out, beat, room):
    """exp(-j 2 pi beat n), interleaved, n from 0 on."""
    starts, places = room.starts, room.places
    cycles = load(places, 0) * splat(-beat)
    lane_re, lane_im = cos_sin_exact(cycles - floor(cycles + splat(0.5)))
    blocks = out.shape[0] // (2 * LANES)
    for first in range(0, blocks, LANES):
        cycles = (load(places, 0) + splat(float(first))) * splat(-beat * LANES)
        c, s = cos_sin_exact(cycles - floor(cycles + splat(0.5)))
        store(starts, 0, c)
        store(starts, LANES, s)
        for i in range(min(LANES, blocks - first)):
            c, s = splat(starts[i]), splat(starts[LANES + i])
            re, im = c * lane_re - s * lane_im, c * lane_im + s * lane_re
            at = 2 * LANES * (first + i)
            store(out, at, zip_low(re, im))
            store(out, at + LANES, zip_high(re, im))


@jit(fast=True)
def _factor(room, turns, row, size):
    """The factor of one chirp's samples, `size` numbers; False where there is none."""
    cycles, factor, count = room.cycles, room.factor, size // 2
    turned = turns.always.shape[0] + turns.first.shape[0] + turns.beat.shape[0] > 0
    if turned:
        if turns.always.shape[0]:
            cycles[:count] = turns.always
        else:
            cycles[:count] = 0.0
        for end in range(turns.first.shape[1] if turns.first.shape[0] else 0):
            values = turns.records[end]
            if values.shape[0]:
                w = turns.weight[row, end]
                _add_phase(cycles[:count], values, turns.first[row, end], w)
        if turns.beat.shape[0]:
            beat = turns.beat[row]
            for n in range(count):
                cycles[n] += beat * turns.place[n]
        _phasors(factor, cycles)
    else:
        factor[0::2] = np.float32(1)
        factor[1::2] = np.float32(0)
    if turns.sent.shape[0]:
        at = 2 * turns.begin[row]
        sent = turns.sent[turns.antenna[row]][at : at + size]
        _turn(factor, 0, factor[:size], sent, room.signs)
    if turns.gain.shape[0]:
        _turn(factor, 0, factor[:size], turns.gain, room.signs)
    return turned or turns.sent.shape[0] + turns.gain.shape[0] > 0


@jit(fast=True)
def _read_near(own, padded, margin, near, row, other, signs):
    """Read one chirp's samples a part of a sample away, times one row of complex factors or two."""
    taps, shift = near
    sign, twice, wide = load(signs, 0), other.shape[0] > 0, taps.shape[0] > 4
    a, b, c, here, beside = taps[1, 0], taps[2, 0], taps[3, 0], taps[0, 1], taps[1, 1]
    d, e = (taps[4, 0], taps[5, 0]) if wide else (a, a)
    size = own.shape[0]
    whole = size - size % LANES
    for i in range(0, whole, LANES):
        at = margin + i
        middle, after, before = load(padded, at), load(padded, at + 2), load(padded, at - 2)
        bend = middle * splat(here) + (after + before) * splat(beside)
        slope = (after - before) * splat(a)
        slope = slope + (load(padded, at + 4) - load(padded, at - 4)) * splat(b)
        slope = slope + (load(padded, at + 6) - load(padded, at - 6)) * splat(c)
        if wide:
            slope = slope + (load(padded, at + 8) - load(padded, at - 8)) * splat(d)
            slope = slope + (load(padded, at + 10) - load(padded, at - 10)) * splat(e)
        late = load(shift, i)
        x = _product(middle + late * (slope + late * bend), load(row, i), sign)
        if twice:
            x = _product(x, load(other, i), sign)
        store(own, i, x)
    for i in range(whole, size):
        at = margin + i
        slope, bend = np.float32(0), padded[at] * taps[0, 1]
        bend += (padded[at + 2] + padded[at - 2]) * taps[1, 1]
        for t in range(1, taps.shape[0]):
            slope += (padded[at + 2 * t] - padded[at - 2 * t]) * taps[t, 0]
        own[i] = padded[at] + shift[i] * (slope + shift[i] * bend)
    _turn(own, whole, own[whole:], row[whole:], signs)
    if twice:
        _turn(own, whole, own[whole:], other[whole:], signs)


@jit(fast=True)
def _read_far(own, padded, reads):
    """Read one chirp's samples at other places; beyond its ends there are none."""
    taps, length = reads.shape
    size = length // LANES * LANES
    weights = reads.reshape(-1)
    for i in range(0, size, LANES):
        total = splat(np.float32(0))
        for tap in range(taps):
            total = total + load(weights, tap * length + i) * load(padded, i + 2 * tap)
        store(own, i, total)
    for i in range(size, length):
        one = np.float32(0)
        for tap in range(taps):
            one += weights[tap * length + i] * padded[i + 2 * tap]
        own[i] = one


_ROOT = np.int32(0x4F584000)  # bits of a first guess that is 3 % off at most
_NEARER = tuple(np.float32(c) for c in (1.52538619, -0.91843581, 0.5107064, -0.11765964))
"""Polynomial of least largest error, 3e-6, for t^(-1/4) of t from 0.8789 to 1.1275."""
_ONE, _HALF = np.float32(1), np.float32(0.5)
_MOST_DRIVEN = np.float32(1e15)  # power over the saturation's, whose square float32 still holds


@jit(inline=True)
def _inverse_fourth_root(y):
    """y^(-1/4) of y from 1 on: relative error below 4e-6."""
    g = np.int32(_ROOT - (np.float32(y).view(np.int32) >> np.int32(2))).view(np.float32)
    square = g * g
    t = y * (square * square)
    return g * (_NEARER[0] + t * (_NEARER[1] + t * (_NEARER[2] + t * _NEARER[3])))


@jit(fast=True)
def _convert(own, saturation, mixing, step, most):
    """Rapp's amplifier with p = 2; quadrature errors, constant, and Q kept or not; the middle of
    each value's step, within `most` steps on both sides of zero."""
    compresses, quantises = saturation > 0, step > 0
    scale = np.float32(1.0 / saturation) if compresses else np.float32(0)
    unit = np.float32(1.0 / step) if quantises else _ONE
    m = mixing * unit
    a, b, c, d, constant, kept = m[0], m[1], m[2], m[3], m[4], mixing[5]
    width, low, high = np.float32(step), np.float32(-most), np.float32(most - 1)
    half = _HALF * width
    width_q, half_q = width * kept, half * kept
    for n in range(own.shape[0] // 2):
        re, im = own[2 * n], own[2 * n + 1]
        if compresses:
            z = min((re * re + im * im) * scale, _MOST_DRIVEN)
            gain = _inverse_fourth_root(_ONE + z * z)
            re, im = re * gain, im * gain
        re, im = a * re + b * im + constant, c * re + d * im + constant
        if quantises:
            re = min(max(np.floor(re), low), high) * width + half
            im = min(max(np.floor(im), low), high) * width_q + half_q
        else:
            im *= kept
        own[2 * n], own[2 * n + 1] = re, im


@jit(fast=True)
def _pass(flat, shape, work, room, margin):
    """Do it chirp by chirp, while the chirp's samples lie in the first cache."""
    groups, elements, chirps, num_samples = shape
    size, signs = 2 * num_samples, room.signs
    near, nothing = work.taps.shape[0] > 0, room.back[:0]
    for row in range(groups * chirps):
        m, p = row // chirps, row % chirps
        turned = _factor(room, work.turns, row, size)
        if margin > 0:
            _tone(room.back, work.beat[row], room)
        for r in range(elements):
            at = size * ((m * elements + r) * chirps + p)
            own = flat[at : at + size]
            other = work.elements[r] if work.elements.shape[0] else nothing
            if margin > 0:
                _turn(room.padded, margin, own, room.back, signs)
            if near:
                how = work.taps, work.shift
                _read_near(own, room.padded, margin, how, room.factor, other, signs)
            elif margin > 0:
                _read_far(own, room.padded, work.reads)
            if turned and not near and other.shape[0]:
                _turn_twice(own, room.factor, other, signs)
            elif turned and not near:
                _turn(own, 0, own, room.factor, signs)
            elif other.shape[0] and not near:
                _turn(own, 0, own, other, signs)
            if work.power > 0:
                power = np.float32(work.power)
                add_stream(own, power, work.key[0], work.key[1], np.uint64(at // 2))
            if work.saturation > 0 or work.step > 0 or work.mixing[6] > 0:
                _convert(own, work.saturation, work.mixing, work.step, work.most)


def finish(samples: np.ndarray, work: Work) -> None:
    """Do to samples (M, L_rx, P, N) complex64, in place, what hardware does behind antennas."""
    length = -(-samples.shape[3] // LANES) * LANES
    margin = 2 * (len(work.taps) - 1) if len(work.taps) else -2 * work.first
    lanes = np.arange(LANES)
    room = _Room(
        np.zeros(length),
        aligned(2 * length),
        aligned(2 * length),
        aligned(2 * length + 2 * margin + LANES),
        aligned(2 * LANES),
        lanes.astype(float),
        np.where(lanes % 2, 1, -1).astype(np.float32),
    )
    _pass(samples.reshape(-1).view(np.float32), samples.shape, work, room, margin)


def rows_of(factors: np.ndarray | None) -> np.ndarray:
    """Complex factors (..., N) as rows for `Work`."""
    if factors is None:
        return NO_ROWS
    flat = np.ascontiguousarray(factors, np.complex64)
    return flat.reshape(-1, factors.shape[-1]).view(np.float32)
