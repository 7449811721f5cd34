"""Searches for directions, and covariances of clutter, sixteen cells or directions at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, evens, larger, load, odds, splat, store, transpose

REACH = 6
"""Range cells and Doppler bins on each side of a cell whose scatterers count in its covariance;
Hann's sidelobes are 55 dB down there."""
TABLE_STEPS = 32
"""Entries per cell of the tables of responses."""
LEAST_WEIGHT = 1e-3
"""Scatterers weaker in a cell than this share of the noise are left out of its covariance."""
SCATTERERS_PER_BATCH = 8
"""Scatterers that are added to a covariance at once."""


@jit(borrows=True)
def _load_channels(flat, at, to, channels_read):
    """Sixteen cells of a channel from `at`: their real parts, then the imaginary ones."""
    a, b = load(flat, at), load(flat, at + LANES)
    store(channels_read, to, evens(a, b))
    store(channels_read, to + LANES, odds(a, b))


@jit
def line_bounds(maps, channels, spectra, out):
    """`isac_rt.receive.directions.fill_line_bounds`, two directions at a time."""
    looks, count = channels.shape
    width, line = maps.shape[1], 2 * LANES * count
    flat = maps.reshape(-1)
    channels_read, zero = np.empty(looks * line, np.float32), splat(np.float32(0))
    for first in range(0, out.size, LANES):
        for t in range(looks):
            for e in range(count):
                at = channels[t, e] * width + 2 * first
                _load_channels(flat, at, t * line + 2 * LANES * e, channels_read)
        # |sum of channels times weights|^2, added over the transmitters' lines; the largest counts
        largest = zero
        for g in range(0, len(spectra), 2):
            one, other = zero, zero
            for t in range(looks):
                re_1, im_1, re_2, im_2 = zero, zero, zero, zero
                for e in range(count):
                    to = t * line + 2 * LANES * e
                    re, im = load(channels_read, to), load(channels_read, to + LANES)
                    c, s = splat(spectra[g, e].real), splat(spectra[g, e].imag)
                    re_1, im_1 = re_1 + c * re - s * im, im_1 + c * im + s * re
                    c, s = splat(spectra[g + 1, e].real), splat(spectra[g + 1, e].imag)
                    re_2, im_2 = re_2 + c * re - s * im, im_2 + c * im + s * re
                one = one + re_1 * re_1 + im_1 * im_1
                other = other + re_2 * re_2 + im_2 * im_2
            largest = larger(largest, larger(one, other))
        store(out, first, largest)


@jit(fast=True)
def search_directions(along_x, along_z, phasors_z, phasors_x, inside, scale, peak, place):
    """`isac_rt.receive.directions.search_directions`, sixteen directions at once."""
    looks, count = along_x.shape[1], along_x.shape[3]
    lines, size = along_z.shape[2], along_z.shape[3]
    phasors, each = phasors_z.reshape(-1), scale.reshape(-1)
    power = np.empty(count * size, np.float32)
    channels_read, zero = np.empty(looks * 2 * lines * size, np.float32), splat(np.float32(0))
    sine, line = phasors_z.shape[1] * size, 2 * lines * size
    for s in range(along_x.shape[0]):
        norm = min(s, scale.shape[0] - 1) * power.size
        for t in range(looks):
            _deinterleave(along_z[s, t], channels_read[t * line : (t + 1) * line])
        for i in range(count):
            for j in range(0, size, LANES):
                total = zero
                for t in range(looks):
                    # spectra along x times phasors of their places along z, and the reverse
                    re, im = zero, zero
                    for k in range(along_x.shape[2]):
                        a, b = splat(along_x[s, t, k, i].real), splat(along_x[s, t, k, i].imag)
                        c, d = load(phasors, k * size + j), load(phasors, sine + k * size + j)
                        re, im = re + a * c - b * d, im + a * d + b * c
                    for k in range(lines):
                        a, b = splat(phasors_x[0, k, i]), splat(phasors_x[1, k, i])
                        at = t * line + k * size + j
                        c, d = load(channels_read, at), load(channels_read, at + lines * size)
                        re, im = re + a * c - b * d, im + a * d + b * c
                    total = total + (re * re + im * im)
                at = i * size + j
                store(power, at, total * load(each, norm + at))
        # the largest inside the field of view, between its neighbours on both axes
        best = _largest(power, inside)
        peak[s] = power[best]
        for axis, step in enumerate((size, 1)):
            at = best // size if axis == 0 else best % size
            place[s, axis] = at
            if 0 < at < (count if axis == 0 else size) - 1:
                _between(power[best - step], power[best], power[best + step], s, axis, peak, place)


@jit(borrows=True)
def _deinterleave(lines, out):
    """All real parts of the lines, then all imaginary ones."""
    count, size = lines.shape
    for k in range(count):
        for j in range(size):
            out[k * size + j], out[(count + k) * size + j] = lines[k, j].real, lines[k, j].imag


@jit
def _largest(power, inside):
    """Number of the largest power that lies inside."""
    most = splat(np.float32(0))
    for n in range(0, power.size, LANES):
        most = larger(most, load(power, n) * load(inside, n))
    lanes, best = np.empty(LANES, np.float32), np.float32(0)
    store(lanes, 0, most)
    for value in lanes:
        best = max(best, value)
    first = power.size - 1
    for n in range(power.size):  # without branches
        first = min(first, n if power[n] * inside[n] == best else power.size)
    return first


@jit(fast=True, inline=True)
def _between(before, middle, after, s, axis, peak, place):
    """Vertex of the parabola through the logarithms of three neighbours."""
    low = np.log(max(before, np.float32(1e-20)) / middle)
    high = np.log(max(after, np.float32(1e-20)) / middle)
    curve = low + high
    if curve < 0:
        offset = min(max(np.float32(0.5) * (low - high) / curve, np.float32(-0.5)), np.float32(0.5))
        place[s, axis] += offset
        peak[s] *= np.exp(
            np.float32(0.5) * (high - low) * offset + np.float32(0.5) * curve * offset * offset
        )


class Axis(NamedTuple):
    """The channels of an array's lines along an axis, line by line.

    Attributes
    ----------
    ends : (lines + 1,) where the channels of each line begin and end
    cosines, sines : (G, n) of exp(+j k v u) along the lines
    phasors : (2, lines, H), the same of the lines' places on the other axis
    """

    ends: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    phasors: np.ndarray


@jit(fast=True)
def quadratic_forms(matrices, order, x, z, out):
    """`isac_rt.receive.directions.quadratic_forms`, sixteen matrices at once.

    Within the lines along an axis a form depends on one cosine alone; what couples an X with a Z
    line is a product of both spectra.
    """
    count, pair, wide, high = order.size, 2 * LANES, x.cosines.shape[0], z.cosines.shape[0]
    num_x, num_z = x.cosines.shape[1], z.cosines.shape[1]
    two, least = np.float32(2), splat(np.float32(1e-6))
    none, one = np.int64(0), np.int64(1)  # bare numbers have callees compiled for them too
    channels_read = np.empty(count * count * pair, np.float32)
    total = np.empty(wide * high * LANES, np.float32)
    near, flat = np.empty(num_z * pair, np.float32), out.reshape(-1)
    far = np.empty((2, x.ends.size - 1, high, num_z), np.float32)
    for p in range(x.ends.size - 1):
        for j in range(high):
            c, d = x.phasors[0, p, j], x.phasors[1, p, j]
            for n in range(num_z):
                far[0, p, j, n] = c * z.cosines[j, n] + d * z.sines[j, n]
                far[1, p, j, n] = d * z.cosines[j, n] - c * z.sines[j, n]
    for first in range(0, len(matrices), LANES):
        here = min(LANES, len(matrices) - first)
        for s in range(LANES):  # a place without a matrix repeats the last one
            matrix = matrices[first + min(s, here - 1)]
            for m in range(count):
                for n in range(count):
                    value, at = matrix[order[m], order[n]], (n * count + m) * pair + s
                    channels_read[at], channels_read[at + LANES] = value.real, value.imag
        total[:] = 0.0
        _within(channels_read, count, none, x, total, high, one)
        _within(channels_read, count, num_x, z, total, one, high)
        for i in range(wide):
            for p in range(x.ends.size - 1):
                for r in range(z.ends.size - 1):
                    c, d = splat(two * z.phasors[0, r, i]), splat(two * z.phasors[1, r, i])
                    for n in range(z.ends[r], z.ends[r + 1]):
                        re, im = _sum(channels_read, count, num_x + n, x, p, none, i)
                        store(near, n * pair, re * c + im * d)
                        store(near, n * pair + LANES, im * c - re * d)
                for j in range(high):
                    at = (i * high + j) * LANES
                    value = load(total, at)
                    for n in range(num_z):
                        a, b = load(near, n * pair), load(near, n * pair + LANES)
                        value = value + a * splat(far[0, p, j, n]) - b * splat(far[1, p, j, n])
                    store(total, at, value)
        for at in range(0, wide * high, LANES):
            transpose(total, at * LANES)
            for s in range(here):
                value = larger(load(total, (at + s) * LANES), least)
                store(flat, (first + s) * wide * high + at, value)


@jit(fast=True, borrows=True)
def _sum(channels_read, count, n, lines, p, begin, g):
    """Sum over the channels m of line p of conj(a_m) Q_mn, real and imaginary part."""
    re, im = splat(np.float32(0)), splat(np.float32(0))
    for m in range(lines.ends[p], lines.ends[p + 1]):
        at = (n * count + begin + m) * 2 * LANES
        a, b = load(channels_read, at), load(channels_read, at + LANES)
        c, d = splat(lines.cosines[g, m]), splat(lines.sines[g, m])
        re, im = re + a * c - b * d, im + b * c + a * d
    return re, im


@jit(fast=True, borrows=True)
def _within(channels_read, count, begin, lines, total, step, other):
    """Add what an axis' own lines, whose channels begin at `begin`, have of `quadratic_forms`;
    `step` and `other` are those from one of their own directions to the next, and across."""
    for g in range(lines.cosines.shape[0]):
        for p in range(lines.ends.size - 1):
            for q in range(lines.ends.size - 1):
                re, im = splat(np.float32(0)), splat(np.float32(0))
                for n in range(lines.ends[q], lines.ends[q + 1]):
                    a, b = _sum(channels_read, count, begin + n, lines, p, begin, g)
                    c, d = splat(lines.cosines[g, n]), splat(lines.sines[g, n])
                    re, im = re + a * c + b * d, im + b * c - a * d
                for h in range(lines.phasors.shape[2]):
                    a, b = lines.phasors[0, p, h], lines.phasors[1, p, h]
                    c, d = lines.phasors[0, q, h], lines.phasors[1, q, h]
                    at = (g * step + h * other) * LANES
                    turned = re * splat(a * c + b * d) - im * splat(b * c - a * d)
                    store(total, at, load(total, at) + turned)


@jit(fast=True)
def covariances(cells, scatterers, tables, shape, out):
    """`covariance.fill_covariances` of the city receivers, `SCATTERERS_PER_BATCH` scatterers at a
    time."""
    rows, bins, num_bins = cells
    start, beat, doppler, power, steer = scatterers
    size = steer.shape[1]
    width = size + -size % LANES
    most = np.zeros((2, REACH + 1), np.float32)  # of a response, so many cells off
    for axis in range(2):
        for k in range(REACH * TABLE_STEPS + TABLE_STEPS // 2 + 1):
            cell = (k + TABLE_STEPS // 2) // TABLE_STEPS
            most[axis, cell] = max(most[axis, cell], tables[axis][k])
            if k % TABLE_STEPS == TABLE_STEPS // 2:  # between two cells
                most[axis, cell - 1] = max(most[axis, cell - 1], tables[axis][k])
    # what lies beyond the channels stays zero
    re, im = (
        np.zeros(SCATTERERS_PER_BATCH * width, np.float32),
        np.zeros(SCATTERERS_PER_BATCH * width, np.float32),
    )
    sums = np.zeros((2, size, width), np.float32)
    for c in range(rows.size):
        sums[:], count = 0.0, np.int64(0)  # as above
        for i in range(-REACH, REACH + 1):
            row = rows[c] + i
            if row < 0 or row >= (start.size - 1) // num_bins:
                continue
            for j in range(-REACH, REACH + 1):
                bucket = row * num_bins + (bins[c] + j) % num_bins
                least = LEAST_WEIGHT / (most[0, abs(i)] * most[1, abs(j)])
                for s in range(start[bucket], start[bucket + 1]):
                    if power[s] < least:
                        break  # the strongest stand first
                    at_r = abs(i + beat[s]) * TABLE_STEPS
                    at_d = abs(j + doppler[s]) * TABLE_STEPS
                    weight = power[s] * tables[0][int(at_r + 0.5)] * tables[1][int(at_d + 0.5)]
                    if weight < LEAST_WEIGHT:
                        continue
                    root = np.sqrt(weight)
                    for k in range(size):
                        re[count * width + k] = steer[s, k].real * root
                        im[count * width + k] = steer[s, k].imag * root
                    count += 1
                    if count == SCATTERERS_PER_BATCH:
                        _add_products(re, im, count, size, sums)
                        count = np.int64(0)
        _add_products(re, im, count, size, sums)
        for k in range(size):
            for m in range(k):
                value = complex(sums[0, k, m], sums[1, k, m]) * shape[k, m]
                out[c, k, m], out[c, m, k] = value, value.conjugate()
            out[c, k, k] = 1.0 + sums[0, k, k] * shape[k, k]


@jit(fast=True, borrows=True)
def _add_products(re, im, count, size, sums):
    """sums[k, m] += x[q, k] x[q, m]^* over q < `count`, for m <= k, and some that no one reads."""
    width, flat = sums.shape[2], sums.reshape(-1)
    for k in range(size):
        for m in range(0, k + 1, LANES):
            at, other = k * width + m, (size + k) * width + m
            c, d = load(flat, at), load(flat, other)
            for q in range(0, count * width, width):
                a, b = splat(re[q + k]), splat(im[q + k])
                x, y = load(re, q + m), load(im, q + m)
                c, d = c + a * x + b * y, d + b * x - a * y
            store(flat, at, c)
            store(flat, other, d)
