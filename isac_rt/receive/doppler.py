"""Range-Doppler maps from cleaned spectra: the union of the groups, or each group's sparse sampling with OMP.

By the Latin property every transmit antenna sends in every slot, in some group. The union of the groups is then a uniform sampling
with the slot's full rate, up to the groups' offsets 2 m T_d, which `union_operator` takes out.
Doppler bins are centred: bin 0 of the output is -P/2. Receding is positive.
"""

from __future__ import annotations

import numpy as np
import scipy.fft

from isac_rt.arrays import Schedule, is_latin
from isac_rt.waveform import Waveform


def slow_window(waveform: Waveform) -> np.ndarray:
    """Hann over the slots (P,), periodic, float32."""
    p = np.arange(waveform.num_chirps) + 0.5
    return (np.sin(np.pi * p / waveform.num_chirps) ** 2).astype(np.float32)


def doppler_bins(waveform: Waveform) -> np.ndarray:
    """(P,) bin numbers, ascending from -P/2 (or -(P-1)/2)."""
    return np.fft.fftshift(np.fft.fftfreq(waveform.num_chirps, 1 / waveform.num_chirps))


def group_phase(waveform: Waveform) -> np.ndarray:
    """(M, P) exp(-j 2 pi f_D 2 m T_d) per Doppler bin, in FFT order."""
    w = waveform
    frequency = np.fft.fftfreq(w.num_chirps, w.slot_duration)
    offsets = np.arange(w.num_groups) * w.group_spacing
    return np.exp(-2j * np.pi * offsets[:, None] * frequency[None, :]).astype(np.complex64)


def channel_maps(spectra: np.ndarray, waveform: Waveform, schedule: Schedule) -> np.ndarray:
    """Doppler spectrum of every virtual channel over all its chirps, groups united.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) complex64 from `clean_spectrum`

    Returns
    -------
    maps : (L_tx, L_rx, rows, P) complex64, FFT order. Where the union is not the full sampling (M < L_tx) these are the
        correlations with the Doppler atoms, with the sampling's sidelobes in them.
    """
    num_groups, num_rx, num_rows, num_chirps = spectra.shape
    out = np.empty((waveform.num_tx, num_rx, num_rows, num_chirps), np.complex64)
    full = num_groups == waveform.num_tx and is_latin(schedule, waveform.num_tx)
    for tx in range(waveform.num_tx):
        united = np.zeros((num_rx, num_rows, num_chirps), np.complex64)
        for m in range(num_groups):
            if full:
                np.copyto(united, spectra[m], where=schedule[m] == tx)
            else:
                united = spectra[m] * (schedule[m] == tx)
                _correlate(united, out[tx], slow_window(waveform), group_phase(waveform)[m], first=m == 0)
        if full:
            operator = union_operator(waveform, (schedule == tx).argmax(axis=0))
            np.matmul(united.reshape(-1, num_chirps), operator.T, out=out[tx].reshape(-1, num_chirps))
    return out


def _correlate(masked: np.ndarray, out: np.ndarray, window: np.ndarray, turn: np.ndarray, first: bool) -> None:
    part = scipy.fft.fft(masked * window, axis=-1, workers=1, overwrite_x=True) * turn
    out[...] = part if first else out + part


def union_operator(waveform: Waveform, group: np.ndarray) -> np.ndarray:
    """(P, P) complex64: from one antenna's samples, slot p heard in `group[p]`, to its windowed Doppler spectrum.

    The samples lie at p + group[p] * 2 T_d / T-, not quite uniformly. Turning each bin by its own group phase would match that bin
    and leave sidelobes of -31 dB of every other velocity; the plain DFT leaves them at high velocity. Solving for the
    spectrum that takes these values at these times (the system is near the identity) leaves neither.
    """
    w, p = waveform, np.arange(waveform.num_chirps)
    bins = np.fft.fftfreq(w.num_chirps, 1 / w.num_chirps)
    times = p + group * (w.group_spacing / w.slot_duration)
    synthesis = np.exp(2j * np.pi * np.outer(times, bins) / w.num_chirps)
    uniform = np.exp(2j * np.pi * np.outer(p, bins) / w.num_chirps)
    resample = np.linalg.solve(synthesis.T, uniform.T).T
    return (uniform.conj().T @ (slow_window(w)[:, None] * resample)).astype(np.complex64)


def accumulate(maps: np.ndarray) -> np.ndarray:
    """Mean power over the virtual channels, Doppler centred: (rows, P) float32."""
    power = np.zeros(maps.shape[-2:], np.float32)
    for channel in maps.reshape(-1, *maps.shape[-2:]):
        power += channel.real**2 + channel.imag**2
    return np.fft.fftshift(power, axes=-1) / (maps.shape[0] * maps.shape[1])


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
    coefficients : (V, P) complex64, FFT order, `sparsity` non-zeros each, scaled as S times the amplitude (so that they
        compare with the plain correlation of an atom)

    References
    ----------
    .. [1] R. Rubinstein et al., "Efficient Implementation of the K-SVD Algorithm using Batch OMP", 2008 (the Gram-matrix form).
    """
    count, size = vectors.shape
    atoms = np.exp(2j * np.pi * np.outer(chosen, np.arange(num_chirps)) / num_chirps)
    gram = atoms.conj().T @ atoms
    first = vectors @ atoms.conj()
    correlation, support = first.copy(), np.zeros((count, 0), np.int64)
    solution = np.zeros((count, 0), np.complex128)
    rows = np.arange(count)
    for _ in range(sparsity):
        best = np.abs(correlation)
        best[rows[:, None], support] = -1
        support = np.concatenate([support, best.argmax(axis=1)[:, None]], axis=1)
        inner = gram[support[:, :, None], support[:, None, :]]
        solution = np.linalg.solve(inner, first[rows[:, None], support][..., None])[..., 0]
        correlation = first - np.einsum("vk,vkp->vp", solution, gram[support])
    out = np.zeros((count, num_chirps), np.complex64)
    out[rows[:, None], support] = solution * size
    return out


def omp_power(spectra: np.ndarray, rows: np.ndarray, waveform: Waveform, schedule: Schedule, sparsity: int) -> np.ndarray:
    """Accumulated OMP power on some range rows (the paper's map): mean over groups, antennas and receivers.

    Returns
    -------
    power : (len(rows), P) float32, Doppler centred, in units of the squared correlation of one group's antenna
    """
    num_groups, num_rx, _, num_chirps = spectra.shape
    power = np.zeros((len(rows), num_chirps), np.float64)
    for m in range(num_groups):
        for tx in range(waveform.num_tx):
            chosen = np.flatnonzero(schedule[m] == tx)
            vectors = spectra[m][:, rows][:, :, chosen].reshape(-1, chosen.size)
            found = omp(vectors, chosen, num_chirps, sparsity).reshape(num_rx, len(rows), num_chirps)
            power += (np.abs(found) ** 2).sum(axis=0)
    power /= num_groups * waveform.num_tx * num_rx
    return np.fft.fftshift(power, axes=-1).astype(np.float32)
