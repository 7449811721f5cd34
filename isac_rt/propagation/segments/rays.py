"""Shadow rays in a Mitsuba scene, local coordinates.

Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from isac_rt.propagation.segments.geometry import RAY_OFFSET_M
from isac_rt.world.city.scene import with_room

CHUNK = 1 << 20


def rays(starts: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> mi.Ray3f:
    """Rays from points (N, 3) along unit vectors (N, 3), as far as `reach` (N,) [m]."""
    columns = *starts.T, *directions.T, reach
    *ends, most = (mi.Float(with_room(column.astype(np.float32))) for column in columns)
    ray = mi.Ray3f(mi.Point3f(*ends[:3]), mi.Vector3f(*ends[3:]))
    ray.maxt = most  # type: ignore[assignment]  # stub: scalars
    return ray


def computed(value: Any) -> np.ndarray:
    """A variable of the back end as an array. Other threads have the interpreter meanwhile: numpy
    would wait with it."""
    dr.eval(value)
    return np.asarray(value)


def _columns(*rows: np.ndarray) -> list[mi.Float64]:
    """Every column of some arrays (N, 3) as a variable of the back end."""
    return [mi.Float64(with_room(axis)) for part in rows for axis in part.T]


class Triangles:
    """All triangles of a scene, and which of them a ray has hit. Asking the scene's meshes at each
    hit takes as long as a million rays."""

    def __init__(self, scene: mi.Scene) -> None:
        self.scene, parts = scene, [np.zeros((0, 3, 3), np.float32)]
        first: dict[int, int] = {0: 0}  # by the number of a shape; 0 is none
        for shape in scene.shapes():
            values = mi.traverse(shape)
            positions = np.asarray(values["vertex_positions"], np.float32).reshape(-1, 3)
            number = int(np.asarray(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))).ravel()[0])
            first[number] = sum(map(len, parts))
            parts.append(positions[np.asarray(values["faces"], np.int64).reshape(-1, 3)])
        self.corners = np.concatenate(parts)
        """(T, 3, 3) float32"""
        self._first = np.zeros(max(first) + 1, np.int64)
        self._first[list(first)] = list(first.values())

    def rows(self, hit: mi.PreliminaryIntersection3f) -> np.ndarray:
        """(K,) int64 into `corners`, -1 where nothing was hit."""
        shape = np.asarray(dr.reinterpret_array(mi.UInt32, hit.shape))
        prim = np.asarray(hit.prim_index, np.int64)
        return np.where(shape == 0, -1, self._first[shape] + prim)


class LosTest:
    """Line-of-sight tests in a scene."""

    def __init__(self, scene: mi.Scene) -> None:
        self.scene = scene

    def sees(self, position: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(N,) bool: `position` sees points (N, 3) on surfaces with normals (N, 3), either side."""
        out = np.empty(len(points), bool)
        for first in range(0, len(points), CHUNK):
            part = slice(first, first + CHUNK)
            span = position - points[part]
            side = np.where((span * normals[part]).sum(1) < 0, -RAY_OFFSET_M, RAY_OFFSET_M)
            start = points[part] + side[:, None] * normals[part]
            span = position - start
            length = np.linalg.norm(span, axis=1)
            span /= np.maximum(length, RAY_OFFSET_M)[:, None]
            ray = rays(start, span, np.maximum(length - RAY_OFFSET_M, 0.0))
            out[part] = ~computed(self.scene.ray_test(ray))
        return out

    @cached_property
    def triangles(self) -> Triangles:
        """Return the triangles of the scene."""
        return Triangles(self.scene)

    def ever_sees(
        self, positions: np.ndarray, points: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """(N,) bool: any of `positions` (K, 3) `sees` points, each tested until one does, in one
        kernel."""
        count = dr.opaque(mi.UInt32, len(positions))  # else each number of places compiles anew
        view, out = _columns(positions), np.zeros(len(points), bool)
        for first in range(0, len(points), CHUNK):
            part = slice(first, first + CHUNK)
            facet = _columns(points[part], normals[part])

            def blocked(number: mi.UInt32, facet: list[mi.Float64] = facet) -> mi.Bool:
                return self._blocked([dr.gather(mi.Float64, axis, number) for axis in view], facet)

            dark, _ = dr.while_loop(
                (dr.full(mi.Bool, True, len(points[part])), mi.UInt32(0)),
                lambda dark, number: dark & (number < count),
                lambda dark, number: (blocked(number), number + 1),
            )
            out[part] = ~computed(dark)
        return out

    def all_seen(
        self, positions: np.ndarray, points: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """(K, N) what each of `positions` (K, 3) `sees`, many places in one kernel."""
        width = max(len(points), 1)
        facet, out = _columns(points, normals), np.empty((len(positions), len(points)), bool)
        for first in range(0, len(positions) if len(points) else 0, max(CHUNK // width, 1)):
            part = slice(first, first + max(CHUNK // width, 1))
            chunk = out[part]
            row, view = dr.arange(mi.UInt32, chunk.size), _columns(positions[part])
            number = row // dr.opaque(mi.UInt32, width)
            at = [dr.gather(mi.Float64, axis, number) for axis in view]
            column = row - number * dr.opaque(mi.UInt32, width)
            here = [dr.gather(mi.Float64, axis, column) for axis in facet]
            chunk[:] = ~computed(self._blocked(at, here)).reshape(chunk.shape)
        return out

    def _blocked(self, position: list[mi.Float64], facet: list[mi.Float64]) -> mi.Bool:
        return mi.Bool(self.scene.ray_test(_ray(position, facet)))

    def clear(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(N,) whether nothing stands between points (N, 3) and points (N, 3)."""
        if not len(starts):
            return np.zeros(0, bool)
        span = ends - starts
        length = np.linalg.norm(span, axis=1)
        ray = rays(starts, span / np.maximum(length, 1e-9)[:, None], length)
        return ~computed(self.scene.ray_test(ray))


def _ray(position: list[mi.Float64], facet: list[mi.Float64]) -> mi.Ray3f:
    """From a facet, its point, then its normal, to a place: line by line as `LosTest.sees`
    has it, so that both agree to the last bit."""
    (x, y, z), (px, py, pz, nx, ny, nz) = position, facet
    side = dr.select((x - px) * nx + (y - py) * ny + (z - pz) * nz < 0, -RAY_OFFSET_M, RAY_OFFSET_M)
    sx, sy, sz = px + side * nx, py + side * ny, pz + side * nz
    dx, dy, dz = x - sx, y - sy, z - sz
    length = dr.sqrt(dx * dx + dy * dy + dz * dz)
    size = dr.maximum(length, RAY_OFFSET_M)
    start = mi.Point3f(mi.Float(sx), mi.Float(sy), mi.Float(sz))
    ray = mi.Ray3f(start, mi.Vector3f(*(mi.Float(d / size) for d in (dx, dy, dz))))
    reach = mi.Float(dr.maximum(length - RAY_OFFSET_M, 0.0))
    ray.maxt = reach  # type: ignore[assignment]  # stub: scalars
    return ray
