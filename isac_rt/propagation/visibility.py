"""What is seen from where: shadow rays, and how sight of a scatterer comes and goes along a flight.

Rays are tested from knots, places every half metre along a flight as it is planned; between them sight is blended, so that a scatterer
is born and dies over about two metres and not at once. A blend is a function of the time alone: a frame is the same whether the
frames before it were computed or not. Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.interpolate import BSpline

from isac_rt.swarm import Pose, Trajectory

KNOT_SPACING = 0.5
"""Flight from one test of the rays to the next [m]."""
OFF_FLIGHT = 1e-3
"""A pose farther than this from the planned flight [m] has its rays tested by itself."""
LIFT = 2e-3
"""Rays start this far from the surface and end as far before the viewer [m]; float32 corners and rays are good to a tenth of it."""
CHUNK = 1 << 20
REACH = 3
"""Knots on each side that matter. A quadratic spline (1.5) let the births at a corner change a range cell by 0.17 of its rms from one
frame to the next, this one by 0.12."""
BLEND = BSpline.basis_element(np.arange(-REACH, REACH + 1))


class Shadows:
    """Ray tests in a Mitsuba scene, local coordinates."""

    def __init__(self, scene: mi.Scene) -> None:
        self._scene = scene

    def sees(self, place: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(N,) whether `place` sees points (N, 3) on surfaces with unit normals (N, 3) (of either side)."""
        out = np.empty(len(points), bool)
        for first in range(0, len(points), CHUNK):
            part = slice(first, first + CHUNK)
            span = place - points[part]
            side = np.where((span * normals[part]).sum(1) < 0, -LIFT, LIFT)
            start = points[part] + side[:, None] * normals[part]
            span = place - start
            length = np.linalg.norm(span, axis=1)
            span /= np.maximum(length, LIFT)[:, None]
            ray = mi.Ray3f(mi.Point3f(*_rows(start)), mi.Vector3f(*_rows(span)))
            ray.maxt = mi.Float(np.maximum(length - LIFT, 0.0).astype(np.float32))  # type: ignore[assignment]
            out[part] = ~np.asarray(self._scene.ray_test(ray))
        return out

    def clear(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(N,) whether nothing stands between points (N, 3) and points (N, 3)."""
        span = ends - starts
        length = np.linalg.norm(span, axis=1)
        ray = mi.Ray3f(mi.Point3f(*_rows(starts)), mi.Vector3f(*_rows(span / np.maximum(length, 1e-9)[:, None])))
        ray.maxt = mi.Float(length.astype(np.float32))  # type: ignore[assignment]
        return ~np.asarray(self._scene.ray_test(ray))


def _rows(vectors: np.ndarray) -> np.ndarray:
    """(3, N) float32 of (N, 3)."""
    return np.ascontiguousarray(vectors.T, np.float32)


class Flight:
    """One terminal's way through a run, with its knots.

    Parameters
    ----------
    trajectory : of the terminal
    duration : of the run [s]
    origin : (3,) of the local coordinates [m]
    """

    def __init__(self, trajectory: Trajectory, duration: float, origin: np.ndarray) -> None:
        self._trajectory, self._origin = trajectory, origin
        self._times = np.linspace(0.0, duration, 2001)
        track = np.array([trajectory.pose(t).position for t in self._times]) - origin
        self._way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=1))])
        self._spacing = max(self._way[-1] / max(np.ceil(self._way[-1] / KNOT_SPACING), 1.0), 1e-9)
        count = round(self._way[-1] / self._spacing) + 1
        times = np.interp(self._spacing * np.arange(count), self._way, self._times)
        self.knots = np.array([trajectory.pose(t).position for t in times]) - origin
        """(K, 3) local [m]"""

    def holds(self, pose: Pose, time: float) -> bool:
        """Whether a pose, local, is the planned one."""
        return bool(np.linalg.norm(self._trajectory.pose(time).position - self._origin - pose.position) < OFF_FLIGHT)

    def blend(self, time: float) -> dict[int, float]:
        """Knots that matter at a time, with their weights, which sum to one: a quintic B-spline over the way flown."""
        q = np.interp(time, self._times, self._way) / self._spacing
        nearby = np.arange(np.ceil(q - REACH), q + REACH)
        out: dict[int, float] = {}
        for knot, weight in zip(np.clip(nearby, 0, len(self.knots) - 1).astype(int).tolist(), BLEND(nearby - q).tolist(), strict=True):
            out[knot] = out.get(knot, 0.0) + weight
        return out


class Sight:
    """How far N points are in sight of each terminal, from 0 to 1, at any time of a run."""

    def __init__(self, shadows: Shadows, flights: dict[str, Flight], points: np.ndarray, normals: np.ndarray) -> None:
        self.shadows, self.flights = shadows, flights
        self._points, self._normals = points, normals
        self._seen: dict[tuple[str, int], np.ndarray] = {}

    @property
    def nbytes(self) -> int:
        """Of the tests kept."""
        return sum(bits.nbytes for bits in self._seen.values())

    def share(self, name: str, pose: Pose, time: float) -> np.ndarray:
        """(N,) float32 for a terminal at a pose, local coordinates."""
        flight = self.flights[name]
        if not flight.holds(pose, time):
            return self.shadows.sees(pose.position, self._points, self._normals).astype(np.float32)
        out = np.zeros(len(self._points), np.float32)
        for knot, weight in flight.blend(time).items():
            if weight > 0:
                out += np.float32(weight) * self._knot(name, knot)
        return out

    def _knot(self, name: str, knot: int) -> np.ndarray:
        if (name, knot) not in self._seen:
            self._seen[name, knot] = np.packbits(self.shadows.sees(self.flights[name].knots[knot], self._points, self._normals))
        return np.unpackbits(self._seen[name, knot], count=len(self._points))
