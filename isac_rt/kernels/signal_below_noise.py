r"""IF samples of below-noise paths, through lines much finer than the grid of fast-time frequency.

In a chirp a path is a tone between two lines. At each receive element linear interpolation gives a
share f of it to the upper line and 1 - f to the lower one; f includes the delays of the elements.
The lines, not the paths, are then spread on the grid. The pair of lines is chosen a few times per
frame, f for every few chirps, the amplitude z for each chirp: a path costs two products and sums
per receive element. With theta the phase over half a chirp from line to line and x the time from
mid-chirp, the error of a path is f (1 - f) theta^2 (x^2 - 1/3)/2 and the quadratic phase of its
motion (`below_noise_error`).

A data delay D is common to all paths: it shifts the lines on the grid and multiplies a line of beat
frequency F by exp(-j 2 pi F D).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from isac_rt.kernels.fourier import ROW
from isac_rt.kernels.jit import jit
from isac_rt.kernels.signal_direct import passed
from isac_rt.kernels.vector import (
    LANES,
    PART,
    aligned,
    cos_sin,
    floor,
    load,
    load_part,
    narrow,
    splat,
    store,
    unset,
)

LINES = 8
"""Lines to a step of the grid."""
CHIRPS_PER_BATCH = 12
"""Chirps for which the paths are read once."""
MAX_LINE_SHIFT = 0.5
"""Lines that paths may move by until the lines beside them are sought anew, where that takes longer
than a batch of chirps."""
TAPS = 4
"""Grid points that a line is spread on."""
LINE_ERROR = 2e-3
"""Error of a path on a line: four weights, to which twelve are fitted besides."""
EXTRA = 2
"""Degree of the weights' polynomials above the width."""
_ACROSS = 3  # chirps whose sums stay in registers, with the same shares
_Z = 2 * LANES * CHIRPS_PER_BATCH  # float32 of 16 paths' amplitudes in these chirps
_SUM = 2 * LANES  # float32 of a line's sums in a chirp
_LINE = _SUM * CHIRPS_PER_BATCH  # and in these chirps
_BLOCK = 32  # lines whose sums stay in the nearest caches
_BITS = LANES.bit_length() - 1  # n >> _BITS is n // LANES, which would mind the sign of n
_NONE, _ONE = np.float32(0), np.float32(1)


class BelowNoisePaths(NamedTuple):
    """K paths, those of one link and offset together, sixteen by sixteen: the last ones of a group
    may be repeated without amplitude.

    Attributes
    ----------
    groups : (G, 4) link, offset, first path, and the one after its last
    phase : (L_tx, K) of each transmit element, at mid-frame and in the middle of a chirp [cycles]
    phase_rate, curvature : (K,) its rate and half its second derivative [cycles/s, cycles/s^2]
    amplitude : (L_tx, K) float32
    position, drift : (K,) on the grid at mid-frame [points], and its rate [points/s]
    late : (L_tx, K) float32, by how many lines a transmit element's delay moves it
    steer : (48 K,) float32, of each path phasors of 16 receive elements, real and imaginary, and
        by how many lines their delays move it
    order : (S, K') of each part of the frame the paths of all groups, each group's by their places
    below : (S, K) float64, number of the line below each path
    """

    groups: np.ndarray
    phase: np.ndarray
    phase_rate: np.ndarray
    curvature: np.ndarray
    amplitude: np.ndarray
    position: np.ndarray
    drift: np.ndarray
    late: np.ndarray
    steer: np.ndarray
    order: np.ndarray
    below: np.ndarray


class Batches(NamedTuple):
    """Order in which chirps are made.

    Attributes
    ----------
    chirp : (M P,) number of each, those of one batch one after the other
    parts : (B, 3) of each batch the first one, their number, and the part of the frame
    """

    chirp: np.ndarray
    parts: np.ndarray


class Buffer(NamedTuple):
    """Grid on which lines are spread.

    Attributes
    ----------
    size : grid points a turn
    more : by which a path's shares f and 1 - f are raised, over f (1 - f)
    stride, inner : float32 from grid to grid, and from a path's first row to a line's
    poly : `weights` of the `TAPS` rows of a line
    """

    size: int
    more: float
    stride: int
    inner: int
    poly: np.ndarray


class Workspace(NamedTuple):
    """Memory of the sums.

    Attributes
    ----------
    z, share : of each path the amplitudes in the chirps of a batch, and the upper line's share
    sums : of each line, and of the one after the last, in every chirp
    position, weights, shift : within a grid step, of the `LINES` lines in one; in every chirp the
        weights of these, and the whole lines that its data move all lines by
    factor : of each line in every chirp
    lines, begin, end : a block of lines and the paths above each
    sent, times, antenna : of each chirp what is sent, its time and its data's delay, and by which
        element; -1: nothing
    """

    z: np.ndarray
    share: np.ndarray
    sums: np.ndarray
    position: np.ndarray
    weights: np.ndarray
    shift: np.ndarray
    factor: np.ndarray
    lines: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    sent: np.ndarray
    times: np.ndarray
    antenna: np.ndarray


def line_phase(size: int, half: float) -> float:
    """Return the phase over half a chirp from line to line [rad]."""
    return 2 * np.pi * half / (size * LINES)


def no_paths(num_tx: int) -> BelowNoisePaths:
    """Return an empty set of paths."""
    none, of_each = np.zeros(0), np.zeros((num_tx, 0))
    narrow_none = of_each.astype(np.float32)
    return BelowNoisePaths(
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


def make_workspace(paths: BelowNoisePaths) -> Workspace:
    """Room for the sums of these paths."""
    blocks = paths.phase_rate.size // LANES
    return Workspace(
        unset(blocks * _Z),
        unset(blocks * LANES * (CHIRPS_PER_BATCH // _ACROSS)),
        aligned((_BLOCK + 1) * _LINE),
        np.arange(LANES) / LINES - 0.5,
        aligned(CHIRPS_PER_BATCH * TAPS * LANES),
        np.zeros(CHIRPS_PER_BATCH, np.int64),
        aligned(CHIRPS_PER_BATCH * 2 * _BLOCK),
        np.zeros(_BLOCK),
        np.zeros(_BLOCK, np.int64),
        np.zeros(_BLOCK, np.int64),
        np.zeros(CHIRPS_PER_BATCH, np.complex128),
        np.zeros((CHIRPS_PER_BATCH, 2)),
        np.zeros(CHIRPS_PER_BATCH, np.int64),
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
        (first, min(CHIRPS_PER_BATCH, start + count - first), part[order[start]])
        for start, count in zip(begin, length, strict=True)
        for first in range(start, start + count, CHIRPS_PER_BATCH)
    ]
    return Batches(order, np.array(rows, np.int64).reshape(-1, 3))


def part_slots(waveform: Any, rate: np.ndarray, size: int) -> int:
    """Return the slots in which paths move by `MAX_LINE_SHIFT` at most: whole batches, one at
    least."""
    moved = float(np.abs(rate).max(initial=0.0)) * waveform.slot_duration * _lines(waveform, size)
    return CHIRPS_PER_BATCH * max(int(MAX_LINE_SHIFT / max(moved * CHIRPS_PER_BATCH, 1e-3)), 1)


def _lines(waveform: Any, size: int) -> float:
    """Lines by which a delay of a second moves a path."""
    return waveform.slope * waveform.sample_interval * size * LINES


def below_noise_error(waveform: Any, tones: Any, size: int) -> np.ndarray:
    """(K,) bound of the relative RMS error over a frame of paths that noise covers, of what the
    receiver's filter would let through whole.

    Four parts, added in power: what two lines leave of a path between them or, by its motion and
    its elements' delays, beyond one of them; shares of the middle of a few chirps; the quadratic
    phase; and `LINE_ERROR`.

    Parameters
    ----------
    size : grid points a turn
    """
    w, t, rate = waveform, tones, np.abs(tones.rate)
    half, lines = w.num_samples / 2, _lines(waveform, size)
    moved = np.maximum(rate * CHIRPS_PER_BATCH * w.slot_duration * lines, MAX_LINE_SHIFT) / 2
    late = (np.ascontiguousarray(d.T) for d in (t.tx_delay, t.rx_delay))  # rows are short
    beyond = moved + lines * sum(np.abs(d).max(axis=0) for d in late)
    # most of f (1 - f), f between the lines, or on one of them and evenly that far to both sides
    between = np.maximum(0.25, np.sqrt(beyond**2 / 3 + beyond**4 / 5))
    step = line_phase(size, half)
    # parts are as long as the fastest path lets them, and cut fewer of the few when they are long
    order, parts = batches(t.antenna[0], w.num_chirps)
    stale = rate * _time_spread(w, order, parts) * lines * step
    curvature = np.pi * w.slope * rate * (w.sample_interval * half) ** 2 * 2
    spread = np.sqrt(1 / 5 - 1 / 9)  # of x^2
    return np.sqrt(
        (step**2 / 2 * between * spread) ** 2
        + stale**2 / 3
        + (curvature * spread) ** 2
        + LINE_ERROR**2
    )


def _time_spread(waveform: Any, order: np.ndarray, parts: np.ndarray) -> float:
    """Return the RMS time of chirps from the middle of the batch that has the same shares [s]."""
    w = waveform
    position = np.concatenate([np.arange(count) for count in parts[:, 1]])
    few = np.repeat(np.arange(len(parts)), parts[:, 1]) * CHIRPS_PER_BATCH + position // _ACROSS
    group, slot = np.divmod(order, w.num_chirps)
    time = slot * w.slot_duration + group * w.group_spacing
    _, number, count = np.unique(few, return_inverse=True, return_counts=True)
    middle = np.bincount(number, time) / count
    return float(np.sqrt(np.mean((time - middle[number]) ** 2)))


def below_noise_paths(
    waveform: Any,
    tones: Any,
    sources: tuple[np.ndarray, np.ndarray],
    slots: int,
    size: int,
    centre: float,
    steering: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> BelowNoisePaths:
    """The paths and offsets `sources` as arrays for `add_below_noise`.

    Parameters
    ----------
    slots : of a part of the frame
    size : grid points a turn
    centre : mean of x^2 over the samples
    steering : makes the `steer` of paths (K,) with delays (K,) [half chirps]
    """
    # paths of one link and offset together, by beat, padded to a multiple of sixteen
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
    # phase at mid-chirp, with the mean of the quadratic term, and its derivatives
    path, lag = path[index], lag[index]
    delay, rate, accel = t.delay[path] - lag, t.rate[path], t.accel[path]
    sent = carrier - w.slope * delay
    step = rate * ts
    bow = (sent * accel * ts * ts / 2 + w.slope * step * (ts - step / 2)) * half**2
    extra = np.ascontiguousarray(t.tx_delay[path].T)
    element = delay + extra
    factor = t.factor[path] * t.tx_gain[path].T if t.tx_gain.size else t.factor[path]
    cycles = element * (carrier - w.slope / 2 * element) + bow * centre
    # place on the grid and its rate, and the line below in the middle of each part of the frame
    position = (w.slope * delay + rate * sent) * ts * size
    drift = w.slope * rate * ts * size
    spacing = 1 / (w.slope * ts * size * LINES)
    first_slots = np.arange(0, w.num_chirps, slots)
    after = np.minimum(first_slots + slots, w.num_chirps)
    middle = (first_slots + after - w.num_chirps) / 2 * w.slot_duration
    below = np.multiply.outer(middle, drift * LINES)
    below += position * LINES
    np.floor(below, out=below)
    shown = [
        np.argsort(below[:, first:last], axis=1, kind="stable") + first
        for first, last in groups[:, 2:]
    ]
    return BelowNoisePaths(
        groups,
        cycles + np.angle(factor) / (2 * np.pi),
        sent * rate,
        (sent * accel - w.slope * rate**2) / 2,
        np.full(element.shape, np.abs(factor) * real, np.float32),
        position,
        drift,
        (extra / spacing).astype(np.float32),
        steering(path, delay / (ts * half)),
        shown[0] if len(shown) == 1 else np.concatenate(shown, axis=1),
        below,
    )


@jit(fast=True, borrows=True)
def shift_elements(steer, late, per_line):
    """Multiply the elements' phasors (`BelowNoisePaths.steer`, with phases over half a chirp
    instead of lines) by the phase of a path's delay `late` [half chirps], to first order."""
    for i in range(late.shape[0]):
        at = 48 * i
        re, im, phase_step = load(steer, at), load(steer, at + 16), load(steer, at + 32)
        angle = phase_step * splat(np.float32(late[i]))
        store(steer, at, re + angle * im)
        store(steer, at + 16, im - angle * re)
        store(steer, at + 32, phase_step * splat(np.float32(1 / per_line)))


@jit(fast=True, borrows=True)
def _shares(workspace, paths, first, last, antenna, segment):
    """The upper lines' shares of a group's paths, in the middle of each few chirps that an antenna
    sends."""
    below, late, size = paths.below[segment], paths.late[antenna], paths.phase_rate.shape[0]
    for half in range(CHIRPS_PER_BATCH // _ACROSS):
        middle, count = 0.0, 0
        for c in range(_ACROSS * half, _ACROSS * half + _ACROSS):
            if workspace.antenna[c] == antenna:
                middle += workspace.times[c, 0]
                count += 1
        middle /= max(count, 1)
        for n in range(first, last, LANES):
            position = load(paths.position, n) + load(paths.drift, n) * splat(middle)
            share = narrow(position * splat(float(LINES)) - load(below, n)) + load(late, n)
            store(workspace.share, half * size + n, share)


@jit(fast=True, borrows=True)
def _amplitudes(workspace, paths, first, last, antenna):
    """Amplitudes of a group's paths in the chirps that an antenna sends."""
    phase, amplitude = paths.phase[antenna], paths.amplitude[antenna]
    for n in range(first, last, LANES):
        p, f, g, a = (
            load(phase, n),
            load(paths.phase_rate, n),
            load(paths.curvature, n),
            load(amplitude, n),
        )
        for c in range(CHIRPS_PER_BATCH):
            at = n // LANES * _Z + 2 * LANES * c
            if workspace.antenna[c] != antenna:
                store(workspace.z, at, splat(np.float32(0)))
                store(workspace.z, at + LANES, splat(np.float32(0)))
                continue
            time, data = workspace.times[c, 0], workspace.times[c, 1]
            cycles = p + f * splat(time + data) + g * splat(time * time)
            re, im = cos_sin(narrow(cycles - floor(cycles + splat(0.5))))
            store(workspace.z, at, a * re)
            store(workspace.z, at + LANES, a * im)


@jit(inline=True)
def _one(z, j, sr, si, ar, ai):
    """Add a path's amplitude in a chirp times its elements' phasors."""
    x, y = z[np.uint64(j)], z[np.uint64(j + LANES)]
    return ar + x * sr - y * si, ai + x * si + y * sr


@jit(fast=True, borrows=True)
def _weigh(workspace, antenna, w, buffer):
    """Where the data of the chirps that an antenna sends move all lines: by whole lines, and the
    weights of the `LINES` places within a grid step that are left."""
    for c in range(CHIRPS_PER_BATCH):
        if workspace.antenna[c] != antenna:
            continue
        moved = w.slope * w.step * buffer.size * LINES * workspace.times[c, 1]
        workspace.shift[c] = int(np.floor(moved))
        r = narrow(load(workspace.position, 0) + splat((moved - np.floor(moved)) / LINES))
        for j in range(TAPS):
            v = splat(buffer.poly[j])
            for d in range(1, TAPS + EXTRA + 1):
                v = v * r + splat(buffer.poly[d * TAPS + j])
            store(workspace.weights, (c * TAPS + j) * LANES, v)


@jit(fast=True, borrows=True)
def _factors(workspace, count, antenna, w, buffer):
    """Factors of `count` lines in the chirps that an antenna sends."""
    to_beat = 1 / (LINES * w.step * buffer.size)
    low, high = workspace.lines[0] * to_beat, workspace.lines[count - 1] * to_beat
    for c in range(CHIRPS_PER_BATCH):
        if workspace.antenna[c] != antenna:
            continue
        data, sent = workspace.times[c, 1], workspace.sent[c]
        re, im = splat(np.float32(sent.real)), splat(np.float32(sent.imag))
        own = c * 2 * _BLOCK
        for b in range(0, count, LANES):
            turned = load(workspace.lines, b) * splat(-to_beat * data)
            x, y = cos_sin(narrow(turned - floor(turned + splat(0.5))))
            store(workspace.factor, own + b, x * re - y * im)
            store(workspace.factor, own + _BLOCK + b, x * im + y * re)
        if low + w.slope * data < 0 or high + w.slope * data > w.rate:
            for b in range(count):
                gain = np.float32(passed(w, workspace.lines[b] * to_beat / w.slope + data))
                workspace.factor[own + b] *= gain
                workspace.factor[own + _BLOCK + b] *= gain


@jit(fast=True, borrows=True)
def _sum(workspace, count, buffer, paths, order, chirps):
    """Sum the paths beside each of `count` lines in the `chirps` of a batch. What paths leave to
    the line after theirs is there when its turn comes. Unsigned indices are not checked for their
    sign."""
    steer, z, sums, shares = paths.steer, workspace.z, workspace.sums, workspace.share
    size = paths.phase_rate.shape[0]
    for b in range(count):
        begin, end, line = workspace.begin[b], workspace.end[b], _LINE * b
        for first in range(0, chirps, _ACROSS):  # as often as before, which processors foresee
            own, to_z = first // _ACROSS * size, 2 * LANES * first
            for lane in range(0, LANES, PART):
                at = line + _SUM * first + lane
                ar, ai = load_part(sums, at), load_part(sums, at + 16)
                cr, ci = load_part(sums, at + 32), load_part(sums, at + 48)
                er, ei = load_part(sums, at + 64), load_part(sums, at + 80)
                zero = _NONE * ar
                br, bi, dr, di, fr, fi = zero, zero, zero, zero, zero, zero
                for i in range(begin, end):
                    n = order[np.uint64(i)]
                    k, j = 48 * n + lane, (n >> _BITS) * _Z + (n & LANES - 1) + to_z
                    share = load_part(steer, k + 32) + shares[np.uint64(own + n)]
                    under = _ONE - share
                    more = _ONE + share * under * np.float32(buffer.more)
                    share, under = share * more, under * more
                    sr, si = load_part(steer, k), load_part(steer, k + 16)
                    tr, ti = sr * share, si * share
                    sr, si = sr * under, si * under
                    ar, ai = _one(z, j, sr, si, ar, ai)
                    br, bi = _one(z, j, tr, ti, br, bi)
                    cr, ci = _one(z, j + 32, sr, si, cr, ci)
                    dr, di = _one(z, j + 32, tr, ti, dr, di)
                    er, ei = _one(z, j + 64, sr, si, er, ei)
                    fr, fi = _one(z, j + 64, tr, ti, fr, fi)
                _keep(sums, at, ar, ai, cr, ci, er, ei)
                _keep(sums, at + _LINE, br, bi, dr, di, fr, fi)


@jit(inline=True)
def _keep(sums, at, ar, ai, cr, ci, er, ei):
    """Write a line's sums in a few chirps."""
    store(sums, at, ar)
    store(sums, at + 16, ai)
    store(sums, at + 32, cr)
    store(sums, at + 48, ci)
    store(sums, at + 64, er)
    store(sums, at + 80, ei)


@jit(inline=True)
def _add(grids, to, re, im):
    """Add to a row of the grids."""
    store(grids, to, load_part(grids, to) + re)
    store(grids, to + 16, load_part(grids, to + 16) + im)


@jit(inline=True)
def _add_four(grids, to, ar, ai, br, bi, cr, ci, dr, di):
    """`_add` to this row and the three after it."""
    _add(grids, to, ar, ai)
    _add(grids, to + ROW, br, bi)
    _add(grids, to + 2 * ROW, cr, ci)
    _add(grids, to + 3 * ROW, dr, di)


@jit(fast=True, borrows=True)
def _spread(grids, workspace, count, c, buffer, lane):
    """Spread the sums of `count` lines in chirp c at the elements from `lane` on. Lines of one grid
    step are added together in registers before the grid is written."""
    shift, size, weights = workspace.shift[c], buffer.size, workspace.weights
    base, at, k = c * buffer.stride + buffer.inner + lane, c * _SUM + lane, c * 2 * _BLOCK
    last = (int(workspace.lines[0]) + shift) // LINES
    row = last % size
    zero = _NONE * load_part(workspace.sums, at)
    ar, ai, br, bi, cr, ci, dr, di = zero, zero, zero, zero, zero, zero, zero, zero
    for b in range(count):
        position = int(workspace.lines[b]) + shift
        steps = position // LINES - last
        if steps > 0:
            to = base + row * ROW
            if steps == 1:
                _add(grids, to, ar, ai)
                ar, ai, br, bi, cr, ci, dr, di = br, bi, cr, ci, dr, di, zero, zero
            else:
                _add_four(grids, to, ar, ai, br, bi, cr, ci, dr, di)
                ar, ai, br, bi, cr, ci, dr, di = zero, zero, zero, zero, zero, zero, zero, zero
            last += steps
            row = last % size
        x, y = workspace.factor[k + b], workspace.factor[k + _BLOCK + b]
        sr, si = load_part(workspace.sums, at), load_part(workspace.sums, at + 16)
        sr, si = x * sr - y * si, x * si + y * sr
        j = c * TAPS * LANES + position % LINES
        u, v = weights[j], weights[j + LANES]
        p, q = weights[j + 2 * LANES], weights[j + 3 * LANES]
        ar, ai, br, bi = ar + u * sr, ai + u * si, br + v * sr, bi + v * si
        cr, ci, dr, di = cr + p * sr, ci + p * si, dr + q * sr, di + q * si
        at += _LINE
    _add_four(grids, base + row * ROW, ar, ai, br, bi, cr, ci, dr, di)


@jit(fast=True, borrows=True)
def _send(workspace, chirps, link, offset, t, w):
    """Compute the signals that reach the chirps of a batch from a link's transmitter, per group."""
    groups, num_chirps = t.send.shape[1:]
    workspace.antenna[:] = -1
    for c in range(chirps.shape[0]):
        m, p = chirps[c] // num_chirps, chirps[c] % num_chirps
        source = m - offset
        if source < 0 or source >= groups or t.send[link, source, p] == 0:
            continue
        data = t.symbol_delay[link, source, p]
        cycles = data * (w.carrier + w.slope * w.middle - w.slope / 2 * data)
        turned = 2 * np.pi * (cycles - np.floor(cycles))
        workspace.sent[c] = t.send[link, source, p] * complex(np.cos(turned), np.sin(turned))
        workspace.times[c, 0] = w.first + p * w.slot + m * w.spacing
        workspace.times[c, 1] = data
        workspace.antenna[c] = t.antenna[link, source, p]


@jit(fast=True, borrows=True)
def _gather(workspace, order, below, i, stop, line, pending):
    """The next lines, a block at most, and which paths lie above each, from place i of `order` on;
    `pending` : whether paths above `line` have a share in the next.

    Returns
    -------
    Their number; i, line and pending for the next call
    """
    count = 0
    while count < _BLOCK and (pending or i < stop):
        line = line + 1.0 if pending else below[order[i]]
        workspace.lines[count], workspace.begin[count] = line, i
        while i < stop and below[order[i]] == line:
            i += 1
        workspace.end[count] = i
        pending = i > workspace.begin[count]
        count += 1
    return count, i, line, pending


@jit(fast=True, borrows=True)
def add_below_noise(grids, paths, segment, chirps, t, w, buffer, workspace):
    """Add all paths to the grids of a batch of chirps."""
    order, below = paths.order[segment], paths.below[segment]
    begin = np.int64(0)  # a bare 0 has `_gather` compiled for 0 too
    for g in range(paths.groups.shape[0]):
        link, offset, first, end = paths.groups[g]
        _send(workspace, chirps, link, offset, t, w)
        stop = begin + end - first
        for antenna in range(paths.phase.shape[0]):
            sends = False
            for c in range(CHIRPS_PER_BATCH):
                sends |= workspace.antenna[c] == antenna
            if not sends:
                continue
            last = first + (end - first + LANES - 1) // LANES * LANES
            _shares(workspace, paths, first, last, antenna, segment)
            _amplitudes(workspace, paths, first, last, antenna)
            _weigh(workspace, antenna, w, buffer)
            workspace.sums[:_LINE] = np.float32(0)
            i, line, pending = begin, 0.0, np.bool_(False)  # bare: a second `_gather`
            while pending or i < stop:
                count, i, line, pending = _gather(workspace, order, below, i, stop, line, pending)
                _factors(workspace, count, antenna, w, buffer)
                _sum(workspace, count, buffer, paths, order, chirps.shape[0])
                for c in range(CHIRPS_PER_BATCH):
                    for lane in range(0, LANES if workspace.antenna[c] == antenna else 0, PART):
                        _spread(grids, workspace, count, c, buffer, lane)
                for at in range(0, _LINE, LANES):
                    store(workspace.sums, at, load(workspace.sums, count * _LINE + at))
        begin = stop
