"""Orthogonal matching pursuit over slow time, for groups that sample it sparsely."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from isac_rt.kernels import receive_omp
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.receive_omp import RIDGE
from isac_rt.kernels.vector import LANES
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


def _sparse_samples(
    spectra: np.ndarray, rows: np.ndarray, known: Known
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return, per group and transmit antenna, the samples of some rows (L_rx, rows, S) and their
    slots (S,)."""
    for m in range(len(spectra)):
        for sent in known.sent_by:
            chosen = np.flatnonzero(sent[m])
            yield spectra[m][:, rows][:, :, chosen], chosen


def sparse_enough(spectra: np.ndarray, rows: np.ndarray, noise: float, known: Known) -> bool:
    """Return whether the occupied range rows are sparse enough in Doppler for random sampling
    (scheme (d)).

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
    return advise(spectra, rows, noise, known)[0]


def advise(
    spectra: np.ndarray, rows: np.ndarray, noise: float, known: Known
) -> tuple[bool, np.ndarray]:
    """`sparse_enough`, and what `SPARSITY` atoms have of the rows' power (the paper's map), by one
    search where these are as many as the sampling recovers dependably.

    Returns
    -------
    sparse : of `sparse_enough`
    recovered : (len(rows), P) float32, mean over groups, antennas and receivers, Doppler centred,
        in units of the squared correlation of one group's antenna
    """
    w = known.waveform
    if not len(rows):
        return True, np.zeros((0, w.num_chirps), np.float32)
    recovered = np.zeros((len(rows), w.num_chirps))
    total, left = np.zeros(len(rows)), np.zeros(len(rows))
    for part, chosen in _sparse_samples(spectra, rows, known):
        vectors, limit = part.reshape(-1, chosen.size), recovery_limit(chosen.size, w.num_chirps)
        atoms = pursued(vectors, chosen, w.num_chirps, limit)
        power = (part.real**2 + part.imag**2).sum(axis=(0, 2))
        total += power
        left += power - atoms.explained.reshape(part.shape[:2]).sum(axis=0)
        if limit != SPARSITY:
            atoms = pursued(vectors, chosen, w.num_chirps, SPARSITY)
        atoms.add_power(recovered)
    selected = spectra[:, :, rows]
    power = np.mean(selected.real**2 + selected.imag**2, axis=(0, 1, 3))
    above = np.maximum(power - noise, 1e-3 * noise)
    size = w.num_chirps // w.num_tx
    # of the noise: each atom takes one dimension
    least_share = 1 - recovery_limit(size, w.num_chirps) / size
    share = (left / np.maximum(total, 1e-300) * power - least_share * noise) / above
    sparse = bool(np.average(share < MOST_UNEXPLAINED, weights=above) > 0.5)
    recovered /= len(spectra) * w.num_tx * spectra.shape[1]
    return sparse, np.fft.fftshift(recovered, axes=-1).astype(np.float32)


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
    atoms = pursued(vectors, chosen, num_chirps, sparsity)
    out = np.zeros((len(vectors), num_chirps), np.complex64)
    np.put_along_axis(out, atoms.support, atoms.amplitude, axis=1)
    return out


class Pursued(NamedTuple):
    """Atoms of vectors (V, sparsity), S times their amplitudes, and the power that they explain
    (V,)."""

    support: np.ndarray
    amplitude: np.ndarray
    explained: np.ndarray

    def add_power(self, power: np.ndarray) -> None:
        """Add the squared amplitudes of vectors of (L_rx, rows) to `power` (rows, P)."""
        row = np.arange(len(self.support)) % len(power)
        np.add.at(power, (row[:, None], self.support), np.abs(self.amplitude) ** 2)


def pursued(vectors: np.ndarray, chosen: np.ndarray, num_chirps: int, sparsity: int) -> Pursued:
    """Return the support that `omp` finds; same parameters."""
    analysis, gram = _dictionary(tuple(chosen.tolist()), num_chirps)
    first = np.asarray(vectors, np.complex64) @ analysis
    support = np.empty((len(vectors), sparsity), np.int64)
    amplitude = np.empty((len(vectors), sparsity), np.complex128)
    fill_atoms(first, *gram, support, amplitude)
    matched = np.take_along_axis(first, support, axis=1)
    explained = (matched.conj() * amplitude).real.sum(axis=1)
    return Pursued(support, amplitude * chosen.size, explained)


@lru_cache(maxsize=32)
def _dictionary(chosen: tuple[int, ...], num_chirps: int) -> tuple[np.ndarray, np.ndarray]:
    """The atoms' conjugates (S, P) complex64 with zeros after them up to a multiple of `LANES`, and
    real and imaginary part of the products of an atom and the one k bins on (2, 3 P): three times,
    so that no stretch of P ends at the edge."""
    atoms = np.exp(2j * np.pi * np.outer(chosen, np.arange(num_chirps)) / num_chirps)
    gram = np.tile(atoms.sum(axis=0), 3)
    analysis = np.pad(atoms.conj().astype(np.complex64), ((0, 0), (0, -num_chirps % LANES)))
    return analysis, np.stack([gram.real, gram.imag])


@twin_of(receive_omp.pursue)
def fill_atoms(
    first: np.ndarray,
    gram_re: np.ndarray,
    gram_im: np.ndarray,
    support: np.ndarray,
    amplitude: np.ndarray,
) -> None:
    """Fill `support` and `amplitude` (V, sparsity) from the correlations `first` (V, P and what
    fills vectors): the atom of most residual correlation, then the least squares of all so far.

    `gram_re` and `gram_im` are the parts of the product of an atom and the one k bins on, for k in
    [0, 3 P).
    """
    gram = gram_re + 1j * gram_im
    num_chirps, each = gram.size // 3, np.arange(len(first))[:, None]
    bins, correlation = np.arange(num_chirps), first[:, : gram.size // 3]
    for k in range(support.shape[1]):
        chosen = support[:, :k]
        left = gram[num_chirps - chosen[..., None] + bins].conj() * amplitude[:, :k, None]
        power = np.abs(correlation - left.sum(axis=1)) ** 2
        power[each, chosen] = -1.0
        support[:, k] = power.argmax(axis=1)
        chosen = support[:, : k + 1]
        products = gram[chosen[:, None] - chosen[:, :, None] + num_chirps]
        products = products + RIDGE * gram_re[0] * np.eye(k + 1)
        right = correlation[each, chosen][..., None].astype(complex)
        amplitude[:, : k + 1] = np.linalg.solve(products, right)[..., 0]


class Omp(LatinUnion):
    """Each group's sparse sampling: the correlations, where OMP's support keeps them.

    A cell stays if OMP's accumulated power there, compared with the correlation's, is above the
    background: the sparse sampling's sidelobes fall away. A path some 20 dB below another one of
    its row is lost: off the grid the stronger one takes several of the few atoms.
    """

    advises = True

    def keep(self, above: np.ndarray, levels: Levels, known: Known) -> np.ndarray:
        assert levels.recovered is not None  # for it advises
        rows, out = np.flatnonzero(above.any(axis=1)), np.zeros_like(above)
        # the united correlation adds P/L_tx * groups chirps coherently with Hann's mean of 1/2,
        # OMP one group's
        gain = (len(known.schedule) / 2) ** 2
        out[rows] = levels.recovered * gain > levels.background[rows]
        return above & out
