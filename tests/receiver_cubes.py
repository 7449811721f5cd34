"""Test cubes straight from the equation of the IF signal, float64, sharing nothing with the
program's synthesis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload, random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.known import Known

C = 299_792_458.0
ANTENNAS = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * C / 77e9, pattern="sector")


@dataclass
class Path:
    """length and rate of the whole path [m, m/s] at mid-frame, complex amplitude, body-frame (u_x,
    u_z) at both ends."""

    length: float
    rate: float
    amplitude: complex = 1.0
    arrival: tuple[float, float] = (0.0, 0.0)
    departure: tuple[float, float] = (0.0, 0.0)


def frame(order: int = 8, seed: int = 3, waveform: Waveform | None = None):
    """Waveform, a pseudo-random schedule and a random payload."""
    w, rng = waveform or Waveform(), np.random.default_rng(seed)
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    return w, schedule, random_payload(w, schedule, order, rng)


def known(
    w: Waveform, schedule, payload: Payload, antennas: Antennas = ANTENNAS, passes: int = 2
) -> Known:
    """What a receiver to which the payload is known knows of a frame."""
    return Known(w, schedule, payload.delay_symbols, payload.phases, antennas, passes)


def cube(
    w: Waveform,
    schedule,
    payload: Payload,
    paths: list[Path],
    antennas: Antennas = ANTENNAS,
    noise=0.0,
    seed=0,
):
    """cycles = f_c tau + alpha tau (u - tau/2), tau = tau_D + tau_k(t) - r.u/c, t the sample time
    since mid-frame."""
    out = np.zeros((w.num_groups, antennas.num_rx, w.num_chirps, w.num_samples), np.complex64)
    u = np.arange(w.num_samples) / w.sampling_rate + w.chirp_duration - w.sampled_duration
    for m in range(w.num_groups):
        t = (
            u
            + (
                np.arange(w.num_chirps) * w.slot_duration
                + 2 * m * w.max_delay
                - w.frame_duration / 2
            )[:, None]
        )
        symbol = payload.delay_symbols[m] / (w.slope * w.sampled_duration)
        for path in paths:
            sent = antennas.tx_positions[schedule[m]] @ np.array(
                [path.departure[0], 0, path.departure[1]]
            )
            for rx in range(antennas.num_rx):
                heard = antennas.rx_positions[rx] @ np.array([path.arrival[0], 0, path.arrival[1]])
                tau = (path.length + path.rate * t - (sent[:, None] + heard)) / C + symbol[:, None]
                cycles = (w.carrier_frequency * tau) % 1 + w.slope * tau * (u - tau / 2)
                out[m, rx] += (
                    path.amplitude * payload.phases[m][:, None] * np.exp(2j * np.pi * (cycles % 1))
                )
    if noise:
        rng = np.random.default_rng(seed)
        out += (
            np.sqrt(noise / 2)
            * rng.standard_normal((*out.shape, 2), np.float32).view(np.complex64)[..., 0]
        )
    return IFCube(samples=out, waveform=w, schedule=schedule, start_time=0.0)
