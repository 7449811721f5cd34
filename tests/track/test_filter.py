"""The filter against its equations: Singer's model integrated, updates against the maximum of the
posterior, predicted measurements against samples, initiation by hand."""

from __future__ import annotations

import numpy as np
import pytest
from one_detection import initiate
from oracles import slopes, what_is_measured
from scipy.optimize import least_squares

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.track.filter import (
    Ambiguity,
    Gaussian,
    expected,
    initiate_all,
    measure,
    measurement_covariance,
    predict,
    singer,
    update,
    wrapped,
)
from isac_rt.world.swarm import Pose, attitude

OWN = Pose(
    np.array([3.1, -2.7, 31.3]),
    np.array([4.3, 7.9, -0.6]),
    np.zeros(3),
    attitude((0.5, 1.2, -0.15)),
)
STILL = Pose.at_rest((3.1, -2.7, 31.3), (0.5, 1.2, -0.15))
BODY = np.array([14.7, 38.9, 27.1, -3.7, 6.1, 1.3, 0.7, -1.1, 0.3])
SENDER = np.array([-21.3, 33.7, 40.9, 8.3, -2.1, 0.4, 0.2, 0.5, -0.4])
STD = np.array([0.031, 0.083, 0.0047, 0.0061])
PERIOD, SHIFT = 30.017, 0.217


def drawn(rng, mean, deviations):
    """A Gaussian whose components are correlated."""
    root = np.diag(deviations) @ np.linalg.qr(rng.normal(size=(len(mean), len(mean))))[0]
    P = root @ np.diag(rng.uniform(0.5, 2, len(mean))) @ root.T
    return Gaussian(np.asarray(mean, float), (P + P.T) / 2)


@pytest.mark.parametrize("interval", [0.0078, 0.41, 1.0, 2.7, 9.1])
def test_singers_model_is_the_integral_of_its_noise(interval):
    """Transition by its closed form with a time constant of 1 s, covariance of the state by the
    integral of the white noise's response, 40 points in long double; the acceleration's variance
    stays. Planted bugs: the density halved; intervals beyond 1 s halved without the transition."""
    sigma = 2.3

    def response(s):
        s = s.astype(np.longdouble)
        decay = np.exp(-s)
        return np.stack([s - 1 + decay, 1 - decay, decay])

    points, weights = np.polynomial.legendre.leggauss(40)
    s, w = interval * (points + 1) / 2, interval * weights / 2
    Q = 2 * sigma**2 * np.einsum("is,js,s->ij", response(s), response(s), w).astype(float)
    F = np.array([[1, interval, 0], [0, 1, 0], [0, 0, 0]])
    F[:, 2] = response(np.array([interval]))[:, 0]
    found_F, found_Q = singer(interval, sigma)
    # long double loses (1 s / 8 ms)^2 of its 1e-19; the exponential of a matrix is good to 1e-12
    np.testing.assert_allclose(found_F, np.kron(F, np.eye(3)), rtol=1e-10, atol=0)
    np.testing.assert_allclose(found_Q, np.kron(Q, np.eye(3)), rtol=1e-9, atol=0)
    assert F[2, 2] ** 2 * sigma**2 + found_Q[6, 6] == pytest.approx(sigma**2, rel=1e-9)


def test_a_prediction_is_where_its_samples_fly():
    """20,000 states that fly on for 0.7 s with accelerations redrawn every 5 ms as an
    Ornstein-Uhlenbeck process: mean and covariance, 4 % (five deviations of a variance, and the
    step)."""
    rng, sigma, count, step = np.random.default_rng(3), 2.9, 20_000, 0.005
    g = drawn(rng, BODY, [0.2, 0.3, 0.1, 0.9, 0.7, 0.5, 1.1, 0.8, 0.6])
    x = g.mean + rng.normal(size=(count, 9)) @ np.linalg.cholesky(g.covariance).T
    keep = np.exp(-step)
    for _ in range(140):
        before = x.copy()
        x[:, 6:] = keep * x[:, 6:] + sigma * np.sqrt(1 - keep**2) * rng.normal(size=(count, 3))
        x[:, 3:6] += step * (before[:, 6:] + x[:, 6:]) / 2
        x[:, :3] += step * (before[:, 3:6] + x[:, 3:6]) / 2
    found = predict(g, 0.7, sigma)
    scale = np.sqrt(np.diag(found.covariance))
    assert (x.mean(axis=0) - found.mean) / scale == pytest.approx(np.zeros(9), abs=0.03)
    assert np.cov(x.T) / np.outer(scale, scale) == pytest.approx(
        found.covariance / np.outer(scale, scale), abs=0.05
    )


def test_the_same_time_again_changes_nothing():
    """A frame handed over twice. Planted bug: the model's powers of the interval at zero (NaN)."""
    g = drawn(np.random.default_rng(4), BODY, np.arange(1.0, 10.0))
    again = predict(g, 0.0, 3.0)
    assert np.array_equal(again.mean, g.mean) and np.array_equal(again.covariance, g.covariance)
    soon = predict(g, 1e-9, 3.0)
    scale = np.sqrt(np.diag(g.covariance))
    assert (soon.mean - g.mean) / scale == pytest.approx(np.zeros(9), abs=1e-7)
    assert soon.covariance / np.outer(scale, scale) == pytest.approx(
        g.covariance / np.outer(scale, scale), abs=1e-7
    )


@pytest.mark.parametrize("missing", [(), (2, 3), (0,), (1, 2)])
@pytest.mark.parametrize("sender", [None, SENDER])
def test_an_update_is_the_maximum_of_the_posterior(sender, missing):
    """A body known to metres and a range known to 3 cm, where the measurement bends by 2 of its
    deviations: the state at the least sum of squares of prior and measurement together, the
    covariance by information at that place, a folded velocity and the range that goes with it
    included. A hundredth of a deviation: where the iteration stops. Planted bugs: one step
    only; the innovation at the new state taken for that at the old one; components that are
    missing kept."""
    rng = np.random.default_rng(5)
    g = drawn(rng, BODY, [2.1, 1.7, 1.3, 4.0, 3.0, 5.0, 2.0, 2.0, 2.0])
    truth = g.mean + np.linalg.cholesky(g.covariance) @ rng.normal(size=9)
    z = np.asarray(what_is_measured(truth, OWN, sender) + STD * rng.normal(size=4), float)
    rows = [i for i in range(4) if i not in missing]
    root = np.linalg.inv(np.linalg.cholesky(g.covariance))

    def parts(x):
        off = np.asarray(z - what_is_measured(x, OWN, sender), float) / STD
        return np.concatenate([root @ (x - g.mean), off[rows]])

    x = least_squares(parts, g.mean, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    H = slopes(lambda s: what_is_measured(s, OWN, sender), x).astype(float)[rows]
    R = np.diag(STD[rows] ** 2)
    P = np.linalg.inv(np.linalg.inv(g.covariance) + H.T @ np.linalg.inv(R) @ H)
    given = z.copy()
    if 1 not in missing:
        given[:2] += 2 * SHIFT, -2 * PERIOD
    given[list(missing)] = np.nan
    found = update(g, given, np.diag(STD**2), OWN, sender, ambiguity=Ambiguity(PERIOD, SHIFT))
    scale = np.sqrt(np.diag(P))
    assert (found.mean - x) / scale == pytest.approx(np.zeros(9), abs=0.01)
    assert found.covariance / np.outer(scale, scale) == pytest.approx(
        P / np.outer(scale, scale), abs=0.01
    )


@pytest.mark.parametrize("bistatic", [False, True])
def test_what_is_expected_is_what_samples_measure(bistatic):
    """100,000 samples of a body, and of the sender, through the exact measurement: means to 0.02
    deviations, covariances to 3 % (a variance's own spread is 0.5 %, the fourth order of the bend
    the rest). Planted bugs: 11
    points for 12; the root of 3 for 6; the sender's covariance left out."""
    rng, count = np.random.default_rng(7), 100_000
    g = drawn(rng, BODY, [1.6, 1.2, 1.4, 6.0, 7.0, 5.0, 1, 1, 1])
    x = g.mean + rng.normal(size=(count, 9)) @ np.linalg.cholesky(g.covariance).T
    sender = drawn(rng, SENDER, [0.5, 0.7, 0.6, 2.0, 1.5, 2.5, 1, 1, 1]) if bistatic else None
    s = None
    if sender is not None:
        s = sender.mean + rng.normal(size=(count, 9)) @ np.linalg.cholesky(sender.covariance).T
    z = np.asarray(what_is_measured(x, STILL, s), float)
    mean, S = expected(g.mean, g.covariance, STILL, sender)
    scale = np.sqrt(np.diag(S))
    assert (z.mean(axis=0) - mean) / scale == pytest.approx(np.zeros(4), abs=0.02)
    assert np.cov(z.T) / np.outer(scale, scale) == pytest.approx(
        S / np.outer(scale, scale), abs=0.03
    )


def test_a_detections_covariance_holds_its_senders():
    """Deviations squared, and the sender's doubt through the slopes of what is measured. Planted
    bugs: the sender's doubt left out; through the slopes of the body."""
    rng = np.random.default_rng(8)
    sender = drawn(rng, SENDER, [0.5, 0.7, 0.6, 2.0, 1.5, 2.5, 1, 1, 1])
    J = slopes(lambda s: what_is_measured(BODY, OWN, s), SENDER).astype(float)
    truth = np.diag(STD**2) + J @ sender.covariance @ J.T
    np.testing.assert_allclose(
        measurement_covariance(STD, BODY, sender), truth, rtol=1e-8, atol=1e-12
    )


@pytest.mark.parametrize(
    ("distance", "there"), [(9_000.0, True), (12_500.0, True), (13_200.0, False)]
)
def test_initiation_is_refused_where_its_place_is_too_unsure(distance, there):
    """Straight ahead a place is unsure by the distance times both cosines' deviations: 69, 96 and
    102 m, and 100 m is the limit. Planted bugs: the limit's square forgotten; no limit."""
    ahead = np.array([distance, 0.0, 0.0, 0.0])
    unsure = np.sqrt(STD[0] ** 2 + distance**2 * (STD[2] ** 2 + STD[3] ** 2))
    assert bool(unsure < 100) is there
    assert (initiate(ahead, STD, STILL, acceleration_std=1.0) is not None) is there


def test_the_velocity_of_a_new_track_is_what_its_rate_says():
    """At rest but for what is measured: of 10 m/s a priori per horizontal axis and 3 m/s upwards
    the rate, along the line of sight (a reflector's: along both ways' sum), takes its part by
    Bayes, and leaves what lies across; the acceleration is open. Planted bugs: deviations for
    variances; the rate of a moving terminal taken for the body's; upwards as along."""
    z = np.array([41.3, -6.1, 0.21, -0.13])
    e = STILL.rotation @ [0.21, np.sqrt(1 - 0.21**2 - 0.13**2), -0.13]
    for sender in (None, Gaussian(SENDER * ([1] * 3 + [0] * 6), np.zeros((9, 9)))):
        far = z + np.array([0 if sender is None else 60, 0, 0, 0])
        g = initiate(far, STD, STILL, sender, acceleration_std=1.7)
        towards = e
        if sender is not None:
            back = g.mean[:3] - sender.mean[:3]
            towards = e + back / np.linalg.norm(back)
        before = np.diag([100.0, 100.0, 9.0])
        gain = before @ towards / (towards @ before @ towards + STD[1] ** 2)
        assert g.mean[3:6] == pytest.approx(-6.1 * gain, abs=2e-3)
        velocity, after = g.covariance[3:6, 3:6], before - np.outer(gain, towards @ before)
        # what the place's doubt adds: 10 m/s times 0.006 rad under the mean, of second order
        for way in (towards, np.cross(towards, [0.3, 0.4, 0.9]), np.array([0.1, 0.3, 2.0])):
            assert way @ velocity @ way == pytest.approx(way @ after @ way, rel=0.03)
        assert not g.mean[6:].any()
        assert g.covariance[6:, 6:] == pytest.approx(1.7**2 * np.eye(3))
    moving = initiate(z, STD, OWN, acceleration_std=1.7)
    assert e @ (moving.mean[3:6] - OWN.velocity) == pytest.approx(-6.1, abs=0.02)


@pytest.mark.parametrize("bistatic", [False, True])
def test_a_new_track_is_the_posterior_of_what_was_measured(bistatic):
    """The place as a root of the exact measurement, its covariance by that root's differences with
    respect to what was measured and to where the transmitter is; then mean and covariance at the
    maximum of the posterior, given the rate. The transmitter's own errors are correlated: those of
    its velocity are in the rate's variance. The filter stops within 1e-3 deviations of its mean.
    Planted bugs: the rate's variance without the transmitter; with its place's errors alone; the
    place's covariance by the slopes in place of their inverse; no acceleration; the prior's mean
    kept."""
    sender = drawn(np.random.default_rng(31), SENDER, [0.4] * 3 + [0.7] * 3 + [0.1] * 3)
    z = np.asarray(what_is_measured(BODY, OWN, SENDER if bistatic else None), float)

    def place(read, end):
        """Where range and direction (3,) put a body at rest."""
        at = SENDER + np.concatenate([end, np.zeros(3)]) if bistatic else None

        def off(x):
            rest = what_is_measured(np.concatenate([x, np.zeros(3)]), OWN, at)
            return rest[[0, 2, 3]].astype(float) - read

        return least_squares(off, BODY[:3], xtol=1e-15, ftol=1e-15, gtol=1e-15).x

    read, nowhere, step = z[[0, 2, 3]], np.zeros(6), 1e-4
    G = np.stack([place(read + d, nowhere) - place(read - d, nowhere) for d in step * np.eye(3)]).T
    P = np.zeros((9, 9))
    P[:3, :3] = (G / (2 * step)) @ np.diag(STD[[0, 2, 3]] ** 2) @ (G / (2 * step)).T
    P[3:6, 3:6], P[6:, 6:] = np.diag([100, 100, 9]), 1.7**2 * np.eye(3)
    mean, variance = np.concatenate([place(read, nowhere), np.zeros(6)]), STD[1] ** 2
    if bistatic:
        doubt = sender.covariance[:6, :6]
        T = [place(read, d) - place(read, -d) for d in step * np.eye(6)]
        T = np.stack(T).T / (2 * step)
        P[:3, :3] += T @ doubt @ T.T
        by_end = slopes(lambda end: what_is_measured(mean, OWN, end)[1:2], SENDER[:6])
        variance += float((by_end @ doubt @ by_end.T).item())

    def rate(x):
        return what_is_measured(x, OWN, SENDER if bistatic else None)[1:2]

    root = np.linalg.cholesky(np.linalg.inv(P))

    def off(x):
        return np.concatenate(
            [root.T @ (x - mean), (rate(x) - z[1]).astype(float) / np.sqrt(variance)]
        )

    best = least_squares(off, mean, x_scale=np.sqrt(np.diag(P)), xtol=1e-15, ftol=1e-15).x
    H = slopes(rate, best).astype(float)
    exact = np.linalg.inv(np.linalg.inv(P) + H.T @ H / variance)
    deviation = np.sqrt(np.diag(exact))
    g = initiate(z, STD, OWN, sender if bistatic else None, acceleration_std=1.7)
    assert np.abs((g.mean - best) / deviation).max() < 1e-3
    assert np.abs((g.covariance - exact) / np.outer(deviation, deviation)).max() < 1e-3


@pytest.mark.parametrize(("passes", "periods"), [(1, 1), (1, -2), (2, 1)])
def test_a_folded_velocity_shifts_the_range(passes, periods):
    """Two paths are alike to a frame if their beats at mid-frame are equal and their phases from
    slot to slot differ by whole turns. A path whose velocity is read a period too high has its beat
    with a range that is 0.43 m (one pass) or 0.22 m too short: to 0.1 mm, for the carrier moves
    with the delay. Planted bugs: the shift's sign; the period of one pass for two."""
    w = Waveform(num_samples=1024, num_chirps=120)
    given = Ambiguity.of(w, passes)
    metres = SPEED_OF_LIGHT / passes
    tau, rate = 61.3 / metres, -31.7 / metres
    other = np.array([tau, rate]) + np.array([-given.shift, given.period]) * periods / metres
    turns = w.effective_carrier * (other[1] - rate) * w.slot_duration
    assert turns == pytest.approx(periods, abs=1e-9)
    cells = w.beat_cells(*other, 0.0) - w.beat_cells(tau, rate, 0.0)
    assert cells * w.range_cell(1) == pytest.approx(0.0, abs=1e-4)
    off = wrapped((other - [tau, rate]) * metres, given)
    assert off == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(("boresight", "readings"), [((0.0, 1.0, 0.0), 2), ((0.0, 0.0, 1.0), 1)])
def test_a_second_reading_is_as_fast_as_uavs_fly_there(boresight, readings):
    """2 m/s, or 26 m/s the other way, which is a UAV's speed along and not upwards. Planted bug: as
    fast upwards as along."""
    own, z = Pose.at_rest((0.0, 0.0, 0.0), boresight), np.array([[30.0, 2.0, 0.0, 0.0]])
    about = {"acceleration_std": 1.7, "ambiguity": Ambiguity(28.0)}
    assert len(initiate_all(z, STD[None], own, **about)[0]) == readings


def test_initiation_reads_a_velocity_nearest_to_standing_still():
    """A body that comes nearer, beyond half the period at a passive terminal: read a period too
    fast and 0.2 m too short, it is born where it is and with its rate; without the ambiguity 10
    cm off, and flying away. Planted bugs: nearest to the receiver's own velocity; the range
    kept."""
    z = np.asarray(what_is_measured(BODY, OWN, SENDER), float)
    given = Ambiguity(abs(z[1]) * 1.9, SHIFT)
    folded = z + np.sign(-z[1]) * np.array([-given.shift, given.period, 0, 0])
    sender = Gaussian(SENDER, 1e-8 * np.eye(9))
    true = initiate(z, STD, OWN, sender, acceleration_std=1.0)
    found = initiate(folded, STD, OWN, sender, acceleration_std=1.0, ambiguity=given)
    assert found.mean == pytest.approx(true.mean, abs=1e-6)
    assert found.covariance == pytest.approx(true.covariance, abs=1e-6)
    blind = initiate(folded, STD, OWN, sender, acceleration_std=1.0)
    assert np.linalg.norm((blind.mean - true.mean)[:3]) > 0.1
    assert measure(blind.mean, OWN, SENDER)[1] * z[1] < 0
