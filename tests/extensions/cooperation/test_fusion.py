"""Covariance intersection against its definition, and tracks of several terminals as one
picture."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from isac_rt.extensions.cooperation.fusion import (
    ATTITUDE_STD,
    DATUM_STD,
    ERRORS,
    OWN_NOISE,
    FusedTracks,
    Report,
    Reported,
    _intersected,
    advance,
    at_once,
    distances,
    in_world,
    intersection,
    intersection_of,
    joint_states,
    report_of,
)
from isac_rt.track.filter import Gaussian, bistatic_distance, predict
from isac_rt.track.fused import Key, Name
from isac_rt.track.parts import POSE_STD, of_itself
from isac_rt.track.tracker import TrackSet
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


def track_report(key, mean, variances, time=0.0, since=0.0, name=None):
    state = Gaussian(np.array(mean, float), np.diag(np.array(variances, float)))
    key = Key(*key)
    return Report(key, since, name or Name(since, *key), time, state)


def test_two_terminals_that_see_from_two_sides_fix_a_body():
    """A terminal to the south knows y to 0.1 m and x to 2 m, one to the west x to 0.1 m and y to
    2 m. By symmetry w = 1/2, so that each axis has the variance 2 / (1/0.01 + 1/4), and the place
    lies where the sure axes cross, up to the weight of the unsure ones: 0.01 / 4.01 of 1.3 m."""
    fine, coarse = 0.01, 4.0
    rest = [0.04, 0.09, 0.09, 0.09]
    south = track_report(("S->S", 4), [31.3, 20.0, 12, 1, 2, 0], [coarse, fine, *rest])
    west = track_report(("S->W", 7), [30.0, 21.3, 12, 1, 2, 0], [fine, coarse, *rest])
    (uav,) = FusedTracks().update([south, west])
    assert set(uav.members) == {south.key, west.key}
    variance = 2 / (1 / fine + 1 / coarse)
    alike = np.repeat(np.square(DATUM_STD), 3)  # what both are wrong alike
    found = np.diag(uav.state.covariance) - alike
    assert np.allclose(found, [variance, variance, *rest], rtol=1e-6)
    off = 1.3 * fine / (fine + coarse)
    assert np.allclose(uav.state.mean, [30 + off, 20 + off, 12, 1, 2, 0], atol=1e-6)


def test_bodies_farther_apart_than_their_errors_stay_two():
    a = track_report(("A->A", 1), [30, 20, 12, 1, 2, 0], [0.01] * 6)
    b = track_report(("A->B", 1), [31, 20, 12, 1, 2, 0], [0.01] * 6)
    assert len(FusedTracks().update([a, b])) == 2


def test_a_track_that_could_be_anything_does_not_take_the_place_of_a_sure_one():
    """Both lie within the gate, the vague one at the lesser Mahalanobis distance. Its likelihood is
    far less. Planted bug: the determinant left out."""
    uav = track_report(("A->A", 1), [30, 20, 12, 1, 2, 0], [0.01] * 6)
    near = track_report(("A->B", 1), [30.2, 20, 12, 1, 2, 0], [0.01] * 6)
    vague = track_report(("A->B", 2), [33, 20, 12, 1, 2, 0], [25.0] * 6)
    found = FusedTracks().update([uav, near, vague])
    assert {frozenset(f.members) for f in found} == {
        frozenset({uav.key, near.key}),
        frozenset({vague.key}),
    }


def test_two_tracks_of_one_terminal_are_two_bodies_unless_uavs_cannot_be_so_near():
    """With errors that would let each of them be the other: 0.6 m apart they are two UAVs, 0.4 m
    apart one, which is parted again over 1 m. A track of another terminal changes nothing. Planted
    bugs: one only if a single terminal sees them; never parted."""
    a = track_report(("A->A", 1), [30, 20, 12, 1, 2, 0], [0.2] * 6)
    other = track_report(("A->B", 1), [30, 20, 12, 1, 2, 0], [0.2] * 6)

    def beside(offset):
        return track_report(("A->A", 2), [30 + offset, 20, 12, 1, 2, 0], [0.2] * 6)

    assert len(FusedTracks().update([a, beside(0.6)])) == 2
    for more in ([], [other]):
        fused_tracks = FusedTracks()
        (uav,) = fused_tracks.update([a, beside(0.4), *more])
        assert len(uav.members) == 2 + len(more)
        assert len(fused_tracks.update([a, beside(0.9), *more])) == 1
        assert len(fused_tracks.update([a, beside(1.1), *more])) == 2


def test_a_pair_is_parted_later_than_it_would_be_joined():
    """chi squared of six: 16.8 at 0.99, 38.3 at 1 - 1e-6. With variances of 0.01 each an offset d
    has d^2 / 0.02: 0.7 m is 24.5, which joins nobody and parts nobody, 0.9 m is 40.5."""
    a = track_report(("A->A", 1), [30, 20, 12, 1, 2, 0], [0.01] * 6)

    def other(offset):
        return track_report(("A->B", 1), [30 + offset, 20, 12, 1, 2, 0], [0.01] * 6)

    apart, together = FusedTracks(), FusedTracks()
    assert len(apart.update([a, other(0.7)])) == 2
    assert len(together.update([a, other(0.1)])) == 1
    assert len(together.update([a, other(0.7)])) == 1
    assert len(together.update([a, other(0.9)])) == 2


def test_all_who_hear_of_the_earliest_track_call_the_body_by_it():
    """One listener hears the earlier track first, one the later one; a third comes after the
    earlier one has ended and has the name from who says the later one. Planted bug: the name of
    the first heard."""
    early = track_report(("A->A", 9), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.0)
    late = track_report(("A->B", 2), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.5)
    first, second = FusedTracks(), FusedTracks()
    first.update([early])
    second.update([late])
    for fused_tracks in (first, second):
        (uav,) = fused_tracks.update([early, late])
        assert uav.name == Name(1.0, "A->A", 9)
        (uav,) = fused_tracks.update([late])
        assert uav.name == Name(1.0, "A->A", 9)
    received = track_report(
        ("A->B", 2), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.5, name=uav.name
    )
    (uav,) = FusedTracks().update([received])
    assert uav.name == Name(1.0, "A->A", 9)


def test_no_two_bodies_have_one_name():
    """A track that was part of a body leaves it and still brings the name along."""
    name = Name(1.0, "A->A", 9)
    early = track_report(("A->A", 9), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.0)
    away = track_report(("A->B", 2), [40, 20, 12, 1, 2, 0], [0.01] * 6, since=1.5, name=name)
    found = FusedTracks().update([away, early])
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
    uavs = [{"name": list(known[key]), "members": [list(key)]} for key in (a, b, c)]
    fused_tracks = FusedTracks()
    fused_tracks.restore({"state": {"uavs": [uavs[i] for i in order]}})
    reports = [
        track_report(key, [50.0 * i, 0, 0, 0, 0, 0], [0.1] * 6, since=float(i), name=known[key])
        for i, key in enumerate((a, b, c))
    ]
    names = {uav.members[0]: uav.name for uav in fused_tracks.update(reports)}
    assert names == {a: Name(0.0, *a), b: Name(1.0, *b), c: Name(2.0, *c)}


def test_a_terminal_is_known_by_what_it_says_of_itself():
    """The nearer in likelihood of two bodies; the other one stays a stranger."""
    itself = Gaussian(np.array([30.0, 20, 12, 1, 2, 0]), 0.0025 * np.eye(6))
    echo = track_report(("A->A", 1), [30.05, 20, 12, 1, 2, 0], [0.04] * 6)
    beside = track_report(("A->A", 2), [30.6, 20, 12, 1, 2, 0], [0.04] * 6)
    found = FusedTracks().update([beside, echo], {"P": report_of(itself)})
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


def test_reports_are_brought_to_one_time():
    """Of several ages, one of the instant itself, against each state and lever alone. Planted bugs:
    the lever of a place without that of its motion; the state of before in the whole."""
    rng = np.random.default_rng(21)
    told_of = [
        Reported(Gaussian(rng.normal(size=6), covariance(rng)), rng.normal(size=(6, ERRORS)))
        for _ in range(3)
    ]
    reports = [
        Report(Key("A->B", k), 0.0, Name(0.0, "A->B", k), time, *told_of[k])
        for k, time in enumerate((0.3, 0.7, 0.41))
    ]
    for report, before in zip(at_once(reports, 0.7, 1.5), reports, strict=True):
        alone = Reported(before.state, before.lever).after(0.7 - before.time, 1.5)
        assert (report.key, report.name, report.time) == (before.key, before.name, 0.7)
        assert np.allclose(report.state.mean, alone.state.mean, rtol=1e-12)
        assert np.allclose(report.state.covariance, alone.state.covariance, rtol=1e-12)
        assert np.allclose(report.lever, alone.lever, rtol=1e-12)
        assert np.allclose(report.whole.covariance, alone.whole.covariance, rtol=1e-12)
    assert at_once([], 0.7, 1.5) == []


def test_distances_within_the_gate():
    """Pairs near and far against the inverse and the determinant. Planted bugs: one variance for
    the trace; one covariance alone."""
    rng = np.random.default_rng(22)
    a, b = (
        [Gaussian(spread * rng.normal(size=6), covariance(rng)) for _ in range(9)]
        for spread in (0.3, 4.0)
    )
    d2, log_det = distances(a, b, 0.99)
    inside = np.zeros((9, 9), bool)
    for i, j in product(range(9), repeat=2):
        S, y = a[i].covariance + b[j].covariance, a[i].mean - b[j].mean
        expected = y @ np.linalg.solve(S, y)
        inside[i, j] = expected <= chi2.ppf(0.99, 6)
        if inside[i, j]:
            both = expected, np.linalg.slogdet(S)[1]
            assert (d2[i, j], log_det[i, j]) == pytest.approx(both, rel=1e-9)
    assert np.array_equal(np.isfinite(d2), inside) and np.array_equal(np.isfinite(log_det), inside)
    assert 5 < inside.sum() < 76


def tracked(*rows, reference=None):
    """Tracks at places and motions (6,) relative to their terminal, known to a decimetre or two."""
    mean = np.array(rows, float)
    none = np.zeros(len(rows))
    return TrackSet(
        ids=np.arange(len(rows)),
        mean=mean,
        covariance=np.tile(np.diag([0.01, 0.02, 0.03, 0.04, 0.05, 0.06]), (len(rows), 1, 1)),
        range=none,
        velocity=none,
        direction=np.zeros((len(rows), 2)),
        std=np.zeros((len(rows), 4)),
        age=none.astype(int),
        confirmed=none == 0,
        is_reference=np.arange(len(rows)) == reference,
        detection=none.astype(int),
        snr=none,
    )


def test_what_is_told_holds_the_errors_of_who_tells():
    """A body 40 m ahead along y: pose, clock and, across the line of sight, attitude: 0.3 degrees
    at 40 m are 0.209 m. What is told apart from them is the track's own. Planted bugs: the attitude
    along the line of sight; no clock; the clock on all axes."""
    tracks = tracked([0.0, 40.0, 0.0, 1.0, 2.0, 3.0])
    report_ = in_world(tracks, 0, Pose.at_rest((5.0, -3.0, 20.0)), clock_std=0.3)
    assert np.allclose(report_.state.mean, [5, 37, 20, 1, 2, 3])
    assert np.array_equal(report_.state.covariance, tracks.covariance[0])
    report = Report(Key("A->B", 0), 0.0, Name(0.0, "A->B", 0), 0.0, *report_)
    across, pose, clock = (40 * ATTITUDE_STD) ** 2, POSE_STD[0] ** 2, 0.09
    assert across == pytest.approx(0.209**2, rel=5e-3)
    assert np.allclose(
        np.diag(report.whole.covariance - report_.state.covariance)[:3],
        [across + pose, pose + clock, across + pose],
    )
    (later,) = at_once([report], 0.2, 1.0)
    assert np.allclose(later.lever[:3, 3:6], 0.2 * POSE_STD[1] * np.eye(3))


def test_a_lever_is_what_an_error_does():
    """A terminal that believes itself to be elsewhere, faster, turned by a small angle and its
    clock late places a reflector, at the same measured path length and direction in its array,
    where the lever has it: exact geometry, errors of a thousandth of a deviation, 1e-5 of a
    deviation. Planted bugs: the turn the other way round; a turn of place alone; the clock on the
    reflector's path alone."""
    own = Pose(np.array([5.0, -3.0, 20.0]), np.array([2.0, 1.0, 0.5]), np.zeros(3), np.eye(3))
    uav, sender = np.array([11.0, 31.0, -4.0, 3.0, -2.0, 1.0]), np.array([-20.0, 25.0, 2.0])
    tracks = tracked([*sender, 0, 0, 0], uav, reference=0)
    report_, lever = in_world(tracks, 1, own, clock_std=0.3)
    rho, d = np.linalg.norm(uav[:3]), np.linalg.norm(sender)
    u, length = uav[:3] / rho, rho + np.linalg.norm(uav[:3] - sender)
    deviations = np.array([*np.repeat(POSE_STD, 3), *[ATTITUDE_STD] * 3, 0.3])
    step = 1e-3
    for k, deviation in enumerate(deviations):
        e = np.zeros(ERRORS)
        e[k] = step * deviation
        turn = Rotation.from_rotvec(e[6:9]).as_matrix()
        far = bistatic_distance(length + e[9], sender * (d + e[9]) / d, u)
        place = own.position + e[:3] + turn @ (u * far)
        motion = own.velocity + e[3:6] + turn @ uav[3:]
        moved = (np.concatenate([place, motion]) - report_.mean) / step
        assert moved == pytest.approx(lever[:, k], abs=1e-5 + 1e-3 * deviation), k


@pytest.mark.parametrize(("beside", "pulled"), [(4.0, True), (9.0, False)])
def test_what_the_line_of_sight_pulls_is_unsure_along_its_direction(beside, pulled):
    """A reflector halfway to a transmitter 40 m away, whose way is 0.79 m longer, and one 3.9 m
    longer, where three cells are 1.4 m: half a cell more puts it, at the same direction, where the
    told covariance has it, by exact geometry. An active terminal has no line of sight. Planted
    bugs: the direction to the transmitter; the way pulled with its reference, as by a clock; pulled
    however far it is."""
    own, sender = Pose.at_rest((5.0, -3.0, 20.0)), np.array([0.0, 40.0, 0.0])
    uav = np.array([beside, 20.0, 0.0, 3.0, -2.0, 1.0])
    tracks = tracked([*sender, 0, 0, 0], uav, reference=0)
    more = in_world(tracks, 1, own, cell=0.47).state.covariance - tracks.covariance[1]
    rho = np.linalg.norm(uav[:3])
    length, u = rho + np.linalg.norm(uav[:3] - sender), uav[:3] / rho
    step = 1e-5
    moved = (bistatic_distance(length + step, sender, u) - rho) / step * 0.5 * 0.47 * u
    expected = np.zeros((6, 6))
    expected[:3, :3] = pulled * np.outer(moved, moved)
    assert more == pytest.approx(expected, rel=1e-3, abs=1e-6)  # of the difference
    alone = tracked([0.0, 40.0, 0.0, 1.0, 2.0, 3.0])
    assert np.array_equal(in_world(alone, 0, own, cell=0.47).state.covariance, alone.covariance[0])


@pytest.mark.parametrize("aside", [0.0, 1e-9, 1e-6, 1e-3])
def test_a_body_on_the_line_of_sight_is_told_with_nothing_known_along_it(aside):
    """A passive terminal's track that crosses its line of sight a third of the way: what it tells
    is known up and down as well as the track is, along the line to hundreds of metres at best, and
    in a picture the word of who sees it from aside counts. A metre of clock moves it by (13/39)^2,
    the limit of the geometry. Planted bugs: a division by nothing on the line, of a pull and of a
    clock."""
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    sender, uav = turn @ [0.0, 39.0, 0.0], turn @ [aside, 13.0, 0.0]
    tracks = tracked([*sender, 0, 0, 0], [*uav, 0, 0, 0], reference=0)
    own = Pose.at_rest((5.0, -3.0, 20.0))
    reported = in_world(tracks, 1, own, clock_std=1.0, cell=0.47)
    P, own_P = (
        turn.T @ C[:3, :3] @ turn for C in (reported.state.covariance, tracks.covariance[1])
    )
    assert P[1, 1] > 100**2
    assert P[2, 2] == pytest.approx(own_P[2, 2], abs=1e-3)  # rounding of (200 km)^2 is 1e-5
    assert turn.T @ reported.lever[:3, 9] == pytest.approx([0, 1 / 9, 0], abs=1e-3)
    seen = Gaussian(reported.state.mean + 0.01, 0.01 * np.eye(6))
    reports = [
        Report(Key(origin, 1), 0.0, Name(0.0, origin, 1), 0.0, state, lever)
        for origin, state, lever in (
            ("A->B", reported.state, reported.lever),
            ("A->A", seen, np.zeros((6, ERRORS))),
        )
    ]
    (one,) = FusedTracks().update(reports)
    assert np.abs(one.state.mean - seen.mean).max() < 0.1


def levered(key, mean, P, rng):
    lever = np.zeros((6, ERRORS))
    lever[:, : ERRORS - 1] = 0.3 * rng.normal(size=(6, ERRORS - 1))
    return Report(Key(*key), 0.0, Name(0.0, *key), 0.0, Gaussian(mean, P), lever)


def test_what_one_body_shows_of_a_terminal_helps_the_others():
    """A sees a terminal T that says where it is, and a stranger. In closed form, for a linear
    Gaussian model: T's own word leaves of A's errors C = I - L1' (L1 L1' + P1 + Q)^-1 L1, the
    stranger has P2 + L2 C L2', and its mean moves by -L2 L1' (...)^-1 of what A and T differ in.
    Planted bugs: errors of each track by itself; the errors' own information left out."""
    rng = np.random.default_rng(8)
    P1, P2 = (0.01 * covariance(rng) for _ in range(2))
    mean, other = rng.normal(size=6), rng.normal(size=6)
    one, two = levered(("A->A", 1), mean, P1, rng), levered(("A->A", 2), other, P2, rng)
    itself = of_itself(Pose(mean[:3] + 0.2, mean[3:] - 0.1, np.zeros(3), np.eye(3)))
    found = joint_states([[one], [two]], {0: ("T", report_of(itself))})
    L1, L2 = one.lever, two.lever
    S = L1 @ L1.T + P1 + itself.covariance + OWN_NOISE**2 * np.eye(6)
    C = np.eye(ERRORS) - L1.T @ np.linalg.solve(S, L1)
    exact = P2 + L2 @ C @ L2.T
    spread = np.sqrt(np.diag(exact))
    assert np.abs((found[1].covariance - exact) / np.outer(spread, spread)).max() < 1e-7
    moved = -L2 @ L1.T @ np.linalg.solve(S, mean - itself.mean)
    assert (found[1].mean - other) / spread == pytest.approx(moved / spread, abs=1e-7)
    assert np.linalg.norm(moved) > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_a_picture_is_the_solution_of_its_normal_equations(seed):
    """Everything at once in one dense system, from the formula, row by row and error by error. A
    terminal tells of four bodies over two links, whose clocks differ; another one of three, two of
    them the same; a third tells of nothing but itself. Weights are those of `_intersected`, which
    has tests of its own. Planted bugs: one clock for both links; errors that several words share
    counted once; the errors' own information left out; a word's own weight left out; `D` added in
    place of taken off."""
    rng = np.random.default_rng([23, seed])
    told_by = [("A->A", "S->A", "A->B"), ("A->A",), ("S->A", "A->B"), ("A->A", "A->B"), ("A->B",)]
    uavs = [
        [
            replace(
                levered((origin, k), rng.normal(size=6), 0.1 * covariance(rng), rng),
                lever=0.4 * rng.normal(size=(6, ERRORS)),
            )
            for origin in origins
        ]
        for k, origins in enumerate(told_by)
    ]
    words = {
        name: report_of(Gaussian(rng.normal(size=6), np.eye(6))).after(0.3, 2.0)
        for name in ("B", "T")
    }
    found = joint_states(uavs, {1: ("B", words["B"]), 4: ("T", words["T"])})

    unknown = [("body", k, i) for k in range(len(uavs)) for i in range(6)]
    unknown += [("pose", name, i) for name in "ABT" for i in range(ERRORS - 1)]
    unknown += [("clock", link) for link in ("A->A", "S->A", "A->B")]
    number = {what: n for n, what in enumerate(unknown)}
    information, vector = np.zeros((len(number),) * 2), np.zeros(len(number))
    for what, n in number.items():
        information[n, n] = what[0] != "body"

    def add(k, terminal, clock, state, lever, weight):
        A = np.zeros((6, len(number)))
        for i in range(6):
            A[i, number["body", k, i]] = 1
            for j in range(ERRORS - 1):
                A[i, number["pose", terminal, j]] = lever[i, j]
            if clock is not None:
                A[i, number["clock", clock]] = lever[i, -1]
        inverse = weight * np.linalg.inv(state.covariance)
        information[:] += A.T @ inverse @ A
        vector[:] += A.T @ inverse @ state.mean

    for k, reports in enumerate(uavs):
        for report, w in zip(reports, _intersected([r.whole for r in reports])[1], strict=True):
            origin = report.key.origin
            add(k, origin[-1], origin, report.state, report.lever, w)
    for k, name in ((1, "B"), (4, "T")):
        add(k, name, None, *words[name], 1.0)
    C = np.linalg.inv(information)
    mean, spread = C @ vector, np.sqrt(np.diag(C))
    for k, uav in enumerate(found):
        rows = slice(6 * k, 6 * k + 6)
        off = (uav.covariance - C[rows, rows]) / np.outer(spread[rows], spread[rows])
        assert np.abs(off).max() < 1e-8  # rounding, of a conditioning of 1e6
        assert np.abs((uav.mean - mean[rows]) / spread[rows]).max() < 1e-7


@pytest.mark.parametrize("acceleration", [0.1, 3.0])
def test_a_word_of_some_time_ago_has_the_errors_of_then_carried_on(acceleration):
    """A sees T, T sees a stranger, and T's word of itself is 0.4 s old: its place is off by 0.4 s
    of its velocity's error, too, which is that of its track of the stranger. Generalised least
    squares of the three with the covariance of all their errors. Planted bug: the word's errors as
    if it were new, the rest of its covariance apart (what is left of it is none at 0.1 m/s^2)."""
    rng, age = np.random.default_rng(9), 0.4
    P1, P2 = (0.01 * covariance(rng) for _ in range(2))
    D = np.diag(np.repeat(POSE_STD, 3))
    lever = np.hstack([D, np.zeros((6, ERRORS - 6))])
    of_t, of_stranger = (
        Report(Key(o, 1), 0.0, Name(0.0, o, 1), 0.0, Gaussian(rng.normal(size=6), P), of)
        for o, P, of in (("A->A", P1, np.zeros((6, ERRORS))), ("T->T", P2, lever))
    )
    itself = Gaussian(0.1 * rng.normal(size=6), D**2)
    word = report_of(itself).after(age, acceleration)
    found = joint_states([[of_t], [of_stranger]], {0: ("T", word)})

    carry = np.kron([[1, age], [0, 1]], np.eye(3))
    rest = advance(Gaussian(np.zeros(6), OWN_NOISE**2 * np.eye(6)), age, acceleration).covariance
    L = np.vstack([np.zeros((6, 6)), D, carry @ D])
    N = L @ L.T + block_diag(P1, P2, rest)
    H = np.kron([[1, 0], [0, 1], [1, 0]], np.eye(6))
    y = np.concatenate([of_t.state.mean, of_stranger.state.mean, carry @ itself.mean])
    C = np.linalg.inv(H.T @ np.linalg.solve(N, H))
    mean, spread = C @ H.T @ np.linalg.solve(N, y), np.sqrt(np.diag(C))
    for k, rows in enumerate((slice(0, 6), slice(6, 12))):
        off = (found[k].covariance - C[rows, rows]) / np.outer(spread[rows], spread[rows])
        assert np.abs(off).max() < 1e-7
        assert found[k].mean / spread[rows] == pytest.approx(mean[rows] / spread[rows], abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_errors_of_terminals_are_told_apart_whatever_else_is_common(seed):
    """Two terminals see the same three bodies. Their own errors are correlated from terminal to
    terminal in a way of which nothing is said; the estimate is linear in what is told, so that its
    true covariance follows from its gains: never above what is stated, in any direction. Planted
    bugs: weights of one each; the levers of the two exchanged."""
    rng = np.random.default_rng([5, seed])
    joints = [0.1 * covariance(rng, 12) for _ in range(3)]
    keys = [("S->A", "S->B")[t] for t in (0, 1)]
    levers = [[0.3 * rng.normal(size=(6, ERRORS)) for _ in range(3)] for _ in keys]

    def estimate(values):
        uavs = []
        for j, joint in enumerate(joints):
            blocks = joint[:6, :6], joint[6:, 6:]
            uavs.append(
                [
                    Report(
                        Key(origin, j),
                        0.0,
                        Name(0.0, origin, j),
                        0.0,
                        Gaussian(values[t, j], blocks[t]),
                        levers[t][j],
                    )
                    for t, origin in enumerate(keys)
                ]
            )
        return joint_states(uavs, {})

    nothing = np.zeros((2, 3, 6))
    stated = estimate(nothing)
    gains = np.zeros((3, 6, 2, 3, 6))
    for place in np.ndindex(2, 3, 6):
        values = nothing.copy()
        values[place] = 1.0
        for j, uav in enumerate(estimate(values)):
            gains[(j, slice(None), *place)] = uav.mean
    errors = np.zeros((2, 3, 6, 2, 3, 6))
    for t in range(2):
        common = np.stack(levers[t]).reshape(18, ERRORS)
        errors[t, :, :, t] = (common @ common.T).reshape(3, 6, 3, 6)
    for j, joint in enumerate(joints):
        errors[:, j, :, :, j] += joint.reshape(2, 6, 2, 6)
    for j, uav in enumerate(stated):
        G = gains[j].reshape(6, 36)
        true = G @ errors.reshape(36, 36) @ G.T
        spread = np.sqrt(np.diag(uav.covariance))
        least = np.linalg.eigvalsh((uav.covariance - true) / np.outer(spread, spread)).min()
        assert least > -1e-8  # rounding


def test_a_lone_track_takes_its_old_name_along():
    """B's track was A's body, which A has lost; another one finds it again. Planted bug: the name
    left behind when bodies join."""
    early = track_report(("A->C", 9), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.0)
    late = track_report(("A->A", 2), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=1.5)
    newest = track_report(("A->B", 7), [30, 20, 12, 1, 2, 0], [0.01] * 6, since=3.0)
    fused_tracks = FusedTracks()
    fused_tracks.update([early, late])
    fused_tracks.update([late])
    (uav,) = fused_tracks.update([late, newest])
    assert uav.name == Name(1.0, "A->C", 9)
