r"""A passive terminal's search for weak echoes: strong paths out, then every direction of every
cell, whitened where clutter is, and again in what the waves found there leave.

What each transmit antenna sends comes from a direction that the receiver does not know, so that
the channels of a cell are matched receiver by receiver and added in power over the L_tx transmit
antennas,

.. math:: T(u) = \sum_t |a^H R^{-1} x_t|^2 / (a^H R^{-1} a),

R the covariance of the receivers under noise and clutter, the same for all transmit antennas, in
units of the noise. Without a target 2 T is a chi-squared field of 2 L_tx degrees of freedom. Where
clutter remains the transmit antennas receive the same of it: with c its share of the beam's power,
c = 1 - a^H R^-2 a / a^H R^-1 a, one of the L_tx terms grows to 1 + (L_tx - 1) c, and the threshold
with it.

The search is separable as at the active terminal (`isac_rt.receive.directions`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isac_rt.extensions.city_receivers.adaptive import DirectionTest, unexplained
from isac_rt.extensions.city_receivers.echoes import Wave, Waves
from isac_rt.receive.cfar import first_row, strongest_peaks
from isac_rt.receive.directions import search_plain
from isac_rt.receive.estimate import (
    Estimate,
    LocalSpectra,
    direction_cosines,
    near_beam,
    standard_deviations,
)
from isac_rt.receive.known import Known
from isac_rt.receive.maps import UNION_FLOOR, maps_with_power
from isac_rt.receive.pursuit import BySchedule, extract_strong
from isac_rt.receive.sense import Sensed, describe, window_gain
from isac_rt.receive.types import NO_HINTS, Detections, Hints

ROUNDS = 4
"""Most searches, each of what the waves found before leave."""
FARTHEST = 1.5
"""Cells or bins that a wave may move away from where it was found."""
STD_CELLS = 0.1
"""Smallest deviation of range and velocity, in cells, of what shares its cell with others."""


@dataclass(frozen=True)
class BeamSearch(BySchedule):
    """The CFAR for paths that stand out, beams for those that do not, all of them waves."""

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        if not known.full:
            return super().sense(spectra, known, hints)
        strong = extract_strong(spectra, known, self.settings)
        _, level = self.rule(known).detect(strong.whole)
        test = DirectionTest.of(self.settings, known, strong.power, hints.clutter)
        found = Waves(spectra.copy(), known, test.noise / window_gain(known), test.search.beam)
        each = zip(strong.paths, strong.snr.tolist(), strict=True)
        found.take_out([self._strong(found, *path, test) for path in each])
        found.changed_rows()
        weak = self._weak(found, test)
        estimates = [*strong.paths, *(found.estimate(f.wave) for f in weak)]
        joined = [describe(strong.paths, strong.snr, known), self._described(weak, test)]
        return Sensed(estimates, Detections.joined(joined), strong.whole, level)

    def _strong(self, found: Waves, estimate: Estimate, power: float, test: DirectionTest) -> Wave:
        """Return the wave of a path that stands out by such a power over the noise."""
        cosines = np.array(direction_cosines(estimate, test.known))
        cosines[test.search.beam == 0] = 0.0
        if np.isnan(cosines).any():  # several waves, which look like one from nowhere
            channels = estimate.channels.astype(np.complex64)[:, :, None]
            cosines = search_plain(channels, test.search, 1.0, 0.0).cosines[0]
        return found.wave(estimate, cosines, power, strong=True)

    def _weak(self, found: Waves, test: DirectionTest) -> list[_Found]:
        """Return the waves that are found in what those before leave, and take them out."""
        left, known, strong = found.left, test.known, len(found.waves)
        most = self.settings.max_detections - strong
        ratio, cosines = np.zeros(left.shape[2:], np.float32), np.full((*left.shape[2:], 2), np.nan)
        refused, rows = np.zeros(ratio.shape, bool), np.arange(len(ratio))
        power, weak = np.zeros(ratio.shape, np.float32), list[_Found]()
        raised: float | np.ndarray = 1.0  # what is taken out goes on raising the threshold
        for _ in range(ROUNDS):
            maps, power[rows] = maps_with_power(left[:, :, rows], known)
            ratio[rows], cosines[rows] = test.ratio(maps, rows)
            around = power / (test.noise + test.expected)
            raised = np.maximum(raised, unexplained(around, ratio > 1, self.settings))
            over = ratio / raised
            over[refused] = 0
            over[: first_row(self.settings, known.range_cell)] = 0
            peaks = np.transpose(strongest_peaks(over, over > 1, self.settings, UNION_FLOOR))
            new = []
            for row, column in peaks[: most - len(weak)].tolist():
                towards = test.search.steering(cosines[row, column]).conj()
                beam = np.tile(towards.astype(complex), (test.looks, 1))
                e = self.estimator.at(LocalSpectra(left, known, row, beam=beam), over, row, column)
                towards = near_beam(e, known, cosines[row, column])
                towards = np.where(np.isfinite(towards), towards, cosines[row, column])
                wave = found.wave(e, towards, power[row, column] / test.noise, strong=False)
                refused[row, column] = found.holds(wave)
                if not refused[row, column]:
                    new.append(_Found(wave, over[row, column], (row, column), found.place(wave)))
            if not new:
                break
            found.take_out([f.wave for f in new])
            for f in reversed(new):
                astray = found.apart(found.place(f.wave), f.place).max() > FARTHEST
                if astray or found.holds(f.wave):
                    found.put_back(f.wave)
                    refused[f.cell] = True
            weak += [f for f in new if not refused[f.cell]]
            rows = found.changed_rows()
        return weak

    def _described(self, weak: list[_Found], test: DirectionTest) -> Detections:
        """Return waves as detections, with deviations by what their beams hold."""
        known, w = test.known, test.known.waveform
        statistic = np.array([f.ratio for f in weak]) * test.limits[0]
        snr = np.maximum(statistic - known.antennas.num_tx, 1.0) / known.channels
        std = standard_deviations(snr, 0.0, known)
        std *= np.array([f.wave.spread for f in weak]).reshape(-1, 4)
        floor = STD_CELLS * np.array([w.range_cell(1), w.velocity_cell(1), 0.0, 0.0])
        u = np.array([f.wave.cosines for f in weak]).reshape(-1, 2)
        seen = known.antennas.observes(1) & (np.abs(u) <= known.antennas.view_limit)
        return Detections(
            range=np.array([f.wave.delay for f in weak]) * known.metres,
            velocity=np.array([f.wave.rate for f in weak]) * known.metres,
            direction=np.where(seen, u, np.nan),
            snr=1 + snr,
            std=np.hypot(std, floor),
            is_reference=np.zeros(len(weak), bool),
            starts=statistic > test.limits[1],
        )


class _Found(NamedTuple):
    """A wave, T over its threshold, the cell of the peak and the `Waves.place` of its first
    estimate."""

    wave: Wave
    ratio: float
    cell: tuple[int, int]
    place: np.ndarray
