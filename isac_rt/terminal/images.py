"""What a terminal hears of itself over the walls of its mesh: its own mirror images.

A wall that is met at a right angle sends the terminal's chirps straight back, and so does a corner
of two planes, wall and ground above all, whatever the angle. Such an echo stands still in the world
but is a point as a UAV is, and the scatterers of the expected clutter do not hold it. The terminal
knows its pose and the mesh, so that it knows the range of each and its rate. Occlusion by other
buildings is not asked for: an image that is not there only forbids births in a few cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from isac_rt.frame.antennas import Antennas, resolutions
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.types import Detections
from isac_rt.terminal.ghosts import Walls, suspicion
from isac_rt.terminal.tracker import Tracker
from isac_rt.world.swarm import Pose

EDGE = 0.3
"""How far beyond the edge of a face a reflection is still taken for possible [m]: the planes of a
corner need not meet exactly."""
LEAST_RANGE = 1.0
BESIDE_CELLS = 1.5
"""Off an image by no more cells of range and of rate than these, a detection is taken for it."""
WELL_INSIDE = 0.95
"""Share of the view's largest cosines within which a direction is no alias of one outside."""


@dataclass(frozen=True)
class Doubts:
    """What an active terminal does not take for a UAV.

    Attributes
    ----------
    walls : the mesh
    antennas : Antennas
    waveform : Waveform
    """

    walls: Walls
    antennas: Antennas
    waveform: Waveform

    def births(self, detections: Detections, own: Pose) -> Detections:
        """The same detections; none starts a track that may be an image of the terminal or an alias
        from beyond the view."""
        d, w = detections, self.waveform
        inside = np.abs(d.direction) < WELL_INSIDE * self.antennas.view_limit
        starts = d.starts & inside.all(axis=1)
        if starts.any():
            shown = own_images(own, self.walls, float(d.range[starts].max()) + 1)
            off = np.column_stack([d.range, d.velocity])[:, None] - shown
            off[..., 1] -= self._period * np.round(off[..., 1] / self._period)
            allowed = BESIDE_CELLS * np.array([w.range_cell(2), w.velocity_cell(2)])
            starts &= ~(np.abs(off) < allowed).all(axis=-1).any(axis=1)
        return replace(d, starts=starts)

    def remove_ghosts(self, tracker: Tracker, new: set[int], own: Pose) -> None:
        """Take out the tracks, among those `new` to be confirmed, that a wall explains."""
        confirmed = {t.id for t in tracker.tracks if t.confirmed} & new
        if not confirmed:
            return
        tracks, cells = tracker.snapshot(own), resolutions(self.waveform, self.antennas, 2)
        suspect = suspicion(tracks, own, self.walls, cells, self._period).suspect
        out = confirmed & set(tracks.ids[suspect].tolist())
        tracker.tracks = [t for t in tracker.tracks if t.id not in out]

    @property
    def _period(self) -> float:
        return 2 * self.waveform.max_velocity(2)


def own_images(own: Pose, walls: Walls, reach: float) -> np.ndarray:
    """Range [m] and its rate [m/s] of the terminal's own images, one way as its echoes: (K, 2).

    Parameters
    ----------
    own : pose, world coordinates
    reach : farthest range that counts [m]
    """
    near = walls.near(own, reach)
    return np.concatenate([_by_one(own, walls, near, reach), _by_two(own, walls, near, reach)])


def _by_one(own: Pose, walls: Walls, near: np.ndarray, reach: float) -> np.ndarray:
    _, normals, offsets = walls.mirrors
    n, p = normals[near], own.position
    s = n @ p - offsets[near]
    on = walls.holds(near, p - s[:, None] * n, EDGE)
    on &= (np.abs(s) < reach) & (np.abs(s) > LEAST_RANGE)
    return np.column_stack([np.abs(s), np.sign(s) * (n @ own.velocity)])[on]


def _by_two(own: Pose, walls: Walls, near: np.ndarray, reach: float) -> np.ndarray:
    """The echo over plane i, then j, comes from the image p_ij of the terminal's image in i; it
    meets j at B, and i at A."""
    _, normals, offsets = walls.mirrors
    n, d, p, v = normals[near], offsets[near], own.position, own.velocity
    s = n @ p - d
    once = p - 2 * s[:, None] * n
    beyond = once @ n.T - d
    length = np.sqrt(((once[:, None] - 2 * beyond[..., None] * n - p) ** 2).sum(axis=-1))
    both = (length / 2 < reach) & (length / 2 > LEAST_RANGE) & (beyond * s > 0)
    i, j = np.nonzero(both & ~np.eye(near.size, dtype=bool))
    # from the image behind j to the terminal before it
    at_j = once[i] - 2 * beyond[i, j][:, None] * n[j]
    B = at_j + (p - at_j) * (beyond[i, j] / (beyond[i, j] + s[j]))[:, None]
    kept = walls.bounded(near[j], B, EDGE)
    i, j, at_j, B = i[kept], j[kept], at_j[kept], B[kept]
    height = (B * n[i]).sum(axis=1) - d[i]
    A = once[i] + (B - once[i]) * (s[i] / (s[i] + height))[:, None]
    kept = (height * s[i] > -EDGE * np.abs(s[i])) & walls.bounded(near[i], A, EDGE)
    i, j, at_j, A, B = i[kept], j[kept], at_j[kept], A[kept], B[kept]
    kept = walls.holds(near[i], A, EDGE) & walls.holds(near[j], B, EDGE)
    i, j, at_j = i[kept], j[kept], at_j[kept]
    turned = v - 2 * (n[i] @ v)[:, None] * n[i]
    turned -= 2 * (turned * n[j]).sum(axis=1)[:, None] * n[j]
    span = p - at_j
    far = np.linalg.norm(span, axis=1)
    return np.column_stack([far / 2, (span * (v - turned)).sum(axis=1) / (2 * far)])
