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
from isac_rt.kernels.vector import (
    PART,
    aligned,
    backwards,
    load_part,
    splat_part,
    store,
    zip_high,
    zip_low,
)
from isac_rt.receive.known import Known

UNION_FLOOR = 1e-5
"""Share of a path's power that the resampling of the united groups may leave in any other Doppler
bin; reached within 2 % of the unambiguous velocity."""
_ROWS = 24
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
    ends, places, factors = _operators(known)
    places = 2 * (places[0] * np.uint64(spectra[0].size) + places[1])
    flat = np.ascontiguousarray(spectra).reshape(-1).view(np.float32)
    room = aligned(4 * _ROWS * len(factors) * PART)
    spare = np.empty((_ROWS, spectra.shape[3]), np.complex64)
    _make_maps(flat, spectra.shape, ends, places, factors, room, maps, spare, power)
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


@jit(borrows=True)
def _make_maps(flat, shape, ends, places, factors, room, maps, spare, power):
    """Add the power of all virtual channels to power (rows, P), FFT order, and write maps (L_tx,
    L_rx, rows, P), or parts of them to `spare` where they have no room. `flat` are the real and
    imaginary parts of samples of `shape`, `places` say where chirps stand in them; unsigned, so
    that no index is checked for its sign.

    An operator is a real matrix before the DFT, so that its rows of opposite bins are conjugates.
    With a + j b such a row and x + j y the samples, both bins follow from a x, b x, a y and b y:
    half of the multiplications. A block of bins stays in the first-level cache for some rows, and
    what is made of these in `room`.
    """
    num_rx, num_rows, num_chirps = shape[1:]
    size, operators = factors.shape[0] * PART, factors.reshape(-1)
    for rx in range(num_rx):
        for first in range(0, num_rows, _ROWS):
            last = min(first + _ROWS, num_rows)
            for tx in range(ends.size - 1):
                sent = places[ends[tx] : ends[tx + 1]]
                for block in range(factors.shape[0]):
                    at = (block * factors.shape[1] + ends[tx]) * 2 * PART
                    for i in range(first, last, 3):
                        rows = i, min(i + 1, last - 1), min(i + 2, last - 1)
                        samples = flat, rx * num_rows, 2 * num_chirps
                        _three_rows(samples, rows, sent, operators, at, room, first, (size, block))
                lines = maps[tx, rx, first:last] if maps.shape[0] else spare[: last - first]
                for i in range(last - first):
                    made = room[4 * i * size : 4 * (i + 1) * size]
                    _join_bins(made.view(np.complex64), lines[i])
                add_power(power[first:last], lines)


@jit(borrows=True)
def _three_rows(samples, rows, places, operators, at, room, first, part):
    """A block of bins and the opposite ones, of three rows at once: their twelve sums, both factors
    and a sample's two parts fill the registers of a processor that has sixteen."""
    flat, before, step = samples
    r0, r1, r2 = (
        np.uint64((before + rows[0]) * step),
        np.uint64((before + rows[1]) * step),
        np.uint64((before + rows[2]) * step),
    )
    zero, imag = splat_part(np.float32(0)), np.uint64(1)
    ax0, bx0, ay0, by0 = zero, zero, zero, zero
    ax1, bx1, ay1, by1 = zero, zero, zero, zero
    ax2, bx2, ay2, by2 = zero, zero, zero, zero
    for s in range(places.size):
        p, a, b = places[s], load_part(operators, at), load_part(operators, at + PART)
        x, y = flat[r0 + p], flat[r0 + p + imag]
        ax0, bx0, ay0, by0 = ax0 + a * x, bx0 + b * x, ay0 + a * y, by0 + b * y
        x, y = flat[r1 + p], flat[r1 + p + imag]
        ax1, bx1, ay1, by1 = ax1 + a * x, bx1 + b * x, ay1 + a * y, by1 + b * y
        x, y = flat[r2 + p], flat[r2 + p + imag]
        ax2, bx2, ay2, by2 = ax2 + a * x, bx2 + b * x, ay2 + a * y, by2 + b * y
        at += 2 * PART
    _keep_both(room, rows[0] - first, part, ax0, bx0, ay0, by0)
    _keep_both(room, rows[1] - first, part, ax1, bx1, ay1, by1)
    _keep_both(room, rows[2] - first, part, ax2, bx2, ay2, by2)


@jit(inline=True)
def _keep_both(room, row, part, ax, bx, ay, by):
    """Write a block of bins to a row's part of `room`, and the opposite bins, the lowest first, at
    its end."""
    size, block = part
    begin = 4 * row * size + 2 * block * PART
    end = 4 * (row + 1) * size - 2 * (block + 1) * PART
    re, im = ax - by, bx + ay
    store(room, begin, zip_low(re, im))
    store(room, begin + PART, zip_high(re, im))
    re, im = backwards(ax + by), backwards(ay - bx)
    store(room, end, zip_low(re, im))
    store(room, end + PART, zip_high(re, im))


@jit(borrows=True)
def _join_bins(made, line):
    """Bins in FFT order from what `_keep_both` wrote, the last of which is bin 0 again."""
    half, before = line.size // 2 + 1, made.size - 1 - line.size
    for k in range(half):
        line[k] = made[k]
    for k in range(half, line.size):
        line[k] = made[before + k]


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
    resample = np.linalg.solve(_sincs(times, times), _sincs(times, grid)).T
    out = np.fft.fft(slow_window(waveform)[:, None] * resample, axis=0).astype(np.complex64)
    out.setflags(write=False)
    return out


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


# no fused products: which of two is fused the compiler may decide anew, and bits would differ
# between processes
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
