"""Shadow rays in a Mitsuba scene, local coordinates.

Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

LIFT = 2e-3
"""Rays start this far from the surface and end as far before the viewer [m]; float32 corners and
rays are good to a tenth of it."""
CHUNK = 1 << 20


def rays(starts: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> mi.Ray3f:
    """Rays from points (N, 3) along unit vectors (N, 3), as far as `reach` (N,) [m]."""
    origin, towards = (np.ascontiguousarray(v.T, np.float32) for v in (starts, directions))
    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*towards))
    ray.maxt = mi.Float(reach.astype(np.float32))  # type: ignore[assignment]  # stub: scalars
    return ray


def _columns(*rows: np.ndarray) -> list[mi.Float64]:
    """Every column of some arrays (N, 3) as a variable of the back end."""
    return [mi.Float64(np.ascontiguousarray(axis)) for part in rows for axis in part.T]


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
            out[part] = ~np.asarray(self.scene.ray_test(ray))
        return out

    def ever_sees(self, places: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(N,) whether any of `places` (K, 3) `sees` points: each is tested until one does, in one
        kernel."""
        count = dr.opaque(mi.UInt32, len(places))  # else each number of places compiles anew
        view, out = _columns(places), np.empty(len(points), bool)
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
            out[part] = ~np.asarray(dark)
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
            some[:] = ~np.asarray(self._blocked(at, here)).reshape(some.shape)
        return out

    def _blocked(self, place: list[mi.Float64], facet: list[mi.Float64]) -> mi.Bool:
        """Line by line as `sees` has it, so that both agree to the last bit; a facet's point, then
        its normal."""
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
        return mi.Bool(self.scene.ray_test(ray))

    def clear(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(N,) whether nothing stands between points (N, 3) and points (N, 3)."""
        if not len(starts):
            return np.zeros(0, bool)
        span = ends - starts
        length = np.linalg.norm(span, axis=1)
        ray = rays(starts, span / np.maximum(length, 1e-9)[:, None], length)
        return ~np.asarray(self.scene.ray_test(ray))
