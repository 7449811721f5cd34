"""The adaptive matched filter in every range-Doppler cell, over all directions.

The channels' maps are whitened with the covariance that the mesh and the own velocity predict; the
statistic over its threshold is searched for peaks, which are estimated off the grid in the beam
towards them: that beam takes out most of the clutter that shares the range-Doppler cell from
elsewhere. The estimates' beam is the plain one, so that clutter within a lobe still pulls them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from isac_rt.extensions.city_receivers.adaptive import (
    LEAST_CLUTTER,
    field_threshold,
    scanned,
    unexplained,
)
from isac_rt.extensions.city_receivers.correction import fit
from isac_rt.extensions.city_receivers.covariance import Bucketed
from isac_rt.extensions.city_receivers.neighbours import phases
from isac_rt.extensions.city_receivers.power import TAPER, Taper, expected_power
from isac_rt.extensions.city_receivers.waves import Wave, waves_of
from isac_rt.frame.antennas import resolutions
from isac_rt.receive.cfar import (
    LOBE_MARGIN,
    first_row,
    leaked,
    strongest_peaks,
)
from isac_rt.receive.directions import (
    PRUNED,
    DirectionPeaks,
    Search,
    channel_search,
    inverses,
    search_plain,
    search_white,
)
from isac_rt.receive.estimate import OFF_GRID, Estimator, LocalSpectra, in_plane, near_beam
from isac_rt.receive.known import Known
from isac_rt.receive.maps import UNION_FLOOR, accumulate, in_their_span, maps_with_power
from isac_rt.receive.sense import Sensed, describe
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import NO_HINTS, Correction, Detections, ExpectedClutter, Hints

QUIET = 0.3
"""Share of the cells, those with the least clutter to be expected, whose median power is taken for
the noise's."""
TWO_WAVES = 0.5
"""Where no clutter is expected an echo starts no track if other waves in its cell have more than
this share of its power: over a wall on one way alone two equal waves arrive. A wall that a UAV
flies by adds less, in a canyon 0.1 to 0.2 of the UAV's echo."""
MOST_KEPT = 50_000_000
"""Entries of covariances that are held at once."""
REPEAT_CELLS = 3.0
"""Cells of the range and the velocity window's main lobe on each side, and one for migration."""


@dataclass(frozen=True)
class Tested:
    """A detector's verdict on every cell, Doppler centred.

    Attributes
    ----------
    ratio : (rows, P) statistic over its threshold; above 1 is a detection
    sure : (rows, P) statistic over the threshold from which on a detection may start a track
    level : (rows, P) power of a channel that counts as background
    cosines : (rows, P, 2) direction in which a filter found most, finite where `ratio` is above 1
    whiteners : of cells (row, bin) in which all channels were whitened R^-1 (L, L), R in units of
        the noise
    """

    ratio: np.ndarray
    sure: np.ndarray
    level: np.ndarray
    cosines: np.ndarray
    whiteners: Mapping[tuple[int, int], np.ndarray]


@dataclass(frozen=True)
class AngleDoppler:
    """All channels of every cell coherently, whitened where clutter is expected.

    Attributes
    ----------
    settings : Receivers
    estimator : of the peaks
    taper : how uncertain the expected clutter is
    fitted : correct the own velocity and the clutter's level by the first frame
        (`isac_rt.extensions.city_receivers.correction`) before anything is decided
    """

    settings: Receivers
    estimator: Estimator = OFF_GRID
    taper: Taper = TAPER
    fitted: bool = True

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        """Detections in cleaned spectra of echoes; raises as `test_cells`."""
        (maps, power), correction = maps_with_power(spectra, known), None
        clutter = hints.clutter
        if clutter is not None and self.fitted:
            correction = correct(power, known, clutter)
            clutter = correction.apply(clutter)
        hints = replace(hints, clutter=clutter)
        tested = replace(self, fitted=False).test_cells([maps], known, hints)[0]
        ratio, first = tested.ratio.copy(), first_row(self.settings, known.range_cell)
        ratio[:first] = 0
        rows, bins = strongest_peaks(ratio, ratio > 1, self.settings, UNION_FLOOR)
        search = channel_search(known.antennas, known.wavenumber)
        found, direction, cells, waves = [], [], [], []
        for cell in zip(rows.tolist(), bins.tolist(), strict=True):
            for wave in self._waves(maps, known, tested, cell):
                beam = BeamSpectra(
                    spectra, known, cell[0], wave.weights.reshape(known.antennas.num_tx, -1)
                )
                estimate = wave.alone(self.estimator.at(beam, ratio, *cell), search)
                found.append(estimate)
                towards = wave.cosines
                if not self.estimator.on_grid:
                    towards = near_beam(estimate, known, towards, wave.inverse)
                direction.append(towards)
                cells.append(cell)
                waves.append((wave.share, wave.number))
        rows, bins = np.array(cells, int).reshape(-1, 2).T
        share, number = np.array(waves).reshape(-1, 2).T
        snr = share * np.maximum(power[rows, bins] / tested.level[rows, bins], ratio[rows, bins])
        detections = describe(found, snr, known, on_grid=self.estimator.on_grid, mixed=TWO_WAVES)
        towards, limit = np.array(direction).reshape(-1, 2), known.antennas.view_limit
        towards = np.where(np.abs(towards) <= limit, towards, np.nan)
        detections = replace(detections, direction=towards)
        # where there is no clutter a UAV's echo is one wave
        in_clutter = np.array([cell in tested.whiteners for cell in cells], bool)
        starts = (share * tested.sure[rows, bins] > 1) & (detections.starts | in_clutter)
        if first:
            starts &= ~in_sidelobe(rows, bins, power, first, known)
        detections = replace(detections, starts=starts)
        starts = starts & ~over_walls(detections, np.column_stack([rows, bins]), known)
        kept = np.flatnonzero((number == 0) | ~repeated(detections, known))
        detections = replace(detections, starts=starts).select(kept)
        found = [found[i] for i in kept]
        out = Sensed(found, detections, power, tested.level, correction=correction)
        if clutter is None or self.settings.self_calibration != "positions" or len(known.leaks) > 1:
            return out
        expected = expected_power(clutter, known, len(power), self.taper)
        noise = noise_level(power, expected, known.channels)
        return replace(out, neighbours=phases(maps, expected, noise, known, clutter))

    def _waves(
        self, maps: np.ndarray, known: Known, tested: Tested, cell: tuple[int, int]
    ) -> list[Wave]:
        """Return the waves of a cell in which something was found."""
        search, bins = channel_search(known.antennas, known.wavenumber), maps.shape[3]
        row, column = cell
        inverse = tested.whiteners.get(cell)
        if inverse is None:
            inverse = np.eye(len(search.channels), dtype=np.complex64)
        x = maps[:, :, row, (column + bins // 2) % bins].ravel()
        ratio = float(tested.ratio[cell])
        return waves_of(x, inverse, tested.cosines[cell], search, ratio)

    def test_cells(self, frames: Sequence[np.ndarray], known: Known, hints: Hints) -> list[Tested]:
        """The verdict on frames that share their data and what is expected of them.

        Parameters
        ----------
        frames : (L_tx, L_rx, rows, P) complex64 of `channel_maps` each
        known : Known
        hints : the expected clutter

        Raises
        ------
        ValueError  If there is no expected clutter.
        """
        powers = [accumulate(maps) for maps in frames]
        clutter, expected, noise = self.expectation(powers, known, hints.clutter)
        hints = replace(hints, clutter=clutter)
        return [
            self._test(maps, power, n, expected, known, hints)
            for maps, power, n in zip(frames, powers, noise, strict=True)
        ]

    def expectation(
        self, powers: list[np.ndarray], known: Known, clutter: ExpectedClutter | None
    ) -> tuple[ExpectedClutter, np.ndarray, list[float]]:
        """The expected clutter, corrected by the first frame, its power (rows, P), and the noise of
        a cell of every frame."""
        if clutter is None:
            raise ValueError(
                f"receivers.clutter_detector {self.settings.clutter_detector} needs the clutter "
                "that the mesh predicts; give it, or use cfar"
            )
        if self.fitted:
            clutter = correct(powers[0], known, clutter).apply(clutter)
        expected = expected_power(clutter, known, len(powers[0]), self.taper)
        noise = [noise_level(power, expected, known.channels) for power in powers]
        return clutter, expected, noise

    def _test(
        self,
        maps: np.ndarray,
        power: np.ndarray,
        noise: float,
        expected: np.ndarray,
        known: Known,
        hints: Hints,
    ) -> Tested:
        assert hints.clutter is not None  # `expectation` has it
        search = channel_search(known.antennas, known.wavenumber)
        limits = self._limits(search, known)
        x = maps.reshape(1, -1, power.size)  # an echo has one look, all channels
        plain = search_plain(x, search, noise, PRUNED * limits[0])
        ratio, sure = np.zeros((2, power.size), np.float32)
        cosines = np.full((power.size, 2), np.nan)

        def note(found: DirectionPeaks) -> None:
            ratio[found.cell], sure[found.cell] = (found.peak / limit for limit in limits)
            cosines[found.cell] = found.cosines

        note(plain)
        filled = np.fft.ifftshift(expected, axes=1).ravel() > LEAST_CLUTTER * noise
        cell = plain.cell[filled[plain.cell] & (plain.peak > PRUNED * limits[0])]
        expected_waves = Bucketed.of(hints.clutter, known, search, noise, self.taper)
        inverse: dict[int, np.ndarray] = {}
        for some in np.array_split(cell, 1 + cell.size * len(search.channels) ** 2 // MOST_KEPT):
            R = expected_waves.covariances(*np.divmod(some, power.shape[1]))
            seen = np.ascontiguousarray(x[0, :, some])[:, None] / np.float32(np.sqrt(noise))
            found, _ = search_white(seen, R, some, search, PRUNED * limits[0])
            note(found)
            above = found.peak > limits[0]
            inverse |= zip(some[above].tolist(), inverses(R[above]), strict=True)
        rows, bins = power.shape
        shown = [
            np.fft.fftshift(a.reshape(rows, bins, *a.shape[1:]), axes=1)
            for a in (ratio, sure, cosines)
        ]
        shown[0] *= in_their_span(shown[0], len(known.leaks))
        held_up = unexplained(power / (noise + expected), shown[0] > 1, self.settings)
        half = bins // 2
        whiteners = {(c // bins, (c % bins + half) % bins): one for c, one in inverse.items()}
        passed = shown[0] / held_up, shown[1] / held_up
        return Tested(*passed, noise + expected, shown[2], whiteners)

    def _limits(self, search: Search, known: Known) -> tuple[float, float]:
        """Thresholds of a detection and of one that may start a track."""
        size = scanned(search)
        usual, sure = self.settings.false_alarm_rates
        return field_threshold(*size, 1, usual), field_threshold(*size, 1, sure)


class BeamSpectra(LocalSpectra):
    """The rows around a peak, of which only one beam's power counts."""

    def __init__(self, spectra: np.ndarray, known: Known, row: int, weights: np.ndarray) -> None:
        super().__init__(spectra, known, row, beam=weights.conj(), in_phase=True)


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


def noise_level(power: np.ndarray, expected: np.ndarray | None, looks: int) -> float:
    """Mean noise power of a cell, from the median of the quietest cells, or of all where nothing is
    known of the clutter.

    The median of a mean of n exponentials is (1 - 1/(9 n))^3 of its mean (Wilson and Hilferty).
    """
    some = power if expected is None else power[expected <= np.quantile(expected, QUIET)]
    return float(np.median(some)) / (1 - 1 / (9 * looks)) ** 3
