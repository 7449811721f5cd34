"""Orthogonal matching pursuit in the Doppler dictionary, vector by vector."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, evens, larger, load, odds, splat, store

RIDGE = 1e-9
"""Of an atom's energy, added to it: few or evenly spaced samples do not tell all atoms apart, and
alike ones share an amplitude then."""


@jit(fast=True)
def pursue(first, gram_re, gram_im, support, amplitude):
    """`isac_rt.receive.omp.fill_atoms`; atoms are chosen in float32."""
    sparsity, power = support.shape[1], np.empty(first.shape[1], np.float32)
    lanes = np.empty(LANES, np.float32)
    short = gram_re.astype(np.float32), gram_im.astype(np.float32)
    lower = np.empty((sparsity, sparsity), np.complex128)
    forward, parts = np.empty(sparsity, np.complex128), first.view(np.float32)
    for v in range(first.shape[0]):
        chosen, x = support[v], amplitude[v]
        for k in range(sparsity):
            _powers(parts[v], short, chosen[:k], x, power)
            chosen[k] = _largest(power, lanes)
            _fit(first[v], chosen[: k + 1], gram_re, gram_im, lower, forward, x)


@jit(fast=True, borrows=True)
def _powers(first, short, chosen, x, power):
    """Return the squared correlation of all bins once the atoms `chosen`, of amplitudes x, are
    subtracted; -1 where they lie and after the last bin. `short` is the Gram in float32."""
    (gram_re, gram_im), num_chirps = short, short[0].size // 3
    for p in range(0, power.size, LANES):
        a, b = load(first, 2 * p), load(first, 2 * p + LANES)
        re, im = evens(a, b), odds(a, b)
        for i in range(chosen.size):  # the correlation with bin p is the Gram's conjugate
            a, b = splat(np.float32(x[i].real)), splat(np.float32(x[i].imag))
            at = num_chirps - chosen[i] + p
            c, d = load(gram_re, at), load(gram_im, at)
            re, im = re - a * c - b * d, im - b * c + a * d
        store(power, p, re * re + im * im)
    power[num_chirps:] = -1.0
    for bin in chosen:
        power[bin] = -1.0


@jit(borrows=True)
def _largest(power, lanes):
    """The first number of the largest."""
    most = load(power, 0)
    for p in range(LANES, power.size, LANES):
        most = larger(most, load(power, p))
    store(lanes, 0, most)
    highest, found = lanes[0], 0
    for value in lanes:
        highest = max(highest, value)
    while power[found] < highest:
        found += 1
    return found


@jit(fast=True, borrows=True)
def _fit(first, chosen, gram_re, gram_im, lower, forward, x):
    """Least-squares amplitudes x of the atoms `chosen`; `lower` and `forward` are Cholesky's of all
    but the last atom, and become those of all. The diagonal of `lower` has the reciprocals: a
    division costs as much as ten products."""
    k, num_chirps = chosen.size - 1, gram_re.size // 3
    left, value = gram_re[0] * (1.0 + RIDGE), first[chosen[k]]
    for i in range(k):
        at = chosen[i] - chosen[k] + num_chirps
        inner = complex(gram_re[at], gram_im[at])
        for j in range(i):
            inner -= lower[k, j] * lower[i, j].conjugate()
        lower[k, i] = inner * lower[i, i].real
        left -= lower[k, i].real ** 2 + lower[k, i].imag ** 2
        value -= lower[k, i] * forward[i]
    lower[k, k] = 1 / np.sqrt(max(left, gram_re[0] * RIDGE))
    forward[k] = value * lower[k, k].real
    for i in range(k, -1, -1):
        value = forward[i]
        for j in range(i + 1, k + 1):
            value -= lower[j, i].conjugate() * x[j]
        x[i] = value * lower[i, i].real
