"""What acts on the samples of a cube, chirp by chirp, in one pass through its memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.hardware.oscillator import OVERSAMPLING, Record, cubic
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import (
    LANES,
    aligned,
    cos_sin_exact,
    floor,
    load,
    splat,
    store,
    swap_pairs,
    zip_high,
    zip_low,
)
from isac_rt.signal.noise import WhiteNoise, add_stream


@jit(fast=True)
def _add_phases(out, values, first, weight, scale):
    """Add scale times the cubic through `values` to each row of `out`: place n of row i lies after
    the value first[i] + 2 n."""
    for i in range(out.shape[0]):
        at, row = first[i] - 1, out[i]
        a, b, c, d = (
            scale * weight[i, 0],
            scale * weight[i, 1],
            scale * weight[i, 2],
            scale * weight[i, 3],
        )
        for n in range(row.shape[0]):
            k = at + 2 * n
            row[n] += a * values[k] + b * values[k + 1] + c * values[k + 2] + d * values[k + 3]


def add_phases(out: np.ndarray, record: Record, begin: np.ndarray, sign: float) -> None:
    """Add the phase of an oscillator to rows of samples, in cycles.

    Parameters
    ----------
    out : (R, N) float64 [cycles], added to
    begin : (R,) time of the first sample of each row [s]; the others follow at the IF's rate
    sign : 1 or -1
    """
    assert OVERSAMPLING == 2
    place = (begin - record.start) / record.step
    first = np.floor(place).astype(np.int64)
    weight = cubic(place - first)
    _add_phases(out, record.values, first, weight, sign / (2 * np.pi))


@jit(fast=True)
def _phasors(out, cycles):
    """exp(j 2 pi cycles), interleaved, of flat arrays whose length is a multiple of 16."""
    for at in range(0, cycles.shape[0], LANES):
        x = load(cycles, at)
        c, s = cos_sin_exact(x - floor(x + splat(0.5)))
        store(out, 2 * at, zip_low(c, s))
        store(out, 2 * at + LANES, zip_high(c, s))


def phasors(cycles: np.ndarray) -> np.ndarray:
    """exp(j 2 pi cycles) of float64, complex64, to 1e-7."""
    size = -(-cycles.size // LANES) * LANES
    flat = np.zeros(size)
    flat[: cycles.size] = cycles.ravel()
    out = aligned(2 * size)
    _phasors(out, flat)
    return out[: 2 * cycles.size].view(np.complex64).reshape(cycles.shape)


@jit(fast=True)
def _turn_row(flat, at, plain, crossed):
    """Multiply one chirp's samples, interleaved from flat[at], by complex factors: their real parts
    twice each, and minus and plus their imaginary parts."""
    size = plain.shape[0]
    whole = size - size % LANES
    for i in range(0, whole, LANES):
        x = load(flat, at + i)
        store(flat, at + i, x * load(plain, i) + swap_pairs(x) * load(crossed, i))
    for i in range(whole, size, 2):
        re, im = flat[at + i], flat[at + i + 1]
        flat[at + i] = re * plain[i] + im * crossed[i]
        flat[at + i + 1] = im * plain[i + 1] + re * crossed[i + 1]


class _Pass(NamedTuple):
    """What one pass through the samples does.

    Attributes
    ----------
    factors : (M P, 2 N) float32, complex factors of each chirp's samples, interleaved; (0, 0): none
    power, key : of the noise per sample [W] (0: none), and its stream
    """

    factors: np.ndarray
    power: float
    key: np.ndarray


@jit(fast=True)
def _pass(flat, shape, job, room):
    """Do it chirp by chirp, while the chirp's samples lie in the first cache."""
    groups, elements, chirps, num_samples = shape
    size = 2 * num_samples
    plain, crossed = room[0], room[1]
    for m in range(groups):
        for p in range(chirps):
            turned = job.factors.shape[0] > 0
            if turned:
                row = job.factors[m * chirps + p]
                for n in range(num_samples):
                    plain[2 * n] = plain[2 * n + 1] = row[2 * n]
                    crossed[2 * n], crossed[2 * n + 1] = -row[2 * n + 1], row[2 * n + 1]
            for r in range(elements):
                at = size * ((m * elements + r) * chirps + p)
                if turned:
                    _turn_row(flat, at, plain, crossed)
                if job.power > 0:
                    own = flat[at : at + size]
                    add_stream(
                        own, np.float32(job.power), job.key[0], job.key[1], np.uint64(at // 2)
                    )


def finish(samples: np.ndarray, factors: np.ndarray | None, noise: WhiteNoise) -> None:
    """Do to samples (M, L_rx, P, N) complex64, in place, what hardware does behind antennas.

    Parameters
    ----------
    factors : (M, P, N) complex64 by which the signal of every element is multiplied; None: none
    noise : added next, the same as by `isac_rt.signal.noise.add_white_noise`
    """
    num_samples = samples.shape[3]
    rows = np.zeros((0, 0), np.float32)
    if factors is not None:
        rows = factors.reshape(-1, num_samples).view(np.float32)
    job = _Pass(rows, noise.power, np.asarray(noise.seed_words, np.uint32))
    room = np.empty((2, 2 * num_samples), np.float32)
    _pass(samples.reshape(-1).view(np.float32), samples.shape, job, room)
