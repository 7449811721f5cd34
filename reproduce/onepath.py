"""A frame of one path, for experiments that need no scene: exact signal by the package's own
synthesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference
from isac_rt.frame.payload import Payload
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import seed_sequence
from isac_rt.signal.if_signal import add_noise, if_signal
from reproduce.waves import AHEAD, STILL, sender, waves


def antennas(waveform: Waveform, per_arm: int) -> Antennas:
    """The paper's transmit L and a receive L with `per_arm` elements on each arm."""
    spacing = 0.5774 * waveform.wavelength
    return Antennas(tx_x=2, tx_z=2, rx_x=per_arm, rx_z=per_arm, spacing=spacing)


def frame(
    waveform: Waveform,
    schedule: Schedule,
    payload: Payload,
    arrays: Antennas,
    *,
    delay: float,
    rate: float = 0.0,
    ends: tuple[np.ndarray, np.ndarray] = (AHEAD, AHEAD),
    clock_offset: float = 0.0,
) -> IFCube:
    """IF samples of one path of unit amplitude, without noise.

    Parameters
    ----------
    delay, rate : of the path at mid-frame [s, 1], without the clock
    ends : departure and arrival, unit vectors
    clock_offset : of the transmitter's clock [s]; it adds to the delay
    """
    sent = replace(sender(arrays, schedule, payload), clock_offset=clock_offset)
    path = waves(waveform.frame_duration / 2, delay, rate, ends=ends)
    return if_signal(waveform, [(sent, path)], ReceiveArray(STILL, arrays), Reference(0.0))


def noisy(cube: IFCube, snr_db: float, seed: int, *purpose: str | int) -> IFCube:
    """A cube of unit amplitude with noise, SNR per sample and antenna."""
    return add_noise(cube, 10 ** (-snr_db / 10), seed_sequence(seed, *purpose).generate_state(2))
