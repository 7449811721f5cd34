r"""Track before detect: a lower threshold where a UAV is expected.

The few cells and directions in which a tracked UAV, or one that says where it is, can lie give
noise few chances. With E(t) the mean Euler characteristic of {T > t} over the gate's directions
(`isac_rt.extensions.city_receivers.adaptive`) noise exceeds t somewhere in a gate of n cells with a
probability of n E(t) at most: its cells are correlated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from isac_rt.extensions.city_receivers.adaptive import field_threshold, scanned_within
from isac_rt.receive.directions import Found, Search, inverses, statistic_of
from isac_rt.receive.known import Known
from isac_rt.receive.types import Gates

DEVIATIONS = 3.0
"""Half width of a gate in deviations of where the UAV is expected, beside half a cell or half a
step of directions for what lies between their grid points."""
MOST_CELLS = 300
"""A gate of more cells is none: little is known of where the UAV is."""
STEP = 0.02
"""Of the directions [cosine]: a fifth of the arms' lobe, where a peak loses 2 %."""


@dataclass(frozen=True)
class Gate:
    """Where one UAV may lie in a frame's maps.

    Attributes
    ----------
    cell : (S,) flat numbers of the cells, Doppler in FFT order
    cosines : (D, 2) directions
    middle, half : (2,) of the directions, and their half widths
    """

    cell: np.ndarray
    cosines: np.ndarray
    middle: np.ndarray
    half: np.ndarray

    def holds(self, cosines: np.ndarray) -> np.ndarray:
        """(S,) which directions (S, 2), that the gate's cells show, lie in it."""
        return (np.abs(cosines - self.middle) <= self.half).all(axis=-1)

    def threshold(self, search: Search, rate: float) -> float:
        """Return the level that noise exceeds somewhere in the gate with probability `rate` at
        most."""
        size = scanned_within(search.channels, search.wavenumber, 2 * self.half)
        return field_threshold(*size, 1, rate / self.cell.size)


def gates_of(expected: Gates, known: Known, rows: int) -> Iterator[Gate]:
    """The gates in maps of so many rows, but those wider than `MOST_CELLS` or out of view."""
    w = known.waveform
    for at, std in zip(expected.mean, expected.std, strict=True):
        delay, rate = at[:2] / known.metres
        beat = float(w.beat_cells(delay, rate, 0.0))
        doppler = rate * float(w.carrier(delay)) * w.frame_duration
        reach = DEVIATIONS * std[:2] / [known.range_cell, w.velocity_cell(known.passes)] + 0.5
        row = np.arange(np.ceil(beat - reach[0]), np.floor(beat + reach[0]) + 1)
        row = row[(row >= 0) & (row < rows)].astype(np.int64)
        column = np.arange(np.ceil(doppler - reach[1]), np.floor(doppler + reach[1]) + 1)
        inside = (np.abs(at[2:]) < known.antennas.view_limit).all()
        if not inside or not 0 < row.size * column.size <= MOST_CELLS:
            continue
        cell = row[:, None] * w.num_chirps + column.astype(np.int64) % w.num_chirps
        half = DEVIATIONS * std[2:] + STEP / 2
        steps = [np.linspace(-h, h, 1 + 2 * int(np.ceil(h / STEP))) for h in half]
        lines = [u + step for u, step in zip(at[2:], steps, strict=True)]
        u = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
        yield Gate(cell.ravel(), u[(u**2).sum(axis=1) <= 1], at[2:], half)


def seek(
    gate: Gate,
    x: np.ndarray,
    covariances: np.ndarray | None,
    search: Search,
) -> Found:
    """Return the largest T in a gate.

    Parameters
    ----------
    x : (S, 1, L) channels of the gate's cells in units of the noise's amplitude
    covariances : (S, L, L) of noise and clutter in units of the noise; None: noise alone
    """
    if covariances is None:
        statistic = statistic_of(x, scale=1 / len(search.channels))
    else:
        inverse = inverses(covariances)
        statistic = statistic_of(np.matmul(x, inverse.transpose(0, 2, 1)), inverse)
    values = statistic(search.steering(gate.cosines)[None])
    s, d = np.unravel_index(values.argmax(), values.shape)
    return Found(gate.cell[[s]], values[[s], d], gate.cosines[[d]])
