"""From cleaned spectra to detections: what the active and the passive terminal do alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.fft

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, RangeProfiles
from isac_rt.frame.schedule import Schedule, is_latin
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.cfar import CfarRule, first_row, strongest_peaks
from isac_rt.receive.estimate import (
    Estimate,
    LocalSpectra,
    direction_cosines,
    refine,
    standard_deviations,
    start_point,
    to_delay,
)
from isac_rt.receive.maps import (
    UNION_FLOOR,
    conventional_power,
    doppler_bins,
    own_bins,
    power_map,
    slow_window,
)
from isac_rt.receive.omp import omp_power, sparse_enough
from isac_rt.receive.pursuit import pursue
from isac_rt.receive.types import Detections, Maps
from isac_rt.scenario.receivers import Receivers

OMP_SPARSITY = 4


@dataclass(frozen=True)
class Sensed:
    """Detections of a frame with their estimates, strongest first, the map that they came from and
    its background (`CfarRule.detect`). `sparse`: see `Reception`."""

    estimates: list[Estimate]
    detections: Detections
    power: np.ndarray
    level: np.ndarray
    sparse: bool | None = None


def velocity_method(
    settings: Receivers, schedule: Schedule, num_tx: int
) -> Literal["omp", "pursuit", "latin_union", "conventional"]:
    """`auto`: the union where it samples every antenna in every slot; else each antenna's own DFT
    where its chirps are equally spaced, as in a conventional schedule; OMP elsewhere."""
    if settings.velocity_method != "auto":
        return settings.velocity_method
    if is_latin(schedule, num_tx) and len(schedule) == num_tx:
        return "latin_union"
    return "conventional" if (schedule[:, num_tx:] == schedule[:, :-num_tx]).all() else "omp"


def num_looks(settings: Receivers, schedule: Schedule, antennas: Antennas) -> int:
    """Channels whose powers are added in the map."""
    groups = (
        len(schedule)
        if velocity_method(settings, schedule, antennas.num_tx) == "conventional"
        else 1
    )
    return groups * antennas.num_tx * antennas.num_rx


def sense(
    spectra: np.ndarray,
    waveform: Waveform,
    schedule: Schedule,
    delay_symbols: np.ndarray,
    antennas: Antennas,
    settings: Receivers,
    passes: int,
) -> Sensed:
    """Range-Doppler map, CFAR, peaks, and an off-grid estimate of each, from spectra whose
    `delay_symbols` were removed."""
    w, method = waveform, velocity_method(settings, schedule, waveform.num_tx)
    rule = CfarRule.of(settings, num_looks(settings, schedule, antennas))
    if method == "pursuit":
        paths, ratio, power = pursue(
            spectra, w, schedule, delay_symbols, antennas, settings, passes
        )
        return Sensed(
            paths, describe(paths, ratio, antennas, w, passes), power, rule.detect(power)[1]
        )
    conventional = method == "conventional"
    if conventional:
        power = conventional_power(spectra, w, schedule)
    else:
        power = power_map(spectra, w, schedule, delay_symbols)
    above, level = rule.detect(power)
    above[: first_row(settings, w.range_cell(passes))] = False
    sparse = None
    if method in ("omp", "conventional"):
        added = len(schedule) if conventional else 1  # groups in power, there
        noise = float(np.median(power)) * added / window_gain(w, schedule)
        sparse = sparse_enough(spectra, np.flatnonzero(above.any(axis=1)), noise, w, schedule)
    if conventional:
        above[:, ~own_bins(w)] = False
    elif method == "omp":
        above &= _confirmed_by_omp(spectra, above, level, w, schedule)
    rows, bins = strongest_peaks(power, above, settings, UNION_FLOOR)
    estimates = []
    for row, column in zip(rows, bins, strict=True):
        local = LocalSpectra(spectra, w, schedule, delay_symbols, int(row), separate=conventional)
        estimates.append(estimate_at(local, power, int(row), int(column), settings))
    snr = power[rows, bins] / level[rows, bins]
    found = describe(estimates, snr, antennas, w, passes, on_grid=settings.refinement == "grid")
    return Sensed(estimates, found, power, level, sparse)


def window_gain(waveform: Waveform, schedule: Schedule) -> float:
    """Noise power of a map's cell over that of a sample of the spectra: the squared window over an
    antenna's chirps."""
    return float((slow_window(waveform) ** 2).sum()) * len(schedule) / waveform.num_tx


def _confirmed_by_omp(
    spectra: np.ndarray,
    above: np.ndarray,
    level: np.ndarray,
    waveform: Waveform,
    schedule: Schedule,
) -> np.ndarray:
    """Cells of rows with a detection that OMP's support keeps: the sparse sampling's sidelobes fall
    away.

    A cell stays if OMP's accumulated power there, compared with the correlation's, is above the
    background. A path some 20 dB below another one of its row is lost: off the grid the stronger
    one takes several of the few atoms.
    """
    rows = np.flatnonzero(above.any(axis=1))
    out = np.zeros_like(above)
    if rows.size:
        found = omp_power(spectra, rows, waveform, schedule, OMP_SPARSITY)
        # the united correlation adds P/L_tx * groups chirps coherently with Hann's mean of 1/2, OMP
        # one group's
        gain = (len(schedule) / 2) ** 2
        out[rows] = found * gain > level[rows]
    return out


def estimate_at(
    local: LocalSpectra, power: np.ndarray, row: int, column: int, settings: Receivers
) -> Estimate:
    """The estimate of a peak of the map: off the grid, or with `refinement: grid` the centre of its
    cell."""
    w = local.waveform
    if settings.refinement == "grid":
        delay, rate = to_delay(row, column - w.num_chirps // 2, w)
        return Estimate(delay, rate, local.respond(delay, rate))
    return refine(local, *start_point(power, row, column, w))


def describe(
    estimates: list[Estimate],
    snr: np.ndarray,
    antennas: Antennas,
    waveform: Waveform,
    passes: int,
    *,
    on_grid: bool = False,
) -> Detections:
    """Detections in ranges, velocities and direction cosines; what lies outside the field of view
    has no direction. `on_grid`: of the directions too the nearest grid point, eight to a beam."""
    count = len(estimates)
    direction, std = np.full((count, 2), np.nan), np.zeros((count, 4))
    limit = antennas.view_limit
    for i, e in enumerate(estimates):
        u = direction_cosines(e, antennas, waveform, passes, on_grid=on_grid)
        direction[i] = [v if abs(v) <= limit else np.nan for v in u]
        std[i] = standard_deviations(snr[i] * e.channels.size, antennas, waveform, passes)
    return Detections(
        range=np.array([e.delay for e in estimates]) * (SPEED_OF_LIGHT / passes),
        velocity=np.array([e.delay_rate for e in estimates]) * (SPEED_OF_LIGHT / passes),
        direction=direction,
        snr=np.asarray(snr, float),
        std=std,
        is_reference=np.zeros(count, bool),
    )


def equivalent_range_power(cube: IFCube) -> np.ndarray:
    """(N, P) mean power over the receivers, over range cell and chirp of the first group, before
    any data are removed."""
    total = np.zeros((cube.samples.shape[3], cube.samples.shape[2]), np.float32)
    for one in cube.samples[0]:
        spectrum = scipy.fft.fft(one, axis=1, workers=1)
        total += (spectrum.real**2 + spectrum.imag**2).T
    return total / cube.samples.shape[1]


def make_maps(
    power: np.ndarray, cube: IFCube | RangeProfiles, settings: Receivers, passes: int
) -> Maps:
    """Maps with their axes; the range axis ignores the range-Doppler coupling (under a cell)."""
    w, before, looks = cube.waveform, np.zeros((0, 0)), 1
    if isinstance(cube, IFCube):
        before, looks = equivalent_range_power(cube), cube.samples.shape[1]
    rule = CfarRule.of(settings, looks)
    return Maps(
        range_doppler=power.astype(np.float32),
        range_axis=np.arange(power.shape[0]) * w.range_cell(passes),
        velocity_axis=doppler_bins(w) * w.velocity_cell(passes),
        equivalent_range=np.sqrt(before),
        equivalent_detections=rule.detect_chirps(before) if before.size else before > 0,
    )
