"""Plane waves in closed form, who sends them and what a receiver expects of them, for studies that
need no scene."""

from __future__ import annotations

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import Transmission
from isac_rt.frame.link import Link
from isac_rt.frame.payload import Payload
from isac_rt.frame.schedule import Schedule
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.receive.types import Prediction
from isac_rt.world.swarm import Pose

STILL = Pose.at_rest()
AT_TO_PT = Link("AT", "PT")
AHEAD = np.array([0.0, 1.0, 0.0])
"""Boresight of a terminal at rest in the origin."""


def waves(
    epoch: float,
    delay: np.ndarray | float,
    rate: np.ndarray | float = 0.0,
    *,
    gain: np.ndarray | complex = 1.0,
    ends: tuple[np.ndarray, np.ndarray] = (AHEAD, AHEAD),
    kind: np.ndarray | int = PathKind.LINE_OF_SIGHT,
    radius: np.ndarray | float = np.inf,
    link: Link = AT_TO_PT,
) -> PathSet:
    """Paths without bounces; what is one number or one direction holds for all of them.

    Parameters
    ----------
    epoch : of delay and rate [s], the middle of a frame
    delay, rate : (K,) or one [s, 1]
    ends : departure and arrival, (K, 3) or (3,) unit vectors
    radius : of the wavefronts at both ends [m]
    """
    delay = np.atleast_1d(delay)
    departure, arrival = (np.broadcast_to(u, (delay.size, 3)) for u in ends)
    return make_paths(
        gain=np.asarray(gain),
        delay=delay,
        delay_rate=rate,
        departure=departure,
        arrival=arrival,
        kind=kind,
        epoch=epoch,
        tx=link.tx,
        rx=link.rx,
        tx_radius=radius,
        rx_radius=radius,
    )


def sender(
    antennas: Antennas, schedule: Schedule, payload: Payload, pose: Pose = STILL
) -> Transmission:
    """The active terminal of these studies."""
    return Transmission(name="AT", pose=pose, antennas=antennas, schedule=schedule, payload=payload)


def prediction(
    length: np.ndarray | float,
    velocity: np.ndarray | float,
    weight: np.ndarray | float = 1.0,
    std: tuple[float, float] = (0.02, 0.1),
) -> Prediction:
    """What a passive terminal expects of paths on boresight; `std`: of range and velocity."""
    length = np.atleast_1d(length)
    one = np.ones(length.size)
    return Prediction(
        range=length,
        velocity=velocity * one,
        direction=np.zeros((length.size, 2)),
        range_std=std[0] * one,
        velocity_std=std[1] * one,
        weight=weight * one,
    )
