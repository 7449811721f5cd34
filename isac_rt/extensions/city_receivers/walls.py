"""The planes of a city's mesh as a terminal uses them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import mirror_image
from isac_rt.world.passage import beside, hits
from isac_rt.world.swarm import Pose

SMALLEST_WALL = 1.0
"""Area of a plane's faces together [m^2] below which it is not taken for a mirror: a car's side is
one, for the first Fresnel zone at 77 GHz is 0.3 m wide 40 m away."""
AT_WALL = 1e-4
"""Share of a segment at its ends that may touch what it ends on."""


@dataclass(frozen=True)
class Walls:
    """A mesh as a terminal uses it, in world coordinates."""

    city: CityMesh

    @cached_property
    def mirrors(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Largest face (W,), unit normal (W, 3) and offset n.x (W,) [m] of the planes of
        `SMALLEST_WALL` and more."""
        plane, areas = self.city.plane_of_face, self.city.areas
        largest_first = np.lexsort((-areas, plane))
        planes, first = np.unique(plane[largest_first], return_index=True)
        total = np.bincount(plane, weights=areas)
        faces = largest_first[first[total[planes] >= SMALLEST_WALL]]
        normals = self.city.normals[faces]
        return faces, normals, self.city.plane_offsets[faces] + normals @ self.city.origin

    @cached_property
    def _faces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces of the mirrors one after the other, where each mirror's begin, and the lowest and
        highest corner of each (2, W, 3), world coordinates."""
        plane = self.city.plane_of_face
        order, planes = np.argsort(plane, kind="stable"), plane[self.mirrors[0]]
        faces = order[np.isin(plane[order], planes)]
        first = np.append(np.searchsorted(plane[faces], planes), faces.size)
        corners = self.city.corners[faces] + self.city.origin
        if not faces.size:
            return faces, first, np.zeros((2, 0, 3))
        bounds = [
            of.reduceat(of.reduce(corners, axis=1), first[:-1]) for of in (np.minimum, np.maximum)
        ]
        return faces, first, np.array(bounds)

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors (F, 3, 3) from the edges of `_faces` inwards, and the edges' places along
        them (F, 3) [m]."""
        faces = self._faces[0]
        corners = self.city.corners[faces] + self.city.origin
        side = np.roll(corners, -1, axis=1) - corners
        inward = np.cross(self.city.normals[faces][:, None], side)
        inward /= np.linalg.norm(inward, axis=2, keepdims=True)
        return inward, (corners * inward).sum(axis=2)

    def near(self, own: Pose, reach: float) -> np.ndarray:
        """Numbers of the mirrors of which something may lie within reach [m] and in front."""
        low, high = self.boxes
        p, forward = own.position, own.rotation[:, 1]
        ahead = np.where(forward > 0, high - p, low - p) @ forward
        some = self.about(p, reach)
        return some[ahead[some] > 0]

    def about(self, place: np.ndarray, reach: float) -> np.ndarray:
        """Numbers of the mirrors of which something may lie within reach [m] of a place."""
        low, high = self.boxes
        away = np.maximum(np.maximum(low - place, place - high), 0.0)
        return np.flatnonzero((away**2).sum(axis=1) < reach**2)

    def within(self, place: np.ndarray, reach: float) -> bool:
        """Return whether a face of a mirror lies within reach [m] of a place (3,); none does within
        less than nothing."""
        if reach <= 0:
            return False
        near = self.about(place, reach)
        _, normals, offsets = self.mirrors
        off = normals[near] @ place - offsets[near]
        near, off = near[np.abs(off) < reach], off[np.abs(off) < reach]
        feet = place - off[:, None] * normals[near]
        return bool(self.holds(near, feet, reach).any())

    @property
    def boxes(self) -> np.ndarray:
        """(2, W, 3) lowest and highest corner of each mirror's faces, world coordinates."""
        return self._faces[2]

    def images(
        self,
        target: np.ndarray,
        end: np.ndarray,
        reach: float,
        edge: float,
        among: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the mirrors (K,) that show a UAV (6,) to an `end` (6,) within `reach` [m], its
        images in them (K, 6), positions and velocities in world coordinates, and where the waves
        meet them (K, 3).

        Parameters
        ----------
        edge : how far off its faces a wave may meet a mirror [m]
        among : numbers of the mirrors that are tried; None: all
        """
        _, normals, offsets = self.mirrors
        tried = np.arange(len(normals)) if among is None else among
        n = normals[tried]
        behind, before = n @ target[:3] - offsets[tried], n @ end[:3] - offsets[tried]
        length2 = ((target[:3] - end[:3]) ** 2).sum() + 4 * behind * before  # to the image
        # else the wall stands between the two, or the image is too far
        some = (behind * before > 0) & (length2 < reach**2)
        tried, n, behind, before = tried[some], n[some], behind[some], before[some]
        places = mirror_image(target[:3], n, offsets[tried])
        met = end[:3] + (places - end[:3]) * (before / (before + behind))[:, None]
        low, high = self.boxes[:, tried]
        boxed = ((met >= low - edge) & (met <= high + edge)).all(axis=1)
        shown = np.flatnonzero(boxed)[self.holds(tried[boxed], met[boxed], edge)]
        images = np.hstack([places, mirror_image(target[3:6], n)])
        return tried[shown], images[shown], met[shown]

    def holds(self, mirrors: np.ndarray, points: np.ndarray, edge: float) -> np.ndarray:
        """Return whether points (n, 3) in the planes of mirrors (n,) lie on one of their faces, or
        within `edge` of it."""
        _, first, _ = self._faces
        count = first[mirrors + 1] - first[mirrors]
        which = np.repeat(np.arange(mirrors.size), count)
        begins = np.cumsum(count) - count
        face = np.arange(which.size) + np.repeat(first[mirrors] - begins, count)
        inward, least = self._edges
        inside = np.einsum("nk,nek->ne", points[which], inward[face]) >= least[face] - edge
        out = np.zeros(mirrors.size, bool)
        out[which[inside.all(axis=1)]] = True
        return out

    def blocking(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Faces (n,) that the open segment between two points (3,) crosses."""
        ends = np.array([start, end]) - self.city.origin
        near = np.flatnonzero(beside(self.city, ends, slice(None)))
        faces, share = hits(self.city.corners[near], *ends)
        return near[faces[(share > 0) & (share < 1)]]

    def block(self, polyline: np.ndarray, edge: float) -> bool:
        """Return whether faces cross a segment of a polyline (P, 3), but for its ends, and no way
        leads round them by `edge` [m]: waves bend round what shows a part of their Fresnel zone."""
        lines = np.diff(polyline, axis=0)
        some = lines.any(axis=1)
        starts, lines = polyline[:-1][some], lines[some]
        share = np.clip(edge / np.linalg.norm(lines, axis=1), AT_WALL, 0.5)[:, None]
        legs = np.stack([starts + share * lines, starts + (1 - share) * lines], axis=1)
        return any(self._blocks(leg, edge) for leg in legs)

    def _blocks(self, leg: np.ndarray, edge: float) -> bool:
        start, end = leg - self.city.origin
        box = np.array([np.minimum(start, end) - edge, np.maximum(start, end) + edge])
        corners = self.city.corners[beside(self.city, box, slice(None))]
        faces, share = hits(corners, start, end)
        if not faces.size:
            return False
        middle = start + share.mean() * (end - start)
        across = np.linalg.svd((end - start)[None])[2][1:]
        turns = 2 * np.pi * np.arange(8)[:, None] / 8  # edges have any slope
        round_by = middle + edge * (np.cos(turns) * across[0] + np.sin(turns) * across[1])
        ways = ([start, via, end] for via in round_by)
        return all(any(hits(corners, *part)[0].size for part in pairwise(way)) for way in ways)
