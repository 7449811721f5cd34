"""A frame of one path, for experiments that need no scene: exact signal by the package's own
synthesis."""

from __future__ import annotations

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, Transmission
from isac_rt.frame.payload import Payload
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.randomness import seed_sequence
from isac_rt.signal.if_signal import add_noise, if_signal
from isac_rt.world.swarm import Pose

"""Skirt of the IF filter [Hz], as in the scenes."""


def antennas(waveform: Waveform, per_arm: int) -> Antennas:
    """The paper's transmit L and a receive L with `per_arm` elements on each arm."""
    return Antennas(
        tx_x=2, tx_z=2, rx_x=per_arm, rx_z=per_arm, spacing=0.5774 * waveform.wavelength
    )


def frame(
    waveform: Waveform,
    schedule: Schedule,
    payload: Payload,
    arrays: Antennas,
    *,
    delay: float,
    rate: float = 0.0,
    clock_offset: float = 0.0,
    snr_db: float | None = None,
    seed: int = 0,
    purpose: tuple[str | int, ...] = (),
) -> IFCube:
    """IF samples of one path of unit amplitude on boresight.

    Parameters
    ----------
    delay, rate : of the path at mid-frame [s, 1], without the clock
    clock_offset : of the transmitter's clock [s]; it adds to the delay
    snr_db : per sample and antenna; None: no noise
    seed, purpose : of the noise
    """
    ahead = np.array([[0.0, 1.0, 0.0]])
    path = make_paths(
        gain=np.ones(1),
        delay=np.array([delay]),
        delay_rate=rate,
        departure=ahead,
        arrival=ahead,
        kind=int(PathKind.LINE_OF_SIGHT),
        epoch=waveform.frame_duration / 2,
        tx="sender",
        rx="receiver",
    )
    pose = Pose.at_rest()
    sent = Transmission(
        name="sender",
        pose=pose,
        antennas=arrays,
        schedule=schedule,
        payload=payload,
        clock_offset=clock_offset,
    )
    cube = if_signal(waveform, [(sent, path)], pose, arrays, start_time=0.0)
    if snr_db is None:
        return cube
    return add_noise(cube, 10 ** (-snr_db / 10), seed_sequence(seed, *purpose).generate_state(2))
