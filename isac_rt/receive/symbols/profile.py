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

from functools import partial

import numpy as np
import scipy.fft
from scipy.special import ndtri

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.symbols.powers import ByPowers, Symbols, decide, demodulate
from isac_rt.receive.types import Detections, Prediction

FALSE_RATE = 1e-3
"""Of an empty cell in the profile."""


def learn_profile(
    cube: IFCube, prediction: Prediction, symbols: np.ndarray | None = None
) -> np.ndarray:
    """Power over noise in every cell, counted from the reference path.

    Parameters
    ----------
    cube : IFCube
    prediction : row 0 is the reference path
    symbols : (M, P) delay symbols as read; None: a frame without data

    Returns
    -------
    profile : (N,) g_k >= 0, circular; cell 0 is the reference's. Cells that noise alone would reach
        are 0
    """
    w = cube.waveform
    total = np.zeros(w.num_samples)
    for samples, turn in zip(cube.samples, derotation(w, prediction, symbols), strict=True):
        for one in samples:
            spectrum = scipy.fft.fft(one * turn, axis=-1, workers=1)
            total += (spectrum.real**2 + spectrum.imag**2).sum(axis=0)
    looks = cube.samples[..., 0].size
    noise = float(np.median(total))
    least = -float(ndtri(FALSE_RATE)) / np.sqrt(looks)
    over = total / noise - 1
    return np.where(over > least, over, 0.0)


def reference_of(detections: Detections) -> Prediction:
    """The reference among the detections of a frame, as what is expected of it."""
    q = detections.is_reference
    return Prediction(
        range=detections.range[q],
        velocity=detections.velocity[q],
        direction=detections.direction[q],
        range_std=detections.std[q, 0],
        velocity_std=detections.std[q, 1],
        weight=np.ones(int(q.sum())),
    )


def derotation(
    waveform: Waveform, prediction: Prediction, symbols: np.ndarray | None = None
) -> np.ndarray:
    """(M, P, N) complex64 by which every chirp's reference is moved to cell 0, with its delay
    symbol where there are `symbols` (M, P)."""
    w = waveform
    beats = w.beat_cells(
        prediction.range[0] / SPEED_OF_LIGHT, prediction.velocity[0] / SPEED_OF_LIGHT
    )
    beats = beats if symbols is None else beats + symbols
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


def decide_by_profile(
    profile: np.ndarray,
    power: np.ndarray,
    others: list[tuple[float, np.ndarray]],
    waveform: Waveform,
) -> tuple[np.ndarray, np.ndarray]:
    """`decide` by correlation with a profile (N,), in which the predicted paths have their vote
    already."""
    metric = correlate(power, profile)
    raw, _ = decide(metric, [], waveform)
    # next to the right symbol the template still overlaps itself: the mean of the rest is not the
    # noise's
    return raw, metric.max(axis=1) / np.median(metric, axis=1)


class ByProfile(ByPowers):
    """Delay symbols by correlation with the range profile of the last frame that was read, or held
    no data."""

    def read(
        self,
        cube: IFCube,
        prediction: Prediction,
        antennas: Antennas,
        profile: np.ndarray | None = None,
    ) -> Symbols:
        decision = None if profile is None else partial(decide_by_profile, profile)
        return demodulate(cube, prediction, self.order, self.run_cells, decision)

    def learn(
        self, cube: IFCube, detections: Detections, symbols: np.ndarray | None = None
    ) -> np.ndarray | None:
        found = learn_profile(cube, reference_of(detections), symbols)
        return found if found.any() else None
