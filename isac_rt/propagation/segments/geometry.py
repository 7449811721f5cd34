"""Path geometry in float64: mirror images, and straight segments to a moving point.

A chain of mirror reflections is unfolded: the transmitter's image behind the chain's planes sends
straight to the receiver. Length, rate and acceleration follow from the relative motion of the image
and the receiver, so curved flight is in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import mirror_image, plane_crossing
from isac_rt.world.swarm import Pose

RAY_OFFSET_M = 2e-3
"""Rays start this far from the surface and end as far before the viewer [m]; float32 corners and
rays are good to a tenth of it."""


@dataclass(frozen=True)
class Segments:
    """K straight (or unfolded) segments from one body to another. World axes, metres.

    Attributes
    ----------
    length, rate, accel : (K,) of the segment's length [m, m/s, m/s^2]
    departure : (K, 3) unit vectors along the first segment, at the start
    arrival : (K, 3) unit vectors at the end, towards where the wave comes from
    points : (K, B, 3) interaction points in order
    """

    length: np.ndarray
    rate: np.ndarray
    accel: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray
    points: np.ndarray

    def select(self, which: np.ndarray | slice) -> Segments:
        """The segments that an index array or a slice chooses."""
        if isinstance(which, slice):
            return Segments(*(array[which] for array in vars(self).values()))
        return Segments(*(array.take(which, axis=0) for array in vars(self).values()))


def unfold(normals: np.ndarray, offsets: np.ndarray, start: Pose, end: Pose) -> Segments:
    """Segments from `start` to `end` over chains of B mirrors at rest.

    Parameters
    ----------
    normals : (K, B, 3) unit normals n in the order of the bounces
    offsets : (K, B) plane offsets d, points x of the plane obey n.x = d
    start, end : poses at one instant

    Returns
    -------
    Segments; `points` lie on the planes (not checked against the faces' edges)
    """
    count, depth = offsets.shape
    image = np.broadcast_to(start.position, (count, 3)).copy()
    velocity = np.broadcast_to(start.velocity, (count, 3)).copy()
    acceleration = np.broadcast_to(start.acceleration, (count, 3)).copy()
    images = [image]
    for b in range(depth):
        n = normals[:, b]
        image = mirror_image(image, n, offsets[:, b])
        velocity, acceleration = mirror_image(velocity, n), mirror_image(acceleration, n)
        images.append(image)
    span = end.position - image
    length = np.linalg.norm(span, axis=1)
    e = span / length[:, None]
    w, a = end.velocity - velocity, end.acceleration - acceleration
    rate = (e * w).sum(1)
    accel = ((w * w).sum(1) - rate**2) / length + (e * a).sum(1)
    points = np.empty((count, depth, 3))
    target = np.broadcast_to(end.position, (count, 3))
    for b in range(depth - 1, -1, -1):
        target = plane_crossing(images[b + 1], target, normals[:, b], offsets[:, b])
        points[:, b] = target
    first = points[:, 0] if depth else np.broadcast_to(end.position, (count, 3))
    departure = first - start.position
    departure = departure / np.linalg.norm(departure, axis=1, keepdims=True)
    return Segments(length, rate, accel, departure, -e, points)


def straight(
    start: Pose,
    points: np.ndarray,
    velocity: np.ndarray | float = 0.0,
    acceleration: np.ndarray | float = 0.0,
) -> Segments:
    """Segments from `start` to points (K, 3) that move with `velocity` and `acceleration` (K, 3 or
    one for all)."""
    span = points - start.position
    length = np.linalg.norm(span, axis=1)
    e = span / length[:, None]
    w, a = velocity - start.velocity, acceleration - start.acceleration
    rate = (e * w).sum(1)
    accel = ((w * w).sum(-1) - rate**2) / length + (e * a).sum(1)
    return Segments(length, rate, accel, e, -e, np.zeros((points.shape[0], 0, 3)))


def plane_of_each_face(city: CityMesh) -> tuple[np.ndarray, np.ndarray]:
    """Normals (F, 3) and offsets (F,) of the planes that faces lie in: those of the plane's largest
    face.

    All triangles of a wall are then one mirror, to the last bit: a path that slides from one to the
    next does not jump, and one that was found on both is recognised.
    """
    by_area = np.argsort(-city.areas, kind="stable")
    _, first, plane = np.unique(city.plane_of_face[by_area], return_index=True, return_inverse=True)
    largest = np.empty(city.num_faces, np.int64)
    largest[by_area] = by_area[first[plane]]
    return city.normals[largest], city.plane_offsets[largest]


EDGE = 1e-3
"""Two points of a path this close together [m] are one point in the edge of two walls."""


def edges_in_any_order(planes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Planes (K, B) of chains with those that are met at one point (K, B, 3) in rising order.

    A wave that meets two walls in their edge meets them in either order: the same path, the same
    image.
    """
    out = planes.copy()
    for b in range(
        1, planes.shape[1]
    ):  # bubble sort of short rows, over the neighbours that share a point
        for a in range(planes.shape[1] - b):
            together = np.linalg.norm(points[:, a + 1] - points[:, a], axis=1) < EDGE
            swap = together & (out[:, a] > out[:, a + 1])
            out[swap, a], out[swap, a + 1] = out[swap, a + 1], out[swap, a]
    return out


def one_of_each_chain(planes: np.ndarray, faces: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Indices of one path per chain of planes (K, B), sorted by the planes; of several that with
    the lowest faces (K, B).

    Mirrors leave two points one path over a chain of planes, so what shares the chain was found
    twice: on both triangles of a seam, or by Sionna's hash of planes, which coordinates far from
    the origin defeat.
    """
    which = np.flatnonzero(good)
    if planes.shape[1] == 0:
        return which[:1]
    keys = np.column_stack([planes, faces])[which]
    which = which[np.lexsort(keys.T[::-1])]
    _, first = np.unique(planes[which], axis=0, return_index=True)
    return which[first]
