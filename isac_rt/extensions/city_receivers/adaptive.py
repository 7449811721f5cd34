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
   chi-squared, F and t fields", Adv. Appl. Probab. 26(1), 1994, doi:10.2307/1427576
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage, optimize, special

from isac_rt.extensions.city_receivers.covariance import Bucketed
from isac_rt.extensions.city_receivers.power import TAPER, expected_power
from isac_rt.receive.cfar import CfarRule, strong_lobes
from isac_rt.receive.directions import (
    PRUNED,
    Search,
    channel_search,
    inverses,
    receiver_search,
    search_plain,
    search_white,
)
from isac_rt.receive.known import Known
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import ExpectedClutter

LEAST_CLUTTER = 0.03
"""Cells whose expected clutter is less than this share of the noise are taken to hold noise
alone."""
QUIET = 0.3
"""Share of the cells, those with the least clutter to be expected, whose median power is taken for
the noise's."""
MOST_KEPT = 50_000_000
"""Entries of covariances that are held at once."""


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


def unexplained(power: np.ndarray, target: np.ndarray, settings: Receivers) -> np.ndarray:
    """Return how many times the expected power (rows, P) is found around each cell, once at least:
    the greater of both sides in range, so that what the mesh does not know raises the threshold.
    Cells about a `target` do not count."""
    near = ndimage.binary_dilation(target, np.ones((3, 3), bool))
    rule = CfarRule.of(settings, 1)
    return np.maximum(rule.background(power, ~(near | strong_lobes(power))), 1.0)


def noise_level(power: np.ndarray, expected: np.ndarray | None, looks: int) -> float:
    """Mean noise power of a cell, from the median of the quietest cells, or of all where nothing is
    known of the clutter.

    The median of a mean of n exponentials is (1 - 1/(9 n))^3 of its mean (Wilson and Hilferty).
    """
    some = power if expected is None else power[expected <= np.quantile(expected, QUIET)]
    return float(np.median(some)) / (1 - 1 / (9 * looks)) ** 3


@dataclass(frozen=True)
class DirectionTest:
    """Test of a frame's cells in every direction, whitened where clutter is expected.

    An active terminal adds all channels of an echo in phase; a passive one adds its receivers in
    phase and the transmit antennas, which are its looks, in power.

    Attributes
    ----------
    search : the directions of the channels that add in phase
    looks : of T, which are added in power
    noise : of a cell of one channel
    expected : (rows, P) power of the clutter, Doppler centred
    limits : of T, of a detection and of one that may start a track
    scatterers : the clutter by cell; None: nothing is known of it
    """

    known: Known
    search: Search
    looks: int
    noise: float
    expected: np.ndarray
    limits: tuple[float, float]
    scatterers: Bucketed | None

    @classmethod
    def of(
        cls, settings: Receivers, known: Known, power: np.ndarray, clutter: ExpectedClutter | None
    ) -> DirectionTest:
        """Return the test of a frame of such mean power (rows, P) of a channel."""
        own, antennas = known.passes == 2, known.antennas
        search = (channel_search if own else receiver_search)(antennas, known.wavenumber)
        looks = 1 if own else antennas.num_tx
        usual, sure = (
            field_threshold(*scanned(search), looks, rate) for rate in settings.false_alarm_rates
        )
        if clutter is None:
            noise, expected = noise_level(power, None, known.channels), np.zeros_like(power)
            return cls(known, search, looks, noise, expected, (usual, sure), None)
        expected = expected_power(clutter, known, len(power))
        noise = noise_level(power, expected, known.channels)
        scatterers = Bucketed.of(clutter, known, search, noise, TAPER)
        return cls(known, search, looks, noise, expected, (usual, sure), scatterers)

    @property
    def filled(self) -> np.ndarray:
        """(rows, P) True for cells that are whitened, Doppler centred."""
        return self.expected > LEAST_CLUTTER * self.noise

    def ratio(self, maps: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """T over the first threshold in rows (S,), (S, P), and its directions (S, P, 2), Doppler
        centred, of `channel_maps` (L_tx, L_rx, S, P)."""
        search, limit, shape = self.search, self.limits[0], maps.shape[2:]
        x, least = maps.reshape(self.looks, -1, maps[0, 0].size), PRUNED * limit
        ratio, cosines = np.zeros(x.shape[2], np.float32), np.full((x.shape[2], 2), np.nan)
        plain = search_plain(x, search, self.noise, least)
        ratio[plain.cell], cosines[plain.cell] = plain.peak / limit, plain.cosines
        if self.scatterers is not None:
            filled = np.fft.ifftshift(self.filled[rows], axes=1).ravel()
            cells = plain.cell[filled[plain.cell] & (plain.peak > least)]
            parts = 1 + cells.size * len(search.channels) ** 2 // MOST_KEPT
            for cell in np.array_split(cells, parts):
                at, bins = np.divmod(cell, shape[1])
                R = self.scatterers.covariances(rows[at], bins)
                y = x[:, :, cell].transpose(2, 0, 1) / np.float32(np.sqrt(self.noise))
                white, common = search_white(y, R, cell, search, least)
                ratio[cell], cosines[cell] = white.peak / (limit * common), white.cosines
        ratio, cosines = (
            np.fft.fftshift(a.reshape(*shape, *a.shape[1:]), axes=1) for a in (ratio, cosines)
        )
        return ratio, cosines

    def inverse(self, row: int, column: int) -> np.ndarray:
        """R^-1 (L, L) of the channels of a cell, Doppler centred; 1 where it is not whitened."""
        if self.scatterers is None or not self.filled[row, column]:
            return np.eye(len(self.search.channels), dtype=np.complex64)
        size = self.expected.shape[1]
        cell = np.array([row]), np.array([(column + size // 2) % size])
        return np.asarray(inverses(self.scatterers.covariances(*cell))[0])
