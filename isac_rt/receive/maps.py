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
    """Return Hann's window over the slots (P,), periodic, float32."""
    p = np.arange(waveform.num_chirps) + 0.5
    return hann(p, waveform.num_chirps).astype(np.float32)


def doppler_bins(waveform: Waveform) -> np.ndarray:
    """Return the Doppler bin numbers (P,), ascending from -P/2 (or -(P-1)/2)."""
    return np.fft.fftshift(np.fft.fftfreq(waveform.num_chirps, 1 / waveform.num_chirps))


def channel_maps(spectra: np.ndarray, known: Known) -> np.ndarray:
    """Return the Doppler spectrum of each virtual channel over all its chirps, groups combined.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) complex64 from `clean_spectrum`
    known : Known, with the removed data

    Returns
    -------
    maps : (L_tx, L_rx, rows, P) complex64, FFT order. Where the union is not the full sampling (M <
        L_tx) these are the correlations with the Doppler atoms, with the sampling's sidelobes in
        them.
    """
    return maps_with_power(spectra, known)[0]


def maps_with_power(spectra: np.ndarray, known: Known) -> tuple[np.ndarray, np.ndarray]:
    """Return `channel_maps` and their `accumulate`, computed while they are in the cache."""
    maps = np.empty((known.waveform.num_tx, *spectra.shape[1:]), np.complex64)
    return maps, _mapped(spectra, known, maps)


def power_map(spectra: np.ndarray, known: Known) -> np.ndarray:
    """Return `accumulate` of the `channel_maps` without storing them: (rows, P) float32,
    centred."""
    return _mapped(spectra, known, np.empty((0, *spectra.shape[1:]), np.complex64))


def _mapped(spectra: np.ndarray, known: Known, maps: np.ndarray) -> np.ndarray:
    """Return `power_map`; fill in `channel_maps` (L_tx, L_rx, rows, P), if given."""
    power = np.zeros(spectra.shape[2:], np.float32)
    ends, index, factors = _operators(known)
    index = 2 * (index[0] * np.uint64(spectra[0].size) + index[1])
    flat = np.ascontiguousarray(spectra).reshape(-1).view(np.float32)
    workspace = aligned(4 * ROWS * len(factors) * PART)
    buffer = np.empty((ROWS, spectra.shape[3]), np.complex64)
    make_maps(flat, spectra.shape, ends, index, factors, workspace, maps, buffer, power)
    return np.fft.fftshift(power, axes=-1) / (known.waveform.num_tx * spectra.shape[1])


@lru_cache(maxsize=8)
def _operators(known: Known) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bounds of the chirps of each transmit antenna (L_tx + 1,), groups and numbers of
    all chirps (2, S), and the operators on them for bins 0 to P/2, real and imaginary parts in
    blocks of `PART` bins (blocks, S, 2, PART)."""
    w, half = known.waveform, known.waveform.num_chirps // 2 + 1
    make = union_operator if known.full else correlation_operator
    index = [np.nonzero(sent) for sent in known.sent_by]
    ends = np.cumsum([0, *(numbers.size for _, numbers in index)])
    rows = np.concatenate([make(w, known.slots[sent])[:half] for sent in known.sent_by], axis=1)
    blocks = -(-half // PART)
    parts = np.zeros((2, blocks * PART, rows.shape[1]), np.float32)
    parts[:, :half] = rows.real, rows.imag
    factors = aligned(parts.size).reshape(blocks, -1, 2, PART)
    factors[...] = parts.reshape(2, blocks, PART, -1).transpose(1, 3, 0, 2)
    return ends, np.concatenate(index, axis=1).astype(np.uint64), factors


class Levels(NamedTuple):
    """Map and background (rows, P), and the rows that OMP recovers, if used
    (`isac_rt.receive.omp.advise`)."""

    power: np.ndarray
    background: np.ndarray
    recovered: np.ndarray | None = None


class LatinUnion:
    """Map of all groups as one uniform sampling of slow time.

    Attributes
    ----------
    separate : add groups in power: the unambiguous velocity is divided by L_tx
    advises : test whether the scene is sparse enough for sparse sampling"""

    separate = False
    advises = False

    def power(self, spectra: np.ndarray, known: Known) -> np.ndarray:
        """Return the power (rows, P), Doppler centred."""
        return known.mapped(spectra, lambda: power_map(spectra, known))

    def keep(self, above: np.ndarray, levels: Levels, known: Known) -> np.ndarray:
        """Mark the cells above the threshold that may be peaks."""
        return above


LATIN_UNION = LatinUnion()


class Conventional(LatinUnion):
    """Map by the DFT over each antenna's chirps in each group."""

    separate = True
    advises = True

    def power(self, spectra: np.ndarray, known: Known) -> np.ndarray:
        return conventional_power(spectra, known)

    def keep(self, above: np.ndarray, levels: Levels, known: Known) -> np.ndarray:
        return above & own_bins(known.waveform)


class Banded(LatinUnion):
    """Map of antennas that send at once, each decoded from all chirps.

    In the channel of an antenna the echoes of the others lie whole Doppler bands away. A path is in
    all channels in its own band and in fewer in the others: the strongest band, by the power of a
    cell and its neighbours, is taken, without sidelobes of the others. Of equal bands the one of
    lowest velocities is taken."""

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
    index: np.ndarray,
    factors: np.ndarray,
    workspace: np.ndarray,
    maps: np.ndarray,
    buffer: np.ndarray,
    power: np.ndarray,
) -> None:
    """Add the power of all virtual channels to power (rows, P), FFT order, and write maps (L_tx,
    L_rx, rows, P) unless there are none.

    `flat`: real and imaginary parts of samples of `shape`; `index`: position of the chirps in them;
    `factors`: see `_operators`; `workspace` and `buffer`: memory of the kernel."""
    num_rx, num_rows, num_chirps = shape[1:]
    samples = flat.view(np.complex64)
    half = num_chirps // 2 + 1
    parts = factors.transpose(2, 0, 3, 1).reshape(2, -1, ends[-1])
    real, imag = parts[:, :half]
    lines = np.arange(num_rx * num_rows)[:, None] * num_chirps
    for tx in range(ends.size - 1):
        part = slice(ends[tx], ends[tx + 1])
        x = samples[lines + index[part].astype(np.int64) // 2]
        # the rows of the operator for opposite bins are conjugates
        made = [x @ (real[:, part] + j * imag[:, part]).T for j in (1j, -1j)]
        opposite = made[1][:, (num_chirps - 1) // 2 : 0 : -1]
        whole = np.concatenate([made[0], opposite], axis=1).reshape(num_rx, num_rows, num_chirps)
        power += (whole.real**2 + whole.imag**2).sum(axis=0)
        if len(maps):
            maps[tx] = whole


def correlation_operator(waveform: Waveform, times: np.ndarray) -> np.ndarray:
    """Return the operator (P, S) complex64 from S samples at `times` [slots] to their windowed
    correlations with the Doppler atoms."""
    bins = np.fft.fftfreq(waveform.num_chirps, 1 / waveform.num_chirps)
    atoms = np.exp(-2j * np.pi * np.outer(bins, times) / waveform.num_chirps)
    return (atoms * slow_window(waveform)[np.floor(times).astype(int)]).astype(np.complex64)


def union_operator(waveform: Waveform, times: np.ndarray) -> np.ndarray:
    """Return the operator (P, P) complex64 from one antenna's samples at `times` [slots], one per
    slot, to its windowed Doppler spectrum.

    The times are slightly non-uniform: a plain DFT, or a phase per group and bin, leaves sidelobes
    of -25 to -35 dB. The samples are resampled to a uniform grid about the mean offset by the
    least-squares fit of all tones up to the unambiguous velocity, whose normal equations have the
    entries sinc(t - t'). Sidelobes are then below -60 dB, or -50 dB within 2 % of the unambiguous
    velocity."""
    return _united(waveform, np.asarray(times, float).tobytes())


@lru_cache(maxsize=16)
def _united(waveform: Waveform, stored: bytes) -> np.ndarray:
    """Return `union_operator`, cached for receivers with the same data."""
    times = np.frombuffer(stored)
    p = np.arange(waveform.num_chirps)
    grid = p + (times - np.floor(times)).mean()
    band = times[:, None]
    resample = np.linalg.solve(np.sinc(band - times), np.sinc(band - grid)).T
    out = np.fft.fft(slow_window(waveform)[:, None] * resample, axis=0).astype(np.complex64)
    out.setflags(write=False)
    return out


def accumulate(maps: np.ndarray) -> np.ndarray:
    """Return the mean power over the virtual channels, Doppler centred: (rows, P) float32."""
    power = np.zeros(maps.shape[-2:], np.float32)
    for channel in maps.reshape(-1, *maps.shape[-2:]):
        power += channel.real**2 + channel.imag**2
    return np.fft.fftshift(power, axes=-1) / (maps.shape[0] * maps.shape[1])


def conventional_power(spectra: np.ndarray, known: Known) -> np.ndarray:
    """Return the mean power of the DFT over each antenna's chirps in each group: the conventional
    TDM-MIMO receiver, schemes (a) and (c).

    The P/L_tx samples of an antenna are L_tx slots apart, so the map repeats every P/L_tx bins: the
    unambiguous velocity is divided by L_tx. Groups are added in power. Start slots of antennas and
    data delays change phases only.

    Returns
    -------
    power : (rows, P) float32, Doppler centred, periodic
    """
    num_groups, num_rx, num_rows, num_chirps = spectra.shape
    num_tx = known.waveform.num_tx
    size = num_chirps // num_tx
    window = hann(np.arange(size) + 0.5, size)
    dft = np.exp(-2j * np.pi * np.outer(np.arange(size), np.arange(size)) / size)
    analyse = (dft * window).astype(np.complex64)
    power = np.zeros((num_rows, size), np.float32)
    for m in range(num_groups):
        for sent in known.sent_by:
            line = spectra[m][..., sent[m]].reshape(-1, size) @ analyse.T
            power += (line.real**2 + line.imag**2).reshape(num_rx, num_rows, size).sum(axis=0)
    return np.fft.fftshift(np.tile(power / (num_groups * num_tx * num_rx), num_tx), axes=-1)


def own_bins(waveform: Waveform) -> np.ndarray:
    """Mark the centred bins (P,) within the unambiguous velocity of one antenna's uniform
    sampling."""
    size = waveform.num_chirps // waveform.num_tx
    bins = doppler_bins(waveform)
    return (bins >= -(size // 2)) & (bins < size - size // 2)
