"""Paths over the faces of boxes that move: mirrors between terminals, and echoes of UAVs.

A segment over a face runs straight from an end's image, which moves with the face (docs/moving.md).
It lives while both its ends stand before the face and the point of reflection is on it. The echo of
a UAV has such a segment before it, after it or both, with the amplitude of the radar equation over
both lengths.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from isac_rt.extensions.street.centres import Attitude
from isac_rt.extensions.street.occlusion import Occlusion
from isac_rt.extensions.street.solid import TINY, Solid
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


class Box(NamedTuple):
    """A box at the middle of a frame.

    Attributes
    ----------
    number : place of the UAV among all
    solid : its shape
    material : of its faces
    pose : of its middle
    attitude : of its axes
    """

    number: int
    solid: Solid
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
            box = FIRST_BOX - int(stretch.faces[0])
            yield _path(state, ways, (gain, PathKind.SPECULAR, box), [stretch])

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
        yield _path(state, ways, (gain, PathKind.GHOST, index), [there, back], pose.position)

    def _straight(self, state: LinkState) -> Iterator[Stretch]:
        """Yield the straight segment from start to end, unless the city hides it."""
        if not self.occlusion.hidden(replace(state, end=state.start), state.end.position[None])[0]:
            segments = straight(state.start, *state.end.motion()[:, None])
            yield Stretch(segments, 1.0, np.zeros((0, 3)), np.zeros(0, int))

    def _over_faces(self, state: LinkState) -> Iterator[Stretch]:
        """Yield the segments from start to end over faces; the middle of a box is before none."""
        for box, axes in zip(self.boxes, self._axes, strict=True):
            margin = margins(box, axes, (state.start, state.end), self._time)
            for face in np.flatnonzero((margin > 0).any(axis=0)):
                stretch = self._stretch(state, box, box.solid.planes[face])
                if not self.occlusion.hidden(state, stretch.points)[0]:
                    for begin, end in lives(self._time, margin[:, face]):
                        yield stretch._replace(begin=begin, end=end)

    def _stretch(self, state: LinkState, box: Box, plane: np.ndarray) -> Stretch:
        """Return the segment over the face in a plane (4,), by Fresnel's coefficients."""
        normal = (box.attitude.axes @ plane[:3])[None]
        image = face_image(state.start, box, plane)
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


def _path(
    state: LinkState,
    ways: ScatterPaths,
    about: tuple[np.ndarray, PathKind, int],
    met: Sequence[Stretch],
    place: np.ndarray | None = None,
) -> PathSet:
    """Return one path of a gain, kind and target while all segments live that it has met, a UAV's
    place between them."""
    points, faces = [one.points for one in met], [one.faces for one in met]
    bounces = sum(map(len, points))
    if place is not None:
        points.insert(1, place[None])
        faces.insert(1, np.array([-1]))
    gain, kind, target = about
    along = {"points": np.concatenate(points)[None], "faces": np.concatenate(faces)[None]}
    paths = state.paths(ways, gain, kind, target=target, bounces=bounces, **along)
    begin, end = max(one.begin for one in met), min(one.end for one in met)
    return replace(paths, begin=np.full(len(paths), begin), end=np.full(len(paths), end))


def face_image(end: Pose, box: Box, plane: np.ndarray) -> Pose:
    """Return the image of an end behind the face in a plane (4,), with velocity and
    acceleration."""
    normal, spin = box.attitude.axes @ plane[:3], box.attitude.rate
    turn = np.cross(spin, normal)
    twist = np.cross(box.attitude.accel, normal) + np.cross(spin, turn)
    place, velocity, acceleration = end.motion() - box.pose.motion()
    height = normal @ place - plane[3]
    rise = turn @ place + normal @ velocity
    lift = twist @ place + 2 * turn @ velocity + normal @ acceleration
    return replace(
        end,
        position=end.position - 2 * height * normal,
        velocity=end.velocity - 2 * (rise * normal + height * turn),
        acceleration=end.acceleration - 2 * (lift * normal + 2 * rise * turn + height * twist),
    )


def margins(box: Box, axes: np.ndarray, ends: tuple[Pose, Pose], time: np.ndarray) -> np.ndarray:
    """Return how far the reflections at the faces (F,) are from failing at times (T,) [s since the
    epoch], (T, F): the least of both ends' heights over the face and of the point's depths under
    the planes of all others [m].

    Parameters
    ----------
    axes : (T, 3, 3) of the box
    """
    t, solid, heights, feet = time[:, None], box.solid, [], []
    for end in ends:
        place, velocity, acceleration = end.motion() - box.pose.motion()
        offset = place + (velocity + acceleration * t / 2) * t
        from_box = (offset[:, None] @ axes)[:, 0]
        heights.append(-solid.depths(from_box))
        feet.append(from_box[:, None] - heights[-1][..., None] * solid.planes[:, :3])
    high, low = np.maximum(heights, TINY)
    share = (high / (high + low))[..., None]
    beside = solid.depths(feet[0] + share * (feet[1] - feet[0]))
    own = np.arange(len(solid.planes))
    beside[:, own, own] = np.inf
    return np.minimum(np.min(heights, axis=0), beside.min(axis=2))


def lives(time: np.ndarray, margin: np.ndarray) -> list[tuple[float, float]]:
    """Return when a margin (T,) is positive, linear between times (T,); from -inf and to inf where
    it is at the ends."""
    alive = margin > 0
    at = np.flatnonzero(alive[1:] != alive[:-1])
    share = margin[at] / (margin[at] - margin[at + 1])
    changes = (time[at] + share * (time[at + 1] - time[at])).tolist()
    bounds = [-np.inf] * bool(alive[0]) + changes + [np.inf] * bool(alive[-1])
    return list(zip(bounds[::2], bounds[1::2], strict=True))
