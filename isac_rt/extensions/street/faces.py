r"""Paths over the faces of boxes that move: mirrors between terminals, and echoes of UAVs.

With n(t) the normal of a face at the height s over the box's middle p(t), an end E of a segment has
the image :math:`E - 2hn`, :math:`h = n\cdot(E - p) - s`, from which the segment runs straight. The
image's velocity and acceleration have the derivatives of h and n,
:math:`\dot n = \omega\times n` and :math:`\ddot n = \dot\omega\times n + \omega\times\dot n`.
A segment lives while both its ends stand before the face and the point of reflection is on it. The
echo of a UAV has such a segment before it, after it or both, with the amplitude of the radar
equation over both lengths.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from isac_rt.extensions.street.centres import Attitude
from isac_rt.extensions.street.occlusion import Occlusion
from isac_rt.propagation.free_space import FreeSpace, friis_amplitude, radar_amplitude
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.scatter_paths import LinkState, ScatterPaths
from isac_rt.propagation.segments.geometry import Segments, straight
from isac_rt.propagation.segments.reflection import mirrored_field, slab_coefficients, vertical
from isac_rt.world.city.materials import Material
from isac_rt.world.mirrors import mirror_image
from isac_rt.world.swarm import Pose

INSTANTS = 65
"""Instants of a frame between which a face is taken to come into view and go linearly."""
FIRST_BOX = -2
"""Number that stands for the face of the first UAV's box in `PathSet.faces`; others count down."""
TINY = np.finfo(float).tiny


class Box(NamedTuple):
    """A box at the middle of a frame.

    Attributes
    ----------
    number : place of the UAV among all
    half : (3,) half its width, length and height [m]
    material : of its faces
    pose : of its middle
    attitude : of its axes
    """

    number: int
    half: np.ndarray
    material: Material
    pose: Pose
    attitude: Attitude

    def middle(self, time: np.ndarray) -> np.ndarray:
        """Return the places of its middle (K, 3) at times (K,) [s since the epoch]."""
        (place, velocity, acceleration), t = self.pose.motion(), time[:, None]
        return place + (velocity + acceleration * t / 2) * t


class Stretch(NamedTuple):
    """A segment from one pose to another, straight or over a face, while it lives.

    Attributes
    ----------
    segments : of one, with the direction in which it really departs
    factor : of its field by the reflection
    points, faces : (B, 3) and (B,) where it is reflected
    begin, end : of its life [s since the epoch]
    """

    segments: Segments
    factor: complex
    points: np.ndarray
    faces: np.ndarray
    begin: float = -np.inf
    end: float = np.inf


@dataclass(frozen=True)
class Mirrors:
    """The faces of boxes in a frame.

    Attributes
    ----------
    boxes : at the middle of the frame
    free : terminals, UAVs and antennas
    occlusion : of points by the city
    half_frame : [s]
    """

    boxes: Sequence[Box]
    free: FreeSpace
    occlusion: Occlusion
    half_frame: float

    @cached_property
    def _time(self) -> np.ndarray:
        return np.linspace(-self.half_frame, self.half_frame, INSTANTS)

    @cached_property
    def _axes(self) -> list[np.ndarray]:
        """Axes (T, 3, 3) of each box at all instants."""
        return [box.attitude.axes_at(self._time) for box in self.boxes]

    def between_terminals(self, state: LinkState) -> Iterator[PathSet]:
        """Yield the paths from end to end over one face each."""
        for stretch in self._over_faces(state):
            ways = ScatterPaths.along(stretch.segments)
            gain = stretch.factor * friis_amplitude(self.free.wavelength, ways.length)
            gain = gain * state.elements(self.free.arrays, ways)
            box, met = FIRST_BOX - int(stretch.faces[0]), _met([stretch])
            yield _alive(state.paths(ways, gain, PathKind.SPECULAR, target=box, **met), [stretch])

    def echoes(self, state: LinkState, poses: dict[str, Pose]) -> Iterator[PathSet]:
        """Yield the echoes of UAVs over one face or two."""
        for index, (name, uav) in enumerate(self.free.uavs.items()):
            if name in state.link or uav.rcs.model == "relative":
                continue
            pose = poses[name]
            seen_from = {end: replace(state, start=poses[end], end=pose) for end in state.link}
            mirrored = {end: list(self._over_faces(way)) for end, way in seen_from.items()}
            if any(mirrored.values()):
                ways = [[*self._straight(seen_from[end]), *mirrored[end]] for end in state.link]
                for there, back in itertools.product(*ways):
                    if there.points.size + back.points.size:
                        yield from self._echo(state, (index, name, pose), there, back)

    def _echo(
        self, state: LinkState, of: tuple[int, str, Pose], there: Stretch, back: Stretch
    ) -> Iterator[PathSet]:
        """Yield the echo of a UAV over two segments, if there is one."""
        index, name, pose = of
        if max(there.begin, back.begin) >= min(there.end, back.end):
            return
        to, on = there.segments, back.segments
        section = self.free.sections[name].square_metres(
            *map(pose.to_body, (to.arrival, on.arrival))
        )
        ways = ScatterPaths.over(to, on)
        gain = radar_amplitude(self.free.wavelength, section, to.length, on.length)
        gain = gain * there.factor * back.factor * state.elements(self.free.arrays, ways)
        met = _met([there, pose.position, back])
        yield _alive(state.paths(ways, gain, PathKind.GHOST, target=index, **met), [there, back])

    def _straight(self, state: LinkState) -> Iterator[Stretch]:
        """Yield the straight segment from start to end, unless the city hides it."""
        if not self.occlusion.hidden(replace(state, end=state.start), state.end.position[None])[0]:
            segments = straight(state.start, *state.end.motion()[:, None])
            yield Stretch(segments, 1.0, np.zeros((0, 3)), np.zeros(0, int))

    def _over_faces(self, state: LinkState) -> Iterator[Stretch]:
        """Yield the segments from start to end over faces; the middle of a box is before none."""
        for box, axes in zip(self.boxes, self._axes, strict=True):
            margin = margins(box, axes, (state.start, state.end), self._time)
            for axis, side in zip(*np.nonzero((margin > 0).any(axis=0)), strict=True):
                stretch = self._stretch(state, box, int(axis), float(2 * side - 1))
                if not self.occlusion.hidden(state, stretch.points)[0]:
                    for begin, end in lives(self._time, margin[:, axis, side]):
                        yield stretch._replace(begin=begin, end=end)

    def _stretch(self, state: LinkState, box: Box, axis: int, sign: float) -> Stretch:
        """Return the segment over a face, by Fresnel's coefficients."""
        normal = sign * box.attitude.axes[None, :, axis]
        image = face_image(state.start, box, axis, sign)
        segment = straight(image, *state.end.motion()[:, None])
        out, arrival = segment.departure, segment.arrival
        along = mirror_image(out, normal)
        cosine = np.abs((out * normal).sum(1))
        te, tm = slab_coefficients(box.material, cosine, self.free.wavelength)
        field = mirrored_field(vertical(along).astype(complex), along, out, normal, te, tm)
        height = np.linalg.norm(state.start.position - image.position) / 2  # over the face
        point = state.start.position + along * height / np.maximum(cosine, TINY)[:, None]
        factor = complex((field * vertical(arrival)).sum())
        return Stretch(
            replace(segment, departure=along), factor, point, np.array([FIRST_BOX - box.number])
        )


def _met(stations: Sequence[Stretch | np.ndarray]) -> dict[str, Any]:
    """Return the interactions of one path: those of segments, the last of them turned round, and a
    UAV's place between."""
    ends = [s for s in stations if isinstance(s, Stretch)]
    points = [s.points if isinstance(s, Stretch) else s[None] for s in stations]
    faces = [s.faces if isinstance(s, Stretch) else np.array([-1]) for s in stations]
    return {
        "points": np.concatenate(points)[None],
        "faces": np.concatenate(faces)[None],
        "bounces": sum(len(s.points) for s in ends),
    }


def _alive(paths: PathSet, stretches: Sequence[Stretch]) -> PathSet:
    """Return a path while all of its segments live."""
    begin, end = (max(s.begin for s in stretches), min(s.end for s in stretches))
    return replace(paths, begin=np.full(len(paths), begin), end=np.full(len(paths), end))


def face_image(end: Pose, box: Box, axis: int, sign: float) -> Pose:
    """Return the image of an end behind a face, with velocity and acceleration."""
    normal, spin = sign * box.attitude.axes[:, axis], box.attitude.rate
    turn = np.cross(spin, normal)
    twist = np.cross(box.attitude.accel, normal) + np.cross(spin, turn)
    place, velocity, acceleration = end.motion() - box.pose.motion()
    height = normal @ place - box.half[axis]
    rise = turn @ place + normal @ velocity
    lift = twist @ place + 2 * turn @ velocity + normal @ acceleration
    return replace(
        end,
        position=end.position - 2 * height * normal,
        velocity=end.velocity - 2 * (rise * normal + height * turn),
        acceleration=end.acceleration - 2 * (lift * normal + 2 * rise * turn + height * twist),
    )


def margins(box: Box, axes: np.ndarray, ends: tuple[Pose, Pose], time: np.ndarray) -> np.ndarray:
    """Return how far the reflections at the faces (3 axes, 2 sides) are from failing at times (T,)
    [s since the epoch], (T, 3, 2): the least of both ends' heights over the face and of the point's
    distances from its rim [m].

    Parameters
    ----------
    axes : (T, 3, 3) of the box
    """
    sides, t, places = np.array([-1.0, 1.0]), time[:, None], []
    for end in ends:
        place, velocity, acceleration = end.motion() - box.pose.motion()
        offset = place + (velocity + acceleration * t / 2) * t
        places.append((offset[:, None] @ axes)[:, 0, :, None])
    first, last = places
    over, under = (place * sides - box.half[:, None] for place in (first, last))
    high, low = np.maximum(over, TINY), np.maximum(under, TINY)
    share = (high / (high + low))[..., None, :]  # (T, axis, 1, side)
    across = first[:, None] + share * (last - first)[:, None]  # (T, axis, coordinate, side)
    beside = box.half[:, None] - np.abs(across)
    beside[:, np.arange(3), np.arange(3)] = np.inf
    return np.minimum(np.minimum(over, under), beside.min(axis=2))


def lives(time: np.ndarray, margin: np.ndarray) -> list[tuple[float, float]]:
    """Return when a margin (T,) is positive, linear between times (T,); from -inf and to inf where
    it is at the ends."""
    alive = margin > 0
    at = np.flatnonzero(alive[1:] != alive[:-1])
    share = margin[at] / (margin[at] - margin[at + 1])
    changes = (time[at] + share * (time[at + 1] - time[at])).tolist()
    bounds = [-np.inf] * bool(alive[0]) + changes + [np.inf] * bool(alive[-1])
    return list(zip(bounds[::2], bounds[1::2], strict=True))
