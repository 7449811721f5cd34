"""Orthogonal matching pursuit over slow time, for groups that sample it sparsely."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from isac_rt.receive.known import Known
from isac_rt.receive.maps import LatinUnion, Levels

SPARSITY = 4
"""Atoms per range row."""
MOST_UNEXPLAINED = 1 / 3
"""Of a sparse row's power above the noise, what OMP with as many atoms as it recovers dependably
may leave."""


def recovery_limit(num_samples: int, num_chirps: int) -> int:
    """Doppler atoms per row that OMP recovers dependably from `num_samples` chirps at random out of
    P: S / (2 ln P), at least 1.

    References
    ----------
    .. [1] J. Tropp, A. Gilbert, "Signal recovery from random measurements via orthogonal matching
    pursuit", 2007: S >= 2 K ln P.
    """
    return max(int(num_samples / (2 * np.log(num_chirps))), 1)


def unexplained(spectra: np.ndarray, rows: np.ndarray, known: Known) -> np.ndarray:
    """(len(rows),) share of each row's power that as many OMP atoms as the sampling's
    `recovery_limit` do not explain."""
    num_chirps = known.waveform.num_chirps
    total, left = np.zeros(len(rows)), np.zeros(len(rows))
    for part, chosen in _sparse_samples(spectra, rows, known):
        limit = recovery_limit(chosen.size, num_chirps)
        found = omp(part.reshape(-1, chosen.size), chosen, num_chirps, limit)
        turns = np.outer(np.arange(num_chirps), chosen)
        atoms = np.exp(2j * np.pi * turns / num_chirps) / chosen.size
        rest = part - (found @ atoms).reshape(part.shape)
        total += (np.abs(part) ** 2).sum(axis=(0, 2))
        left += (np.abs(rest) ** 2).sum(axis=(0, 2))
    return left / np.maximum(total, 1e-300)


def _sparse_samples(
    spectra: np.ndarray, rows: np.ndarray, known: Known
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of each group and transmit antenna its samples of some rows (L_rx, rows, S) and their slots
    (S,)."""
    for m in range(len(spectra)):
        for sent in known.sent_by:
            chosen = np.flatnonzero(sent[m])
            yield spectra[m][:, rows][:, :, chosen], chosen


def sparse_enough(spectra: np.ndarray, rows: np.ndarray, noise: float, known: Known) -> bool:
    """Whether the occupied range rows are sparse enough in Doppler for random sampling (scheme
    (d)).

    The paper falls back to scheme (c) "when the scene is not sparse" and gives no rule. Here: in a
    majority of the occupied rows, weighted by power over the noise, as many atoms as the sampling
    recovers dependably must explain all but `MOST_UNEXPLAINED` of what is above the noise. A path
    half a bin off the grid needs two atoms for 81 % of its power.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) cleaned
    rows : indices of the occupied rows; none is sparse
    noise : mean power of a sample of `spectra` without paths
    """
    if not len(rows):
        return True
    power = np.mean(np.abs(spectra[:, :, rows]) ** 2, axis=(0, 1, 3))
    above = np.maximum(power - noise, 1e-3 * noise)
    w = known.waveform
    size = w.num_chirps // w.num_tx
    # of the noise: each atom takes one dimension
    kept = 1 - recovery_limit(size, w.num_chirps) / size
    share = (unexplained(spectra, rows, known) * power - kept * noise) / above
    return bool(np.average(share < MOST_UNEXPLAINED, weights=above) > 0.5)


def omp(vectors: np.ndarray, chosen: np.ndarray, num_chirps: int, sparsity: int) -> np.ndarray:
    """Batch orthogonal matching pursuit of slow-time vectors in the Doppler DFT dictionary.

    Parameters
    ----------
    vectors : (V, S) complex; V vectors sampled at the S slots of `chosen`
    chosen : (S,) slots in [0, P)
    num_chirps : P
    sparsity : atoms per vector

    Returns
    -------
    coefficients : (V, P) complex64, FFT order, `sparsity` non-zeros each, scaled as S times the
        amplitude (so that they compare with the plain correlation of an atom)

    References
    ----------
    .. [1] R. Rubinstein et al., "Efficient Implementation of the K-SVD Algorithm using Batch OMP",
    2008 (the Gram-matrix form).
    """
    count, size = vectors.shape
    atoms = np.exp(2j * np.pi * np.outer(chosen, np.arange(num_chirps)) / num_chirps)
    gram = atoms.conj().T @ atoms
    # few or evenly spaced samples do not tell all atoms apart: alike ones share a coefficient then
    ridge = 1e-9 * size
    first = vectors @ atoms.conj()
    correlation, support = first.copy(), np.zeros((count, 0), np.int64)
    solution = np.zeros((count, 0), np.complex128)
    rows = np.arange(count)
    for _ in range(sparsity):
        best = np.abs(correlation)
        best[rows[:, None], support] = -1
        support = np.concatenate([support, best.argmax(axis=1)[:, None]], axis=1)
        inner = gram[support[:, :, None], support[:, None, :]] + ridge * np.eye(support.shape[1])
        solution = np.linalg.solve(inner, first[rows[:, None], support][..., None])[..., 0]
        correlation = first - np.einsum("vk,vkp->vp", solution, gram[support].conj())
    out = np.zeros((count, num_chirps), np.complex64)
    out[rows[:, None], support] = solution * size
    return out


def omp_power(spectra: np.ndarray, rows: np.ndarray, known: Known, sparsity: int) -> np.ndarray:
    """Accumulated OMP power on some range rows (the paper's map): mean over groups, antennas and
    receivers.

    Returns
    -------
    power : (len(rows), P) float32, Doppler centred, in units of the squared correlation of one
        group's antenna
    """
    num_groups, num_rx, _, num_chirps = spectra.shape
    power = np.zeros((len(rows), num_chirps), np.float64)
    for part, chosen in _sparse_samples(spectra, rows, known):
        found = omp(part.reshape(-1, chosen.size), chosen, num_chirps, sparsity)
        power += (np.abs(found.reshape(num_rx, len(rows), num_chirps)) ** 2).sum(axis=0)
    power /= num_groups * known.waveform.num_tx * num_rx
    return np.fft.fftshift(power, axes=-1).astype(np.float32)


class Omp(LatinUnion):
    """Each group's sparse sampling: the correlations, where OMP's support keeps them.

    A cell stays if OMP's accumulated power there, compared with the correlation's, is above the
    background: the sparse sampling's sidelobes fall away. A path some 20 dB below another one of
    its row is lost: off the grid the stronger one takes several of the few atoms.
    """

    advises = True

    def keep(
        self, above: np.ndarray, levels: Levels, spectra: np.ndarray, known: Known
    ) -> np.ndarray:
        rows, out = np.flatnonzero(above.any(axis=1)), np.zeros_like(above)
        if rows.size:
            found = omp_power(spectra, rows, known, SPARSITY)
            # the united correlation adds P/L_tx * groups chirps coherently with Hann's mean of 1/2,
            # OMP one group's
            gain = (len(known.schedule) / 2) ** 2
            out[rows] = found * gain > levels.background[rows]
        return above & out
