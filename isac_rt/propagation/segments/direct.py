"""Straight segments between UAVs, bent round the shadow edge that matters: no segment is switched
when it meets the city's edges.

On the lit side a segment stays straight and its amplitude ripples; in the shadow it runs by way of
the edge, with that detour's length, rate and directions. Both are F(nu) of the knife edge under
Friis's amplitude, and the same at the edge.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.propagation.segments.diffraction import edge_factor
from isac_rt.propagation.segments.discs import UavDiscs
from isac_rt.propagation.segments.edges import ShadowEdges
from isac_rt.propagation.segments.geometry import Segments, straight
from isac_rt.propagation.segments.segment_set import SegmentSet, segment_set
from isac_rt.world.swarm import Pose

Direct = tuple[np.ndarray, Segments]


def past_edges_and_discs(
    segments: dict[Link, SegmentSet],
    poses: dict[str, Pose],
    edges: ShadowEdges,
    discs: UavDiscs,
    wavelength: float,
) -> dict[Link, SegmentSet]:
    """Traced segments of all pairs with straight ones that bend (in place of those that are there
    or not), past the swarm's UAVs."""
    direct, out = direct_segments(poses, list(segments), edges, discs, wavelength), {}
    empty = np.zeros((1, 0), np.int64)
    factors = _past_discs(segments, poses, discs, wavelength)
    for (pair, found), factor in zip(segments.items(), factors, strict=True):
        rest = np.flatnonzero(found.bounces)
        mirrored = found.select(rest)
        amplitude = mirrored.amplitude * factor[rest]
        parts = [(*direct[pair], empty, empty)] if pair in direct else []
        parts.append((amplitude, mirrored.segments, mirrored.faces, mirrored.planes))
        out[pair] = segment_set(parts, found.faces.shape[1])
    return out


def _past_discs(
    segments: dict[Link, SegmentSet], poses: dict[str, Pose], discs: UavDiscs, wavelength: float
) -> list[np.ndarray]:
    """Factors of the UAVs for the mirrored segments of each pair."""
    sizes = [len(found.amplitude) for found in segments.values()]
    owner, factor = np.repeat(np.arange(len(sizes)), sizes), np.ones(sum(sizes), complex)
    bounces = np.concatenate([found.bounces for found in segments.values()])
    points = np.concatenate([found.segments.points for found in segments.values()])
    starts, ends = (
        np.array([poses[pair[side]].position for pair in segments])[owner] for side in (0, 1)
    )
    spared = discs.spared(list(segments))[owner]
    for count in range(1, points.shape[1] + 1):
        which = np.flatnonzero(bounces == count)
        stops = starts[which, None], points[which, :count], ends[which, None]
        factor[which] = discs.factor(np.concatenate(stops, axis=1), wavelength, spared[which])
    return np.split(factor, np.cumsum(sizes)[:-1])


def direct_segments(
    poses: dict[str, Pose],
    pairs: list[Link],
    edges: ShadowEdges,
    discs: UavDiscs,
    wavelength: float,
) -> dict[Link, Direct]:
    """Amplitude (0 or 1,) and segment of every pair of UAVs at different places.

    `points` (.., 1, 3) of a segment holds the edge round which it bends, else NaN.
    """
    separated = [
        pair
        for pair in pairs
        if np.linalg.norm(poses[pair[1]].position - poses[pair[0]].position) > 1e-9
    ]
    starts, ends = (
        np.array([poses[pair[k]].position for pair in separated]).reshape(-1, 3) for k in (0, 1)
    )
    diffractions = edges.diffractions(starts, ends)
    factors = edge_factor(diffractions.nu)
    spared, there = discs.spared(separated), factors != 0
    straight_on, round_edge = there & (diffractions.nu <= 0), there & (diffractions.nu > 0)
    for which, *between in ((straight_on,), (round_edge, diffractions.points)):
        stops = np.stack([stop[which] for stop in (starts, *between, ends)], axis=1)
        factors[which] *= discs.factor(stops, wavelength, spared[which])
    out = {}
    for k in np.flatnonzero(there):
        start, end = (poses[name] for name in separated[k])
        direct = straight(start, end.position[None], end.velocity, end.acceleration)
        segment, factor = replace(direct, points=np.full((1, 1, 3), np.nan)), factors[k]
        if round_edge[k]:
            segment = _diffracted(start, end, diffractions.points[k])
            # the detour's phase is in its delay
            factor = factor * np.exp(2j * np.pi * (segment.length - direct.length) / wavelength)
        friis = wavelength / (4 * np.pi * direct.length)
        out[separated[k]] = friis * factor, segment
    return out


def _diffracted(start: Pose, end: Pose, point: np.ndarray) -> Segments:
    """The segment by way of a point at rest. Where the detour is the shortest over an edge, its
    rate is that of the detour as it moves too."""
    there, on = straight(start, point[None]), straight(end, point[None])
    points = point[None, None]
    return Segments(
        there.length + on.length,
        there.rate + on.rate,
        there.accel + on.accel,
        there.departure,
        on.departure,
        points,
    )
