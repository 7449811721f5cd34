"""Range-Doppler maps from cleaned spectra: the union of the groups, or each group's sparse sampling with OMP.

By the Latin property every transmit antenna sends in every slot, in some group. The union of the groups is then a uniform sampling
with the slot's full rate, up to the offsets of the groups and of the data (2 m T_d and tau_D), which `union_operator` takes out.
Doppler bins are centred: bin 0 of the output is -P/2. Receding is positive.
"""

from __future__ import annotations

import numpy as np

from isac_rt.arrays import Schedule, is_latin
from isac_rt.waveform import Waveform

UNION_FLOOR = 1e-5
"""Share of a path's power that the resampling of the united groups may leave in any other Doppler bin; reached within 2 % of the
unambiguous velocity."""


def slow_window(waveform: Waveform) -> np.ndarray:
    """Hann over the slots (P,), periodic, float32."""
    p = np.arange(waveform.num_chirps) + 0.5
    return (np.sin(np.pi * p / waveform.num_chirps) ** 2).astype(np.float32)


def doppler_bins(waveform: Waveform) -> np.ndarray:
    """(P,) bin numbers, ascending from -P/2 (or -(P-1)/2)."""
    return np.fft.fftshift(np.fft.fftfreq(waveform.num_chirps, 1 / waveform.num_chirps))


def slow_times(waveform: Waveform, delay_symbols: np.ndarray) -> np.ndarray:
    """(M, P) times of the cleaned chirps in slots: a group is 2 m T_d late, and the window of a chirp with data lies tau_D later."""
    w = waveform
    return (w.chirp_time + delay_symbols * w.delay_step) / w.slot_duration


def channel_maps(spectra: np.ndarray, waveform: Waveform, schedule: Schedule, delay_symbols: np.ndarray) -> np.ndarray:
    """Doppler spectrum of every virtual channel over all its chirps, groups united.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) complex64 from `clean_spectrum`
    delay_symbols : (M, P) int, those that were removed

    Returns
    -------
    maps : (L_tx, L_rx, rows, P) complex64, FFT order. Where the union is not the full sampling (M < L_tx) these are the
        correlations with the Doppler atoms, with the sampling's sidelobes in them.
    """
    num_groups, num_rx, num_rows, num_chirps = spectra.shape
    out = np.empty((waveform.num_tx, num_rx, num_rows, num_chirps), np.complex64)
    full = num_groups == waveform.num_tx and is_latin(schedule, waveform.num_tx)
    times = slow_times(waveform, delay_symbols)
    for tx in range(waveform.num_tx):
        sent = schedule == tx
        united = np.concatenate([spectra[m][..., sent[m]] for m in range(num_groups)], axis=-1)
        operator = union_operator(waveform, times[sent]) if full else correlation_operator(waveform, times[sent])
        np.matmul(united.reshape(-1, united.shape[-1]), operator.T, out=out[tx].reshape(-1, num_chirps))
    return out


def correlation_operator(waveform: Waveform, times: np.ndarray) -> np.ndarray:
    """(P, S) complex64: from S samples at `times` [slots] to their windowed correlations with the Doppler atoms."""
    bins = np.fft.fftfreq(waveform.num_chirps, 1 / waveform.num_chirps)
    atoms = np.exp(-2j * np.pi * np.outer(bins, times) / waveform.num_chirps)
    return (atoms * slow_window(waveform)[np.floor(times).astype(int)]).astype(np.complex64)


def union_operator(waveform: Waveform, times: np.ndarray) -> np.ndarray:
    """(P, P) complex64: from one antenna's samples at `times` [slots], one in each slot, to its windowed Doppler spectrum.

    The times are not quite uniform. The plain DFT, or turning each bin by its own group phase, would leave sidelobes of -25 to -35 dB
    at all other velocities. Here the samples are resampled to the uniform grid (about the mean offset) by the least-squares fit
    of all tones up to the unambiguous velocity: the normal equations of that band have the entries sinc(t - t'). What
    remains is below -60 dB, and below -50 dB within 2 % of the unambiguous velocity.
    """
    p = np.arange(waveform.num_chirps)
    bins = np.fft.fftfreq(waveform.num_chirps, 1 / waveform.num_chirps)
    grid = p + (times - np.floor(times)).mean()
    resample = np.linalg.solve(np.sinc(times[:, None] - times), np.sinc(times[:, None] - grid)).T
    analyse = np.exp(-2j * np.pi * np.outer(bins, p) / waveform.num_chirps)
    return (analyse @ (slow_window(waveform)[:, None] * resample)).astype(np.complex64)


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
        correlation = first - np.einsum("vk,vkp->vp", solution, gram[support].conj())
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
