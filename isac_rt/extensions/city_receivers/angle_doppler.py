"""The adaptive matched filter in every range-Doppler cell, over all directions.

The channels' maps are whitened with the covariance that the mesh and the own velocity predict; the
statistic over its threshold is searched for peaks, which are estimated off the grid in the whitened
beam towards them: it takes out most of the clutter that shares the range-Doppler cell from
elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from isac_rt.extensions.city_receivers.adaptive import DirectionTest, noise_level, unexplained
from isac_rt.extensions.city_receivers.correction import fit
from isac_rt.extensions.city_receivers.power import expected_power
from isac_rt.extensions.city_receivers.waves import waves_of
from isac_rt.frame.antennas import resolutions
from isac_rt.receive.cfar import LOBE_MARGIN, first_row, leaked, strongest_peaks
from isac_rt.receive.estimate import OFF_GRID, Estimator, LocalSpectra, in_plane, near_beam
from isac_rt.receive.known import Known
from isac_rt.receive.maps import UNION_FLOOR, in_their_span, maps_with_power
from isac_rt.receive.sense import Sensed, describe
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import NO_HINTS, Correction, Detections, ExpectedClutter, Hints

TWO_WAVES = 0.5
"""Where no clutter is expected an echo starts no track if other waves in its cell have more than
this share of its power: over a wall on one way alone two equal waves arrive. A wall that a UAV
flies by adds less, in a canyon 0.1 to 0.2 of the UAV's echo."""
REPEAT_CELLS = 3.0
"""Cells of the range and the velocity window's main lobe on each side, and one for migration."""


@dataclass(frozen=True)
class AngleDoppler:
    """All channels of every cell coherently, whitened where clutter is expected.

    Attributes
    ----------
    settings : Receivers
    estimator : of the peaks
    """

    settings: Receivers
    estimator: Estimator = OFF_GRID

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        """Detections in cleaned spectra of echoes. The own velocity and the clutter's level are
        corrected by the frame itself first.

        Raises
        ------
        ValueError  If there is no expected clutter.
        """
        if hints.clutter is None:
            raise ValueError(
                f"receivers.clutter_detector {self.settings.clutter_detector} needs the clutter "
                "that the mesh predicts; give it, or use cfar"
            )
        maps, power = maps_with_power(spectra, known)
        correction = correct(power, known, hints.clutter)
        clutter = correction.apply(hints.clutter)
        ratio, cosines, test = self.test_cells(maps, power, known, clutter)
        level, first = test.noise + test.expected, first_row(self.settings, known.range_cell)
        ratio[:first] = 0
        rows, bins = strongest_peaks(ratio, ratio > 1, self.settings, UNION_FLOOR)
        found, direction, told, cells, waves = [], [], [], [], []
        for cell in zip(rows.tolist(), bins.tolist(), strict=True):
            x = maps[:, :, cell[0], (cell[1] + maps.shape[3] // 2) % maps.shape[3]].ravel()
            x = x / np.sqrt(test.noise)
            inverse = test.inverse(*cell)
            for wave in waves_of(x, inverse, cosines[cell], test.search, float(ratio[cell])):
                beam = wave.weights.reshape(known.antennas.num_tx, -1).conj()
                local = LocalSpectra(spectra, known, cell[0], beam=beam, in_phase=True)
                estimate = wave.alone(self.estimator.at(local, ratio, *cell), test.search)
                found.append(estimate)
                towards = wave.cosines
                if not self.estimator.on_grid:
                    towards = near_beam(estimate, known, towards, inverse)
                direction.append(towards)
                told.append(wave.told)
                cells.append(cell)
                waves.append((wave.share, wave.number))
        rows, bins = np.array(cells, int).reshape(-1, 2).T
        share, number = np.array(waves).reshape(-1, 2).T
        snr = share * np.maximum(power[rows, bins] / level[rows, bins], ratio[rows, bins])
        detections = describe(found, snr, known, on_grid=self.estimator.on_grid, mixed=TWO_WAVES)
        towards, limit = np.array(direction).reshape(-1, 2), known.antennas.view_limit
        axes, std = np.array(told, bool).reshape(-1, 2), detections.std.copy()
        in_view = np.abs(towards) <= limit
        std[:, 2:][in_view & ~axes] = np.inf
        towards = np.where(in_view & axes, towards, np.nan)
        sure = ratio[rows, bins] * (test.limits[0] / test.limits[1])
        # where there is no clutter a UAV's echo is one wave
        starts = (share * sure > 1) & (detections.starts | test.filled[rows, bins])
        if first:
            starts &= ~in_sidelobe(rows, bins, power, first, known)
        detections = replace(detections, direction=towards, std=std, starts=starts)
        starts = starts & ~over_walls(detections, np.column_stack([rows, bins]), known)
        kept = np.flatnonzero((number == 0) | ~repeated(detections, known))
        detections = replace(detections, starts=starts).select(kept)
        found = [found[i] for i in kept]
        return Sensed(found, detections, power, level, correction=correction)

    def test_cells(
        self, maps: np.ndarray, power: np.ndarray, known: Known, clutter: ExpectedClutter
    ) -> tuple[np.ndarray, np.ndarray, DirectionTest]:
        """Return the statistic over its threshold (rows, P) and its directions (rows, P, 2),
        Doppler centred, of the `channel_maps` of a frame and their mean power; and the test."""
        test = DirectionTest.of(self.settings, known, power, clutter)
        ratio, cosines = test.ratio(maps, np.arange(len(power)))
        ratio *= in_their_span(ratio, len(known.leaks))
        around = power / (test.noise + test.expected)
        return ratio / unexplained(around, ratio > 1, self.settings), cosines, test


def correct(power: np.ndarray, known: Known, clutter: ExpectedClutter) -> Correction:
    """Estimate from the frame the terminal's own velocity and the level that it expects."""
    expected = expected_power(clutter, known, len(power))
    return fit(power, noise_level(power, expected, known.channels), clutter, known)


def over_walls(d: Detections, cells: np.ndarray, known: Known) -> np.ndarray:
    """Mark waves (Q,) that share a cell (Q, 2) of which one comes from where a nearer and stronger
    detection is that may start a track: an echo over a wall on one way arrives from its source
    and from the wall."""
    off = _off(d, known)
    sources = (off[..., 0] > REPEAT_CELLS) & d.starts & _same_direction(off, d.snr)
    together = (cells[:, None] == cells).all(axis=2)
    source = (together & sources.any(axis=1)).any(axis=1)
    return np.asarray((together.sum(axis=1) > 1) & source)


def repeated(d: Detections, known: Known) -> np.ndarray:
    """Mark detections (Q,) in the main lobe of a stronger one from the same direction."""
    off = _off(d, known)
    beside = (np.abs(off[..., :2]) < REPEAT_CELLS).all(axis=2)
    return np.asarray((beside & _same_direction(off, d.snr)).any(axis=1))


def _off(d: Detections, known: Known) -> np.ndarray:
    """(Q, Q, 4) by how many resolutions detections are off others, by none on an axis that the
    array does not observe."""
    measured = replace(d, direction=in_plane(d.direction, known)).measured
    off = measured[:, None] - measured
    return np.asarray(off / resolutions(known.waveform, known.antennas, known.passes))


def _same_direction(off: np.ndarray, snr: np.ndarray) -> np.ndarray:
    """(Q, Q) which detections come from where others are that are stronger, by `_off`."""
    near = (np.abs(off[..., 2:]) < 0.5).all(axis=2)
    return np.asarray(near & (snr > snr[:, None]))


def in_sidelobe(
    rows: np.ndarray, bins: np.ndarray, power: np.ndarray, first: int, known: Known
) -> np.ndarray:
    """Mark the cells that hold no more than the sidelobes of the strongest path before the row
    `first`, the transmitter's leakage, in all spans of velocities in which it shows; a map of all
    range cells has the last row beside the first."""
    row, column = np.unravel_index(power[:first].argmax(), power[:first].shape)
    row_offset, span = rows - row, power.shape[1] // len(known.leaks)
    if len(power) == known.waveform.num_samples:
        row_offset = np.minimum(row_offset % len(power), -row_offset % len(power))
    lobes = leaked(row_offset, (bins - column) % span, span, UNION_FLOOR)
    return np.asarray(power[rows, bins] <= LOBE_MARGIN * power[row, column] * lobes)
