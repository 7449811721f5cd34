"""Where every UAV is and how it is turned: trajectories, attitude, frames of reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline, PPoly
from scipy.spatial.transform import Rotation, RotationSpline

from isac_rt.world.settings import Uav

SAG_M = 0.01
MAX_POINTS = 20_000
"""A flight that would need more is followed less closely."""


@dataclass(frozen=True)
class Pose:
    """State of a body at one instant, in world axes.

    Attributes
    ----------
    position, velocity, acceleration : (3,) float64 [m, m/s, m/s^2]
    rotation : (3, 3) float64; columns are the body's X (right), Y (boresight) and Z (up) in world
        axes, so world = rotation @ body and body = rotation.T @ world

    Examples
    --------
    >>> pose = Pose.at_rest((0, 0, 30), boresight=(1, 0, 0))
    >>> pose.to_body(np.array([2.0, 0.0, 0.0])).tolist()
    [0.0, 2.0, 0.0]
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    rotation: np.ndarray

    @classmethod
    def at_rest(
        cls,
        position: Sequence[float] | np.ndarray = (0, 0, 0),
        boresight: Sequence[float] | np.ndarray = (0, 1, 0),
    ) -> Pose:
        """A body that hovers at a place [m], turned towards `boresight` with its roll level."""
        return cls(np.array(position, float), np.zeros(3), np.zeros(3), attitude(boresight))

    def motion(self) -> np.ndarray:
        """(3, 3) position, velocity and acceleration, one a row."""
        return np.stack([self.position, self.velocity, self.acceleration])

    def to_body(self, direction: np.ndarray) -> np.ndarray:
        """World vectors (..., 3) in body axes."""
        return direction @ self.rotation

    def to_world(self, direction: np.ndarray) -> np.ndarray:
        """Body vectors (..., 3) in world axes."""
        return direction @ self.rotation.T


def attitude(boresight: Sequence[float] | np.ndarray) -> np.ndarray:
    """Rotation whose Y column is `boresight` and whose Z column is as near to up as it can be.

    A vertical boresight leaves the roll open: then X is east.
    """
    y = np.asarray(boresight, float) / np.linalg.norm(boresight)
    east, north, up = y
    size = np.sqrt(north * north + east * east)
    # written out, for numpy's cross products of single vectors take most of the time of a pose
    x0, x1 = (north / size, -east / size) if size > 1e-9 else (1.0, 0.0)
    return np.array([[x0, east, x1 * up], [x1, north, -x0 * up], [0.0, up, x0 * north - x1 * east]])


def turned(yaw_pitch_roll: npt.ArrayLike) -> Rotation:
    """Rotation from body to world of (..., 3) yaw (clockwise from north, which is +y), pitch (nose
    up) and roll (right side down) [degrees]."""
    angles = np.asarray(yaw_pitch_roll, float) * [-1.0, 1.0, 1.0]
    return Rotation.from_euler("ZXY", angles, degrees=True)


def _with_derivatives(spline: CubicSpline) -> PPoly:
    """Values of a spline (3,), their first and second derivatives as one (9,)."""
    orders = [spline.derivative(k).c for k in range(3)]
    same = [np.pad(c, ((len(spline.c) - len(c), 0), (0, 0), (0, 0))) for c in orders]
    return PPoly(np.concatenate(same, axis=2), spline.x)


class Trajectory:
    """Position, velocity, acceleration and attitude of one UAV at any time.

    A straight line, or the smooth (C2) spline through its waypoints, prolonged in a straight line
    beyond them. Attitudes of waypoints are met by a spline whose angular velocity and acceleration
    are smooth; beyond them it stays as it is.
    """

    def __init__(self, uav: Uav) -> None:
        self._fixed_boresight = (
            None if uav.boresight == "velocity" else np.array(uav.boresight, float)
        )
        # tracing, plan, receivers and scores ask for the same instants of the frames at work
        self._latest = lru_cache(maxsize=16)(self._pose)
        self._mount = None if not any(uav.mount_deg) else turned(uav.mount_deg).as_matrix()
        self._attitude: RotationSpline | None = None
        if uav.waypoints is None:
            assert uav.position_m is not None  # the scenario's own check
            self._start, self._velocity, self._spline = (
                np.array(uav.position_m),
                np.array(uav.velocity_mps),
                None,
            )
        else:
            times = np.array([w.time_s for w in uav.waypoints])
            self._span = times[0], times[-1]
            self._spline = CubicSpline(
                times, np.array([w.position_m for w in uav.waypoints]), bc_type="natural"
            )
            self._motion = _with_derivatives(self._spline)
            angles = [w.attitude_deg for w in uav.waypoints if w.attitude_deg is not None]
            if angles:
                self._attitude = RotationSpline(times, turned(angles))

    def positions(self, times: np.ndarray) -> np.ndarray:
        """(K, 3) positions at times (K,) [s]."""
        if self._spline is None:
            return self._start + times[:, None] * self._velocity
        inside = np.clip(times, *self._span)
        return self._spline(inside) + (times - inside)[:, None] * self._spline(inside, 1)

    def pose(self, time: float) -> Pose:
        """Pose at `time` [s]; the same object again for one of the latest."""
        return self._latest(time)

    def _pose(self, time: float) -> Pose:
        if self._spline is None:
            position, velocity, acceleration = (
                self._start + time * self._velocity,
                self._velocity.copy(),
                np.zeros(3),
            )
        else:
            inside = min(max(time, self._span[0]), self._span[1])
            position, velocity, acceleration = self._motion(inside).reshape(3, 3)
            if inside != time:
                position, acceleration = position + (time - inside) * velocity, np.zeros(3)
        boresight = self._fixed_boresight if self._fixed_boresight is not None else velocity
        if not np.any(boresight):
            boresight = np.array([0.0, 1.0, 0.0])  # a hovering UAV looks north
        rotation = attitude(boresight)
        if self._attitude is not None:
            rotation = self._attitude(float(np.clip(time, *self._span))).as_matrix()
        if self._mount is not None:
            rotation = rotation @ self._mount
        return Pose(position, velocity, acceleration, rotation)

    def polyline(self, start: float, end: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (T,) [s] and places (T, 3) [m] of the flight between two times, whose straight
        connections keep within `SAG_M` of it."""
        times = np.array([start, end])
        if self._spline is not None:
            breakpoints = self._spline.x[(self._spline.x > start) & (self._spline.x < end)]
            curvature = np.linalg.norm(self._spline(np.clip(self._spline.x, start, end), 2), axis=1)
            count = int((end - start) * np.sqrt(curvature.max() / (8 * SAG_M))) + 2
            times = np.union1d(np.linspace(start, end, min(count, MAX_POINTS)), breakpoints)
        return times, np.array([self.pose(float(t)).position for t in times])


@dataclass(frozen=True)
class Swarm:
    """All UAVs by name, and their flights.

    Attributes
    ----------
    uavs : in the scenario's order
    duration : of the flights [s]
    successors : UAVs that become active later on

    Examples
    --------
    >>> uav = Uav(role="active", position_m=(0, 0, 30), velocity_mps=(0, 5, 0))
    >>> swarm = Swarm({"AT": uav}, duration=2.0)
    >>> swarm.poses(1.5)["AT"].position.tolist(), swarm.middle.tolist()
    ([0.0, 7.5, 30.0], [0.0, 5.0, 30.0])
    """

    uavs: Mapping[str, Uav]
    duration: float = 0.0
    successors: tuple[str, ...] = ()

    @cached_property
    def trajectories(self) -> dict[str, Trajectory]:
        """The flight of every UAV."""
        return {name: Trajectory(uav) for name, uav in self.uavs.items()}

    def poses(self, time: float) -> dict[str, Pose]:
        """Every UAV's pose at `time` [s]."""
        return {name: trajectory.pose(time) for name, trajectory in self.trajectories.items()}

    @cached_property
    def middle(self) -> np.ndarray:
        """(3,) mean position of all UAVs over nine instants of the flights [m]."""
        times = np.linspace(0, self.duration, 9)
        return np.mean([p.position for t in times for p in self.poses(t).values()], axis=0)

    @property
    def has_boxes(self) -> bool:
        """A UAV has a box."""
        return any(uav.box for uav in self.uavs.values())

    @property
    def terminals(self) -> list[str]:
        """Names of the UAVs that send or receive."""
        return [name for name, uav in self.uavs.items() if uav.is_terminal]

    @property
    def transmitters(self) -> list[str]:
        """Names of the UAVs that are active at some time."""
        return [n for n, uav in self.uavs.items() if uav.role == "active" or n in self.successors]
