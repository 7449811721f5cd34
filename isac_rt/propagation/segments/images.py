"""Paths over chains of walls by their images, in float64.

A chain of planes is a path where the straight line from the last image of the terminal meets each
mirror between the image and what it leads to, where there is a face at each of these points, and
where nothing stands in the way. The first two are exact; the third is asked of rays. The face that
holds a point says its material.

Where walls meet at right angles (or a wall the ground), the mirror path of a terminal to itself
runs through their edge, in every order of the walls at once: each order holds a part of the
wavefront, and together they make one image. Walls that are not quite at right angles let it pass on
one side or the other of the edge, so chains of two and more bounces are also sought to points
beside each terminal, and unfolded to the terminal itself.

Local coordinates. Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.kernels import propagation_images
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.propagation_images import WIDER
from isac_rt.propagation.segments.chains import Chains
from isac_rt.propagation.segments.geometry import (
    RAY_OFFSET_M,
    Segments,
    edges_in_any_order,
    one_of_each_chain,
    plane_of_each_face,
    unfold,
)
from isac_rt.propagation.segments.rays import LosTest
from isac_rt.propagation.segments.reflection import mirror_amplitude
from isac_rt.propagation.segments.segment_set import SegmentSet, segment_set
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import mirror_image, plane_crossing
from isac_rt.world.swarm import Pose

PROBES_M = np.array([[0.061, -0.047, 0.064], [0.052, 0.073, -0.044]])
"""From a terminal to the points beside it to which corners are sought, local coordinates [m]. A
tenth of a metre is what Sionna's ray offsets need (3 cm: half of the corners, 1 cm: none) and less
than a Fresnel zone; two points, because one that lies towards the corner does not help."""
SLACK = float(4 * np.linalg.norm(PROBES_M, axis=1).max())
"""Most by which the points of a corner's path may differ between the terminal and a point beside it
[m], and `STRETCH` of the path's length."""
STRETCH = 1e-3


class Mirrors(NamedTuple):
    """Planes of a city and the faces in each, as compiled code takes them.

    Attributes
    ----------
    normals, offsets : (P, 3), (P,)
    low, high : (P, 3) box about the faces of each plane [m]
    axes : (P, 3) numbers of the coordinates: along which the faces are sorted, across, and the one
        that is left out
    first : (P + 1,) where the faces of each plane begin
    face : (F,) faces, plane by plane
    begin : (F,) least coordinate of each along its plane's first axis [m]
    widest : (P,) longest face along the first axis [m]
    sides : (F, 3, 3) a, b, c of a u + b v + c, the distance from each side, >= 0 inside [m]
    """

    normals: np.ndarray
    offsets: np.ndarray
    low: np.ndarray
    high: np.ndarray
    axes: np.ndarray
    first: np.ndarray
    face: np.ndarray
    begin: np.ndarray
    widest: np.ndarray
    sides: np.ndarray

    @classmethod
    def of(cls, city: CityMesh) -> Mirrors:
        """The mirrors of a city."""
        plane = city.plane_of_face
        count = int(plane.max(initial=-1)) + 1
        by_face = plane_of_each_face(city)
        _, some = np.unique(plane, return_index=True)
        normals, offsets = (values[some] for values in by_face)
        low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
        np.minimum.at(low, plane, city.boxes[0])
        np.maximum.at(high, plane, city.boxes[1])
        left_out = np.abs(normals).argmax(axis=1)
        others = np.stack([(left_out + 1) % 3, (left_out + 2) % 3], axis=1)
        wide = np.take_along_axis(high - low, others, axis=1)
        others[wide[:, 0] < wide[:, 1]] = others[wide[:, 0] < wide[:, 1], ::-1]
        axes = np.column_stack([others, left_out])
        flat = np.take_along_axis(city.corners, axes[plane][:, None, :2], axis=2)
        begin = flat[:, :, 0].min(axis=1)
        widest = np.zeros(count)
        np.maximum.at(widest, plane, flat[:, :, 0].max(axis=1) - begin)
        order = np.lexsort([np.arange(len(plane)), begin, plane])
        first = np.searchsorted(plane[order], np.arange(count + 1))
        columns = low - WIDER, high + WIDER, axes, first, order, begin[order], widest
        return cls(normals, offsets, *columns, _sides(flat[order]))


def _sides(flat: np.ndarray) -> np.ndarray:
    """(F, 3, 3) of triangles (F, 3, 2) in a plane, either way round."""
    span = np.roll(flat, -1, axis=1) - flat
    around = span[:, 0, 0] * span[:, 1, 1] - span[:, 0, 1] * span[:, 1, 0]
    across = np.stack([-span[..., 1], span[..., 0]], axis=2) * np.sign(around)[:, None, None]
    across /= np.linalg.norm(span, axis=2, keepdims=True)
    return np.concatenate([across, -(across * flat).sum(2, keepdims=True)], axis=2)


@dataclass(frozen=True)
class _Candidates:
    """K chains of B bounces that may be paths at one instant.

    Attributes
    ----------
    pair : (K,) number of the pair
    faces : (K, B)
    normals : (K, B, 3)
    segments : to the end of the pair
    stops : (K, B + 2, 3) places that each visits in turn, to the end or to the place beside it
    """

    pair: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    segments: Segments
    stops: np.ndarray


class Images:
    """Places chains between the terminals and the UAVs of one city.

    Parameters
    ----------
    city : CityMesh
    los : for rays
    wavelength : [m]
    depth : most planes of a chain
    """

    def __init__(self, city: CityMesh, los: LosTest, wavelength: float, depth: int) -> None:
        self._city, self._los, self._wavelength = city, los, wavelength
        self._depth, self._mirrors = depth, Mirrors.of(city)
        self._planes = plane_of_each_face(city)

    def segments(
        self, chains: Mapping[str, Chains], local: Mapping[str, Pose]
    ) -> dict[Link, SegmentSet]:
        """Mirror reflections from the terminals that `chains` names to all UAVs, for their poses;
        sorted by bounces and length."""
        pairs = [Link(start, end) for start in chains for end in local]
        rows = [self._rows(chains, local, start) for start in chains]
        motion = np.array([[local[name].motion() for name in pair] for pair in pairs])
        parts = []
        every = np.concatenate([np.zeros((0, self._depth + 2), np.int64), *rows])
        bounces = (every[:, 2:] >= 0).sum(axis=1)
        for count in range(1, self._depth + 1):
            pick = every[(bounces == count) & ((count > 1) | (every[:, 1] < 0))]
            parts.append(self._candidates(pick[:, 0], pick[:, 1], pick[:, 2 : 2 + count], motion))
        clear = self._clear(parts)
        return self._settled(parts, clear, pairs)

    def _rows(
        self, chains: Mapping[str, Chains], local: Mapping[str, Pose], start: str
    ) -> np.ndarray:
        """(K, 2 + depth) number of the pair, of the point beside the terminal (-1: the UAV itself),
        and faces, of chains from a terminal."""
        position, names = local[start].position, list(local)
        ends = np.array([local[name].position for name in names])
        if self._depth > 1:
            ends = np.concatenate([ends, position + PROBES_M])
        images = reflected(chains[start], self._mirrors, self._depth, position, ends)
        end = images[:, 0]
        beside = np.where(end < len(names), -1, end - len(names))
        end = np.where(end < len(names), end, names.index(start))
        pair = list(chains).index(start) * len(names) + end
        return np.column_stack([pair, beside, images[:, 1:]])

    def _candidates(
        self, pair: np.ndarray, beside: np.ndarray, faces: np.ndarray, motion: np.ndarray
    ) -> _Candidates:
        """Chains (K, B) unfolded; those to points beside a terminal are left out where they run
        elsewhere than to the terminal itself."""
        normals, offsets = (values[faces] for values in self._planes)
        start, end = (_stacked(motion[pair, side]) for side in (0, 1))
        segments = unfold(normals, offsets, start, end)
        aside = beside >= 0
        tip = end.position + np.where(aside[:, None], PROBES_M[beside], 0.0)
        points = segments.points.copy()
        there = _stacked(motion[pair[aside], 1])
        there = replace(there, position=tip[aside])
        begin = _stacked(motion[pair[aside], 0])
        points[aside] = unfold(normals[aside], offsets[aside], begin, there).points
        distance = np.linalg.norm(segments.points - points, axis=2).max(axis=1, initial=0.0)
        stops = np.concatenate([start.position[:, None], points, tip[:, None]], axis=1)
        keep = np.flatnonzero(distance < SLACK + STRETCH * segments.length)
        chosen = segments.select(keep)
        return _Candidates(pair[keep], faces[keep], normals[keep], chosen, stops[keep])

    def _clear(self, parts: list[_Candidates]) -> list[np.ndarray]:
        """(K,) of each part, whether nothing stands in the way."""
        lifted = [_lifted(part.stops, part.normals) for part in parts]
        starts, ends = (
            np.concatenate([np.zeros((0, 3)), *(rays[side].reshape(-1, 3) for rays in lifted)])
            for side in (0, 1)
        )
        clear, out, first = self._los.clear(starts, ends), [], 0
        for rays, _ in lifted:
            here = clear[first : first + rays.shape[0] * rays.shape[1]]
            out.append(np.all(here.reshape(rays.shape[:2]), axis=1))
            first += here.size
        return out

    def _settled(
        self, parts: list[_Candidates], clear: list[np.ndarray], pairs: list[Link]
    ) -> dict[Link, SegmentSet]:
        """Return each path once, sorted by pair, bounces and length, with its amplitudes."""
        sets, owners = [], []
        for part, good in zip(parts, clear, strict=True):
            planes = edges_in_any_order(self._city.plane_of_face[part.faces], part.segments.points)
            owned = np.column_stack([part.pair, planes])
            keep = one_of_each_chain(owned, part.faces, good)
            segments, faces = part.segments.select(keep), part.faces[keep]
            amplitude = mirror_amplitude(
                self._city, part.normals[keep], faces, segments, self._wavelength
            )
            sets.append((amplitude, segments, faces, planes[keep]))
            owners.append(part.pair[keep])
        width = max(self._depth, 1)  # a straight segment may bend round one point
        every, owner = segment_set(sets, width), np.concatenate([np.zeros(0, int), *owners])
        order = np.lexsort([every.segments.length, every.bounces, owner])
        edges = np.searchsorted(owner[order], np.arange(len(pairs) + 1))
        rows = [order[a:b] for a, b in itertools.pairwise(edges)]
        return {pair: every.select(which) for pair, which in zip(pairs, rows, strict=True)}


def _stacked(motion: np.ndarray) -> Pose:
    """UAVs in motion (K, 3, 3), one a row."""
    return Pose(motion[:, 0], motion[:, 1], motion[:, 2], np.eye(3))


def _lifted(stops: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and ends (K, B + 1, 3) of the paths' straight pieces, `RAY_OFFSET_M` off the
    walls on the path's side."""
    lift = np.zeros_like(stops)
    side = np.sign(((stops[:, :-2] - stops[:, 1:-1]) * normals).sum(2))
    lift[:, 1:-1] = RAY_OFFSET_M * side[..., None] * normals
    return (stops + lift)[:, :-1], (stops + lift)[:, 1:]


@twin_of(propagation_images.reflected)
def reflected(
    chains: Chains, mirrors: Mirrors, depth: int, start: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """Find the chains that lead from a place (3,) to places (S, 3) by way of faces, whatever stands
    between: the straight way from the last image must cross each mirror, on a face.

    Returns
    -------
    rows : (K, 1 + depth) number of the place, and the faces in order, -1 where a chain is shorter
    """
    images = np.empty((len(chains.plane), 3))
    for level in map(slice, chains.first[:-1], chains.first[1:]):
        parent, plane = chains.parent[level, None], chains.plane[level]
        source = np.where(parent < 0, start, images[parent[:, 0]])
        images[level] = mirror_image(source, mirrors.normals[plane], mirrors.offsets[plane])
    row, place = np.divmod(np.arange(len(images) * len(ends)), len(ends))
    point, faces = ends[place], np.full((row.size, depth), -1)
    for _ in range(depth):  # backwards, from the place to the terminal; row -1: is there
        plane = chains.plane[row]
        sides = [
            (mirrors.normals[plane] * end).sum(axis=1) > mirrors.offsets[plane]
            for end in (point, images[row])
        ]
        row = np.where((row >= 0) & (sides[0] == sides[1]), -2, row)
        on = np.flatnonzero(row >= 0)
        plane, normal, offset = plane[on], mirrors.normals[plane[on]], mirrors.offsets[plane[on]]
        point[on] = plane_crossing(images[row[on]], point[on], normal, offset)
        face = _faces_at(mirrors, plane, point[on])
        faces[on] = np.column_stack([face, faces[on, :-1]])
        row[on] = np.where(face >= 0, chains.parent[row[on]], -2)
    return np.column_stack([place, faces])[row == -1]


def _faces_at(mirrors: Mirrors, plane: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(K,) the first faces of planes that hold points (K, 3) of them; -1 where there is none."""
    out, none = np.full(len(plane), -1), len(mirrors.face)
    for number in np.unique(plane):
        on = plane == number
        at, faces = points[on], slice(*mirrors.first[number : number + 2])
        flat = np.column_stack([at[:, mirrors.axes[number, :2]], np.ones(len(at))])
        inside = (np.einsum("fsc,kc->kfs", mirrors.sides[faces], flat) >= -WIDER).all(axis=2)
        inside &= ((mirrors.low[number] <= at) & (at <= mirrors.high[number])).all(axis=1)[:, None]
        first = np.where(inside, mirrors.face[faces], none).min(axis=1)
        out[on] = np.where(first < none, first, -1)
    return out
