"""Orthogonal matching pursuit off the grid: paths are estimated in sequence, each subtracted before
the next is sought.

The dictionary is not the Doppler grid but every path that the frame can hold: range, velocity and
migration by maximum likelihood, an amplitude for each channel, and each element's delay. A strong
path then takes one atom, not several, and leaves its row to the weaker ones; the sidelobes of
sparse sampling go with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from isac_rt.kernels import receive_estimate
from isac_rt.kernels.jit import twin_of
from isac_rt.receive.arms import element_delays
from isac_rt.receive.cfar import CfarRule, first_row, hann_envelope, peaks, without_sidelobes
from isac_rt.receive.estimate import (
    STENCILS,
    Estimate,
    LocalSpectra,
    direction_cosines,
    refine,
    start_point,
)
from isac_rt.receive.known import Known
from isac_rt.receive.maps import (
    LATIN_UNION,
    UNION_FLOOR,
    LatinUnion,
    power_map,
)
from isac_rt.receive.omp import Omp, sparse_enough
from isac_rt.receive.sense import Cfar, Sensed, describe, doppler_of, window_gain
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import NO_HINTS, Hints

FARTHEST_REACH = 24
"""Range rows on each side in which the strongest paths are taken out; Hann's lobes are 90 dB down
there."""
LEAST, MIN_INFLUENCE = 0.01, 0.1
"""Of the noise in a cell: what a path leaves in it below the first is not taken out, and below the
second not felt by another path."""
CYCLES, SETTLED, SETTLED_STD = 6, 2e-3, 0.25
"""Most times that the paths which a new one touches are estimated again, each with the others taken
out, and the move that ends it, in cells and bins and in deviations."""
RESIDUAL_DB = 35.0
"""What is this far under a path found before, within `NEAR` rows and bins of it, is what its
removal left."""
NEAR = (3, 4)
STRONG_DB, STRONG_ROUNDS = 25.0, 3
"""Paths so far over the noise of a cell hide others far about them and are taken out first, in at
most so many rounds."""
CLOSE = STENCILS[1:]
"""Of the estimates after the first."""


@dataclass(frozen=True)
class Pursuit(Cfar):
    """CFAR on the residual of the paths found before."""

    doppler: LatinUnion | None = LATIN_UNION

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        paths, snr, power = pursue(spectra, known, self.settings)
        above, level = self.rule(known).detect(power)
        sparse = None
        if not known.full:
            noise = float(np.median(power)) / window_gain(known)
            sparse = sparse_enough(spectra, np.flatnonzero(above.any(axis=1)), noise, known)
        return Sensed(paths, describe(paths, snr, known), power, level, sparse)


@dataclass(frozen=True)
class BySchedule(Cfar):
    """CFAR with the Doppler processing of the schedule, and `Pursuit` for sparse sampling of slow
    time, whose sidelobes lie at all velocities; on the grid the paper's OMP."""

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        if isinstance(doppler_of(known), Omp) and not self.estimator.on_grid:
            return Pursuit(self.settings, self.estimator).sense(spectra, known, hints)
        return super().sense(spectra, known, hints)


@dataclass
class _Path:
    """A found path: its estimate, its power on the map, the rows [first, last) from which it is
    subtracted, and the elements' delays [cells]."""

    estimate: Estimate
    power: float
    snr: float
    rows: tuple[int, int] = (0, 0)
    sent: np.ndarray = field(default_factory=lambda: np.zeros(0))
    received: np.ndarray = field(default_factory=lambda: np.zeros(0))


def pursue(
    spectra: np.ndarray, known: Known, settings: Receivers
) -> tuple[list[Estimate], np.ndarray, np.ndarray]:
    """Paths of a frame from cleaned spectra, their SNR on the map in which they were found, and the
    map (rows, P) before anything was taken out.

    In each round the peaks that are no sidelobes of stronger ones are estimated and taken out, the
    strongest first. Then they and the paths that they touch are estimated again, each with the
    others out: the orthogonal step. A map is made once a round, and a path costs by those that it
    touches and not by all.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) from `clean_spectrum`; not changed
    """
    left, floor = spectra.copy(), sidelobe_floor(known)
    rule, first = CfarRule.of(settings, known.channels), first_row(settings, known.range_cell)
    power = power_map(left, known)
    whole = power.copy()
    noise = max(float(np.median(power)), 1e-30)
    masked = np.zeros(power.shape)  # power under which a cell holds a remainder
    paths: list[_Path] = []
    while len(paths) < settings.max_detections:
        above, level = rule.detect(power)
        above[:first] = False
        above &= power > masked
        rows, bins = peaks(power, above, (1, 1))
        keep = without_sidelobes(rows, bins, power, power.shape[1], floor)
        rows, bins = (i[keep][: settings.max_detections - len(paths)] for i in (rows, bins))
        if not rows.size:
            break
        changed = _find(left, power, level, (rows, bins), paths, masked, known, noise)
        if len(paths) < settings.max_detections:
            _map_again(power, left, changed, known)
    return [f.estimate for f in paths], np.array([f.snr for f in paths]), whole


class StrongPaths(NamedTuple):
    """Strong paths of a frame, and the power without them.

    Attributes
    ----------
    paths : list of Estimate
    snr : of each, on the map in which it was found
    whole : (rows, P) power before subtraction
    power : (rows, P) of what is left
    """

    paths: list[Estimate]
    snr: np.ndarray
    whole: np.ndarray
    power: np.ndarray


def extract_strong(spectra: np.ndarray, known: Known, settings: Receivers) -> StrongPaths:
    """Subtract the paths at least `STRONG_DB` over the noise; parameters as for `pursue`."""
    left, floor = spectra.copy(), sidelobe_floor(known)
    whole = known.mapped(spectra, lambda: power_map(spectra, known))
    power = whole.copy()
    noise = max(float(np.median(power)), 1e-30)
    masked, level = np.zeros(power.shape), np.full(power.shape, noise)
    extracted: list[_Path] = []
    for _ in range(STRONG_ROUNDS):
        above = power > np.maximum(noise * 10 ** (STRONG_DB / 10), masked)
        rows, bins = peaks(power, above, (1, 1))
        keep = without_sidelobes(rows, bins, power, power.shape[1], floor)
        rows, bins = (i[keep][: settings.max_detections - len(extracted)] for i in (rows, bins))
        if not rows.size:
            break
        changed = _find(left, power, level, (rows, bins), extracted, masked, known, noise)
        _map_again(power, left, changed, known)
    paths, snr = [f.estimate for f in extracted], np.array([f.snr for f in extracted])
    return StrongPaths(paths, snr, whole, power)


def _find(
    left: np.ndarray,
    power: np.ndarray,
    level: np.ndarray,
    cells: tuple[np.ndarray, np.ndarray],
    paths: list[_Path],
    masked: np.ndarray,
    known: Known,
    noise: float,
) -> np.ndarray:
    """Estimate the paths at some peaks of the map of what is `left`, take them out, and estimate
    again what they touch; in place. (rows,) bool, which rows that changes."""
    new, changed = [], np.zeros(left.shape[2], bool)
    for row, column in zip(cells[0].tolist(), cells[1].tolist(), strict=True):
        peak = float(power[row, column])
        local = LocalSpectra(left, known, row)
        estimate = refine(local, *start_point(power, row, column, known.waveform))
        new.append(_Path(estimate, peak, peak / float(level[row, column])))
        _subtract(left, new[-1], known, noise)
        _mark(masked, row, column, peak)
        changed[slice(*new[-1].rows)] = True
    paths += new
    _fit_again(left, paths, len(new), known, noise, changed)
    return changed


def _map_again(power: np.ndarray, left: np.ndarray, changed: np.ndarray, known: Known) -> None:
    """Recompute the rows of the map with subtracted paths, in place."""
    power[changed] = power_map(left[:, :, changed], known)


def sidelobe_floor(known: Known) -> float:
    """Share of a path's power that its removal by the Doppler transform alone may leave in any bin
    of its row: the resampling's, or in a sparse sampling the highest sidelobes of antennas' random
    slots, ln P / S with S chirps each, as far as they agree."""
    if known.full:
        return UNION_FLOOR
    least = min(int(sent.sum()) for sent in known.sent_by)
    return float(np.log(known.waveform.num_chirps) / least)


def _mark(masked: np.ndarray, row: int, column: int, peak: float) -> None:
    """Raise, in place, the power about a peak below which a cell holds its residual."""
    rows = np.arange(max(row - NEAR[0], 0), min(row + NEAR[0] + 1, len(masked)))
    columns = (np.arange(-NEAR[1], NEAR[1] + 1) + column) % masked.shape[1]
    block = np.ix_(rows, columns)
    masked[block] = np.maximum(masked[block], peak * 10 ** (-RESIDUAL_DB / 10))


def _fit_again(
    spectra: np.ndarray,
    paths: list[_Path],
    count: int,
    known: Known,
    noise: float,
    changed: np.ndarray,
) -> None:
    """Estimate the last `count` paths and those that they touch once more, each with the others
    taken out; in place, and mark the rows that are `changed`. A path that nothing touches stays as
    it is."""
    w = known.waveform
    power = np.array([f.power for f in paths])
    rate = 1 / (w.frame_duration * w.effective_carrier)
    cells = np.array(
        [
            [w.beat_cells(f.estimate.delay, f.estimate.delay_rate).mean() for f in paths],
            [f.estimate.delay_rate / rate for f in paths],
        ]
    )
    rows, bins = np.abs(cells[:, :, None] - cells[:, None, :])
    bins = np.minimum(bins % w.num_chirps, -bins % w.num_chirps)
    lobes = hann_envelope(np.maximum(rows - 1, 0)) * (
        hann_envelope(np.maximum(bins - 1, 0)) + sidelobe_floor(known)
    )
    touches = np.minimum(power[:, None], power) * lobes > MIN_INFLUENCE * noise
    np.fill_diagonal(touches, False)
    fresh = np.arange(len(paths)) >= len(paths) - count
    near = np.flatnonzero((touches & (fresh | fresh[:, None])).any(axis=1))
    for cycle in range(CYCLES):
        moved = []
        for k in near:
            path, before = paths[k], paths[k].estimate
            _add(spectra, path, known, 1.0)
            changed[slice(*path.rows)] = True
            row = min(max(round(float(cells[0, k])), 0), spectra.shape[2] - 1)
            local = LocalSpectra(spectra, known, row)
            path.estimate = refine(local, before.delay, before.delay_rate, CLOSE)
            if cycle == 0:
                _subtract(spectra, path, known, noise)
                changed[slice(*path.rows)] = True
            else:  # where it comes from it does not change any more
                _add(spectra, path, known, -1.0)
            move = np.array(
                [
                    (path.estimate.delay - before.delay) / w.delay_step,
                    (path.estimate.delay_rate - before.delay_rate) / rate,
                ]
            )
            deviation = 0.55 / np.sqrt(path.snr * known.channels)
            moved.append(np.abs(move).max() > max(SETTLED, SETTLED_STD * deviation))
        near = near[moved]


def lobes_over(power: float) -> int:
    """Return the rows on each side in which Hann's lobes, 1 / (pi d^3)^2 of a peak of such a power,
    are above 1; a row for migration."""
    lobe = (max(power, 1.0) / np.pi**2) ** (1 / 6)
    return int(min(np.ceil(lobe) + 3, FARTHEST_REACH))


def _subtract(spectra: np.ndarray, path: _Path, known: Known, noise: float) -> None:
    """Subtract a path in place from its rows, with the template of `LocalSpectra` and each
    element's own delay."""
    w, e = known.waveform, path.estimate
    middle = round(float(w.beat_cells(e.delay, e.delay_rate).mean()))
    reach = lobes_over(path.power / (LEAST * noise))
    path.rows = max(middle - reach, 0), min(middle + reach + 1, spectra.shape[2])
    direction = np.nan_to_num(direction_cosines(e, known))
    path.received, path.sent = (
        element_delays(positions, direction, known.radius(e.delay))[0] / w.delay_step
        for positions in (known.antennas.rx_positions, known.antennas.tx_positions)
    )
    path.sent = path.sent * (known.passes == 2)
    _add(spectra, path, known, -1.0)


def _add(spectra: np.ndarray, path: _Path, known: Known, sign: float) -> None:
    """Add a path times `sign` to its rows, in place."""
    w, e = known.waveform, path.estimate
    cycles = w.phase(e.delay + e.delay_rate * known.times, w.window_middle)
    add_template(
        spectra,
        path.rows,
        sign * e.channels,
        np.array(known.schedule, order="C"),
        w.beat_cells(e.delay, e.delay_rate, known.times),
        np.exp(2j * np.pi * cycles),
        path.sent,
        path.received,
        (float(w.window_length), float(w.num_samples)),
    )


@twin_of(receive_estimate.add_template)
def add_template(
    spectra: np.ndarray,
    rows: tuple[int, int],
    channels: np.ndarray,
    schedule: np.ndarray,
    beat: np.ndarray,
    phasor: np.ndarray,
    sent: np.ndarray,
    received: np.ndarray,
    window: tuple[float, float],
) -> None:
    """Add a path's template in place.

    spectra[m, rx, i, p] += channels[tx, rx] phasor[m, p] h(beat + sent + received - i) exp(-j pi i
    length / size), tx the antenna of the chirp, for i in [*rows), h the transform of the window
    (`hann_response`) of `window` length and size [samples].
    """
    length, size = window
    row, share = np.arange(*rows)[:, None], length / size
    back = np.exp(-1j * np.pi * share * row)
    for rx in range(spectra.shape[1]):
        beats = (beat + sent[schedule] + received[rx])[:, None]
        d = (beats - row) * share
        hole = np.abs(np.abs(d) - 1) < 1e-6
        safe = np.where(hole, 0.5, d)
        shape = length / 2 * np.where(hole, 0.5, np.sinc(safe) / (1 - safe**2))
        factor = channels[schedule, rx] * phasor
        spectra[:, rx, rows[0] : rows[1]] += factor[:, None] * back * shape
