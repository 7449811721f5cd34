"""One filter of several terminals' detections: against drawn errors, differences, and itself in
another order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from isac_rt.extensions.cooperation.centralised import (
    ERRORS,
    POSE,
    CentralisedTracker,
    JointState,
    Scan,
    TrackManagement,
    _View,
)
from isac_rt.extensions.cooperation.fusion import ATTITUDE_STD
from isac_rt.storage import pack, unpack
from isac_rt.track.filter import Ambiguity, measure
from isac_rt.track.fused import Key, Name
from isac_rt.track.parts import POSE_STD
from isac_rt.track.settings import Tracking
from isac_rt.world.swarm import Pose

T = 0.05
PLACES = {"A": ((0.0, 0.0, 20.0), (0, 1, 0)), "B": ((12.0, 60.0, 24.0), (-0.2, -1, 0))}
FLIGHTS = {"A": (1.0, 3.0, 0.2), "B": (-0.5, -2.0, 0.1)}
BODIES = np.array([[4.0, 28, 22, 1.0, 4, 0.2], [-6.0, 35, 19, -2.0, 1.5, 0.1]])
STD = np.array([0.01, 0.05, 2e-3, 2e-3])
SETTINGS = Tracking(acceleration_std_mps2=0.05)
CLOCK_STD = 0.2


def true_pose(name, time):
    place, boresight = PLACES[name]
    start = Pose.at_rest(place, boresight)
    velocity = np.array(FLIGHTS[name])
    return replace(start, position=start.position + time * velocity, velocity=velocity)


def believed(pose, error):
    turn = Rotation.from_rotvec(error[6:9]).as_matrix()
    return replace(
        pose,
        position=pose.position + error[:3],
        velocity=pose.velocity + error[3:6],
        rotation=turn @ pose.rotation,
    )


def bodies_at(time):
    return np.column_stack([BODIES[:, :3] + time * BODIES[:, 3:], BODIES[:, 3:]])


def measure_channels(rx, frame, errors, rng, sure=True, which=(0, 1)):
    """A's chirps seen by `rx`, with its errors, and what A says of itself."""
    time = T * frame
    own, sender = true_pose(rx, time), true_pose("A", time)
    state = np.concatenate([sender.position, sender.velocity])
    z = np.array([measure(b, own, None if rx == "A" else state) for b in bodies_at(time)])
    z += rng.normal(size=z.shape) * STD
    z[:, 0] += errors[rx][9]
    rows = np.array(which, int)
    scan = Scan(
        f"A->{rx}",
        frame,
        time,
        believed(own, errors[rx]),
        CLOCK_STD if rx == "B" else 0.0,
        rows,
        z[rows],
        np.tile(STD, (len(rows), 1)),
        np.array([100.0, 50.0])[rows],
        np.full(len(rows), sure),
        (None,) * len(rows),
        (0, 1),
    )
    return scan, None if rx == "A" else state + errors["A"][:6]


def drawn(rng):
    std = [*[POSE_STD[0]] * 3, *[POSE_STD[1]] * 3, *[ATTITUDE_STD] * 3]
    return {
        "A": np.append(rng.normal(size=9) * std, 0.0),
        "B": np.append(rng.normal(size=9) * std, rng.normal() * CLOCK_STD),
    }


FIRST = 2 * POSE + 1
"""States before the bodies': of both terminals, and of the clocks of the link from A to B."""
NONE = {"A": np.zeros(ERRORS), "B": np.zeros(ERRORS)}


def tracker(terminals=("A", "B")):
    folds = Ambiguity(30.0), Ambiguity(60.0)
    return CentralisedTracker(terminals, SETTINGS, TrackManagement(3, 5 * T, 0.36), folds)


def test_bodies_and_errors_lie_where_their_covariances_say():
    """Thirty draws of all errors: the squared errors of both bodies' states and of all nineteen
    states of the terminals and of B's clock, in their joint covariance, are chi squared within what
    30 draws may be off at 1e-4. Planted bugs: the sign of the errors at initiation; errors of the
    transmitter left out; the attitude's cross product the other way round."""
    rng, total, freedom = np.random.default_rng(7), 0.0, 0
    for _ in range(30):
        errors, joint = drawn(rng), tracker()
        for frame in range(6):
            for rx in "AB":
                assert joint.add(*measure_channels(rx, frame, errors, rng))
        found = joint.latest
        assert len(found.uavs) == 2
        order = np.argsort([b.fed["A->A"][0] for b in found.uavs])
        truth = np.concatenate([errors["A"][:POSE], errors["B"]])  # B's clock comes last
        kept = [*range(FIRST)]
        for i, uav in zip(order, bodies_at(T * 5), strict=True):
            truth = np.append(truth, uav)
            kept += [FIRST + 9 * int(i) + k for k in range(6)]
        e = found.mean[kept] - truth
        total += e @ np.linalg.solve(found.covariance[np.ix_(kept, kept)], e)
        freedom += len(kept)
    low, high = stats.chi2.ppf([5e-5, 1 - 5e-5], freedom) / freedom
    assert low < total / freedom < high


def test_the_clock_of_a_passive_terminal_is_found_by_what_both_see():
    """B's clock makes its paths 0.3 m longer, which A's ranges show: most of 0.2 m of deviation is
    taken away, and the error is found within four deviations."""
    errors, rng = {**NONE, "B": np.append(np.zeros(9), 0.3)}, np.random.default_rng(3)
    joint = tracker()
    for frame in range(8):
        for rx in "AB":
            joint.add(*measure_channels(rx, frame, errors, rng))
    at = FIRST - 1
    std = np.sqrt(joint.latest.covariance[at, at])
    assert std < CLOCK_STD / 2
    assert abs(joint.latest.mean[at] - 0.3) < 4 * std


def test_each_link_of_a_terminal_has_clocks_of_its_own():
    """B hears A with paths 0.3 m too long and C, beside A, with paths 0.2 m too short: both are
    found within four deviations that are half of what was stated. As one state they would be a
    mean. Planted bugs: one clock for a receiver; a new clock in the place of the first one's."""
    errors, rng = {**NONE, "B": np.append(np.zeros(9), 0.3)}, np.random.default_rng(3)
    joint = tracker(("A", "B", "C"))
    for frame in range(8):
        joint.add(*measure_channels("A", frame, errors, rng))
        scan, sender = measure_channels("B", frame, errors, rng)
        joint.add(scan, sender)
        z = scan.z - np.array([0.5, 0, 0, 0])
        joint.add(replace(scan, origin="C->B", z=z), sender)
    memory = joint.memory()
    again = tracker(("A", "B", "C"))
    again.restore(memory)
    for found in (joint.latest, again.latest):
        assert [*found.clocks] == ["A->B", "C->B"]
        for k, late in ((3 * POSE, 0.3), (3 * POSE + 1, -0.2)):
            std = np.sqrt(found.covariance[k, k])
            assert std < CLOCK_STD / 2
            assert abs(found.mean[k] - late) < 4 * std


def test_errors_that_nobody_sees_stay_as_uncertain_as_they_were():
    """A stationary process: after 5 s without detections the prior variances. Planted bug: noise
    of 1 - k for a memory of k instead of 1 - k^2."""
    joint = tracker()
    scan, _ = measure_channels("A", 0, NONE, np.random.default_rng(1), which=())
    joint.add(scan, None)
    later = np.diag(joint._predicted(joint.latest, 5.0).covariance)[:POSE]
    assert later == pytest.approx(
        np.square([*[POSE_STD[0]] * 3, *[POSE_STD[1]] * 3, *[ATTITUDE_STD] * 3])
    )


def test_a_clock_that_nobody_sees_is_as_uncertain_as_was_stated_last():
    """B states 0.2 m, 5 s later 0.5 m and then 0.4 m: the prior deviation is the largest of what
    was said, however long ago. Planted bugs: a clock's error is forgotten as a pose's is; only the
    first statement counts."""
    joint, rng = tracker(), np.random.default_rng(1)
    at = FIRST - 1
    for frame, stated, expected in ((0, 0.2, 0.2), (100, 0.5, 0.5), (101, 0.4, 0.5)):
        scan, sender = measure_channels("B", frame, NONE, rng, which=())
        joint.add(replace(scan, clock_std=stated), sender)
        assert np.sqrt(joint.latest.covariance[at, at]) == pytest.approx(expected)
    later = joint._predicted(joint.latest, 30.0)
    assert np.sqrt(later.covariance[at, at]) == pytest.approx(0.5)


@pytest.mark.parametrize("rx", ["A", "B"])
def test_derivatives_by_differences(rx):
    """Of what is measured with respect to the errors of both ends, at errors that are not zero;
    a thousandth of their size apart."""
    rng = np.random.default_rng(5)
    scan, sender = measure_channels(rx, 3, drawn(rng), rng)
    clock = None if rx == "A" else FIRST - 1
    view, uav = _View(scan, sender, ["A", "B"], clock), bodies_at(T * 3)[0] + 0.1

    def measured(x):
        return view.measured(x, uav, *view.corrected(x))

    x = np.array([*[0.02, -0.03, 0.01, 0.04, 0.02, -0.05, 1e-3, 5e-4, -8e-4] * 2, 0.01])
    H = np.zeros((4, FIRST))
    view.errors_into(H, uav, *view.corrected(x))
    for k in range(FIRST):
        step = np.zeros_like(x)
        step[k] = 1e-6
        slope = (measured(x + step) - measured(x - step)) / 2e-6
        assert np.allclose(H[:, k], slope, atol=2e-3 * max(1.0, np.abs(slope).max())), k


def test_the_order_in_which_detections_come_plays_no_part():
    """Twelve looks in order, and in three others: the same bits. What comes too late counts for
    nothing. Planted bug: a late look on the latest state."""
    rng = np.random.default_rng(11)
    scans = [measure_channels(rx, frame, NONE, rng) for frame in range(6) for rx in "AB"]
    pictures = []
    for _ in range(4):
        joint = tracker()
        for k in rng.permutation(12) if pictures else range(12):
            assert joint.add(*scans[k])
        pictures.append(joint.at(T * 6))
    for other in pictures[1:]:
        for a, b in zip(pictures[0], other, strict=True):
            assert a.name == b.name and a.members == b.members
            assert np.array_equal(a.state.mean, b.state.mean)
            assert np.array_equal(a.state.covariance, b.state.covariance)
    joint = tracker()
    for scan in scans[4:]:
        joint.add(*scan)
    joint.forget(T * 2 + 0.51)
    assert not joint.add(*scans[0])


def test_what_two_links_see_is_sure_before_either_is():
    """Tentative at both: three hits of two links confirm, three of one do not, one of a confirmed
    track does. Planted bug: hits of one link alone."""
    rng = np.random.default_rng(2)

    def confirmed(*seen):
        joint = tracker()
        for rx, frame, sure in seen:
            joint.add(*measure_channels(rx, frame, NONE, rng, sure=sure, which=(0,)))
        return len(joint.at(T * 3))

    assert confirmed(("A", 0, False), ("A", 1, False), ("A", 2, False)) == 0
    assert confirmed(("A", 0, False), ("B", 1, False), ("A", 2, False)) == 1
    assert confirmed(("A", 0, False), ("B", 0, False)) == 0
    assert confirmed(("B", 2, True)) == 1


def test_a_body_ends_without_detections():
    """0.36 s after its last one, not before."""
    joint = tracker()
    joint.add(*measure_channels("A", 0, NONE, np.random.default_rng(1)))
    assert len(joint.at(0.35)) == 2
    assert len(joint.at(0.37)) == 0


def test_a_body_ends_with_the_tracks_that_it_rests_on():
    """A gives up its track 1: the body of both links stays with B's, and ends when B has given it
    up too. Planted bug: a body that goes with the first of its tracks."""
    rng = np.random.default_rng(8)
    joint = tracker()
    for rx in "AB":
        joint.add(*measure_channels(rx, 0, NONE, rng))
    scan, sender = measure_channels("A", 1, NONE, rng, which=(0,))
    joint.add(replace(scan, kept=(0,)), sender)
    members = [set(uav.members) for uav in joint.at(T)]
    assert {Key("A->B", 1)} in members and len(members) == 2
    scan, sender = measure_channels("B", 2, NONE, rng, which=(0,))
    joint.add(replace(scan, kept=(0,)), sender)
    assert [set(b.members) for b in joint.at(2 * T)] == [{Key("A->A", 0), Key("A->B", 0)}]


def test_an_outlier_is_no_body_of_its_own():
    """B's track has fed a body that A follows well; one detection of it lies 1.5 m off. A second
    body appears only where the track stays there for longer than the window."""
    rng = np.random.default_rng(8)
    joint, counts = tracker(), []
    for frame in range(12):
        joint.add(*measure_channels("A", frame, NONE, rng, which=(0,)))
        scan, sender = measure_channels("B", frame, NONE, rng, which=(0,))
        off = np.array([1.5, 0.0, 0.0, 0.0]) if frame >= 4 else np.zeros(4)
        joint.add(replace(scan, z=scan.z + off), sender)
        counts.append(len(joint.latest.uavs))
    assert counts == [1] * 8 + [2] * 4


def test_everyone_calls_a_body_by_the_earliest_name_that_was_told():
    """B has followed it since before: its detections say so. Two bodies never share a name."""
    rng, old = np.random.default_rng(9), Name(-1.0, "A->B", 3)
    joint = tracker()
    joint.add(*measure_channels("A", 0, NONE, rng))
    scan, sender = measure_channels("B", 1, NONE, rng)
    joint.add(replace(scan, names=(old, old)), sender)
    names = [uav.name for uav in joint.at(T)]
    assert sorted(names)[0] == old and len(set(names)) == 2
    assert joint.names_of(scan).count(old) == 1
    assert {Key("A->A", 0), Key("A->B", 0)} in [set(b.members) for b in joint.at(T)]


def test_two_bodies_in_one_place_become_one():
    """What A alone and B alone have followed, put side by side: each pair is one body under the
    earlier name, with the state of the surer; with a common track they stay apart. Planted bugs:
    the later name; bodies merged that one terminal follows apart."""
    joint, alone = tracker(), {}
    for rx in "AB":
        one, rng = tracker(), np.random.default_rng(4)
        for frame in range(6):
            one.add(*measure_channels(rx, frame, NONE, rng))
        alone[rx] = one.latest
    count = 2 * POSE
    states = [alone[rx].mean[-18:] for rx in "AB"]  # of two bodies
    blocks = [alone[rx].covariance[-18:, -18:] for rx in "AB"]
    both = JointState(
        T * 5,
        np.concatenate([np.zeros(count), *states]),
        block_diag(1e-4 * np.eye(count), *blocks),
        alone["A"].uavs + alone["B"].uavs,
    )
    found = joint._merged(both)
    assert [uav.name.origin for uav in found.uavs] == ["A->A", "A->A"]
    assert [set(uav.fed) for uav in found.uavs] == [{"A->A", "A->B"}] * 2
    assert len(found.mean) == count + 2 * 9
    shared = {"A->A": (7, 0.2)}
    watched = [replace(b, fed={**b.fed, **shared}) for b in both.uavs]
    assert len(joint._merged(replace(both, uavs=tuple(watched))).uavs) == 4


def test_memory_goes_on_with_the_same_bits():
    """By way of the file's own form. Planted bugs: names, hits or the transmitter left out."""
    rng = np.random.default_rng(6)
    scans = [measure_channels(rx, frame, drawn(rng), rng) for frame in range(14) for rx in "AB"]
    joint, again = tracker(), tracker()
    for scan in scans[:24]:
        joint.add(*scan)
    joint.forget(T * 11)
    again.restore(unpack(*pack(joint.memory())))
    for one in (joint, again):
        for scan in scans[24:]:
            one.add(*scan)
    a, b = joint.latest, again.latest
    assert np.array_equal(a.mean, b.mean) and np.array_equal(a.covariance, b.covariance)
    assert a.uavs == b.uavs
