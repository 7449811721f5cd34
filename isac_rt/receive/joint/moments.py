"""Sums of a frame's samples against tones that move little: the samples are read once for a path,
and what a fit asks of them again and again comes from sums over short blocks.

A block of L samples s about its middle n_b, turned back by the tone for which it was made, is kept
as S_0 = sum s and S_1 = sum nu s, nu the place in the block. A tone that is off by x cycles per
sample then finds, with t = 2 pi x,

    sum_nu s exp(-j t nu) = S_0 (1 - t^2 V / 2) - j t S_1,    V = (L^2 - 1) / 12,

to 1e-5 of a tone, and 2e-3 of noise, for half a cell and sixteen blocks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.receive.known import Known

BLOCKS = 16
MOST_OFF = 0.5
"""Cells by which a tone may be off the one for which blocks were made."""


class _Blocks(NamedTuple):
    """`sums` (2, M, L_rx, P, blocks) about tones of a `frequency` (M, P) and a `ramp` (L_rx,)
    [cycles per sample]."""

    frequency: np.ndarray
    ramp: np.ndarray
    sums: np.ndarray


class Moments:
    """A frame's samples as tones find them.

    Attributes
    ----------
    known : Known
    energy : sum of the samples' squares
    size : number of samples
    """

    def __init__(self, samples: np.ndarray, known: Known) -> None:
        """`samples` is (M, L_rx, P, N)."""
        self.known = known
        self.energy, self.size = float(np.vdot(samples, samples).real), samples.size
        self._samples = np.ascontiguousarray(samples, np.complex64)
        self._kept: list[_Blocks] = []

    def of(
        self, frequency: np.ndarray, curvature: float, ramp: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sums of s T* and n s T* over each chirp, n from its middle: two of (M, L_rx, P).

        Parameters
        ----------
        frequency : (M, P) of the tones T [cycles per sample]
        curvature : half of their chirp rate [cycles per sample^2]
        ramp : (L_rx,) further frequency at each receiver
        """
        blocks = self._blocks(frequency, curvature, ramp)
        out = np.empty((2, *blocks.sums.shape[1:4]), np.complex128)
        _evaluate(
            blocks.sums,
            frequency - blocks.frequency,
            ramp - blocks.ramp,
            self._samples.shape[-1] // blocks.sums.shape[-1],
            out,
        )
        out *= self.known.phases.conj()[:, None, :]
        return out[0], out[1]

    def _blocks(self, frequency: np.ndarray, curvature: float, ramp: np.ndarray) -> _Blocks:
        size = self._samples.shape[-1]
        for kept in self._kept:
            off = np.abs(frequency - kept.frequency).max() + np.abs(ramp - kept.ramp).max()
            if off * size < MOST_OFF:
                return kept
        length = max(d for d in range(1, max(size // BLOCKS, 1) + 1) if size % d == 0)
        n = np.arange(size) - (size - 1) / 2
        ramps = np.exp(-2j * np.pi * np.outer(ramp, n)).astype(np.complex64)
        sums = np.empty((2, *self._samples.shape[:3], size // length), np.complex64)
        _compress(self._samples, frequency, curvature, ramps, length, sums)
        made = _Blocks(frequency, ramp, sums)
        self._kept.append(made)
        return made


@jit(fast=True)
def _compress(samples, frequency, curvature, ramps, length, sums):
    """`_Blocks.sums` of samples times ramps[rx] and the conjugate tone of each chirp."""
    num_groups, num_rx, num_chirps, size = samples.shape
    cosine, sine = np.empty(size, np.float32), np.empty(size, np.float32)
    for m in range(num_groups):
        for p in range(num_chirps):
            for i in range(size):
                n = i - (size - 1) / 2
                cycles = (frequency[m, p] + curvature * n) * n
                angle = np.float32(2 * np.pi * (cycles - np.floor(cycles)))
                cosine[i], sine[i] = np.cos(angle), -np.sin(angle)
            for rx in range(num_rx):
                line, ramp = samples[m, rx, p], ramps[rx]
                for b in range(size // length):
                    re0 = im0 = re1 = im1 = np.float32(0.0)
                    place = np.float32(-(length - 1) / 2)
                    for i in range(b * length, (b + 1) * length):
                        c = ramp[i].real * cosine[i] - ramp[i].imag * sine[i]
                        s = ramp[i].real * sine[i] + ramp[i].imag * cosine[i]
                        re = line[i].real * c - line[i].imag * s
                        im = line[i].real * s + line[i].imag * c
                        re0 += re
                        im0 += im
                        re1 += place * re
                        im1 += place * im
                        place += np.float32(1.0)
                    sums[0, m, rx, p, b] = complex(re0, im0)
                    sums[1, m, rx, p, b] = complex(re1, im1)


@jit
def _evaluate(sums, frequency, ramp, length, out):
    """Moments of tones that are off the blocks' by frequency[m, p] + ramp[rx]."""
    _, num_groups, num_rx, num_chirps, blocks = sums.shape
    spread = (length * length - 1) / 12
    first = -(blocks - 1) / 2 * length
    for m in range(num_groups):
        for rx in range(num_rx):
            for p in range(num_chirps):
                t = 2 * np.pi * (frequency[m, p] + ramp[rx])
                turn = complex(np.cos(t * first), -np.sin(t * first))
                step = complex(np.cos(t * length), -np.sin(t * length))
                zeroth, moment, middle = 0j, 0j, first
                for b in range(blocks):
                    s0, s1 = sums[0, m, rx, p, b], sums[1, m, rx, p, b]
                    at0 = turn * (s0 * (1 - t * t * spread / 2) - 1j * t * s1)
                    zeroth += at0
                    moment += middle * at0 + turn * (s1 - 1j * t * spread * s0)
                    turn *= step
                    middle += length
                out[0, m, rx, p], out[1, m, rx, p] = zeroth, moment


@jit
def tone_sums(offset, cycles, size, out):
    """out[k] (3, ...), sums over n = -(N-1)/2 .. (N-1)/2 of n^k exp(j 2 pi (x n + c)), x an
    `offset` below a half in magnitude [cycles per sample], c `cycles`."""
    second = size * (size * size - 1) / 12
    fourth = size * (size * size - 1) * (3 * size * size - 7) / 240
    flat, turns, sums = offset.ravel(), cycles.ravel(), out.reshape(3, -1)
    for i in range(flat.size):
        x = flat[i]
        if abs(x) < 1e-2 / size:  # the closed forms lose digits there
            y = 2 * np.pi * x
            sum0 = size - second * y**2 / 2
            sum1 = second * y - fourth * y**3 / 6
            sum2 = second - fourth * y**2 / 2
        else:
            s, c = np.sin(np.pi * size * x), np.cos(np.pi * size * x)
            t, k = np.sin(np.pi * x), np.cos(np.pi * x)
            sum0 = s / t
            sum1 = -(size * c * t - s * k) / (2 * t**2)
            sum2 = -((1 - size**2) * s / (4 * t) - k * (size * c * t - s * k) / (2 * t**3))
        whole = turns[i] - np.floor(turns[i])
        turn = complex(np.cos(2 * np.pi * whole), np.sin(2 * np.pi * whole))
        sums[0, i] = sum0 * turn
        sums[1, i] = 1j * sum1 * turn
        sums[2, i] = sum2 * turn
