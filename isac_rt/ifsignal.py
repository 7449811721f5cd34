"""PathSet, waveform and payload to IF samples: the exact model, its oracle, the fast methods, and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.arrays import Antennas, Schedule
from isac_rt.payload import Payload
from isac_rt.propagation.pathset import PathSet
from isac_rt.swarm import Pose
from isac_rt.waveform import Waveform


@dataclass(frozen=True, kw_only=True)
class Transmission:
    """One transmitter's frame.

    Attributes
    ----------
    name : of the terminal
    pose : at the epoch (the middle of the frame)
    antennas : its arrays
    schedule : (M, P) transmit antenna of each group and chirp
    payload : what it modulates
    amplitude : sqrt(transmit power of one antenna) [sqrt(W)]
    clock_offset, clock_drift : of the transmitter's clock against the receiver's [s, 1]; they add to every delay
    active : (M, P) bool, False where nothing is sent (on-off keying)
    """

    name: str
    pose: Pose
    antennas: Antennas
    schedule: Schedule
    payload: Payload
    amplitude: float = 1.0
    clock_offset: float = 0.0
    clock_drift: float = 0.0
    active: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class IFCube:
    """What a receiver's converters deliver in one frame. It never holds the payload.

    Attributes
    ----------
    samples : (M, L_rx, P, N) complex64 [sqrt(W)]
    waveform, schedule : public parameters of the frame
    start_time : of the frame's first reference chirp [s]
    """

    samples: np.ndarray
    waveform: Waveform
    schedule: Schedule
    start_time: float
