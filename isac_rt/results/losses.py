"""Why a UAV in view was found or not: one cause for each frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from scipy.linalg import orth
from scipy.special import chndtr

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import Transmission
from isac_rt.frame.schedule import is_latin
from isac_rt.frame.waveform import MAIN_LOBE, Waveform
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.receive.cfar import STRONG, CfarRule, hann_envelope
from isac_rt.receive.maps import UNION_FLOOR
from isac_rt.receive.settings import Receivers
from isac_rt.results.labels import MapPositions, hann_response
from isac_rt.world.swarm import Pose

MATCHED_DB = 13.0
"""SNR under which a coherent matched filter is taken to see nothing: with 13.1 dB it finds a steady
target nine times in ten at 1e-6 false alarms (Albersheim)."""
HOPELESS, CERTAIN = 0.1, 0.99
"""Probabilities of detection in noise alone: under the first a target is noise to the detector,
over the second chance does not explain that it was missed."""
SIDELOBE_MARGIN = 4.0
"""Peaks within this factor of a stronger path's sidelobes are taken for them
(`cfar.without_sidelobes`)."""
HANN_LOSS = 1.5
"""Noise bandwidth of a Hann window in cells."""


class Loss(IntEnum):
    """Outcome of a UAV in view in one frame; of several that hold, the first."""

    FOUND = 0  # by its own path, within one resolution on all four axes
    TOO_WEAK = 1  # for a matched filter that is coherent over samples, chirps and antennas
    ERASED = 2  # a PT did not read the data, or misread them, and had nothing clean to look at
    INACCURATE = 3  # detected by its own path, but farther off than one resolution
    NOISE = 4  # to a detector that adds the channels' powers
    MASKED = 5  # by a stronger line of sight, mirror image, leakage, or another UAV's echo
    CLUTTER = (
        6  # its cell holds more clutter than noise, those around it raise their background, or
    )
    # it was taken for a wall
    THRESHOLD = 7  # missed by chance: its probability of detection is not near 1
    OTHER = 8  # none of these


LOSSES = tuple(loss.name.lower() for loss in Loss)


@dataclass(frozen=True)
class Sensitivity:
    """Response of a link's frame to a path of unit power (|gain|^2).

    Attributes
    ----------
    matched : SNR of a matched filter that is coherent over all samples, chirps and antennas
    cell : SNR in the cell of one channel of a Hann-windowed range-Doppler map
    rule : by which a cell of that map stands out of those around it
    beam_rate : false alarms in a cell of a detector that adds the channels in phase, None: this one
        adds their powers
    """

    matched: float
    cell: float
    rule: CfarRule
    beam_rate: float | None = None

    @classmethod
    def of(
        cls,
        waveform: Waveform,
        antennas: Antennas,
        settings: Receivers,
        sent: Transmission,
        noise_power: float,
        groups: int,
        own: bool = False,
    ) -> Sensitivity:
        """Return the sensitivity by the link budget for a frame and the number of groups that the
        receiver reads; `own`: it receives its own chirps."""
        groups = groups * sent.num_streams
        w, chirps = waveform, groups * waveform.num_chirps
        sample = sent.amplitude**2 / noise_power
        united = sent.codes is not None or (
            groups == w.num_tx and is_latin(sent.schedule, w.num_tx)
        )
        united = united and settings.velocity_method != "conventional"
        looks = antennas.num_tx * antennas.num_rx * (1 if united else groups)
        per_look = chirps * antennas.num_rx / looks
        return cls(
            sample * w.num_samples * chirps * antennas.num_rx,
            sample * w.window_length * per_look / HANN_LOSS**2,
            CfarRule.of(settings, looks),
            settings.false_alarm_rates[0] if settings.looks_by_beam(own) else None,
        )

    def detection_probability(self, snr: float, background: float = 0.0) -> float:
        """Return the detection probability of a steady path with this SNR in its cell, in noise and
        a background of `background` times its power in the cells around."""
        degrees, threshold = 2 * self.rule.looks, self.rule.threshold * (1 + background)
        return float(1 - chndtr(degrees * threshold, degrees, degrees * snr))

    def clutter_free(self, snr: float) -> float:
        """Probability that this detector would find a steady path with this SNR in a channel's cell
        if there were noise alone."""
        if self.beam_rate is None:
            return self.detection_probability(snr)
        return coherent_detection(snr * self.rule.looks, self.beam_rate)

    def whitened(self, snr: float) -> float:
        """Probability that one test of the whitened channels of a cell finds a steady path, from
        its SNR there."""
        return coherent_detection(snr, self.rule.rate if self.beam_rate is None else self.beam_rate)

    def genie(self, snr: float) -> float:
        """Probability that a matched filter at a path's true delay, Doppler and direction finds it,
        from its coherent SNR; its false alarms are those of a cell."""
        return coherent_detection(snr, self.rule.rate)


def coherent_detection(snr: float, rate: float) -> float:
    """Probability of detection of a steady path by one coherent test with a rate of false
    alarms."""
    return float(1 - chndtr(-2 * np.log(rate), 2, 2 * snr))


class Channels(NamedTuple):
    """Channels of a link: arrays, wavenumber [1/m], and poses of transmitter and receiver."""

    antennas: Antennas
    wavenumber: float
    tx: Pose
    rx: Pose

    def steering(self, paths: PathSet, rows: np.ndarray) -> np.ndarray:
        """(n, L) phases of some paths over the channels, as plane waves."""
        tx = self.tx.to_body(paths.departure[rows]) @ self.antennas.tx_positions.T
        rx = self.rx.to_body(paths.arrival[rows]) @ self.antennas.rx_positions.T
        length = (tx[:, :, None] + rx[:, None]).reshape(len(rows), tx.shape[1] * rx.shape[1])
        return np.exp(1j * self.wavenumber * length)


@dataclass(frozen=True)
class Chance:
    """Level of one UAV's own path in a frame, over the noise.

    Attributes
    ----------
    matched : SNR of the coherent matched filter
    cell : SNR in its cell of one channel's map
    channels : SNR in its cell, all channels in phase
    straddling : share of its power that is left where it lies between cells
    whitened : SNR in its cell, channels whitened by the city's paths in it, and the line of sight
        taken out
    clutter : power of the diffuse paths in that cell
    background : what other paths add to the mean of the cells around it
    masked : a stronger path covers it
    """

    matched: float
    cell: float
    channels: float
    straddling: float
    whitened: float
    clutter: float
    background: float
    masked: bool

    @classmethod
    def of(
        cls,
        own: int,
        paths: PathSet,
        positions: MapPositions,
        waveform: Waveform,
        sees: Sensitivity,
        channels: Channels,
    ) -> Chance:
        """Return the chance of path number `own`."""
        w, power = waveform, paths.power
        half = w.frame_duration / 2
        life = max(min(paths.end[own], half) - max(paths.begin[own], -half), 0.0) / (2 * half)
        beat = float(w.beat_cells(paths.delay[own], paths.delay_rate[own], 0.0))
        doppler = positions.velocity[own] / positions.cells[1]
        off = np.array([beat - round(beat), doppler - round(doppler)])
        off_grid = float(np.prod(hann_response(off)))
        centre = np.array([positions.range[own], positions.velocity[own]]) - off * positions.cells
        mine = power[own]
        diffuse = paths.kind == PathKind.DIFFUSE
        clutter, background, masked = _around(own, positions, power, diffuse, mine * off_grid, sees)
        cell = float(sees.cell * life**2 * mine * off_grid)
        every = cell * sees.rule.looks
        return cls(
            float(sees.matched * life * mine),
            cell,
            every,
            off_grid,
            every
            * _whitened_share(own, centre, paths, positions, sees, channels)
            * _beside_sight(own, paths, w, channels),
            sees.cell * clutter,
            background,
            masked,
        )


def _whitened_share(
    own: int,
    centre: np.ndarray,
    paths: PathSet,
    positions: MapPositions,
    sees: Sensitivity,
    channels: Channels,
) -> float:
    """Return the share of a path's SNR over the channels of its cell that whitening leaves:
    a^H R^-1 a / a^H a, with its phases a and the covariance R of unit noise and the city's paths.

    The city's paths are those whose main lobe holds the cell, of true power and directions and
    independent phases.

    Parameters
    ----------
    own : row of the path
    centre : range and velocity of the middle of its cell
    """
    city = (paths.kind == PathKind.DIFFUSE) | (paths.kind == PathKind.SPECULAR)
    near = np.abs(positions.range - centre[0]) < MAIN_LOBE * positions.cells[0]
    rows = np.flatnonzero(city & near)
    beside = positions._replace(range=positions.range[rows], velocity=positions.velocity[rows])
    row, column = beside.distances(*centre)
    rows, row, column = (values[column < MAIN_LOBE] for values in (rows, row, column))
    if not len(rows):
        return 1.0
    mine = channels.steering(paths, np.array([own]))[0]
    groups = sees.rule.looks / len(mine)
    power = groups * sees.cell * paths.power[rows] * hann_response(row) * hann_response(column)
    clutter = channels.steering(paths, rows) * np.sqrt(power)[:, None]
    covariance = np.eye(len(mine)) + clutter.T @ clutter.conj()
    return float((mine.conj() @ np.linalg.solve(covariance, mine)).real / len(mine))


def _beside_sight(own: int, paths: PathSet, waveform: Waveform, channels: Channels) -> float:
    """Return the share of a path's energy that is left after the strongest line of sight, unless it
    is the path itself, has been fitted and subtracted with unknown amplitudes by transmit antenna,
    delay, delay rate and direction: 1 less the projection on it and on its four derivatives.

    A frame's samples fill delay, Doppler and receivers evenly, so that the inner products factor:
    over an axis of unit length a tone x cells off has sinc(x) along the constant and
    (sinc(x) - cos(pi x)) / (2 pi x) along the line j n, of norm 12^-1/2.
    """
    los_paths = np.flatnonzero(paths.kind == PathKind.LINE_OF_SIGHT)
    los = int(los_paths[np.argmax(paths.power[los_paths])]) if los_paths.size else own
    if los == own:
        return 1.0
    w = waveform
    both, middle = np.array([own, los]), np.zeros(1)
    beats = w.beat_cells(paths.delay[both, None], paths.delay_rate[both, None], middle)[:, 0]
    rate = paths.delay_rate[own] - paths.delay_rate[los]
    x = np.array(
        [
            (beats[0] - beats[1]) * w.window_length / w.num_samples,
            rate * w.effective_carrier * w.frame_duration,
        ]
    )
    flat = np.sinc(x)
    x = np.where(np.abs(x) < 1e-6, 1e-6, x)
    line = np.sqrt(12) * (np.sinc(x) - np.cos(np.pi * x)) / (2 * np.pi * x)
    u = channels.rx.to_body(paths.arrival[both])
    positions = channels.antennas.rx_positions
    constant = np.full((len(positions), 1), len(positions) ** -0.5)
    basis = np.hstack([constant, orth(positions - positions.mean(axis=0))])
    steering = np.exp(1j * channels.wavenumber * positions @ (u[0] - u[1])) * constant[:, 0]
    of_receivers = np.abs(basis.T @ steering) ** 2
    overlap = of_receivers.sum() * flat.prod() ** 2
    overlap += of_receivers[0] * ((line[0] * flat[1]) ** 2 + (flat[0] * line[1]) ** 2)
    return max(1.0 - float(overlap), 0.0)


def _around(
    own: int,
    positions: MapPositions,
    power: np.ndarray,
    diffuse: np.ndarray,
    in_cell: float,
    sees: Sensitivity,
) -> tuple[float, float, bool]:
    """Power of the clutter in a path's cell; what the other paths add to the greater of the means
    before and behind it, over the noise; and whether a stronger one covers it.

    Parameters
    ----------
    own : row of the path
    power : (K,) of all paths; what is over `STRONG` is kept out of the training
    in_cell : the path's power in its cell
    """
    guard, training = sees.rule.guard, sees.rule.training
    off = positions.range - positions.range[own]
    most = max(guard[0] + training[0] + 1, 2) * positions.cells[0]
    rows = np.flatnonzero(~diffuse | (np.abs(off) < most))
    off, level, field = off[rows], power[rows], diffuse[rows]
    near = positions._replace(range=positions.range[rows], velocity=positions.velocity[rows])
    row, column = near.distances(positions.range[own], positions.velocity[own])
    beside = field & (row < MAIN_LOBE) & (column < MAIN_LOBE)
    clutter = level[beside] @ (hann_response(row[beside]) * hann_response(column[beside]))
    strong = ~field & (level > power[own])
    lobes = hann_envelope(row[strong]) * (hann_envelope(column[strong]) + UNION_FLOOR)
    masked = (SIDELOBE_MARGIN * level[strong] * lobes >= in_cell).any()
    width = guard[1] + training[1] + 0.5
    along, snr = row - guard[0] - 0.5, sees.cell * level
    trained = (along > 0) & (along <= training[0]) & (column <= width) & (snr < STRONG)
    behind, before = snr[trained & (off > 0)].sum(), snr[trained & (off <= 0)].sum()
    mean = max(before, behind) * HANN_LOSS**2 / (training[0] * 2 * width)
    return float(clutter), float(mean), bool(masked)


def cause_of(
    hit: bool, own: bool, beside: np.ndarray, chance: Chance, sees: Sensitivity, read: bool
) -> Loss:
    """Return the outcome of a UAV in view in one frame.

    Parameters
    ----------
    hit : found by its own path within one resolution on all axes
    own : a detection is explained by its own path
    beside : kinds of the paths that explain the detections within a cell of it
    chance : what its path amounts to
    sees : the detector's sensitivity
    read : the frame held no data, or data that were read
    """
    likely = sees.detection_probability(chance.cell)
    causes = {
        Loss.FOUND: hit,
        Loss.TOO_WEAK: chance.matched < 10 ** (MATCHED_DB / 10),
        Loss.ERASED: not read,
        Loss.INACCURATE: own,
        Loss.NOISE: likely < HOPELESS,
        Loss.MASKED: chance.masked or bool(((beside >= 0) & (beside != PathKind.DIFFUSE)).any()),
        Loss.CLUTTER: chance.clutter > 1
        or sees.detection_probability(chance.cell, chance.background) < likely / 2
        or bool((beside == PathKind.DIFFUSE).any()),
        Loss.THRESHOLD: likely < CERTAIN,
    }
    return next((loss for loss, holds in causes.items() if holds), Loss.OTHER)
