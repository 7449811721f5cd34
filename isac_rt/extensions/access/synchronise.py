r"""Two-round synchronisation: what a link measures in both directions tells its clock from its
range.

The transmitter's clock of round 1 (the active terminal's) is ahead or behind by delta(t) against
the passive terminal's and adds to the delay; in round 2 the same clocks add with the opposite sign
(signs of `Transmission.clock_offset`). With the path's delay tau(t), t counted from round 1,

.. math::

    y_1 = \tau + \delta,\ \dot y_1 = \dot\tau + \dot\delta,\qquad y_2 = \tau(t) - \delta(t),\ \dot
    y_2 = \dot\tau(t) - \dot\delta

A drift of 0.01 ppm is 3 m/s of apparent velocity, and a motion of 10 m/s between rounds 8 ms apart
is 0.08 m of apparent offset: both are solved for, with the path's acceleration as an unknown of
known spread, so that the rounds may be apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.types import Detections

ACCELERATION_STD = 5.0
"""Spread of the range's acceleration [m/s^2]: manoeuvres, and v^2/R of passing by."""


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

    @property
    def drift_std(self) -> float:
        return float(np.sqrt(self.covariance[1, 1]))

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


def round_of(
    detections: Detections, time: float, forward: bool, *, cell: float, held: float = 0.0
) -> Round | None:
    """The reference of a reception as a round: the strongest detection within a range cell of the
    earliest sure one.

    One group alone samples an antenna's chirps so sparsely that a strong path leaves Doppler
    sidelobes at its own range, and one of these may seem earlier by less than a cell.

    Parameters
    ----------
    detections : of an unmodulated frame
    time : of its middle [s]
    forward : whether the active terminal sent
    cell : size of a range cell [m]
    held : how much later than its clock the sender sent on purpose [s]
    """
    which = np.flatnonzero(detections.is_reference)
    if which.size == 0:
        return None
    near = np.abs(detections.range - detections.range[which[0]]) < cell
    i = np.where(near, detections.snr, -np.inf).argmax()
    return Round(
        time=time,
        forward=forward,
        range=float(detections.range[i]) - held * SPEED_OF_LIGHT,
        velocity=float(detections.velocity[i]),
        range_std=float(detections.std[i, 0]),
        velocity_std=float(detections.std[i, 1]),
    )


def estimate_clock(
    rounds: Sequence[Round], acceleration_std: float = ACCELERATION_STD
) -> ClockEstimate:
    """Clock and path from rounds of both directions by least squares with the measurements'
    covariance.

    Parameters
    ----------
    rounds : at least one in each direction, in any order
    acceleration_std : spread of the path's acceleration, constant over the rounds [m/s^2]

    Raises
    ------
    ValueError  If a direction is missing: then clock and range cannot be told apart.

    Notes
    -----
    With one round each way: drift = (v1 - v2)/2c, offset = (r1 - r2 + v2 dt)/2c.
    """
    if len({r.forward for r in rounds}) < 2:
        raise ValueError(
            "the rounds are all of one direction; a clock needs one from each end of the link"
        )
    start = min(r.time for r in rounds)
    rows, values, stds = [], [], []
    for r in rounds:
        t, s = r.time - start, 1.0 if r.forward else -1.0
        # unknowns in metres: c offset, c drift, range, velocity, acceleration
        rows += [[s, s * t, 1.0, t, t * t / 2], [0.0, s, 0.0, 1.0, t]]
        values += [r.range, r.velocity]
        stds += [r.range_std, r.velocity_std]
    rows.append([0.0, 0.0, 0.0, 0.0, 1.0])
    values.append(0.0)
    stds.append(acceleration_std)
    weight = 1 / np.array(stds)
    design = np.array(rows) * weight[:, None]
    solution = np.linalg.lstsq(design, np.array(values) * weight, rcond=None)[0]
    inverse = np.linalg.pinv(design)
    covariance = (inverse @ inverse.T)[:4, :4]
    unit = np.array([1 / SPEED_OF_LIGHT, 1 / SPEED_OF_LIGHT, 1.0, 1.0])
    offset, drift, distance, velocity = solution[:4] * unit
    covariance = covariance * np.outer(unit, unit)
    covariance.setflags(write=False)
    return ClockEstimate(
        start, float(offset), float(drift), float(distance), float(velocity), covariance
    )
