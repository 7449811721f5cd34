r"""Angle-Doppler filters: the adaptive matched filter in every range-Doppler cell, scanned over
direction.

With x the channels of a cell, R their covariance under clutter and noise and a(u) the steering
vector,

.. math:: T(u) = |a^H R^{-1} x|^2 / (a^H R^{-1} a)

is exponential of mean one where there is no target [1]_. The largest over u exceeds t with a
probability that for high t is the mean Euler characteristic of the set {T > t} (Worsley [2]_, his
chi-squared field of two degrees of freedom):

.. math:: e^{-t}\,(1 + \mu_1\sqrt{t/\pi} + \mu_2 (2t - 1)/(2\pi)),

mu the length and area of the scanned directions in units of the correlation length, which follows
from the variances of the channels' places; summed over n looks 2 T has 2 n degrees of freedom.

References
----------
.. [1] F. C. Robey et al., "A CFAR adaptive matched filter detector", IEEE Trans. Aerosp. Electron.
Syst. 28(1), 1992, doi:10.1109/7.135446
.. [2] K. J. Worsley, "Local maxima and the expected Euler characteristic of excursion sets of
chi-squared, F and t fields", Adv. Appl.
   Probab. 26(1), 1994, doi:10.2307/1427576
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage, optimize, special

from isac_rt.receive.cfar import CfarRule, strong_lobes
from isac_rt.receive.directions import Search
from isac_rt.receive.settings import Receivers

LEAST_CLUTTER = 0.03
"""Cells whose expected clutter is less than this share of the noise are taken to hold noise
alone."""


def scanned(search: Search) -> tuple[tuple[float, float], float]:
    """Sides of the searched directions over the correlation length, and their area over the
    correlation area; 0 on an axis that the channels do not observe.

    The correlation length along an axis is 1 / (k s), s the deviation of the channels' places.
    """
    covariance = search.wavenumber**2 * np.cov(search.channels.positions[:, [0, 2]].T, bias=True)
    width = search.steps * [u.size for u in search.cosines]
    x, z = width * np.sqrt(np.diag(covariance))
    return (float(x), float(z)), float(width.prod() * np.sqrt(max(np.linalg.det(covariance), 0.0)))


def expected_count(t: float, lengths: tuple[float, ...], area: float, looks: int = 1) -> float:
    """Return the mean Euler characteristic of {T > t} over directions of such lengths and area
    (`scanned`), T a sum of `looks` unit exponentials; at least that of one beam."""
    shape = t ** (looks - 1) * np.exp(-t) / special.gamma(looks)
    edges = sum(lengths) * np.sqrt(t / np.pi) * shape
    inside = area * max(2 * t - (2 * looks - 1), 0.0) * shape / (2 * np.pi)
    return float(special.gammaincc(looks, t) + edges + inside)


@lru_cache(maxsize=256)
def field_threshold(lengths: tuple[float, ...], area: float, looks: int, rate: float) -> float:
    """Return what the largest T over directions exceeds at this rate: it is below t with
    probability exp(-`expected_count`)."""
    aim = -np.log1p(-rate)

    def excess(t: float) -> float:
        return float(np.log(expected_count(t, lengths, area, looks) / aim))

    return float(optimize.brentq(excess, looks, 400.0))


def unexplained(
    power: np.ndarray,
    target: np.ndarray,
    settings: Receivers,
    left_out: np.ndarray | bool = False,
) -> np.ndarray:
    """Return how many times the expected power (rows, P) is found around each cell, once at least:
    the greater of both sides in range, so that what the mesh does not know raises the threshold.
    Cells about a `target`, and those `left_out`, do not count."""
    near = ndimage.binary_dilation(target, np.ones((3, 3), bool)) | left_out
    rule = CfarRule.of(settings, 1)
    return np.maximum(rule.background(power, ~(near | strong_lobes(power))), 1.0)
