"""Detection of occupied resource blocks at the slot grid, and the choice of a free run.

Data move a sender's beat from chirp to chirp, so energies cannot be added over chirps cell by cell.
A chirp is *hot* when its strongest cell, added over antennas, stands out of its other cells; a
block is taken when more chirps are hot than noise explains.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from typing import TypeVar

import numpy as np
import scipy.fft
from scipy.special import bdtrc, betainccinv

T = TypeVar("T", bound=Hashable)

HOT_RATE = 0.01
"""Chance that noise alone makes a chirp hot."""


def hot_threshold(num_rx: int, num_cells: int, rate: float = HOT_RATE) -> float:
    """Strongest cell over the mean of the others that noise exceeds in this share of chirps: the
    largest of `num_cells` F-distributed ratios with 2 L_rx and 2 L_rx (num_cells - 1) degrees of
    freedom."""
    a, b = num_rx, num_rx * (num_cells - 1)
    share = betainccinv(a, b, -np.expm1(np.log1p(-rate) / num_cells))  # a x / (a x + b)
    return float(share / (1 - share) * b / a)


def hot_chirps(samples: np.ndarray) -> np.ndarray:
    """Hot chirps per group, (M,) int, of samples (M, L_rx, P, N)."""
    groups, num_rx, num_chirps, num_cells = samples.shape
    limit = hot_threshold(num_rx, num_cells)
    count = np.zeros(groups, int)
    for m in range(groups):
        power = np.zeros((num_chirps, num_cells))
        for one in samples[m]:
            spectra = scipy.fft.fft(one, axis=1, workers=1)
            power += spectra.real**2 + spectra.imag**2
        peak = power.max(axis=1)
        count[m] = (peak > limit * (power.sum(axis=1) - peak) / (num_cells - 1)).sum()
    return count


def needed_chirps(num_chirps: int, false_rate: float) -> int:
    """Hot chirps from which a block counts as taken: noise reaches them with at most
    `false_rate`."""
    tail = np.append(1.0, bdtrc(np.arange(num_chirps), num_chirps, HOT_RATE))
    return int(np.flatnonzero(tail <= false_rate)[0])


def choose_run(taken: np.ndarray, length: int, wished: int | None = None) -> int | None:
    """First block of a free run: the wished one, else the free start nearest to it (the lower of
    two); without a wish the lowest.

    Parameters
    ----------
    taken : (blocks,) bool
    length : consecutive blocks needed; a run does not wrap around the slot
    """
    starts = [b for b in range(len(taken) - length + 1) if not taken[b : b + length].any()]
    if not starts:
        return None
    return min(starts, key=lambda b: (abs(b - (wished or 0)), b))


def consensus(answers: Sequence[T]) -> T | None:
    """Return the value that most blocks agree on; None without any or with a tie."""
    ranked = Counter(answers).most_common(2)
    if not ranked or (len(ranked) > 1 and ranked[0][1] == ranked[1][1]):
        return None
    return ranked[0][0]
