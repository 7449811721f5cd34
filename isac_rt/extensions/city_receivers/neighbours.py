r"""Phases of neighbouring channels from the clutter that the mesh predicts.

Noise is independent from channel to channel, clutter is not: in a range-Doppler cell c two channels
i and j that stand :math:`\Delta` apart have

.. math:: E\{y_i^* y_j\} = e^{j(\phi_j - \phi_i)} \Gamma_c, \qquad
    \Gamma_c = \sum_k p_k e^{-j 2\pi f \Delta\cdot u_k / c}

with the scatterers k that the mesh has there. The sum over all cells of
:math:`y_i^* y_j \Gamma_c^*` therefore has the phase by which the two channels differ. However wide
the directions of a cell are spread, and however weak it is, it counts as much as it tells.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage

from isac_rt.extensions.city_receivers.power import cells_of
from isac_rt.frame.antennas import SAME_POSITION_M, Antennas
from isac_rt.receive.known import Known
from isac_rt.receive.types import ExpectedClutter, Neighbours

LOBE = np.array([0.25, 1.0, 0.25])
"""Power of a scatterer in its own cell and those beside, under Hann's window."""
OUTLIER = 8.0
"""A cell with this many times its mean holds something else than clutter."""
BLOCKS = 64
"""Parts of the range axis, by whose scatter the deviation of the sum is told."""
LEAST_BLOCKS = 5
"""So many of them must hold clutter: of fewer, the scatter may be small by chance."""


@lru_cache(maxsize=16)
def neighbours_of(antennas: Antennas) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Virtual channels next to each other along X and along Z: first, second and axis (Q,)."""
    positions = np.round(antennas.virtual_positions[:, [0, 2]] / SAME_POSITION_M).astype(int)
    offset = positions[None] - positions[:, None]
    out = []
    for axis in (0, 1):
        along = np.where(offset[..., 1 - axis] == 0, offset[..., axis], 0)
        if not along.any():
            continue
        nearest = along[along > 0].min()
        first, second = np.nonzero(np.abs(along - nearest) <= 1)
        out.append(np.stack([first, second, np.full(first.size, axis)]))
    first, second, axis = np.concatenate(out, axis=1) if out else np.zeros((3, 0), int)
    return first, second, axis


def coherence(
    clutter: ExpectedClutter, known: Known, axis: int, spacing: float, shape: tuple[int, int]
) -> np.ndarray:
    """Gamma (rows, P), FFT order, of channels `spacing` [m] along X (0) or Z (1), but for a
    factor."""
    beat, doppler = cells_of(clutter, known.waveform)
    row = np.round(beat).astype(int)
    inside = (row >= 0) & (row < shape[0])
    at = (row * shape[1] + np.round(doppler).astype(int) % shape[1])[inside]
    wave = np.exp(-1j * known.wavenumber * spacing * clutter.arrival[inside, 2 * axis])
    weight = clutter.power[inside] * wave
    grid = np.bincount(at, weight.real, shape[0] * shape[1]) + 1j * np.bincount(
        at, weight.imag, shape[0] * shape[1]
    )
    grid = ndimage.convolve1d(grid.reshape(shape), LOBE, axis=0, mode="constant")
    return np.asarray(ndimage.convolve1d(grid, LOBE, axis=1, mode="wrap"))


def phases(
    maps: np.ndarray, expected: np.ndarray, noise: float, known: Known, clutter: ExpectedClutter
) -> Neighbours:
    """By how much channels differ from their neighbours.

    Parameters
    ----------
    maps : (L_tx, L_rx, rows, P) of `channel_maps`
    expected : (rows, P) clutter power of a channel, Doppler centred
    noise : of a cell

    Returns
    -------
    neighbours : of infinite deviation where too few cells hold clutter to tell
    """
    shape = maps.shape[2:]
    channels = maps.reshape(-1, *shape)
    mean = np.fft.ifftshift(expected, axes=1) + noise
    power = (np.abs(channels) ** 2).mean(axis=0)
    usable = (mean > 1.05 * noise) & (power < OUTLIER * mean)
    first, second, axis = neighbours_of(known.antennas)
    positions = known.antennas.virtual_positions[:, [0, 2]]
    sums = np.zeros((BLOCKS, first.size), complex)
    rows, columns = np.nonzero(usable)
    block = rows * BLOCKS // shape[0]
    received = channels[:, rows, columns]
    for one in np.unique(axis):
        pairs = np.flatnonzero(axis == one)
        spacing = float(positions[second[pairs[0]], one] - positions[first[pairs[0]], one])
        gamma = coherence(clutter, known, int(one), spacing, shape)[rows, columns]
        weight = gamma.conj() / mean[rows, columns] ** 2
        for q in pairs:
            product = received[first[q]].conj() * received[second[q]] * weight
            sums[:, q] = np.bincount(block, product.real, BLOCKS) + 1j * np.bincount(
                block, product.imag, BLOCKS
            )
    total = sums.sum(axis=0)
    turned = sums * np.exp(-1j * np.angle(total))
    # sums of blocks scatter about 0 across the mean phase: that is the total's own deviation, but
    # for the degree of freedom that the mean takes
    blocks = (sums != 0).sum(axis=0)
    spread = np.sqrt((turned.imag**2).sum(axis=0) * blocks / np.maximum(blocks - 1, 1))
    std = spread / np.maximum(np.abs(total), 1e-300)
    return Neighbours(first, second, np.angle(total), np.where(blocks < LEAST_BLOCKS, np.inf, std))
