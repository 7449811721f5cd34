r"""Delay symbols read with the whole range profile: clutter carries the transmitter's data as the
line of sight does.

All that arrives moves by the same number of cells with a symbol, so that a frame's profile - the
mean power in every cell from the reference on - is a template of the chirp. With cells that are
circular Gaussian, of SNR g_k over the noise where the template lies and 0 elsewhere, the likelihood
of a symbol D grows with

.. math:: \sum_k \frac{g_k}{1 + g_k}\, |Y_{D+k}|^2,

a correlation over the cells, by FFT for all D at once. The plain decision takes the strongest cell
for the reference's, and stronger clutter takes its place. The profile is learned from an
unmodulated frame, and anew from every frame whose data were read.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from scipy.special import ndtri

from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.types import Prediction

FALSE_RATE = 1e-3
"""Of an empty cell in the profile."""


def learn_profile(cube: IFCube, prediction: Prediction) -> np.ndarray:
    """Power over noise in every cell of a frame without data, counted from the reference path.

    Parameters
    ----------
    cube : IFCube
    prediction : row 0 is the reference path

    Returns
    -------
    profile : (N,) g_k >= 0, circular; cell 0 is the reference's. Cells that noise alone would reach
        are 0
    """
    w = cube.waveform
    total = np.zeros(w.num_samples)
    for samples, turn in zip(cube.samples, derotation(w, prediction), strict=True):
        for one in samples:
            spectrum = scipy.fft.fft(one * turn, axis=-1, workers=1)
            total += (spectrum.real**2 + spectrum.imag**2).sum(axis=0)
    looks = cube.samples[..., 0].size
    noise = float(np.median(total))
    least = -float(ndtri(FALSE_RATE)) / np.sqrt(looks)
    over = total / noise - 1
    return np.where(over > least, over, 0.0)


def derotation(waveform: Waveform, prediction: Prediction) -> np.ndarray:
    """(M, P, N) complex64 by which every chirp's reference is moved to cell 0."""
    w = waveform
    beats = w.beat_cells(
        prediction.range[0] / SPEED_OF_LIGHT, prediction.velocity[0] / SPEED_OF_LIGHT
    )
    cycles = (beats[..., None] * (np.arange(w.num_samples) / w.num_samples)) % 1.0
    return np.exp(-2j * np.pi * cycles).astype(np.complex64)


def correlate(power: np.ndarray, profile: np.ndarray) -> np.ndarray:
    """The likelihood of every symbol, scaled as if it were the power of one cell: noise has its
    mean and spread, so that thresholds on a cell's power stay valid.

    Parameters
    ----------
    power : (P, N) of derotated chirps
    profile : (N,) from `learn_profile`, not all zero

    Returns
    -------
    metric : (P, N) over the symbol, circular
    """
    weight = profile / (1 + profile)
    spread = np.sqrt((weight**2).sum())
    noise = np.median(power, axis=1, keepdims=True).astype(np.float64)
    spectrum = (
        scipy.fft.rfft(power.astype(np.float64) - noise, axis=1) * scipy.fft.rfft(weight).conj()
    )
    return np.maximum(noise + scipy.fft.irfft(spectrum, power.shape[1], axis=1) / spread, 0.0)
