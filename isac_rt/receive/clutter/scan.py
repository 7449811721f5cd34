"""Kernels of the search for directions, sixteen cells or directions at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, evens, larger, load, odds, splat, store, transpose


def line_bounds(maps: np.ndarray, channels: np.ndarray, spectra: np.ndarray) -> np.ndarray:
    """(S,) largest power of each cell in a line's directions, added over the looks.

    Parameters
    ----------
    maps : (C, S) complex64
    channels : (looks, n) numbers of the line's channels
    spectra : (G, n) complex64 of the line in its directions, an even number
    """
    floats = _whole_vectors(maps)
    out = np.empty(floats.shape[1] // 2, np.float32)
    parts = np.ascontiguousarray(spectra.real), np.ascontiguousarray(spectra.imag)
    _line_bounds(floats, channels, *parts, out)
    return out[: maps.shape[1]]


def _whole_vectors(maps: np.ndarray) -> np.ndarray:
    """Complex maps (C, S) as real and imaginary parts in turn, with zeros after the last cell where
    it fills no vector."""
    short = -maps.shape[1] % LANES
    if short:
        maps = np.pad(maps, ((0, 0), (0, short)))
    return np.ascontiguousarray(maps).view(np.float32)


@jit(borrows=True)
def _hear(flat, at, to, heard):
    """Sixteen cells of a channel from `at`: their real parts, then the imaginary ones."""
    a, b = load(flat, at), load(flat, at + LANES)
    store(heard, to, evens(a, b))
    store(heard, to + LANES, odds(a, b))


@jit
def _line_bounds(maps, channels, cosines, sines, out):
    """`line_bounds`, two directions at a time; complex maps as real and imaginary parts in turn."""
    looks, count = channels.shape
    width, line = maps.shape[1], 2 * LANES * count
    flat, cosine, sine = maps.reshape(-1), cosines.reshape(-1), sines.reshape(-1)
    heard, zero = np.empty(looks * line, np.float32), splat(np.float32(0))
    for first in range(0, out.size, LANES):
        for t in range(looks):
            for e in range(count):
                at = channels[t, e] * width + 2 * first
                _hear(flat, at, t * line + 2 * LANES * e, heard)
        largest = zero
        for g in range(0, len(cosines), 2):
            one, other = zero, zero
            for t in range(looks):
                re_1, im_1, re_2, im_2 = zero, zero, zero, zero
                for e in range(count):
                    at, to = g * count + e, t * line + 2 * LANES * e
                    re, im = load(heard, to), load(heard, to + LANES)
                    c, s = splat(cosine[at]), splat(sine[at])
                    re_1, im_1 = re_1 + c * re - s * im, im_1 + c * im + s * re
                    c, s = splat(cosine[at + count]), splat(sine[at + count])
                    re_2, im_2 = re_2 + c * re - s * im, im_2 + c * im + s * re
                one = one + re_1 * re_1 + im_1 * im_1
                other = other + re_2 * re_2 + im_2 * im_2
            largest = larger(largest, larger(one, other))
        store(out, first, largest)


@jit(fast=True)
def search_coherent(along_x, along_z, turns_z, turns_x, inside, scale, peak, place):
    """Largest |a^H y|^2 times the scale of each cell, and its place in steps of the grid, between
    its neighbours on both axes.

    Parameters
    ----------
    along_x, along_z : (S, lines, G) complex64 spectra of the lines
    turns_z, turns_x : (2, lines, G) float32, cosines and sines of the lines' places on the other
        axis
    inside : (G G) float32, 1 for directions of the unit disc, else 0
    scale : (S or 1, G, G) float32
    peak, place : (S,) and (S, 2) float32, filled
    """
    size, lines = along_x.shape[2], along_z.shape[1]
    turns, each, power = turns_z.reshape(-1), scale.reshape(-1), np.empty(size * size, np.float32)
    heard, zero = np.empty(2 * lines * size, np.float32), splat(np.float32(0))
    sine = turns_z.shape[1] * size
    for s in range(along_x.shape[0]):
        norm = min(s, scale.shape[0] - 1) * power.size
        _apart(along_z[s], heard)
        for i in range(size):
            for j in range(0, size, LANES):
                re, im = zero, zero
                for k in range(along_x.shape[1]):
                    a, b = splat(along_x[s, k, i].real), splat(along_x[s, k, i].imag)
                    c, d = load(turns, k * size + j), load(turns, sine + k * size + j)
                    re, im = re + a * c - b * d, im + a * d + b * c
                for k in range(lines):
                    a, b = splat(turns_x[0, k, i]), splat(turns_x[1, k, i])
                    c, d = load(heard, k * size + j), load(heard, (lines + k) * size + j)
                    re, im = re + a * c - b * d, im + a * d + b * c
                at = i * size + j
                store(power, at, (re * re + im * im) * load(each, norm + at))
        best = _largest(power, inside)
        peak[s] = power[best]
        for axis, step in enumerate((size, 1)):
            at = best // step % size
            place[s, axis] = at
            if 0 < at < size - 1:
                _between(power[best - step], power[best], power[best + step], s, axis, peak, place)


@jit(fast=True)
def search_by_power(along_x, along_z, scale, peak, place):
    """Largest sum over the transmit antennas of |along_x(i) + along_z(j)|^2 times the scale of
    each cell, and its place (i, j) on the grid.

    Parameters
    ----------
    along_x, along_z : (S, L_tx, G) complex64
    scale : (S or 1, G, G) float32, 0 beyond the unit disc
    peak, place : (S,) float32 and (S, 2) int64, filled
    """
    looks, size = along_x.shape[1:]
    each, power = scale.reshape(-1), np.empty(size * size, np.float32)
    every, zero = np.ones(size * size, np.float32), splat(np.float32(0))
    heard = np.empty(2 * looks * size, np.float32)
    for s in range(along_x.shape[0]):
        norm = min(s, scale.shape[0] - 1) * power.size
        _apart(along_z[s], heard)
        for i in range(size):
            for j in range(0, size, LANES):
                total = zero
                for t in range(looks):
                    re = splat(along_x[s, t, i].real) + load(heard, t * size + j)
                    im = splat(along_x[s, t, i].imag) + load(heard, (looks + t) * size + j)
                    total = total + re * re + im * im
                at = i * size + j
                store(power, at, total * load(each, norm + at))
        best = _largest(power, every)
        peak[s], place[s, 0], place[s, 1] = power[best], best // size, best % size


@jit(borrows=True)
def _apart(lines, out):
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
    turns : (2, lines, G), the same of the lines' places on the other axis
    """

    ends: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    turns: np.ndarray


@jit(fast=True)
def quadratic_forms(matrices, order, x, z, out):
    """a^H Q a of all directions, out (S, G, G), from Hermitian matrices Q (S, L, L) of channels
    which `order` sorts: those of `x`, an `Axis`, then those of `z`.

    Within the lines along an axis it depends on one cosine alone; what couples an X with a Z line
    is a product of both spectra.
    """
    count, size, pair = order.size, x.cosines.shape[0], 2 * LANES
    num_x, num_z = x.cosines.shape[1], z.cosines.shape[1]
    two, least = np.float32(2), splat(np.float32(1e-6))
    heard = np.empty(count * count * pair, np.float32)
    total = np.empty(size * size * LANES, np.float32)
    near, flat = np.empty(num_z * pair, np.float32), out.reshape(-1)
    far = np.empty((2, x.ends.size - 1, size, num_z), np.float32)
    for p in range(x.ends.size - 1):
        for j in range(size):
            c, d = x.turns[0, p, j], x.turns[1, p, j]
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
                    heard[at], heard[at + LANES] = value.real, value.imag
        total[:] = 0.0
        _within(heard, count, 0, x, total, size, 1)
        _within(heard, count, num_x, z, total, 1, size)
        for i in range(size):
            for p in range(x.ends.size - 1):
                for r in range(z.ends.size - 1):
                    c, d = splat(two * z.turns[0, r, i]), splat(two * z.turns[1, r, i])
                    for n in range(z.ends[r], z.ends[r + 1]):
                        re, im = _sum(heard, count, num_x + n, x, p, 0, i)
                        store(near, n * pair, re * c + im * d)
                        store(near, n * pair + LANES, im * c - re * d)
                for j in range(size):
                    at = (i * size + j) * LANES
                    value = load(total, at)
                    for n in range(num_z):
                        a, b = load(near, n * pair), load(near, n * pair + LANES)
                        value = value + a * splat(far[0, p, j, n]) - b * splat(far[1, p, j, n])
                    store(total, at, value)
        for at in range(0, size * size, LANES):
            transpose(total, at * LANES)
            for s in range(here):
                value = larger(load(total, (at + s) * LANES), least)
                store(flat, (first + s) * size * size + at, value)


@jit(fast=True, borrows=True)
def _sum(heard, count, n, lines, p, begin, g):
    """Sum over the channels m of line p of conj(a_m) Q_mn, real and imaginary part."""
    re, im = splat(np.float32(0)), splat(np.float32(0))
    for m in range(lines.ends[p], lines.ends[p + 1]):
        at = (n * count + begin + m) * 2 * LANES
        a, b = load(heard, at), load(heard, at + LANES)
        c, d = splat(lines.cosines[g, m]), splat(lines.sines[g, m])
        re, im = re + a * c - b * d, im + b * c + a * d
    return re, im


@jit(fast=True, borrows=True)
def _within(heard, count, begin, lines, total, step, other):
    """Add what an axis' own lines, whose channels begin at `begin`, have of `quadratic_forms`;
    `step` and `other` are those from one of their own directions to the next, and across."""
    size = lines.cosines.shape[0]
    for g in range(size):
        for p in range(lines.ends.size - 1):
            for q in range(lines.ends.size - 1):
                re, im = splat(np.float32(0)), splat(np.float32(0))
                for n in range(lines.ends[q], lines.ends[q + 1]):
                    a, b = _sum(heard, count, begin + n, lines, p, begin, g)
                    c, d = splat(lines.cosines[g, n]), splat(lines.sines[g, n])
                    re, im = re + a * c + b * d, im + b * c - a * d
                for h in range(size):
                    a, b = lines.turns[0, p, h], lines.turns[1, p, h]
                    c, d = lines.turns[0, q, h], lines.turns[1, q, h]
                    at = (g * step + h * other) * LANES
                    turned = re * splat(a * c + b * d) - im * splat(b * c - a * d)
                    store(total, at, load(total, at) + turned)
