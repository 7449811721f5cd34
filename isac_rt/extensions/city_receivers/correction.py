r"""The platform's own velocity and the clutter's level, read off the clutter of the frame itself.

Thousands of range-Doppler cells hold clutter whose Doppler is that of the flight. With n the noise,
C the power that the mesh predicts for a cell and P what is found there, P is taken as exponential
of mean :math:`m = n + e^{\theta_0} C(\theta_1..\theta_3)`, with
:math:`\theta_1..\theta_3` what the velocity is off [m/s]. Fisher scoring of that likelihood, with
Gaussian priors as wide as such errors usually are, gives the level to tenths of a decibel and the
velocity along boresight to hundredths of m/s; across it, where little clutter is, less well, and
there it matters less. Cells that stand far out (`OUTLIER`), UAVs among them, do not count. Where
the mesh predicts so little that too few cells count, but those of most clutter hold far more than
noise, the fit starts from their level.
"""

from __future__ import annotations

import numpy as np

from isac_rt.extensions.city_receivers.power import Response, Taper, cells_of
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.known import Known
from isac_rt.receive.types import Correction, ExpectedClutter

VELOCITY_STD = 0.1
"""Prior deviation of each component of the velocity [m/s]."""
LEVEL_STD = np.log(10) * 0.3
"""Prior deviation of the level's logarithm: 3 dB."""
OUTLIER = 8.0
"""A cell with this many times its mean counts for nothing; an exponential variable exceeds it in
0.03 % of the cells, four times its mean, with the level 3 dB off, in 2 %."""
FEWEST = 100
"""Cells with more clutter than noise below which nothing is fitted."""
FAR_OFF = np.log(10) * 0.6, np.log(10) * 2.0
"""Logarithms of the level, 6 and 20 dB, between which it is taken from the cells of most clutter
where no fit can start: less may be the chance of so few cells, more is something else."""
UNTAPERED = Taper(doppler_bins=0.0)
"""What is fitted is not averaged over; range cells migrate all the same."""
STEPS = 6
SETTLED = 0.02
"""Step of the level's logarithm and of the velocity [m/s] from which on the fit stands."""
ALIKE = 0.05
"""Velocities [m/s] so near to each other, a fifth of a Doppler bin, have the same slopes."""
LONGEST_STEP = np.array([1.0, 0.1, 0.1, 0.1])
"""Of the level's logarithm and the velocity [m/s]; 0.4 of a Doppler bin is well inside the
response's main lobe."""


def fit(power: np.ndarray, noise: float, clutter: ExpectedClutter, known: Known) -> Correction:
    """Correction of the expected clutter of an active terminal's own link.

    Parameters
    ----------
    power : (rows, P) mean power over the channels, Doppler centred; the rows up to N/2, which hold
        every chirp, are used
    noise : mean noise power of a cell
    """
    w = known.waveform
    rows = min(power.shape[0], w.num_range_cells)
    response = Response(w, rows, UNTAPERED, known.leaks)
    towards = clutter.departure + clutter.arrival
    per_velocity = -w.carrier() * w.frame_duration / SPEED_OF_LIGHT * towards  # bins per m/s
    beat, doppler = cells_of(clutter, w)
    prior = np.array([LEVEL_STD, *[VELOCITY_STD] * 3]) ** -2.0
    theta, at, slopes = np.zeros(4), np.full(3, np.inf), np.zeros((3, rows, power.shape[1]))
    for _ in range(STEPS):
        moved = doppler + per_velocity @ theta[1:]
        anew = np.abs(theta[1:] - at).max() > ALIKE
        along = per_velocity if anew else per_velocity[:, :0]
        parts = response.of(beat, moved, clutter.power, along)
        if anew:
            at, slopes = theta[1:].copy(), parts[1:]
        parts = np.exp(theta[0]) * np.concatenate([parts[:1], slopes])
        used = parts[0] > noise
        if used.sum() < FEWEST and not theta.any():
            theta[0] = _far_off(power[:rows], noise, parts[0])
            parts = np.exp(theta[0]) * parts
            used = parts[0] > noise
        if used.sum() < FEWEST:
            return Correction(0.0, np.zeros(3))
        mean, found = parts[0][used] + noise, power[:rows][used]
        kept = found < OUTLIER * mean
        score, excess = (parts[:, used] / mean)[:, kept], (found / mean - 1)[kept]
        step = np.linalg.solve(score @ score.T + np.diag(prior), score @ excess - prior * theta)
        theta = theta + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        if np.abs(step).max() < SETTLED:
            break
    return Correction(float(theta[0]), theta[1:])


def _far_off(power: np.ndarray, noise: float, expected: np.ndarray) -> float:
    """Logarithm of the level, by the median of the cells of most expected clutter.

    0 where it is not far off (`FAR_OFF`), or the clutter found is weaker than the noise.
    """
    most = np.argpartition(expected, -FEWEST, axis=None)[-FEWEST:]
    found = float(np.median(power.ravel()[most])) / np.log(2) - noise
    if found < noise:
        return 0.0
    level = float(np.log(found / expected.ravel()[most].mean()))
    return level if FAR_OFF[0] < level < FAR_OFF[1] else 0.0
