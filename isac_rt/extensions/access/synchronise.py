r"""Two-round synchronisation: what a link measures in both directions tells its clock from its
range.

The transmitter's clock of round 1 (the active terminal's) is ahead or behind by delta(t) against
the passive terminal's and adds to the delay; in round 2 the same clocks add with the opposite sign
(signs of `Transmission.clock_offset`). With the path's delay tau(t), t counted from round 1,

.. math::

    y_1 = \tau + \delta,\ \dot y_1 = \dot\tau + \dot\delta,\qquad y_2 = \tau(t) - \delta(t),\ \dot
    y_2 = \dot\tau(t) - \dot\delta

A drift of 0.01 ppm is 3 m/s of apparent velocity, and a motion of 10 m/s between rounds 8 ms apart
is 0.08 m of apparent offset: both are solved for. The path's acceleration between the rounds
follows from the positions and velocities that both ends report.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import SPEED_OF_LIGHT, hann
from isac_rt.receive.estimate import (
    HALF_WIDTH,
    PULL,
    LocalSpectra,
    directions,
    excess,
    hann_response,
    refine,
)
from isac_rt.receive.known import Known
from isac_rt.receive.maps import slow_window
from isac_rt.receive.spectrum import cleaned
from isac_rt.receive.types import Detections
from isac_rt.world.swarm import Pose


@dataclass(frozen=True)
class Round:
    """The line of sight as one terminal of a link measured it in an unmodulated frame.

    Attributes
    ----------
    time : of the middle of the frame [s]
    forward : True when the active terminal sent, False when the passive one did
    range, velocity : apparent, clocks included [m, m/s]
    range_std, velocity_std : [m, m/s]
    """

    time: float
    forward: bool
    range: float
    velocity: float
    range_std: float
    velocity_std: float


@dataclass(frozen=True)
class ClockEstimate:
    """The active terminal's clock against the passive one's, and the path, at `time`.

    Attributes
    ----------
    time : of the first round [s]
    offset : [s]; adds to the delay from the active to the passive terminal
    drift : d offset/dt [1]
    range, velocity : of the path [m, m/s]
    covariance : (4, 4) of (offset, drift, range, velocity), in their units
    """

    time: float
    offset: float
    drift: float
    range: float
    velocity: float
    covariance: np.ndarray

    @property
    def offset_std(self) -> float:
        return float(np.sqrt(self.covariance[0, 0]))

    def offset_at(self, time: float) -> float:
        """Offset at another time [s]."""
        return self.offset + self.drift * (time - self.time)

    def offset_std_at(self, time: float) -> float:
        """Standard deviation of `offset_at` [s]."""
        row = np.array([1.0, time - self.time])
        return float(np.sqrt(row @ self.covariance[:2, :2] @ row))


EXTERNAL = ClockEstimate(
    time=0.0, offset=0.0, drift=0.0, range=np.nan, velocity=np.nan, covariance=np.zeros((4, 4))
)
"""Clocks that an external source keeps equal: nothing to estimate, stage 2 is left out."""


def line_of_sight(detections: Detections, cell: float) -> int | None:
    """Return the row of the strongest detection within a range cell [m] of the earliest sure one.

    One group alone samples an antenna's chirps so sparsely that a strong path leaves Doppler
    sidelobes at its own range, and one of these may seem earlier by less than a cell.
    """
    which = np.flatnonzero(detections.is_reference)
    if which.size == 0:
        return None
    near = np.abs(detections.range - detections.range[which[0]]) < cell
    return int(np.where(near, detections.snr, -np.inf).argmax())


def measured_alone(detections: Detections, cube: IFCube, antennas: Antennas) -> Detections:
    """Return the detections of an unmodulated frame with the line of sight measured once more, and
    its deviations as noise, other detections and what a single wave does not explain make them.

    The floors of `standard_deviations` stand for what is not known of other paths; around a line of
    sight they are known, but for those within two cells that no detector tells apart. A line of
    sight that is not a single wave stays as it is.
    """
    known = Known.unmodulated(cube.waveform, cube.schedule, antennas, 1)
    w, d = known.waveform, detections
    i = line_of_sight(d, w.range_cell(1))
    if i is None or not d.starts[i]:
        return d
    spectra, known = cleaned(cube, known)
    delay, rate = d.range / SPEED_OF_LIGHT, d.velocity / SPEED_OF_LIGHT
    beat = w.beat_cells(delay, rate, 0.0)
    row = min(max(round(float(beat[i])), 0), spectra.shape[2] - 1)
    found = refine(LocalSpectra(spectra, known, row), delay[i], rate[i])
    # what the sender's elements leave, whose delays are unknown: it appears at other velocities
    reach = np.linalg.norm(antennas.tx_positions, axis=1).max() / w.range_cell(1)
    own = (d.snr < (np.pi * reach) ** 2 * d.snr[i]) & (np.abs(beat - beat[i]) < 2)
    own[i] = True
    phase = known.wavenumber * (d.direction - d.direction[i]) @ antennas.rx_positions[:, [0, 2]].T
    beam = np.abs(np.exp(1j * np.nan_to_num(phase)).mean(axis=1)) ** 2
    waves = np.stack([d.snr / d.snr[i] * beam, beat - beat[i], rate - rate[i]], axis=1)[~own]
    snr = float((np.abs(found.channels) ** 2).mean()) / _noise(spectra, known)
    variance = _variances(known, snr, waves)
    at = found.channels[None], np.array([found.delay])
    others = excess(*at, directions(*at, known), d.snr[[i]], known)
    pull = PULL * others / (1 + others) * np.array([w.range_cell(1), w.velocity_cell(1)])
    distance, speed, std = d.range.copy(), d.velocity.copy(), d.std.copy()
    distance[i], speed[i] = found.delay * SPEED_OF_LIGHT, found.delay_rate * SPEED_OF_LIGHT
    std[i, :2] = np.hypot(SPEED_OF_LIGHT * np.sqrt(variance), pull)
    return replace(d, range=distance, velocity=speed, std=std)


def _noise(spectra: np.ndarray, known: Known) -> float:
    """Return the noise's power per sample: the median over the spectra is ln 2 of an exponential's
    mean, and the few rows of paths do not move it."""
    w, median = known.waveform, float(np.median(spectra.real**2 + spectra.imag**2))
    window = hann(np.arange(w.num_samples), w.window_length)
    return median / (np.log(2) * float((window**2).sum()))


def _variances(known: Known, snr: float, waves: np.ndarray) -> np.ndarray:
    r"""Return the variances (2,) of delay and delay rate of the `refine` estimate of one path.

    A phase slope x about its weighted mean errs by :math:`\sum W x\, \mathrm{Im}\, n / \sum W x^2`.
    For white noise W is the square of the range window, which data and template have both, times
    the slow-time window. Each transmit antenna has a phase of its own, so that slow time counts
    about its own mean. Other waves have another phase at each, and are matched in the rows of
    `LocalSpectra` alone.

    Parameters
    ----------
    snr : of a sample
    waves : (K, 3) power over the path's, beat and delay rate from it [1, cells, 1]
    """
    w, sent = known.waveform, known.schedule
    fast = hann(np.arange(w.num_samples), w.window_length) ** 2
    slow = np.broadcast_to(slow_window(w), sent.shape).astype(float)
    ramp = 2 * np.pi * w.slope * w.sample_interval * np.arange(w.num_samples)
    ramp -= np.average(ramp, weights=fast)
    phase = 2 * np.pi * w.effective_carrier * known.times
    each = [sent == antenna for antenna in np.unique(sent)]
    for mine in each:
        phase[mine] -= np.average(phase[mine], weights=slow[mine])
    size, curve = slow.sum(), (slow * phase**2).sum()

    delay = ((fast * ramp) ** 2).sum() / (fast * ramp**2).sum() ** 2 * (slow**2).sum() / size**2
    rate = (fast**2).sum() / fast.sum() ** 2 * ((slow * phase) ** 2).sum() / curve**2
    out = np.array([delay, rate]) / (snr * known.antennas.num_rx)
    rows, step = np.arange(-HALF_WIDTH, HALF_WIDTH + 1), 1e-3
    here = hann_response(w, rows)
    slope = (hann_response(w, rows + step) - hann_response(w, rows - step)) / (2 * step)
    slope /= w.delay_step
    for power, cells, faster in waves:
        other, wave = hann_response(w, rows - cells), slow * np.exp(1j * phase * faster)
        late, quick = (sum(abs(x[m].sum()) ** 2 for m in each) for x in (wave, phase * wave))
        delay = (slope @ other / (slope @ slope) / size) ** 2 * late
        out += power * np.array([delay, (here @ other / (here @ here) / curve) ** 2 * quick])
    return out / 2


def round_of(
    detections: Detections, time: float, forward: bool, *, cell: float, held: float = 0.0
) -> Round | None:
    """The line of sight of a reception as a round (`line_of_sight`).

    Parameters
    ----------
    detections : of an unmodulated frame
    time : of its middle [s]
    forward : whether the active terminal sent
    cell : size of a range cell [m]
    held : how much later than its clock the sender sent on purpose [s]
    """
    i = line_of_sight(detections, cell)
    if i is None:
        return None
    return Round(
        time=time,
        forward=forward,
        range=float(detections.range[i]) - held * SPEED_OF_LIGHT,
        velocity=float(detections.velocity[i]),
        range_std=float(detections.std[i, 0]),
        velocity_std=float(detections.std[i, 1]),
    )


def path_acceleration(
    before: tuple[Pose, Pose], after: tuple[Pose, Pose], interval: float
) -> float:
    """Return the mean acceleration of a path's length between two rounds [m/s^2], as both ends
    report their positions and velocities there: manoeuvres, and v^2/R of passing by.

    Only the change is used, so that errors of their navigation, which last longer than the rounds,
    cancel but for their share of v^2/R.
    """
    speeds = []
    for one, other in (before, after):
        away = other.position - one.position
        speeds.append(away @ (other.velocity - one.velocity) / np.linalg.norm(away))
    return float((speeds[1] - speeds[0]) / interval)


def estimate_clock(rounds: Sequence[Round], acceleration: float = 0.0) -> ClockEstimate:
    """Clock and path from rounds of both directions by least squares with the measurements'
    covariance.

    Parameters
    ----------
    rounds : at least one in each direction, in any order
    acceleration : of the path's length, constant over the rounds [m/s^2] (`path_acceleration`)

    Raises
    ------
    ValueError  If a direction is missing: then clock and range cannot be told apart.

    Notes
    -----
    With one round each way: drift = (v1 - v2 + a dt)/2c, offset = (r1 - r2 + v2 dt - a dt^2/2)/2c.
    """
    if len({r.forward for r in rounds}) < 2:
        raise ValueError(
            "the rounds are all of one direction; a clock needs one from each end of the link"
        )
    start = min(r.time for r in rounds)
    rows, values, stds = [], [], []
    for r in rounds:
        t, s = r.time - start, 1.0 if r.forward else -1.0
        # unknowns in metres: c offset, c drift, range, velocity
        rows += [[s, s * t, 1.0, t], [0.0, s, 0.0, 1.0]]
        values += [r.range - acceleration * t * t / 2, r.velocity - acceleration * t]
        stds += [r.range_std, r.velocity_std]
    weight = 1 / np.array(stds)
    design = np.array(rows) * weight[:, None]
    solution = np.linalg.lstsq(design, np.array(values) * weight, rcond=None)[0]
    inverse = np.linalg.pinv(design)
    unit = np.array([1 / SPEED_OF_LIGHT, 1 / SPEED_OF_LIGHT, 1.0, 1.0])
    offset, drift, distance, velocity = (solution * unit).tolist()
    covariance = inverse @ inverse.T * np.outer(unit, unit)
    covariance.setflags(write=False)
    return ClockEstimate(start, offset, drift, distance, velocity, covariance)
