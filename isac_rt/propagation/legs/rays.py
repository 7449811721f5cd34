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
        view = [mi.Float64(np.ascontiguousarray(axis)) for axis in places.T]
        out = np.empty(len(points), bool)
        for first in range(0, len(points), CHUNK):
            part = slice(first, first + CHUNK)
            px, py, pz, nx, ny, nz = (
                mi.Float64(np.ascontiguousarray(axis))
                for axis in (*points[part].T, *normals[part].T)
            )

            def blocked(number: mi.UInt32, px=px, py=py, pz=pz, nx=nx, ny=ny, nz=nz) -> mi.Bool:
                """Line by line as `sees` has it, so that both agree to the last bit."""
                x, y, z = (dr.gather(mi.Float64, axis, number) for axis in view)
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

            dark, _ = dr.while_loop(
                (dr.full(mi.Bool, True, len(points[part])), mi.UInt32(0)),
                lambda dark, number: dark & (number < count),
                lambda dark, number: (blocked(number), number + 1),
            )
            out[part] = ~np.asarray(dark)
        return out

    def clear(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(N,) whether nothing stands between points (N, 3) and points (N, 3)."""
        if not len(starts):
            return np.zeros(0, bool)
        span = ends - starts
        length = np.linalg.norm(span, axis=1)
        ray = rays(starts, span / np.maximum(length, 1e-9)[:, None], length)
        return ~np.asarray(self.scene.ray_test(ray))
