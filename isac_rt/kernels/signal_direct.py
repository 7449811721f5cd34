"""IF samples of a flat list of paths, one by one: the direct kernel."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import (
    LANES,
    aligned,
    cos_sin_exact,
    floor,
    load,
    narrow,
    splat,
    store,
    zip_high,
    zip_low,
)


class Numbers(NamedTuple):
    """The waveform's numbers in compiled code.

    Attributes
    ----------
    carrier, slope : f_c [Hz], alpha [Hz/s]
    step, middle : of a sample, and of the middle sample since the start of the reference chirp [s]
    slot, spacing : from slot to slot, and from group to group [s]
    first : middle sample of the first chirp since mid-frame [s]
    rate, transition : of the IF filter: width and skirts [Hz]
    """

    carrier: float
    slope: float
    step: float
    middle: float
    slot: float
    spacing: float
    first: float
    rate: float
    transition: float


def numbers(waveform: Any) -> Numbers:
    """The numbers of a waveform."""
    w = waveform
    middle = w.fast_time[w.num_samples // 2]
    first = middle - w.frame_duration / 2
    times = w.sample_interval, middle, w.slot_duration, w.group_spacing, first
    every = w.carrier_frequency, w.slope, *times, w.sampling_rate, w.filter_transition
    return Numbers(*map(float, every))


@jit(inline=True)
def chirp_terms(w, tau, rate, accel):
    """Start phase [cycles], frequency [cycles/sample] and quadratic term of a path about the middle
    sample.

    `tau`, `rate`: there, elements included. What is left out is cubic, below 1e-8 cycles for 10
    m/s^2.
    """
    f_c, slope, ts, u = w.carrier, w.slope, w.step, w.middle
    b = rate * ts
    a = accel * ts * ts / 2
    phase = f_c * tau + slope * tau * (u - tau / 2)
    frequency = (f_c + slope * (u - tau)) * b + slope * ts * tau
    quadratic = (f_c + slope * (u - tau)) * a + slope * b * (ts - b / 2)
    return phase - np.floor(phase), frequency, quadratic


@jit(inline=True)
def passed(w, tau):
    """Gain of the IF filter for the centroid's delay `tau`."""
    beat = w.slope * tau
    outside = max(-beat, beat - w.rate) / w.transition
    if outside <= 0.0:
        return 1.0
    if outside >= 1.0:
        return 0.0
    return 0.5 + 0.5 * np.cos(np.pi * outside)


@jit(fast=True, borrows=True)
def _phasor(out, at, cycles, amplitude):
    """amplitude exp(j 2 pi cycles) of 16 float64: real parts to out[at:], imaginary ones to out[at
    + 16:]."""
    c, s = cos_sin_exact(cycles - floor(cycles + splat(0.5)))
    re, im = splat(np.float32(amplitude.real)), splat(np.float32(amplitude.imag))
    store(out, at, re * c - im * s)
    store(out, at + 16, re * s + im * c)


@jit(fast=True, borrows=True)
def _tone(workspace, half, amplitude, phase, frequency, quadratic):
    """Add amplitude exp(j 2 pi (phase + frequency x + quadratic x^2)), x = n - N/2, to the sums: of
    each 16 samples real parts, then imaginary ones.

    With X the middle of 16 samples and i = x - X the tone is exp(phase + frequency X + quadratic
    X^2) exp(frequency i + quadratic i^2) (1 + j 4 pi quadratic X i), all phases reduced in float64;
    what is left out is the square of the last term, 1e-8 at 15 m/s.
    """
    sums, starts, lane, offsets = workspace
    # exp(frequency i + quadratic i^2) within 16 samples, and i times it
    within = load(offsets, 0)
    _phasor(lane, 0, within * (splat(frequency) + within * splat(quadratic)), 1.0 + 0.0j)
    lr, li, offset = load(lane, 0), load(lane, 16), narrow(within)
    mr, mi = offset * lr, offset * li
    blocks, curvature = sums.shape[0] // 32, np.float32(4 * np.pi * quadratic)
    for first in range(0, blocks, LANES):
        # of 16 middles X: the phasor, and j 4 pi quadratic X times it
        x = load(offsets, 16) + splat(first * LANES - half)
        _phasor(starts, 0, splat(phase) + x * (splat(frequency) + x * splat(quadratic)), amplitude)
        cross = narrow(x) * splat(curvature)
        store(starts, 32, splat(np.float32(0)) - cross * load(starts, 16))
        store(starts, 48, cross * load(starts, 0))
        # sums of the products
        for i in range(min(LANES, blocks - first)):
            at = 32 * (first + i)
            pr, pi, qr, qi = (
                splat(starts[i]),
                splat(starts[16 + i]),
                splat(starts[32 + i]),
                splat(starts[48 + i]),
            )
            store(sums, at, (load(sums, at) + pr * lr - pi * li) + (qr * mr - qi * mi))
            store(sums, at + 16, (load(sums, at + 16) + pr * li + pi * lr) + (qr * mi + qi * mr))


@jit(fast=True, borrows=True)
def flush(out, to, num_samples, sums, fresh):
    """Write the sums of one chirp to its samples, from out[to] on, or add them, and clear them."""
    zero = splat(np.float32(0))
    for at in range(0, 2 * num_samples, 32):
        re, im, here = load(sums, at), load(sums, at + 16), to + at
        if at + 32 > 2 * num_samples:
            for i in range(num_samples - at // 2):
                out[here + 2 * i] = sums[at + i] if fresh else out[here + 2 * i] + sums[at + i]
                out[here + 2 * i + 1] = (
                    sums[at + 16 + i] if fresh else out[here + 2 * i + 1] + sums[at + 16 + i]
                )
        elif fresh:
            store(out, here, zip_low(re, im))
            store(out, here + 16, zip_high(re, im))
        else:
            store(out, here, load(out, here) + zip_low(re, im))
            store(out, here + 16, load(out, here + 16) + zip_high(re, im))
        store(sums, at, zero)
        store(sums, at + 16, zero)


@jit(fast=True, borrows=True)
def _multiplied(sums, factor):
    """Multiply the sums of one chirp by as many complex factors, interleaved."""
    for n in range(factor.shape[0] // 2):
        at = 32 * (n // LANES) + n % LANES
        re, im, c, s = sums[at], sums[at + 16], factor[2 * n], factor[2 * n + 1]
        sums[at], sums[at + 16] = re * c - im * s, re * s + im * c


class _Workspace(NamedTuple):
    """Memory of the kernel: sums of a chirp, phasors of 16 blocks and within one, and the places of
    the 16 within a block and of the 16 blocks' middles."""

    sums: np.ndarray
    starts: np.ndarray
    lane: np.ndarray
    offsets: np.ndarray


class OneByOne(NamedTuple):
    """Paths and group offsets (K,) of tones, and the memory of their sums.

    The first `slots[0]` may live in every slot; those that may live in slot p follow at `slots[p]`
    to `slots[p + 1]`.
    """

    path: np.ndarray
    offset: np.ndarray
    slots: np.ndarray
    tones: Any
    workspace: _Workspace


def one_by_one(waveform: Any, tones: Any) -> OneByOne:
    """All that is received of some tones, for the kernels."""
    lanes = np.arange(LANES)
    offsets = np.concatenate([lanes, lanes * LANES]) + (LANES - 1) / 2 * np.repeat(
        [-1.0, 1.0], LANES
    )
    blocks = -(-waveform.num_samples // LANES)
    workspace = _Workspace(
        aligned(2 * LANES * blocks), aligned(4 * LANES), aligned(2 * LANES), offsets
    )
    path, offset = tones.sources(waveform)
    brief = lives_briefly(waveform, tones)[path]
    order, slots = _by_slot(waveform, tones.begin[path], tones.end[path], brief)
    return OneByOne(path[order], offset[order], slots, tones, workspace)


def lives_briefly(waveform: Any, tones: Any) -> np.ndarray:
    """Mark the paths that live for half a frame at most (K,)."""
    return tones.end - tones.begin <= waveform.frame_duration / 2


def _by_slot(
    waveform: Any, begin: np.ndarray, end: np.ndarray, is_brief: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of paths that live from `begin` to `end` (K,) in the order of `OneByOne`, a brief one
    for each slot that it may touch, and where each slot's begin (P + 1,)."""
    w, brief, whole = waveform, np.flatnonzero(is_brief), np.flatnonzero(~is_brief)
    middle = w.fast_time[w.num_samples // 2] - w.frame_duration / 2
    latest = middle + (w.num_groups - 1) * w.group_spacing
    first = np.ceil((begin[brief] - latest) / w.slot_duration).astype(np.int64)
    last = np.floor((end[brief] - middle) / w.slot_duration).astype(np.int64)
    touched = np.maximum(last - first + 1, 0)
    row = np.repeat(brief, touched)
    slot = np.repeat(first - np.cumsum(touched) + touched, touched) + np.arange(row.size)
    row, slot = (a[(slot >= 0) & (slot < w.num_chirps)] for a in (row, slot))
    order = np.concatenate([whole, row[np.argsort(slot, kind="stable")]])
    count = np.bincount(slot, minlength=w.num_chirps)
    return order, np.cumsum([whole.size, *count])


@jit(fast=True, borrows=True)
def sum_paths(alone, w, half, m, r, p):
    """Add the paths to the sums of chirp p of group m at element r; how many it has."""
    path, offset, slots, t, workspace = alone
    groups, time, count = t.send.shape[1], w.first + p * w.slot + m * w.spacing, 0
    whole, here = slots[0], slots[p]
    for n in range(whole + slots[p + 1] - here):
        i = n if n < whole else n - whole + here
        k, source = path[i], m - offset[i]
        if source < 0 or source >= groups or time < t.begin[k] or time >= t.end[k]:
            continue
        # delay of the centroid, with data; amplitude behind the filter; then the element's tone
        q = t.link[k]
        tau = (
            t.symbol_delay[q, source, p]
            + t.delay[k]
            + (t.rate[k] + t.accel[k] * time / 2) * time
            - offset[i] * w.spacing
        )
        amplitude = t.factor[k] * t.send[q, source, p] * passed(w, tau)
        if amplitude == 0:
            continue
        a = t.antenna[q, source, p]
        if t.tx_gain.shape[0]:
            amplitude *= t.tx_gain[k, a]
        if t.rx_gain.shape[0]:
            amplitude *= t.rx_gain[k, r]
        element = tau + t.tx_delay[k, a] + t.rx_delay[k, r] + t.cross[t.cross_row[k], a, r]
        terms = chirp_terms(w, element, t.rate[k] + t.accel[k] * time, t.accel[k])
        _tone(workspace, half, amplitude, *terms)
        count += 1
    return count


@jit(fast=True, borrows=True)
def _direct(out, shape, w, alone, fresh, factor):
    """Add the paths to the samples of `shape`, or write them."""
    groups, num_rx, chirps, num_samples = shape
    half, sums = float(num_samples // 2), alone.workspace.sums
    for line in range(groups * num_rx * chirps):  # as they lie in memory
        m, r, p = line // (num_rx * chirps), line // chirps % num_rx, line % chirps
        if sum_paths(alone, w, half, m, r, p) == 0 and not fresh:
            continue
        if factor.shape[0]:
            _multiplied(sums, factor[m * chirps + p])
        flush(out, 2 * num_samples * line, num_samples, sums, fresh)


def add_direct(
    samples: np.ndarray,
    waveform: Any,
    tones: Any,
    *,
    fresh: bool = False,
    factor: np.ndarray | None = None,
) -> None:
    """Add paths one by one, every element with its own delay (wideband, spherical).

    Relative error against `exact` below 1e-6: roundings of float32 (`_tone`). A path lives in whole
    chirps (it does where the middle of the window lies in its life). Runs in one thread without the
    interpreter's lock.

    Parameters
    ----------
    samples : (M, L_rx, P, N) complex64, contiguous, added to
    fresh : write instead of adding, whatever `samples` held
    factor : (M, P, N) complex64 by which the paths' samples are multiplied; None: not
    """
    alone = one_by_one(waveform, tones)
    if alone.path.size == 0:
        if fresh:
            samples[:] = 0
        return
    flat = samples.reshape(-1).view(np.float32)
    rows = np.zeros((0, 0), np.float32)
    if factor is not None:
        rows = factor.reshape(-1, factor.shape[2]).view(np.float32)
    _direct(flat, samples.shape, numbers(waveform), alone, fresh, rows)
