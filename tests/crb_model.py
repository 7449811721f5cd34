"""The exact IF signal of one path from points in space, and its Cramer-Rao bound by numerical
differences.

Shares nothing with the receiver.
"""

from __future__ import annotations

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import Payload
from isac_rt.frame.waveform import Waveform

C = 299_792_458.0


def samples(
    w: Waveform,
    schedule: np.ndarray,
    payload: Payload,
    antennas: Antennas,
    theta: np.ndarray,
    passes: int,
) -> np.ndarray:
    """Unit-amplitude signal (M, rx, P, N), complex128.

    theta: range [m] and its rate at mid-frame, u_x, u_z, phase [rad], amplitude, and at a PT the
    direction of departure. The target (or, at a PT, the transmitter) is a point at that range;
    distances to every element are those of points.
    """
    r, v, ux, uz, phase, amplitude = theta[:6]
    departure = theta[2:4] if passes == 2 else theta[6:8]

    def extra(elements: np.ndarray, d: np.ndarray) -> np.ndarray:
        centre = r * np.array([d[0], np.sqrt(1 - d[0] ** 2 - d[1] ** 2), d[1]])
        return np.linalg.norm(centre - elements, axis=1) - r

    u = np.arange(w.num_samples) / w.sampling_rate + w.chirp_duration - w.sampled_duration
    out = np.empty((w.num_groups, antennas.num_rx, w.num_chirps, w.num_samples), complex)
    heard, sent = (
        extra(antennas.rx_positions, np.array([ux, uz])),
        extra(antennas.tx_positions, departure),
    )
    for m in range(w.num_groups):
        t = (
            u
            + (
                np.arange(w.num_chirps) * w.slot_duration
                + 2 * m * w.max_delay
                - w.frame_duration / 2
            )[:, None]
        )
        length = passes * (r + v * t) + sent[schedule[m]][:, None]
        data = payload.delay_symbols[m][:, None] / (w.slope * w.sampled_duration)
        for rx in range(antennas.num_rx):
            tau = (length + heard[rx]) / C + data
            cycles = (w.carrier_frequency * tau) % 1 + w.slope * tau * (u - tau / 2)
            out[m, rx] = payload.phases[m][:, None] * np.exp(2j * np.pi * (cycles % 1))
    return amplitude * np.exp(1j * phase) * out


def bound(
    w: Waveform,
    schedule,
    payload: Payload,
    antennas: Antennas,
    theta: np.ndarray,
    passes: int,
    snr: float,
) -> np.ndarray:
    """Least variances of theta at a per-sample SNR: the inverse of F = 2/sigma^2 Re(J^H J), J by
    central differences."""
    steps = np.array([1e-6, 1e-5, 1e-6, 1e-6, 1e-4, 1e-3, 1e-6, 1e-6])[: len(theta)]
    columns = []
    for i, h in enumerate(steps):
        shift = h * np.eye(len(theta))[i]
        plus, minus = (
            samples(w, schedule, payload, antennas, theta + s, passes) for s in (shift, -shift)
        )
        columns.append(((plus - minus) / (2 * h)).ravel())
    J = np.stack(columns, axis=1)
    return np.diag(np.linalg.inv(2 * snr / theta[5] ** 2 * (J.conj().T @ J).real))
