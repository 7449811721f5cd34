r"""Waves that share a range-Doppler cell, told apart by their directions.

With A the steering vectors of those that are known, what they leave of a cell x has the statistic
of a further one

.. math:: T(u) = |a^H Q x|^2 / (a^H Q a), \quad
    Q = R^{-1} - R^{-1} A (A^H R^{-1} A)^{-1} A^H R^{-1},

the generalised likelihood ratio with the amplitudes of the known waves as nuisance (Scharf and
Friedlander [1]_). Each is sought again in what the others leave, once one is added.

References
----------
.. [1] L. L. Scharf and B. Friedlander, "Matched subspace detectors", IEEE Trans. Signal Process.
   42(8), 1994, doi:10.1109/78.301849
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from isac_rt.receive.directions import (
    Search,
    climbed,
    denominators,
    settled,
    statistic_of,
    strongest_on_grid,
)
from isac_rt.receive.estimate import Estimate

MOST_WAVES = 3
"""Waves that are told apart in a cell; each further one costs a search."""
RESIDUAL_SHARE = 3e-3
"""Share of a wave's statistic that its removal may leave, for what straddles the cell."""
RESOLVED = 0.5
"""Share of a direction's response that the known waves must leave of it."""
ROUNDS = 2
"""Times that the directions are sought again, each in what the others leave."""


@dataclass(frozen=True)
class Wave:
    """One of the K waves of a cell.

    Attributes
    ----------
    cosines : (2,) its direction
    share : its statistic over that of the strongest wave alone
    weights : (L,) of the beam towards it and against the others
    steering : (L, K) of all
    number : which of these it is
    inverse : (L, L) R^-1
    told : (2,) bool, axes on which its direction is known to half a beam: clutter may leave other
        lobes about as likely
    """

    cosines: np.ndarray
    share: float
    weights: np.ndarray
    steering: np.ndarray
    number: int
    inverse: np.ndarray
    told: np.ndarray

    def alone(self, estimate: Estimate, search: Search) -> Estimate:
        """Return the estimate with the other waves taken out of its channels."""
        if self.steering.shape[1] == 1:
            return estimate
        c, A = search.channels, self.steering
        B = self.inverse @ A
        amplitudes = np.linalg.solve(A.conj().T @ B, B.conj().T @ estimate.channels[c.tx, c.rx])
        amplitudes[self.number] = 0
        channels = estimate.channels.copy()
        channels[c.tx, c.rx] -= A @ amplitudes
        return replace(estimate, channels=channels)


def waves_of(
    x: np.ndarray, inverse: np.ndarray, first: np.ndarray, search: Search, ratio: float
) -> list[Wave]:
    """Return the waves of a cell, that of the detection first.

    Parameters
    ----------
    x : (L,) channels of the cell, in units of the noise
    inverse : (L, L) R^-1 of noise and clutter
    first : (2,) direction of the detection
    ratio : its statistic over the threshold, which further waves have to exceed, too
    """
    u, alone = first[None], float(_statistic(x, inverse, first, search))
    least = alone * max(1 / ratio, RESIDUAL_SHARE)
    while len(u) < min(MOST_WAVES, x.size):
        peak, further = _further(x, inverse, u, search)
        if peak < least:
            break
        u = np.concatenate([u, further])
        for k in ROUNDS * list(range(len(u))):
            Q = nulled(inverse, search.steering(np.delete(u, k, axis=0)).T)
            u[[k]] = settled(statistic_of((Q @ x)[None, None], Q[None]), u[[k]], search)
    A, out = search.steering(u).T, []
    for k in range(len(u)):
        Q = nulled(inverse, np.delete(A, k, axis=1))
        share = float(_statistic(x, Q, u[k], search)) / alone
        told = _deviations(x, Q, u[k], search) <= search.beam / 2
        out.append(Wave(u[k], share, Q @ A[:, k], A, k, inverse, told))
    return out


def nulled(inverse: np.ndarray, steering: np.ndarray) -> np.ndarray:
    """Return Q (L, L) of R^-1 and known waves (L, K)."""
    B = inverse @ steering
    return np.asarray(inverse - B @ np.linalg.solve(steering.conj().T @ B, B.conj().T))


def _further(
    x: np.ndarray, inverse: np.ndarray, u: np.ndarray, search: Search
) -> tuple[float, np.ndarray]:
    """Return the largest T in what waves from directions u (K, 2) leave, and where (1, 2)."""
    Q = nulled(inverse, search.steering(u).T)
    before, after = denominators(np.stack([inverse, Q]), search)
    y = (Q @ x)[None, None]
    scale = np.where(after > RESOLVED * before, 1 / after, 0.0)
    near = strongest_on_grid(y, scale[None], search)[1]
    peak, cosines = climbed(statistic_of(y, Q[None]), near, search)
    return float(peak[0]), cosines


def _deviations(x: np.ndarray, Q: np.ndarray, cosines: np.ndarray, search: Search) -> np.ndarray:
    """Return the standard deviations (2,) of the likelihood exp(T) along each axis, through a
    peak."""
    out = np.zeros(2)
    for axis, values in enumerate(search.cosines):
        u = np.tile(cosines, (values.size, 1))
        u[:, axis] = values
        T = np.where((u**2).sum(axis=1) <= 1, _statistic(x, Q, u, search), 0.0)
        weight = np.exp(T - T.max())
        mean = np.average(values, weights=weight)
        out[axis] = np.sqrt(np.average((values - mean) ** 2, weights=weight))
    return out


def _statistic(x: np.ndarray, Q: np.ndarray, cosines: np.ndarray, search: Search) -> np.ndarray:
    a = search.steering(cosines)
    return np.asarray(abs(a.conj() @ Q @ x) ** 2 / np.vecdot(a, a @ Q.T).real)
