"""Constant-false-alarm-rate (CFAR) detection on range-Doppler maps, and selection of peaks.

In noise of unit power a cell of a map that averages the powers of L channels has the distribution
Gamma(L)/L, and the mean of n independent training cells Gamma(L n)/(L n). Greatest-of CFAR
(Richards) compares a cell with k times the larger of the means before and behind it in range, which
holds the false-alarm rate at clutter edges. With F the distribution function of that larger mean z
and g the density of Gamma(L), the factor k solves

    P_fa = integral of P(cell > k z) dF(z) = integral of L k g(L k z) F(z) dz                  (1)

(by parts); the integral is taken numerically.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import optimize, special

from isac_rt.kernels import receive_maps
from isac_rt.kernels.jit import twin_of
from isac_rt.receive.settings import Receivers

HANN_CORRELATION = ((2 / 3) ** 2, (1 / 6) ** 2)
"""Correlation of the powers of cells one and two apart along a Hann-windowed axis."""

QUADRATURE_POINTS = 4001
"""Points of the integral (1)."""
ROUNDING = 1e-16
"""Least background relative to the strongest cell: rounding of complex64 transforms leaves -170 dB
of it at a quarter and half of the range axis."""
STRONG, MAX_STRONG = 1e3, 8
"""Least power over the median cell, and largest number, of the peaks whose sidelobes are excluded
from the training cells."""
DEEPEST_LOBE = 1e-8
"""Least excluded sidelobe relative to its peak, 15 cells away; in a map without noise the sidelobes
would fill every cell."""
LOBE_MARGIN = 4.0
"""Least ratio of a peak to the bound of a stronger path's sidelobes at which it counts."""
LEAST_KEPT = 0.25
"""Least share of a training block's cells for its mean to be used."""


@dataclass(frozen=True)
class CfarRule:
    """Greatest-of CFAR with its training and guard cells.

    Attributes
    ----------
    rate : false-alarm probability of one cell
    guard, training : (range, Doppler) cells on each side
    looks : L, channels whose powers are averaged in the map

    Examples
    --------
    >>> rule = CfarRule(1e-6, (3, 3), (8, 6), looks=45)
    >>> above, level = rule.detect(np.ones((64, 32)))
    >>> above.any(), bool(rule.threshold > 1)
    (np.False_, True)
    """

    rate: float
    guard: tuple[int, int]
    training: tuple[int, int]
    looks: int

    @classmethod
    def of(cls, settings: Receivers, looks: int) -> CfarRule:
        """Build the rule of the settings for a map of `looks` channels."""
        s = settings
        return cls(s.false_alarm_rate, s.guard_cells, s.training_cells, looks)

    @property
    def threshold(self) -> float:
        """Factor k of (1) for a Hann-windowed map, away from the ends of the range axis."""
        return _factor(self, self.training[0], self.training[0])

    def factors(self, rows: int) -> np.ndarray:
        """Return the factors k (rows,) of a Hann-windowed map."""
        return _factors(self, rows)

    def detect(self, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compare each cell with its threshold, k times the background.

        Parameters
        ----------
        power : (rows, P) mean power over the looks of Hann-windowed maps

        Returns
        -------
        above : (rows, P) bool
        level : (rows, P) background
        """
        level = np.maximum(self.background(power, ~strong_lobes(power)), ROUNDING * power.max())
        return power > self.factors(len(power))[:, None] * level, level

    def ratio(self, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return power over threshold, and background (`detect`)."""
        level = self.detect(power)[1]
        return power / (self.factors(len(power))[:, None] * level), level

    def detect_chirps(self, power: np.ndarray) -> np.ndarray:
        """One-dimensional CFAR along the range cells of every chirp (the paper's first stage).

        Parameters
        ----------
        power : (N, P) mean power over the looks of spectra without a window, so that their noise
            is independent

        Returns
        -------
        above : (N, P) bool
        """
        along = replace(self, guard=(self.guard[0], 0), training=(self.training[0], 0))
        level = along.background(power, np.ones(power.shape, bool))
        level = np.maximum(level, ROUNDING * power.max())
        sides = self.side_rows(len(power)).tolist()
        factor = np.array([self._chirp_factor(*count) for count in sides])
        return power > factor[:, None] * level

    def background(self, power: np.ndarray, keep: np.ndarray) -> np.ndarray:
        """Return the greater of the means of the training cells before and behind each cell in
        range, over the cells of the mask `keep`; Doppler wraps. A side with fewer than
        `LEAST_KEPT` of its cells is left out; without both sides the background is infinite."""
        out = np.empty(power.shape)
        half = self.guard[1] + self.training[1]
        sides = self.side_rows(len(power))
        fill_background(
            np.ascontiguousarray(power), keep, sides, self.guard[0], half, LEAST_KEPT, out
        )
        return out

    def side_rows(self, rows: int) -> np.ndarray:
        """Return the training rows (rows, 2) before and behind each row; 0 for a side with less
        than half of them."""
        index, guard, training = np.arange(rows), self.guard[0], self.training[0]
        count = np.clip(np.stack([index - guard, rows - 1 - guard - index], axis=1), 0, training)
        return np.where(count >= max(training // 2, 1), count, 0)

    def _chirp_factor(self, before: int, behind: int) -> float:
        if before == behind == 0:
            return np.inf
        return greatest_of_factor(self.rate, float(self.looks), before, behind)


@lru_cache(maxsize=4096)
def _factor(rule: CfarRule, before: int, behind: int) -> float:
    """Return `greatest_of_factor` for training blocks of `before` and `behind` rows, with the
    independent cells of Hann-windowed neighbours; infinite without a training row."""
    if before == behind == 0:
        return np.inf
    across = independent_cells(2 * (rule.guard[1] + rule.training[1]) + 1)
    sides = (independent_cells(rows) * across for rows in (before, behind))
    return greatest_of_factor(rule.rate, float(rule.looks), *sides)


@lru_cache(maxsize=64)
def _factors(rule: CfarRule, rows: int) -> np.ndarray:
    """`CfarRule.factors`."""
    out = np.array([_factor(rule, *count) for count in rule.side_rows(rows).tolist()])
    out.setflags(write=False)
    return out


@lru_cache(maxsize=256)
def greatest_of_factor(
    false_alarm_rate: float, looks: float, before: float, behind: float
) -> float:
    """Solve (1) for the factor k on the greater of two training means.

    Parameters
    ----------
    false_alarm_rate : of one cell
    looks : L, independent exponentials in a cell's mean
    before, behind : independent training cells on each side (may be fractions); 0 where a side is
        missing
    """
    # grid of z over all but 1e-12 of its distribution; F(z) is the product of both sides'
    sides = np.array([looks * n for n in (before, behind) if n > 0])  # shapes of Gamma means
    low = (special.gammaincinv(sides, 1e-12) / sides).min()
    high = (special.gammainccinv(sides, 1e-14) / sides).max()
    z = np.linspace(low, high, QUADRATURE_POINTS)
    cumulative = np.prod([special.gammainc(shape, shape * z) for shape in sides], axis=0)

    def excess(factor: float) -> float:
        # (1) on the grid of z; beyond it F = 1, the tail of the cell
        x = looks * factor * z
        density = np.exp(special.xlogy(looks - 1, x) - x - special.gammaln(looks))
        tail = special.gammaincc(looks, x[-1])
        rate = np.trapezoid(looks * factor * density * cumulative, z) + tail
        return float(np.log(max(rate, 1e-300)) - np.log(false_alarm_rate))

    return float(optimize.brentq(excess, 0.5, 1000.0, xtol=1e-6))


@twin_of(receive_maps.background)
def fill_background(
    power: np.ndarray,
    keep: np.ndarray,
    sides: np.ndarray,
    guard: int,
    half: int,
    least: float,
    out: np.ndarray,
) -> None:
    """Fill in the background (`CfarRule.background`) of each cell of `power` (rows, P).

    Training blocks have `sides` rows (rows, 2) beyond `guard` rows, and `half` bins on each side;
    a block counts if the cells to `keep` are at least a share `least` of it.
    """
    row, wide = np.arange(len(power)), 2 * half + 1
    # powers and cells to keep, summed over the bins of a block, then cumulated over rows
    bins = np.arange(-half, power.shape[1] + half) % power.shape[1]
    masked = np.stack([np.where(keep, power, 0.0), keep]).astype(float)[..., bins]
    about = np.lib.stride_tricks.sliding_window_view(masked, wide, axis=2).sum(axis=3)
    sums = np.pad(np.cumsum(about, axis=1), ((0, 0), (1, 0), (0, 0)))
    before, behind = sides.T
    # mean of each side with enough cells; the greater one
    out[:] = -np.inf
    for first, rows in ((row - guard - before, before), (row + guard + 1, behind)):
        first = np.clip(first, 0, len(power))  # a side without rows may begin outside
        total, cells = sums[:, first + rows] - sums[:, first]
        enough = (cells >= least * rows[:, None] * wide) & (rows > 0)[:, None]
        out[:] = np.maximum(out, np.where(enough, total / np.maximum(cells, 1), -np.inf))
    out[out == -np.inf] = np.inf


def strong_lobes(power: np.ndarray) -> np.ndarray:
    """Mark the cells (rows, P) in which sidelobes of the strongest peaks exceed the median power.

    Sidelobes of a line of sight 60 dB over the noise would raise the background of targets many
    cells away. They are taken to begin one row later, for range migration.
    """
    noise = float(np.median(power))
    rows, bins = peaks(power, power > STRONG * noise, (8, 8))
    reached = np.zeros(power.shape, bool)
    for row, column in zip(rows[:MAX_STRONG], bins[:MAX_STRONG], strict=True):
        along = np.maximum(np.abs(np.arange(power.shape[0]) - row) - 1, 0)
        across = np.abs(np.arange(power.shape[1]) - column)
        across = np.minimum(across, power.shape[1] - across)
        reached |= np.outer(hann_envelope(along), hann_envelope(across)) > max(
            noise / power[row, column], DEEPEST_LOBE
        )
    return reached


def independent_cells(count: int) -> float:
    """Return the number of independent cells whose mean has the variance of that of `count`
    neighbours on a Hann-windowed axis: n^2 / (n + 2 sum of (n - d) rho_d)."""
    pairs = sum(max(count - d, 0) * c for d, c in enumerate(HANN_CORRELATION, start=1))
    return count**2 / (count + 2 * pairs) if count else 0.0


def peaks(
    power: np.ndarray, above: np.ndarray, reach: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells above the threshold that are the largest within `reach` (range, Doppler)
    cells, strongest first; Doppler wraps."""
    rows, bins = np.nonzero(above)
    # neighbours of each cell: rows end with the map, bins wrap
    steps = (np.arange(-r, r + 1) for r in reach)
    along, across = (at[:, None] + n for at, n in zip((rows, bins), steps, strict=True))
    along, across = np.clip(along, 0, len(power) - 1), across % power.shape[1]
    keep = power[along[:, :, None], across[:, None]].max(axis=(1, 2)) <= power[rows, bins]
    rows, bins = rows[keep], bins[keep]
    order = np.argsort(-power[rows, bins], kind="stable")
    return rows[order], bins[order]


def strongest_peaks(
    power: np.ndarray, above: np.ndarray, settings: Receivers, floor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and bins of the strongest peaks that are no sidelobes of a stronger one
    (`without_sidelobes`), at most `max_detections`."""
    rows, bins = peaks(power, above, (1, 1))
    keep = np.flatnonzero(without_sidelobes(rows, bins, power, power.shape[1], floor))[
        : settings.max_detections
    ]
    return rows[keep], bins[keep]


def first_row(settings: Receivers, range_cell: float) -> int:
    """Return the row of `min_range_m`, where the search begins; `range_cell` [m]."""
    return int(np.ceil(settings.min_range_m / range_cell))


def hann_envelope(distance: np.ndarray) -> np.ndarray:
    """Return an upper bound of a Hann-windowed tone's power at `distance` d [cells], relative to
    its peak: 1 in the main lobe, then 1/(pi d (1 - d^2))^2, the envelope of
    (sinc(d)/(1 - d^2))^2."""
    d = np.maximum(np.abs(distance), 2.0)
    return np.where(np.abs(distance) < 2.0, 1.0, 1.0 / (np.pi * d * (d * d - 1)) ** 2)


def without_sidelobes(
    rows: np.ndarray,
    bins: np.ndarray,
    power: np.ndarray,
    num_bins: int,
    floor: float,
    margin: float = LOBE_MARGIN,
) -> np.ndarray:
    """Mark the peaks (strongest first) that are no sidelobes of a stronger one.

    Parameters
    ----------
    floor : sidelobe level in every Doppler bin of a path's range row, relative to its peak
    margin : least power relative to the bound
    """
    keep, values = np.ones(rows.size, bool), power[rows, bins]
    for i in range(1, rows.size):
        over = np.flatnonzero(keep[:i])
        # against the sidelobes of every stronger peak that counts
        lobes = leaked(rows[i] - rows[over], bins[i] - bins[over], num_bins, floor)
        keep[i] = (values[i] > margin * values[over] * lobes).all()
    return keep


def leaked(rows: np.ndarray, bins: np.ndarray, num_bins: int, floor: float) -> np.ndarray:
    """Return the bound of a path's power at a distance of rows and bins, relative to its peak:
    Hann's sidelobes on both axes, and `floor` in every Doppler bin."""
    bins = np.abs(bins)
    bins = np.minimum(bins, num_bins - bins)
    return hann_envelope(rows) * (hann_envelope(bins) + floor)
