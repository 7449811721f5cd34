r"""Range cells of a chirp from its tones, past the IF samples: what `isac_rt.signal.gridded` does
after its transform.

Of a chirp only some range cells are wanted, and only paths in and near them are spread. A band that
much narrower needs fewer samples: N' instead of N over the same time. These are made as ever (grid,
transform, division by the kernel's response), multiplied by the window and transformed back, with
the chirp's grid still in the second-level cache:

.. math::

    Y_k = \frac{N}{N'} \sum_{i} w(x_i)\, s(x_i)\, e^{-j2\pi k x_i/N}, \qquad x_i = \frac{N}{N'} (i -
    N'/2)

x counts samples from the middle of the window, wherever it lies in the chirp. The sum over N
samples differs by tails of the window's transform at N' - (cells between path and cell), `PAD`
cells or more: 1e-5 of a path for Hann's window, at the edges alone. A path less than `PAD` cells
below N is taken for one below 0, as the samples have it; since the x_i are not the samples' times,
it is turned by exp(-j 2 pi n_c), n_c the place of the window's middle in the chirp.

White noise of power sigma^2 in N samples is noise of power sigma^2 N'/N in the N' samples before
the window; the cells' covariance sigma^2 sum_n w_n^2 exp(-j 2 pi (k - k') n/N) is the same, since
the transform of w^2 falls faster still.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.fft

from isac_rt.frame.waveform import hann
from isac_rt.kernels.fourier import ROW, plan, transform
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, aligned, load, splat, store, stream, transpose
from isac_rt.signal.noise import WhiteNoise, add_stream

PAD = 32
"""Cells beyond either end of the band in which paths are kept."""
CHIRPS = 8
"""Chirps written at once: 64 bytes of one cell and element."""


class Band(NamedTuple):
    """The wanted cells of a chirp as arrays for the kernels; `no_band` for samples.

    Attributes
    ----------
    window : (N',) float32, N/N' w(x_i)
    radices, twiddles, order : of the transform of N' rows (`isac_rt.kernels.fourier.plan`)
    turn : (cells, 2) float32, factor of each cell
    power, key : of the noise per sample of the N' [W] (0: none), and the stream's
    table, stage : room for one chirp's N' rows and for `CHIRPS` chirps' cells
    """

    window: np.ndarray
    radices: np.ndarray
    twiddles: np.ndarray
    order: np.ndarray
    turn: np.ndarray
    power: float
    key: np.ndarray
    table: np.ndarray
    stage: np.ndarray


def band_size(num_samples: int, num_cells: int) -> int:
    """N', even: enough for the cells and `PAD` on both sides, or all N."""
    size = num_cells + 2 * PAD
    while size < num_samples and (size % 2 or scipy.fft.next_fast_len(size, real=True) != size):
        size += 1
    return size if size < num_samples else num_samples


def make_band(num_samples: int, num_cells: int, window_length: float, noise: WhiteNoise) -> Band:
    """The first `num_cells` cells under Hann's window of `window_length` samples, phases counted
    from its start; `noise` is that of the N samples."""
    size = band_size(num_samples, num_cells)
    x = (np.arange(size) - size // 2) * (num_samples / size)
    window = hann(x + window_length / 2, window_length) * (num_samples / size)
    angle = -np.pi * np.arange(num_cells) * (window_length / num_samples)
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    room = aligned(size * ROW), aligned(CHIRPS * num_cells * ROW)
    return Band(
        window.astype(np.float32),
        *plan(size),
        turn,
        noise.power * size / num_samples,
        np.asarray(noise.seed_words, np.uint32),
        *room,
    )


def no_band() -> Band:
    """For samples: nothing is made of them."""
    return Band(
        np.zeros(0, np.float32),
        *plan(1),
        np.zeros((0, 2), np.float32),
        0.0,
        np.zeros(2, np.uint32),
        aligned(0),
        aligned(0),
    )


@jit(fast=True, borrows=True)
def to_cells(grid, low, rows, deconvolution, band, first, slot):
    """Window, noise and transform of the chirp in `grid` (rows `rows` after `low`), to place `slot`
    of the stage.

    Real and imaginary parts change places on the way in and out, which turns the inverse transform
    into the forward one. `first` : number of the noise stream's first sample
    """
    window, table, stage, turn = band.window, band.table, band.stage, band.turn
    size, cells, noisy = window.shape[0], turn.shape[0], band.power > 0
    half = size // 2
    if noisy:
        table[:] = np.float32(0)
        add_stream(table, np.float32(band.power), band.key[0], band.key[1], np.uint64(first))
    for i in range(size):
        mode = i - half
        at, to = (
            (low + rows[mode if mode >= 0 else mode + rows.shape[0]]) * ROW,
            (mode if mode >= 0 else mode + size) * ROW,
        )
        share, weight = splat(deconvolution[i] * window[i]), splat(window[i])
        re, im = share * load(grid, at), share * load(grid, at + 16)
        if noisy:
            re, im = re + weight * load(table, to), im + weight * load(table, to + 16)
        store(table, to, im)
        store(table, to + 16, re)
    transform(table, 0, size, band.radices, band.twiddles)
    for k in range(cells):
        at, to = band.order[k] * ROW, (slot * cells + k) * ROW
        im, re, c, s = load(table, at), load(table, at + 16), splat(turn[k, 0]), splat(turn[k, 1])
        store(stage, to, re * c - im * s)
        store(stage, to + 16, re * s + im * c)


@jit(fast=True, borrows=True)
def write_cells(out, at, stride, channels, count, num_chirps, cells, stage, tile):
    """Write `count` staged chirps: cell k of channel r to out[at + r stride + 2 k num_chirps];
    `out` begins at a multiple of 64 bytes."""
    for k in range(cells):
        for g in range(CHIRPS):
            row = (g * cells + k) * ROW
            store(tile, 2 * LANES * g, load(stage, row))
            store(tile, 2 * LANES * g + LANES, load(stage, row + 16))
        transpose(tile, 0)
        for r in range(channels):
            to = at + r * stride + 2 * k * num_chirps
            if count == CHIRPS and to % LANES == 0:
                stream(out, to, load(tile, LANES * r))
            else:
                for i in range(2 * count):
                    out[to + i] = tile[LANES * r + i]
