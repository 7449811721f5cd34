"""What a terminal hears over the walls of its mesh: its own mirror images, or its transmitter's.

A wall that is met at a right angle sends the terminal's chirps straight back, and so does a corner
of two planes, wall and ground above all, whatever the angle. Such an echo stands still in the world
but is a point as a UAV is, and the scatterers of the expected clutter do not hold it. The terminal
knows its pose and the mesh, so that it knows the range of each and its rate. Occlusion by other
buildings is not asked for: an image that is not there only forbids births in a few cells.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.jit import jit
from isac_rt.receive.types import Detections
from isac_rt.track.filter import Ambiguity, wrapped
from isac_rt.track.parts import Own, TrackRule
from isac_rt.track.walls import Walls
from isac_rt.world.swarm import Pose

EDGE = 0.3
"""How far beyond the edge of a face a reflection is still taken for possible [m]: the planes of a
corner need not meet exactly."""
LEAST_RANGE = 1.0
BESIDE_CELLS = 1.5
"""Off an image by no more cells of range and of rate than these, a detection is taken for it."""
WELL_INSIDE = 0.95
"""Share of the view's largest cosines within which a direction is no alias of one outside."""
ALIAS_DEVIATIONS = 3.0
"""So many deviations further inside at a passive terminal, whose array is a third as long."""


class Images(TrackRule):
    """No track starts from what may be an image of the terminal, at a passive one of its
    transmitter, or an alias from beyond the view.

    Parameters
    ----------
    walls : the mesh
    passes : 2 at an active terminal, 1 at a passive one
    """

    def __init__(self, walls: Walls, antennas: Antennas, waveform: Waveform, passes: int) -> None:
        self._walls, self._passes = walls, passes
        self._edge = WELL_INSIDE * antennas.view_limit
        self._ambiguity = Ambiguity.of(waveform, passes)
        self._cells = np.array([waveform.range_cell(passes), waveform.velocity_cell(passes)])

    def births(self, detections: Detections, own: Own) -> Detections:
        d, sender = detections, own.transmitter
        spread = ALIAS_DEVIATIONS * d.std[:, 2:] if self._passes == 1 else 0.0
        inside = np.abs(d.direction) + spread < self._edge
        starts = d.starts & inside.all(axis=1)
        if starts.any():
            reach = float(d.range[starts].max()) + 1
            if sender is None:
                shown = own_images(own.pose, self._walls, reach)
            else:
                shown = sender_images(sender.mean[:6], own.pose, self._walls, reach)
            off = wrapped(d.measured[:, None, :2] - shown, self._ambiguity)
            beside = (np.abs(off) < BESIDE_CELLS * self._cells).all(axis=-1)
            starts &= ~beside.any(axis=1)
        return replace(d, starts=starts)


def own_images(own: Pose, walls: Walls, reach: float) -> np.ndarray:
    """Range [m] and its rate [m/s] of the terminal's own images, one way as its echoes: (K, 2).

    Parameters
    ----------
    own : pose, world coordinates
    reach : farthest range that counts [m]
    """
    near = walls.near(own, reach)
    here = np.concatenate([own.position, own.velocity])
    return _images(here, here, walls, (near, near), 2 * reach) / 2


def sender_images(sender: np.ndarray, own: Pose, walls: Walls, reach: float) -> np.ndarray:
    """Length [m] and its rate [m/s] of the ways from a transmitter to a passive terminal over one
    or two planes: (K, 2).

    Parameters
    ----------
    sender : (6,) position and velocity of the transmitter, world coordinates
    own : pose of the terminal
    reach : longest way that counts [m]
    """
    here = np.concatenate([own.position, own.velocity])
    near = walls.about(sender[:3], reach), walls.near(own, reach)
    return _images(sender, here, walls, near, reach)


def _images(
    start: np.ndarray,
    end: np.ndarray,
    walls: Walls,
    near: tuple[np.ndarray, np.ndarray],
    reach: float,
) -> np.ndarray:
    """Ways from `start` to `end` (6,), over mirrors that are near the one and the other."""
    return np.concatenate(
        [_by_one(start, end, walls, near[1], reach), _by_two(start, end, walls, near, reach)]
    )


def _by_one(
    start: np.ndarray, end: np.ndarray, walls: Walls, near: np.ndarray, reach: float
) -> np.ndarray:
    _, normals, offsets = walls.mirrors
    n, p = normals[near], end[:3]
    s, e = n @ start[:3] - offsets[near], n @ p - offsets[near]
    some = s * e > 0
    n, s, e, near = n[some], s[some], e[some], near[some]
    image = start[:3] - 2 * s[:, None] * n
    met = p + (image - p) * (e / (e + s))[:, None]
    ways = _ways(image, start[3:] - 2 * (n @ start[3:])[:, None] * n, end)
    on = walls.holds(near, met, EDGE) & (ways[:, 0] < reach) & (ways[:, 0] > 2 * LEAST_RANGE)
    return ways[on]


def _by_two(
    start: np.ndarray,
    end: np.ndarray,
    walls: Walls,
    near: tuple[np.ndarray, np.ndarray],
    reach: float,
) -> np.ndarray:
    """The wave over plane i, then j, comes from the image p_ij of the start's image in i; it meets
    j at B, and i at A."""
    _, normals, offsets = walls.mirrors
    planes = _Planes(normals, offsets, *walls.boxes)
    pairs, places = _met(start[:3], end[:3], planes, *near, reach)
    i, j = pairs.T
    A, B, at_j = places.swapaxes(0, 1)
    kept = walls.holds(i, A, EDGE) & walls.holds(j, B, EDGE)
    n, m, at_j = normals[i[kept]], normals[j[kept]], at_j[kept]
    turned = start[3:] - 2 * (n @ start[3:])[:, None] * n
    turned -= 2 * (turned * m).sum(axis=1)[:, None] * m
    return _ways(at_j, turned, end)


class _Planes(NamedTuple):
    """Normals (W, 3), offsets (W,) and corners of the boxes (W, 3) of mirrors."""

    normals: np.ndarray
    offsets: np.ndarray
    low: np.ndarray
    high: np.ndarray


@jit
def _met(
    start: np.ndarray,
    end: np.ndarray,
    planes: _Planes,
    first: np.ndarray,
    last: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (K, 2) of mirrors over which a way may lead, with A, B and p_ij (K, 3, 3)."""
    pairs, places, count = np.empty((64, 2), np.int64), np.empty((64, 3, 3)), 0
    once, at_j, A, B = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    before = np.array([_dot(planes.normals[j], end) - planes.offsets[j] for j in last])
    x, y, z = planes.normals[last].T.copy()
    offsets, beyond = planes.offsets[last], np.empty(last.size)
    some = np.empty(last.size, np.int64)
    for i in first:
        n, d = planes.normals[i], planes.offsets[i]
        s, apart = _dot(n, start) - d, 0.0
        for c in range(3):
            once[c] = start[c] - 2 * s * n[c]
            apart += (once[c] - end[c]) ** 2
        for k in range(last.size):
            beyond[k] = x[k] * once[0] + y[k] * once[1] + z[k] * once[2] - offsets[k]
        # a mirror between two points makes the square of the way between them longer by four times
        # the product of their distances from it
        least = max((2 * LEAST_RANGE) ** 2 - apart, 0.0) / 4
        most, chosen = (reach**2 - apart) / 4, 0
        for k in range(last.size):  # without branches
            some[chosen] = k
            chosen += least < beyond[k] * before[k] < most
        for k in some[:chosen]:
            j = last[k]
            if i == j:
                continue
            for c in range(3):
                at_j[c] = once[c] - 2 * beyond[k] * planes.normals[j, c]
            # from the image behind j to the end before it
            if not _within(at_j, end, beyond[k] / (beyond[k] + before[k]), planes, j, B):
                continue
            height = _dot(n, B) - d
            if not height * s > -EDGE * abs(s):
                continue
            if not _within(once, B, s / (s + height), planes, i, A):
                continue
            if count == len(pairs):
                pairs = np.concatenate((pairs, np.empty_like(pairs)))
                places = np.concatenate((places, np.empty_like(places)))
            pairs[count, 0], pairs[count, 1] = i, j
            places[count, 0], places[count, 1], places[count, 2] = A, B, at_j
            count += 1
    return pairs[:count], places[:count]


@jit
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def _within(
    a: np.ndarray, b: np.ndarray, share: float, planes: _Planes, mirror: int, out: np.ndarray
) -> bool:
    """Whether the place that lies so far on the way from a to b, put into `out`, is in the box of a
    mirror or within `EDGE` of it."""
    for c in range(3):
        out[c] = a[c] + (b[c] - a[c]) * share
        if not planes.low[mirror, c] - EDGE <= out[c] <= planes.high[mirror, c] + EDGE:
            return False
    return True


def _ways(places: np.ndarray, motions: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Length and rate (K, 2) of straight ways from moving places (K, 3) to `end` (6,)."""
    span = end[:3] - places
    far = np.linalg.norm(span, axis=1)
    return np.column_stack([far, (span * (end[3:] - motions)).sum(axis=1) / far])
