"""Which path caused a detection."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.jit import jit
from isac_rt.kernels.receive_maps import lobe_bound
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.receive.maps import UNION_FLOOR
from isac_rt.receive.types import Detections

EXPLAINS = 0.25
"""Least power over the noise of one channel's cell that explains a detection. Averaged over the 45
channels of the default arrays, 0.25 passes the threshold in one of a thousand cells; less is hardly
more than noise."""


class Explanation(NamedTuple):
    """What caused each of Q detections; -1 where nothing stands out of the noise (a false alarm).

    kind : (Q,) int8 `PathKind`
    target : (Q,) int16 index into the set's target names, -1 also where no UAV is involved
    order : (Q,) int16 interactions with the city, 0 of a direct path
    face : (Q,) int32 face of the city's mesh that the path meets first, -1 also where it meets none
    skirt : (Q,) bool, the path lies more than a cell away: the detection is in its skirt
    """

    kind: np.ndarray
    target: np.ndarray
    order: np.ndarray
    face: np.ndarray
    skirt: np.ndarray


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


@jit
def hann_response(distance: float) -> float:
    """Power of a Hann-windowed tone at a distance of 0 or more cells, relative to its peak."""
    if distance == 0 or distance == 1:
        return 1.0 if distance == 0 else 0.25
    x = np.pi * distance
    return (np.sin(x) / x / (1 - distance * distance)) ** 2


@jit
def reach(distance: float) -> float:
    """Share of a path's power that is counted at a distance in cells: all within one cell, then
    what the Hann window passes at most."""
    if distance <= 1:
        return 1.0
    if distance < 2:
        return max(hann_response(distance), lobe_bound(2.0))
    return lobe_bound(distance)


class Places(NamedTuple):
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
    def of(cls, paths: PathSet, waveform: Waveform, passes: int) -> Places:
        """Where a receiver sees paths."""
        metres = SPEED_OF_LIGHT / passes
        return cls.at(metres * paths.delay, metres * paths.delay_rate, waveform, passes)

    @classmethod
    def at(cls, range: np.ndarray, velocity: np.ndarray, waveform: Waveform, passes: int) -> Places:
        """Where detections or tracks lie."""
        cells = waveform.range_cell(passes), waveform.velocity_cell(passes)
        return cls(range, velocity, cells, 2 * waveform.max_velocity(passes))

    def apart(
        self, range: float | np.ndarray, velocity: float | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances from a place in range and Doppler cells, velocities modulo the unambiguous
        span; from places (Q, 1) as (Q, K)."""
        off = velocity - self.velocity
        off -= self.span * np.round(off / self.span)
        return np.abs(range - self.range) / self.cells[0], np.abs(off) / self.cells[1]


@jit
def cells_apart(
    range: float, velocity: float, cells: tuple[float, float], span: float
) -> tuple[float, float]:
    """`Places.apart` of one place, from the differences of range and velocity."""
    velocity -= span * np.round(velocity / span)
    return abs(range) / cells[0], abs(velocity) / cells[1]


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
    """Which path caused each detection: the one with the most power at its place.

    A path counts with all its power within one cell in range and in Doppler, and beyond with what
    its Hann-windowed sidelobes hold at most. The diffuse paths within a cell count together, as the
    clutter that they are; the strongest of them gives order and face. What lies under `EXPLAINS`
    of the noise explains nothing. Paths of one cell reach a detection together, and the strongest
    decides; but a receiver that looks by beam, or takes strong paths out first, finds a weak one
    beside it. So a path of the cell that comes from where the detection says is the cause before
    a stronger one from elsewhere, and before the skirt of one whose direction fits worse.

    Parameters
    ----------
    cell_gain : power over the noise of one channel's cell, of a path of unit power
    aim : of `paths`; None: their directions do not count
    """
    places, power = Places.of(paths, waveform, passes), paths.power * cell_gain
    diffuse = paths.kind == PathKind.DIFFUSE
    if aim is None:
        aim = Aim(np.full((len(paths), 2), np.nan), np.ones(2))
    cause, near = _causes(
        (detections.range, detections.velocity, detections.direction),
        (places.range, places.velocity, aim.direction),
        (places.cells, places.span, tuple(aim.beam)),
        power,
        np.flatnonzero(diffuse),
        np.flatnonzero(~diffuse),
    )
    found = np.flatnonzero(cause >= 0)
    rows, count = cause[found], len(detections)
    kinds, targets, orders, faces = (
        np.full(count, -1, dtype) for dtype in (np.int8, np.int16, np.int16, np.int32)
    )
    kinds[found], targets[found], orders[found] = (
        column[rows] for column in (paths.kind, paths.target, paths.bounces)
    )
    met = np.append(paths.faces[rows], np.full((len(rows), 1), -1), axis=1)
    faces[found] = met[np.arange(len(rows)), (met >= 0).argmax(axis=1)]
    return Explanation(kinds, targets, orders, faces, (cause >= 0) & ~near)


@jit
def _causes(
    detections: tuple[np.ndarray, ...],
    paths: tuple[np.ndarray, ...],
    scales: tuple[tuple[float, float], float, tuple[float, float]],
    power: np.ndarray,
    field: np.ndarray,
    others: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Row of the path that caused each of Q detections (range, velocity and direction), -1 for
    none, and whether it lies within a cell of it; `scales` are the two cells, the span of
    velocities and the two beams."""
    (ranges, velocities, directions), (at, rate, towards) = detections, paths
    cells, span, (wide, high) = scales
    close_by = cells[0] * (1 + 1e-9)
    cause, beside = np.full(ranges.size, -1), np.zeros(ranges.size, np.bool_)
    most = field.size + others.size
    rows, near, able = np.empty(most, np.int64), np.empty(most, np.bool_), np.empty(most, np.bool_)
    here, clutter, off = np.empty(most), np.empty(most), np.empty(most)
    for q in range(ranges.size):
        count = 0
        for i in others:
            row, column = cells_apart(ranges[q] - at[i], velocities[q] - rate[i], cells, span)
            share = reach(row) * min(reach(column) + UNION_FLOOR, 1.0)
            rows[count], near[count] = i, row <= 1 and column <= 1
            here[count], clutter[count] = power[i] * share, 0.0
            count += 1
        for i in field:
            if abs(ranges[q] - at[i]) > close_by:  # most are, which no division needs to tell
                continue
            row, column = cells_apart(ranges[q] - at[i], velocities[q] - rate[i], cells, span)
            if row <= 1 and column <= 1:
                rows[count], near[count] = i, True
                here[count], clutter[count] = 0.0, power[i]
                count += 1
        for c in range(count):
            x = abs(towards[rows[c], 0] - directions[q, 0]) / wide
            z = abs(towards[rows[c], 1] - directions[q, 1]) / high
            off[c] = max(x, z) if x + z >= 0 else np.nan
            able[c] = off[c] <= 1
        best = _strongest(here, clutter, able, count)
        if best >= 0 and not near[best]:
            for c in range(count):
                able[c] &= near[c] and off[c] < off[best]
            best = _strongest(here, clutter, able, count)
        if best < 0 or not near[best]:
            able[:] = True
            best = _strongest(here, clutter, able, count)
        if best >= 0:
            cause[q], beside[q] = rows[best], near[best]
    return cause, beside


@jit
def _strongest(power: np.ndarray, clutter: np.ndarray, able: np.ndarray, count: int) -> int:
    """Of the first `count` paths the one of most power that is `able`, -1 if none explains
    anything; all clutter counts as its strongest. `power` is of single paths, `clutter` of those
    that count together."""
    first, total = -1, 0.0
    for c in range(count):
        if able[c] and clutter[c] > 0:
            total += clutter[c]
            if first < 0 or clutter[c] > clutter[first]:
                first = c
    best, most = -1, 0.0
    for c in range(count):
        mine = total if c == first else power[c]
        if able[c] and mine >= EXPLAINS and mine > most:
            best, most = c, mine
    return best
