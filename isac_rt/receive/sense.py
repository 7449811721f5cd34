"""From cleaned spectra to detections: the CFAR on range-Doppler maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.fft

from isac_rt.frame.cube import IFCube
from isac_rt.receive.cfar import CfarRule, first_row, strongest_peaks
from isac_rt.receive.estimate import (
    OFF_GRID,
    Estimate,
    Estimator,
    LocalSpectra,
    directions,
    excess,
    standard_deviations,
)
from isac_rt.receive.known import Known
from isac_rt.receive.maps import (
    UNION_FLOOR,
    Banded,
    Conventional,
    LatinUnion,
    Levels,
    doppler_bins,
    slow_window,
)
from isac_rt.receive.omp import Omp, advise
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import (
    NO_HINTS,
    Correction,
    Detections,
    Hints,
    Maps,
    Neighbours,
    PathChannels,
)

MIXED = 0.1
"""Power of other paths over its own from which a detection starts no track, beside what noise
adds: the range of a mixed cell wanders from frame to frame."""

MOST_LOOKS = 24
"""Strongest paths of a frame that are looked at for self-calibration."""


@dataclass(frozen=True)
class Sensed:
    """Detections of a frame with their estimates, strongest first, the map that they came from and
    its background (`CfarRule.detect`). `sparse`, `correction`, `path_channels`, `neighbours`: see
    `Reception`."""

    estimates: list[Estimate]
    detections: Detections
    power: np.ndarray
    level: np.ndarray
    sparse: bool | None = None
    correction: Correction | None = None
    path_channels: tuple[PathChannels, ...] = ()
    neighbours: Neighbours | None = None


class Detector(Protocol):
    """Protocol of a detector: it finds paths in cleaned spectra (M, L_rx, rows, P)."""

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        """Return what a frame shows."""
        ...


@dataclass(frozen=True)
class Cfar:
    """Peaks of the range-Doppler map that stand out of their surroundings.

    Attributes
    ----------
    settings : Receivers
    estimator : of the peaks
    doppler : how the map is made; None: as the schedule asks for (`doppler_of`)
    """

    settings: Receivers
    estimator: Estimator = OFF_GRID
    doppler: LatinUnion | None = None

    def way(self, known: Known) -> LatinUnion:
        """Return how the map of a frame is made."""
        return self.doppler or doppler_of(known)

    def rule(self, known: Known) -> CfarRule:
        """The rule for the map of a frame."""
        groups = len(known.schedule) if self.way(known).separate else 1
        return CfarRule.of(self.settings, groups * known.channels)

    def estimates(
        self,
        spectra: np.ndarray,
        known: Known,
        power: np.ndarray,
        rows: np.ndarray,
        columns: np.ndarray,
    ) -> list[Estimate]:
        """The paths at peaks (Q,) of the map."""
        separate = self.way(known).separate
        return self.estimator.at_peaks(spectra, known, power, rows, columns, separate=separate)

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        """Range-Doppler map, CFAR, peaks, and an estimate of each."""
        way = self.way(known)
        power = way.power(spectra, known)
        above, level = self.rule(known).detect(power)
        above[: first_row(self.settings, known.range_cell)] = False
        sparse, recovered = None, None
        if way.advises:
            added = len(known.schedule) if way.separate else 1
            noise = float(np.median(power)) * added / window_gain(known)
            rows = np.flatnonzero(above.any(axis=1))
            sparse, recovered = advise(spectra, rows, noise, known)
        above = way.keep(above, Levels(power, level, recovered), known)
        rows, bins = strongest_peaks(power, above, self.settings, UNION_FLOOR)
        estimates = self.estimates(spectra, known, power, rows, bins)
        snr = power[rows, bins] / level[rows, bins]
        found = describe(estimates, snr, known, on_grid=self.estimator.on_grid)
        return Sensed(estimates, found, power, level, sparse)


def doppler_of(known: Known) -> LatinUnion:
    """The union where it samples every antenna in every slot, by bands where all send at once; else
    each antenna's own DFT where its chirps are equally spaced, as in a conventional schedule; OMP
    elsewhere."""
    if known.full:
        return Banded() if known.waveform.bands > 1 else LatinUnion()
    schedule, num_tx = known.schedule, known.waveform.num_tx
    equally = (schedule[:, num_tx:] == schedule[:, :-num_tx]).all()
    return Conventional() if equally else Omp()


def window_gain(known: Known) -> float:
    """Noise power of a map's cell over that of a sample of the spectra: the squared window over an
    antenna's chirps."""
    w = known.waveform
    return float((slow_window(w) ** 2).sum()) * len(known.schedule) / w.num_tx


def measure_channels(
    spectra: np.ndarray, known: Known, estimates: Sequence[Estimate], snr: np.ndarray
) -> tuple[PathChannels, ...]:
    """Return the channels as the `MOST_LOOKS` strongest of the paths show them."""
    out = []
    for i in np.argsort(snr)[::-1][:MOST_LOOKS]:
        delay, rate = estimates[i].delay, estimates[i].delay_rate
        row = round(float(known.waveform.beat_cells(delay, rate, 0.0)))
        if 0 <= row < spectra.shape[2] and (known.full or known.passes == 1):
            modes = LocalSpectra(spectra, known, row).modes(delay, rate)
            out.append(PathChannels(delay, rate, modes, float(snr[i])))
    return tuple(out)


def describe(
    estimates: list[Estimate],
    snr: np.ndarray,
    known: Known,
    *,
    on_grid: bool = False,
    mixed: float = MIXED,
) -> Detections:
    """Detections in ranges, velocities and direction cosines; what lies outside the field of view
    has no direction. `on_grid`: of the directions too the nearest grid point, eight to a beam.

    What a single wave does not explain, such as a wall, carries on a track and starts none: where
    others have more than `mixed` of its power.
    """
    count = len(estimates)
    shape = count, known.antennas.num_tx, known.antennas.num_rx
    channels = np.array([e.channels for e in estimates], complex).reshape(shape)
    delays, snr = np.array([e.delay for e in estimates], float), np.asarray(snr, float)
    u = directions(channels, delays, known, on_grid=on_grid)
    others = excess(channels, delays, u, snr, known)
    noise = 1 / (snr * np.sqrt(known.channels))
    return Detections(
        range=delays * known.metres,
        velocity=np.array([e.delay_rate for e in estimates], float) * known.metres,
        direction=np.where(np.abs(u) <= known.antennas.view_limit, u, np.nan),
        snr=snr,
        std=standard_deviations(snr, others, known),
        is_reference=np.zeros(count, bool),
        starts=others <= mixed + noise,
    )


def equivalent_range_power(cube: IFCube) -> np.ndarray:
    """(N, P) mean power over the receivers, over range cell and chirp of the first group, before
    any data are removed."""
    total = np.zeros((cube.samples.shape[3], cube.samples.shape[2]), np.float32)
    for one in cube.samples[0]:
        spectrum = scipy.fft.fft(one, axis=1, workers=1)
        total += (spectrum.real**2 + spectrum.imag**2).T
    return total / cube.samples.shape[1]


def make_maps(power: np.ndarray, cube: IFCube, settings: Receivers, passes: int) -> Maps:
    """Maps with their axes; the range axis ignores the range-Doppler coupling (under a cell)."""
    w, before = cube.waveform, equivalent_range_power(cube)
    rule = CfarRule.of(settings, cube.samples.shape[1])
    return Maps(
        range_doppler=power.astype(np.float32),
        range_axis=np.arange(power.shape[0]) * w.range_cell(passes),
        velocity_axis=doppler_bins(w) * w.velocity_cell(passes),
        equivalent_range=np.sqrt(before),
        equivalent_detections=rule.detect_chirps(before),
    )
