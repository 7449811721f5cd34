"""Tracker and scores against theory."""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
from one_detection import initiate
from scipy import stats

from isac_rt.results.metrics import binomial_interval, gospa
from isac_rt.track.filter import (
    INITIAL_SPEED_STD,
    MANOEUVRE_TIME,
    Gaussian,
    bistatic_distance,
    jacobian,
    measure,
    predict,
    singer,
    update,
)
from isac_rt.track.settings import Tracking
from isac_rt.world.swarm import Pose
from truths import stage
from truths.case import Errors, case, slow

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


@case(
    "Lyapunov's integral by Gauss and Legendre, its exponentials by their power series",
    "1e-12 relative",
    "float64 rounding",
)
def covariance_of_an_unknown_acceleration() -> Errors:
    """Transition and covariance of a track's prediction over 7.8 ms to 3.1 s; two halves of an
    interval make the whole."""
    A = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / MANOEUVRE_TIME]])
    L = np.diag([0, 0, 2 * 1.7**2 / MANOEUVRE_TIME])

    def exponential(s: float) -> np.ndarray:
        terms = itertools.accumulate(range(1, 40), lambda P, k: P @ A * (s / k), initial=np.eye(3))
        return np.sum(list(terms), axis=0)

    nodes, weights = np.polynomial.legendre.leggauss(20)
    for T in (0.0078, 0.05, 0.2, 0.5, 3.1):
        F, Q = singer(T, 1.7)
        powers = [exponential(T * (node + 1) / 2) for node in nodes]
        truth = sum(T * w / 2 * e @ L @ e.T for w, e in zip(weights, powers, strict=True))
        scale = np.repeat(np.sqrt(np.diag(truth)), 3)
        yield np.abs((Q - np.kron(truth, np.eye(3))) / np.outer(scale, scale)).max()
        yield np.abs(F - np.kron(exponential(T), np.eye(3))).max()
        yield np.abs((F @ Q @ F.T + Q - singer(2 * T, 1.7)[1]) / np.outer(scale, scale)).max()


@lru_cache(maxsize=1)
def _tracked(runs: int = 100, steps: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """NEES of the last state (6 degrees of freedom) and NIS of the last innovation (4) over
    independent runs."""
    rng, sigma, interval, pieces = np.random.default_rng(17), 1.7, 0.05, 25
    h = interval / pieces
    kept = np.exp(-h / MANOEUVRE_TIME)
    nees, nis = [], []
    for _ in range(runs):
        x = np.concatenate(
            [BODY[:3] + rng.normal(0, 3.0, 3), INITIAL_SPEED_STD * rng.standard_normal(3)]
        )
        own, a = OWN, sigma * rng.standard_normal(3)
        g = initiate(
            measure(x, own) + STD * rng.standard_normal(4), STD, own, acceleration_std=sigma
        )
        assert g is not None
        for _ in range(steps):
            for _ in range(pieces):
                x = np.concatenate([x[:3] + h * x[3:] + h**2 / 2 * a, x[3:] + h * a])
                a = kept * a + sigma * np.sqrt(1 - kept**2) * rng.standard_normal(3)
            own = Pose(
                own.position + interval * own.velocity, own.velocity, own.acceleration, own.rotation
            )
            g = predict(g, interval, sigma)
            z, R = measure(x, own) + STD * rng.standard_normal(4), np.diag(STD**2)
            H = jacobian(g.mean, own)
            y = z - measure(g.mean, own)
            innovation = float(y @ np.linalg.solve(H @ g.covariance @ H.T + R, y))
            g = update(g, z, R, own)
        off = x - g.mean[:6]
        nees.append(float(off @ np.linalg.solve(g.covariance[:6, :6], off)))
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


FLIGHTS = 20
WIND_STD, WIND_TIME = np.array([3.7, 3.7, 2.3]), np.array([20.0, 20.0, 5.0])
"""Dryden's turbulence of MIL-F-8785C at 50 m in a severe wind of 45 time samples, met at 10 m/s:
standard deviations [m/s] and correlation times [s]."""


def _acceleration(manoeuvre: str, velocity: np.ndarray, wind: np.ndarray) -> np.ndarray:
    """(FLIGHTS, 3) of a turn to alternate sides, of braking, or of following the wind in 1 s."""
    if manoeuvre == "gusts":
        return wind - velocity
    ahead = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 0.01)
    if manoeuvre == "stop":
        return -3.0 * ahead
    left = np.cross([0.0, 0.0, 1.0], ahead)
    return float(manoeuvre) * left * (-1.0) ** np.arange(FLIGHTS)[:, None]


def _manoeuvred(manoeuvre: str, interval: float, frames: int) -> np.ndarray:
    """(frames, FLIGHTS, 6) states; the manoeuvre begins at a third and stays, gusts blow always."""
    rng, pieces = np.random.default_rng(23), int(np.ceil(interval / 0.002))
    h = interval / pieces
    x = rng.normal((5, 70, 30, 0, 0, 0), (15, 10, 5, 7, 7, 1), (FLIGHTS, 6))
    calm, wind = x[:, 3:].copy(), WIND_STD * rng.standard_normal((FLIGHTS, 3))
    kept, states = np.exp(-h / WIND_TIME), [x.copy()]
    for frame in range(1, frames):
        for _ in range(pieces):
            wind = kept * wind + WIND_STD * np.sqrt(1 - kept**2) * rng.standard_normal(wind.shape)
            a = _acceleration(manoeuvre, x[:, 3:], calm + wind)
            if manoeuvre != "gusts" and 3 * frame <= frames:
                a = np.zeros((FLIGHTS, 3))
            x[:, :3] += h * x[:, 3:] + h**2 / 2 * a
            x[:, 3:] += h * a
        states.append(x.copy())
    return np.array(states)


@slow(
    "chi-square with six degrees of freedom",
    "6 sigma",
    "chance of 4e-7 in each of 600 frames' means",
)
def consistency_in_manoeuvres() -> Errors:
    """NEES of twenty tracks, by the default setting and in every frame from the onset, in turns of
    1 and 3 m/s^2, braking by 3 m/s^2 to a stop and severe gusts, seen by an active and a passive
    terminal every 7.8 to 500 ms."""
    own, sigma = Pose.at_rest((3.1, -2.7, 31.3), (0.1, 1.2, -0.1)), Tracking().acceleration_std_mps2
    known = Gaussian(np.concatenate([AT[:3], np.zeros(3)]), np.zeros((6, 6)))
    rng, R = np.random.default_rng(29), np.diag(STD**2)
    cadence = {0.0078: 150, 0.05: 45, 0.2: 20, 0.5: 12}
    manoeuvres = ("1.0", "3.0", "stop", "gusts")
    for k, (manoeuvre, interval) in enumerate(itertools.product(manoeuvres, cadence)):
        states = _manoeuvred(manoeuvre, interval, cadence[interval])
        sender = known if (k + k // 4) % 2 else None
        at = None if sender is None else sender.mean
        nees = np.zeros(states.shape[:2])
        for flight in range(FLIGHTS):
            g = None
            for frame, x in enumerate(states[:, flight]):
                z = measure(x, own, at) + STD * rng.standard_normal(4)
                if g is None:
                    g = initiate(z, STD, own, sender, acceleration_std=sigma)
                    assert g is not None
                else:
                    g = update(predict(g, interval, sigma), z, R, own, at)
                off = x - g.mean[:6]
                nees[frame, flight] = off @ np.linalg.solve(g.covariance[:6, :6], off)
        late = nees[len(states) // 3 :].mean(axis=1)
        yield float(np.abs(late - 6).max() / np.sqrt(12 / FLIGHTS))


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
