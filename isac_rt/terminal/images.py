"""What a terminal hears of itself over the walls of its mesh: its own mirror images.

A wall that is met at a right angle sends the terminal's chirps straight back, and so does a corner
of two planes, wall and ground above all, whatever the angle. Such an echo stands still in the world
but is a point as a UAV is, and the scatterers of the expected clutter do not hold it. The terminal
knows its pose and the mesh, so that it knows the range of each and its rate. Occlusion by other
buildings is not asked for: an image that is not there only forbids births in a few cells.
"""

from __future__ import annotations

import numpy as np

from isac_rt.terminal.ghosts import Walls
from isac_rt.world.swarm import Pose

EDGE = 0.3
"""How far beyond the edge of a face a reflection is still taken for possible [m]: the planes of a
corner need not meet exactly."""
LEAST_RANGE = 1.0


def own_images(own: Pose, walls: Walls, reach: float) -> np.ndarray:
    """Range [m] and its rate [m/s] of the terminal's own images, one way as its echoes: (K, 2).

    Parameters
    ----------
    own : pose, world coordinates
    reach : farthest range that counts [m]
    """
    near = walls.near(own, reach)
    return np.concatenate([_by_one(own, walls, near, reach), _by_two(own, walls, near, reach)])


def _by_one(own: Pose, walls: Walls, near: np.ndarray, reach: float) -> np.ndarray:
    _, normals, offsets = walls.mirrors
    n, p = normals[near], own.position
    s = n @ p - offsets[near]
    on = walls.holds(near, p - s[:, None] * n, EDGE)
    on &= (np.abs(s) < reach) & (np.abs(s) > LEAST_RANGE)
    return np.column_stack([np.abs(s), np.sign(s) * (n @ own.velocity)])[on]


def _by_two(own: Pose, walls: Walls, near: np.ndarray, reach: float) -> np.ndarray:
    """The echo over plane i, then j, comes from the image p_ij of the terminal's image in i; it
    meets j at B, and i at A."""
    _, normals, offsets = walls.mirrors
    n, d, p, v = normals[near], offsets[near], own.position, own.velocity
    s = n @ p - d
    once = p - 2 * s[:, None] * n
    beyond = once @ n.T - d
    length = np.sqrt(((once[:, None] - 2 * beyond[..., None] * n - p) ** 2).sum(axis=-1))
    both = (length / 2 < reach) & (length / 2 > LEAST_RANGE) & (beyond * s > 0)
    i, j = np.nonzero(both & ~np.eye(near.size, dtype=bool))
    # from the image behind j to the terminal before it
    at_j = once[i] - 2 * beyond[i, j][:, None] * n[j]
    B = at_j + (p - at_j) * (beyond[i, j] / (beyond[i, j] + s[j]))[:, None]
    kept = walls.bounded(near[j], B, EDGE)
    i, j, at_j, B = i[kept], j[kept], at_j[kept], B[kept]
    height = (B * n[i]).sum(axis=1) - d[i]
    A = once[i] + (B - once[i]) * (s[i] / (s[i] + height))[:, None]
    kept = (height * s[i] > -EDGE * np.abs(s[i])) & walls.bounded(near[i], A, EDGE)
    i, j, at_j, A, B = i[kept], j[kept], at_j[kept], A[kept], B[kept]
    kept = walls.holds(near[i], A, EDGE) & walls.holds(near[j], B, EDGE)
    i, j, at_j = i[kept], j[kept], at_j[kept]
    turned = v - 2 * (n[i] @ v)[:, None] * n[i]
    turned -= 2 * (turned * n[j]).sum(axis=1)[:, None] * n[j]
    span = p - at_j
    far = np.linalg.norm(span, axis=1)
    return np.column_stack([far / 2, (span * (v - turned)).sum(axis=1) / (2 * far)])
