"""The measures of a score: where a UAV ought to be seen, symbols that are wrong, GOSPA."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import asin, atan2, sqrt
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import betaincinv

from isac_rt.frame.antennas import Antennas, Arrays, resolutions
from isac_rt.frame.link import Link
from isac_rt.frame.payload import Payload
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.types import Reception
from isac_rt.world.swarm import Pose


class Truth(NamedTuple):
    """One UAV as one terminal ought to see it.

    range [m] and velocity [m/s, positive receding] in the terms of `Detections`; direction cosines
    u_x, u_z; azimuth from the boresight towards +X and elevation from the horizontal of the UAV
    [rad]
    """

    range: float
    velocity: float
    u_x: float
    u_z: float
    azimuth: float
    elevation: float


def truth_of(observer: Pose, uav: Pose, at: Pose | None = None) -> Truth:
    """Return what `observer` ought to measure of `uav`.

    Without `at` the one-way range and its rate: every target of an AT, and the AT itself at a PT.
    With `at` the bistatic path length AT - UAV - observer and its rate. The direction is that of
    arrival, over the whole sphere.
    """
    offset = uav.position - observer.position
    distance = sqrt(offset @ offset)
    velocity = float(offset @ (uav.velocity - observer.velocity)) / distance
    direction = observer.to_body(offset / distance)
    length = distance
    if at is not None:
        outward = uav.position - at.position
        further = sqrt(outward @ outward)
        length += further
        velocity += float(outward @ (uav.velocity - at.velocity)) / further
    right, ahead, up = direction.tolist()
    return Truth(length, velocity, right, up, atan2(right, ahead), asin(min(max(up, -1.0), 1.0)))


GATE_RESOLUTIONS = 3.0
"""An estimate farther from a UAV than so many resolutions on some axis does not stand for it, even
if the UAV's own path caused it: an alias, a range misread, a track that has drifted off."""


class Resolution(NamedTuple):
    """Resolution of a link's receiver: of range [m], velocity [m/s] and direction cosines (4,), and
    whether it observes u_x and u_z."""

    width: np.ndarray
    observed: tuple[bool, bool]

    @classmethod
    def of(cls, waveform: Waveform, antennas: Antennas, passes: int) -> Resolution:
        """Return the resolution for an echo in one-way range (passes = 2) or for a path length."""
        return cls(resolutions(waveform, antennas, passes), antennas.observes(passes))

    def off(self, truth: Truth, points: np.ndarray) -> np.ndarray:
        """(Q,) largest distance of points (Q, 4) from the truth on any axis in resolutions; a
        direction that was not found counts as `GATE_RESOLUTIONS`, one that is not observed not at
        all."""
        off = np.abs(points - np.array(truth[:4])) / self.width
        off[:, 2:][:, np.logical_not(self.observed)] = 0.0
        return np.where(np.isnan(off), GATE_RESOLUTIONS, off).max(axis=1)


@dataclass(frozen=True)
class SymbolCount:
    """Symbols and bits sent to a terminal in data mode, and what became of them; `+` pools.

    Symbols and bits are erased where they were not decided, or the frame's check sum fails; errors
    are those decided wrongly or not at all. Bits of check sums do not count, and `bits_decoded` are
    of frames that were read. `frames` are data frames.
    """

    delay_total: int = 0
    delay_errors: int = 0
    delay_erased: int = 0
    dpsk_total: int = 0
    dpsk_errors: int = 0
    dpsk_erased: int = 0
    bits_total: int = 0
    bit_errors: int = 0
    bits_decoded: int = 0
    frames: int = 0

    def __add__(self, more: SymbolCount) -> SymbolCount:
        return SymbolCount(
            *(getattr(self, f) + getattr(more, f) for f in self.__dataclass_fields__)
        )


def count_symbols(
    payload: Payload, reception: Reception, groups: Sequence[int] | None = None
) -> SymbolCount:
    """One frame: what was sent in `groups` (None: in all) against what was decided. An unmodulated
    frame counts nothing."""
    if not payload.modulated:
        return SymbolCount()
    mine = list(range(len(payload.delay_symbols)) if groups is None else groups)

    def compare(sent: np.ndarray, decided: np.ndarray) -> tuple[int, int, int]:
        if not reception.decoded:
            return sent.size, sent.size, sent.size
        erased = int((decided < 0).sum()) if reception.intact else sent.size
        return sent.size, int((sent != decided).sum()), erased

    useful = ~payload.is_check(mine)
    bits = int(useful.sum())
    wrong = bits
    if reception.decoded:
        wrong = int((payload.bits_of(mine) != reception.bits)[useful].sum())
    return SymbolCount(
        *compare(payload.delay_symbols[mine], reception.delay_symbols[mine]),
        *compare(payload.transitions[mine], reception.transitions[mine]),
        bits,
        wrong,
        bits if reception.is_read else 0,
        1,
    )


GOSPA_CUTOFF_M = 5.0
"""c: a track farther than this from a UAV does not stand for it [m]."""


class Gospa(NamedTuple):
    """distance^2 = localisation + missed + false (each already to the power of two) [m, m^2]."""

    distance: float
    localisation: float
    missed: float
    false: float


def gospa(truths: np.ndarray, estimates: np.ndarray, cutoff: float) -> Gospa:
    r"""Generalised optimal sub-pattern assignment with p = 2, alpha = 2.

    .. math::

        d^2 = \min_\gamma \sum_{(i,j)\in\gamma} |x_i-y_j|^2 + \tfrac{c^2}{2}(|X|+|Y|-2|\gamma|)

    Parameters
    ----------
    truths, estimates : (n, D), (m, D) [m]
    cutoff : c [m]; a pair farther apart counts as one missed and one false

    References
    ----------
    .. [1] A. S. Rahmathullah et al., "Generalized optimal sub-pattern assignment metric", FUSION
    2017,
       doi:10.23919/ICIF.2017.8009645
    """
    x, y = np.asarray(truths, float), np.asarray(estimates, float)
    distance = np.linalg.norm(x[:, None] - y[None], axis=-1)
    paired = assigned(distance, cutoff)
    square, pairs = float(sum(distance[pair] ** 2 for pair in paired)), len(paired)
    missed, false = (len(x) - pairs) * cutoff**2 / 2, (len(y) - pairs) * cutoff**2 / 2
    return Gospa(float(np.sqrt(square + missed + false)), square, missed, false)


def assigned(distance: np.ndarray, limit: float) -> list[tuple[int, int]]:
    """Return the pairs of rows and columns (n, m) with the least sum of squared distances, each
    clipped at `limit`; a row or column that is `limit` or more from its partner has none."""
    rows, columns = linear_sum_assignment(np.minimum(distance, limit) ** 2)
    near = distance[rows, columns] < limit
    return list(zip(rows[near].tolist(), columns[near].tolist(), strict=True))


def score_tracks(
    tracks: np.ndarray, uavs: np.ndarray, scored: np.ndarray
) -> tuple[Gospa, np.ndarray]:
    """Return GOSPA of tracks against the UAVs that are scored, and which tracks are
    `GOSPA_CUTOFF_M` or more from every UAV.

    Tracks are assigned to all UAVs together. A track assigned to a UAV that is not scored, or left
    within the cutoff of one, is no error: it stands for a terminal, which reports its position, or
    for a target that is occluded now.

    Parameters
    ----------
    tracks, uavs : (T, 3), (U, 3) positions [m]
    scored : (U,) bool, the targets in view
    """
    distance = np.linalg.norm(tracks[:, None] - uavs[None], axis=-1)
    near = distance < GOSPA_CUTOFF_M
    beside = near[:, ~scored].any(axis=1)
    for track, uav in assigned(distance, GOSPA_CUTOFF_M):
        beside[track] = not scored[uav]
    return gospa(uavs[scored], tracks[~beside], GOSPA_CUTOFF_M), ~near.any(axis=1)


def decibels(ratio: float) -> float | None:
    """10 log10; None for nothing."""
    return round(float(10 * np.log10(ratio)), 2) if ratio > 0 else None


def binomial_interval(
    successes: float, trials: float, confidence: float = 0.95
) -> tuple[float, float]:
    """Clopper-Pearson: the proportions that would not make `successes` or fewer, or as many or
    more, too unlikely."""
    tail = (1 - confidence) / 2
    low = float(betaincinv(successes, trials - successes + 1, tail)) if successes else 0.0
    high = (
        float(betaincinv(successes + 1, trials - successes, 1 - tail))
        if successes < trials
        else 1.0
    )
    return low, high


def within_view(arrays: Arrays, link: Link, poses: Mapping[str, Pose], uav: str) -> bool:
    """Return whether a target is in the field of view of a link's receiver and, unless it is the
    transmitter itself, of the transmitter."""
    tx, rx = link
    ends = [(rx, uav)]
    if uav == tx:
        ends.append((tx, rx))
    elif tx != rx:
        ends.append((tx, uav))
    for here, there in ends:
        offset = poses[there].position - poses[here].position
        towards = poses[here].to_body(offset / np.linalg.norm(offset))
        if not arrays.of(here).in_view(towards):
            return False
    return True
