"""Detection and excision of foreign chirps in IF samples: short in time where echoes are narrow in
frequency.

Each chirp's spectrum loses its lines, bins over the median by a false alarm probability. Of what is
left samples are removed whose power over all antennas exceeds the threshold of noise at the same
probability: lines stay whole, so that a strong one leaves no gap that spreads over the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.fft
from scipy.special import gammainccinv, gammaincinv

from isac_rt.frame.cube import IFCube

LEAST_WINDOW = 0.2
"""Value of the window under which samples are left as they are: receivers weigh them so little."""


def excised(cube: IFCube, rate: float) -> IFCube:
    """Return samples without foreign chirps.

    Parameters
    ----------
    rate : probability that a sample of noise is taken for one
    """
    samples, size = cube.samples, cube.waveform.num_samples
    window = np.sin(np.pi * (np.arange(size) + 0.5) / size).astype(np.float32) ** 2
    antennas = samples.shape[1]
    threshold = gammainccinv(antennas, rate) / gammaincinv(antennas, 0.5)
    # a strong crossing, cut to the threshold, covers no line
    strength = (samples.real**2 + samples.imag**2).sum(axis=1, keepdims=True)
    most = threshold * np.median(strength, axis=(-2, -1), keepdims=True)
    cut = most / np.maximum(strength, np.finfo(np.float32).tiny)
    limited = scipy.fft.fft(samples * window * np.sqrt(np.minimum(cut, 1)))
    power = limited.real**2 + limited.imag**2
    # the power of noise in a bin is exponential, its median ln 2 of the mean
    most = np.median(power, axis=-1, keepdims=True) * (-np.log(rate) / np.log(2))
    lines = power > most
    spectrum = scipy.fft.fft(samples * window)
    spectrum[lines] = 0
    rest = scipy.fft.ifft(spectrum)
    # what is left of white noise: less of it, and that of the lines spread over the chirp
    share = lines.mean()
    noise = (1 - 2 * share) * window**2 + share * np.mean(window**2)
    inside = window > LEAST_WINDOW
    total = (rest.real**2 + rest.imag**2).sum(axis=1) / noise  # Gamma distributed
    level = np.median(total[..., inside], axis=(-2, -1), keepdims=True)
    hit = (total > threshold * level) & inside
    return replace(cube, samples=np.where(hit[:, None], samples - rest / window, samples))
