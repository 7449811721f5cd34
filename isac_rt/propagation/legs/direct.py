"""Straight legs between bodies, bent round the shadow edge that matters: no leg is switched when it
meets the city's edges.

On the lit side a leg stays straight and its amplitude ripples; in the shadow it runs by way of the
edge, with that detour's length, rate and directions. Both are F(nu) of the knife edge under Friis's
amplitude, and the same at the edge.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.propagation.legs.bodies import Bodies
from isac_rt.propagation.legs.diffraction import edge_factor
from isac_rt.propagation.legs.edges import ShadowEdges
from isac_rt.propagation.legs.geometry import Legs, straight
from isac_rt.propagation.legs.legset import LegSet, leg_set
from isac_rt.world.swarm import Pose

Direct = tuple[np.ndarray, Legs]


def past_edges_and_bodies(
    legs: dict[Link, LegSet],
    poses: dict[str, Pose],
    edges: ShadowEdges,
    bodies: Bodies,
    wavelength: float,
) -> dict[Link, LegSet]:
    """Traced legs of all pairs with straight ones that bend (in place of those that are there or
    not), past the swarm's bodies."""
    direct, out = direct_legs(poses, list(legs), edges, bodies, wavelength), {}
    for pair, found in legs.items():
        depth = found.faces.shape[1]
        empty = np.zeros((1, 0), np.int64)
        parts = [(*direct[pair], empty, empty)] if pair in direct else []
        for count in range(1, depth + 1):
            which = np.flatnonzero(found.bounces == count)
            legs_here = found.legs.select(which)
            ends = [np.broadcast_to(poses[name].position, (which.size, 1, 3)) for name in pair]
            chain = np.concatenate([ends[0], legs_here.points[:, :count], ends[1]], axis=1)
            amplitude = found.amplitude[which] * bodies.factor(chain, wavelength, pair)
            parts.append(
                (amplitude, legs_here, found.faces[which, :count], found.planes[which, :count])
            )
        out[pair] = leg_set(parts, depth)
    return out


def direct_legs(
    poses: dict[str, Pose],
    pairs: list[Link],
    edges: ShadowEdges,
    bodies: Bodies,
    wavelength: float,
) -> dict[Link, Direct]:
    """Amplitude (0 or 1,) and leg of every pair of bodies at different places.

    `points` (.., 1, 3) of a leg holds the edge round which it bends, else NaN.
    """
    apart = [
        pair
        for pair in pairs
        if np.linalg.norm(poses[pair[1]].position - poses[pair[0]].position) > 1e-9
    ]
    starts, ends = (
        np.array([poses[pair[k]].position for pair in apart]).reshape(-1, 3) for k in (0, 1)
    )
    bends = edges.bends(starts, ends)
    factors = edge_factor(bends.nu)
    out = {}
    for pair, nu, point, factor in zip(apart, bends.nu, bends.points, factors, strict=True):
        if factor == 0:
            continue
        start, end = poses[pair[0]], poses[pair[1]]
        direct = straight(start, end.position[None], end.velocity, end.acceleration)
        if nu > 0:
            leg = _bent(start, end, point)
            chain = np.stack([start.position, point, end.position])[None]
            factor = factor * np.exp(
                2j * np.pi * (leg.length - direct.length) / wavelength
            )  # the detour's phase is in its delay
        else:
            leg = replace(direct, points=np.full((1, 1, 3), np.nan))
            chain = np.stack([start.position, end.position])[None]
        friis = wavelength / (4 * np.pi * direct.length)
        out[pair] = friis * factor * bodies.factor(chain, wavelength, pair), leg
    return out


def _bent(start: Pose, end: Pose, point: np.ndarray) -> Legs:
    """The leg by way of a point at rest. Where the detour is the shortest over an edge, its rate is
    that of the detour as it moves too."""
    there, on = straight(start, point[None]), straight(end, point[None])
    points = point[None, None]
    return Legs(
        there.length + on.length,
        there.rate + on.rate,
        there.accel + on.accel,
        there.departure,
        on.departure,
        points,
    )
