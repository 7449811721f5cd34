"""The least error that any unbiased estimator makes of one path in white noise: Cramer-Rao."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.constants import speed_of_light
from scipy.optimize import brentq
from scipy.special import erf

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.directions import direction_bound
from isac_rt.results.metrics import Truth


@dataclass(frozen=True)
class CramerRao:
    r"""Bound of one path whose amplitude and phase are unknown.

    A sample's phase goes as :math:`2\pi\alpha t` with the delay, :math:`2\pi f t'` with the delay
    rate and :math:`k\,r` with the direction, over the time t within a chirp, the chirp's time t'
    and the place r of the channel. The variance of each is :math:`1/(2\gamma\,\mathrm{var})` with
    the variance of what stands beside it, by the coherent SNR :math:`\gamma` of the frame. Chirps,
    samples and channels count as independent: what an order of transmitters mixes of velocity and
    direction only raises the bound.

    Attributes
    ----------
    range, velocity : standard deviations at unit SNR [m], [m/s]
    direction : (2, 2) covariance of u_x and u_z at unit SNR, infinite where one is not observed
    """

    range: float
    velocity: float
    direction: np.ndarray

    @classmethod
    def of(cls, waveform: Waveform, antennas: Antennas, passes: int) -> CramerRao:
        """Return the bounds of a frame; `passes` 2 for an echo in one-way range, 1 for a path
        length."""
        w, carrier = waveform, float(waveform.carrier())
        fast = w.sample_interval * np.sqrt((w.num_samples**2 - 1) / 12)
        slow = w.slot_duration * np.sqrt((w.num_chirps**2 - 1) / 12)
        tone = speed_of_light / (passes * 2 * np.pi * np.sqrt(2.0))
        wavenumber = 2 * np.pi * carrier / speed_of_light
        return cls(
            tone / (w.slope * fast),
            tone / (carrier * slow),
            direction_bound(antennas, passes, wavenumber),
        )

    def of_path(self, snr: float, truth: Truth) -> np.ndarray:
        """(4,) standard deviations of range, velocity, azimuth and elevation of a path from the
        front [m, m/s, rad, rad], NaN of an angle that is not observed."""
        u_x, u_z = truth.u_x, truth.u_z
        seen = np.isfinite(np.diag(self.direction))
        u_x, u_z = np.where(seen, [u_x, u_z], 0.0)
        ahead = np.sqrt(max(1 - u_x**2 - u_z**2, 1e-9))
        level = u_x**2 + ahead**2
        jacobian = np.array([[1 / ahead, u_x * u_z / (ahead * level)], [0.0, 1 / np.sqrt(level)]])
        covariance = np.where(np.outer(seen, seen), self.direction, 0.0)
        angles = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
        out = np.array([self.range, self.velocity, *np.where(seen, angles, np.nan)])
        return np.asarray(out / np.sqrt(snr))


def error_quantile(deviations: np.ndarray, share: float) -> float:
    """Return the level that a share of the magnitudes of errors stays under, each error normal with
    a standard deviation of its own.

    Examples
    --------
    >>> round(error_quantile(np.array([2.0, 2.0]), 0.5), 3)
    1.349
    """
    s = np.asarray(deviations, float)
    return float(
        brentq(lambda x: erf(x / (np.sqrt(2) * s)).mean() - share, 0.0, 10 * s.max(), xtol=1e-12)
    )
