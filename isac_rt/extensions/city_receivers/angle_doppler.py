"""The adaptive matched filter in every range-Doppler cell, over all directions.

The channels' maps are whitened with the covariance that the mesh and the own velocity predict; the
statistic over its threshold is searched for peaks, which are estimated off the grid in the beam
towards them: that beam takes out most of the clutter that shares the range-Doppler cell from
elsewhere. The estimates' beam is the plain one, so that clutter within a lobe still pulls them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
from isac_rt.extensions.city_receivers.gates import Gate, gates_of, seek
from isac_rt.extensions.city_receivers.neighbours import phases
from isac_rt.extensions.city_receivers.power import TAPER, Taper, expected_power
from isac_rt.receive.arms import all_channels, both_arms
from isac_rt.receive.cfar import (
    LOBE_MARGIN,
    first_row,
    leaked,
    strongest_peaks,
)
from isac_rt.receive.directions import (
    FINE,
    PRUNED,
    Found,
    Search,
    climbed,
    inverses,
    search_plain,
    search_white,
    searches,
    statistic_of,
)
from isac_rt.receive.estimate import OFF_GRID, Estimate, Estimator, LocalSpectra
from isac_rt.receive.known import Known
from isac_rt.receive.maps import UNION_FLOOR, accumulate, maps_with_power
from isac_rt.receive.sense import Sensed, describe
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import NO_HINTS, Correction, ExpectedClutter, Gates, Hints

QUIET = 0.3
"""Share of the cells, those with the least clutter to be expected, whose median power is taken for
the noise's."""
TWO_WAVES = 0.5
"""Where no clutter is expected an echo starts no track if other waves in its cell have more than
this share of its power: over a wall on one way alone two equal waves arrive. A wall that a UAV
flies by adds less, in a canyon 0.1 to 0.2 of the UAV's echo."""


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
        judged = replace(self, fitted=False).test_cells([maps], known, hints)[0]
        ratio, first = judged.ratio.copy(), first_row(self.settings, known.range_cell)
        ratio[:first] = 0
        rows, bins = strongest_peaks(ratio, ratio > 1, self.settings, UNION_FLOOR)
        cells = list(zip(rows.tolist(), bins.tolist(), strict=True))
        found, direction = [], []
        for (row, column), towards in zip(cells, judged.cosines[rows, bins], strict=True):
            whitener = judged.whiteners.get((row, column))
            beam = BeamSpectra(spectra, known, row, beam_weights(known, towards, whitener))
            estimate = self.estimator.at(beam, ratio, row, column)
            found.append(estimate)
            if not self.estimator.on_grid:
                towards = near_beam(estimate, known, towards, whitener)
            direction.append(towards)
        snr = np.maximum(power[rows, bins] / judged.level[rows, bins], ratio[rows, bins])
        detections = describe(found, snr, known, on_grid=self.estimator.on_grid, mixed=TWO_WAVES)
        # where there is no clutter a UAV's echo is one wave
        in_clutter = np.array([cell in judged.whiteners for cell in cells], bool)
        starts = (judged.sure[rows, bins] > 1) & (detections.starts | in_clutter)
        if first:
            starts &= ~in_sidelobe(rows, bins, power, first)
        directions = np.array(direction).reshape(-1, 2)
        detections = replace(detections, direction=directions, starts=starts)
        out = Sensed(found, detections, power, judged.level, correction=correction)
        if clutter is None or self.settings.self_calibration != "positions":
            return out
        expected = expected_power(clutter, known, len(power), self.taper)
        noise = noise_level(power, expected, known.channels)
        return replace(out, neighbours=phases(maps, expected, noise, known, clutter))

    def test_cells(self, frames: Sequence[np.ndarray], known: Known, hints: Hints) -> list[Tested]:
        """The verdict on frames that share their data and what is expected of them.

        Parameters
        ----------
        frames : (L_tx, L_rx, rows, P) complex64 of `channel_maps` each
        known : Known
        hints : the expected clutter, and gates, which have thresholds of their own
            (`isac_rt.extensions.city_receivers.gates`)

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
        everything, arms = searches(known.antennas, known.wavenumber)
        limits = self._limits(everything, known), self._limits(arms, known)
        x = maps.reshape(1, -1, power.size)  # an echo has one look, all channels
        plain = search_plain(x, everything, noise, PRUNED * limits[0][0])
        ratio, sure = np.zeros((2, power.size), np.float32)
        cosines = np.full((power.size, 2), np.nan)

        def note(found: Found, limit: tuple[float, float]) -> None:
            ratio[found.cell], sure[found.cell] = found.peak / limit[0], found.peak / limit[1]
            cosines[found.cell] = found.cosines

        note(plain, limits[0])
        filled = np.fft.ifftshift(expected, axes=1).ravel() > LEAST_CLUTTER * noise
        cell = plain.cell[filled[plain.cell] & (plain.peak > PRUNED * limits[1][0])]
        bucketed = Bucketed.of(hints.clutter, known, everything, noise, self.taper)

        def received(cell: np.ndarray, search: Search) -> np.ndarray:
            c = search.channels
            x = maps.reshape(*maps.shape[:2], -1)[c.tx[:, None], c.rx[:, None], cell]
            return np.ascontiguousarray(x.T)[:, None] / np.float32(np.sqrt(noise))

        R = bucketed.among(arms_of(known)).covariances(*np.divmod(cell, power.shape[1]))
        found, _ = search_white(received(cell, arms), R, cell, arms)
        note(found, limits[1])
        # the few that remain with all channels: fewer directions look alike
        cell = cell[found.peak > PRUNED * limits[1][0]]
        R = bucketed.covariances(*np.divmod(cell, power.shape[1]))
        note(search_white(received(cell, everything), R, cell, everything)[0], limits[0])
        inverse = dict(zip(cell.tolist(), inverses(R), strict=True))
        for gate in _gates(hints.gates, known, len(power), ratio, cosines):
            quiet = not filled[gate.cell].any()
            whiten = None if quiet else bucketed.covariances(*np.divmod(gate.cell, power.shape[1]))
            found = seek(gate, received(gate.cell, everything), whiten, everything)
            limit = gate.threshold(everything, self.settings.gate_rate)
            if found.peak[0] > limit:
                ratio[found.cell], cosines[found.cell] = found.peak / limit, found.cosines
        rows, bins = power.shape
        shown = [
            np.fft.fftshift(a.reshape(rows, bins, *a.shape[1:]), axes=1)
            for a in (ratio, sure, cosines)
        ]
        held_up = unexplained(power / (noise + expected), shown[0] > 1, self.settings)
        half = bins // 2
        whiteners = {(c // bins, (c % bins + half) % bins): one for c, one in inverse.items()}
        passed = shown[0] / held_up, shown[1] / held_up
        return Tested(*passed, noise + expected, shown[2], whiteners)

    def _limits(self, search: Search, known: Known) -> tuple[float, float]:
        """Thresholds of a detection and of one that may start a track."""
        size = scanned(search.channels, known.wavenumber, known.antennas.view_limit)
        usual, sure = self.settings.false_alarm_rates
        return field_threshold(*size, 1, usual), field_threshold(*size, 1, sure)


def _gates(
    expected: Gates | None, known: Known, rows: int, ratio: np.ndarray, cosines: np.ndarray
) -> Iterator[Gate]:
    """Gates in which nothing was found yet, but for cells that hold something from elsewhere: what
    it leaves in other directions is no noise."""
    for gate in () if expected is None else gates_of(expected, known, rows):
        full = ratio[gate.cell] > 1
        if not full.all() and not (gate.holds(cosines[gate.cell]) & full).any():
            yield replace(gate, cell=gate.cell[~full])


class BeamSpectra(LocalSpectra):
    """The rows around a peak, of which only one beam's power counts."""

    def __init__(self, spectra: np.ndarray, known: Known, row: int, weights: np.ndarray) -> None:
        super().__init__(spectra, known, row, beam=weights.conj(), in_phase=True)


def beam_weights(
    known: Known, cosines: np.ndarray, whitener: np.ndarray | None = None
) -> np.ndarray:
    """(L_tx, L_rx) weights towards (u_x, u_z): of the virtual L, zero off it, or of all channels
    against the clutter by R^-1 (L, L)."""
    channels = both_arms(known.antennas) if whitener is None else all_channels(known.antennas)
    out = np.zeros((known.antennas.num_tx, known.antennas.num_rx), complex)
    towards = np.array([[cosines[0], 0.0, cosines[1]]])
    steering = channels.steering(towards, known)[0]
    out[channels.tx, channels.rx] = steering if whitener is None else whitener @ steering
    return out


def near_beam(
    estimate: Estimate, known: Known, cosines: np.ndarray, whitener: np.ndarray | None = None
) -> np.ndarray:
    """(u_x, u_z) near the filter's beam of the most power of the virtual L, or of the largest
    likelihood of all channels with R^-1 (L, L)."""
    everything, arms = searches(known.antennas, known.wavenumber)
    search = arms if whitener is None else everything
    y = estimate.channels[search.channels.tx, search.channels.rx][None, None]
    if whitener is None:
        statistic = statistic_of(y)
    else:
        statistic = statistic_of(y @ whitener.T, whitener[None])
    best = climbed(statistic, cosines[None], search, FINE, 2)[1][0]
    period = 2 * np.pi / (known.wavenumber * known.antennas.spacing)
    best = best - period * np.round(best / period)
    return best if (best**2).sum() <= 1 else np.full(2, np.nan)


def correct(power: np.ndarray, known: Known, clutter: ExpectedClutter) -> Correction:
    """Estimate from the frame the terminal's own velocity and the level that it expects."""
    expected = expected_power(clutter, known, len(power))
    return fit(power, noise_level(power, expected, known.channels), clutter, known)


def in_sidelobe(rows: np.ndarray, bins: np.ndarray, power: np.ndarray, first: int) -> np.ndarray:
    """Mark the cells that hold no more than the sidelobes of the strongest path before the row
    `first`: the transmitter's leakage."""
    row, column = np.unravel_index(power[:first].argmax(), power[:first].shape)
    lobes = leaked(rows - row, bins - column, power.shape[1], UNION_FLOOR)
    return np.asarray(power[rows, bins] <= LOBE_MARGIN * power[row, column] * lobes)


def noise_level(power: np.ndarray, expected: np.ndarray | None, looks: int) -> float:
    """Mean noise power of a cell, from the median of the quietest cells, or of all where nothing is
    known of the clutter.

    The median of a mean of n exponentials is (1 - 1/(9 n))^3 of its mean (Wilson and Hilferty).
    """
    some = power if expected is None else power[expected <= np.quantile(expected, QUIET)]
    return float(np.median(some)) / (1 - 1 / (9 * looks)) ** 3


def arms_of(known: Known) -> np.ndarray:
    """Numbers of the channels of both arms among all."""
    c, every = both_arms(known.antennas), all_channels(known.antennas)
    pairs = zip(every.tx.tolist(), every.rx.tolist(), strict=True)
    number = {pair: i for i, pair in enumerate(pairs)}
    return np.array([number[pair] for pair in zip(c.tx.tolist(), c.rx.tolist(), strict=True)])
