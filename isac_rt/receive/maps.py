"""Range-Doppler maps from cleaned spectra: the union of the groups, or each group's sparse sampling
with OMP.

By the Latin property every transmit antenna sends in every slot, in some group. The union of the
groups is then a uniform sampling with the slot's full rate, up to the offsets of the groups and of
the data (2 m T_d and tau_D), which `union_operator` takes out. Doppler bins are centred: bin 0 of
the output is -P/2. Receding is positive.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from isac_rt.frame.waveform import Waveform, hann
from isac_rt.kernels.jit import jit
from isac_rt.receive.known import Known

UNION_FLOOR = 1e-5
"""Share of a path's power that the resampling of the united groups may leave in any other Doppler
bin; reached within 2 % of the unambiguous velocity."""
_ROWS = 128
"""Range cells of an antenna, all groups' chirps, that stay in the second-level cache."""


def slow_window(waveform: Waveform) -> np.ndarray:
    """Hann over the slots (P,), periodic, float32."""
    p = np.arange(waveform.num_chirps) + 0.5
    return hann(p, waveform.num_chirps).astype(np.float32)


def doppler_bins(waveform: Waveform) -> np.ndarray:
    """(P,) bin numbers, ascending from -P/2 (or -(P-1)/2)."""
    return np.fft.fftshift(np.fft.fftfreq(waveform.num_chirps, 1 / waveform.num_chirps))


def channel_maps(spectra: np.ndarray, known: Known) -> np.ndarray:
    """Doppler spectrum of every virtual channel over all its chirps, groups united.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) complex64 from `clean_spectrum`
    known : Known, whose data were taken out

    Returns
    -------
    maps : (L_tx, L_rx, rows, P) complex64, FFT order. Where the union is not the full sampling (M <
        L_tx) these are the correlations with the Doppler atoms, with the sampling's sidelobes in
        them.
    """
    return maps_with_power(spectra, known)[0]


def maps_with_power(spectra: np.ndarray, known: Known) -> tuple[np.ndarray, np.ndarray]:
    """`channel_maps`, and `accumulate` of them, added while they are in the cache."""
    maps = np.empty((known.waveform.num_tx, *spectra.shape[1:]), np.complex64)
    return maps, _mapped(spectra, known, maps)


def power_map(spectra: np.ndarray, known: Known) -> np.ndarray:
    """`accumulate` of the `channel_maps`, which are not kept: (rows, P) float32, centred."""
    return _mapped(spectra, known, np.empty((0, *spectra.shape[1:]), np.complex64))


def _mapped(spectra: np.ndarray, known: Known, maps: np.ndarray) -> np.ndarray:
    """`power_map`; fills (L_tx, L_rx, rows, P) `channel_maps`, or none."""
    power = np.zeros(spectra.shape[2:], np.float32)
    ends, places, parts = _operators(known)
    places = places[0] * np.uint64(spectra[0].size) + places[1]
    _make_maps(np.ascontiguousarray(spectra), ends, places, parts, maps, power)
    return np.fft.fftshift(power, axes=-1) / (known.waveform.num_tx * spectra.shape[1])


@lru_cache(maxsize=8)
def _operators(known: Known) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the chirps of each transmit antenna begin and end (L_tx + 1,), the groups and numbers
    of all these chirps (2, S), and the real and imaginary parts of the operators on them for the
    bins from 0 to P/2 (S, P + 2)."""
    w, half = known.waveform, known.waveform.num_chirps // 2 + 1
    places, parts = [], []
    for sent in known.sent_by:
        operator = (union_operator if known.full else correlation_operator)(w, known.slots[sent])
        rows = operator[:half].copy()
        if w.num_chirps % 2 == 0:  # the lowest bin, -P/2, stands where P/2 would
            rows[-1] = rows[-1].conj()
        places.append(np.nonzero(sent))
        parts.append(np.concatenate([rows.real, rows.imag]).T)
    ends = np.cumsum([0, *map(len, parts)])
    every = np.ascontiguousarray(np.concatenate(parts))
    return ends, np.concatenate(places, axis=1).astype(np.uint64), every


class Levels(NamedTuple):
    """A map and its background (rows, P), and what OMP recovers of the rows with a cell above the
    threshold, where it was asked (`isac_rt.receive.omp.advise`)."""

    power: np.ndarray
    background: np.ndarray
    recovered: np.ndarray | None = None


class LatinUnion:
    """All groups as one uniform sampling of slow time; the map of a receiver by this way.

    Attributes
    ----------
    separate : groups are added in power and not in phase: velocities are known up to the
        unambiguous velocity divided by L_tx
    advises : says whether the scene is sparse enough for sparse sampling
    """

    separate = False
    advises = False

    def power(self, spectra: np.ndarray, known: Known) -> np.ndarray:
        """(rows, P) power, Doppler centred."""
        return known.mapped(spectra, lambda: power_map(spectra, known))

    def keep(self, above: np.ndarray, levels: Levels, known: Known) -> np.ndarray:
        """Which of the cells `above` the threshold may be peaks."""
        return above


LATIN_UNION = LatinUnion()


class Conventional(LatinUnion):
    """The DFT over each antenna's own chirps in each group."""

    separate = True
    advises = True

    def power(self, spectra: np.ndarray, known: Known) -> np.ndarray:
        return conventional_power(spectra, known)

    def keep(self, above: np.ndarray, levels: Levels, known: Known) -> np.ndarray:
        return above & own_bins(known.waveform)


class Banded(LatinUnion):
    """Antennas that send at once, each decoded from all chirps.

    In an antenna's channel the echoes of the others lie whole Doppler bands away. A path shows in
    all channels in its own band and in fewer of them in the others, so that the strongest band
    counts, by the power of a cell and its neighbours, and no skirt of the others does. Where codes
    leave two bands alike the lowest velocities do.
    """

    def keep(self, above: np.ndarray, levels: Levels, known: Known) -> np.ndarray:
        w = known.waveform
        share = known.unambiguous_share
        if share == 1:
            about = ndimage.uniform_filter(levels.power, 3, mode=("nearest", "wrap"))
            around = ndimage.maximum_filter(about, 3, mode=("nearest", "wrap"))
            step = w.num_chirps // w.bands
            for k in range(1, w.bands):
                above = above & (about >= np.roll(around, k * step, axis=1))
            return above
        return above & (np.abs(doppler_bins(w) + 0.25) < share * w.num_chirps / 2)


@jit
def _make_maps(spectra, ends, places, parts, maps, power):
    """Add the power of all virtual channels to power (rows, P), FFT order, and write maps (L_tx,
    L_rx, rows, P) if there is room for them; `places` of chirps in the samples of all groups.

    An operator is a real matrix before the DFT, so that its rows of opposite bins are conjugates.
    With a + j b such a row and x + j y the samples, both bins follow from a x, b x, a y and b y:
    half of the multiplications. All antennas' chirps of some range cells are taken while they are
    in the cache.
    """
    num_rx, num_rows, num_chirps = spectra.shape[1:]
    flat, half = spectra.reshape(-1), parts.shape[1] // 2
    room = np.empty(2 * _ROWS * places.size, np.float32)
    made = np.empty((2 * _ROWS, 2 * half), np.float32)
    for first in range(0, num_rows, _ROWS):
        count = min(_ROWS, num_rows - first)
        for rx in range(num_rx):
            start = np.uint64((rx * num_rows + first) * num_chirps)
            for tx in range(ends.size - 1):
                begin, end = ends[tx], ends[tx + 1]
                united = room[: 2 * count * (end - begin)].reshape(2 * count, end - begin)
                _unite(flat, start, places[begin:end], num_chirps, united)
                np.dot(united, parts[begin:end], made[: 2 * count])
                both = made[: 2 * count].reshape(2, count, 2, half)
                _add_both_bins(both, power[first : first + count])
                if maps.shape[0]:
                    _join_both_bins(both, maps[tx, rx, first : first + count])


@jit(borrows=True)
def _unite(flat, start, places, num_chirps, out):
    """out[i, s] and out[rows + i, s] = real and imaginary part of flat[start + i P + places[s]];
    unsigned, so that no index is checked for its sign."""
    rows = out.shape[0] // 2
    for i in range(rows):
        first, real, imag = start + np.uint64(i * num_chirps), out[i], out[rows + i]
        for s in range(places.size):
            value = flat[first + places[s]]
            real[s], imag[s] = value.real, value.imag


# no fused products: which of two is fused the compiler may decide anew, and bits would differ
# between processes
@jit(borrows=True)
def _add_both_bins(made, power):
    """power[i, k] and power[i, -k] += |.|^2 from made[x or y, i, a or b, k]."""
    num_chirps = power.shape[1]
    for i in range(power.shape[0]):
        ax, bx, ay, by = made[0, i, 0], made[0, i, 1], made[1, i, 0], made[1, i, 1]
        line = power[i]
        for k in range((num_chirps + 1) // 2):
            line[k] += (ax[k] - by[k]) ** 2 + (bx[k] + ay[k]) ** 2
        for k in range(1, num_chirps // 2 + 1):
            line[num_chirps - k] += (ax[k] + by[k]) ** 2 + (ay[k] - bx[k]) ** 2


@jit(borrows=True)
def _join_both_bins(made, out):
    """out[i, k] and out[i, -k] from made[x or y, i, a or b, k]."""
    num_chirps = out.shape[1]
    for i in range(out.shape[0]):
        ax, bx, ay, by = made[0, i, 0], made[0, i, 1], made[1, i, 0], made[1, i, 1]
        for k in range((num_chirps + 1) // 2):
            out[i, k] = complex(ax[k] - by[k], bx[k] + ay[k])
        for k in range(1, num_chirps // 2 + 1):
            out[i, num_chirps - k] = complex(ax[k] + by[k], ay[k] - bx[k])


def correlation_operator(waveform: Waveform, times: np.ndarray) -> np.ndarray:
    """(P, S) complex64: from S samples at `times` [slots] to their windowed correlations with the
    Doppler atoms."""
    bins = np.fft.fftfreq(waveform.num_chirps, 1 / waveform.num_chirps)
    atoms = np.exp(-2j * np.pi * np.outer(bins, times) / waveform.num_chirps)
    return (atoms * slow_window(waveform)[np.floor(times).astype(int)]).astype(np.complex64)


def union_operator(waveform: Waveform, times: np.ndarray) -> np.ndarray:
    """(P, P) complex64: from one antenna's samples at `times` [slots], one in each slot, to its
    windowed Doppler spectrum.

    The times are not quite uniform. The plain DFT, or turning each bin by its own group phase,
    would leave sidelobes of -25 to -35 dB at all other velocities. Here the samples are resampled
    to the uniform grid (about the mean offset) by the least-squares fit of all tones up to the
    unambiguous velocity: the normal equations of that band have the entries sinc(t - t'). What
    remains is below -60 dB, and below -50 dB within 2 % of the unambiguous velocity.
    """
    p = np.arange(waveform.num_chirps)
    grid = p + (times - np.floor(times)).mean()
    resample = np.linalg.solve(_sincs(times, times), _sincs(times, grid)).T
    return np.fft.fft(slow_window(waveform)[:, None] * resample, axis=0).astype(np.complex64)


@jit
def _sincs(a, b):
    """(A, B) `numpy.sinc` of the differences of places, by sines and cosines of each place."""
    out = np.empty((a.size, b.size))
    sine, cosine = np.sin(np.pi * b), np.cos(np.pi * b)
    for i in range(a.size):
        s, c = np.sin(np.pi * a[i]), np.cos(np.pi * a[i])
        for j in range(b.size):
            x = np.pi * (a[i] - b[j])
            near = 1 - x * x / 6 * (1 - x * x / 20)
            out[i, j] = near if abs(x) < 1e-3 else (s * cosine[j] - c * sine[j]) / x
    return out


@jit(borrows=True)
def add_power(power, values):
    """power += |values|^2 of two matrices, float32 and complex64."""
    for i in range(power.shape[0]):
        for j in range(power.shape[1]):
            power[i, j] += values[i, j].real ** 2 + values[i, j].imag ** 2


def accumulate(maps: np.ndarray) -> np.ndarray:
    """Mean power over the virtual channels, Doppler centred: (rows, P) float32."""
    power = np.zeros(maps.shape[-2:], np.float32)
    for channel in maps.reshape(-1, *maps.shape[-2:]):
        add_power(power, channel)
    return np.fft.fftshift(power, axes=-1) / (maps.shape[0] * maps.shape[1])


def conventional_power(spectra: np.ndarray, known: Known) -> np.ndarray:
    """Mean power of the DFT over each antenna's own chirps in each group: the conventional TDM-MIMO
    receiver, schemes (a) and (c).

    An antenna's P/L_tx samples lie L_tx slots apart, so the map repeats every P/L_tx bins:
    velocities are known up to the unambiguous velocity divided by L_tx. Groups are added in power.
    The few slots by which the antennas' samples start later, and the data delays, only turn phases.

    Returns
    -------
    power : (rows, P) float32, Doppler centred, periodic
    """
    num_groups, num_rx, num_rows, num_chirps = spectra.shape
    num_tx = known.waveform.num_tx
    size = num_chirps // num_tx
    window = hann(np.arange(size) + 0.5, size)
    turns = np.exp(-2j * np.pi * np.outer(np.arange(size), np.arange(size)) / size)
    analyse = (turns * window).astype(np.complex64)
    power = np.zeros((num_rows, size), np.float32)
    for m in range(num_groups):
        for sent in known.sent_by:
            own = spectra[m][..., sent[m]].reshape(-1, size) @ analyse.T
            power += (own.real**2 + own.imag**2).reshape(num_rx, num_rows, size).sum(axis=0)
    return np.fft.fftshift(np.tile(power / (num_groups * num_tx * num_rx), num_tx), axes=-1)


def own_bins(waveform: Waveform) -> np.ndarray:
    """(P,) bool: the centred bins within the unambiguous velocity of one antenna's uniform
    sampling."""
    size = waveform.num_chirps // waveform.num_tx
    bins = doppler_bins(waveform)
    return (bins >= -(size // 2)) & (bins < size - size // 2)
