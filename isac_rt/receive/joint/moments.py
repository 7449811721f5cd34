"""Sums of a frame's samples against tones: the samples are transformed once, and every tone reads
its sums from the transform.

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

import numpy as np
import scipy.fft
from numpy.polynomial import Chebyshev
from scipy.special import i0

from isac_rt.kernels import receive_joint
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.vector import LANES, new_memory
from isac_rt.receive.joint.tones import Tones, Weights
from isac_rt.receive.known import Known
from isac_rt.receive.spectrum import transform

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
        """(M, P, G, lanes) transform of the weighted samples, counted from sample N // 2; lanes
        beyond the receivers are zero."""
        num_groups, num_rx, num_chirps, length = self._samples.shape
        # a multiple of 8 and of nothing but 2, 3 and 5, for the reception's own transform
        size = 8 * scipy.fft.next_fast_len(int(np.ceil(OVERSAMPLING * length / 8)), real=True)
        lanes = num_rx + -num_rx % LANES
        factor = np.zeros((lanes, size), np.complex64)
        factor[:, :length] = _weights(length, size)
        phasor = np.exp(2j * np.pi * (np.arange(size) * (length // 2) % size) / size)
        phasors = np.repeat(phasor.astype(np.complex64)[:, None], lanes, axis=1)
        padded = np.zeros((num_chirps, lanes, size), np.complex64)
        out = new_memory((num_groups, num_chirps, size, lanes))
        for group, made in zip(self._samples, out, strict=True):  # receivers in the place of chirps
            padded[:, :num_rx, :length] = group.swapaxes(0, 1)
            transform(padded, factor, np.arange(size), made, phasor=phasors)
        return out

    @cached_property
    def noise(self) -> float:
        """Power of the noise in a sample, from the median of one receiver's spectrum under Hann's
        window."""
        window = np.hanning(self._samples.shape[-1]).astype(np.float32)
        spectrum = scipy.fft.fft(self._samples[0, 0] * window, axis=1, workers=1)
        gain = np.log(2) * float((window**2).sum())
        return max(float(np.median(np.abs(spectrum) ** 2)) / gain, 1e-30)

    def of(self, tones: Tones, weights: Weights) -> np.ndarray:
        """(K, 2, I, A, L_rx) sums of s n^q g_i T* of each tone, but for the data's phases, which
        are taken out, n from the chirp's middle."""
        shape = len(tones.cycles), 2, len(weights.factors), weights.num_sums, tones.delay.shape[1]
        out, size = np.zeros(shape, complex), self._samples.shape[-1]
        shift = size // 2 - (size - 1) / 2
        factors = weights.factors * self.known.phases.conj()
        turned = weights._replace(factors=factors)
        fill_sums(self.spectrum.view(np.float32), tones, turned, shift, _kernel(), out)
        return out


@lru_cache(maxsize=8)
def _weights(length: int, size: int) -> np.ndarray:
    """(N,) float32, one over the kernel's transform."""
    at = (np.arange(length) - length // 2) / size
    root = np.sqrt(SHAPE**2 - (np.pi * TAPS * at) ** 2)
    return (i0(SHAPE) * root / (TAPS * np.sinh(root))).astype(np.float32)


@lru_cache(maxsize=1)
def _kernel() -> np.ndarray:
    """(STEPS, 4, TAPS) float32, the kernel and its three derivatives at the taps about a frequency,
    in the middle of each step from one grid point to the next."""
    position = (np.arange(STEPS) + 0.5) / STEPS
    out = np.empty((STEPS, 4, TAPS), np.float32)
    for j in range(TAPS):

        def kernel(part: np.ndarray, j: int = j) -> np.ndarray:
            x = 2 * (part + TAPS // 2 - 1 - j) / TAPS
            return i0(SHAPE * np.sqrt(np.maximum(1 - x**2, 0))) / i0(SHAPE)

        exact = Chebyshev.interpolate(kernel, 17, [0, 1])
        for order in range(4):
            out[:, order, j] = exact.deriv(order)(position) if order else exact(position)
    return out


@twin_of(receive_joint.interpolate)
def fill_sums(
    spectrum: np.ndarray,
    tones: Tones,
    weights: Weights,
    late: float,
    kernel: np.ndarray,
    out: np.ndarray,
) -> None:
    """Fill `Moments.of` from the spectrum, (M, P, G, 2 lanes) real and imaginary parts in turn;
    `late` is the place of sample N // 2 from the middle, `kernel` see `_kernel`."""
    data, t, (factors, sum_index, _) = spectrum.view(np.complex64), tones, weights
    (steps, _, taps), size = kernel.shape, data.shape[2]
    group, chirp = np.indices(sum_index.shape)[..., None]
    for k, rx in np.ndindex(len(out), out.shape[4]):
        own, f = t.delay[k, rx], t.frequency[k]
        ramp = own * t.slope * t.interval
        at = (f + ramp) * size
        whole, part = np.floor(at).astype(int), at % 1 * steps
        step = np.minimum(part.astype(int), steps - 1)
        x, table = ((part - step - 0.5) / steps)[..., None], kernel[step]
        values = table[..., 0, :] + x * (table[..., 1, :] + x / 2 * table[..., 2, :])
        slopes = table[..., 1, :] + x * (table[..., 2, :] + x / 2 * table[..., 3, :])
        near = data[group, chirp, (whole[..., None] - taps // 2 + 1 + np.arange(taps)) % size, rx]
        cycles = own * t.middle[k] - t.slope * own**2 / 2 + ramp * late + t.cycles[k] + f * late
        cycles = cycles + (t.carrier[k] - t.middle[k]) * own
        back = np.exp(-2j * np.pi * (cycles % 1))
        zeroth = (values * near).sum(axis=-1) * back
        first = 1j * size / (2 * np.pi) * (slopes * near).sum(axis=-1) * back + late * zeroth
        for a in range(out.shape[3]):
            here = sum_index == a
            out[k, 0, :, a, rx] += factors[:, here] @ zeroth[here]
            out[k, 1, :, a, rx] += factors[:, here] @ first[here]
