r"""Many paths that noise covers, through lines much finer than the grid of fast-time frequency.

In each chirp a path is a tone between two lines. At every receive element a share f of it goes to
the upper one and the rest to the lower one, f by its place between them, the delays of its elements
included. The lines, not the paths, are then spread on the grid. Between which lines a path lies is
decided a few times in a frame, f for every few chirps, and amplitudes z for every chirp: a path
costs two sums of products for each receive element. With theta the turn over half a chirp from line
to line and x the time from the middle of the chirp, what is left out of a path is f (1 - f) theta^2
(x^2 - 1/3)/2, and the quadratic phase of motion away from the middle of the chirp: see
`covered_error`.

Data delay all paths alike by D: they move the lines over the grid and turn a line of beat F by
exp(-j 2 pi F D).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.fourier import ROW
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, aligned, cos_sin, floor, load, narrow, splat, store
from isac_rt.signal.direct import passed
from isac_rt.signal.tones import Tones

LINES = 8
"""Lines to a step of the grid."""
TOGETHER = 12
"""Chirps for which the paths are read once."""
MOVED = 0.5
"""Lines that paths may move by until the lines beside them are sought anew, where that takes longer
than a batch of chirps."""
FLOOR = 2e-3
"""Error of a path on a line: four weights, to which twelve are fitted besides."""
EXTRA = 2
"""Degree of the weights' polynomials above the width."""
_ACROSS = 3  # chirps whose sums stay in registers, with the same shares
_Z = 2 * LANES * TOGETHER  # float32 of 16 paths' amplitudes in these chirps
_SUMS = 4 * LANES  # float32 of a chirp's sums for two lines
_ONE, _HALF = np.float32(1), np.float32(0.5)


class Covered(NamedTuple):
    """K paths, those of one link and offset together, sixteen by sixteen: the last ones of a group
    may be repeated without amplitude.

    Attributes
    ----------
    groups : (G, 4) link, offset, first path, and the one after its last
    phase : (L_tx, K) of each transmit element, at mid-frame and in the middle of a chirp [cycles]
    turn, bend : (K,) by which it changes [cycles/s, cycles/s^2]
    amplitude : (L_tx, K) float32
    place, drift : (K,) on the grid, at mid-frame and by the second
    late : (L_tx, K) float32, by how many lines a transmit element's delay moves it
    steer : (48 K,) float32, of each path phasors of 16 receive elements, real and imaginary, and
        by how many lines their delays move it
    order : (S, K') of each part of the frame the paths of all groups, each group's by their places
    below : (S, K) float64, number of the line below each path
    """

    groups: np.ndarray
    phase: np.ndarray
    turn: np.ndarray
    bend: np.ndarray
    amplitude: np.ndarray
    place: np.ndarray
    drift: np.ndarray
    late: np.ndarray
    steer: np.ndarray
    order: np.ndarray
    below: np.ndarray


class Batches(NamedTuple):
    """In which order chirps are made.

    Attributes
    ----------
    chirp : (M P,) number of each, those of one batch one after the other
    parts : (B, 3) of each batch the first one, their number, and the part of the frame
    """

    chirp: np.ndarray
    parts: np.ndarray


class Sheet(NamedTuple):
    """Where lines are spread.

    Attributes
    ----------
    size : grid points a turn
    more : by which a path's shares f and 1 - f are raised, over f (1 - f)
    stride, inner : float32 from grid to grid, and from a path's first row to a line's
    taps, poly : one 0 for each row of a line, and `weights` of these
    """

    size: int
    more: float
    stride: int
    inner: int
    taps: tuple[int, ...]
    poly: np.ndarray


class Desk(NamedTuple):
    """Memory of the sums.

    Attributes
    ----------
    z, share : of each path the amplitudes in the chirps of a batch, and the upper line's share
    sums : of a line and the next one in each chirp
    work, weights, factor, rows : places of 16 lines within a grid step; of every chirp their
        weights, factors and first rows
    lines, begin, end : 16 lines and the paths above each
    sent, times, antenna : of each chirp what is sent, its time and its data's delay, and by which
        element; -1: nothing
    """

    z: np.ndarray
    share: np.ndarray
    sums: np.ndarray
    work: np.ndarray
    weights: np.ndarray
    factor: np.ndarray
    rows: np.ndarray
    lines: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    sent: np.ndarray
    times: np.ndarray
    antenna: np.ndarray


def line_turn(size: int, half: float) -> float:
    """Turn over half a chirp from line to line [rad]."""
    return 2 * np.pi * half / (size * LINES)


def no_paths(num_tx: int) -> Covered:
    """None at all."""
    none, of_each = np.zeros(0), np.zeros((num_tx, 0))
    narrow_none = of_each.astype(np.float32)
    return Covered(
        np.zeros((0, 4), np.int64),
        of_each,
        none,
        none,
        narrow_none,
        none,
        none,
        narrow_none,
        aligned(0),
        np.zeros((1, 0), np.int64),
        np.zeros((1, 0)),
    )


def desk(paths: Covered, width: int) -> Desk:
    """Room for the sums of these paths."""
    blocks = paths.turn.size // LANES
    return Desk(
        aligned(blocks * _Z),
        aligned(blocks * LANES * (TOGETHER // _ACROSS)),
        aligned(TOGETHER * _SUMS),
        aligned(LANES),
        aligned(TOGETHER * width * LANES),
        aligned(TOGETHER * 2 * LANES),
        np.zeros(TOGETHER * LANES),
        np.zeros(LANES),
        np.zeros(LANES, np.int64),
        np.zeros(LANES, np.int64),
        np.zeros(TOGETHER, np.complex128),
        np.zeros((TOGETHER, 2)),
        np.zeros(TOGETHER, np.int64),
    )


def plain_batches(num_chirps: int, together: int) -> Batches:
    """Chirps one after the other, so many at once."""
    first = np.arange(0, num_chirps, together)
    count = np.minimum(together, num_chirps - first)
    parts = np.stack([first, count, np.zeros_like(first)], axis=1)
    return Batches(np.arange(num_chirps), parts)


def batches(antenna: np.ndarray, slots: int) -> Batches:
    """Chirps (M, P) that one antenna sends together, in each part of so many slots."""
    groups, chirps = antenna.shape
    slot = np.broadcast_to(np.arange(chirps), (groups, chirps)).ravel()
    part, sender = slot // slots, antenna.ravel()
    order = np.lexsort((slot, sender, part))
    new = (np.diff(part[order]) != 0) | (np.diff(sender[order]) != 0)
    begin = np.flatnonzero(np.r_[True, new])
    length = np.diff(np.r_[begin, order.size])
    rows = [
        (first, min(TOGETHER, start + count - first), part[order[start]])
        for start, count in zip(begin, length, strict=True)
        for first in range(start, start + count, TOGETHER)
    ]
    return Batches(order, np.array(rows, np.int64).reshape(-1, 3))


def part_slots(waveform: Waveform, rate: np.ndarray, size: int) -> int:
    """Slots of a part of the frame, in which paths move by no more than `MOVED`: whole batches, one
    at least."""
    moved = float(np.abs(rate).max(initial=0.0)) * waveform.slot_duration * _lines(waveform, size)
    return TOGETHER * max(int(MOVED / max(moved * TOGETHER, 1e-3)), 1)


def _lines(waveform: Waveform, size: int) -> float:
    """Lines by which a delay of a second moves a path."""
    return waveform.slope * waveform.sample_interval * size * LINES


def covered_error(waveform: Waveform, tones: Tones, size: int) -> np.ndarray:
    """(K,) bound of the relative RMS error over a frame of paths that noise covers, of what the
    receiver's filter would let through whole.

    Four parts, added in power: what two lines leave of a path between them or, by its motion and
    its elements' delays, beyond one of them; shares of the middle of a few chirps; the quadratic
    phase; and `FLOOR`.

    Parameters
    ----------
    size : grid points a turn
    """
    w, t, rate = waveform, tones, np.abs(tones.rate)
    half, lines = w.num_samples / 2, _lines(waveform, size)
    moved = np.maximum(rate * TOGETHER * w.slot_duration * lines, MOVED) / 2
    beyond = moved + lines * sum(np.abs(d).max(axis=1) for d in (t.tx_delay, t.rx_delay))
    # most of f (1 - f), f between the lines, or on one of them and evenly that far to both sides
    between = np.maximum(0.25, np.sqrt(beyond**2 / 3 + beyond**4 / 5))
    turn = line_turn(size, half)
    # parts are as long as the fastest path lets them, and cut fewer of the few when they are long
    order, parts = batches(t.antenna[0], w.num_chirps)
    stale = rate * _apart(w, order, parts) * lines * turn
    bend = np.pi * w.slope * rate * (w.sample_interval * half) ** 2 * 2
    spread = np.sqrt(1 / 5 - 1 / 9)  # of x^2
    return np.sqrt(
        (turn**2 / 2 * between * spread) ** 2 + stale**2 / 3 + (bend * spread) ** 2 + FLOOR**2
    )


def summed_share(waveform: Waveform, tones: Tones, size: int) -> float:
    """Chirps for which sums are made over those that there are: some of the few that share a sum
    are missing where an element sends seldom."""
    slots = part_slots(waveform, tones.rate, size)
    count = batches(tones.antenna[0], slots).parts[:, 1]
    return float((-(-count // _ACROSS) * _ACROSS).sum() / count.sum())


def _apart(waveform: Waveform, order: np.ndarray, parts: np.ndarray) -> float:
    """RMS of the time from the middle of the chirps that have the same shares [s]."""
    w = waveform
    place = np.concatenate([np.arange(count) for count in parts[:, 1]])
    few = np.repeat(np.arange(len(parts)), parts[:, 1]) * TOGETHER + place // _ACROSS
    group, slot = np.divmod(order, w.num_chirps)
    time = slot * w.slot_duration + group * w.group_spacing
    _, number, count = np.unique(few, return_inverse=True, return_counts=True)
    middle = np.bincount(number, time) / count
    return float(np.sqrt(np.mean((time - middle[number]) ** 2)))


def covered_paths(
    waveform: Waveform,
    tones: Tones,
    sources: tuple[np.ndarray, np.ndarray],
    slots: int,
    size: int,
    centre: float,
    steering: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Covered:
    """The paths and offsets `sources` as arrays for `add_covered`.

    Parameters
    ----------
    slots : of a part of the frame
    size : grid points a turn
    centre : mean of x^2 over the samples
    steering : makes the `steer` of paths (K,) with delays (K,) [half chirps]
    """
    w, t = waveform, tones
    path, offset = sources
    lag = offset * w.group_spacing
    ts, half = w.sample_interval, w.num_samples // 2
    carrier = w.carrier_frequency + w.slope * w.fast_time[half]
    beat = w.slope * (t.delay[path] - lag) + t.rate[path] * carrier
    order = np.lexsort((beat, offset, t.link[path]))
    path, offset, lag = path[order], offset[order], lag[order]
    kind = t.link[path] * (2 * w.num_groups) + offset
    _, starts, counts = np.unique(kind, return_index=True, return_counts=True)
    full = -(-counts // LANES) * LANES
    index = np.concatenate(
        [s + np.minimum(np.arange(f), c - 1) for s, c, f in zip(starts, counts, full, strict=True)]
    )
    real = np.concatenate([np.arange(f) < c for c, f in zip(counts, full, strict=True)])
    ends = np.cumsum(full)
    groups = np.stack([t.link[path[starts]], offset[starts], ends - full, ends - full + counts], 1)
    path, lag = path[index], lag[index]
    delay, rate, accel = t.delay[path] - lag, t.rate[path], t.accel[path]
    sent = carrier - w.slope * delay
    step = rate * ts
    bow = (sent * accel * ts * ts / 2 + w.slope * step * (ts - step / 2)) * half**2
    extra = np.ascontiguousarray(t.tx_delay[path].T)
    element = delay + extra
    factor = np.empty(element.shape, complex)
    factor[:] = t.factor[path] * t.tx_gain[path].T if t.tx_gain.size else t.factor[path]
    cycles = element * (carrier - w.slope / 2 * element) + bow * centre
    place = (w.slope * delay + rate * sent) * ts * size
    drift = w.slope * rate * ts * size
    spacing = 1 / (w.slope * ts * size * LINES)
    first_slots = np.arange(0, w.num_chirps, slots)
    after = np.minimum(first_slots + slots, w.num_chirps)
    middle = (first_slots + after - w.num_chirps) / 2 * w.slot_duration
    below = np.floor((place + drift * middle[:, None]) * LINES)
    shown = [
        first + np.argsort(below[:, first:last], axis=1, kind="stable")
        for first, last in groups[:, 2:]
    ]
    return Covered(
        groups,
        (cycles + np.angle(factor) / (2 * np.pi)) % 1.0,
        sent * rate,
        (sent * accel - w.slope * rate**2) / 2,
        (np.abs(factor) * real).astype(np.float32),
        place,
        drift,
        (extra / spacing).astype(np.float32),
        steering(path, delay / (ts * half)),
        np.concatenate(shown, axis=1),
        below,
    )


@jit(fast=True)
def turn_elements(steer, late, per_line):
    """Turn the elements' phasors (of `Covered.steer`, turns over half a chirp instead of lines) by
    what a path's delay `late`, in half chirps, does to the frequency that they see."""
    for i in range(late.shape[0]):
        at = 48 * i
        re, im, turn = load(steer, at), load(steer, at + 16), load(steer, at + 32)
        angle = turn * splat(np.float32(late[i]))
        store(steer, at, re + angle * im)
        store(steer, at + 16, im - angle * re)
        store(steer, at + 32, turn * splat(np.float32(1 / per_line)))


@jit(fast=True)
def _shares(desk, paths, first, last, antenna, segment):
    """The upper lines' shares of a group's paths, in the middle of each few chirps that an antenna
    sends."""
    below, late, size = paths.below[segment], paths.late[antenna], paths.turn.shape[0]
    for half in range(TOGETHER // _ACROSS):
        middle, count = 0.0, 0
        for c in range(_ACROSS * half, _ACROSS * half + _ACROSS):
            if desk.antenna[c] == antenna:
                middle += desk.times[c, 0]
                count += 1
        middle /= max(count, 1)
        for n in range(first, last, LANES):
            place = load(paths.place, n) + load(paths.drift, n) * splat(middle)
            share = narrow(place * splat(float(LINES)) - load(below, n)) + load(late, n)
            store(desk.share, half * size + n, share)


@jit(fast=True)
def _amplitudes(desk, paths, first, last, antenna):
    """Amplitudes of a group's paths in the chirps that an antenna sends."""
    phase, amplitude = paths.phase[antenna], paths.amplitude[antenna]
    for n in range(first, last, LANES):
        p, f, g, a = load(phase, n), load(paths.turn, n), load(paths.bend, n), load(amplitude, n)
        for c in range(TOGETHER):
            at = n // LANES * _Z + 2 * LANES * c
            if desk.antenna[c] != antenna:
                store(desk.z, at, splat(np.float32(0)))
                store(desk.z, at + LANES, splat(np.float32(0)))
                continue
            time, data = desk.times[c, 0], desk.times[c, 1]
            cycles = p + f * splat(time + data) + g * splat(time * time)
            re, im = cos_sin(narrow(cycles - floor(cycles + splat(0.5))))
            store(desk.z, at, a * re)
            store(desk.z, at + LANES, a * im)


@jit(inline=True)
def _one(z, j, sr, si, ar, ai):
    """Add a path's amplitude in a chirp times its elements' phasors."""
    x, y = splat(z[j]), splat(z[j + LANES])
    return ar + x * sr - y * si, ai + x * si + y * sr


@jit(fast=True)
def _weigh(desk, c, poly, taps):
    """Weights on the grid points of 16 lines in a chirp."""
    r, width, degree = load(desk.work, 0), len(taps), len(taps) + EXTRA
    at = c * width * LANES
    for j in range(width):
        v = splat(poly[j])
        for d in range(1, degree + 1):
            v = v * r + splat(poly[d * width + j])
        store(desk.weights, at + LANES * j, v)


@jit(fast=True)
def _place(desk, count, antenna, w, sheet):
    """Rows, weights and factors of `count` lines in the chirps that an antenna sends."""
    to_beat, size = 1 / (LINES * w.step * sheet.size), float(sheet.size)
    low, high = desk.lines[0] * to_beat, desk.lines[count - 1] * to_beat
    for c in range(TOGETHER):
        if desk.antenna[c] != antenna:
            continue
        data, sent = desk.times[c, 1], desk.sent[c]
        lines = load(desk.lines, 0)
        turned = lines * splat(-to_beat * data)
        x, y = cos_sin(narrow(turned - floor(turned + splat(0.5))))
        re, im = splat(np.float32(sent.real)), splat(np.float32(sent.imag))
        store(desk.factor, c * 2 * LANES, x * re - y * im)
        store(desk.factor, c * 2 * LANES + LANES, x * im + y * re)
        place = lines * splat(1 / LINES) + splat(w.slope * w.step * size * data)
        place = place - splat(size) * floor(place * splat(1 / size))
        row = floor(place)
        store(desk.rows, c * LANES, row)
        store(desk.work, 0, narrow(place - row) - splat(_HALF))
        _weigh(desk, c, sheet.poly, sheet.taps)
        if low + w.slope * data < 0 or high + w.slope * data > w.rate:
            for i in range(count):
                gain = np.float32(passed(w, desk.lines[i] * to_beat / w.slope + data))
                desk.factor[c * 2 * LANES + i] *= gain
                desk.factor[c * 2 * LANES + LANES + i] *= gain


@jit(fast=True)
def _add_lines(grids, desk, count, antenna, sheet, paths, order, used):
    """Sum the paths beside each of `count` lines in the `used` chirps of the batch, and spread
    them. What the last paths leave to the next line stays in `desk.sums`."""
    steer, z, sums, zero, width = (
        paths.steer,
        desk.z,
        desk.sums,
        splat(np.float32(0)),
        len(sheet.taps),
    )
    for b in range(count):
        for half in range(0, used, _ACROSS):
            at, own = _SUMS * half, half // _ACROSS * paths.turn.shape[0]
            ar, ai = load(sums, at + 32), load(sums, at + 48)
            cr, ci = load(sums, at + 96), load(sums, at + 112)
            er, ei = load(sums, at + 160), load(sums, at + 176)
            br, bi, dr, di, fr, fi = zero, zero, zero, zero, zero, zero
            for i in range(desk.begin[b], desk.end[b]):
                n = order[i]
                k, j = 48 * n, n // LANES * _Z + n % LANES + 2 * LANES * half
                share = load(steer, k + 32) + splat(desk.share[own + n])
                rest = splat(_ONE) - share
                more = splat(_ONE) + share * rest * splat(np.float32(sheet.more))
                share, rest = share * more, rest * more
                sr, si = load(steer, k), load(steer, k + 16)
                tr, ti = sr * share, si * share
                sr, si = sr * rest, si * rest
                ar, ai = _one(z, j, sr, si, ar, ai)
                br, bi = _one(z, j, tr, ti, br, bi)
                cr, ci = _one(z, j + 32, sr, si, cr, ci)
                dr, di = _one(z, j + 32, tr, ti, dr, di)
                er, ei = _one(z, j + 64, sr, si, er, ei)
                fr, fi = _one(z, j + 64, tr, ti, fr, fi)
            _keep(sums, at, ar, ai, br, bi)
            _keep(sums, at + _SUMS, cr, ci, dr, di)
            _keep(sums, at + 2 * _SUMS, er, ei, fr, fi)
        for c in range(TOGETHER):
            if desk.antenna[c] != antenna:
                continue
            row, at, k = int(desk.rows[c * LANES + b]), _SUMS * c, c * 2 * LANES + b
            ar, ai = load(sums, at), load(sums, at + 16)
            x, y = splat(desk.factor[k]), splat(desk.factor[k + LANES])
            ar, ai = x * ar - y * ai, x * ai + y * ar
            to, j = c * sheet.stride + sheet.inner + row * ROW, c * width * LANES + b
            for _tap in range(width):
                u = splat(desk.weights[j])
                store(grids, to, load(grids, to) + u * ar)
                store(grids, to + 16, load(grids, to + 16) + u * ai)
                to += ROW
                j += LANES


@jit(inline=True)
def _keep(sums, at, ar, ai, br, bi):
    """Write a chirp's sums for the lower line and the upper one."""
    store(sums, at, ar)
    store(sums, at + 16, ai)
    store(sums, at + 32, br)
    store(sums, at + 48, bi)


@jit(fast=True)
def _send(desk, chirps, link, offset, t, w):
    """What reaches the chirps of a batch from a link's transmitter, so many groups apart."""
    groups, num_chirps = t.send.shape[1:]
    desk.antenna[:] = -1
    for c in range(chirps.shape[0]):
        m, p = chirps[c] // num_chirps, chirps[c] % num_chirps
        source = m - offset
        if source < 0 or source >= groups or t.send[link, source, p] == 0:
            continue
        data = t.symbol_delay[link, source, p]
        cycles = data * (w.carrier + w.slope * w.middle - w.slope / 2 * data)
        turned = 2 * np.pi * (cycles - np.floor(cycles))
        desk.sent[c] = t.send[link, source, p] * complex(np.cos(turned), np.sin(turned))
        desk.times[c, 0] = w.first + p * w.slot + m * w.spacing
        desk.times[c, 1] = data
        desk.antenna[c] = t.antenna[link, source, p]


@jit(fast=True)
def _gather(desk, order, below, i, stop, line, pending):
    """The next lines, up to 16, and which paths lie above each, from place i of the `order` on;
    `pending` : whether paths above `line` have a share in the next.

    Returns
    -------
    Their number; i, line and pending for the next call
    """
    count = 0
    while count < LANES and (pending or i < stop):
        line = line + 1.0 if pending else below[order[i]]
        desk.lines[count], desk.begin[count] = line, i
        while i < stop and below[order[i]] == line:
            i += 1
        desk.end[count] = i
        pending = i > desk.begin[count]
        count += 1
    return count, i, line, pending


@jit(fast=True)
def add_covered(grids, paths, segment, chirps, t, w, sheet, desk):
    """Add all paths to the grids of a batch of chirps."""
    order, below = paths.order[segment], paths.below[segment]
    begin = 0
    for g in range(paths.groups.shape[0]):
        link, offset, first, end = paths.groups[g]
        _send(desk, chirps, link, offset, t, w)
        stop = begin + end - first
        for antenna in range(paths.phase.shape[0]):
            if not (desk.antenna == antenna).any():
                continue
            last = first + (end - first + LANES - 1) // LANES * LANES
            _shares(desk, paths, first, last, antenna, segment)
            _amplitudes(desk, paths, first, last, antenna)
            desk.sums[:] = np.float32(0)
            i, line, pending = begin, 0.0, False
            while pending or i < stop:
                count, i, line, pending = _gather(desk, order, below, i, stop, line, pending)
                _place(desk, count, antenna, w, sheet)
                used = chirps.shape[0]
                _add_lines(grids, desk, count, antenna, sheet, paths, order, used)
        begin = stop
