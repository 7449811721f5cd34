"""The measures of a score: where a UAV ought to be seen, symbols that are wrong, GOSPA."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import asin, atan2, sqrt
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import betaincinv

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import Payload
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
    body = observer.to_body(offset / distance)
    length = distance
    if at is not None:
        outward = uav.position - at.position
        further = sqrt(outward @ outward)
        length += further
        velocity += float(outward @ (uav.velocity - at.velocity)) / further
    right, ahead, up = body.tolist()
    return Truth(length, velocity, right, up, atan2(right, ahead), asin(min(max(up, -1.0), 1.0)))


@dataclass(frozen=True)
class SymbolCount:
    """Symbols and bits sent to a terminal in data mode, and what became of them; `+` pools.

    Errors include what was erased (not decided). `frames` are data frames.
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

    def __add__(self, other: SymbolCount) -> SymbolCount:
        return SymbolCount(
            *(getattr(self, f) + getattr(other, f) for f in self.__dataclass_fields__)
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
        return sent.size, int((sent != decided).sum()), int((decided < 0).sum())

    bits = payload.bits_of(mine)
    decoded = bits.size if reception.decoded else 0
    wrong = int((bits != reception.bits).sum()) if decoded else bits.size
    return SymbolCount(
        *compare(payload.delay_symbols[mine], reception.delay_symbols[mine]),
        *compare(payload.transitions[mine], reception.transitions[mine]),
        bits.size,
        wrong,
        decoded,
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
    square, pairs = 0.0, 0
    if len(x) and len(y):
        d2 = np.minimum(np.sum((x[:, None] - y[None]) ** 2, axis=-1), cutoff**2)
        rows, columns = linear_sum_assignment(d2)
        chosen = d2[rows, columns]
        square, pairs = float(chosen[chosen < cutoff**2].sum()), int((chosen < cutoff**2).sum())
    missed, false = (len(x) - pairs) * cutoff**2 / 2, (len(y) - pairs) * cutoff**2 / 2
    return Gospa(float(np.sqrt(square + missed + false)), square, missed, false)


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


def within_view(antennas: Antennas, own: Pose, active: Pose, body: Pose) -> bool:
    """Return whether a target is in the field of view of the receiver and, unless it is the
    transmitter itself, of the transmitter."""
    ends = [(own, body)]
    if body is active:
        ends.append((active, own))
    elif own is not active:
        ends.append((active, body))
    offsets = [(a, b.position - a.position) for a, b in ends]
    return all(bool(antennas.in_view(a.to_body(d / np.linalg.norm(d)))) for a, d in offsets)
