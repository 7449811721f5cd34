"""The adaptive matched filter with the covariance that the mesh and the own velocity predict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from isac_rt.receive.cfar import CfarRule, strong_lobes
from isac_rt.receive.clutter.adaptive import scanned, threshold_of
from isac_rt.receive.clutter.coherent import (
    Bucketed,
    Found,
    Search,
    search_plain,
    search_white,
    searches,
)
from isac_rt.receive.clutter.detectors import ClutterDetector, Judged
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate
from isac_rt.receive.types import ExpectedClutter

LEAST = 0.03
"""Cells whose expected clutter is less than this share of the noise are taken to hold noise
alone."""
PRUNED = 0.9
"""Share of the lower threshold below which a cell is not looked at further: the grid of directions
misses a tenth of a peak at most."""


class AngleDoppler(ClutterDetector):
    """All channels of every cell coherently, whitened where clutter is expected."""

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
        cluttered = np.fft.ifftshift(expected, axes=1).ravel()[plain.cell] > LEAST * noise
        cell = plain.cell[cluttered & (plain.peak > PRUNED * limits[1][0])]
        R = Bucketed.of(clutter, known, arms, noise, self.taper).covariances(
            *np.divmod(cell, power.shape[1])
        )
        x = maps[arms.channels.tx, arms.channels.rx].reshape(len(arms.channels), -1)[:, cell]
        x = np.ascontiguousarray(x.T) / np.float32(np.sqrt(noise))
        note(search_white(x, R, cell, arms, PRUNED * limits[1][0]), limits[1])
        rows, bins = power.shape
        shown = [
            np.fft.fftshift(a.reshape(rows, bins, *a.shape[1:]), axes=1)
            for a in (ratio, sure, cosines)
        ]
        held_up = self._unexplained(power / (noise + expected), shown[0])
        return Judged(shown[0] / held_up, shown[1] / held_up, noise + expected, shown[2])

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
