"""Trajectories and attitude."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.scenario.swarm import Uav, Waypoint
from isac_rt.world.swarm import Trajectory, attitude

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


def test_vertical_boresight_has_an_attitude():
    r = attitude(np.array([0.0, 0.0, -1.0]))
    assert r.T @ r == pytest.approx(np.eye(3), abs=1e-14)


def test_spline_derivatives_match_differences():
    """Velocity and acceleration against central differences of the position; planted bug:
    derivative orders swapped."""
    trajectory, h = Trajectory(Uav(role="target", waypoints=WAYPOINTS)), 1e-4
    for t in (0.37, 1.3, 2.05, 3.71):
        before, now, after = (trajectory.pose(s) for s in (t - h, t, t + h))
        # discretisation: h^2/6 of the third derivative, about 1e-8 here; second difference loses
        # 1e-15*20/h^2 = 2e-6
        assert (after.position - before.position) / (2 * h) == pytest.approx(now.velocity, abs=1e-6)
        assert (after.position - 2 * now.position + before.position) / h**2 == pytest.approx(
            now.acceleration, abs=2e-3
        )
    for w in WAYPOINTS:
        assert trajectory.pose(w.time_s).position == pytest.approx(
            np.array(w.position_m), abs=1e-12
        )


def test_beyond_the_waypoints_it_flies_straight_on():
    trajectory = Trajectory(Uav(role="target", waypoints=WAYPOINTS))
    end, later = trajectory.pose(4.1), trajectory.pose(6.0)
    assert later.position == pytest.approx(end.position + 1.9 * end.velocity)
    assert not later.acceleration.any()


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
