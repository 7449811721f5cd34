r"""Power of expected clutter in every range-Doppler cell.

A scatterer of power p at beat f and Doppler bin g answers in a range-Doppler cell (r, d) with

.. math:: p\, |h_r(r-f)|^2 |h_d(d-g)|^2,

scatterers being independent. Their powers are summed on a grid of parts of cells, the range
response is convolved across it and the Doppler response along it. Only rows up to half of the
unambiguous range are made, which hold every chirp whatever the data. What the terminal does not
know exactly (its velocity, the mesh, migration within the frame) is a `Taper`: boxes over which
each response is averaged.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from scipy import sparse

from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.receive_directions import REACH
from isac_rt.receive.estimate import hann_response
from isac_rt.receive.known import Known
from isac_rt.receive.maps import slow_window
from isac_rt.receive.types import ExpectedClutter

FINE_BEAT, FINE_DOPPLER = 2, 3
"""Grid points per range cell, to the nearest of which a scatterer goes, and per Doppler bin,
between two of which its power is shared."""


@dataclass(frozen=True)
class Taper:
    """Full widths of the boxes over which responses are averaged.

    Attributes
    ----------
    range_cells, doppler_bins : at 10 m/s a frame of the paper's settings migrates 0.3 cells, 0.1 m
        of mesh error are 0.4 cells and 0.1 m/s of velocity error 0.4 bins
    cosine : of direction cosines
    """

    range_cells: float = 0.8
    doppler_bins: float = 0.8
    cosine: float = 0.03


TAPER = Taper()


def cells_of(clutter: ExpectedClutter, waveform: Waveform) -> tuple[np.ndarray, np.ndarray]:
    """Beat [range cells] and Doppler [bins, receding positive] of each scatterer at mid-frame."""
    w = waveform
    beat = w.beat_cells(clutter.delay, clutter.delay_rate, 0.0)
    return beat, clutter.delay_rate * w.carrier(clutter.delay) * w.frame_duration


def range_power(waveform: Waveform, offset: np.ndarray, width: float) -> np.ndarray:
    """|h_r|^2 averaged over a box of `width` cells."""
    steps = (np.arange(9) - 4) / 9 * width
    return np.mean(hann_response(waveform, np.asarray(offset)[..., None] + steps) ** 2, axis=-1)


def slow_power(waveform: Waveform, offset: np.ndarray, width: float) -> np.ndarray:
    """|h_d|^2 of all slots averaged over a box of `width` bins."""
    steps = (np.arange(9) - 4) / 9 * width
    slots = np.arange(waveform.num_chirps) / waveform.num_chirps
    at = (np.asarray(offset)[..., None] + steps)[..., None]
    response = (slow_window(waveform) * np.exp(2j * np.pi * at * slots)).sum(axis=-1)
    return np.mean(response.real**2 + response.imag**2, axis=-1)


@lru_cache(maxsize=16)
def _kernels(waveform: Waveform, taper: Taper, rows: int) -> tuple[sparse.csr_array, np.ndarray]:
    """Range response as a matrix (rows, lines of the grid), and the transform of the Doppler
    response."""
    across = np.arange(-REACH * FINE_BEAT, REACH * FINE_BEAT + 1) / FINE_BEAT
    along = np.arange(waveform.num_chirps * FINE_DOPPLER) / FINE_DOPPLER
    weights = range_power(waveform, across, taper.range_cells) / FINE_DOPPLER
    first = FINE_BEAT * np.arange(rows)[:, None]
    lines = (first + np.arange(weights.size)).ravel()
    ends, size = np.arange(rows + 1) * weights.size, (rows + 2 * REACH) * FINE_BEAT
    weigh = sparse.csr_array((np.tile(weights, rows), lines, ends), shape=(rows, size))
    return weigh, scipy.fft.rfft(slow_power(waveform, along, taper.doppler_bins))


@dataclass(frozen=True)
class Response:
    """Mean power of scatterers in range rows from 0, and its slopes against their Doppler.

    Attributes
    ----------
    waveform : Waveform
    rows : at most N/2, which hold every chirp
    taper : Taper
    leaks : of `Known`; what a channel shows of several antennas is added by power
    """

    waveform: Waveform
    rows: int
    taper: Taper
    leaks: np.ndarray

    def of(
        self, beat: np.ndarray, doppler: np.ndarray, power: np.ndarray, slope: np.ndarray
    ) -> np.ndarray:
        """(1 + A, rows, P) power, and its derivatives where the bins of all scatterers move by
        `slope` (K, A), Doppler centred."""
        weigh, along = _kernels(self.waveform, self.taper, self.rows)
        size, half = self.waveform.num_chirps, self.waveform.num_chirps // 2 + 1
        ramp = 2j * np.pi * np.arange(along.size) / size
        inside, grid_points, shares = self._grid_points(beat, doppler)
        grid_shape = weigh.shape[1], size * FINE_DOPPLER
        out = np.empty((1 + slope.shape[1], self.rows, size))
        for number, made in enumerate(out):
            weight = (power if number == 0 else power * slope[:, number - 1])[inside]
            weights = np.concatenate([weight * share for share in shares])
            grid = np.bincount(grid_points, weights, grid_shape[0] * grid_shape[1])
            spectra = scipy.fft.rfft(weigh @ grid.reshape(grid_shape))
            spectra *= along if number == 0 else -along * ramp
            # every third place alone is wanted: the three parts of the spectrum fall together
            folded = spectra[:, :half] + spectra[:, size : size + half]
            folded += spectra[:, size : size - half : -1].conj()
            made[:] = scipy.fft.irfft(folded, size)
        shares = (np.abs(self.leaks) ** 2).sum(axis=(1, 2)) / self.leaks.shape[1]
        shown = np.fft.fftshift(out, axes=2)
        if shares.size == 1:
            return shares[0] * shown
        steps = size // shares.size * np.arange(shares.size)
        return sum(q * np.roll(shown, step, axis=2) for q, step in zip(shares, steps, strict=True))

    def _grid_points(
        self, beat: np.ndarray, doppler: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Place scatterers on the fine grid: which lie on it, the two places of each, on the
        nearest line and on both sides of its Doppler, and the shares that these take."""
        size, lines = self.waveform.num_chirps * FINE_DOPPLER, (self.rows + 2 * REACH) * FINE_BEAT
        line = np.rint((beat + REACH) * FINE_BEAT).astype(np.int64)
        inside = (line >= 0) & (line < lines)
        at = doppler[inside] * FINE_DOPPLER
        left = np.floor(at).astype(np.int64)
        first, share = line[inside] * size, at - left
        grid_points = np.concatenate([first + left % size, first + (left + 1) % size])
        return inside, grid_points, (1 - share, share)


def expected_power(
    clutter: ExpectedClutter, known: Known, num_rows: int, taper: Taper = TAPER
) -> np.ndarray:
    """(num_rows, P) mean clutter power of a channel, Doppler centred as in `accumulate`."""
    beat, doppler = cells_of(clutter, known.waveform)
    response = Response(known.waveform, num_rows, taper, known.leaks)
    power = response.of(beat, doppler, clutter.power, np.zeros((len(clutter), 0)))[0]
    return np.maximum(power, 0).astype(np.float32)
