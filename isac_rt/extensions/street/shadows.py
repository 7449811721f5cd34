r"""Shadows of boxes that move, constant over pieces of a frame (docs/moving.md: a screen's factor).

A Fresnel unit is that of the distances along the path to the terminals or scatterers before and
after the screen: waves go on over faces that reflect, and begin anew where a UAV or another
scatterer sends them. Within a frame ends, UAVs and points of reflection move on straight lines.
Since the knife edge F has :math:`|F'| = 1/\sqrt2` and :math:`|F(v_1) - F(v_2)| \le 1.4`, an edge
that moves by one Fresnel unit changes the factor by one at most. Pieces, all of one length, are as
short as `STEP` asks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from isac_rt.extensions.street.faces import FIRST_BOX, Box
from isac_rt.extensions.street.motion import pieces
from isac_rt.extensions.street.solid import TINY
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathKind, PathSet, merge
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.segments.diffraction import LIT_REACH, fresnel_unit, knife_edge, tapered
from isac_rt.propagation.segments.reflection import vertical
from isac_rt.world.swarm import Pose

STEP = 0.05
"""Largest error of a shadow's factor at the ends of a piece: -26 dB of the unshadowed path."""
RIPPLE_REACH = 1 / (np.sqrt(2) * np.pi * STEP)
"""Fresnel units from an edge beyond which its ripple is below `STEP`."""
SWEEPS = 20
"""Sweeps for the velocities of chains of reflections: 1e-12 of two, 1e-6 of three in turn."""


class Part(NamedTuple):
    """Straight parts of K paths.

    Attributes
    ----------
    rows : (K,) of the paths
    starts, ends : (K, 3) [m]
    before, total : (K,) length of the path from the last terminal or scatterer to the part, and
        from there to the next [m]
    """

    rows: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    before: np.ndarray
    total: np.ndarray


class Stops(NamedTuple):
    """Ends of the straight parts of K paths at the epoch, some of which have no length.

    Attributes
    ----------
    places, velocities : (K, B + 2, 3) [m, m/s]
    passed : (K, B + 2) whether a wave goes on there and does not begin anew
    """

    places: np.ndarray
    velocities: np.ndarray
    passed: np.ndarray


@dataclass(frozen=True)
class Shadows:
    """Shadows of the boxes of a frame on the paths of one link.

    Attributes
    ----------
    boxes : at the middle of the frame
    state : of the link
    poses : of all UAVs
    wavelength : [m]
    half_frame : [s]
    """

    boxes: Sequence[Box]
    state: LinkState
    poses: dict[str, Pose]
    wavelength: float
    half_frame: float

    def factor(self, paths: PathSet, time: float | np.ndarray = 0.0) -> np.ndarray:
        """Return the factor (K,) of all boxes, at one time or at that of each path [s since the
        epoch]."""
        time, out = np.broadcast_to(time, len(paths)), np.ones(len(paths), complex)
        stops = self.stops(paths)
        for box in self.boxes:
            for part in self._parts(paths, stops, time, box):
                rows, first, last = screen(box, time, part, self.wavelength)
                screened = (knife_edge(first) - knife_edge(last)).prod(axis=1)
                out[rows] *= tapered(1 - screened, np.maximum(first, -last).max(axis=1))
        return out

    def change(self, paths: PathSet, time: np.ndarray) -> np.ndarray:
        """Return the factor of each path (K,) at its time [s since the epoch] over that at the
        epoch."""
        now = self.factor(paths)
        return self.factor(paths, time) / np.where(now == 0, 1, now)

    def counts(self, paths: PathSet) -> np.ndarray:
        """Return into how many pieces (K,) the frame is to be cut for each path."""
        stops, moved = self.stops(paths), np.zeros(len(paths))
        times = np.multiply.outer((-self.half_frame, 0.0, self.half_frame), np.ones(len(paths)))
        fastest = np.linalg.norm(stops.velocities, axis=2).max(initial=0.0)
        for box in self.boxes:
            reach = (fastest + float(np.linalg.norm(box.pose.velocity))) * self.half_frame
            heights = np.full((3, stops.places.shape[1] - 1, len(paths), 4), np.nan)
            for i, time in enumerate(times):
                for k, part in enumerate(self._parts(paths, stops, time, box)):
                    rows, first, last = screen(box, time, part, self.wavelength, reach)
                    heights[i, k, rows] = np.concatenate([first, last], axis=1)
            least, most = (pick(heights[:-1], heights[1:]) for pick in (np.minimum, np.maximum))
            beyond = (least[..., :2] > LIT_REACH) | (most[..., 2:] < -LIT_REACH)
            ripples = (
                (least < RIPPLE_REACH)
                & (most > -RIPPLE_REACH)
                & ~beyond.any(axis=-1, keepdims=True)
            )
            moved += np.where(ripples, most - least, 0.0).sum(axis=(0, 1, 3))
        return np.maximum(np.ceil(moved / (2 * STEP)), 1).astype(int)

    def _parts(self, paths: PathSet, stops: Stops, time: np.ndarray, box: Box) -> Iterator[Part]:
        """Yield the straight parts that a box may shadow at the time (K,) of each path [s since the
        epoch], the first of all paths first."""
        placed, passed = placed_paths(paths), stops.passed
        of_box = (paths.target == box.number) | (paths.faces == FIRST_BOX - box.number).any(axis=1)
        places = stops.places + stops.velocities * time[:, None, None]
        lengths = np.linalg.norm(np.diff(places, axis=1), axis=2)
        before, after = np.zeros_like(lengths), np.zeros_like(lengths)
        for k in range(1, lengths.shape[1]):
            before[:, k] = np.where(passed[:, k], before[:, k - 1] + lengths[:, k - 1], 0.0)
            after[:, -k - 1] = np.where(passed[:, -k - 1], after[:, -k] + lengths[:, -k], 0.0)
        total = before + lengths + after
        for k in range(lengths.shape[1]):
            rows = np.flatnonzero(placed & ~of_box & (lengths[:, k] > 0))
            yield Part(rows, places[rows, k], places[rows, k + 1], before[rows, k], total[rows, k])

    def stops(self, paths: PathSet) -> Stops:
        """Return the ends of the paths' straight parts; a point that is missing has none, at the
        stop after it."""
        count, (start, end) = len(paths), (self.state.start, self.state.end)
        ends = [np.broadcast_to(e.motion()[:2, None, None], (2, count, 1, 3)) for e in (start, end)]
        chain = np.concatenate([ends[0][0], paths.points, ends[1][0]], axis=1)
        velocity = np.concatenate([ends[0][1], np.zeros(paths.points.shape), ends[1][1]], axis=1)
        faces = np.pad(paths.faces, ((0, 0), (1, 1)), constant_values=-1)
        for box in self.boxes:
            velocity[faces == FIRST_BOX - box.number] = box.pose.velocity
        for index in np.unique(paths.target[paths.target >= 0]):
            uav = self.poses[paths.target_names[index]]
            at_uav = (paths.target == index)[:, None] & (faces == -1)
            at_uav &= (np.abs(chain - uav.position) < 1e-6).all(axis=2)  # not a terminal
            velocity[at_uav] = uav.velocity
        for k in range(chain.shape[1] - 2, 0, -1):
            missing = ~np.isfinite(chain[:, k])
            velocity[:, k] = np.where(missing, velocity[:, k + 1], velocity[:, k])
            chain[:, k] = np.where(missing, chain[:, k + 1], chain[:, k])
        mirrors, missing = _mirrors(paths), ~np.isfinite(paths.points).all(axis=2)
        return Stops(chain, _with_reflections(chain, velocity, mirrors), mirrors | _inner(missing))

    def in_pieces(
        self, paths: PathSet, waveform: Waveform, later: float, least_power: float
    ) -> PathSet:
        """Return paths cut where their shadows change, in a frame whose middle is `later` than the
        epoch [s]: those over `least_power`, or in a shadow at the epoch by less than 1/`STEP` of
        their amplitude."""
        placed = placed_paths(paths) & (paths.power > least_power * STEP**2)
        counts = np.ones(len(paths), int)
        counts[placed] = self.counts(paths.select(placed))
        changing = np.flatnonzero(counts > 1)
        cuts = [pieces(waveform, max(waveform.num_chirps // n, 1), later) for n in counts[changing]]
        if not cuts:
            return paths
        row = np.repeat(changing, [time.size for _, time in cuts])
        path, time = paths.select(row), np.concatenate([time for _, time in cuts])
        begin = np.maximum(path.begin, np.concatenate([edges[:-1] for edges, _ in cuts]))
        end = np.minimum(path.end, np.concatenate([edges[1:] for edges, _ in cuts]))
        cut = replace(path, gain=path.gain * self.change(path, time), begin=begin, end=end)
        return merge([paths.select(counts == 1), cut.select(begin < end)])


def placed_paths(paths: PathSet) -> np.ndarray:
    """Mark the paths (K,) whose way is known: not statistical clutter, leakage or moving parts."""
    with_points = np.isfinite(paths.points).any(axis=(1, 2))
    return np.asarray(with_points | (paths.kind == PathKind.LINE_OF_SIGHT))


def _mirrors(paths: PathSet) -> np.ndarray:
    """Mark the stops (K, B + 2) of paths at which a face reflects them."""
    return _inner((paths.faces != -1) & (paths.kind != PathKind.DIFFUSE)[:, None])


def _inner(points: np.ndarray) -> np.ndarray:
    """Return a mask of points (K, B) as one of stops (K, B + 2), without the ends."""
    return np.pad(points, ((0, 0), (1, 1)), constant_values=False)


def _with_reflections(chain: np.ndarray, velocity: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Return velocities (K, B + 2, 3) with those of points of reflection (K, B + 2), where the
    velocity given is that of the surface.

    An end that moves along its ray leaves the point alone; the rest of its motion lies in the
    surface and moves the point by the share of the other ray's length.
    """
    out = velocity.copy()
    for k in np.tile(np.arange(1, chain.shape[1] - 1), SWEEPS):
        rows = np.flatnonzero(mirror[:, k])
        if not rows.size:
            continue
        rays = chain[rows, k] - chain[rows, k - 1], chain[rows, k + 1] - chain[rows, k]
        lengths = [np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), TINY) for ray in rays]
        into, on = (ray / length for ray, length in zip(rays, lengths, strict=True))
        normal, surface = on - into, velocity[rows, k]
        moved = np.zeros((len(rows), 3))
        for side, ray, other in ((k - 1, into, lengths[1]), (k + 1, on, lengths[0])):
            along = (ray * normal).sum(axis=1, keepdims=True)
            relative = out[rows, side] - surface
            off = (relative * normal).sum(axis=1, keepdims=True)
            moved += (relative - ray * off / np.where(along == 0, np.inf, along)) * other
        out[rows, k] = surface + moved / (lengths[0] + lengths[1])
    return out


def screen(
    box: Box, time: np.ndarray, part: Part, wavelength: float, reach: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows of paths whose part passes a box (N,), and the heights of its edges, the
    lower and the upper (N, 2) each in Fresnel units, level and across.

    Parameters
    ----------
    time : (K,) of each path [s since the epoch]
    reach : how much farther than its shadow reaches a box counts [m]
    """
    rows, starts, ends, before, total = part
    centre, length = box.middle(time[rows]), np.linalg.norm(ends - starts, axis=1)
    along, to = (ends - starts) / length[:, None], centre - starts
    at = np.clip((to * along).sum(1), 0, length)
    off = np.linalg.norm(to - at[:, None] * along, axis=1)
    largest_unit = np.sqrt(wavelength * total / 8)
    near = np.flatnonzero(off < box.solid.reach + LIT_REACH * largest_unit + reach)
    axes = box.attitude.axes_at(time[rows[near]])
    corners = centre[near, None] + box.solid.corners @ axes.swapaxes(1, 2)
    up = vertical(along[near])
    basis = np.stack([np.cross(along[near], up), along[near], up], axis=2)  # level, along, across
    a, b = ((corners - starts[near, None]) @ basis)[:, box.solid.edges.T].swapaxes(0, 1)
    low, high = extent_between(a, b, length[near])
    between = np.isfinite(low[:, 1])
    near, low, high = near[between], low[between], high[between]
    middle = before[near] + (low[:, 1] + high[:, 1]) / 2
    unit = fresnel_unit(wavelength, middle, total[near] - middle)
    unit = np.maximum(unit, TINY)[:, None]
    return rows[near], low[:, ::2] / unit, high[:, ::2] / unit


def extent_between(
    a: np.ndarray, b: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and greatest coordinates (K, 3) of solids, by both ends (K, E, 3) of their
    edges, where the second coordinate is from 0 to `length` (K,); not finite where it never is."""
    rise = (b - a)[..., 1]
    rise = np.where(rise == 0, TINY, rise)
    with np.errstate(over="ignore"):  # to infinity, with the right sign
        shares = -a[..., 1] / rise, (length[:, None] - a[..., 1]) / rise
    first, last = np.minimum(*shares), np.maximum(*shares)
    within = np.tile((first <= 1) & (last >= 0), (1, 2))[..., None]
    cuts = [np.clip(share, 0, 1)[..., None] for share in (first, last)]
    ends = np.concatenate([a + cut * (b - a) for cut in cuts], axis=1)
    low, high = np.where(within, ends, np.inf), np.where(within, ends, -np.inf)
    return low.min(axis=1), high.max(axis=1)
