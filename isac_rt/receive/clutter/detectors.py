"""Detectors in clutter: channels' maps in, in every cell the statistic over its threshold out.

Peaks of the statistic are estimated off the grid. A filter that looks at directions also estimates
there: the beam towards a detection takes out most of the clutter that shares its range-Doppler cell
from elsewhere. The estimates' beam is the plain one, so that clutter within a lobe still pulls
them. A new detector is a subclass of `ClutterDetector` in a file of its own, and a line of
`isac_rt.receive.chain.DETECTORS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from isac_rt.kernels.order import median
from isac_rt.receive.arms import Channels, all_channels, arm, both_arms
from isac_rt.receive.cfar import first_row, strongest_peaks, without_sidelobes
from isac_rt.receive.clutter.adaptive import Beams, Scan, beams_of, scan_threshold
from isac_rt.receive.clutter.correction import fit
from isac_rt.receive.clutter.neighbours import phases
from isac_rt.receive.clutter.power import TAPER, Taper, expected_power
from isac_rt.receive.estimate import OFF_GRID, Estimate, Estimator, LocalSpectra
from isac_rt.receive.known import Known
from isac_rt.receive.maps import UNION_FLOOR, maps_with_power
from isac_rt.receive.sense import Sensed, describe
from isac_rt.receive.types import Correction, ExpectedClutter
from isac_rt.scenario.receivers import Receivers

QUIET = 0.3
"""Share of the cells, those with the least clutter to be expected, whose median power is taken for
the noise's."""
FINE = 0.03, 0.01, 0.003
"""Steps of the search for a direction around the filter's beam [cosine]."""
TWO_WAVES = 0.5
"""Where no clutter is expected an echo starts no track if other waves in its cell have more than
this share of its power: over a wall on one way alone two equal waves arrive. A wall that a UAV
flies by adds less, in a canyon 0.1 to 0.2 of the UAV's echo."""
SCANNED = {"arms": ((0,), (2,)), "joint": ((0, 2),)}
"""Axes of the L that are filtered together, by `receivers.clutter_channels`."""


@dataclass(frozen=True)
class Judged:
    """A detector's verdict on every cell, Doppler centred.

    Attributes
    ----------
    ratio : (rows, P) statistic over its threshold; above 1 is a detection
    sure : (rows, P) statistic over the threshold from which on a detection may start a track
    level : (rows, P) power of a channel that counts as background
    cosines : (rows, P, 2) direction in which a filter found most, NaN where the detector does not
        look at directions
    whiteners : of cells (row, bin) in which all channels were whitened R^-1 (L, L), R in units of
        the noise; None: the detector whitens none
    """

    ratio: np.ndarray
    sure: np.ndarray
    level: np.ndarray
    cosines: np.ndarray
    whiteners: Mapping[tuple[int, int], np.ndarray] | None = None

    @classmethod
    def everywhere(cls, ratio: np.ndarray, level: np.ndarray) -> Judged:
        """The verdict of a detector that does not look at directions and has one threshold."""
        return cls(ratio, ratio, level, np.full((*ratio.shape, 2), np.nan))


@dataclass(frozen=True)
class ClutterDetector:
    """A detector of echoes that holds cells against something else than their surroundings.

    Attributes
    ----------
    settings : Receivers
    estimator : of the peaks
    taper : how uncertain the expected clutter is
    fitted : correct the own velocity and the clutter's level by the first frame
        (`isac_rt.receive.clutter.correction`) before anything is decided
    """

    settings: Receivers
    estimator: Estimator = OFF_GRID
    taper: Taper = TAPER
    fitted: bool = True

    def judge(
        self, frames: Sequence[np.ndarray], known: Known, clutter: ExpectedClutter | None = None
    ) -> list[Judged]:
        """The verdict on frames that share their data and the expected clutter.

        Parameters
        ----------
        frames : (L_tx, L_rx, rows, P) complex64 of `channel_maps` each
        known : Known
        clutter : what is expected, for detectors that need it

        Raises
        ------
        ValueError  If the detector needs the expected clutter and there is none.
        """
        raise NotImplementedError

    def sense(
        self, spectra: np.ndarray, known: Known, clutter: ExpectedClutter | None = None
    ) -> Sensed:
        """Detections in cleaned spectra of echoes."""
        (maps, power), correction = maps_with_power(spectra, known), None
        if clutter is not None and self.fitted:
            correction = correct(power, known, clutter)
            clutter = correction.apply(clutter)
        judged = replace(self, fitted=False).judge([maps], known, clutter)[0]
        ratio, first = judged.ratio.copy(), first_row(self.settings, known.range_cell)
        ratio[:first] = 0
        rows, bins = strongest_peaks(ratio, ratio > 1, self.settings, UNION_FLOOR)
        found, towards = [], judged.cosines[rows, bins]
        whiteners = judged.whiteners or {}
        for row, column, cosines in zip(rows.tolist(), bins.tolist(), towards, strict=True):
            if np.isfinite(cosines).all():
                weights = beam_weights(known, cosines, whiteners.get((row, column)))
                beam = BeamSpectra(spectra, known, row, weights)
                found.append(self.estimator.at(beam, ratio, row, column))
            else:
                local = LocalSpectra(spectra, known, row)
                found.append(self.estimator.at(local, power, row, column))
        snr = np.maximum(power[rows, bins] / judged.level[rows, bins], ratio[rows, bins])
        on_grid = self.estimator.on_grid
        detections = describe(found, snr, known, on_grid=on_grid, mixed=TWO_WAVES)
        direction = detections.direction.copy()
        for i, cosines in enumerate(towards):
            if np.isfinite(cosines).all():
                white = whiteners.get((int(rows[i]), int(bins[i])))
                direction[i] = cosines if on_grid else near_beam(found[i], known, cosines, white)
        starts = judged.sure[rows, bins] > 1
        if judged.whiteners is not None:  # where there is no clutter a UAV's echo is one wave
            cells = zip(rows.tolist(), bins.tolist(), strict=True)
            starts &= detections.starts | np.array([cell in whiteners for cell in cells], bool)
        if first:
            starts &= ~in_skirt(rows, bins, power, first)
        detections = replace(detections, direction=direction, starts=starts)
        out = Sensed(found, detections, power, judged.level, correction=correction)
        if clutter is None or self.settings.self_calibration != "positions":
            return out
        expected = expected_power(clutter, known, len(power), self.taper)
        noise = noise_level(power, expected, known.channels)
        return replace(out, neighbours=phases(maps, expected, noise, known, clutter))

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

    def scans(self, known: Known) -> list[tuple[Channels, Beams]]:
        """Channels that are filtered together, and the beams in which they are scanned."""
        sets = [
            (arm(known.antennas, axes[0]) if len(axes) == 1 else both_arms(known.antennas), axes)
            for axes in SCANNED[self.settings.clutter_channels]
        ]
        return [(channels, beams_of(channels, known, axes)) for channels, axes in sets]

    def directed(self, parts: list[tuple[Scan, Beams]], level: np.ndarray) -> Judged:
        """Scans added, over their threshold."""
        total = np.fft.fftshift(np.sum([scan.peak for scan, _ in parts], axis=0), axes=1)
        limit = scan_threshold(tuple(b for _, b in parts), self.settings.false_alarm_rate)
        ratio = total / limit
        cosines = np.zeros((*ratio.shape, 2))
        for scan, beams in parts:
            # each arm's beams lie along its own axis, so that the sum puts the two together
            cosines += np.fft.fftshift(beams.cosines[scan.beam][..., [0, 2]], axes=1)
        return Judged(ratio, ratio, level, cosines)


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
    channels = both_arms(known.antennas) if whitener is None else all_channels(known.antennas)
    values = estimate.channels[channels.tx, channels.rx]
    if whitener is not None:
        values = whitener @ values
    best = np.array(cosines, float)
    for step in FINE:
        i, j = np.meshgrid(np.arange(-2, 3), np.arange(-2, 3), indexing="ij")
        tried = np.stack(
            [best[0] + step * i.ravel(), np.zeros(25), best[1] + step * j.ravel()], axis=1
        )
        a = channels.steering(tried, known)
        power = np.abs(a.conj() @ values) ** 2
        if whitener is not None:
            power /= ((a.conj() @ whitener) * a).sum(axis=1).real
        best = tried[power.argmax()][[0, 2]]
    period = 2 * np.pi / (known.wavenumber * known.antennas.spacing)
    best = best - period * np.round(best / period)
    return best if (best**2).sum() <= 1 else np.full(2, np.nan)


def correct(power: np.ndarray, known: Known, clutter: ExpectedClutter) -> Correction:
    """What the frame says of the terminal's own velocity and of the level that it expects."""
    expected = expected_power(clutter, known, len(power))
    return fit(power, noise_level(power, expected, known.channels), clutter, known)


def in_skirt(rows: np.ndarray, bins: np.ndarray, power: np.ndarray, first: int) -> np.ndarray:
    """Which cells hold no more than the lobes of the strongest path before the row `first`: the
    transmitter's leakage."""
    row, column = np.unravel_index(power[:first].argmax(), power[:first].shape)
    pairs = [(np.array([row, r]), np.array([column, b])) for r, b in zip(rows, bins, strict=True)]
    kept = [without_sidelobes(*pair, power, power.shape[1], UNION_FLOOR)[1] for pair in pairs]
    return ~np.array(kept, bool)


def noise_level(power: np.ndarray, expected: np.ndarray | None, looks: int) -> float:
    """Mean noise power of a cell, from the median of the quietest cells, or of all where nothing is
    known of the clutter.

    The median of a mean of n exponentials is (1 - 1/(9 n))^3 of its mean (Wilson and Hilferty).
    """
    some = power if expected is None else power[expected <= np.quantile(expected, QUIET)]
    return median(some) / (1 - 1 / (9 * looks)) ** 3
