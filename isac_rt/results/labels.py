"""Labels of detections: the path that caused each."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.receive.cfar import hann_envelope
from isac_rt.receive.maps import UNION_FLOOR
from isac_rt.receive.types import Detections

EXPLAINS = 0.25
"""Least power over the noise of one channel's cell that explains a detection. Averaged over the 45
channels of the default arrays, 0.25 passes the threshold in one of a thousand cells; less is hardly
more than noise."""


class Explanation(NamedTuple):
    """Causes of Q detections; -1 where nothing stands out of the noise (a false alarm).

    kind : (Q,) int8 `PathKind`
    target : (Q,) int16 index into the set's target names, -1 also where no UAV is involved
    order : (Q,) int16 interactions with the city, 0 of a direct path
    face : (Q,) int32 face of the city's mesh that the path meets first, -1 also where it meets none
    sidelobe : (Q,) bool, the path lies more than a cell away: the detection is one of its sidelobes
    """

    kind: np.ndarray
    target: np.ndarray
    order: np.ndarray
    face: np.ndarray
    sidelobe: np.ndarray


def owners(kind: np.ndarray, target: np.ndarray, paths: PathSet, names: list[str]) -> np.ndarray:
    """(Q,) index into `names` of the UAV whose own path each label names, -1 where it is none's:
    its straight echo, or the line of sight of the link's transmitter.

    Parameters
    ----------
    kind, target : (Q,) of `paths` themselves or of what they explain
    """
    index = np.array([names.index(name) for name in paths.target_names] + [-1])
    out, echoes = np.full(len(kind), -1), kind == PathKind.TARGET  # of many paths a few
    out[echoes] = index[target[echoes]]
    if paths.tx != paths.rx:
        out[kind == PathKind.LINE_OF_SIGHT] = names.index(paths.tx)
    return out


def hann_response(distance: np.ndarray) -> np.ndarray:
    """Power of a Hann-windowed tone at distances from it in cells, relative to its peak."""
    d = np.asarray(distance, float)
    edge = np.abs(d) == 1
    return np.where(edge, 0.25, (np.sinc(d) / np.where(edge, 1.0, 1 - d * d)) ** 2)


def reach(distance: np.ndarray) -> np.ndarray:
    """Share of a path's power that is counted at distances in cells: all within one cell, then what
    the Hann window passes at most."""
    d = np.asarray(distance, float)
    lobes = hann_envelope(np.maximum(d, 2.0))
    return np.where(d <= 1, 1.0, np.where(d < 2, np.maximum(hann_response(d), lobes), lobes))


class MapPositions(NamedTuple):
    """Paths or estimates in the terms of `Detections`.

    Attributes
    ----------
    range, velocity : (K,) [m], [m/s]
    cells : of both [m], [m/s]
    span : of unambiguous velocities [m/s]
    """

    range: np.ndarray
    velocity: np.ndarray
    cells: tuple[float, float]
    span: float

    @classmethod
    def of(cls, paths: PathSet, waveform: Waveform, passes: int) -> MapPositions:
        """Where a receiver sees paths."""
        metres = SPEED_OF_LIGHT / passes
        return cls.at(metres * paths.delay, metres * paths.delay_rate, waveform, passes)

    @classmethod
    def at(
        cls, range: np.ndarray, velocity: np.ndarray, waveform: Waveform, passes: int
    ) -> MapPositions:
        """Where detections or tracks lie."""
        cells = waveform.range_cell(passes), waveform.velocity_cell(passes)
        return cls(range, velocity, cells, 2 * waveform.max_velocity(passes))

    def distances(
        self, range: float | np.ndarray, velocity: float | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances from a place in range and Doppler cells, velocities modulo the unambiguous
        span; from places (Q, 1) as (Q, K)."""
        off = velocity - self.velocity
        off -= self.span * np.round(off / self.span)
        return np.abs(range - self.range) / self.cells[0], np.abs(off) / self.cells[1]


class Aim(NamedTuple):
    """Where paths come from, for a receiver.

    Attributes
    ----------
    direction : (K, 2) u_x, u_z of each path's arrival in body axes
    beam : (2,) width of the array's beam in both, infinite where it sees no direction
    """

    direction: np.ndarray
    beam: np.ndarray


def explain(
    detections: Detections,
    paths: PathSet,
    waveform: Waveform,
    passes: int,
    cell_gain: float,
    aim: Aim | None = None,
) -> Explanation:
    """Return the path that caused each detection: the one with the most power at its place.

    A path counts with all its power within one cell in range and in Doppler, and beyond with what
    its Hann-windowed sidelobes hold at most. The diffuse paths within a cell count together, as the
    clutter that they are; the strongest of them gives order and face. What lies under `EXPLAINS`
    of the noise explains nothing. Paths of one cell reach a detection together, and the strongest
    decides; but a receiver that looks by beam, or takes strong paths out first, finds a weak one
    beside it. So a path of the cell that comes from where the detection says is the cause before
    a stronger one from elsewhere, and before the sidelobes of one whose direction fits worse.

    Parameters
    ----------
    cell_gain : power over the noise of one channel's cell, of a path of unit power
    aim : of `paths`; None: their directions do not count
    """
    positions, power = MapPositions.of(paths, waveform, passes), paths.power * cell_gain
    diffuse = paths.kind == PathKind.DIFFUSE
    if aim is None:
        aim = Aim(np.full((len(paths), 2), np.nan), np.ones(2))
    cause, near = np.full(len(detections), -1), np.zeros(len(detections), bool)
    for q, candidates in enumerate(_candidates(detections, positions, aim, power, diffuse)):
        best = candidates.cause()
        if best >= 0:
            cause[q], near[q] = candidates.path[best], candidates.near[best]
    explained = np.flatnonzero(cause >= 0)
    rows, count = cause[explained], len(detections)
    kinds, targets, orders, faces = (
        np.full(count, -1, dtype) for dtype in (np.int8, np.int16, np.int16, np.int32)
    )
    kinds[explained], targets[explained], orders[explained] = (
        column[rows] for column in (paths.kind, paths.target, paths.bounces)
    )
    met = np.append(paths.faces[rows], np.full((len(rows), 1), -1), axis=1)
    faces[explained] = met[np.arange(len(rows)), (met >= 0).argmax(axis=1)]
    return Explanation(kinds, targets, orders, faces, (cause >= 0) & ~near)


class _Candidates(NamedTuple):
    """Paths that may have caused one detection, in C rows.

    Attributes
    ----------
    path : (C,) row of the path
    near : (C,) bool, within one cell of the detection
    power : (C,) of a single path at the detection's place, over the noise; 0 of diffuse ones
    clutter : (C,) of a diffuse path, 0 of the others
    off : (C,) distance in direction in beams, NaN where it is not known
    """

    path: np.ndarray
    near: np.ndarray
    power: np.ndarray
    clutter: np.ndarray
    off: np.ndarray

    def strongest(self, able: np.ndarray) -> int:
        """Row of the candidate of most power among those that are `able`, -1 if none explains
        anything; all their clutter counts as the strongest of it."""
        power, clutter = np.where(able, self.power, 0.0), np.where(able, self.clutter, 0.0)
        if clutter.any():
            power[clutter.argmax()] = clutter.sum()
        best = int(power.argmax()) if power.size else -1
        return best if best >= 0 and power[best] >= EXPLAINS else -1

    def cause(self) -> int:
        """Row of the candidate that caused the detection, -1 for none."""
        aimed = self.off <= 1
        best = self.strongest(aimed)
        if best >= 0 and not self.near[best]:
            best = self.strongest(aimed & self.near & (self.off < self.off[best]))
        if best < 0:
            best = self.strongest(np.ones(len(self.path), bool))
        return best


def _candidates(
    detections: Detections, at: MapPositions, aim: Aim, power: np.ndarray, diffuse: np.ndarray
) -> list[_Candidates]:
    """List for each detection the paths that may have caused it; of the diffuse ones those within
    a cell."""
    close = np.abs(detections.range[:, None] - at.range) <= at.cells[0] * (1 + 1e-9)
    q, path = np.nonzero(~diffuse | close)
    some = at._replace(range=at.range[path], velocity=at.velocity[path])
    row, column = some.distances(detections.range[q], detections.velocity[q])
    near, field = (row <= 1) & (column <= 1), diffuse[path]
    share = reach(row) * np.minimum(reach(column) + UNION_FLOOR, 1.0)
    off = np.abs(aim.direction[path] - detections.direction[q]) / aim.beam
    every = (
        path,
        near,
        np.where(field, 0.0, power[path] * share),
        np.where(field & near, power[path], 0.0),
        np.max(off, axis=1),
    )
    ends = np.searchsorted(q, np.arange(len(detections) + 1))
    return [_Candidates(*(a[i:j] for a in every)) for i, j in pairwise(ends)]
