"""DPSK phases decided once more, coherently, by the path that the frame itself shows.

Differential decisions chain: one wrong transition turns all later chirps of its antenna and group,
and what is sensed with such phases is off by many of its standard deviations. After a first
estimate the chirps can be added over the receivers in phase and held against one carrier phase per
antenna for the whole frame. That carrier and what is left of the velocity are found without the
data: to the power D a chirp's phase no longer holds them (Viterbi and Viterbi). A wrong decision
then spoils its own chirp alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from isac_rt.receive.joint.fit import Frame, JointPath, fit, match_chirps

OFFSETS = np.arange(-1.5, 1.501, 0.02)
"""Errors of the first velocity that are tried [bins]; to the power D a chirp's bin is 1/D wide."""
ROUNDS = 2


def decide_phases(frame: Frame, path: JointPath, order: int) -> np.ndarray:
    """(M, P) running phases of a modulated frame at a PT.

    Parameters
    ----------
    frame : with the phases decided so far, which are handed back unless others let the path stand
        out more
    path : near estimate of the reference path, within 1.5 Doppler bins
    order : D

    Returns
    -------
    phases : as sent, but for whole steps that an antenna has in common over the frame: those belong
        to its amplitude
    """
    for _ in range(ROUNDS):
        tried = fit(frame, [path])[0]
        chirps = match_chirps(frame, tried) * frame.phases
        phases, offset = _decide(frame, chirps, order)
        moved = replace(tried, delay_rate=tried.delay_rate + offset * frame.units[1])
        other = replace(frame, phases=phases)
        if _gathered(other, match_chirps(other, moved)) <= _gathered(
            frame, match_chirps(frame, tried)
        ):
            break
        frame, path = other, moved
    return frame.phases


def _decide(frame: Frame, chirps: np.ndarray, order: int) -> tuple[np.ndarray, float]:
    """Phases of the chirps' sums (M, P), and the velocity's error [bins] that they show."""
    w, schedule = frame.waveform, frame.cube.schedule
    turns = np.broadcast_to(frame.middle / w.frame_duration, schedule.shape)
    powers = (chirps / np.maximum(np.abs(chirps), 1e-300)) ** order
    antennas = [schedule == tx for tx in range(w.num_tx)]
    sums = np.array(
        [np.exp(-2j * np.pi * order * np.outer(OFFSETS, turns[a])) @ powers[a] for a in antennas]
    )
    best = int((np.abs(sums) ** 2).sum(axis=0).argmax())
    carrier = np.angle(sums[:, best])[schedule] / order
    steps = np.round(
        (np.angle(chirps) - 2 * np.pi * OFFSETS[best] * turns - carrier) * order / (2 * np.pi)
    )
    for a in antennas:  # as before, in the middle
        apart = np.exp(2j * np.pi * steps[a] / order) @ frame.phases[a].conj()
        steps[a] -= np.round(np.angle(apart) * order / (2 * np.pi))
    return np.exp(2j * np.pi * steps / order), float(OFFSETS[best])


def _gathered(frame: Frame, chirps: np.ndarray) -> float:
    """Power of the chirps added in phase, antenna by antenna."""
    schedule = frame.cube.schedule
    return sum(
        float(np.abs(chirps[schedule == tx].sum()) ** 2) for tx in range(frame.waveform.num_tx)
    )
