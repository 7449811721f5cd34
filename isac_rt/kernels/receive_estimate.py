"""Templates of paths in a few range rows: correlation with the samples, and addition to them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import (
    LANES,
    cos_sin_double,
    cos_sin_exact,
    floor,
    load,
    narrow,
    not_above,
    splat,
    store,
    transpose,
)

_NONE = np.float32(0)
STENCIL = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [-1, 1], [1, -1], [1, 1]])
"""Points of a stencil (down, across): middle, cross, corners."""


class Chirps(NamedTuple):
    """Samples of `rows` range rows, float32: for each chirp and row the real and imaginary parts of
    `blocks` times 16 receivers; weight, time [s] and antenna of each chirp, the first two padded to
    a multiple of 16. `tile`: buffer of 16 x 16."""

    data: np.ndarray
    rows: int
    blocks: int
    weight: np.ndarray
    time: np.ndarray
    tx: np.ndarray
    tile: np.ndarray


class WindowAxis(NamedTuple):
    """Parameters of a template from the waveform: the window's cells per range cell, and the first
    row."""

    carrier: float
    slope: float
    middle: float
    duration: float
    length: float
    share: float
    first: float


@jit(fast=True, borrows=True)
def _square(flat, start, to_next, lanes, count, tile):
    """Load `count` complex values of `lanes` receivers, at a stride of `to_next` from `start`, and
    transpose them: real and imaginary parts of one value of all receivers."""
    if lanes < LANES or count < LANES // 2:
        tile[:] = _NONE
    for r in range(lanes):
        at = start + r * to_next
        if count == LANES // 2:
            store(tile, LANES * r, load(flat, at))
        else:
            for i in range(2 * count):
                tile[LANES * r + i] = flat[at + i]
    transpose(tile, 0)


@jit(fast=True, borrows=True)
def gather(spectra, low, share, chirps):
    """`isac_rt.receive.estimate.gather`, eight chirps of sixteen receivers at a time."""
    groups, num_rx, num_rows, num_chirps = spectra.shape
    flat, tile, out = spectra.reshape(-1).view(np.float32), chirps.tile, chirps.data
    rows, blocks, to_next = chirps.rows, chirps.blocks, 2 * num_rows * num_chirps
    for i in range(rows):
        angle = np.pi * (low + i) * share
        c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        for m in range(groups):
            for b in range(blocks):
                lanes = min(LANES, num_rx - LANES * b)
                start = (m * num_rx + LANES * b) * to_next + 2 * (low + i) * num_chirps
                for p in range(0, num_chirps, LANES // 2):
                    count = min(LANES // 2, num_chirps - p)
                    _square(flat, start + 2 * p, to_next, lanes, count, tile)
                    for q in range(count):
                        re, im = load(tile, 2 * LANES * q), load(tile, 2 * LANES * q + LANES)
                        to = (((m * num_chirps + p + q) * rows + i) * blocks + b) * 2 * LANES
                        store(out, to, c * re - s * im)
                        store(out, to + LANES, s * re + c * im)


@jit(fast=True, borrows=True)
def _template(chirps, axis, first, delay, delay_rate, steps, out):
    """Compute a path's template for 16 chirps from `first` on, 16 float32 each: weighted cosine and
    sine, weight times the sum of the rows' squared factors, and the rows' real factors. `steps`:
    cosine and sine of the phase from the first row to each."""
    carrier, slope, middle, duration, length, share, low = axis
    weight, tau = narrow(load(chirps.weight, first)), delay + delay_rate * load(chirps.time, first)
    # equation (1) of `isac_rt.receive.estimate`: beat in cells of the window, then phase
    near = (slope * tau + delay_rate * (carrier + slope * (middle - tau))) * duration
    near = (near - low) * share
    carrier_cycles, chirp, half = carrier * tau, slope * tau * (middle - 0.5 * tau), 0.5 * near
    cycles = carrier_cycles - floor(carrier_cycles) + chirp - floor(chirp)
    c, s = cos_sin_exact(cycles - floor(cycles + 0.5))
    store(out, 0, weight * c)
    store(out, LANES, weight * s)
    # window's transform in each row: sin(pi d) by the addition theorem, over pi d (1 - d^2)
    c, s = cos_sin_double(half - floor(half + 0.5))
    energy = splat(_NONE)
    for k in range(chirps.rows):
        d = near - k * share
        value, under = s * steps[0, k] - c * steps[1, k], np.pi * d * (1.0 - d * d)
        # limits of the quotient: 1 at d = 0, 1/2 at |d| = 1
        at_hole, inside = not_above(under * under, splat(1e-16)), not_above(d * d, splat(0.25))
        value = value + at_hole * (0.5 + 0.5 * inside - value)
        under = under + at_hole * (1.0 - under)
        factor = np.float32(length / 2) * (narrow(value) / narrow(under))
        store(out, (3 + k) * LANES, factor)
        energy = energy + factor * factor
    store(out, 2 * LANES, weight * energy)


@jit(inline=True)
def _add_chirp(chirps, chirp, template, lane, out, to):
    """Add conj(template) times the data of a chirp to out[to:]; `lane` of the template."""
    rows, data = chirps.rows, chirps.data
    line = 2 * LANES * chirps.blocks
    c, s = template[lane], template[LANES + lane]
    for start in range(0, line, 2 * LANES):
        at = chirp * rows * line + start
        re, im = splat(_NONE), splat(_NONE)
        for k in range(rows):
            factor = template[(3 + k) * LANES + lane]
            re = re + factor * load(data, at)
            im = im + factor * load(data, at + LANES)
            at += line
        store(out, to + start, load(out, to + start) + c * re + s * im)
        store(out, to + start + LANES, load(out, to + start + LANES) + c * im - s * re)


@jit(fast=True)
def match(chirps, axis, delays, delay_rates, out, energy):
    """`isac_rt.receive.estimate.match`, sixteen chirps of a template at a time."""
    angle = np.pi * axis.share * np.arange(chirps.rows)
    steps = np.stack((np.cos(angle), np.sin(angle)))  # from the first row to each
    _add_matches(chirps, axis, delays, delay_rates, steps, out, energy)


@jit(fast=True, borrows=True)
def _add_matches(chirps, axis, delays, delay_rates, steps, out, energy):
    """`match`, with the `steps` of `_template`; `out` (K, antennas * line) float32."""
    flat, line, template = out.reshape(-1), 2 * LANES * chirps.blocks, chirps.tile
    for first in range(0, chirps.tx.size, LANES):
        for j in range(delays.size):
            _template(chirps, axis, first, delays[j], delay_rates[j], steps, template)
            for i in range(min(LANES, chirps.tx.size - first)):
                tx = chirps.tx[first + i]
                energy[j, tx] += template[2 * LANES + i]
                to = j * out.shape[1] + tx * line
                _add_chirp(chirps, first + i, template, i, flat, to)


@jit
def _explained(chirps, axis, delays, delay_rates, antennas):
    """Return the energies (K,) that templates explain: |match|^2 over the template's energy, summed
    over antennas and receivers."""
    line = 2 * LANES * chirps.blocks
    out = np.zeros((delays.size, antennas * line), np.float32)
    energy, total = np.zeros((delays.size, antennas)), np.zeros(delays.size)
    match(chirps, axis, delays, delay_rates, out, energy)
    for j in range(delays.size):
        for t in range(antennas):
            power = 0.0
            for i in range(t * line, (t + 1) * line):
                power += np.float64(out[j, i]) ** 2
            total[j] += power / max(energy[j, t], 1e-30)
    return total


@jit
def newton(powers, step, mixed):
    """`isac_rt.receive.estimate.newton`."""
    g = np.log(np.maximum(powers, 1e-300))
    gx, gy = (g[2] - g[1]) / (2 * step), (g[4] - g[3]) / (2 * step)
    hxx = (g[2] - 2 * g[0] + g[1]) / step**2
    hyy = (g[4] - 2 * g[0] + g[3]) / step**2
    hxy = (g[8] - g[7] - g[6] + g[5]) / (4 * step**2) if g.size > 5 else mixed
    det = hxx * hyy - hxy**2
    down, across = np.copysign(step, gx), np.copysign(step, gy)
    if hxx < 0 and det > 0:
        down, across = (hyy * gx - hxy * gy) / -det, (hxx * gy - hxy * gx) / -det
    most = 3 * step
    return min(max(down, -most), most), min(max(across, -most), most), hxy


@jit
def estimate(spectra, chirps, axis, lows, counts, delays, rates, steps, units, out, energy):
    """`isac_rt.receive.estimate.estimate`, all peaks in the memory of `chirps`."""
    data, _, blocks, weight, time, tx, tile = chirps
    carrier, slope, middle, duration, length, share, _ = axis
    delay_unit, rate_unit, coupling = units
    for q in range(lows.size):
        here = Chirps(data, counts[q], blocks, weight, time, tx, tile)
        gather(spectra, lows[q], share, here)
        about = WindowAxis(carrier, slope, middle, duration, length, share, np.float64(lows[q]))
        doppler, mixed = rates[q] / rate_unit, 0.0
        beat = delays[q] / delay_unit + doppler * coupling
        for number in range(steps.size):
            step, stencil = steps[number], STENCIL[: 5 if number else len(STENCIL)]
            across = doppler + step * stencil[:, 1]
            taus = (beat + step * stencil[:, 0] - across * coupling) * delay_unit
            # objective (2) on the stencil, then a Newton step
            powers = _explained(here, about, taus, across * rate_unit, energy.shape[1])
            down, up, mixed = newton(powers, step, mixed)
            beat, doppler = beat + down, doppler + up
        delays[q], rates[q] = (beat - doppler * coupling) * delay_unit, doppler * rate_unit
        one = slice(q, q + 1)
        match(here, about, delays[one], rates[one], out[one], energy[one])


@jit
def add_template(spectra, rows, channels, schedule, beat, phasor, sent, received, window):
    """`isac_rt.receive.pursuit.add_template`."""
    length, size = window
    share = length / size
    num_chirps = spectra.shape[3]
    near, sine, cosine = np.empty(num_chirps), np.empty(num_chirps), np.empty(num_chirps)
    factor = np.empty(num_chirps, np.complex128)
    for m in range(spectra.shape[0]):
        for rx in range(spectra.shape[1]):
            for p in range(num_chirps):
                tx = schedule[m, p]
                # offset from the first row in cells of the window; amplitude of the chirp
                near[p] = (beat[m, p] + sent[tx] + received[rx] - rows[0]) * share
                sine[p], cosine[p] = np.sin(np.pi * near[p]), np.cos(np.pi * near[p])
                factor[p] = channels[tx, rx] * phasor[m, p] * (length / 2)
            for i in range(rows[1] - rows[0]):
                # sin(pi d) of row i by the addition theorem; phase about the window's start
                c, s = np.cos(np.pi * share * i), np.sin(np.pi * share * i)
                angle = np.pi * share * (rows[0] + i)
                back = complex(np.cos(angle), -np.sin(angle))
                line = spectra[m, rx, rows[0] + i]
                for p in range(num_chirps):
                    d = near[p] - i * share
                    if abs(abs(d) - 1.0) < 1e-6:
                        shape = 0.5
                    elif abs(d) < 1e-9:
                        shape = 1.0
                    else:
                        shape = (sine[p] * c - cosine[p] * s) / (np.pi * d * (1.0 - d * d))
                    line[p] += factor[p] * back * shape
