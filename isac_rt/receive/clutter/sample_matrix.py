"""The adaptive matched filter with the covariance of the cells around."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import betaincinv

from isac_rt.receive.arms import Channels
from isac_rt.receive.clutter.adaptive import Beams, Matched, Scan, white_scan
from isac_rt.receive.clutter.detectors import ClutterDetector, Judged, noise_level
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate
from isac_rt.receive.types import ExpectedClutter

BLOCK = 16
SIDE_BINS = 1
"""Doppler bins on each side of a cell whose snapshots train its sample matrix."""
LOADING = 0.1
"""Of the sample matrix, relative to the noise."""
TRAINED = 0.5
"""Independent snapshots per training cell: neighbours of Hann-windowed axes are correlated."""


class SampleMatrix(ClutterDetector):
    """The filter of every cell against the sample matrix of its surroundings."""

    def judge(
        self, frames: Sequence[np.ndarray], known: Known, clutter: ExpectedClutter | None = None
    ) -> list[Judged]:
        out, guard, scans = [], self.settings.guard_cells[0], self.scans(known)
        for maps in frames:
            power = accumulate(maps)
            noise = noise_level(power, None, known.channels)
            found = [(sampled(maps, c, b, noise, guard), b) for c, b in scans]
            out.append(self.directed(found, np.full_like(power, noise)))
        return out


def sampled(maps: np.ndarray, channels: Channels, beams: Beams, noise: float, guard: int) -> Scan:
    """Scan with the sample matrix of the cells around: 2 L range rows outside the guard, half on
    each side, and a bin on each side.

    T is transformed to what an exponential variable would have to exceed as rarely: with N training
    snapshots the tail of T is E[(1 + rho T/N)^-(N-L+1)], rho ~ Beta(N-L+2, L-1) [1]_. The range
    neighbours are windowed, which `TRAINED` counts.
    """
    x = np.ascontiguousarray(np.moveaxis(maps[channels.tx, channels.rx], 0, -1))
    rows, columns, size = x.shape
    first, second = np.tril_indices(size)
    scan = white_scan(x, beams, noise)
    each = size
    for low in range(0, rows, BLOCK):
        block = np.arange(low, min(low + BLOCK, rows))
        begin, end = max(low - guard - each, 0), min(int(block[-1]) + guard + each + 1, rows)
        pairs = x[begin:end][..., first] * x[begin:end][..., second].conj()
        pairs = sum(np.roll(pairs, s, axis=1) for s in range(-SIDE_BINS, SIDE_BINS + 1))
        total = np.concatenate(
            [np.zeros_like(pairs[:1]), np.cumsum(pairs, axis=0, dtype=np.complex128)]
        )
        for row in block.tolist():
            spans = [
                (max(row - guard - each, 0), max(row - guard, 0)),
                (row + guard + 1, min(row + guard + 1 + each, rows)),
            ]
            spans = [(a - begin, b - begin) for a, b in spans if b > a]
            count = sum(b - a for a, b in spans) * (2 * SIDE_BINS + 1)
            mean = sum(total[b] - total[a] for a, b in spans) / (count * noise)
            R = np.zeros((columns, size, size), np.complex64)
            R[:, first, second] = mean
            R[:, second, first] = mean.conj()
            R += np.float32(LOADING) * np.eye(size, dtype=np.complex64)
            Matched.of(R, beams).fill(
                scan, row, np.arange(columns), x[row] / np.float32(np.sqrt(noise))
            )
    grid = np.geomspace(1e-3, 1e6, 600)
    equal = like_exponential(grid, 2 * each * (2 * SIDE_BINS + 1) * TRAINED, size)
    return Scan(np.interp(scan.peak, grid, equal).astype(np.float32), scan.beam, scan.energy)


def like_exponential(t: np.ndarray, snapshots: float, size: int) -> np.ndarray:
    """-ln P[T > t] of one beam's matched filter whose covariance comes from so many snapshots of
    `size` channels."""
    a, b = max(snapshots - size + 2, 1), max(size - 1, 1)
    rho = betaincinv(a, b, (np.arange(200) + 0.5) / 200)
    return -np.log(
        np.mean((1 + rho[:, None] * np.asarray(t) / snapshots) ** -(snapshots - size + 1), axis=0)
    )
