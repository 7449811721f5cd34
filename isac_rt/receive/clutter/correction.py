r"""The platform's own velocity and the clutter's level, read off the clutter of the frame itself.

Thousands of range-Doppler cells hold clutter whose Doppler is that of the flight. With n the noise,
C the power that the mesh predicts for a cell and P what is found there, P is taken as exponential
of mean :math:`m = n + e^{\theta_0} C(\theta_1..\theta_3)`, with
:math:`\theta_1..\theta_3` what the velocity is off [m/s]. Fisher scoring of that likelihood, with
Gaussian priors as wide as such errors usually are, gives the level to tenths of a decibel and the
velocity along boresight to hundredths of m/s; across it, where little clutter is, less well, and
there it matters less. Cells that stand far out (`OUTLIER`), UAVs among them, do not count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from scipy import ndimage

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.clutter.power import REACH, cells_of, doppler_products, kept_slots, range_power
from isac_rt.receive.known import Known
from isac_rt.receive.types import ExpectedClutter

VELOCITY_STD = 0.1
"""Prior deviation of each component of the velocity [m/s]."""
LEVEL_STD = np.log(10) * 0.3
"""Prior deviation of the level's logarithm: 3 dB."""
OUTLIER = 8.0
"""A cell with this many times its mean counts for nothing; an exponential variable exceeds it in
0.03 % of the cells, four times its mean, with the level 3 dB off, in 2 %."""
FEWEST = 100
"""Cells with more clutter than noise below which nothing is fitted."""
FINE_BEAT, FINE_DOPPLER = 2, 4
MIGRATION_CELLS = 0.8
STEPS = 6
LONGEST_STEP = np.array([1.0, 0.1, 0.1, 0.1])
"""Of the level's logarithm and the velocity [m/s]; a quarter of a Doppler bin is well inside the
response's main lobe."""


@dataclass(frozen=True)
class Correction:
    """What a frame says of the terminal's own mistakes.

    Attributes
    ----------
    level : natural logarithm of the factor on all expected powers
    velocity : (3,) to be added to the terminal's velocity, body axes [m/s]
    """

    level: float
    velocity: np.ndarray

    def apply(self, clutter: ExpectedClutter) -> ExpectedClutter:
        """The clutter as it is expected after the correction."""
        closing = (clutter.departure + clutter.arrival) @ self.velocity
        return replace(
            clutter,
            delay_rate=clutter.delay_rate - closing / SPEED_OF_LIGHT,
            power=clutter.power * np.exp(self.level),
        )


def fit(power: np.ndarray, noise: float, clutter: ExpectedClutter, known: Known) -> Correction:
    """Correction of the expected clutter of an active terminal's own link.

    Parameters
    ----------
    power : (rows, P) mean power over the channels, Doppler centred; the rows up to N/2, which hold
        every chirp, are used
    noise : mean noise power of a cell
    """
    w = known.waveform
    rows = min(power.shape[0], w.num_delay_symbols)
    response = _Response(w, kept_slots(known, 0), rows)
    towards = clutter.departure + clutter.arrival
    per_velocity = -w.carrier() * w.frame_duration / SPEED_OF_LIGHT * towards  # bins per m/s
    beat, doppler = cells_of(clutter, w)
    prior = np.array([LEVEL_STD, *[VELOCITY_STD] * 3]) ** -2.0
    theta = np.zeros(4)
    for _ in range(STEPS):
        parts = np.exp(theta[0]) * response(
            beat, doppler + per_velocity @ theta[1:], clutter.power, per_velocity
        )
        used = parts[0] > noise
        if used.sum() < FEWEST:
            return Correction(0.0, np.zeros(3))
        mean, found = parts[0][used] + noise, power[:rows][used]
        kept = found < OUTLIER * mean
        slopes, excess = (parts[:, used] / mean)[:, kept], (found / mean - 1)[kept]
        step = np.linalg.solve(slopes @ slopes.T + np.diag(prior), slopes @ excess - prior * theta)
        theta = theta + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        if np.abs(step).max() < 1e-3:
            break
    return Correction(float(theta[0]), theta[1:])


class _Response:
    """Mean power of scatterers in the rows that hold all chirps, and its slopes against Doppler."""

    def __init__(self, waveform: Waveform, kept: np.ndarray, rows: int) -> None:
        self.rows, self.bins = rows, waveform.num_chirps
        products = doppler_products(waveform, kept, 0.0, FINE_DOPPLER)
        self._along = scipy.fft.rfft(np.einsum("iip->p", products).real / len(products))
        self._turn = 2j * np.pi * np.arange(self._along.size) / self.bins
        offset = np.arange(-REACH * FINE_BEAT, REACH * FINE_BEAT + 1) / FINE_BEAT
        self._across = range_power(waveform, offset, MIGRATION_CELLS)

    def __call__(
        self, beat: np.ndarray, doppler: np.ndarray, power: np.ndarray, slope: np.ndarray
    ) -> np.ndarray:
        """(1 + A, rows, P) power, and its derivatives where the bins of all scatterers move by
        `slope` (K, A), Doppler centred."""
        lines, fine = (self.rows + 2 * REACH) * FINE_BEAT, self.bins * FINE_DOPPLER
        line = np.round((beat + REACH) * FINE_BEAT).astype(np.int64)
        inside = (line >= 0) & (line < lines)
        left = np.floor(doppler * FINE_DOPPLER)
        share = (doppler * FINE_DOPPLER - left)[inside]
        at = [(line * fine + (left.astype(np.int64) + side) % fine)[inside] for side in (0, 1)]
        out = []
        for number in range(1 + slope.shape[1]):
            weight = (power if number == 0 else power * slope[:, number - 1])[inside]
            grid = np.zeros(lines * fine)
            for where, part in zip(at, (1 - share, share), strict=True):
                grid += np.bincount(where, weight * part, lines * fine)
            kernel = self._along if number == 0 else -self._along * self._turn
            turned = scipy.fft.irfft(scipy.fft.rfft(grid.reshape(lines, fine)) * kernel, fine)[
                :, ::FINE_DOPPLER
            ]
            spread = ndimage.convolve1d(turned, self._across, axis=0, mode="constant")
            out.append(np.fft.fftshift(spread[REACH * FINE_BEAT :: FINE_BEAT][: self.rows], axes=1))
        return np.array(out)
