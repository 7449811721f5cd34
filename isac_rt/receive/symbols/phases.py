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

from isac_rt.receive.joint.fit import JointPath, fit, match_chirps, rate_bin
from isac_rt.receive.known import Known

OFFSETS = np.arange(-1.5, 1.501, 0.02)
"""Errors of the first velocity that are tried [bins]; to the power D a chirp's bin is 1/D wide."""
ROUNDS = 2


def decide_phases(samples: np.ndarray, known: Known, path: JointPath, order: int) -> np.ndarray:
    """(M, P) running phases of a modulated frame at a PT.

    Parameters
    ----------
    samples : (M, L_rx, P, N)
    known : with the phases decided so far, which are handed back unless others let the path stand
        out more
    path : near estimate of the reference path, within 1.5 Doppler bins
    order : D

    Returns
    -------
    phases : as sent, but for whole steps that an antenna has in common over the frame: those belong
        to its amplitude
    """
    for _ in range(ROUNDS):
        tried = fit(samples, known, [path])[0]
        matched = match_chirps(samples, known, tried)
        phases, offset = _decide(known, matched * known.phases, order)
        moved = replace(tried, delay_rate=tried.delay_rate + offset * rate_bin(known.waveform))
        other = replace(known, phases=phases)
        if _gathered(other, match_chirps(samples, other, moved)) <= _gathered(known, matched):
            break
        known, path = other, moved
    return known.phases


def _decide(known: Known, chirps: np.ndarray, order: int) -> tuple[np.ndarray, float]:
    """Phases of the chirps' sums (M, P), and the velocity's error [bins] that they show."""
    turns = known.sampled_times / known.waveform.frame_duration
    powers = (chirps / np.maximum(np.abs(chirps), 1e-300)) ** order
    sums = np.array(
        [
            np.exp(-2j * np.pi * order * np.outer(OFFSETS, turns[a])) @ powers[a]
            for a in known.sent_by
        ]
    )
    best = int((np.abs(sums) ** 2).sum(axis=0).argmax())
    carrier = np.angle(sums[:, best])[known.schedule] / order
    steps = np.round(
        (np.angle(chirps) - 2 * np.pi * OFFSETS[best] * turns - carrier) * order / (2 * np.pi)
    )
    for a in known.sent_by:  # as before, in the middle
        apart = np.exp(2j * np.pi * steps[a] / order) @ known.phases[a].conj()
        steps[a] -= np.round(np.angle(apart) * order / (2 * np.pi))
    return np.exp(2j * np.pi * steps / order), float(OFFSETS[best])


def _gathered(known: Known, chirps: np.ndarray) -> float:
    """Power of the chirps added in phase, antenna by antenna."""
    return sum(float(np.abs(chirps[sent].sum()) ** 2) for sent in known.sent_by)
