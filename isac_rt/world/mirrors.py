"""Planes and triangles in them: images behind a plane, where a line crosses it, what a triangle
holds."""

from __future__ import annotations

import numpy as np


def mirror_image(
    points: np.ndarray, normals: np.ndarray, offsets: np.ndarray | float = 0.0
) -> np.ndarray:
    """Places (..., 3) behind planes with unit normals (..., 3) and offsets (...): points x of a
    plane obey normal.x = offset. With offsets of 0: directions after a mirror."""
    height = (points * normals).sum(axis=-1) - offsets
    return points - 2 * height[..., None] * normals


def plane_crossing(
    starts: np.ndarray, ends: np.ndarray, normals: np.ndarray, offsets: np.ndarray | float
) -> np.ndarray:
    """Points (..., 3) at which lines between two places cross planes that they are not parallel
    to."""
    line = ends - starts
    share = (offsets - (normals * starts).sum(axis=-1)) / (normals * line).sum(axis=-1)
    return starts + share[..., None] * line


def over_triangle(
    points: np.ndarray, corners: np.ndarray, normals: np.ndarray, margin: float = 0.0
) -> np.ndarray:
    """Return whether points (..., 3) lie over or under triangles (..., 3, 3), whose unit normals
    (..., 3) belong to the order of their corners, or beside them within a margin [m]."""
    side = np.roll(corners, -1, axis=-2) - corners
    inward = np.cross(normals[..., None, :], side)
    height = ((points[..., None, :] - corners) * inward).sum(axis=-1)
    return (height >= -margin * np.linalg.norm(side, axis=-1)).all(axis=-1)
