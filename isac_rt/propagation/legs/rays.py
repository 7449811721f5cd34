"""Shadow rays in a Mitsuba scene, local coordinates.

Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from isac_rt.kernels.propagation_rays import LIFT
from isac_rt.kernels.propagation_rays import hides as _hides

CHUNK = 1 << 20


def rays(starts: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> mi.Ray3f:
    """Rays from points (N, 3) along unit vectors (N, 3), as far as `reach` (N,) [m]."""
    origin, towards = (np.ascontiguousarray(v.T, np.float32) for v in (starts, directions))
    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*towards))
    ray.maxt = mi.Float(reach.astype(np.float32))  # type: ignore[assignment]  # stub: scalars
    return ray


def computed(value: Any) -> np.ndarray:
    """A variable of the back end as an array. Other threads have the interpreter meanwhile: numpy
    would wait with it."""
    dr.eval(value)
    return np.asarray(value)


def _columns(*rows: np.ndarray) -> list[mi.Float64]:
    """Every column of some arrays (N, 3) as a variable of the back end."""
    return [mi.Float64(np.ascontiguousarray(axis)) for part in rows for axis in part.T]


class Triangles:
    """All triangles of a scene, and which of them a ray has hit. Asking the scene's meshes at each
    hit takes as long as a million rays."""

    def __init__(self, scene: mi.Scene) -> None:
        self.scene, parts = scene, [np.zeros((0, 3, 3), np.float32)]
        first: dict[int, int] = {0: 0}  # by the number of a shape; 0 is none
        for shape in scene.shapes():
            values = mi.traverse(shape)
            place = np.asarray(values["vertex_positions"], np.float32).reshape(-1, 3)
            number = int(np.asarray(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))).ravel()[0])
            first[number] = sum(map(len, parts))
            parts.append(place[np.asarray(values["faces"], np.int64).reshape(-1, 3)])
        self.corners = np.concatenate(parts)
        """(T, 3, 3) float32"""
        self._first = np.zeros(max(first) + 1, np.int64)
        self._first[list(first)] = list(first.values())

    @cached_property
    def sides(self) -> np.ndarray:
        """(T, 4, 4): the planes of the triangles, then the planes across them through their sides,
        as a unit vector, inward for sides, and how far along it they lie."""
        corners = self.corners.astype(np.float64)
        span = np.roll(corners, -1, axis=1) - corners
        normal = np.cross(span[:, 0], span[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):  # what is not a number hides nothing
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            inward = np.cross(normal[:, None], span)
            inward /= np.linalg.norm(inward, axis=2, keepdims=True)
        vectors = np.concatenate([normal[:, None], inward], axis=1)
        along = (vectors * np.concatenate([corners[:, :1], corners], axis=1)).sum(2, keepdims=True)
        return np.concatenate([vectors, along], axis=2)

    def rows(self, hit: mi.PreliminaryIntersection3f) -> np.ndarray:
        """(K,) int64 into `corners`, -1 where nothing was hit."""
        shape = np.asarray(dr.reinterpret_array(mi.UInt32, hit.shape))
        prim = np.asarray(hit.prim_index, np.int64)
        return np.where(shape == 0, -1, self._first[shape] + prim)


class Shadows:
    """Tests of sight in a scene."""

    def __init__(self, scene: mi.Scene) -> None:
        self.scene = scene

    def sees(self, place: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(N,) whether `place` sees points (N, 3) on surfaces with unit normals (N, 3) (of either
        side)."""
        out = np.empty(len(points), bool)
        for first in range(0, len(points), CHUNK):
            part = slice(first, first + CHUNK)
            span = place - points[part]
            side = np.where((span * normals[part]).sum(1) < 0, -LIFT, LIFT)
            start = points[part] + side[:, None] * normals[part]
            span = place - start
            length = np.linalg.norm(span, axis=1)
            span /= np.maximum(length, LIFT)[:, None]
            ray = rays(start, span, np.maximum(length - LIFT, 0.0))
            out[part] = ~computed(self.scene.ray_test(ray))
        return out

    @cached_property
    def triangles(self) -> Triangles:
        """Return the triangles of the scene."""
        return Triangles(self.scene)

    def ever_sees(self, places: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(N,) whether any of `places` (K, 3) `sees` points: each is tested until one does, in one
        kernel; but for those that a single triangle surely hides from all."""
        count = dr.opaque(mi.UInt32, len(places))  # else each number of places compiles anew
        view, out = _columns(places), np.zeros(len(points), bool)
        left = np.flatnonzero(~self._hidden(places, points, normals))
        for first in range(0, left.size, CHUNK):
            part = left[first : first + CHUNK]
            facet = _columns(points[part], normals[part])

            def blocked(number: mi.UInt32, facet: list[mi.Float64] = facet) -> mi.Bool:
                return self._blocked([dr.gather(mi.Float64, axis, number) for axis in view], facet)

            dark, _ = dr.while_loop(
                (dr.full(mi.Bool, True, part.size), mi.UInt32(0)),
                lambda dark, number: dark & (number < count),
                lambda dark, number: (blocked(number), number + 1),
            )
            out[part] = ~computed(dark)
        return out

    def _hidden(self, places: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(N,) of which points the triangle that hides them from the middle one of `places` surely
        hides them from all."""
        out = np.zeros(len(points), bool)
        for first in range(0, len(points) if len(places) > 1 else 0, CHUNK):
            part = slice(first, first + CHUNK)
            view = np.broadcast_to(places[len(places) // 2], points[part].shape)
            ray = _ray(_columns(view), _columns(points[part], normals[part]))
            hit = self.scene.ray_intersect_preliminary(ray)
            dr.eval(hit)
            row = self.triangles.rows(hit)
            _hides(self.triangles.sides, row, _box(places), places, points[part], out[part])
        return out

    def all_seen(self, places: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(K, N) what each of `places` (K, 3) `sees`, many places in one kernel."""
        width = max(len(points), 1)
        facet, out = _columns(points, normals), np.empty((len(places), len(points)), bool)
        for first in range(0, len(places) if len(points) else 0, max(CHUNK // width, 1)):
            part = slice(first, first + max(CHUNK // width, 1))
            some = out[part]
            row, view = dr.arange(mi.UInt32, some.size), _columns(places[part])
            number = row // dr.opaque(mi.UInt32, width)
            at = [dr.gather(mi.Float64, axis, number) for axis in view]
            column = row - number * dr.opaque(mi.UInt32, width)
            here = [dr.gather(mi.Float64, axis, column) for axis in facet]
            some[:] = ~computed(self._blocked(at, here)).reshape(some.shape)
        return out

    def _blocked(self, place: list[mi.Float64], facet: list[mi.Float64]) -> mi.Bool:
        return mi.Bool(self.scene.ray_test(_ray(place, facet)))

    def clear(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(N,) whether nothing stands between points (N, 3) and points (N, 3)."""
        if not len(starts):
            return np.zeros(0, bool)
        span = ends - starts
        length = np.linalg.norm(span, axis=1)
        ray = rays(starts, span / np.maximum(length, 1e-9)[:, None], length)
        return ~computed(self.scene.ray_test(ray))


def _ray(place: list[mi.Float64], facet: list[mi.Float64]) -> mi.Ray3f:
    """From a facet, its point, then its normal, to a place: line by line as `Shadows.sees` has it,
    so that both agree to the last bit."""
    (x, y, z), (px, py, pz, nx, ny, nz) = place, facet
    side = dr.select((x - px) * nx + (y - py) * ny + (z - pz) * nz < 0, -LIFT, LIFT)
    sx, sy, sz = px + side * nx, py + side * ny, pz + side * nz
    dx, dy, dz = x - sx, y - sy, z - sz
    length = dr.sqrt(dx * dx + dy * dy + dz * dz)
    size = dr.maximum(length, LIFT)
    ray = mi.Ray3f(
        mi.Point3f(mi.Float(sx), mi.Float(sy), mi.Float(sz)),
        mi.Vector3f(mi.Float(dx / size), mi.Float(dy / size), mi.Float(dz / size)),
    )
    reach = mi.Float(dr.maximum(length - LIFT, 0.0))
    ray.maxt = reach  # type: ignore[assignment]  # stub: scalars
    return ray


def _box(places: np.ndarray) -> np.ndarray:
    """(8, 3) corners of the box about places (K, 3)."""
    ends = np.stack([places.min(axis=0), places.max(axis=0)])
    return np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3)
