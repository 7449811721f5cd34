"""One filter per UAV, fed by the detections of all terminals: which tracks are one UAV, where it
is, and its name in the whole swarm.

A terminal is wrong about its own pose and clock, and so about all its detections alike. These
errors are states of each UAV's filter: what two terminals see of the UAV tells them apart from its
motion, and what no terminal sees stays in its covariance.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from isac_rt.plain import Stateful
from isac_rt.track.filter import (
    INITIAL_POSITION_STD_LIMIT,
    INITIAL_SPEED_STD,
    Gaussian,
    conditioned,
    curvature,
    jacobian,
    mahalanobis,
    measure,
    measurement_covariance,
    narrowed,
    resting,
    singer,
    transmitter_jacobian,
)
from isac_rt.track.fused import Fused, Key, Name
from isac_rt.track.parts import POSE_STD
from isac_rt.track.tracker import assign
from isac_rt.world.swarm import Pose

SIZE = 6
"""Position and velocity in world axes [m, m/s]: what is told of a UAV."""
STATES = 9
"""And its acceleration [m/s^2]."""
POSE_ERRORS = 9
"""Errors of a terminal's position, velocity and attitude."""
DATUM_STD = (0.05, 0.05)
"""Errors that all terminals have alike, for they receive the same satellites [m, m/s]: nothing that
they tell each other shows them, and all fused tracks have them."""
_DATUM = np.diag(np.repeat(np.square(DATUM_STD), 3))
ATTITUDE_STD = np.radians(0.3)
"""Deviation of a terminal's attitude about each axis [rad]. Small inertial sensors with two
antennas hold it."""
HOLD_S = 0.5
"""How long a detection can be taken up in its order, and what was said counts without being said
again [s]."""
JOIN_PROBABILITY = 0.99
SPLIT_PROBABILITY = 1 - 1e-6
"""Two tracks are joined within the first gate and parted beyond the second, so that noise does not
join and part them in turns."""


class Detection(NamedTuple):
    """Detection that a track took.

    Attributes
    ----------
    key : the track
    since : when it was confirmed [s]
    name : by which the sender knows the UAV
    time : of the middle of the frame [s]
    own : pose of its terminal, as that believes it
    transmitter : (6,) state of the transmitter of a passive terminal, as that reports it; (0,) at
        an active one
    bias_std : deviation of the error that all ranges of the track share [m]
    measured, std : (4,) as in `isac_rt.track.filter.measure`, in the track's reading of an ambiguous
        velocity, and their deviations
    """

    key: Key
    since: float
    name: Name
    time: float
    own: Pose
    transmitter: np.ndarray
    bias_std: float
    measured: np.ndarray
    std: np.ndarray

    @property
    def own_name(self) -> Name:
        """The name that the track alone would give."""
        return Name(self.since, *self.key)

    @property
    def sender(self) -> np.ndarray | None:
        """State of a passive terminal's transmitter."""
        return self.transmitter if self.transmitter.size else None


@dataclass
class FusedUav:
    """Filter of one UAV.

    Attributes
    ----------
    name : in the swarm
    members : tracks that are taken for it, with the name that each alone would give
    found : their detections of the last `HOLD_S`, in order of time
    states : after each of them: the UAV's 9 states, the errors of the terminals and of the ranges
        of each link
    tests : squared Mahalanobis distance of each of them from what was expected
    base : time [s] and state before the first of them; None: it starts the filter
    """

    name: Name
    members: dict[Key, Name]
    found: list[Detection] = field(default_factory=list)
    states: list[Gaussian] = field(default_factory=list)
    tests: list[float] = field(default_factory=list)
    base: tuple[float, Gaussian] | None = None

    def change(self, found: Iterable[Detection]) -> None:
        """Exchange the detections; those from the first that differs on are filtered again."""
        new = sorted(found, key=lambda d: (d.time, d.key))
        if self.base is not None:
            new = [d for d in new if d.time >= self.base[0]]
        same = 0
        while same < min(len(new), len(self.states)) and new[same][:4:3] == self.found[same][:4:3]:
            same += 1
        self.found = new
        del self.states[same:], self.tests[same:]

    def worst(self) -> Key | None:
        """Return the track whose detections lie farthest beyond the gate of what is expected of
        this UAV; None: none does."""
        beyond = {}
        for key in self.members:
            mine = [k for k, d in enumerate(self.found) if d.key == key]
            size = sum(int(np.isfinite(self.found[k].measured).sum()) for k in mine)
            if mine:
                beyond[key] = sum(self.tests[k] for k in mine) / gate(SPLIT_PROBABILITY, size)
        key = max(beyond, key=lambda k: beyond[k], default=None)
        return key if key is not None and beyond[key] > 1 else None


@dataclass
class Followed:
    """UAVs that a listener follows."""

    uavs: list[FusedUav] = field(default_factory=list)


class FusedTracks(Stateful):
    """Fused tracks of a listener: an extended Kalman filter for each UAV with the errors of
    terminals and links, and memory of which tracks are one UAV, and of its name.

    Parameters
    ----------
    terminals, links : of the swarm, by name
    acceleration_std : of UAVs, per axis [m/s^2]
    """

    def __init__(
        self, terminals: Sequence[str], links: Sequence[str], acceleration_std: float
    ) -> None:
        self.state = Followed()
        self._acceleration_std = acceleration_std
        first = STATES + POSE_ERRORS * len(terminals)
        self._pose = {name: STATES + POSE_ERRORS * k for k, name in enumerate(terminals)}
        self._bias = {link: first + k for k, link in enumerate(links)}
        of_uav = [INITIAL_POSITION_STD_LIMIT, INITIAL_SPEED_STD, acceleration_std]
        of_pose = np.tile(np.repeat([*POSE_STD, ATTITUDE_STD], 3), len(terminals))
        self._prior = np.diag(np.square([*np.repeat(of_uav, 3), *of_pose, *np.zeros(len(links))]))

    def update(
        self,
        time: float,
        detections: Iterable[Detection],
        kept: Collection[Key],
        known: Mapping[str, Gaussian],
    ) -> list[Fused]:
        """Return the UAVs at a time [s].

        Parameters
        ----------
        detections : all that are known of the last `HOLD_S`
        kept : tracks that still exist
        known : what terminals say of themselves (6,)
        """
        by_key: dict[Key, list[Detection]] = {}
        for d in sorted(detections, key=lambda d: d.time):
            if d.key in kept and (d.key in by_key or _starts(d)):
                by_key.setdefault(d.key, []).append(d)
        self._take(by_key, kept)
        states = [self._at(uav, time) for uav in self.state.uavs]
        states = self._part(states, time)
        states = self._join(states, time)
        self._call(by_key)
        whose = recognise(states, known)
        return [
            Fused(uav.name, Gaussian(g.mean, g.covariance + _DATUM), tuple(uav.members), terminal)
            for uav, g, terminal in zip(self.state.uavs, states, whose, strict=True)
        ]

    def _take(self, by_key: Mapping[Key, list[Detection]], kept: Collection[Key]) -> None:
        """Take up detections; tracks that have ended leave, and new ones are UAVs of their own."""
        for uav in self.state.uavs:
            uav.members = {key: name for key, name in uav.members.items() if key in kept}
            own = [d for key in uav.members for d in by_key.get(key, ())]
            uav.change([*own, *(d for d in uav.found if d.key not in uav.members)])
        self.state.uavs = [uav for uav in self.state.uavs if uav.members]
        known = {key for uav in self.state.uavs for key in uav.members}
        for key, found in by_key.items():
            if key not in known:
                self.state.uavs.append(FusedUav(found[-1].name, {key: found[-1].own_name}, found))

    def _part(self, states: list[Gaussian], time: float) -> list[Gaussian]:
        """Make tracks whose detections are not those of their UAV UAVs of their own."""
        uavs, out = self.state.uavs, list(states)
        for k in range(len(uavs)):
            key = uavs[k].worst()
            if key is None:
                continue
            mine = [d for d in uavs[k].found if d.key == key]
            if len(uavs[k].members) > 1:
                own_name = uavs[k].members.pop(key)
                uavs[k].change([d for d in uavs[k].found if d.key != key])
                out[k] = self._at(uavs[k], time)
                alone = FusedUav(own_name, {key: own_name}, mine)
                uavs.append(alone)
                out.append(self._at(alone, time))
        return out

    def _join(self, states: list[Gaussian], time: float) -> list[Gaussian]:
        """Join UAVs that no terminal tells apart: as many as the gate allows, of the greatest
        likelihood."""
        uavs = self.state.uavs
        cost = distances(states, states)
        origins = [{key.origin for key in uav.members} for uav in uavs]
        for i, j in np.ndindex(cost.shape):
            if i >= j or origins[i] & origins[j]:
                cost[i, j] = np.inf
        gone: set[int] = set()
        for i, j in assign(cost):
            if not {i, j} & gone:
                gone.add(j)
                uavs[i].members |= uavs[j].members
                uavs[i].name = min(uavs[i].name, uavs[j].name)
                uavs[i].change([*uavs[i].found, *uavs[j].found])
                states[i] = self._at(uavs[i], time)
        self.state.uavs = [uav for k, uav in enumerate(uavs) if k not in gone]
        return [g for k, g in enumerate(states) if k not in gone]

    def _call(self, by_key: Mapping[Key, list[Detection]]) -> None:
        """Give names: the earliest that any member is known by; two UAVs never have the same. The
        one with the track that the name is of keeps it, else the one that had it before."""
        known = {key: found[-1] for key, found in by_key.items()}
        for uav in self.state.uavs:
            uav.name = min([uav.name, *(known[key].name for key in uav.members if key in known)])
        holder: dict[Name, FusedUav] = {}
        waiting = sorted(self.state.uavs, key=lambda b: Key(*b.name[1:]) not in b.members)
        for uav in waiting:
            if uav.name in holder:
                uav.name = min(uav.members.values())
            if uav.name in holder:  # by a UAV that lacks the track; it takes its own in its turn
                waiting.append(holder[uav.name])
            holder[uav.name] = uav

    def _at(self, uav: FusedUav, time: float) -> Gaussian:
        """Return a UAV's position and velocity at a time [s], after filtering what is new among its
        detections; those that are older than `HOLD_S` are let go."""
        for k in range(len(uav.states), len(uav.found)):
            d = uav.found[k]
            before = (uav.found[k - 1].time, uav.states[k - 1]) if k else uav.base
            if before is None:
                mean = np.zeros(len(self._prior))
                mean[:STATES] = resting(d.measured[None], d.own, d.sender)[0]
                before = d.time, Gaussian(mean, self._prior)
            g, test = self._updated(self._predicted(before[1], d.time - before[0]), d)
            uav.states.append(g)
            uav.tests.append(test)
        while len(uav.found) and uav.found[0].time < time - HOLD_S:
            uav.base = uav.found.pop(0).time, uav.states.pop(0)
            del uav.tests[0]
        last, g = (uav.found[-1].time, uav.states[-1]) if uav.found else uav.base
        g = self._predicted(g, time - last)
        return Gaussian(g.mean[:SIZE], g.covariance[:SIZE, :SIZE])

    def _predicted(self, g: Gaussian, interval: float) -> Gaussian:
        """Return a state after an interval [s]; errors stay as they are."""
        if interval == 0:
            return g
        F, Q = singer(interval, self._acceleration_std)
        mean, P = g.mean.copy(), g.covariance.copy()
        mean[:STATES] = F @ mean[:STATES]
        P[:STATES] = F @ P[:STATES]
        P[:, :STATES] = P[:, :STATES] @ F.T
        P[:STATES, :STATES] += Q
        return Gaussian(mean, P)

    def _updated(self, g: Gaussian, d: Detection) -> tuple[Gaussian, float]:
        """Return a state conditioned on a detection, and the squared Mahalanobis distance of
        that."""
        bias = self._bias[d.key.origin]
        if d.bias_std and g.covariance[bias, bias] == 0:  # the link's first
            g = Gaussian(g.mean, g.covariance.copy())
            g.covariance[bias, bias] = d.bias_std**2
        uav = Gaussian(g.mean[None, :STATES], g.covariance[None, :STATES, :STATES])
        R = measurement_covariance(d.std, uav.mean[0])[None]
        rows = np.flatnonzero(np.isfinite(d.measured))
        if g.covariance is not self._prior:
            left = narrowed(uav, R, d.own, d.sender) if rows.size == 4 else uav
            R = R + curvature(left, d.own, d.sender)
        R = R[0][rows[:, None], rows]

        def seen(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            off, H = self._residual(x, d)
            return off[rows], H[rows]

        y, H = seen(g.mean)
        d2, _ = mahalanobis(y[None], (H @ g.covariance @ H.T + R)[None])
        return conditioned(g, R, seen), float(d2[0])

    def _residual(self, x: np.ndarray, d: Detection) -> tuple[np.ndarray, np.ndarray]:
        """Return a detection less what is expected of a state (S,), (4,), and the latter's
        derivatives (4, S)."""
        tx, _, rx = d.key.origin.partition("->")
        own, sender, mine = d.own, d.sender, self._pose[rx]
        H = np.zeros((4, x.size))
        H[:, :STATES] = jacobian(x[:STATES], own, sender)
        segment = H[:, :SIZE]
        if sender is not None:
            of_sender = transmitter_jacobian(x[:STATES], sender)
            segment = segment + of_sender
            H[:, self._pose[tx] : self._pose[tx] + SIZE] = of_sender
        H[:, mine : mine + SIZE] = -segment
        e = (x[:3] - own.position) / np.linalg.norm(x[:3] - own.position)
        # R^T (I - [a]) e = R^T e + R^T [e] a, for an attitude that is off by a
        H[2:, mine + SIZE : mine + POSE_ERRORS] = own.rotation.T[[0, 2]] @ cross(e)
        H[0, self._bias[d.key.origin]] = 1.0
        return d.measured - measure(x[:STATES], own, sender) - H[:, STATES:] @ x[STATES:], H


def cross(e: np.ndarray) -> np.ndarray:
    """(3, 3) matrix of the cross product with e from the left."""
    x, y, z = e
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _starts(d: Detection) -> bool:
    """Return whether a detection fixes a place."""
    return bool(np.isfinite(resting(d.measured[None], d.own, d.sender)).all())


@lru_cache(maxsize=256)
def gate(probability: float, size: int = SIZE) -> float:
    """Return the squared distance within which so many components lie with a probability."""
    return float(2 * gammaincinv(size / 2, probability))


def distances(a: Sequence[Gaussian], b: Sequence[Gaussian]) -> np.ndarray:
    """Return squared Mahalanobis distances (len(a), len(b)) plus ln det S, S = A + B; infinite
    where the distance is outside the gate of `JOIN_PROBABILITY`.

    What the errors have in common makes the true S smaller, so that this gate lets in more than
    its share.
    """
    out = np.full((len(a), len(b)), np.inf)
    if not out.size:
        return out
    (x, P), (y, Q) = ([np.array(of) for of in zip(*some, strict=True)] for some in (a, b))
    off = (x[:, None] - y).reshape(-1, SIZE)
    d2, log_det = mahalanobis(off, (P[:, None] + Q).reshape(-1, SIZE, SIZE))
    return np.where(d2 <= gate(JOIN_PROBABILITY), d2 + log_det, np.inf).reshape(out.shape)


def recognise(states: Sequence[Gaussian], known: Mapping[str, Gaussian]) -> list[str | None]:
    """Return the terminal that each UAV is, by what terminals say of themselves."""
    whose: list[str | None] = [None] * len(states)
    names = list(known)
    for i, j in assign(distances(list(known.values()), states)):
        whose[j] = names[i]
    return whose
