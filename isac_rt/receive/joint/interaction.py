"""Interaction between the paths of a frame, and how much of another one each may ignore.

Two unit tones of a frame share at most the product of three factors of their signals: a Dirichlet
kernel's envelope in beat, one in Doppler, and the array's pattern between their directions. An
estimate that ignores a path of energy E over the noise, with which it shares c, is off by at most
3 sqrt(2 E) c of its deviations: a path's tangents (amplitude, delay, rate, two cosines) hold at
most c^2 (1 + 3 + 3 + 1 + 1) of the other one's energy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from isac_rt.receive.arms import element_delays
from isac_rt.receive.known import Known
from isac_rt.receive.pursuit import sidelobe_floor

CLOSE = 0.1
"""Paths that share more are estimated together; the others each by itself, with these taken out."""
IGNORED = 0.1
"""Deviations by which all that an estimate ignores may move it."""
TANGENTS = 3.0
MARGIN = 1.0
"""Cells and bins by which two paths may come nearer to each other while they are fitted."""


class CellPositions(NamedTuple):
    """Beat [cells], Doppler [bins] (K,), directions (K, 2) and delays [s] (K,) of paths."""

    cells: np.ndarray
    bins: np.ndarray
    direction: np.ndarray
    delay: np.ndarray


def shared(known: Known, of: CellPositions, at: CellPositions) -> np.ndarray:
    """(A, B) most that unit tones at the places `at` (A) share with those `of` (B)."""
    w = known.waveform
    beat = _dirichlet(np.abs(at.cells[:, None] - of.cells), w.num_samples)
    doppler = _dirichlet(np.abs(at.bins[:, None] - of.bins), w.num_chirps)
    beat_doppler = beat * np.minimum(doppler + np.sqrt(sidelobe_floor(known)), 1)
    left, right = _waves(known, at), _waves(known, of)
    pattern = np.abs(np.einsum("aie,bje->aibj", left.conj(), right)).max(axis=(1, 3))
    return beat_doppler * np.minimum(pattern, 1)


def ignored(share: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """(A, B) bool, which of B paths with an `energy` over the noise each of A places ignores: the
    least ones, until all together may move its estimate by `IGNORED` deviations."""
    bound = TANGENTS * np.sqrt(2 * energy) * share
    order = np.argsort(bound, axis=1)
    total = np.cumsum(np.take_along_axis(bound, order, axis=1), axis=1)
    out = np.zeros(share.shape, bool)
    np.put_along_axis(out, order, total <= IGNORED, axis=1)
    return out


def clusters(share: np.ndarray) -> np.ndarray:
    """(K,) number of the cluster of each path: those that `CLOSE` ones connect."""
    return connected_components(share > CLOSE, directed=False)[1]


def _dirichlet(distance: np.ndarray, size: int) -> np.ndarray:
    """Envelope of |sin(pi d) / (size sin(pi d / size))| at what may be left of a distance."""
    d = np.maximum(distance - MARGIN, 0) % size
    under = size * np.sin(np.pi * np.minimum(d, size - d) / size)
    return 1 / np.maximum(under, 1.0)


def _waves(known: Known, positions: CellPositions) -> np.ndarray:
    """(K, 3, L_rx) the receivers' phases, and these times either coordinate of the receivers, each
    of unit norm."""
    a, j_omega = known.antennas, -2j * np.pi * known.waveform.effective_carrier
    radius = known.radius(positions.delay)[:, None]
    wave = np.exp(j_omega * element_delays(a.rx_positions, positions.direction, radius)[0])
    levers = np.stack([np.ones(a.num_rx), *(a.rx_positions[:, [0, 2]].T)])
    levers -= levers.mean(axis=1, keepdims=True) * (np.arange(3) > 0)[:, None]
    levers /= np.maximum(np.linalg.norm(levers, axis=1, keepdims=True), 1e-30)
    return wave[:, None] * levers
