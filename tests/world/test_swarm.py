"""Trajectories and attitude."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.scenario.swarm import Uav
from isac_rt.world.settings import Waypoint
from isac_rt.world.swarm import Pose, Swarm, Trajectory, attitude

WAYPOINTS = tuple(
    Waypoint(time_s=t, position_m=p)
    for t, p in [
        (0.0, (0.3, 1.7, 20.1)),
        (1.3, (8.2, 9.1, 22.7)),
        (2.9, (17.4, 8.8, 25.3)),
        (4.1, (22.9, -3.1, 24.2)),
    ]
)


def test_attitude_is_a_right_handed_frame():
    """Columns: right, boresight, up; planted bug: Z = Y x X."""
    r = attitude(np.array([0.8, -2.3, 0.4]))
    assert r.T @ r == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(r) == pytest.approx(1.0)
    assert r[2, 2] > 0.9
    north = attitude(np.array([0.0, 3.0, 0.0]))
    assert north == pytest.approx(np.eye(3))  # facing north, east is to the right


def test_many_positions_at_once_are_those_of_the_poses():
    """Bit for bit, beyond the waypoints too. Planted bug: no straight way beyond them."""
    times = np.linspace(-1.3, 9.7, 57)
    waypoints = [
        {"time_s": t, "position_m": p} for t, p in ((0, (1, 2, 3)), (4, (-7, 9, 5)), (8, (3, 1, 8)))
    ]
    for way in ({"waypoints": waypoints}, {"position_m": (1, 2, 3), "velocity_mps": (4, -5, 0.7)}):
        flight = Trajectory(Uav.model_validate({"role": "active", **way}))
        alone = np.array([flight.pose(t).position for t in times])
        assert np.array_equal(flight.positions(times), alone)


def test_boresight_follows_velocity_or_stays():
    moving = Uav(role="passive", position_m=(0, 0, 0), velocity_mps=(3.0, -1.0, 0.0))
    fixed = moving.model_copy(update={"boresight": (0.0, -1.0, 0.0)})
    y = Trajectory(moving).pose(1.0).rotation[:, 1]
    assert y == pytest.approx(np.array([3.0, -1.0, 0.0]) / np.sqrt(10))
    assert Trajectory(fixed).pose(1.0).rotation[:, 1] == pytest.approx(np.array([0.0, -1.0, 0.0]))


def test_straight_flight_by_hand():
    """Planted bug: time with the other sign."""
    pose = Trajectory(
        Uav(role="target", position_m=(1.0, 2.0, 3.0), velocity_mps=(0.5, -4.0, 0.25))
    ).pose(2.0)
    assert pose.position.tolist() == [2.0, -6.0, 3.5]
    assert pose.motion().tolist() == [[2.0, -6.0, 3.5], [0.5, -4.0, 0.25], [0.0, 0.0, 0.0]]


def test_body_axes_and_back():
    """A body that looks east has south to its right; and any vector comes back from its axes.
    Planted bug: one way's matrix not transposed."""
    pose = Pose.at_rest((0, 0, 9), (1, 0, 0))
    assert pose.motion().tolist() == [[0, 0, 9], [0, 0, 0], [0, 0, 0]]
    assert pose.to_body(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])) == pytest.approx(
        np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    )
    assert pose.to_world(np.array([0.0, 1.0, 0.0])) == pytest.approx(np.array([1.0, 0.0, 0.0]))
    tilted = Pose.at_rest((0, 0, 9), (0.8, -2.3, 0.4))
    v = np.array([[0.3, -1.1, 2.0], [1.7, 0.2, -0.4]])
    assert tilted.to_world(tilted.to_body(v)) == pytest.approx(v, abs=1e-14)
    assert tilted.to_body(np.array([0.8, -2.3, 0.4]))[[0, 2]] == pytest.approx([0, 0], abs=1e-14)


def test_what_looks_nowhere_looks_north_and_straight_up_has_east_to_its_right():
    """A UAV that hovers; a vertical boresight. Planted bugs: it looks east; west to its right."""
    hovering = Trajectory(Uav(role="passive", position_m=(1, 2, 3))).pose(0.4)
    assert hovering.rotation == pytest.approx(np.eye(3))
    for up in (1.0, -1.0):
        assert attitude((0, 0, up))[:, 0].tolist() == [1.0, 0.0, 0.0]
        assert attitude((0, 0, up))[:, 1].tolist() == [0.0, 0.0, up]


def natural_spline(times, values, t):
    """The cubic through the values with no curvature at its ends, by solving for the second
    derivatives at the time samples in the textbook's form: (3, 3) place, velocity and
    acceleration."""
    n, h = len(times), np.diff(times)
    A, b = np.eye(n), np.zeros((n, 3))
    for i in range(1, n - 1):
        A[i, i - 1 : i + 2] = h[i - 1], 2 * (h[i - 1] + h[i]), h[i]
        b[i] = 6 * ((values[i + 1] - values[i]) / h[i] - (values[i] - values[i - 1]) / h[i - 1])
    m = np.linalg.solve(A, b)
    i = min(int(np.searchsorted(times, t, side="right")) - 1, n - 2)
    left, right = times[i + 1] - t, t - times[i]
    ends = values[i] / h[i] - m[i] * h[i] / 6, values[i + 1] / h[i] - m[i + 1] * h[i] / 6
    place = (m[i] * left**3 + m[i + 1] * right**3) / (6 * h[i]) + ends[0] * left + ends[1] * right
    velocity = (m[i + 1] * right**2 - m[i] * left**2) / (2 * h[i]) + ends[1] - ends[0]
    return np.stack([place, velocity, (m[i] * left + m[i + 1] * right) / h[i]])


def test_beyond_the_waypoints_it_flies_straight_on():
    """Before the first and after the last, at which it has no acceleration. Planted bugs: other
    conditions at the ends; the line before the start in the wrong direction."""
    trajectory = Trajectory(Uav(role="target", waypoints=WAYPOINTS))
    first = trajectory.pose(0.0)
    assert first.acceleration == pytest.approx(np.zeros(3), abs=1e-12)
    before = trajectory.pose(-1.5)
    assert before.position == pytest.approx(first.position - 1.5 * first.velocity)
    assert before.velocity == pytest.approx(first.velocity) and not before.acceleration.any()
    last, after = trajectory.pose(4.1), trajectory.pose(6.0)
    assert after.position == pytest.approx(last.position + 1.9 * last.velocity)
    assert not after.acceleration.any()


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_pose_moves_as_the_natural_spline_does(count):
    """Place, velocity and acceleration, at waypoints and between them, by the closed form of the
    curve; of two waypoints it is a straight line. Rounding is 1e-14 of 20 m and 20 m/s^2. Planted
    bugs: a factor of the second derivative off by 1e-4, which differences of places do not show;
    velocity and acceleration exchanged; waypoints a millisecond late."""
    flown = WAYPOINTS[:count]
    trajectory = Trajectory(Uav(role="target", waypoints=flown))
    times = np.array([w.time_s for w in flown])
    values = np.array([w.position_m for w in flown])
    for t in np.sort(np.concatenate([times, np.linspace(times[0], times[-1], 12)])):
        pose = trajectory.pose(float(t))
        found = np.stack([pose.position, pose.velocity, pose.acceleration])
        assert found == pytest.approx(natural_spline(times, values, t), abs=1e-11)
    assert count == 2 or abs(trajectory.pose(1.0).acceleration).max() > 1


def test_places_on_straight_lines():
    """A flight's place to judge an input by: between two waypoints in proportion, beyond them
    along the last line. Planted bugs: time counted from zero; the wrong stretch."""
    uav = Uav(role="target", waypoints=WAYPOINTS)
    assert uav.position_at(0.65) == pytest.approx((4.25, 5.4, 21.4))
    assert uav.position_at(2.1) == pytest.approx((12.8, 8.95, 24.0))
    assert uav.position_at(2.9) == pytest.approx((17.4, 8.8, 25.3))
    assert uav.position_at(4.7) == pytest.approx((25.65, -9.05, 23.65))
    straight = Uav(role="target", position_m=(1, 2, 3), velocity_mps=(0.5, -4, 0.25))
    assert straight.position_at(2.0) == (2.0, -6.0, 3.5)


def test_a_swarm_by_roles_and_its_middle():
    """Who sends or receives, who sends at some time, and the mean place over nine instants of the
    flights: of straight ones halfway. Planted bugs: a successor forgotten; targets counted; the
    start alone."""
    uavs = {
        "A": Uav(role="active", position_m=(0, 0, 30)),
        "P": Uav(role="passive", position_m=(6, 0, 30), velocity_mps=(0, 5, 0)),
        "Q": Uav(role="passive", position_m=(0, 9, 60)),
        "T": Uav(role="target", position_m=(0, 0, 0), velocity_mps=(0, 0, 8)),
    }
    swarm = Swarm(uavs, duration=2.0, successors=("P",))
    assert swarm.terminals == ["A", "P", "Q"] and swarm.transmitters == ["A", "P"]
    assert swarm.middle == pytest.approx([1.5, 3.5, 32.0])
    # a flight that stands at its end half of the time: (0, 1, 2, 3, 4, 4, 4, 4, 4) metres up
    points = [Waypoint(time_s=t, position_m=(0, 0, z)) for t, z in ((0.0, 0.0), (1.0, 4.0))]
    line = Swarm({"T": Uav(role="target", waypoints=tuple(points))}, duration=2.0)
    assert line.middle == pytest.approx([0, 0, 4.0])  # it flies straight on: 0 to 8
    assert Swarm({"T": uavs["T"]}).middle.tolist() == [0, 0, 0]


def test_a_waypoint_out_of_order_is_named_with_the_one_before():
    """The third of three waypoints lies before the second: both places are named, counted from 0.
    Planted bug: counted from 1."""
    late = Uav.model_construct(
        role="target",
        position_m=None,
        waypoints=(WAYPOINTS[0], WAYPOINTS[2], WAYPOINTS[1]),
        resource_block=None,
    )
    (problem,) = late.problems()
    assert problem[0] == (("waypoints", 2, "time_s"), ("waypoints", 1, "time_s"))
    assert "2.9 s" in problem[1]
