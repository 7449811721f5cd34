"""One picture from the tracks of several terminals: which of them are one body, what they say of it
together, and its name in the whole swarm.

What terminals have in common is not known: they follow the same manoeuvres, rest on one
transmitter's pose, and may hear their own words again. Covariance intersection is consistent
whatever it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.special import gammaincinv

from isac_rt.terminal.filter import Gaussian, normalised, singer
from isac_rt.terminal.tracker import TrackSet, assign
from isac_rt.world.swarm import Pose

SIZE = 6
"""Position and velocity in world axes [m, m/s]: what terminals tell each other of a body."""
POSE_STD = (0.05, 0.05)
"""Deviations of a terminal's own position and velocity on each axis, as satellites and inertial
sensors give them [m, m/s]. They are part of what it says of itself and of others."""
ATTITUDE_STD = np.radians(0.1)
"""Deviation of a terminal's attitude about each axis [rad]: across the line of sight, times the
range, it adds to what it says of others."""
JOIN_PROBABILITY = 0.99
SPLIT_PROBABILITY = 1 - 1e-6
"""Two tracks are joined within the first gate and parted beyond the second, so that noise does not
join and part them in turns."""


class Key(NamedTuple):
    """A track: the link whose receiver follows it, as "TX->RX", and its number there."""

    origin: str
    number: int


class Name(NamedTuple):
    """A body's name in the swarm: the earliest track known of it, by the time of its confirmation
    [s]. All who know of that track give the body the same name."""

    since: float
    origin: str
    number: int


@dataclass(frozen=True)
class Report:
    """What a terminal says of one of its tracks.

    Attributes
    ----------
    key : the track
    since : when it was confirmed [s]
    name : by which it knows the body
    time : that the state is of [s]
    state : position and velocity (6,), (6, 6)
    """

    key: Key
    since: float
    name: Name
    time: float
    state: Gaussian

    @property
    def own_name(self) -> Name:
        """The name that the track alone would give."""
        return Name(self.since, *self.key)

    def at(self, time: float, acceleration_std: float) -> Report:
        """The same at another time [s]."""
        state = advance(self.state, time - self.time, acceleration_std)
        return replace(self, time=time, state=state)

    def memory(self) -> list[Any]:
        """As plain numbers and arrays, for `of_memory`."""
        return [list(self.key), self.since, list(self.name), self.time, list(self.state)]

    @classmethod
    def of_memory(cls, memory: Sequence[Any]) -> Report:
        """The report that gave a `memory`."""
        key, since, name, time, state = memory
        return cls(Key(*key), since, Name(*name), time, Gaussian(*state))


@dataclass(frozen=True)
class Fused:
    """One body of a picture.

    Attributes
    ----------
    name : in the swarm
    state : position and velocity (6,), (6, 6)
    members : the tracks that are taken for it
    terminal : of the swarm that it is, by what that one says of itself; None: none
    """

    name: Name
    state: Gaussian
    members: tuple[Key, ...]
    terminal: str | None = None


def advance(state: Gaussian, interval: float, acceleration_std: float) -> Gaussian:
    """Position and velocity (6,) after an interval [s] of Singer's model. The acceleration is not
    told: it is zero with `acceleration_std` [m/s^2] per axis."""
    if interval == 0:
        return state
    F, Q = singer(interval, acceleration_std)
    P = np.zeros((9, 9))
    P[:SIZE, :SIZE] = state.covariance
    P[SIZE:, SIZE:] = acceleration_std**2 * np.eye(3)
    return Gaussian(F[:SIZE, :SIZE] @ state.mean, (F @ P @ F.T + Q)[:SIZE, :SIZE])


def in_world(tracks: TrackSet, row: int, own: Pose, clock_std: float = 0.0) -> Gaussian:
    """A track in world axes as it is told to others.

    Beside the track's own covariance it holds the errors of the terminal's pose (`POSE_STD`,
    `ATTITUDE_STD`), and `clock_std` [m], the speed of light times the deviation of what is left
    of its clock's offset, on every axis. The turn of the velocity by the attitude's error is left
    out: it is a thousandth of it.
    """
    offset = tracks.mean[row, :3]
    across = offset @ offset * np.eye(3) - np.outer(offset, offset)
    P = tracks.covariance[row].copy()
    P[:3, :3] += (POSE_STD[0] ** 2 + clock_std**2) * np.eye(3) + ATTITUDE_STD**2 * across
    P[3:, 3:] += POSE_STD[1] ** 2 * np.eye(3)
    return Gaussian(tracks.mean[row] + np.concatenate([own.position, own.velocity]), P)


def of_itself(own: Pose) -> Gaussian:
    """What a terminal says of its own position and velocity."""
    variance = np.repeat(np.square(POSE_STD), 3)
    return Gaussian(np.concatenate([own.position, own.velocity]), np.diag(variance))


def intersection(a: Gaussian, b: Gaussian) -> Gaussian:
    r"""Covariance intersection of two estimates whose correlation is not known.

    .. math::

        P^{-1} = w A^{-1} + (1-w) B^{-1},\quad x = P\,(w A^{-1} a + (1-w) B^{-1} b)

    with the w in [0, 1] that makes the trace of P least, metres and metres a second alike. With
    :math:`V^T B^{-1} V = I,\ V^T A^{-1} V = \Lambda` it is the one root of the trace's derivative,
    :math:`\sum_i |v_i|^2 (\lambda_i - 1) / (w\lambda_i + 1 - w)^2 = 0`, or an end.

    References
    ----------
    .. [1] S. J. Julier and J. K. Uhlmann, "A non-divergent estimation algorithm in the presence of
       unknown correlations", Proc. American Control Conference, 1997,
       doi:10.1109/ACC.1997.609105

    Examples
    --------
    >>> a = Gaussian(np.array([1.0, 0.0]), np.diag([1.0, 9.0]))
    >>> b = Gaussian(np.array([0.0, 2.0]), np.diag([9.0, 1.0]))
    >>> fused = intersection(a, b)
    >>> fused.mean.round(6).tolist(), fused.covariance.round(6).tolist()
    ([0.9, 1.8], [[1.8, 0.0], [0.0, 1.8]])
    """
    A, B = np.linalg.inv(a.covariance), np.linalg.inv(b.covariance)
    values, V = eigh((A + A.T) / 2, (B + B.T) / 2)
    lengths = np.sum(V**2, axis=0)

    def slope(w: float) -> float:
        return float(np.sum(lengths * (values - 1) / (w * values + 1 - w) ** 2))

    if slope(0.0) <= 0:
        w = 0.0
    elif slope(1.0) >= 0:
        w = 1.0
    else:
        w = float(brentq(slope, 0.0, 1.0))
    P = (V / (w * values + 1 - w)) @ V.T
    return Gaussian(P @ (w * A @ a.mean + (1 - w) * B @ b.mean), P)


def intersection_of(states: Sequence[Gaussian]) -> Gaussian:
    """Covariance intersection of one or more, one after the other, the surest first."""
    ordered = sorted(states, key=lambda g: float(np.trace(g.covariance)))
    fused = ordered[0]
    for other in ordered[1:]:
        fused = intersection(fused, other)
    return fused


def distances(a: Sequence[Gaussian], b: Sequence[Gaussian]) -> tuple[np.ndarray, np.ndarray]:
    """(len(a), len(b)) squared Mahalanobis distances and ln det S, S = A + B.

    What the errors have in common makes the true S smaller, so that this gate lets in more than
    its share.
    """
    if not len(a) or not len(b):
        return np.zeros((len(a), len(b))), np.zeros((len(a), len(b)))
    means = [np.stack([g.mean for g in of]) for of in (a, b)]
    covariances = [np.stack([g.covariance for g in of]) for of in (a, b)]
    residual = means[0][:, None] - means[1][None]
    S = covariances[0][:, None] + covariances[1][None]
    return normalised(residual, S)


def gate(probability: float) -> float:
    """Squared distance within which two estimates of one body lie with a probability."""
    return float(2 * gammaincinv(SIZE / 2, probability))


@dataclass
class _Body:
    name: Name
    members: list[Key]

    def origins(self) -> set[str]:
        return {key.origin for key in self.members}


class Picture:
    """What a listener makes of all tracks that it knows: from frame to frame it remembers which of
    them are one body, and its name."""

    def __init__(self) -> None:
        self._bodies: list[_Body] = []

    def memory(self) -> list[Any]:
        """What is remembered as plain numbers and words, for `restore`."""
        return [[list(b.name), [list(k) for k in b.members]] for b in self._bodies]

    def restore(self, memory: Sequence[Any]) -> None:
        """Go on from a `memory`."""
        self._bodies = [_Body(Name(*name), [Key(*k) for k in keys]) for name, keys in memory]

    def update(
        self, reports: Iterable[Report], known: Mapping[str, Gaussian] | None = None
    ) -> list[Fused]:
        """The bodies of one instant.

        Parameters
        ----------
        reports : all of that instant (`Report.at`), one per track
        known : what terminals say of themselves, likewise
        """
        by_key = {report.key: report for report in reports}
        self._keep(by_key)
        self._join(by_key)
        self._call(by_key)
        states = [intersection_of([by_key[k].state for k in b.members]) for b in self._bodies]
        whose = recognise(states, known or {})
        return [
            Fused(body.name, state, tuple(body.members), terminal)
            for body, state, terminal in zip(self._bodies, states, whose, strict=True)
        ]

    def _keep(self, by_key: Mapping[Key, Report]) -> None:
        """Bodies of the tracks that are still there: those that have left their body, and new
        ones, stand alone."""
        kept, alone = [], dict.fromkeys(by_key)
        for body in self._bodies:
            members = [key for key in body.members if key in by_key]
            if not members:
                continue
            surest = min(members, key=lambda k: float(np.trace(by_key[k].state.covariance)))
            d2, _ = distances([by_key[surest].state], [by_key[k].state for k in members])
            body.members = [
                k for k, d in zip(members, d2[0], strict=True) if d <= gate(SPLIT_PROBABILITY)
            ]
            kept.append(body)
            for key in body.members:
                del alone[key]
        self._bodies = kept + [_Body(by_key[key].name, [key]) for key in alone]

    def _join(self, by_key: Mapping[Key, Report]) -> None:
        """Tracks that stand alone join bodies that their terminal has no track of, origin by
        origin: as many as the gate allows, of the greatest likelihood."""
        for origin in dict.fromkeys(key.origin for key in sorted(by_key)):
            single = [b for b in self._bodies if len(b.members) == 1 and origin in b.origins()]
            others = [b for b in self._bodies if origin not in b.origins()]
            d2, log_det = distances(
                [intersection_of([by_key[k].state for k in b.members]) for b in others],
                [by_key[b.members[0]].state for b in single],
            )
            cost = np.where(d2 <= gate(JOIN_PROBABILITY), d2 + log_det, np.inf)
            for i, j in assign(cost):
                others[i].members += single[j].members
                others[i].name = min(others[i].name, single[j].name)
                self._bodies.remove(single[j])

    def _call(self, by_key: Mapping[Key, Report]) -> None:
        """Names: the earliest that any member is known by; two bodies never have the same. The one
        with the track that the name is of keeps it, else the one that had it before."""
        for body in self._bodies:
            body.name = min(body.name, *(by_key[key].name for key in body.members))
        holder: dict[Name, _Body] = {}
        waiting = sorted(self._bodies, key=lambda b: Key(*b.name[1:]) not in b.members)
        for body in waiting:
            if body.name in holder:
                body.name = min(by_key[key].own_name for key in body.members)
            if body.name in holder:  # by a body that lacks the track; it takes its own in its turn
                waiting.append(holder[body.name])
            holder[body.name] = body


def recognise(states: Sequence[Gaussian], known: Mapping[str, Gaussian]) -> list[str | None]:
    """The terminal that each body is, by what terminals say of themselves."""
    whose: list[str | None] = [None] * len(states)
    names = list(known)
    d2, log_det = distances(list(known.values()), states)
    for i, j in assign(np.where(d2 <= gate(JOIN_PROBABILITY), d2 + log_det, np.inf)):
        whose[j] = names[i]
    return whose
