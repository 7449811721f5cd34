r"""Boxes that move, such as cars and trams: shadows of paths, and paths over their faces.

**Shadow.** The part of a box that lies between the ends of a straight part of a path is a screen
across it, in the middle of that part: the smallest rectangle about its silhouette whose one side is
level. By Babinet's principle its factor is, with `knife_edge` F of the edges at the heights u and v
in Fresnel units,

.. math:: 1 - \big(F(u_1) - F(u_2)\big)\big(F(v_1) - F(v_2)\big)

exact in the Fresnel approximation for a rectangle (M. Born and E. Wolf, *Principles of Optics*,
section 8.7). It is that of the frame's middle; until the frame's end each Fresnel unit that an edge
moves changes it by 1.4/sqrt(2) at most, the other two edges' :math:`|F(v_1) - F(v_2)|` times that
of :math:`F'`.

**Mirror.** With n(t) the normal of a face at the height s over the box's middle p(t), the
transmitter T has the image :math:`T - 2hn`, :math:`h = n\cdot(T - p) - s`, which sends straight to
the receiver. Its velocity and acceleration have the derivatives of h and n,
:math:`\dot n = \omega\times n` and :math:`\ddot n = \dot\omega\times n + \omega\times\dot n`.
A path lives while both ends stand before the face and the point of reflection is on it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from isac_rt.extensions.street.centres import Attitude, attitude_about, body_axes
from isac_rt.extensions.street.occlusion import Occlusion
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.free_space import FreeSpace, friis_amplitude
from isac_rt.propagation.model import Census, Propagation, Traced
from isac_rt.propagation.pathset import PathKind, PathSet, merge
from isac_rt.propagation.scatter_paths import LinkState, ScatterPaths
from isac_rt.propagation.segments.diffraction import LIT_REACH, fresnel_unit, knife_edge, tapered
from isac_rt.propagation.segments.geometry import straight
from isac_rt.propagation.segments.reflection import mirrored_field, slab_coefficients, vertical
from isac_rt.world.city.materials import CityError, Material, MaterialUse, resolve_materials
from isac_rt.world.mirrors import mirror_image
from isac_rt.world.settings import MaterialOverride
from isac_rt.world.swarm import Pose, Swarm

INSTANTS = 65
"""Instants of a frame between which a face is taken to come into view and go linearly."""
TURN_STEP = 1e-4
"""Step [s] of the differences that are a box's turn: 1e-9 rad/s and 1e-8 rad/s^2 of error."""
CORNERS = np.array(list(itertools.product((-1, 1), repeat=3)))
EDGES = np.array([e for e in itertools.combinations(range(8), 2) if (e[0] ^ e[1]) in (1, 2, 4)])
"""Pairs of corners that differ in one sign."""


class Box(NamedTuple):
    """A box at the middle of a frame.

    Attributes
    ----------
    name : of the UAV
    half : (3,) half its width, length and height [m]
    pose : of its middle
    attitude : of its axes
    """

    name: str
    half: np.ndarray
    pose: Pose
    attitude: Attitude


class Boxes:
    """A propagation model with boxes.

    Parameters
    ----------
    swarm : whose UAVs may have boxes
    changes : of materials, by name
    model : of the paths without boxes
    free : terminals and antennas
    waveform : of the run
    city : whose surfaces hide faces; None: open space
    """

    def __init__(
        self,
        swarm: Swarm,
        changes: Mapping[str, MaterialOverride],
        model: Propagation,
        free: FreeSpace,
        waveform: Waveform,
        city: Any,
    ) -> None:
        self.model, self._swarm, self._free, self._waveform = model, swarm, free, waveform
        self._occlusion = Occlusion(city, waveform.carrier_frequency)
        self._halves: dict[str, np.ndarray] = {}
        self._materials: dict[str, Material] = {}
        for name, uav in swarm.uavs.items():
            if uav.box is not None:
                use = MaterialUse(uav.box.material)
                try:
                    _, (material,) = resolve_materials([use], waveform.carrier_frequency, changes)
                except CityError as problem:
                    raise CityError(f"swarm.{name}.box.material: {problem}") from None
                self._materials[name], self._halves[name] = material, np.array(uav.box.size_m) / 2

    def census(self) -> Census:
        """Return the census of the underlying model."""
        return self.model.census()

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Return the model's paths and those over faces, shadowed."""
        found, dropped = self.model.trace(poses, epoch, links)
        boxes = [
            Box(name, half, poses[name], attitude_about(self._swarm, name, epoch, TURN_STEP))
            for name, half in self._halves.items()
        ]
        out = {}
        for link, paths in found.items():
            state = LinkState(link, epoch, poses[link.tx], poses[link.rx], paths.target_names)
            parts = [self._mirrored(state, box) for box in boxes]
            mirrors = np.repeat([box.name for box in boxes], list(map(len, parts)))
            owner = np.append(np.array([*paths.target_names, ""])[paths.target], mirrors)
            every = merge([paths, *itertools.chain(*parts)])
            factor = self._shadow(every, state, boxes, owner)
            out[link] = replace(every, gain=every.gain * factor)
        return Traced(out, dropped)

    def _shadow(
        self, paths: PathSet, state: LinkState, boxes: list[Box], owner: np.ndarray
    ) -> np.ndarray:
        """Return the factor (K,) of all boxes but the `owner` (K,) of a path, by name."""
        chain = stops(paths, state)
        # statistical clutter has no place
        nowhere = (paths.kind == PathKind.DIFFUSE) & ~np.isfinite(paths.points).any(axis=(1, 2))
        nowhere |= paths.kind == PathKind.LEAKAGE
        lengths = np.linalg.norm(np.diff(chain, axis=1), axis=2)
        before, total = np.cumsum(lengths, axis=1) - lengths, lengths.sum(axis=1)
        out = np.ones(len(paths), complex)
        for box in boxes:
            for k in range(lengths.shape[1]):
                some = np.flatnonzero((owner != box.name) & ~nowhere & (lengths[:, k] > 0))
                ways = chain[some, k], chain[some, k + 1], before[some, k], total[some]
                out[some] *= past_box(box, *ways, self._free.wavelength)
        return out

    def _mirrored(self, state: LinkState, box: Box) -> list[PathSet]:
        """Return the paths over the faces of a box, one for each time that a face mirrors."""
        half = self._waveform.frame_duration / 2
        time, out = np.linspace(-half, half, INSTANTS), []
        for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
            for begin, end in lives(time, face_margin(state, box, (axis, sign), time)):
                path = self._over_face(state, box, axis, sign)
                if len(path) and not self._occlusion.hidden(state, path.points[:, 0]).any():
                    out.append(replace(path, begin=np.array([begin]), end=np.array([end])))
        return out

    def _over_face(self, state: LinkState, box: Box, axis: int, sign: float) -> PathSet:
        """Return the path over a face, by Fresnel's coefficients."""
        normal, wavelength = sign * box.attitude.axes[None, :, axis], self._free.wavelength
        receiver, image = state.end, face_image(state.start, box, axis, sign)
        segment = straight(image, *receiver.motion()[:, None])
        out, arrival = segment.departure, segment.arrival
        along = mirror_image(out, normal)
        cosine = np.abs((out * normal).sum(1))
        te, tm = slab_coefficients(self._materials[box.name], cosine, wavelength)
        field = mirrored_field(vertical(along).astype(complex), along, out, normal, te, tm)
        ways = ScatterPaths.along(replace(segment, departure=along))
        gain = (field * vertical(arrival)).sum(1) * friis_amplitude(wavelength, segment.length)
        over = np.linalg.norm(state.start.position - image.position) / 2  # height over the face
        point = (
            state.start.position + along * over / np.maximum(cosine, np.finfo(float).tiny)[:, None]
        )
        return state.paths(
            ways,
            gain * state.elements(self._free.arrays, ways),
            PathKind.SPECULAR,
            bounces=1,
            points=point[:, None],
            faces=np.full((1, 1), -1),
        )


def box_corners(swarm: Swarm, times: Sequence[float]) -> dict[str, np.ndarray]:
    """Return the corners (T, 8, 3) of a swarm's boxes at some times [s], by UAV."""
    return {
        name: np.array(
            [
                swarm.trajectories[name].pose(t).position
                + (CORNERS * uav.box.size_m / 2) @ body_axes(swarm, name, t).T
                for t in times
            ]
        )
        for name, uav in swarm.uavs.items()
        if uav.box is not None
    }


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


def face_margin(
    state: LinkState, box: Box, face: tuple[int, float], time: np.ndarray
) -> np.ndarray:
    """Return how far (T,) the reflection is from failing at times (T,) [s since the epoch]: the
    least of both ends' heights over the face and of the point's distances from its rim [m]."""
    axis, sign = face
    t, (rate, accel) = time[:, None], box.attitude[1:]
    axes = Rotation.from_rotvec((rate + accel * t / 2) * t).as_matrix() @ box.attitude.axes
    heights, places = [], []
    for end in (state.start, state.end):
        place, velocity, acceleration = end.motion() - box.pose.motion()
        of_end = ((place + (velocity + acceleration * t / 2) * t)[:, None] @ axes)[:, 0]
        heights.append(sign * of_end[:, axis] - box.half[axis])
        places.append(of_end)
    first, second = (np.maximum(h, np.finfo(float).tiny)[:, None] for h in heights)
    point = (places[0] * second + places[1] * first) / (first + second)
    beside = np.delete(box.half - np.abs(point), axis, axis=1)
    return np.column_stack([*heights, beside]).min(axis=1)


def lives(time: np.ndarray, margin: np.ndarray) -> list[tuple[float, float]]:
    """Return when a margin (T,) is positive, linear between times (T,); from -inf and to inf where
    it is at the ends."""
    there = margin > 0
    at = np.flatnonzero(there[1:] != there[:-1])
    share = margin[at] / (margin[at] - margin[at + 1])
    changes = (time[at] + share * (time[at + 1] - time[at])).tolist()
    bounds = [-np.inf] * bool(there[0]) + changes + [np.inf] * bool(there[-1])
    return list(zip(bounds[::2], bounds[1::2], strict=True))


def stops(paths: PathSet, state: LinkState) -> np.ndarray:
    """Return the ends of each path's straight parts (K, B + 2, 3), some of which have no length."""
    count = len(paths)
    start, end = (np.broadcast_to(e.position, (count, 1, 3)) for e in (state.start, state.end))
    chain = np.concatenate([start, paths.points, end], axis=1)
    for k in range(1, chain.shape[1] - 1):
        chain[:, k] = np.where(np.isfinite(chain[:, k]), chain[:, k], chain[:, k - 1])
    return chain


def past_box(
    box: Box,
    starts: np.ndarray,
    ends: np.ndarray,
    before: np.ndarray,
    total: np.ndarray,
    wavelength: float,
) -> np.ndarray:
    """Return the factor (K,) of a box for straight parts of paths.

    Parameters
    ----------
    starts, ends : (K, 3) of the parts [m]
    before, total : (K,) length of the path before the part, and of all of it [m]
    """
    out, centre = np.ones(len(starts), complex), box.pose.position
    length = np.linalg.norm(ends - starts, axis=1)
    along, to = (ends - starts) / length[:, None], centre - starts
    at = np.clip((to * along).sum(1), 0, length)
    off = np.linalg.norm(to - at[:, None] * along, axis=1)
    largest_unit = np.sqrt(wavelength * total / 8)
    near = np.flatnonzero(off < np.linalg.norm(box.half) + LIT_REACH * largest_unit)
    corners = centre + (CORNERS * box.half) @ box.attitude.axes.T
    up = vertical(along[near])
    basis = np.stack([np.cross(along[near], up), along[near], up], axis=2)  # level, along, across
    low, high = extent_between((corners - starts[near, None]) @ basis, length[near])
    there = np.isfinite(low[:, 1])
    near, low, high = near[there], low[there], high[there]
    middle = before[near] + (low[:, 1] + high[:, 1]) / 2
    unit = fresnel_unit(wavelength, middle, total[near] - middle)
    unit = np.maximum(unit, np.finfo(float).tiny)[:, None]
    first, last = low[:, ::2] / unit, high[:, ::2] / unit
    screened = (knife_edge(first) - knife_edge(last)).prod(axis=1)
    out[near] = tapered(1 - screened, np.maximum(first, -last).max(axis=1))
    return out


def extent_between(corners: np.ndarray, length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and greatest coordinates (K, 3) of boxes, by their corners (K, 8, 3), where
    the second coordinate is from 0 to `length` (K,); not finite where it never is."""
    a, b = corners[:, EDGES[:, 0]], corners[:, EDGES[:, 1]]
    rise = (b - a)[..., 1]
    rise = np.where(rise == 0, np.finfo(float).tiny, rise)
    with np.errstate(over="ignore"):  # to infinity, with the right sign
        shares = -a[..., 1] / rise, (length[:, None] - a[..., 1]) / rise
    first, last = np.minimum(*shares), np.maximum(*shares)
    within = np.tile((first <= 1) & (last >= 0), (1, 2))[..., None]
    cuts = [np.clip(share, 0, 1)[..., None] for share in (first, last)]
    found = np.concatenate([a + cut * (b - a) for cut in cuts], axis=1)
    low, high = np.where(within, found, np.inf), np.where(within, found, -np.inf)
    return low.min(axis=1), high.max(axis=1)
