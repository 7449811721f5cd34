"""Constant-false-alarm-rate detection on accumulated maps, and the choice of peaks.

A cell of an accumulated noise map is the mean of L exponentials, a Gamma(L) variable; a training mean of n independent cells is
Gamma(L n). The greatest-of rule takes the larger of the means before and behind the cell in range, which holds the
rate at clutter edges. The factor follows from these laws by quadrature, not from the large-number limit.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import integrate, ndimage, optimize, stats

HANN_CORRELATION = 1.0 + 2 * ((2 / 3) ** 2 + (1 / 6) ** 2)
"""Cells per independent cell along one Hann-windowed axis: the sum of the squared correlations of neighbouring cells."""


ROUNDING = 1e-16
"""The least background, relative to the strongest cell: complex64 transforms leave -170 dB of it a quarter and half the range away."""


@lru_cache(maxsize=64)
def greatest_of_factor(false_alarm_rate: float, looks: float, cells_per_side: float) -> float:
    """Factor on the greater of two training means that gives the false-alarm rate.

    Parameters
    ----------
    false_alarm_rate : of one cell
    looks : L, independent exponentials in a cell's mean
    cells_per_side : independent training cells on each side (may be a fraction)
    """
    side = stats.gamma(looks * cells_per_side, scale=1 / (looks * cells_per_side))
    cell = stats.gamma(looks, scale=1 / looks)

    def rate(factor: float) -> float:
        low, high = side.ppf(1e-12), side.isf(1e-14)
        value, _ = integrate.quad(
            lambda z: cell.sf(factor * z) * 2 * side.pdf(z) * side.cdf(z), low, high, limit=400, epsabs=0, epsrel=1e-8
        )
        return np.log(max(value, 1e-300)) - np.log(false_alarm_rate)

    return float(optimize.brentq(rate, 0.5, 200.0, xtol=1e-6))


def _side_mean(power: np.ndarray, guard: tuple[int, int], training: tuple[int, int], side: int) -> np.ndarray:
    """Mean over the training block before (-1) or behind (+1) each cell in range; Doppler wraps. NaN where no cell is."""
    rows, _ = power.shape
    width = 2 * (guard[1] + training[1]) + 1
    across = ndimage.uniform_filter1d(power.astype(np.float64), width, axis=1, mode="wrap")
    total = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(across, axis=0)])
    index = np.arange(rows)
    if side < 0:
        stop = np.clip(index - guard[0], 0, rows)
        start = np.clip(index - guard[0] - training[0], 0, rows)
    else:
        start = np.clip(index + guard[0] + 1, 0, rows)
        stop = np.clip(index + guard[0] + 1 + training[0], 0, rows)
    count = stop - start
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count[:, None] >= max(training[0] // 2, 1), (total[stop] - total[start]) / count[:, None], np.nan)


def background(power: np.ndarray, guard: tuple[int, int], training: tuple[int, int]) -> np.ndarray:
    """The greater of the two training means; at the ends of the range axis the one there is."""
    return np.fmax(_side_mean(power, guard, training, -1), _side_mean(power, guard, training, +1))


def detect(
    power: np.ndarray,
    looks: int,
    false_alarm_rate: float,
    guard: tuple[int, int],
    training: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Cells above the threshold, and the background of every cell.

    Parameters
    ----------
    power : (rows, P) mean power over `looks` channels of Hann-windowed maps
    guard, training : (range, Doppler) cells on each side

    Returns
    -------
    above : (rows, P) bool
    level : (rows, P) background
    """
    level = np.maximum(background(power, guard, training), ROUNDING * power.max())
    return power > threshold(looks, false_alarm_rate, guard, training) * level, level


def threshold(looks: int, false_alarm_rate: float, guard: tuple[int, int], training: tuple[int, int]) -> float:
    """Factor on the background of a Hann-windowed map: neighbouring training cells count for less than one each."""
    width = 2 * (guard[1] + training[1]) + 1
    independent = training[0] * width / HANN_CORRELATION**2
    return greatest_of_factor(false_alarm_rate, float(looks), max(independent, 1.0))


def peaks(power: np.ndarray, above: np.ndarray, reach: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Cells above the threshold that are the largest within `reach` (range, Doppler); Doppler wraps. Strongest first."""
    size = (2 * reach[0] + 1, 2 * reach[1] + 1)
    largest = ndimage.maximum_filter(power, size=size, mode=("nearest", "wrap"))
    rows, bins = np.nonzero(above & (power == largest))
    order = np.argsort(-power[rows, bins], kind="stable")
    return rows[order], bins[order]


def hann_envelope(distance: np.ndarray) -> np.ndarray:
    """Upper bound of a Hann-windowed tone's power at a distance in cells, relative to its peak: 1 within the main lobe,
    then 1/(pi^2 d^2 (1 - d^2)^2) for the peaks of the sidelobes (of the amplitude sinc(d)/(1 - d^2))."""
    d = np.maximum(np.abs(distance), 2.0)
    return np.where(np.abs(distance) < 2.0, 1.0, 1.0 / (np.pi * d * (d * d - 1)) ** 2)


def without_sidelobes(
    rows: np.ndarray, bins: np.ndarray, power: np.ndarray, num_bins: int, floor: float, margin: float = 4.0
) -> np.ndarray:
    """Which peaks (strongest first) are more than what a stronger one leaves around it.

    Parameters
    ----------
    floor : share of a path's power that may lie in any Doppler bin of its range row
    margin : power factor above the bound
    """
    keep = np.zeros(rows.size, bool)
    values = power[rows, bins]
    for i in range(rows.size):
        stronger = np.flatnonzero(keep[:i])
        across = np.abs(bins[i] - bins[stronger])
        across = np.minimum(across, num_bins - across)
        bound = margin * values[stronger] * hann_envelope(rows[i] - rows[stronger]) * (hann_envelope(across) + floor)
        keep[i] = not np.any(values[i] <= bound)
    return keep
