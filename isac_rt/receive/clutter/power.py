r"""Power and covariance of expected clutter in every range-Doppler cell.

A scatterer of power p at beat f and Doppler bin g answers on channel l of a range-Doppler cell (r,
d) with h_r(r - f) h_d(d - g) exp(-j k v_l.u), v_l the channel's place. Scatterers are independent,
so that

.. math:: R(r,d) = \sum_s p_s |h_r(r-f_s)|^2 |h_d(d-g_s)|^2 a_s a_s^H.

It is summed in three steps: scatterers onto a grid of half cells, the range response across it, the
Doppler response by a circular convolution. Past half the unambiguous range the data gate a path
chirp by chirp: there the Doppler response is that of the chirps that hold the row, which the active
terminal knows. What the terminal does not know exactly (its velocity, the mesh, migration within
the frame) is a `Taper`: boxes over which each response is averaged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.fft

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.jit import jit
from isac_rt.receive.arms import Channels
from isac_rt.receive.estimate import hann_response
from isac_rt.receive.known import Known
from isac_rt.receive.maps import slow_window
from isac_rt.receive.types import ExpectedClutter

REACH = 6
"""Range cells on each side that a scatterer is followed; Hann's sidelobes are 55 dB down there."""
ROWS = 16
"""Range rows at a time, which bounds the memory."""


@dataclass(frozen=True)
class Taper:
    """Full widths of the boxes over which responses are averaged, and how finely the grid divides a
    cell.

    Attributes
    ----------
    range_cells, doppler_bins : at 10 m/s a frame of the paper's settings migrates 0.3 cells, 0.1 m
        of mesh error are 0.4 cells and 0.1 m/s of velocity error 0.4 bins
    cosine : of direction cosines
    fine : grid points per cell and per bin; a scatterer goes to the nearest
    """

    range_cells: float = 0.8
    doppler_bins: float = 0.8
    cosine: float = 0.03
    fine: int = 2


TAPER = Taper()


def one_each(antennas_sent: int) -> Channels:
    """One isotropic channel per transmit antenna: the diagonal of its covariance is the clutter's
    power."""
    return Channels(
        np.arange(antennas_sent), np.zeros(antennas_sent, int), np.zeros((antennas_sent, 3))
    )


def cells_of(clutter: ExpectedClutter, waveform: Waveform) -> tuple[np.ndarray, np.ndarray]:
    """Beat [range cells] and Doppler [bins, receding positive] of each scatterer at mid-frame."""
    w = waveform
    beat = w.beat_cells(clutter.delay, clutter.delay_rate, 0.0)
    return beat, clutter.delay_rate * w.carrier(clutter.delay) * w.frame_duration


def range_power(waveform: Waveform, offset: np.ndarray, width: float) -> np.ndarray:
    """|h_r|^2 averaged over a box of `width` cells."""
    steps = (np.arange(9) - 4) / 9 * width
    return np.mean(hann_response(waveform, np.asarray(offset)[..., None] + steps) ** 2, axis=-1)


def doppler_products(waveform: Waveform, kept: np.ndarray, width: float, fine: int) -> np.ndarray:
    """h_d h_d'* of every pair of transmit antennas for a path at bin 0, averaged over a box of
    `width` bins.

    Parameters
    ----------
    kept : (L_tx, P) bool, slots in which the path passes the filter when the antenna sends

    Returns
    -------
    products : (L_tx, L_tx, P * fine) complex, Doppler in FFT order, `fine` points per bin
    """
    over = 4 * fine
    response = scipy.fft.fft(slow_window(waveform) * kept, waveform.num_chirps * over, axis=1)
    product = response[:, None] * response[None].conj()
    span = max(round(width * over / 2), 0)
    return np.mean([np.roll(product, s, axis=2) for s in range(-span, span + 1)], axis=0)[..., ::4]


def kept_slots(known: Known, row: int) -> np.ndarray:
    """(L_tx, P) bool: whether the data let a path of a range row through the IF filter in the
    slot's chirp of each antenna.

    Its beat with the data must be below N. A slot in which no group uses the antenna counts as not
    kept.
    """
    passes = row + known.delay_symbols < known.waveform.num_samples
    return np.stack([(passes & sent).any(axis=0) for sent in known.sent_by])


def covariances(
    clutter: ExpectedClutter,
    known: Known,
    channels: Channels,
    wanted: np.ndarray,
    taper: Taper = TAPER,
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Covariance of the clutter in chosen cells, row by row.

    Parameters
    ----------
    clutter : ExpectedClutter of an active terminal's own link
    known : of the frame, one group per transmit antenna; its data gate the rows past N/2
    wanted : (rows, P) bool, cells from range row 0 on, Doppler in FFT order

    Yields
    ------
    row, bins, R : of each row with a wanted cell its columns (S,), and (S, L, L) complex64 in units
        of `channel_maps` squared
    """
    w, t = known.waveform, taper
    beat, doppler = cells_of(clutter, w)
    order = np.argsort(beat, kind="stable")
    clutter, beat, doppler = clutter.select(order), beat[order], doppler[order]
    column = np.round(doppler * t.fine).astype(np.int64) % (w.num_chirps * t.fine)
    size = len(channels)
    first, second = np.tril_indices(size)
    shape = _angle_taper(channels, w, t.cosine)[first, second]
    pairs = channels.tx[first], channels.tx[second]

    def kernel(kept: np.ndarray) -> np.ndarray:
        """(P * fine, T) Doppler response that goes with each pair of channels; one column, real,
        where all chirps are kept."""
        products = doppler_products(w, kept, t.doppler_bins, t.fine)
        return (
            products[0, 0, :, None].real.astype(np.float32)
            if kept.all()
            else products[pairs].T.astype(np.complex64)
        )

    whole = kernel(kept_slots(known, 0))
    rows = np.flatnonzero(wanted.any(axis=1))
    for block in np.array_split(rows, max(1, -(-rows.size // ROWS))) if rows.size else []:
        low, high = int(block[0]) - REACH, int(block[-1]) + REACH
        some = slice(*np.searchsorted(beat, [low, high]))
        line = np.round((beat[some] - low) * t.fine).astype(np.int64)
        grid = np.zeros(
            ((high - low) * t.fine + 1, w.num_chirps * t.fine, first.size), np.complex64
        )
        steer = channels.steering(clutter.arrival[some], known).astype(np.complex64)
        _accumulate(grid, line, column[some], clutter.power[some].astype(np.float32), steer)
        offset = block[:, None] - (low + np.arange(len(grid)) / t.fine)
        response = range_power(w, offset, t.range_cells) * (np.abs(offset) <= REACH)
        spread = response.astype(np.float32) @ grid.reshape(len(grid), -1).view(np.float32)
        for row, line_of in zip(
            block.tolist(),
            spread.view(np.complex64).reshape(block.size, *grid.shape[1:]),
            strict=True,
        ):
            turned = whole if row <= w.num_delay_symbols else kernel(kept_slots(known, row))
            bins = np.flatnonzero(wanted[row])
            along = _across(turned, line_of, bins * t.fine) * shape
            out = np.empty((bins.size, size, size), np.complex64)
            out[:, first, second] = along
            out[:, second, first] = along.conj()
            yield row, bins, out


def _across(kernel: np.ndarray, line: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(S, T) circular convolution along Doppler of (G, T) values with (G, T or 1), at the grid
    points `at`."""
    shift = (at[:, None] - np.arange(len(line))) % len(line)
    if kernel.shape[1] == 1:
        return (kernel[shift, 0] @ np.ascontiguousarray(line).view(np.float32)).view(np.complex64)
    return np.einsum("sgt,gt->st", kernel[shift], line)


def _angle_taper(channels: Channels, waveform: Waveform, width: float) -> np.ndarray:
    """(L, L) average of the steering products over a box of direction cosines on both axes."""
    k = waveform.effective_carrier / SPEED_OF_LIGHT
    apart = channels.places[:, None] - channels.places[None]
    return np.sinc(k * apart[..., 0] * width) * np.sinc(k * apart[..., 2] * width)


def expected_power(
    clutter: ExpectedClutter, known: Known, num_rows: int, taper: Taper = TAPER
) -> np.ndarray:
    """(num_rows, P) mean clutter power over the channels, Doppler centred as in `accumulate`."""
    w = known.waveform
    out = np.zeros((num_rows, w.num_chirps), np.float32)
    channels, wanted = one_each(w.num_tx), np.ones(out.shape, bool)
    for row, _, one in covariances(clutter, known, channels, wanted, taper):
        out[row] = np.fft.fftshift(np.maximum(np.einsum("pii->p", one).real, 0)) / len(channels)
    return out


@jit
def _accumulate(grid, line, column, power, steer):
    """grid[line, column] += power * (lower triangle of a a^H, row by row)."""
    size = steer.shape[1]
    for s in range(line.size):
        cell = grid[line[s], column[s]]
        t = 0
        for i in range(size):
            a = power[s] * steer[s, i]
            for j in range(i + 1):
                cell[t] += a * steer[s, j].conjugate()
                t += 1
