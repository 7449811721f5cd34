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
from isac_rt.kernels import receive_maps
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.receive_maps import ROWS
from isac_rt.kernels.vector import PART, aligned
from isac_rt.receive.known import Known

UNION_FLOOR = 1e-5
"""Share of a path's power that the resampling of the united groups may leave in any other Doppler
bin; reached within 2 % of the unambiguous velocity."""


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
    ends, places, factors = _operators(known)
    places = 2 * (places[0] * np.uint64(spectra[0].size) + places[1])
    flat = np.ascontiguousarray(spectra).reshape(-1).view(np.float32)
    workspace = aligned(4 * ROWS * len(factors) * PART)
    buffer = np.empty((ROWS, spectra.shape[3]), np.complex64)
    make_maps(flat, spectra.shape, ends, places, factors, workspace, maps, buffer, power)
    return np.fft.fftshift(power, axes=-1) / (known.waveform.num_tx * spectra.shape[1])


@lru_cache(maxsize=8)
def _operators(known: Known) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the chirps of each transmit antenna begin and end (L_tx + 1,), the groups and numbers
    of all these chirps (2, S), and the real and imaginary parts of the operators on them for the
    bins from 0 to P/2, `PART` bins at a time: (blocks, S, 2, PART)."""
    w, half = known.waveform, known.waveform.num_chirps // 2 + 1
    make = union_operator if known.full else correlation_operator
    places = [np.nonzero(sent) for sent in known.sent_by]
    ends = np.cumsum([0, *(numbers.size for _, numbers in places)])
    rows = np.concatenate([make(w, known.slots[sent])[:half] for sent in known.sent_by], axis=1)
    blocks = -(-half // PART)
    parts = np.zeros((2, blocks * PART, rows.shape[1]), np.float32)
    parts[:, :half] = rows.real, rows.imag
    factors = aligned(parts.size).reshape(blocks, -1, 2, PART)
    factors[...] = parts.reshape(2, blocks, PART, -1).transpose(1, 3, 0, 2)
    return ends, np.concatenate(places, axis=1).astype(np.uint64), factors


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
        """Mark the cells `above` the threshold that may be peaks."""
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


def in_their_span(statistic: np.ndarray, spans: int) -> np.ndarray:
    """Mark the cells (rows, P) whose neighbourhood holds no less than those that lie whole spans of
    velocities off, of so many in which antennas that share the chirps show an echo: all channels
    agree on a direction in the right one alone."""
    around = ndimage.maximum_filter(statistic, 3, mode=("nearest", "wrap"))
    held = statistic > 0
    for k in range(1, spans):
        held &= around >= np.roll(around, k * statistic.shape[1] // spans, axis=1)
    return held


@twin_of(receive_maps.make_maps)
def make_maps(
    flat: np.ndarray,
    shape: tuple[int, ...],
    ends: np.ndarray,
    places: np.ndarray,
    factors: np.ndarray,
    workspace: np.ndarray,
    maps: np.ndarray,
    buffer: np.ndarray,
    power: np.ndarray,
) -> None:
    """Add the power of all virtual channels to power (rows, P), FFT order, and write maps (L_tx,
    L_rx, rows, P) unless there are none.

    `flat` are the real and imaginary parts of samples of `shape`, `places` say where chirps stand
    in them; `factors` see `_operators`. `workspace` and `buffer` are work space.
    """
    num_rx, num_rows, num_chirps = shape[1:]
    samples = flat.view(np.complex64)
    half = num_chirps // 2 + 1
    parts = factors.transpose(2, 0, 3, 1).reshape(2, -1, ends[-1])
    real, imag = parts[:, :half]
    lines = np.arange(num_rx * num_rows)[:, None] * num_chirps
    for tx in range(ends.size - 1):
        own = slice(ends[tx], ends[tx + 1])
        x = samples[lines + places[own].astype(np.int64) // 2]
        # the rows of the operator for opposite bins are conjugates
        made = x @ (real[:, own] + 1j * imag[:, own]).T, x @ (real[:, own] - 1j * imag[:, own]).T
        opposite = made[1][:, (num_chirps - 1) // 2 : 0 : -1]
        one = np.concatenate([made[0], opposite], axis=1).reshape(num_rx, num_rows, num_chirps)
        power += (one.real**2 + one.imag**2).sum(axis=0)
        if len(maps):
            maps[tx] = one


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
    return _united(waveform, np.asarray(times, float).tobytes())


@lru_cache(maxsize=16)
def _united(waveform: Waveform, stored: bytes) -> np.ndarray:
    """`union_operator`, once for all receivers that read the same data."""
    times = np.frombuffer(stored)
    p = np.arange(waveform.num_chirps)
    grid = p + (times - np.floor(times)).mean()
    band = times[:, None]
    resample = np.linalg.solve(np.sinc(band - times), np.sinc(band - grid)).T
    out = np.fft.fft(slow_window(waveform)[:, None] * resample, axis=0).astype(np.complex64)
    out.setflags(write=False)
    return out


def accumulate(maps: np.ndarray) -> np.ndarray:
    """Mean power over the virtual channels, Doppler centred: (rows, P) float32."""
    power = np.zeros(maps.shape[-2:], np.float32)
    for channel in maps.reshape(-1, *maps.shape[-2:]):
        power += channel.real**2 + channel.imag**2
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
