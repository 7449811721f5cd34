"""Sums of a frame's samples against tones, and of tones against each other: the samples are
transformed once, and every tone reads its sums from the transform.

The sums over a chirp are

    Z_k(f) = sum_n n^k s_n exp(-j 2 pi f n),    k = 0, 1,

n from the chirp's middle. The samples are divided by the transform of a Kaiser-Bessel kernel and
transformed on a grid of 1.5 N frequencies; a tone between grid points adds `TAPS` of them, weighted
by the kernel for Z_0 and by its derivative for Z_1 (a non-uniform Fourier transform of the second
type). The curvature of a tone, 0.003 cycles at the chirp's ends, is left out.

References
----------
.. [1] A. Barnett et al., "A parallel nonuniform fast Fourier transform library based on an
   'exponential of semicircle' kernel", 2019, section 2.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.polynomial import Chebyshev
from scipy.special import i0

from isac_rt.kernels.jit import jit
from isac_rt.receive.known import Known

OVERSAMPLING, TAPS = 1.5, 8
"""Frequencies per cell, and those that a tone reads: an error of 1e-6 of the largest tone."""
SHAPE = 0.98 * np.pi * TAPS * (1 - 0.5 / OVERSAMPLING)
STEPS = 1024
"""Places between two frequencies at which the kernel is tabled; a parabola between them."""


class Moments:
    """A frame's samples as tones find them.

    Attributes
    ----------
    known : Known
    size : number of samples
    """

    def __init__(self, samples: np.ndarray, known: Known) -> None:
        """`samples` is (M, L_rx, P, N)."""
        self.known, self.size, self._samples = known, samples.size, samples

    def read_by(self, known: Known) -> Moments:
        """The same samples with other data in them; they are transformed once."""
        out = Moments(self._samples, known)
        out.spectrum, out.noise, out.energy = self.spectrum, self.noise, self.energy
        return out

    @cached_property
    def energy(self) -> float:
        """Sum of the samples' squares."""
        return float(np.vdot(self._samples, self._samples).real)

    @cached_property
    def spectrum(self) -> np.ndarray:
        """(M, P, G, L_rx) transform of the weighted samples, counted from sample N // 2."""
        num_groups, num_rx, num_chirps, length = self._samples.shape
        size = scipy.fft.next_fast_len(int(np.ceil(OVERSAMPLING * length)) + TAPS)
        middle, weight = length // 2, _weights(length, size)
        out = np.empty((num_groups, num_chirps, size, num_rx), np.complex64)
        part = np.zeros((num_rx, size), np.complex64)
        for m in range(num_groups):
            for p in range(num_chirps):
                mine = self._samples[m, :, p]
                np.multiply(mine[:, middle:], weight[middle:], out=part[:, : length - middle])
                np.multiply(mine[:, :middle], weight[:middle], out=part[:, size - middle :])
                out[m, p] = scipy.fft.fft(part, axis=1, workers=1).T
        return out

    @cached_property
    def noise(self) -> float:
        """Power of the noise in a sample, from the median of one receiver's spectrum under Hann's
        window."""
        window = np.hanning(self._samples.shape[-1]).astype(np.float32)
        spectrum = scipy.fft.fft(self._samples[0, 0] * window, axis=1, workers=1)
        gain = np.log(2) * float((window**2).sum())
        return max(float(np.median(np.abs(spectrum) ** 2)) / gain, 1e-30)

    def of(
        self, cycles: np.ndarray, frequency: np.ndarray, ramp: np.ndarray, apart: np.ndarray
    ) -> np.ndarray:
        """Sums of s T* and n s T* over each chirp, n from its middle, (2, M, P, L_rx).

        Parameters
        ----------
        cycles, frequency : (M, P) of the tones T at mid-chirp [cycles, cycles per sample], but for
            the data's phases
        ramp : (L_rx,) further frequency at each receiver
        apart : (M, P, L_rx) further phase there [cycles]
        """
        length = self._samples.shape[-1]
        num_groups, num_rx, num_chirps, _ = self._samples.shape
        out = np.empty((2, num_groups, num_chirps, num_rx), np.complex128)
        late = length // 2 - (length - 1) / 2
        _interpolate(self.spectrum, (cycles, frequency, ramp, apart), late, _kernel(), out)
        out *= self.known.phases.conj()[..., None]
        return out


@lru_cache(maxsize=8)
def _weights(length: int, size: int) -> np.ndarray:
    """(N,) float32, one over the kernel's transform."""
    at = (np.arange(length) - length // 2) / size
    root = np.sqrt(SHAPE**2 - (np.pi * TAPS * at) ** 2)
    return (i0(SHAPE) * root / (TAPS * np.sinh(root))).astype(np.float32)


@lru_cache(maxsize=1)
def _kernel() -> np.ndarray:
    """(STEPS, 4, TAPS) the kernel and its three derivatives at the taps about a frequency, in the
    middle of each step from one grid point to the next."""
    place = (np.arange(STEPS) + 0.5) / STEPS
    out = np.empty((STEPS, 4, TAPS))
    for j in range(TAPS):

        def kernel(part: np.ndarray, j: int = j) -> np.ndarray:
            x = 2 * (part + TAPS // 2 - 1 - j) / TAPS
            return i0(SHAPE * np.sqrt(np.maximum(1 - x**2, 0))) / i0(SHAPE)

        exact = Chebyshev.interpolate(kernel, 17, [0, 1])
        for order in range(4):
            out[:, order, j] = exact.deriv(order)(place) if order else exact(place)
    return out


@jit(fast=True)
def _interpolate(spectrum, tone, late, kernel, out):
    """`Moments.of` but for the data; `late` is the place of sample N // 2 from the middle."""
    cycles, frequency, ramp, apart = tone
    num_groups, num_chirps, size, num_rx = spectrum.shape
    steps, _, taps = kernel.shape
    for m in range(num_groups):
        for p in range(num_chirps):
            for rx in range(num_rx):
                f = frequency[m, p] + ramp[rx]
                whole = np.floor(f * size)
                part = (f * size - whole) * steps
                step = min(int(part), steps - 1)
                x = (part - step - 0.5) / steps
                at = (int(whole) - taps // 2 + 1) % size
                table = kernel[step]
                re0 = im0 = re1 = im1 = 0.0
                for j in range(taps):
                    k0, k1, k2, k3 = table[0, j], table[1, j], table[2, j], table[3, j]
                    weight = k0 + x * (k1 + x / 2 * k2)
                    change = k1 + x * (k2 + x / 2 * k3)
                    s = spectrum[m, p, at, rx]
                    re0 += weight * s.real
                    im0 += weight * s.imag
                    re1 += change * s.real
                    im1 += change * s.imag
                    at += 1
                    if at == size:
                        at = 0
                turns = cycles[m, p] + apart[m, p, rx] + f * late
                angle = 2 * np.pi * (turns - np.floor(turns))
                back = complex(np.cos(angle), -np.sin(angle))
                total = complex(re0, im0) * back
                out[0, m, p, rx] = total
                slope = size / (2 * np.pi) * complex(-im1, re1) * back
                out[1, m, p, rx] = slope + late * total


class Apart(NamedTuple):
    """What a tone T' has before another one T.

    Attributes
    ----------
    frequency, cycles : (M, P) at mid-chirp [cycles per sample, cycles]
    ramp : (L_rx,) further frequency at each receiver
    turn : (L_rx,) complex, further turn there
    delay, wobble : (L_rx,) and (M, P), of which the product is what is left of that turn, under a
        hundredth of a cycle [cycles]
    size : samples of a chirp
    """

    frequency: np.ndarray
    cycles: np.ndarray
    ramp: np.ndarray
    turn: np.ndarray
    delay: np.ndarray
    wobble: np.ndarray
    size: float


@jit(fast=True)
def cross_sums(apart, out):
    """Sums of 1, n and n^2 times T' T* over each chirp, out (3, M, P, L_rx)."""
    ends = _ends(apart)
    for m in range(out.shape[1]):
        for p in range(out.shape[2]):
            start = _start(apart, m, p)
            for rx in range(out.shape[3]):
                sum0, sum1, sum2, turn = _sums(apart, ends, start, rx)
                out[0, m, p, rx] = sum0 * turn
                out[1, m, p, rx] = 1j * sum1 * turn
                out[2, m, p, rx] = sum2 * turn


@jit(fast=True)
def exchange(apart, own, other, left, left_other):
    """Take what T' of amplitudes `other` (M, P) puts into the sums `left` (2, M, P, L_rx) of T out
    of them, and what T of amplitudes `own` puts into `left_other`, in place."""
    ends = _ends(apart)
    for m in range(left.shape[1]):
        for p in range(left.shape[2]):
            start = _start(apart, m, p)
            a, b = other[m, p], own[m, p]
            for rx in range(left.shape[3]):
                sum0, sum1, _, turn = _sums(apart, ends, start, rx)
                there, back = a * turn, b * turn.conjugate()
                left[0, m, p, rx] -= sum0 * there
                left[1, m, p, rx] -= 1j * sum1 * there
                left_other[0, m, p, rx] -= sum0 * back
                left_other[1, m, p, rx] += 1j * sum1 * back


@jit(inline=True)
def _ends(apart):
    """Sines and cosines of the receivers' ramps at a chirp's ends, and over a sample."""
    wide, narrow = np.pi * apart.size * apart.ramp, np.pi * apart.ramp
    return np.sin(wide), np.cos(wide), np.sin(narrow), np.cos(narrow)


@jit(inline=True)
def _start(apart, m, p):
    """Frequency of a chirp, its sines and cosines, its turn, and how much it wobbles."""
    x, cycles = apart.frequency[m, p], apart.cycles[m, p]
    angle = 2 * np.pi * (cycles - np.floor(cycles))
    wide, narrow = np.pi * apart.size * x, np.pi * x
    turn = complex(np.cos(angle), np.sin(angle))
    edge = np.sin(wide), np.cos(wide), np.sin(narrow), np.cos(narrow)
    return x, edge, turn, 2 * np.pi * apart.wobble[m, p]


@jit(inline=True)
def _sums(apart, ends, start, rx):
    """Sums of exp(j 2 pi x n) times 1, -j n and n^2 over a chirp, and the turn before them."""
    size, (x0, (e, f, g, h), common, wobble) = apart.size, start
    x = x0 + apart.ramp[rx]
    a, b, c, d = ends[0][rx], ends[1][rx], ends[2][rx], ends[3][rx]
    second = size * (size * size - 1) / 12
    if abs(x) < 1e-2 / size:  # the closed forms lose digits there
        y = 2 * np.pi * x
        fourth = second * (3 * size * size - 7) / 20
        sum0 = size - second * y * y / 2
        sum1 = second * y - fourth * y * y * y / 6
        sum2 = second - fourth * y * y / 2
    else:
        s, k, t, u = e * b + f * a, f * b - e * a, g * d + h * c, h * d - g * c
        under = 1 / t
        edge = (size * k * t - s * u) * under * under / 2
        sum0 = s * under
        sum1 = -edge
        sum2 = u * under * edge - (1 - size * size) * s * under / 4
    z = wobble * apart.delay[rx]
    return sum0, sum1, sum2, common * apart.turn[rx] * complex(1 - z * z / 2, z)
