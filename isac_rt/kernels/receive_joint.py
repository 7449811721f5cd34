"""Correlations of a frame's samples, and of tones, with tones."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit

TURNED = 1e-7
"""Relative error of a truncated series of the phase between receivers."""
EXACT = 1e-8
"""Relative error of the interpolation by Chebyshev nodes."""


@jit(borrows=True)
def _nodes(reach):
    """Return the number of Chebyshev nodes for sums over frequencies within `reach` cells, which
    are band-limited to half a cycle per cell."""
    count, left = 1, np.pi * reach
    while left > EXACT and count < 64:
        count += 1
        left *= np.pi * reach / 2 / count
    return count


@jit(fast=True)
def cross(tones, pairs, weights, out):
    """`isac_rt.receive.joint.tones.fill_cross_sums`.

    The sums over the samples have a closed form, smooth in the difference of frequencies, which
    varies little over a frame: a few Chebyshev nodes interpolate it. The loop over chirps thus runs
    once for all receivers."""
    factors, sum_index, num_sums = weights
    num_weights, num_groups, num_chirps = factors.shape
    for s in range(len(pairs)):
        k, j = pairs[s]
        low, high, wide = np.inf, -np.inf, 0.0
        for m in range(num_groups):
            for p in range(num_chirps):
                x = tones.frequency[j, m, p] - tones.frequency[k, m, p]
                low, high = min(low, x), max(high, x)
                wide = max(wide, abs(tones.carrier[k, m, p] - tones.middle[k]))
        # T_j T_k* has the frequency x: sums over chirps of g_i exp(j cycles) T_c(x), by antenna,
        # and by powers of the carrier's offset z times the difference of delays
        middle, half = (low + high) / 2, max((high - low) / 2, 1e-30)
        count = _nodes(half * tones.size)
        wobble = 2 * np.pi * wide * np.abs(tones.delay[j] - tones.delay[k]).max()
        orders = 1 if wobble < TURNED else (2 if wobble * wobble / 2 < TURNED else 3)
        sums = np.zeros((orders, num_weights, num_sums, count), np.complex128)
        level = np.empty(count)
        for m in range(num_groups):
            for p in range(num_chirps):
                cycles = tones.cycles[j, m, p] - tones.cycles[k, m, p]
                angle = 2 * np.pi * (cycles - np.floor(cycles))
                phasor = complex(np.cos(angle), np.sin(angle))
                x = (tones.frequency[j, m, p] - tones.frequency[k, m, p] - middle) / half
                level[0] = 1.0  # Chebyshev polynomials T_c(x)
                if count > 1:
                    level[1] = x
                for c in range(2, count):
                    level[c] = 2 * x * level[c - 1] - level[c - 2]
                a, z = sum_index[m, p], tones.carrier[k, m, p] - tones.middle[k]
                for i in range(num_weights):
                    one = phasor * factors[i, m, p]
                    for b in range(orders):
                        for c in range(count):
                            sums[b, i, a, c] += one * level[c]
                        one *= z
        _over_nodes(tones, (k, j), (middle, half), sums, out[s])


@jit(fast=True)
def _over_nodes(tones, pair, span, sums, out):
    """Combine the sums over chirps of each Chebyshev polynomial with the closed form at the nodes
    of each receiver."""
    k, j = pair
    middle, half = span
    powers, num_weights, num_sums, num_rx = out.shape
    orders, count = sums.shape[0], sums.shape[3]
    value, shape = np.empty((3, count)), np.empty((3, count))
    for rx in range(num_rx):
        mine, other = tones.delay[k, rx], tones.delay[j, rx]
        ramp = (other - mine) * tones.slope * tones.interval
        # closed sums over the samples at the nodes, with the receiver's own difference of beats
        for i in range(count):
            node = middle + half * np.cos(np.pi * (i + 0.5) / count)
            value[0, i], value[1, i], value[2, i] = closed_sums(node + ramp, tones.size)
        # their Chebyshev coefficients
        for c in range(count):
            share = (1.0 if c == 0 else 2.0) / count
            for q in range(powers):
                shape[q, c] = 0.0
            for i in range(count):
                at = share * np.cos(np.pi * c * (i + 0.5) / count)
                for q in range(powers):
                    shape[q, c] += at * value[q, i]
        # phase of the receiver's delays; exp(j r z) to second order
        cycles = other * tones.middle[j] - mine * tones.middle[k]
        cycles -= tones.slope * (other * other - mine * mine) / 2
        angle = 2 * np.pi * (cycles - np.floor(cycles))
        phasor = complex(np.cos(angle), np.sin(angle))
        radians_per_hertz = 2 * np.pi * (other - mine)
        for i in range(num_weights):
            for a in range(num_sums):
                for q in range(powers):
                    total = 0j
                    for c in range(count):
                        one = sums[0, i, a, c]
                        if orders > 1:
                            one += complex(0, radians_per_hertz) * sums[1, i, a, c]
                        if orders > 2:
                            one -= radians_per_hertz * radians_per_hertz / 2 * sums[2, i, a, c]
                        total += shape[q, c] * one
                    out[q, i, a, rx] = total * phasor * (1j if q == 1 else 1.0)


@jit(inline=True)
def closed_sums(x, size):
    """Return the sums of exp(j 2 pi x n) times 1, -j n and n^2 over a chirp, n from its middle."""
    second = size * (size * size - 1) / 12
    if abs(x) < 1e-2 / size:  # the closed forms lose digits there
        y = 2 * np.pi * x
        fourth = second * (3 * size * size - 7) / 20
        return (
            size - second * y * y / 2,
            second * y - fourth * y * y * y / 6,
            second - fourth * y * y / 2,
        )
    s, k = np.sin(np.pi * size * x), np.cos(np.pi * size * x)
    t, u = np.sin(np.pi * x), np.cos(np.pi * x)
    edge = (size * k * t - s * u) / (t * t) / 2
    return s / t, -edge, u / t * edge - (1 - size * size) * s / t / 4


@jit(fast=True)
def interpolate(spectrum, tones, weights, late, kernel, out):
    """`isac_rt.receive.joint.moments.fill_sums`.

    The frequencies of receivers differ by a fraction of a grid point: their taps are weights on a
    common stretch of the grid."""
    factors, sum_index, _ = weights
    num_groups, num_chirps, size, width = spectrum.shape
    (steps, _, taps), num_rx = kernel.shape, out.shape[4]
    count = len(out)
    ramp, phasor = np.empty((count, num_rx)), np.empty((count, num_rx), np.complex128)
    low, span = np.empty(count), np.empty(count, np.int64)
    # phase and beat of each receiver's delay; stretch of the grid that holds all receivers
    for k in range(count):
        for rx in range(num_rx):
            own = tones.delay[k, rx]
            ramp[k, rx] = own * tones.slope * tones.interval
            cycles = own * tones.middle[k] - tones.slope * own * own / 2 + ramp[k, rx] * late
            angle = 2 * np.pi * (cycles - np.floor(cycles))
            phasor[k, rx] = complex(np.cos(angle), -np.sin(angle))
        low[k] = ramp[k].min()
        span[k] = taps + 1 + int(np.ceil((ramp[k].max() - low[k]) * size))
    zeroth, slant = np.empty(width, np.float32), np.empty(width, np.float32)
    weight, change = np.empty((2, span.max(), width), np.float32)
    tap = np.empty((2, taps), np.float32)
    for m in range(num_groups):
        for p in range(num_chirps):
            for k in range(count):  # tones of like frequencies find each other's part of the grid
                f = tones.frequency[k, m, p]
                first = np.floor((f + low[k]) * size)
                weight[:], change[:], zeroth[:], slant[:] = 0.0, 0.0, 0.0, 0.0
                # taps of each receiver and their derivatives, by Taylor series about a tabled step
                for rx in range(num_rx):
                    at = (f + ramp[k, rx]) * size
                    whole = np.floor(at)
                    part = (at - whole) * steps
                    step = min(int(part), steps - 1)
                    x, table = np.float32((part - step - 0.5) / steps), kernel[step]
                    half = x / np.float32(2)
                    for i in range(taps):
                        k1, k2 = table[1, i], table[2, i]
                        tap[0, i] = table[0, i] + x * (k1 + half * k2)
                        tap[1, i] = k1 + x * (k2 + half * table[3, i])
                    begin = int(whole - first)
                    for i in range(taps):
                        weight[begin + i, 2 * rx] = weight[begin + i, 2 * rx + 1] = tap[0, i]
                        change[begin + i, 2 * rx] = change[begin + i, 2 * rx + 1] = tap[1, i]
                # interpolated spectrum and its derivative
                at = (int(first) - taps // 2 + 1) % size
                for i in range(span[k]):
                    line, own_weight, own_change = spectrum[m, p, at], weight[i], change[i]
                    for c in range(width):
                        zeroth[c] += own_weight[c] * line[c]
                        slant[c] += own_change[c] * line[c]
                    at += 1
                    if at == size:
                        at = 0
                # sums of s T* and of s n T*, n from the chirp's middle, into the antenna's sum
                cycles = tones.cycles[k, m, p] + f * late
                angle = 2 * np.pi * (cycles - np.floor(cycles))
                back = complex(np.cos(angle), -np.sin(angle))
                wobble = 2 * np.pi * (tones.carrier[k, m, p] - tones.middle[k])
                a = sum_index[m, p]
                for rx in range(num_rx):
                    z = wobble * tones.delay[k, rx]
                    one = back * phasor[k, rx] * complex(1 - z * z / 2, -z * (1 - z * z / 6))
                    total = complex(zeroth[2 * rx], zeroth[2 * rx + 1]) * one
                    slope = size / (2 * np.pi) * complex(-slant[2 * rx + 1], slant[2 * rx]) * one
                    slope += late * total
                    for i in range(len(factors)):
                        out[k, 0, i, a, rx] += factors[i, m, p] * total
                        out[k, 1, i, a, rx] += factors[i, m, p] * slope
