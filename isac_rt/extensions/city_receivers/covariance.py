"""Covariances of channels under noise and the clutter that a mesh predicts, cell by cell.

R of a cell is summed over the scatterers about it, each with its responses in range and Doppler and
its steering vector, and tapered over the directions that are not known exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isac_rt.extensions.city_receivers.power import Taper, cells_of, range_power, slow_power
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels import receive_directions
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.receive_directions import LEAST_WEIGHT, REACH, TABLE_STEPS
from isac_rt.receive.directions import Search, turned
from isac_rt.receive.known import Known
from isac_rt.receive.types import ExpectedClutter


@dataclass(frozen=True)
class Bucketed:
    """Expected scatterers sorted by the cell that they lie in.

    Attributes
    ----------
    start : where those of each cell (row, bin) begin, the strongest first; the rows begin `REACH`
        before the first
    beat, doppler : of each scatterer, off the middle of its cell
    power : over the noise of a cell of one channel, before the responses
    steer : (K, L) complex64
    tables : responses in range and Doppler at offsets of 0, 1/TABLE_STEPS, ... cells
    shape : (L, L) of the taper over directions
    num_bins : P
    """

    start: np.ndarray
    beat: np.ndarray
    doppler: np.ndarray
    power: np.ndarray
    steer: np.ndarray
    tables: tuple[np.ndarray, np.ndarray]
    shape: np.ndarray
    num_bins: int

    @classmethod
    def of(
        cls, clutter: ExpectedClutter, known: Known, search: Search, noise: float, taper: Taper
    ) -> Bucketed:
        """The scatterers that some cell holds; `noise` of a cell of one channel."""
        w, leaks = known.waveform, known.leaks
        beat, doppler = cells_of(clutter, w)
        tables = _tables(w, taper)
        strongest = tables[0].max() * tables[1].max()
        rows = w.num_range_cells + 2 * REACH
        row = np.round(beat).astype(np.int64) + REACH
        received = (row >= 0) & (row < rows) & (clutter.power * strongest > LEAST_WEIGHT * noise)
        clutter = clutter.select(received)
        beat, doppler, row = (of[received] for of in (beat, doppler, row))
        steer = turned(-known.wavenumber * (clutter.arrival @ search.channels.positions.T))
        power = (clutter.power / noise).astype(np.float32)
        if len(leaks) > 1:  # the same scatterers once more for each image
            sent = steer.reshape(-1, known.antennas.num_tx, known.antennas.num_rx)
            steer = np.einsum("kba,sar->ksbr", leaks.astype(np.complex64), sent, optimize=True)
            steer = steer.reshape(-1, len(search.channels))
            at = w.num_chirps / len(leaks) * np.arange(len(leaks))
            doppler = np.add.outer(at, doppler).ravel()
            beat, row, power = (np.tile(of, len(leaks)) for of in (beat, row, power))
        else:
            power *= np.float32(abs(leaks[0, 0, 0]) ** 2)
        column = np.round(doppler).astype(np.int64)
        bucket = row * w.num_chirps + column % w.num_chirps
        # by bucket, then by falling power, whose bits grow as it does
        order = np.argsort((bucket << 32) - power.view(np.int32))
        return cls(
            np.searchsorted(bucket[order], np.arange(rows * w.num_chirps + 1)),
            (beat - row + REACH)[order].astype(np.float32),
            (doppler - column)[order].astype(np.float32),
            power[order],
            steer[order],
            tables,
            search.spread(taper.cosine),
            w.num_chirps,
        )

    def covariances(self, rows: np.ndarray, bins: np.ndarray) -> np.ndarray:
        """(S, L, L) complex64 of noise and clutter in cells, Doppler in FFT order, in units of the
        noise."""
        size = self.steer.shape[1]
        out = np.empty((rows.size, size, size), np.complex64)
        scatterers = self.start, self.beat, self.doppler, self.power, self.steer
        cells = rows + REACH, np.ascontiguousarray(bins), self.num_bins
        fill_covariances(cells, scatterers, self.tables, self.shape, out)
        return out


@lru_cache(maxsize=8)
def _tables(waveform: Waveform, taper: Taper) -> tuple[np.ndarray, np.ndarray]:
    """Responses in range and in Doppler at offsets of 0, 1/TABLE_STEPS, ... cells."""
    offset = np.arange((REACH + 1) * TABLE_STEPS + 2) / TABLE_STEPS
    return (
        range_power(waveform, offset, taper.range_cells).astype(np.float32),
        slow_power(waveform, offset, taper.doppler_bins).astype(np.float32),
    )


@twin_of(receive_directions.covariances)
def fill_covariances(
    cells: tuple[np.ndarray, np.ndarray, int],
    scatterers: tuple[np.ndarray, ...],
    tables: tuple[np.ndarray, np.ndarray],
    shape: np.ndarray,
    out: np.ndarray,
) -> None:
    """Fill 1 + sum_s w_s a_s a_s^H times the taper `shape` for each cell, (S, L, L).

    `cells` are rows, bins and the number of bins; `scatterers` and `tables` as in `Bucketed`.
    """
    start, beat, doppler, power, steer = scatterers
    num_bins = cells[2]
    bucket = np.repeat(np.arange(start.size - 1), np.diff(start))
    for c, (row, column) in enumerate(zip(cells[0], cells[1], strict=True)):
        i = bucket // num_bins - row
        j = (bucket % num_bins - column + num_bins // 2) % num_bins - num_bins // 2
        near = np.flatnonzero((np.abs(i) <= REACH) & (np.abs(j) <= REACH))
        offsets = np.abs(i[near] + beat[near]), np.abs(j[near] + doppler[near])
        r, d = ((o * TABLE_STEPS + 0.5).astype(int) for o in offsets)
        weight = power[near] * tables[0][r] * tables[1][d]
        kept = weight >= LEAST_WEIGHT
        a = steer[near[kept]] * np.sqrt(weight[kept])[:, None]
        out[c] = (a.T @ a.conj()) * shape + np.eye(shape.shape[0])
