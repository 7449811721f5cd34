"""Shadow edges of a city near straight paths: which edge of the mesh bends a wave round an
obstacle, or brushes it in passing.

Of all edges the one with the shortest detour counts, alone: where two edges shade one path at once
(a broad roof, two houses in a row) the result is that of the one whose detour is free, and nothing
where no single detour is. That is a path in full shadow behind several edges, where a double edge
would add what is 20 dB and more further down.

Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isac_rt.propagation.segments.diffraction import LIT_REACH, SHADOW_REACH
from isac_rt.propagation.segments.rays import LosTest
from isac_rt.world.city.mesh import CityMesh

BESIDE = 0.01
"""How far beside an edge rays are sent that find out which side of it is free [m]; float32 rays are
good to a hundredth of that."""
EDGES_PER_BLOCK, STRIP = 32, 30.0
"""Edges of a block, which are passed over at once, and width of the strips in which edges are
gathered [m]."""
MOST_TRIED = 24
"""Edges near a path, the shortest detours first, that are tried."""
FLAT = 1e-3
"""Sine of the angle between two faces under which the edge between them is none."""


class Edges(NamedTuple):
    """E edges of a mesh at which its surface ends or turns.

    Attributes
    ----------
    start, span : (E, 3) first end, and from it to the other [m]
    wings : (E, 2, 3) third corners of the two faces; the same twice where a surface ends
    middle : (E, 3) [m]
    half : (E,) half the length [m]
    block, centre, radius : (C, EDGES_PER_BLOCK) neighbouring edges, padded with -1, and the
        balls (C, 3), (C,) that hold them [m]
    """

    start: np.ndarray
    span: np.ndarray
    wings: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    block: np.ndarray
    centre: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, city: CityMesh) -> Edges:
        """All edges of a city, flat ones left out; one between more than two faces stands there for
        each pair of neighbours in the list."""
        faces = city.faces.astype(np.int64)
        ends = np.sort(
            np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1
        )
        third, face = (
            np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]]),
            np.tile(np.arange(len(faces)), 3),
        )
        order = np.lexsort([face, ends[:, 1], ends[:, 0]])
        ends, third, face = ends[order], third[order], face[order]
        same = (ends[1:] == ends[:-1]).all(axis=1)
        alone = ~(np.append(same, False) | np.append(False, same))[: len(ends)]
        sine = np.linalg.norm(np.cross(city.normals[face[:-1]], city.normals[face[1:]]), axis=1)
        pair = np.flatnonzero(same & (sine > FLAT))
        single = np.flatnonzero(alone)
        first, second = np.append(pair, single), np.append(pair + 1, single)
        start = city.vertices[ends[first, 0]]
        wings = city.vertices[np.stack([third[first], third[second]], axis=1)]
        span = city.vertices[ends[first, 1]] - start
        middle, half = start + span / 2, np.linalg.norm(span, axis=1) / 2
        count = -(-len(half) // EDGES_PER_BLOCK)
        block = np.full((count, EDGES_PER_BLOCK), -1)
        block.flat[: len(half)] = np.lexsort([middle[:, 1], middle[:, 0] // STRIP])
        centre = middle[block[:, 0]]
        extent = np.linalg.norm(middle[block] - centre[:, None], axis=2) + half[block]
        radius = np.where(block < 0, 0.0, extent).max(axis=1, initial=0.0)
        return cls(start, span, wings, middle, half, block, centre, radius)


@dataclass(frozen=True)
class Diffractions:
    """The edge that matters to each of K straight paths.

    Attributes
    ----------
    nu : (K,) Fresnel-Kirchhoff parameter, > 0 in the shadow: 2 sqrt(detour/wavelength); -inf free
        of edges, inf beyond all
    points : (K, 3) where the detour meets the edge; NaN without one
    """

    nu: np.ndarray
    points: np.ndarray


class ShadowEdges:
    """Finds the edges of one city that shade or brush straight paths."""

    def __init__(self, city: CityMesh, los: LosTest, wavelength: float) -> None:
        self._edges, self._los, self._wavelength = Edges.of(city), los, wavelength

    def diffractions(self, starts: np.ndarray, ends: np.ndarray) -> Diffractions:
        """For paths (K, 3) to (K, 3), neither end nearer to a surface than `BESIDE`. Local
        coordinates."""
        count = len(starts)
        nu, points = np.full(count, -np.inf), np.full((count, 3), np.nan)
        if not count or not len(self._edges.start):
            return Diffractions(nu, points)
        lit = self._los.clear(starts, ends)
        nu[~lit] = np.inf
        reach = np.where(lit, LIT_REACH, SHADOW_REACH) ** 2 / 4 * self._wavelength
        path, detour, at, out = near(self._edges, starts, ends, reach)
        if not path.size:
            return Diffractions(nu, points)
        ahead = (ends - starts)[path]
        ahead *= BESIDE / np.linalg.norm(ahead, axis=1, keepdims=True)
        free, behind = at + BESIDE * out, at - BESIDE * out
        from_here, to_there = starts[path], ends[path]
        tests = self._los.clear(
            np.concatenate([from_here, free, from_here, behind - ahead]),
            np.concatenate([free, to_there, behind + ahead, to_there]),
        ).reshape(4, -1)
        true = np.flatnonzero(tests[0] & tests[1] & ~(tests[2] & tests[3]))
        which, first = np.unique(
            path[true], return_index=True
        )  # the shortest detour of each path comes first
        size = 2 * np.sqrt(np.maximum(detour[true[first]], 0.0) / self._wavelength)
        nu[which] = np.where(lit[which], -size, size)
        points[which] = at[true[first]]
        return Diffractions(nu, points)


def near(
    edges: Edges, sources: np.ndarray, sinks: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the silhouette edges near straight paths (K, 3) to (K, 3), at most `MOST_TRIED` each.

    The shortest way over an edge makes equal angles with it on both sides (Fermat): its point
    divides the edge between the feet of both ends as their distances from the edge.

    Returns
    -------
    path : (N,) number of the path
    detour : (N,) at most the `reach` (K,) of the path, shortest first [m]
    point : (N, 3) of the shortest way, on the edge
    out : (N, 3) unit vectors across the path and the edge, away from what the edge bounds
    """
    length = np.linalg.norm(sinks - sources, axis=1)
    # half the width of the ellipsoid of all points within reach, and its ends
    aside = np.sqrt(reach * (reach + 2 * length)) / 2 + reach
    blocks = [
        np.flatnonzero(_off(edges.centre, *ends) <= edges.radius + far)
        for *ends, far in zip(sources, sinks, aside, strict=True)
    ]
    path = np.repeat(np.arange(len(sources)), [edges.block[block].size for block in blocks])
    edge = edges.block[np.concatenate(blocks)].ravel()
    ball = edges.half[edge] + aside[path]
    inside = (edge >= 0) & (_off(edges.middle[edge], sources[path], sinks[path]) <= ball)
    order = np.lexsort([edge[inside], path[inside]])
    path, edge = path[inside][order], edge[inside][order]
    start, size = edges.start[edge], 2 * edges.half[edge]
    unit, both = edges.span[edge] / size[:, None], (sources[path], sinks[path])
    foot = [_dot(end - start, unit) for end in both]
    across = [end - start - at[:, None] * unit for end, at in zip(both, foot, strict=True)]
    off = [np.sqrt(_dot(line, line)) for line in across]
    off_sum = off[0] + off[1]
    at = (foot[0] * off[1] + foot[1] * off[0]) / np.maximum(off_sum, 1e-9)
    point = start + np.clip(at, 0, size)[:, None] * unit
    detour = sum(np.linalg.norm(point - end, axis=1) for end in both) - length[path]
    normal = np.cross(unit, both[1] - both[0]) / length[path, None]
    sine = np.linalg.norm(normal, axis=1)
    # a silhouette: both faces lie on one side of the plane of the path and the edge
    side = ((edges.wings[edge] - start[:, None]) * normal[:, None]).sum(axis=2)
    true = (off_sum >= 1e-9) & (detour <= reach[path]) & (sine >= 1e-6) & (side.prod(axis=1) > 0)
    which = np.flatnonzero(true)
    which = which[np.lexsort([detour[which], path[which]])]
    rank = np.arange(which.size) - np.searchsorted(path[which], path[which])
    which = which[rank < MOST_TRIED]
    out = normal[which] / np.where(side[which, :1] < 0, 1, -1) / sine[which, None]
    return path[which], detour[which], point[which], out


def _off(points: np.ndarray, source: np.ndarray, sink: np.ndarray) -> np.ndarray:
    """Return the distances of points (N, 3) from the straight segments between places, (3,)
    or (N, 3)."""
    to, span = points - source, sink - source
    share = _dot(to, span) / _dot(span, span)
    off = to - np.clip(share, 0, 1)[:, None] * span
    return np.asarray(np.sqrt(_dot(off, off)))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the inner products of vectors (N, 3), or (3,), faster than by the sum of products."""
    return np.asarray(np.einsum("...i,...i", a, b))
