"""Inverses of many small covariances, sixteen side by side."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, load, splat, store


@jit(fast=True)
def inverses(matrices, out):
    """`isac_rt.receive.directions.fill_inverses`.

    Every row is swept once (J. Goodnight, "A tutorial on the SWEEP operator", Am. Stat. 33, 1979),
    in float64 and without a search for pivots. `table` holds the lower halves of sixteen matrices,
    real and imaginary parts.
    """
    size, pair = matrices.shape[1], 2 * LANES
    table = np.zeros(size * (size + 1) // 2 * pair)
    column, one, zero = np.empty(size * pair), np.empty(LANES), splat(np.float64(0))
    for first in range(0, len(matrices), LANES):
        count = min(LANES, len(matrices) - first)
        for s in range(LANES):  # a place without a matrix repeats the last one
            matrix = matrices[first + min(s, count - 1)]
            at = s
            for i in range(size):
                for j in range(i + 1):
                    table[at], table[at + LANES] = matrix[i, j].real, matrix[i, j].imag
                    at += pair
        for k in range(size):
            for i in range(size):
                low, high = min(i, k), max(i, k)
                at, to = (high * (high + 1) // 2 + low) * pair, i * pair
                store(column, to, load(table, at))
                im = load(table, at + LANES)
                store(column, to + LANES, im if i >= k else zero - im)
            for s in range(LANES):
                one[s] = 1.0 / column[k * pair + s]
            share = load(one, 0)
            for i in range(size):
                re, im = share * load(column, i * pair), share * load(column, i * pair + LANES)
                at = i * (i + 1) // 2 * pair
                if i != k:
                    for j in range(i + 1):
                        c, d = load(column, j * pair), load(column, j * pair + LANES)
                        a, b = load(table, at), load(table, at + LANES)
                        store(table, at, a - re * c - im * d)
                        store(table, at + LANES, b - im * c + re * d)
                        at += pair
            for i in range(size):
                low, high = min(i, k), max(i, k)
                at = (high * (high + 1) // 2 + low) * pair
                re, im = share * load(column, i * pair), share * load(column, i * pair + LANES)
                store(table, at, re)
                store(table, at + LANES, im if i >= k else zero - im)
            store(table, (k * (k + 1) // 2 + k) * pair, zero - share)
        for s in range(count):
            at = s
            for i in range(size):
                for j in range(i + 1):
                    value = complex(-table[at], -table[at + LANES])
                    out[first + s, i, j], out[first + s, j, i] = value, value.conjugate()
                    at += pair
