"""Tracker and scores against theory."""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
from scipy import stats

from isac_rt.results.metrics import binomial_interval, gospa
from isac_rt.studies.validation import stage
from isac_rt.studies.validation.case import Errors, case, slow
from isac_rt.terminal.filter import (
    BIRTH_SPEED_STD,
    birth,
    bistatic_distance,
    jacobian,
    measure,
    predict,
    update,
)
from isac_rt.world.swarm import Pose

ONCE_IN_1E5 = "false alarm 7e-6"


# ---- tracking

OWN = stage.pose((3.1, -2.7, 31.3), (4.3, 7.9, -0.6), boresight=(0.5, 1.2, -0.15))
BODY = np.array([14.7, 28.9, 27.1, -3.7, 6.1, 1.3])
AT = np.array([-21.3, 33.7, 40.9, 8.3, -2.1, 0.4])
STD = np.array([0.031, 0.083, 0.0047, 0.0061])


@case(
    "derivatives by a complex step of 1e-30",
    "1e-12 1",
    "float64 rounding; a complex step has no error of its own",
)
def jacobians_of_the_tracker() -> Errors:
    """Derivative of range, rate and direction with respect to the state, one-way and bistatic."""
    for transmitter in (None, AT):
        truth = np.stack(
            [measure(BODY + 1e-30j * d, OWN, transmitter).imag / 1e-30 for d in np.eye(6)], axis=1
        )
        yield np.abs(jacobian(BODY, OWN, transmitter) - truth).max()


@case(
    "a reflector placed anywhere",
    "1e-9 relative",
    "float64 rounding, conditioned by 1e4 where the detour is short",
)
def bistatic_range() -> Errors:
    """Distance to a reflector from the path length and the direction of arrival."""
    rng = np.random.default_rng(11)
    for _ in range(50):
        offset, baseline = rng.normal(0, 40.0, 3), rng.normal(0, 30.0, 3)
        rho = float(np.linalg.norm(offset))
        length = rho + float(np.linalg.norm(offset - baseline))
        if length - np.linalg.norm(baseline) > 1:
            yield abs(bistatic_distance(length, baseline, offset / rho) / rho - 1)


@lru_cache(maxsize=1)
def _tracked(runs: int = 100, steps: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """NEES of the last state (6 degrees of freedom) and NIS of the last innovation (4) over
    independent runs."""
    rng, sigma, interval = np.random.default_rng(17), 1.7, 0.05
    nees, nis = [], []
    for _ in range(runs):
        x = np.concatenate(
            [BODY[:3] + rng.normal(0, 3.0, 3), BIRTH_SPEED_STD * rng.standard_normal(3)]
        )
        own = OWN
        g = birth(measure(x, own) + STD * rng.standard_normal(4), STD, own)
        assert g is not None
        for _ in range(steps):
            a = sigma * rng.standard_normal(3)
            x = np.concatenate(
                [x[:3] + interval * x[3:] + interval**2 / 2 * a, x[3:] + interval * a]
            )
            own = Pose(
                own.position + interval * own.velocity, own.velocity, own.acceleration, own.rotation
            )
            g = predict(g, interval, sigma)
            z, R = measure(x, own) + STD * rng.standard_normal(4), np.diag(STD**2)
            H = jacobian(g.mean, own)
            y = z - measure(g.mean, own)
            innovation = float(y @ np.linalg.solve(H @ g.covariance @ H.T + R, y))
            g = update(g, z, R, own)
        off = x - g.mean
        nees.append(float(off @ np.linalg.solve(g.covariance, off)))
        nis.append(innovation)
    return np.array(nees), np.array(nis)


@slow("chi-square with six degrees of freedom", "4.5 sigma", ONCE_IN_1E5)
def consistency_of_states() -> float:
    """Normalised estimation error squared (NEES) of tracks born from one detection, over 100
    independent runs."""
    return float(abs(_tracked()[0].mean() - 6) / np.sqrt(12 / 100))


@slow("chi-square with four degrees of freedom", "4.5 sigma", ONCE_IN_1E5)
def consistency_of_innovations() -> float:
    """Normalised innovation squared (NIS) of the same tracks."""
    return float(abs(_tracked()[1].mean() - 4) / np.sqrt(8 / 100))


# ---- scores


@case("every assignment tried", "1e-12 m", "float64 rounding")
def gospa_metric() -> Errors:
    """GOSPA with p = 2, alpha = 2 of up to four truths and five estimates."""
    rng, cutoff = np.random.default_rng(3), 2.7
    for n, m in ((0, 3), (3, 2), (4, 5), (2, 2)):
        x, y = rng.uniform(0, 4, (n, 3)), rng.uniform(0, 4, (m, 3))
        best = np.inf
        for size in range(min(n, m) + 1):
            for rows in itertools.combinations(range(n), size):
                for columns in itertools.permutations(range(m), size):
                    square = sum(
                        float(((x[i] - y[j]) ** 2).sum())
                        for i, j in zip(rows, columns, strict=True)
                    )
                    best = min(best, square + cutoff**2 / 2 * (n + m - 2 * size))
        yield abs(gospa(x, y, cutoff).distance - np.sqrt(best))


@case("binomial tails summed term by term", "1e-9 probability", "float64 rounding")
def binomial_intervals() -> Errors:
    """At either end of a Clopper-Pearson interval the outcome, or one farther out, has a chance of
    2.5 %."""
    for k, n in ((1, 20), (7, 31), (30, 31)):
        low, high = binomial_interval(k, n)
        yield abs(1 - stats.binom.cdf(k - 1, n, low) - 0.025)
        yield abs(stats.binom.cdf(k, n, high) - 0.025)
