"""Detection in cleaned spectra: CFAR on range-Doppler maps."""

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
    PathChannels,
)

MIXED = 0.1
"""Power of other paths over its own from which a detection starts no track, beside what noise
adds: the range of a mixed cell wanders from frame to frame."""

MAX_PATHS = 24
"""Strongest paths of a frame that are looked at for self-calibration."""


@dataclass(frozen=True)
class Sensed:
    """Detections of a frame with their estimates, strongest first, the map that they came from and
    its background (`CfarRule.detect`). `sparse`, `correction`, `path_channels`: see
    `Reception`."""

    estimates: list[Estimate]
    detections: Detections
    power: np.ndarray
    level: np.ndarray
    sparse: bool | None = None
    correction: Correction | None = None
    path_channels: tuple[PathChannels, ...] = ()


class Detector(Protocol):
    """Protocol of a detector of paths in cleaned spectra (M, L_rx, rows, P)."""

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        """Detect paths in a frame."""
        ...


@dataclass(frozen=True)
class Cfar:
    """Greatest-of CFAR on the range-Doppler map.

    Attributes
    ----------
    settings : Receivers
    estimator : of the peaks
    doppler : method of the map; None: by the schedule (`doppler_of`)"""

    settings: Receivers
    estimator: Estimator = OFF_GRID
    doppler: LatinUnion | None = None

    def doppler_method(self, known: Known) -> LatinUnion:
        """Return the Doppler processing of a frame."""
        return self.doppler or doppler_of(known)

    def rule(self, known: Known) -> CfarRule:
        """Return the CFAR rule of a frame."""
        groups = len(known.schedule) if self.doppler_method(known).separate else 1
        return CfarRule.of(self.settings, groups * known.channels)

    def estimates(
        self,
        spectra: np.ndarray,
        known: Known,
        power: np.ndarray,
        rows: np.ndarray,
        columns: np.ndarray,
    ) -> list[Estimate]:
        """Estimate the paths at peaks (Q,) of the map."""
        separate = self.doppler_method(known).separate
        return self.estimator.at_peaks(spectra, known, power, rows, columns, separate=separate)

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        """Compute the range-Doppler map, apply CFAR, and estimate a path at each peak."""
        doppler_method = self.doppler_method(known)
        power = doppler_method.power(spectra, known)
        above, level = self.rule(known).detect(power)
        above[: first_row(self.settings, known.range_cell)] = False
        sparse, recovered = None, None
        if doppler_method.advises:
            added = len(known.schedule) if doppler_method.separate else 1
            noise = float(np.median(power)) * added / window_gain(known)
            rows = np.flatnonzero(above.any(axis=1))
            sparse, recovered = advise(spectra, rows, noise, known)
        above = doppler_method.keep(above, Levels(power, level, recovered), known)
        rows, bins = strongest_peaks(power, above, self.settings, UNION_FLOOR)
        estimates = self.estimates(spectra, known, power, rows, bins)
        snr = power[rows, bins] / level[rows, bins]
        detections = describe(estimates, snr, known, on_grid=self.estimator.on_grid)
        return Sensed(estimates, detections, power, level, sparse)


def doppler_of(known: Known) -> LatinUnion:
    """Choose the Doppler processing of a schedule: bands if all antennas send at once; the union if
    it samples each antenna in each slot; each antenna's DFT for equally spaced chirps; else OMP."""
    if known.full:
        return Banded() if known.waveform.bands > 1 else LatinUnion()
    schedule, num_tx = known.schedule, known.waveform.num_tx
    equally = (schedule[:, num_tx:] == schedule[:, :-num_tx]).all()
    return Conventional() if equally else Omp()


def window_gain(known: Known) -> float:
    """Return the noise power of a map's cell over that of the spectra: the sum of the squared
    window over an antenna's chirps."""
    w = known.waveform
    return float((slow_window(w) ** 2).sum()) * len(known.schedule) / w.num_tx


def measure_channels(
    spectra: np.ndarray, known: Known, estimates: Sequence[Estimate], snr: np.ndarray
) -> tuple[PathChannels, ...]:
    """Return the channels measured by the `MAX_PATHS` strongest paths."""
    out = []
    for i in np.argsort(snr)[::-1][:MAX_PATHS]:
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
    """Convert estimates to ranges, velocities and direction cosines, NaN outside the field of view.
    `on_grid`: directions on a grid too, eight per beam.

    A detection in which other waves have more than `mixed` of its power, such as a wall, updates
    tracks but starts none."""
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
    """Return the mean power (N, P) over the receivers by range cell and chirp of the first group,
    before data removal."""
    total = np.zeros((cube.samples.shape[3], cube.samples.shape[2]), np.float32)
    for group in cube.samples[0]:
        spectrum = scipy.fft.fft(group, axis=1, workers=1)
        total += (spectrum.real**2 + spectrum.imag**2).T
    return total / cube.samples.shape[1]


def make_maps(power: np.ndarray, cube: IFCube, settings: Receivers, passes: int) -> Maps:
    """Return the maps with their axes; the range axis omits range-Doppler coupling (under a
    cell)."""
    w, before = cube.waveform, equivalent_range_power(cube)
    rule = CfarRule.of(settings, cube.samples.shape[1])
    return Maps(
        range_doppler=power.astype(np.float32),
        range_axis=np.arange(power.shape[0]) * w.range_cell(passes),
        velocity_axis=doppler_bins(w) * w.velocity_cell(passes),
        equivalent_range=np.sqrt(before),
        equivalent_detections=rule.detect_chirps(before),
    )
