"""Mirror images that a terminal receives over the walls of its mesh: its own, or its transmitter's.

A wall that is met at a right angle sends the terminal's chirps straight back, and so does a corner
of two planes, wall and ground above all, whatever the angle. Such an echo stands still in the world
but is a point as a UAV is, and the scatterers of the expected clutter do not hold it. The terminal
knows its pose and the mesh, so that it knows the range of each and its rate. A passive terminal
knows its transmitter's, and the images of that one's line of sight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import Antennas, folded, resolutions
from isac_rt.frame.waveform import MAIN_LOBE, Waveform
from isac_rt.kernels import track_images
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.track_images import EDGE, LEAST_RANGE
from isac_rt.receive.types import Detections
from isac_rt.track.filter import Ambiguity, measure, wrapped
from isac_rt.track.parts import Ownship, TrackRule
from isac_rt.world.mirrors import mirror_image
from isac_rt.world.swarm import Pose

WELL_INSIDE = 0.95
"""Share of the view's largest cosines within which a direction is no alias of one outside."""
ALIAS_DEVIATIONS = 3.0
"""So many deviations further inside at a passive terminal, whose array is half as long."""
CORNER_STEPS_M = 0.02, 2 * EDGE
"""From the edge of a corner on each plane [m], or beside by half of it: a roof's wall may end a
hand above it, and planes need not meet."""


class Images(TrackRule):
    """No track starts from what may be an image of the transmitter, or an alias from beyond the
    view.

    Parameters
    ----------
    walls : the mesh
    passes : 2 at an active terminal, which sees itself, 1 at a passive one
    """

    def __init__(self, walls: Walls, antennas: Antennas, waveform: Waveform, passes: int) -> None:
        self._walls, self._passes, self._antennas = walls, passes, antennas
        self._edge = WELL_INSIDE * antennas.view_limit
        self._ambiguity = Ambiguity.of(waveform, passes)
        cells = resolutions(waveform, antennas, passes)
        self._beside, self._beam = MAIN_LOBE * cells[:2], cells[2:]
        self._cosine_period = antennas.cosine_period(waveform.wavelength, passes)

    def candidates(self, detections: Detections, own: Ownship) -> Detections:
        d = detections
        spread = ALIAS_DEVIATIONS * d.std[:, 2:] if self._passes == 1 else 0.0
        inside = np.abs(d.direction) + spread < self._edge
        starts = d.starts & inside.all(axis=1)
        if starts.any():
            some = np.flatnonzero(starts)
            starts[some] = ~self._beside_images(d.select(some), own)
        return replace(d, starts=starts)

    def _beside_images(self, d: Detections, own: Ownship) -> np.ndarray:
        """(Q,) which detections lie within an image's main lobe: at a passive terminal in direction
        too, or in an alias of it."""
        reach, here = float(d.range.max()) + 1, own.pose
        if self._passes == 2:
            known = Ways.of_own(here, self._walls, reach)
        elif own.transmitter is not None:
            known = Ways.of_sender(own.transmitter.mean[:6], here, self._walls, reach)
        else:
            return np.zeros(len(d), bool)
        off = np.abs(wrapped(d.measured[:, None, :2] - known.seen[:, :2], self._ambiguity))
        beside = (off < self._beside).all(axis=-1)
        if self._passes == 1:
            away = np.abs(folded(d.direction[:, None] - known.seen[:, 2:], self._cosine_period))
            beside &= (away < self._beam + ALIAS_DEVIATIONS * d.std[:, None, 2:]).all(axis=-1)
        gain = self._antennas.element_gain(here.to_body(_unit(known.images[:, :3] - here.position)))
        for k in np.flatnonzero(beside.any(axis=0)):
            beside[:, k] &= gain[k] > 0 and not self._walls.block(known.points[k], EDGE)
        return np.asarray(beside.any(axis=1))


class Ways(NamedTuple):
    """Ways over one plane or two to a terminal.

    Attributes
    ----------
    images : (K, 6) from where waves seem to come, world coordinates
    points : (K, 4, 3) their ends and between them where they meet planes, the same twice for one
    seen : (K, 4) length [m], its rate [m/s] and direction cosines; of own images half of both, as
        of echoes
    """

    images: np.ndarray
    points: np.ndarray
    seen: np.ndarray

    @classmethod
    def of_own(cls, own: Pose, walls: Walls, reach: float) -> Ways:
        """A terminal's own images up to a range [m]."""
        near = walls.near(own, reach)
        here = np.concatenate([own.position, own.velocity])
        found = _images(here, here, walls, (near, near), 2 * reach)
        return cls(*found, measure(found[0], own) * [0.5, 0.5, 1, 1])

    @classmethod
    def of_sender(cls, sender: np.ndarray, own: Pose, walls: Walls, reach: float) -> Ways:
        """Ways of at most `reach` [m] from a transmitter (6,), position and velocity in world
        coordinates, to a passive terminal."""
        here = np.concatenate([own.position, own.velocity])
        near = walls.about(sender[:3], reach), walls.near(own, reach)
        found = _images(sender, here, walls, near, reach)
        return cls(*found, measure(found[0], own))


def _images(
    start: np.ndarray,
    end: np.ndarray,
    walls: Walls,
    near: tuple[np.ndarray, np.ndarray],
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Images (K, 6) of `start` (6,) that `end` (6,) sees, over mirrors that are near the one and
    the other, and the ways of their waves (K, 4, 3)."""
    _, single, places = walls.images(start, end, reach, EDGE, near[1])
    far = np.linalg.norm(single[:, :3] - end[:3], axis=1) > 2 * LEAST_RANGE
    by_one = single[far], np.stack([places, places], axis=1)[far]
    parts = by_one, _by_two(start, end, walls, near, reach)
    images, points = (np.concatenate(of) for of in zip(*parts, strict=True))
    first, last = (np.tile(of[:3], (len(images), 1, 1)) for of in (start, end))
    return images, np.concatenate([first, points, last], axis=1)


def _by_two(
    start: np.ndarray,
    end: np.ndarray,
    walls: Walls,
    near: tuple[np.ndarray, np.ndarray],
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The wave over plane i, then j, comes from the image p_ij of the start's image in i; it meets
    j at B, and i at A. A = B is a corner, which sends back if each plane goes on in front of the
    other: that of a house does not."""
    _, normals, offsets = walls.mirrors
    pairs, places = met(start[:3], end[:3], normals, offsets, *walls.boxes, *near, reach)
    i, j = pairs.T
    A, B, at_j = places.swapaxes(0, 1)
    kept = np.flatnonzero(walls.holds(i, A, EDGE))
    kept = kept[walls.holds(j[kept], B[kept], EDGE)]
    i, j, A, B, at_j = (of[kept] for of in (i, j, A, B, at_j))
    n, m = (  # towards the ends
        np.sign(normals[k] @ end_of[:3] - offsets[k])[:, None] * normals[k]
        for k, end_of in ((i, start), (j, end))
    )
    sends, along = np.linalg.norm(A - B, axis=1) > EDGE, np.vecdot(n, m)[:, None]
    at = np.flatnonzero(~sends)
    sends[at] = True
    for k, place, ahead in ((i, A, m - along * n), (j, B, n - along * m)):
        ahead = _unit(ahead[at])
        on = [walls.holds(k[at], place[at] + s * ahead, s / 2) for s in CORNER_STEPS_M]
        sends[at] &= np.any(on, axis=0)
    turned = mirror_image(mirror_image(start[3:], n), m)
    return np.hstack([at_j, turned])[sends], np.stack([A, B], axis=1)[sends]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@twin_of(track_images.met)
def met(
    start: np.ndarray,
    end: np.ndarray,
    normals: np.ndarray,
    offsets: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (K, 2) of mirrors, one of `first` and one of `last`, over which a path of at most
    `reach` [m] may lead from `start` to `end` (3,), with A, B and p_ij (K, 3, 3).

    Mirrors have normals (W, 3), offsets (W,) and boxes from `low` to `high` (W, 3). A point x has
    the image x - 2 (n.x - d) n; the square of its distance from a point on its own side is longer
    by 4 (n.x - d) (n.y - d) than that of x itself.
    """
    pairs, places = [np.zeros((0, 2), np.int64)], [np.zeros((0, 3, 3))]
    before = normals[last] @ end - offsets[last]
    for i in first:
        s = normals[i] @ start - offsets[i]
        once = mirror_image(start, normals[i], offsets[i])
        base2, beyond = ((once - end) ** 2).sum(), normals[last] @ once - offsets[last]
        longer = 4 * beyond * before
        some = (longer > max((2 * LEAST_RANGE) ** 2 - base2, 0)) & (longer < reach**2 - base2)
        some &= last != i
        j, share = last[some], (beyond[some] / (beyond[some] + before[some]))[:, None]
        at_j = mirror_image(once, normals[j], offsets[j])
        B = at_j + (end - at_j) * share
        height = B @ normals[i] - offsets[i]
        A = once + (B - once) * (s / (s + height))[:, None]
        on = height * s > -EDGE * abs(s)
        for point, of in ((B, j), (A, i)):
            on &= ((low[of] - EDGE <= point) & (point <= high[of] + EDGE)).all(axis=1)
        pairs.append(np.column_stack([np.full(on.sum(), i), j[on]]))
        places.append(np.stack([A, B, at_j], axis=1)[on])
    return np.concatenate(pairs), np.concatenate(places)
