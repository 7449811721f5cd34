"""The adaptive matched filter with the covariance that the mesh and the own velocity predict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from isac_rt.kernels.hermitian import inverses
from isac_rt.receive.arms import all_channels, both_arms
from isac_rt.receive.cfar import CfarRule, strong_lobes
from isac_rt.receive.clutter.adaptive import scanned, threshold_of
from isac_rt.receive.clutter.coherent import (
    PRUNED,
    Bucketed,
    Found,
    Search,
    search_plain,
    search_white,
    searches,
)
from isac_rt.receive.clutter.detectors import ClutterDetector, Judged
from isac_rt.receive.clutter.gates import Gate, gates_of, seek
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate
from isac_rt.receive.types import ExpectedClutter, Gates

LEAST = 0.03
"""Cells whose expected clutter is less than this share of the noise are taken to hold noise
alone."""


@dataclass(frozen=True)
class AngleDoppler(ClutterDetector):
    """All channels of every cell coherently, whitened where clutter is expected.

    Attributes
    ----------
    sought : where UAVs are expected, with a threshold of their own
        (`isac_rt.receive.clutter.gates`); None: nowhere
    """

    sought: Gates | None = None

    def judge(
        self, frames: Sequence[np.ndarray], known: Known, clutter: ExpectedClutter | None = None
    ) -> list[Judged]:
        powers = [accumulate(maps) for maps in frames]
        clutter, expected, noise = self.expectation(powers, known, clutter)
        return [
            self._judge(maps, power, n, expected, known, clutter)
            for maps, power, n in zip(frames, powers, noise, strict=True)
        ]

    def _judge(
        self,
        maps: np.ndarray,
        power: np.ndarray,
        noise: float,
        expected: np.ndarray,
        known: Known,
        clutter: ExpectedClutter,
    ) -> Judged:
        everything, arms = searches(known.antennas, known.wavenumber)
        limits = self._limits(everything, known), self._limits(arms, known)
        plain = search_plain(maps, everything, noise, PRUNED * limits[0][0])
        ratio, sure = np.zeros((2, power.size), np.float32)
        cosines = np.full((power.size, 2), np.nan)

        def note(found: Found, limit: tuple[float, float]) -> None:
            ratio[found.cell], sure[found.cell] = found.peak / limit[0], found.peak / limit[1]
            cosines[found.cell] = found.cosines

        note(plain, limits[0])
        filled = np.fft.ifftshift(expected, axes=1).ravel() > LEAST * noise
        cell = plain.cell[filled[plain.cell] & (plain.peak > PRUNED * limits[1][0])]
        bucketed = Bucketed.of(clutter, known, everything, noise, self.taper)

        def heard(cell: np.ndarray, search: Search) -> np.ndarray:
            c = search.channels
            x = maps.reshape(*maps.shape[:2], -1)[c.tx[:, None], c.rx[:, None], cell]
            return np.ascontiguousarray(x.T) / np.float32(np.sqrt(noise))

        R = bucketed.among(arms_of(known)).covariances(*np.divmod(cell, power.shape[1]))
        found = search_white(heard(cell, arms), R, cell, arms, PRUNED * limits[1][0])
        note(found, limits[1])
        # the few that remain with all channels: fewer directions look alike
        cell = cell[found.peak > PRUNED * limits[1][0]]
        R = bucketed.covariances(*np.divmod(cell, power.shape[1]))
        note(search_white(heard(cell, everything), R, cell, everything, 0.0), limits[0])
        inverse = dict(zip(cell.tolist(), inverses(R), strict=True))
        for gate in self._gates(known, len(power), ratio, cosines):
            quiet = not filled[gate.cell].any()
            whiten = None if quiet else bucketed.covariances(*np.divmod(gate.cell, power.shape[1]))
            found = seek(gate, heard(gate.cell, everything), whiten, everything)
            limit = gate.threshold(everything, self.settings.gate_rate)
            if found.peak[0] > limit:
                ratio[found.cell], cosines[found.cell] = found.peak / limit, found.cosines
        rows, bins = power.shape
        shown = [
            np.fft.fftshift(a.reshape(rows, bins, *a.shape[1:]), axes=1)
            for a in (ratio, sure, cosines)
        ]
        held_up = self._unexplained(power / (noise + expected), shown[0])
        half = bins // 2
        whiteners = {(c // bins, (c % bins + half) % bins): one for c, one in inverse.items()}
        passed = shown[0] / held_up, shown[1] / held_up
        return Judged(*passed, noise + expected, shown[2], whiteners)

    def _gates(
        self, known: Known, rows: int, ratio: np.ndarray, cosines: np.ndarray
    ) -> Iterator[Gate]:
        """Where UAVs are sought in which nothing was found yet, but for cells that hold something
        from elsewhere: what it leaves in other directions is no noise."""
        for gate in () if self.sought is None else gates_of(self.sought, known, rows):
            full = ratio[gate.cell] > 1
            if not full.all() and not (gate.holds(cosines[gate.cell]) & full).any():
                yield replace(gate, cell=gate.cell[~full])

    def _limits(self, search: Search, known: Known) -> tuple[float, float]:
        """Thresholds of a detection and of one that may start a track."""
        size = scanned(search.channels, known.wavenumber, known.antennas.view_limit)
        usual, sure = self.settings.false_alarm_rates
        return threshold_of((size,), usual), threshold_of((size,), sure)

    def _unexplained(self, found: np.ndarray, ratio: np.ndarray) -> np.ndarray:
        """How many times the power around a cell is what was expected, once at least: the greater
        of both sides in range, so that what the mesh does not know raises the threshold."""
        target = ndimage.binary_dilation(ratio > 1, np.ones((3, 3), bool))
        rule = CfarRule.of(self.settings, 1)
        return np.maximum(rule.background(found, ~(target | strong_lobes(found))), 1.0)


def arms_of(known: Known) -> np.ndarray:
    """Numbers of the channels of both arms among all."""
    c, every = both_arms(known.antennas), all_channels(known.antennas)
    pairs = zip(every.tx.tolist(), every.rx.tolist(), strict=True)
    number = {pair: i for i, pair in enumerate(pairs)}
    return np.array([number[pair] for pair in zip(c.tx.tolist(), c.rx.tolist(), strict=True)])
