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
from scipy.special import gammainccinv

from isac_rt.receive.joint.fit import fit, match_chirps
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.joint.tones import JointPath, rate_bin
from isac_rt.receive.known import Known

FARTHEST = 1.5
"""Error of the first velocity within which it is sought [bins]."""
STEP = 0.32
"""Spacing of the offsets tried, in bins of the D-th power: a line between two loses 4 %."""
UNAMBIGUOUS = 0.45
"""Share of the D-th power's period in velocity, P/D bins, that is searched on each side."""
FALSE_RATE = 1e-3
"""Chance that noise is taken for the carrier."""
ROUNDS = 2


def decide_phases(moments: Moments, path: JointPath, order: int) -> np.ndarray | None:
    """(M, P) running phases of a modulated frame at a PT; None where it shows no carrier.

    Hard decisions add up nearly in phase whatever the carrier and the velocity: of uniform phases
    they leave sin(pi/D)/(pi/D) of the sum, 0.994 for D = 16. So it is no evidence that the decided
    chirps gather. What counts is that the D-th powers do, more than noise makes them.

    Parameters
    ----------
    moments : of the frame's samples, with the phases decided so far
    path : near estimate of the reference path, within 1.5 Doppler bins
    order : D

    Returns
    -------
    phases : as sent, but for whole steps that an antenna has in common over the frame: those belong
        to its amplitude
    """
    known, phases = moments.known, None
    for _ in range(ROUNDS):
        path = fit(moments, [path]).paths[0]
        matched = match_chirps(moments, path)
        found = _decide(known, matched * known.phases, order)
        if found is None:
            break
        phases, offset = found
        path = replace(path, delay_rate=path.delay_rate + offset * rate_bin(known.waveform))
        known = replace(known, phases=phases)
        moments = moments.read_by(known)
    return phases


def _decide(known: Known, chirps: np.ndarray, order: int) -> tuple[np.ndarray, float] | None:
    """Phases of the chirps' sums (M, P), and the velocity's error [bins] that they show; None where
    noise alone would show as much."""
    w = known.waveform
    far = min(FARTHEST, UNAMBIGUOUS * w.num_chirps / order)
    offsets = np.linspace(-far, far, 2 * int(np.ceil(far * order / STEP)) + 1)
    turns = known.sampled_times / w.frame_duration
    powers = (chirps / np.maximum(np.abs(chirps), 1e-300)) ** order
    sums = np.array(
        [
            np.exp(-2j * np.pi * order * np.outer(offsets, turns[a])) @ powers[a]
            for a in known.sent_by
        ]
    )
    counts = np.array([[a.sum()] for a in known.sent_by])
    line = (np.abs(sums) ** 2 / counts).sum(axis=0)  # in noise a sum of L_tx exponentials
    best = int(line.argmax())
    if line[best] < gammainccinv(w.num_tx, FALSE_RATE / offsets.size):
        return None
    carrier = np.angle(sums[:, best])[known.schedule] / order
    steps = np.round(
        (np.angle(chirps) - 2 * np.pi * offsets[best] * turns - carrier) * order / (2 * np.pi)
    )
    for a in known.sent_by:  # as before, in the middle
        apart = np.exp(2j * np.pi * steps[a] / order) @ known.phases[a].conj()
        steps[a] -= np.round(np.angle(apart) * order / (2 * np.pi))
    return np.exp(2j * np.pi * steps / order), float(offsets[best])
