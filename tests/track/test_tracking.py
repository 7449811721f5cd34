"""EKF, association and management of tracks."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from one_detection import initiate
from scipy.stats import chi2

from isac_rt.receive.types import Detections
from isac_rt.track.filter import (
    INITIAL_SPEED_STD,
    STD_FLOOR,
    Ambiguity,
    Gaussian,
    bistatic_distance,
    curvature,
    expected,
    jacobian,
    measure,
    measurement_covariance,
    narrowed,
    predict,
    singer,
    transmitter_jacobian,
    update,
    wrapped,
)
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Track, Tracker, assign
from isac_rt.world.swarm import Pose, attitude

OWN = Pose(
    np.array([3.1, -2.7, 31.3]),
    np.array([4.3, 7.9, -0.6]),
    np.zeros(3),
    attitude(np.array([0.5, 1.2, -0.15])),
)
BODY = np.array([14.7, 28.9, 27.1, -3.7, 6.1, 1.3])
AT = np.array([-21.3, 33.7, 40.9, 8.3, -2.1, 0.4])
STD = np.array([0.031, 0.083, 0.0047, 0.0061])
PERIOD = 30.017


def detections(z: np.ndarray, std: np.ndarray = STD, snr: float = 50.0) -> Detections:
    z = np.asarray(z, float).reshape(-1, 4)
    return Detections(
        range=z[:, 0].copy(),
        velocity=z[:, 1].copy(),
        direction=z[:, 2:].copy(),
        snr=np.full(len(z), snr),
        std=np.tile(std, (len(z), 1)),
        is_reference=np.zeros(len(z), bool),
        starts=np.ones(len(z), bool),
    )


def test_measurement_by_hand():
    """Range, rate and direction of a body straight ahead and to the right; planted bug: rate
    without the own velocity."""
    own = Pose(np.array([1.0, 2.0, 3.0]), np.array([0.0, 4.0, 0.0]), np.zeros(3), np.eye(3))
    z = measure(np.array([4.0, 6.0, 3.0, 0.0, 9.0, 0.0]), own)
    assert z == pytest.approx([5.0, 4.0, 0.6, 0.0], abs=1e-14)  # rounding
    z = measure(
        np.array([4.0, 6.0, 3.0, 0.0, 9.0, 0.0]), own, np.array([4.0, 6.0, 15.0, 1.0, 2.0, -3.0])
    )
    assert z == pytest.approx([17.0, 4.0 + 3.0 * -1.0, 0.6, 0.0], abs=1e-14)


@pytest.mark.parametrize("transmitter", [None, AT])
def test_rate_is_the_derivative_of_range(transmitter):
    """Central difference over time of the first component; planted bug: rate of the outward segment
    left out."""
    h = 1e-4

    def range_at(t: float) -> float:
        move = np.concatenate([t * BODY[3:], np.zeros(3)])
        own = Pose(OWN.position + t * OWN.velocity, OWN.velocity, OWN.acceleration, OWN.rotation)
        at = (
            None
            if transmitter is None
            else transmitter + np.concatenate([t * transmitter[3:], np.zeros(3)])
        )
        return measure(BODY + move, own, at)[0]

    discretisation = 1e-7  # h^2/6 of the third derivative (< 1 m/s^3) and 50 m * eps / h
    assert measure(BODY, OWN, transmitter)[1] == pytest.approx(
        (range_at(h) - range_at(-h)) / (2 * h), abs=discretisation
    )


def test_slopes_over_the_transmitter_against_complex_step():
    """Planted bug: projector I - e e^T without the division by the distance."""
    h, rounding = 1e-30, 1e-13
    step = np.stack(
        [measure(BODY.astype(complex), OWN, AT + 1j * h * d).imag / h for d in np.eye(6)], axis=1
    )
    assert np.abs(step).max() > 0.1
    assert transmitter_jacobian(BODY, AT) == pytest.approx(step, abs=rounding)


@pytest.mark.parametrize(
    "transmitter", [None, Gaussian(AT, np.diag([1e-4, 2e-4, 1e-4, 0.01, 0.02, 0.01]))]
)
def test_initiation_reproduces_the_detection_and_its_covariance(transmitter):
    """The state measures what was measured, its position is the reflector's, and 2,000 noisy
    initiations scatter as it says; planted bug: covariance with J instead of its inverse."""
    t = None if transmitter is None else transmitter.mean
    z = measure(BODY, OWN, t)
    g = initiate(z, STD, OWN, transmitter, acceleration_std=1.0)
    assert g.mean[:3] == pytest.approx(
        BODY[:3], abs=1e-4
    )  # of deviations of 0.1 m; the pull named below
    # the rate pulls the direction a little because the transversal velocity is open: 10 m/s * 0.005
    # against 0.08 m/s
    assert measure(g.mean, OWN, t)[0] == pytest.approx(z[0], abs=0.01)
    assert measure(g.mean, OWN, t)[1] == pytest.approx(z[1], abs=0.02)
    assert np.linalg.eigvalsh(g.covariance).min() > 0
    rng = np.random.default_rng(5)
    position = []
    for _ in range(2000):
        if transmitter is None:
            at = None
        else:
            at = Gaussian(
                transmitter.mean
                + np.sqrt(np.diag(transmitter.covariance)) * rng.standard_normal(6),
                transmitter.covariance,
            )
        noisy = z + STD * rng.standard_normal(4)
        position.append(initiate(noisy, STD, OWN, at, acceleration_std=1.0).mean[:3] - BODY[:3])
    spread = np.cov(np.array(position).T)
    ratio = np.linalg.solve(g.covariance[:3, :3], spread)
    # statistical: 2,000 samples, std of a variance 3.2 %, five of them; nonlinearity below 2 %
    assert np.trace(ratio) / 3 == pytest.approx(1.0, abs=0.16)


def test_initiation_refuses_what_fixes_no_position():
    start = partial(initiate, std=STD, own=OWN, acceleration_std=1.0)
    assert start(np.array([20.0, 1.0, np.nan, np.nan])) is None
    assert start(np.array([20.0, 1.0, 0.8, 0.7])) is None
    short = np.linalg.norm(AT[:3] - OWN.position) - 0.5
    at = Gaussian(AT, np.eye(6) * 1e-4)
    assert start(np.array([short, 1.0, 0.2, 0.1]), transmitter=at) is None


def test_no_track_starts_in_the_very_place_of_the_transmitter():
    """It has no direction from there. A length next to the baseline's puts a body there by
    rounding. Planted bug: the Jacobian not asked, which then is not a number and no matrix to
    invert."""
    own, at = Pose.at_rest((0.0, 0.0, 0.0)), np.array([0.0, 10.0, 0.0])
    lengths = 10.0 + np.spacing(10.0) * np.arange(1, 40)
    there = [x for x in lengths if bistatic_distance(x, at, at / 10) == 10.0]
    assert there
    sender = Gaussian(np.concatenate([at, np.zeros(3)]), 1e-4 * np.eye(6))
    for length in there:
        assert initiate(np.array([length, 0, 0, 0]), STD, own, sender, acceleration_std=1.0) is None


def test_filter_against_the_joint_posterior():
    """A body so far away that the measurement is affine: filter against the batch posterior over
    all states and measurements, from the full precision matrix; planted bugs: Q without the
    position block, Joseph term K R K^T left out."""
    own = Pose(np.zeros(3), np.array([1.3, 0.7, 0.2]), np.zeros(3), OWN.rotation)
    far = 3e6 * own.to_world(np.array([0.31, np.sqrt(1 - 0.31**2 - 0.17**2), -0.17]))
    origin = np.concatenate([far, [3.3, -4.1, 1.2], np.zeros(3)])
    rng = np.random.default_rng(3)
    root = rng.normal(size=(9, 9)) * np.repeat([0.7, 2.0, 3.0], 3)[:, None]
    prior = Gaussian(origin, root @ root.T + 0.01 * np.eye(9))
    R = np.diag(np.array([0.31, 0.27, 2.2e-7, 1.9e-7]) ** 2)
    intervals, sigma = [0.11, 0.07, 0.19, 0.13], 3.7
    h0, scale = measure(origin, own), np.repeat([0.5, 5.0, 5.0], 3)
    H = np.stack(
        [
            (measure(origin + s * d, own) - measure(origin - s * d, own)) / (2 * s)
            for s, d in zip(scale, np.eye(9), strict=True)
        ],
        1,
    )

    x = prior.mean + np.linalg.cholesky(prior.covariance) @ rng.standard_normal(9)
    g, zs, Fs, Qs = prior, [], [], []
    for dt in intervals:
        F, Q = singer(dt, sigma)  # against their own integral: `isac-rt validate`
        x = F @ x + np.linalg.cholesky(Q) @ rng.standard_normal(9)
        z = measure(x, own) + np.sqrt(np.diag(R)) * rng.standard_normal(4)
        g = update(predict(g, dt, sigma), z, R, own)
        zs, Fs, Qs = [*zs, z], [*Fs, F], [*Qs, Q]

    # joint Gaussian of (x_1..x_n) a priori, then conditioned on all measurements at once
    n = len(intervals)
    mean, blocks = [prior.mean], [[prior.covariance]]
    for F, Q in zip(Fs, Qs, strict=True):
        mean.append(F @ mean[-1])
        blocks.append([F @ c for c in blocks[-1]] + [F @ blocks[-1][-1] @ F.T + Q])
    C = np.zeros((9 * (n + 1), 9 * (n + 1)))
    for i in range(n + 1):
        for j in range(i + 1):
            C[9 * i : 9 * i + 9, 9 * j : 9 * j + 9] = blocks[i][j]
            C[9 * j : 9 * j + 9, 9 * i : 9 * i + 9] = blocks[i][j].T
    A = np.kron(np.eye(n + 1)[1:], H)
    innovation = np.concatenate(
        [z - h0 - H @ (m - origin) for z, m in zip(zs, mean[1:], strict=True)]
    )
    gain = C @ A.T @ np.linalg.inv(A @ C @ A.T + np.kron(np.eye(n), R))
    batch_mean = np.concatenate(mean) + gain @ innovation
    batch_covariance = C - gain @ A @ C
    # curvature at 3,000 km: 2 m^2 / 6e6 m; rounding of 3e6 m: 1e-9 m over deviations of 2e-7 rad
    affine = 1e-3
    scale = np.sqrt(np.diag(batch_covariance)[-9:])
    assert (g.mean - batch_mean[-9:]) / scale == pytest.approx(np.zeros(9), abs=affine)
    assert g.covariance / np.outer(scale, scale) == pytest.approx(
        batch_covariance[-9:, -9:] / np.outer(scale, scale), abs=affine
    )


@pytest.mark.parametrize(("transmitter", "interval"), [(None, 0.0078), (None, 0.156), (AT, 0.05)])
def test_consistency_in_monte_carlo(transmitter, interval):
    """NEES of the last state and NIS of the last innovations over independent runs, born from one
    detection, against chi-square; planted bug: R doubled in `update` (NIS falls to a half)."""
    rng, runs, steps, sigma = np.random.default_rng(17), 90, 20, 1.7
    F, Q = singer(interval, sigma)
    root = np.linalg.cholesky(Q)
    nees, nis = [], []
    for _ in range(runs):
        x = np.concatenate(
            [BODY[:3] + rng.normal(0, 3.0, 3), INITIAL_SPEED_STD * rng.standard_normal(3)]
        )
        own, at = OWN, None if transmitter is None else transmitter.copy()
        full = np.concatenate([x, sigma * rng.standard_normal(3)])

        def see(x, own, at):
            return measure(x, own, at) + STD * rng.standard_normal(4)

        exact = None if at is None else Gaussian(at, np.zeros((6, 6)))
        g = initiate(see(x, own, at), STD, own, exact, acceleration_std=sigma)
        for _ in range(steps):
            full = F @ full + root @ rng.standard_normal(9)
            x = full[:6]
            own = Pose(
                own.position + interval * own.velocity, own.velocity, own.acceleration, own.rotation
            )
            if at is not None:
                at = np.concatenate([at[:3] + interval * at[3:], at[3:]])
            exact = None if at is None else Gaussian(at, np.zeros((6, 6)))
            g = predict(g, interval, sigma)
            z, R = see(x, own, at), measurement_covariance(STD, g.mean, exact)
            z_mean, S = expected(g.mean, g.covariance, own, exact)
            innovation = (z - z_mean) @ np.linalg.solve(S + R, z - z_mean)
            g = update(g, z, R, own, at)
            assert np.array_equal(g.covariance, g.covariance.T)
            assert np.linalg.eigvalsh(g.covariance).min() > 0
        error = x - g.mean[:6]
        nees.append(error @ np.linalg.solve(g.covariance[:6, :6], error))
        nis.append(innovation)
    # statistical: two-sided 1e-4 each; 4 % for what linearisation leaves
    for values, freedom in ((nees, 6 * runs), (nis, 4 * runs)):
        low, high = chi2.ppf([5e-5, 1 - 5e-5], freedom)
        assert 0.96 * low < np.sum(values) < 1.04 * high


@pytest.mark.parametrize("transmitter", [None, AT])
def test_curvature_is_what_linearisation_leaves_out(transmitter):
    """Range and rate of 400,000 drawn states less their linear parts: covariances within 5 % of the
    larger variance (1.5 % statistical, the rest of third order). Planted bugs: without the
    derivative by position and velocity; half of it; range for rate."""
    rng = np.random.default_rng(23)
    root = np.zeros((9, 9))
    root[:6, :6] = np.tril(rng.standard_normal((6, 6))) * np.repeat([0.5, 2.0], 3)[:, None]
    mean = np.append(BODY, np.zeros(3))
    x = mean + rng.standard_normal((400_000, 9)) @ root.T
    linear = (x - mean) @ jacobian(mean, OWN, transmitter).T
    left = (measure(x, OWN, transmitter) - linear)[:, :2]
    found = curvature(Gaussian(mean, root @ root.T), OWN, transmitter)
    scale = np.sqrt(np.diag(found)[:2])
    assert np.cov(left.T) / np.outer(scale, scale) == pytest.approx(
        found[:2, :2] / np.outer(scale, scale), abs=0.05
    )
    assert not found[2:].any() and not found[:, 2:].any()


def test_what_directions_leave_unknown_is_that_of_the_information_form():
    """P^-1 + H^T R^-1 H with the derivatives H of both cosines by complex steps is the inverse of
    the covariance left; planted bug: the rows of range and rate."""
    mean, root = np.append(BODY, np.zeros(3)), np.random.default_rng(3).standard_normal((9, 9))
    P, R = root @ root.T, np.diag(STD**2)
    steps = mean + 1e-30j * np.eye(9)
    H = np.array([measure(x, OWN)[2:].imag / 1e-30 for x in steps]).T
    found = narrowed(Gaussian(mean[None], P[None]), R[None], OWN).covariance[0]
    expected = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.inv(R[2:, 2:]) @ H)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_a_board_that_hardly_tells_heights_tracks_them():
    """Deviations of an AWR1843 at 17 dB: heights to 2 m, ranges to 2 cm. Over 60 flights of two
    seconds the last position is off by less than 1 m in the median, and by what chance exceeds once
    in 370 in at most a quarter; the first position's NEES is below 2. Planted bugs: an update
    without `curvature` (1.2 m, four fifths); an initiation without it (NEES above 10)."""
    rng, own, std = np.random.default_rng(4), Pose.at_rest(), np.array([0.02, 0.02, 0.018, 0.075])
    start = np.array([7.5, 27.4, 4.0, 0.2, -3.1, 0.3])
    off, nees = [], []
    for _ in range(60):
        tracker = Tracker(Tracking(), Ambiguity())
        for t in 0.05 * np.arange(40):
            x = np.append(start[:3] + t * start[3:], start[3:])
            tracker.predict(t)
            tracker.update(detections(measure(x, own) + std * rng.standard_normal(4), std), own)
            if t in (0.0, 0.05 * 39):
                state = max(tracker.tracks, key=lambda one: one.age).state
                error = state.mean[:3] - x[:3]
                off.append(np.linalg.norm(error))
                nees.append(error @ np.linalg.solve(state.covariance[:3, :3], error))
    assert np.median(off[1::2]) < 1.0 and np.mean(nees[::2]) / 3 < 2
    assert np.mean(np.array(nees[1::2]) > chi2.ppf(1 - 1 / 370, 3)) <= 0.25


def test_missing_direction_reduces_the_measurement():
    """Without direction the update equals one with infinite direction deviations; planted bug: NaN
    taken as zero."""
    g = predict(initiate(measure(BODY, OWN) + STD, STD, OWN, acceleration_std=1.0), 0.02, 1.0)
    z = measure(BODY, OWN) + 0.7 * STD
    partial = update(g, np.array([z[0], z[1], np.nan, np.nan]), np.diag(STD**2), OWN)
    wide = update(g, z, np.diag([STD[0] ** 2, STD[1] ** 2, 1e12, 1e12]), OWN)
    assert partial.mean == pytest.approx(wide.mean, abs=1e-6)
    assert partial.covariance == pytest.approx(wide.covariance, abs=1e-6)


def test_velocity_is_taken_modulo_its_period():
    """A measured velocity beyond the unambiguous span pulls the track by the folded difference
    only."""
    g = predict(initiate(measure(BODY, OWN), STD, OWN, acceleration_std=1.0), 0.02, 1.0)
    z = measure(BODY, OWN)
    folded = z - np.array([0.0, PERIOD, 0.0, 0.0])
    R = np.diag(STD**2)
    assert update(g, folded, R, OWN, ambiguity=Ambiguity(PERIOD)).mean == pytest.approx(
        update(g, z, R, OWN).mean, abs=1e-9
    )
    assert wrapped(np.array([1.0, 0.6 * PERIOD, 0.1, 0.2]), Ambiguity(PERIOD))[1] == pytest.approx(
        -0.4 * PERIOD
    )


def test_std_floor_holds():
    R = measurement_covariance(np.array([1e-9, 1e-9, np.nan, 1.0]), BODY)
    assert np.sqrt(np.diag(R)) == pytest.approx([STD_FLOOR[0], STD_FLOOR[1], STD_FLOOR[2], 1.0])


def test_assign_takes_as_many_pairs_as_it_can():
    """The greedy choice (0, 0) would leave row 1 alone; planted bug: refused pairs cost too
    little."""
    cost = np.array([[0.1, 9.0], [0.2, np.inf]])
    assert assign(cost) == [(0, 1), (1, 0)]
    assert assign(np.full((2, 3), np.inf)) == []


def fly(
    tracker: Tracker, frames: int, bodies: list[np.ndarray], interval: float, seed: int, hidden=()
):
    """Frames of noisy detections in a shuffled order; yields the frame, the true states and the
    snapshot."""
    rng = np.random.default_rng(seed)
    for k in range(frames):
        t = k * interval
        states = [np.concatenate([b[:3] + t * b[3:], b[3:]]) for b in bodies]
        own = Pose(OWN.position + t * OWN.velocity, OWN.velocity, OWN.acceleration, OWN.rotation)
        z = np.array(
            [measure(x, own) for x in states if k not in hidden] or np.zeros((0, 4))
        ).reshape(-1, 4)
        z = z + STD * rng.standard_normal(z.shape)
        tracker.predict(t)
        tracker.update(detections(rng.permutation(z)), own)
        yield k, states, tracker.snapshot(own)


def test_crossing_targets_keep_their_tracks():
    """Two bodies whose ranges and directions cross; each id stays with its body."""
    first, second = BODY.copy(), BODY.copy()
    second[:3] += [2.0, 4.0, 0.4]
    second[3:] = [-6.9, -1.0, 0.6]
    tracker = Tracker(Tracking(), Ambiguity(PERIOD))
    owner: dict[int, int] = {}
    nearest = np.inf
    for k, states, tracks in fly(tracker, 60, [first, second], 0.02, 8):
        world = tracks.mean[:, :3] + OWN.position + k * 0.02 * OWN.velocity
        nearest = min(nearest, np.linalg.norm(states[0][:3] - states[1][:3]))
        for i in np.flatnonzero(tracks.confirmed):
            who = int(np.argmin([np.linalg.norm(world[i] - x[:3]) for x in states]))
            if np.linalg.norm(states[0][:3] - states[1][:3]) > 1.5:
                assert owner.setdefault(int(tracks.ids[i]), who) == who
    assert nearest < 0.5
    assert sorted(owner.values()) == [0, 1]
    assert tracks.confirmed.sum() == 2


@pytest.mark.parametrize("interval", [0.05, 0.5])
def test_a_swarm_that_turns_keeps_its_tracks(interval):
    """Three bodies fly straight for 2 s, then a circle by 3 m/s^2; each is one track all the way.
    Planted bug: a density 100 times too low."""
    rng, speed = np.random.default_rng(6), 9.0
    start, turn = rng.normal((5, 70, 30), (12, 9, 5), (3, 3)), 3.0 / speed  # [m], [rad/s]
    own, tracker, ids = (
        Pose.at_rest(OWN.position, (0.1, 1.2, -0.1)),
        Tracker(Tracking(), Ambiguity(60.0)),
        set(),
    )
    for k in range(int(5 / interval)):
        straight, angle = min(k * interval, 2.0), turn * max(k * interval - 2.0, 0.0)
        place = start + np.array(
            [speed * straight + speed / turn * np.sin(angle), speed / turn * (1 - np.cos(angle)), 0]
        )
        velocity = np.tile([speed * np.cos(angle), speed * np.sin(angle), 0.0], (3, 1))
        z = measure(np.concatenate([place, velocity], axis=1), own)
        tracker.predict(k * interval)
        tracker.update(detections(rng.permutation(z + STD * rng.standard_normal(z.shape))), own)
        ids |= {track.id for track in tracker.tracks if track.confirmed}
    assert len(ids) == len(tracker.tracks) == 3


def test_initiation_confirmation_and_deletion():
    """Confirmed at the third hit, dropped after eight misses, a new id afterwards; a single false
    alarm lives until it can no longer reach 3 of 5. Planted bug: misses not reset by a hit."""
    settings = Tracking()
    tracker = Tracker(settings, Ambiguity())
    hidden = {6, 7, 8} | set(range(12, 20))
    seen = {
        k: (tracks.ids.tolist(), tracks.confirmed.tolist())
        for k, _, tracks in fly(tracker, 24, [BODY], 0.02, 2, hidden)
    }
    assert seen[0] == ([0], [False]) and seen[1] == ([0], [False]) and seen[2] == ([0], [True])
    assert seen[8] == ([0], [True]) and seen[18] == ([0], [True])
    assert seen[19] == ([], [])
    assert seen[20] == ([1], [False]) and seen[22] == ([1], [True])
    alone = Tracker(settings, Ambiguity())
    lives = [len(tracks) for _, _, tracks in fly(alone, 6, [BODY], 0.02, 2, set(range(1, 6)))]
    assert lives == [1, 1, 1, 0, 0, 0]


def test_a_folded_velocity_starts_a_track_in_both_readings():
    """A body that recedes by 0.55 of the period, in the world too: after three frames one track is
    confirmed, at its velocity, and the other reading ends. Planted bugs: the reading nearest to
    standing still alone; the range of the second one kept."""
    fold = Ambiguity(PERIOD, 0.217)
    body = np.concatenate([BODY[:3], OWN.velocity])
    away = measure(body, OWN)[0]
    body[3:] += 0.55 * PERIOD * (body[:3] - OWN.position) / away
    tracker = Tracker(Tracking(), fold)
    for k in range(6):
        now = replace(OWN, position=OWN.position + 0.02 * k * OWN.velocity)
        z = measure(body + np.concatenate([0.02 * k * body[3:], np.zeros(3)]), now)
        tracker.predict(0.02 * k)
        tracker.update(detections(z - np.array([fold.shift, fold.period, 0, 0])), now)
        if k == 0:
            assert sorted(t.detection for t in tracker.tracks) == [0, 0]
    assert [t.confirmed for t in tracker.tracks] == [True]
    assert tracker.snapshot(now).velocity[0] == pytest.approx(0.55 * PERIOD, abs=0.1)


def test_prediction_lists_reference_then_confirmed_reflectors():
    """Weights are powers over the strongest's; tentative tracks are left out."""
    tracker = Tracker(Tracking(), Ambiguity(2 * PERIOD))
    at = Gaussian(AT, np.eye(6) * 1e-4)
    reference_id = tracker.new_id()
    other = BODY + np.array([7.0, 9.0, 1.0, 1.0, -2.0, 0.0])
    for k in range(4):
        tracker.predict(0.0078 * k)
        bodies = [BODY] + ([other] if k == 3 else [])
        tracker.update(detections([measure(b, OWN, AT) for b in bodies], snr=20.0), OWN, at)
    reference = Track(reference_id, at, 1000.0, confirmed=True)
    prediction = tracker.to_prediction(OWN, reference)
    assert prediction.weight == pytest.approx([1.0, 0.02])
    assert prediction.range[0] == pytest.approx(np.linalg.norm(AT[:3] - OWN.position))
    assert prediction.range[1] == pytest.approx(measure(BODY, OWN, AT)[0], abs=0.3)
    assert (prediction.range_std > 0).all()
    tracks = tracker.snapshot(OWN, reference)
    assert tracks.ids.tolist() == [0, 1, 2] and tracks.is_reference.tolist() == [True, False, False]
    assert tracks.mean[0, :3] == pytest.approx(AT[:3] - OWN.position)


def test_a_bistatic_track_finds_the_reflector():
    """Fifty frames with a moving AT and receiver: position within three of its own deviations, and
    these below 0.5 m."""
    rng, tracker = np.random.default_rng(4), Tracker(Tracking(), Ambiguity(2 * PERIOD))
    for k in range(50):
        t = 0.0078 * k
        move = [np.concatenate([s[:3] + t * s[3:], s[3:]]) for s in (BODY, AT)]
        own = Pose(OWN.position + t * OWN.velocity, OWN.velocity, OWN.acceleration, OWN.rotation)
        z = measure(move[0], own, move[1]) + STD * rng.standard_normal(4)
        tracker.predict(t)
        tracker.update(detections(z), own, Gaussian(move[1], np.eye(6) * 1e-5))
    tracks = tracker.snapshot(own)
    assert tracks.confirmed.tolist() == [True]
    error = tracks.mean[0] - (move[0] - np.concatenate([own.position, own.velocity]))
    deviation = np.sqrt(np.diag(tracks.covariance[0]))
    assert (np.abs(error) < 4 * deviation).all() and deviation[:3].max() < 0.5


def test_a_track_says_which_detection_updated_it():
    """Rows of the frame's detections, whatever their order; -1 while it coasts. Planted bugs: the
    row kept while coasting, the row among the detections that no confirmed track took."""
    tracker = Tracker(Tracking(), Ambiguity())
    far = BODY + np.array([17.0, 9.0, 1.0, 1.0, -2.0, 0.0])
    expected_rows = ([0, 1], [1, 0], [0, 1], [1, 0], [-1, 0], [-1, -1])
    for k, rows in enumerate(expected_rows):
        t = 0.02 * k
        z = np.zeros((max(rows) + 1, 4))
        for body, row in zip((BODY, far), rows, strict=True):
            if row >= 0:
                place = np.concatenate([body[:3] + t * body[3:], body[3:]])
                own = OWN.position + t * OWN.velocity
                z[row] = measure(place, Pose(own, OWN.velocity, np.zeros(3), OWN.rotation))
        now = Pose(OWN.position + t * OWN.velocity, OWN.velocity, np.zeros(3), OWN.rotation)
        tracker.predict(t)
        tracker.update(detections(z), now)
        assert tracker.snapshot(now).detection.tolist() == rows


@pytest.mark.parametrize("sender", [None, Gaussian(AT, 1e-4 * np.eye(6))])
@pytest.mark.parametrize(
    ("sure", "frame"), [((1, 1, 0, 0), 1), ((1, 0, 0, 1), 3), ((1, 0, 0, 0), None)]
)
def test_one_sure_detection_confirms_no_track(sure, frame, sender):
    """Four detections in a row, some of which could have started the track: both kinds of terminal
    confirm it by two that are sure. Planted bugs: any two; the first not counted; three at a
    passive one."""
    settings = Tracking(initiation="unexplained")
    tracker, first = Tracker(settings, Ambiguity(np.inf, 0.0)), None
    z = measure(BODY, OWN, None if sender is None else sender.mean)
    for n, starts in enumerate(sure):
        tracker.predict(1e-6 * n)
        one = detections(z)
        tracker.update(replace(one, starts=np.array([bool(starts)])), OWN, sender)
        if first is None and tracker.tracks[0].confirmed:
            first = n
    assert first == frame


@pytest.mark.parametrize("sender", [None, Gaussian(AT, 1e-4 * np.eye(6))])
def test_two_detections_are_a_target(sender):
    """Detected in each frame, a track is a target more probably than not from the second one on.
    Planted bug: from the first."""
    tracker = Tracker(Tracking(initiation="unexplained"), Ambiguity(np.inf, 0.0))
    z, said = measure(BODY, OWN, None if sender is None else sender.mean), []
    for n in range(4):
        tracker.predict(1e-6 * n)
        tracker.update(detections(z), OWN, sender)
        said.append(tracker.tracks[0].credible)
    assert said == [False, True, True, True]
