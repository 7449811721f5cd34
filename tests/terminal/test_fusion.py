"""Covariance intersection against its definition, and tracks of several terminals as one
picture."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.terminal.filter import Gaussian, predict
from isac_rt.terminal.fusion import (
    ATTITUDE_STD,
    POSE_STD,
    Key,
    Name,
    Picture,
    Report,
    advance,
    in_world,
    intersection,
    intersection_of,
)
from isac_rt.terminal.tracker import TrackSet
from isac_rt.world.swarm import Pose

RNG = np.random.default_rng(20)


def covariance(rng, size=6):
    root = rng.normal(size=(size, size)) * 10 ** rng.uniform(-1, 1, size)[:, None]
    return root @ root.T + 1e-3 * np.eye(size)


def by_definition(a, b, w):
    A, B = np.linalg.inv(a.covariance), np.linalg.inv(b.covariance)
    P = np.linalg.inv(w * A + (1 - w) * B)
    return P @ (w * A @ a.mean + (1 - w) * B @ b.mean), P


@pytest.mark.parametrize("seed", range(12))
def test_intersection_is_the_least_trace_of_its_definition(seed):
    """A scan of 20,001 weights: the least trace is met to the scan's own error, and mean and
    covariance are those of one weight. Planted bugs: the weights exchanged; the determinant in
    place of the trace."""
    rng = np.random.default_rng([3, seed])
    a, b = (Gaussian(rng.normal(size=6), covariance(rng)) for _ in range(2))
    weights = np.linspace(0, 1, 20_001)
    A, B = np.linalg.inv(a.covariance), np.linalg.inv(b.covariance)
    every = np.linalg.inv(weights[:, None, None] * A + (1 - weights)[:, None, None] * B)
    traces = np.trace(every, axis1=1, axis2=2)
    best = int(traces.argmin())
    fused = intersection(a, b)
    assert np.trace(fused.covariance) <= traces[best] * (1 + 1e-9)
    # the scan's weight is off by 2.5e-5 at most, which moves mean and covariance in proportion
    mean, P = by_definition(a, b, weights[best])
    spread = np.sqrt(np.diag(P))
    assert np.abs((fused.mean - mean) / spread).max() < 1e-2
    assert np.abs((fused.covariance - P) / np.outer(spread, spread)).max() < 1e-2


@pytest.mark.parametrize("seed", range(12))
def test_intersection_holds_whatever_the_estimates_have_in_common(seed):
    """Errors of a known joint covariance: that of the fused estimate, by its own weights, is never
    above what is stated, in any direction. Planted bug: the sum of the inverses in place of their
    mean."""
    rng = np.random.default_rng([4, seed])
    joint = covariance(rng, 12)
    A, B, C = joint[:6, :6], joint[6:, 6:], joint[:6, 6:]
    fused = intersection(Gaussian(np.zeros(6), A), Gaussian(np.zeros(6), B))
    gains = []
    for k in range(2):  # the estimate is linear in both means
        columns = []
        for e in np.eye(6):
            means = [np.zeros(6), np.zeros(6)]
            means[k] = e
            columns.append(intersection(Gaussian(means[0], A), Gaussian(means[1], B)).mean)
        gains.append(np.array(columns).T)
    K, L = gains
    true = K @ A @ K.T + L @ B @ L.T + K @ C @ L.T + L @ C.T @ K.T
    spread = np.sqrt(np.diag(fused.covariance))
    least = np.linalg.eigvalsh((fused.covariance - true) / np.outer(spread, spread)).min()
    assert least > -1e-9  # rounding
    assert np.allclose(K + L, np.eye(6), atol=1e-9)


def test_the_same_words_heard_again_count_once():
    """Planted bug: a product of the densities, which halves the covariance."""
    a = Gaussian(RNG.normal(size=6), covariance(RNG))
    again = intersection_of([a, a, a])
    assert np.allclose(again.mean, a.mean, rtol=1e-9)
    assert np.allclose(again.covariance, a.covariance, rtol=1e-9)


def told(key, mean, variances, time=0.0, since=0.0, name=None):
    state = Gaussian(np.array(mean, float), np.diag(np.array(variances, float)))
    key = Key(*key)
    return Report(key, since, name or Name(since, *key), time, state)


def test_two_terminals_that_see_from_two_sides_fix_a_body():
    """A terminal to the south knows y to 0.1 m and x to 2 m, one to the west x to 0.1 m and y to
    2 m. By symmetry w = 1/2, so that each axis has the variance 2 / (1/0.01 + 1/4), and the place
    lies where the sure axes cross, up to the weight of the unsure ones: 0.01 / 4.01 of 1.3 m."""
    fine, coarse = 0.01, 4.0
    rest = [0.04, 0.09, 0.09, 0.09]
    south = told(("S->S", 4), [31.3, 20.0, 12, 1, 2, 0], [coarse, fine, *rest])
    west = told(("S->W", 7), [30.0, 21.3, 12, 1, 2, 0], [fine, coarse, *rest])
    (body,) = Picture().update([south, west])
    assert set(body.members) == {south.key, west.key}
    variance = 2 / (1 / fine + 1 / coarse)
    assert np.allclose(np.diag(body.state.covariance), [variance, variance, *rest], rtol=1e-6)
    off = 1.3 * fine / (fine + coarse)
    assert np.allclose(body.state.mean, [30 + off, 20 + off, 12, 1, 2, 0], atol=1e-6)


def test_bodies_farther_apart_than_their_errors_stay_two():
    a = told(("A->A", 1), [30, 20, 12, 1, 2, 0], [0.01] * 6)
    b = told(("A->B", 1), [31, 20, 12, 1, 2, 0], [0.01] * 6)
    assert len(Picture().update([a, b])) == 2


def test_a_track_that_could_be_anything_does_not_take_the_place_of_a_sure_one():
    """Both lie within the gate, the vague one at the lesser Mahalanobis distance. Its likelihood is
    far less. Planted bug: the determinant left out."""
    body = told(("A->A", 1), [30, 20, 12, 1, 2, 0], [0.01] * 6)
    near = told(("A->B", 1), [30.2, 20, 12, 1, 2, 0], [0.01] * 6)
    vague = told(("A->B", 2), [33, 20, 12, 1, 2, 0], [25.0] * 6)
    found = Picture().update([body, near, vague])
    assert {frozenset(f.members) for f in found} == {
        frozenset({body.key, near.key}),
        frozenset({vague.key}),
    }


def test_two_tracks_of_one_terminal_are_two_bodies():
    a = told(("A->A", 1), [30, 20, 12, 1, 2, 0], [0.01] * 6)
    b = told(("A->A", 2), [30, 20, 12, 1, 2, 0], [0.01] * 6)
    assert len(Picture().update([a, b])) == 2


def test_a_pair_is_parted_later_than_it_would_be_joined():
    """chi squared of six: 16.8 at 0.99, 38.3 at 1 - 1e-6. With variances of 0.01 each an offset d
    has d^2 / 0.02: 0.7 m is 24.5, which joins nobody and parts nobody, 0.9 m is 40.5."""
    a = told(("A->A", 1), [30, 20, 12, 1, 2, 0], [0.01] * 6)

    def other(offset):
        return told(("A->B", 1), [30 + offset, 20, 12, 1, 2, 0], [0.01] * 6)

    apart, together = Picture(), Picture()
    assert len(apart.update([a, other(0.7)])) == 2
    assert len(together.update([a, other(0.1)])) == 1
    assert len(together.update([a, other(0.7)])) == 1
    assert len(together.update([a, other(0.9)])) == 2


def test_all_who_hear_of_the_earliest_track_call_the_body_by_it():
    """One listener hears the earlier track first, one the later one; a third comes after the
    earlier one has ended and has the name from who says the later one. Planted bug: the name of
    the first heard."""
    early = told(("A->A", 9), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.0)
    late = told(("A->B", 2), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.5)
    first, second = Picture(), Picture()
    first.update([early])
    second.update([late])
    for picture in (first, second):
        (body,) = picture.update([early, late])
        assert body.name == Name(1.0, "A->A", 9)
        (body,) = picture.update([late])
        assert body.name == Name(1.0, "A->A", 9)
    heard = told(("A->B", 2), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.5, name=body.name)
    (body,) = Picture().update([heard])
    assert body.name == Name(1.0, "A->A", 9)


def test_no_two_bodies_have_one_name():
    """A track that was part of a body leaves it and still brings the name along."""
    name = Name(1.0, "A->A", 9)
    early = told(("A->A", 9), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.0)
    away = told(("A->B", 2), [40, 20, 12, 1, 2, 0], [0.01] * 6, since=1.5, name=name)
    found = Picture().update([away, early])
    assert {f.members[0]: f.name for f in found} == {
        early.key: name,
        away.key: Name(1.5, "A->B", 2),
    }


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (2, 1, 0)])
def test_a_name_goes_back_to_the_body_with_its_track(order):
    """Three bodies: the second is known by the first one's name and has to fall back to that of its
    own track, by which the third is known meanwhile. That one had it too before."""
    a, b, c = Key("S->A", 1), Key("S->B", 1), Key("S->C", 1)
    known = {a: Name(0.0, *a), b: Name(0.0, *a), c: Name(1.0, *b)}
    picture = Picture()
    bodies = [[list(known[key]), [list(key)]] for key in (a, b, c)]
    picture.restore([bodies[i] for i in order])
    reports = [
        told(key, [50.0 * i, 0, 0, 0, 0, 0], [0.1] * 6, since=float(i), name=known[key])
        for i, key in enumerate((a, b, c))
    ]
    names = {body.members[0]: body.name for body in picture.update(reports)}
    assert names == {a: Name(0.0, *a), b: Name(1.0, *b), c: Name(2.0, *c)}


def test_a_terminal_is_known_by_what_it_says_of_itself():
    """The nearer in likelihood of two bodies; the other one stays a stranger."""
    itself = Gaussian(np.array([30.0, 20, 12, 1, 2, 0]), 0.0025 * np.eye(6))
    echo = told(("A->A", 1), [30.05, 20, 12, 1, 2, 0], [0.01] * 6)
    beside = told(("A->A", 2), [30.3, 20, 12, 1, 2, 0], [0.01] * 6)
    found = Picture().update([beside, echo], {"P": itself})
    assert {f.members[0]: f.terminal for f in found} == {echo.key: "P", beside.key: None}


def test_a_state_told_goes_on_as_the_tracks_do():
    """Against the filter of nine states whose acceleration is not known; twice half the time is
    not the whole, for the acceleration is forgotten in between."""
    P = covariance(RNG)
    nine = np.zeros((9, 9))
    nine[:6, :6], nine[6:, 6:] = P, 2.25 * np.eye(3)
    mean = RNG.normal(size=6)
    found = advance(Gaussian(mean, P), 0.37, 1.5)
    expected = predict(Gaussian(np.concatenate([mean, np.zeros(3)]), nine), 0.37, 1.5)
    assert np.allclose(found.mean, expected.mean[:6])
    assert np.allclose(found.covariance, expected.covariance[:6, :6])
    assert np.allclose(found.mean[:3], mean[:3] + 0.37 * mean[3:])


def test_what_is_told_holds_the_errors_of_who_tells():
    """A body 40 m ahead along y: pose, clock and, across the line of sight, attitude: 0.1 degrees
    at 40 m are 0.0698 m. Planted bugs: the attitude along the line of sight; no clock."""
    none = np.zeros(1)
    P = np.diag([0.01, 0.02, 0.03, 0.04, 0.05, 0.06])
    tracks = TrackSet(
        ids=none.astype(int),
        mean=np.array([[0.0, 40.0, 0.0, 1.0, 2.0, 3.0]]),
        covariance=P[None],
        range=none,
        velocity=none,
        direction=np.zeros((1, 2)),
        std=np.zeros((1, 4)),
        age=none.astype(int),
        confirmed=none == 0,
        is_reference=none > 0,
        detection=none.astype(int),
    )
    own = Pose.at_rest((5.0, -3.0, 20.0))
    state = in_world(tracks, 0, own, clock_std=0.3)
    assert np.allclose(state.mean, [5, 37, 20, 1, 2, 3])
    across, pose, clock = (40 * ATTITUDE_STD) ** 2, POSE_STD[0] ** 2, 0.09
    assert across == pytest.approx(0.0698**2, rel=1e-3)
    assert np.allclose(
        np.diag(state.covariance) - np.diag(P),
        [across + pose + clock, pose + clock, across + pose + clock, *[POSE_STD[1] ** 2] * 3],
    )


def test_a_lone_track_takes_its_old_name_along():
    """B's track was A's body, which A has lost; another one finds it again. Planted bug: the name
    left behind when bodies join."""
    early = told(("A->C", 9), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.0)
    late = told(("A->A", 2), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.5)
    newest = told(("A->B", 7), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=3.0)
    picture = Picture()
    picture.update([early, late])
    picture.update([late])
    (body,) = picture.update([late, newest])
    assert body.name == Name(1.0, "A->C", 9)
