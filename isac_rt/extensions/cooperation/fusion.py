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
from itertools import dropwhile
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
from isac_rt.track.tracker import CLEAR_M, assign
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
"""Two tracks are joined within the first gate and parted beyond the second, by all detections that
are held, so that noise does not join and part them in turns."""


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
    measured, std : (4,) as in `isac_rt.track.filter.measure`, in the track's reading of an
        ambiguous velocity, and their deviations
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
    def order(self) -> tuple[float, Key]:
        """Place among all detections."""
        return self.time, self.key

    @property
    def frame(self) -> tuple[float, str, list[bool]]:
        """Time, link and measured quantities: detections that share them are filtered at once."""
        return self.time, self.key.origin, np.isfinite(self.measured).tolist()

    @property
    def sender(self) -> np.ndarray | None:
        """State of a passive terminal's transmitter."""
        return self.transmitter if self.transmitter.size else None


class Instant(NamedTuple):
    """State after a detection: its time [s], the UAV's 9 states with the errors of the terminals
    and of the ranges of each link, and the squared Mahalanobis distance of the detection from what
    was expected."""

    time: float
    state: Gaussian
    test: float = 0.0


@dataclass
class FusedUav:
    """Filter of one UAV.

    Attributes
    ----------
    name : in the swarm
    members : tracks that are taken for it, with the name that each alone would give
    found : their detections of the last `HOLD_S`, in order of time
    states : after those that were filtered
    base : what the first of them follows; None: it starts the filter
    """

    name: Name
    members: dict[Key, Name]
    found: list[Detection] = field(default_factory=list)
    states: list[Instant] = field(default_factory=list)
    base: Instant | None = None

    @property
    def latest(self) -> Instant | None:
        """State after the last detection that was filtered."""
        return self.states[-1] if self.states else self.base

    @property
    def next_found(self) -> Detection:
        """Detection to be filtered next."""
        return self.found[len(self.states)]

    def change(self, found: Iterable[Detection]) -> None:
        """Exchange the detections; those from the first that differs on are filtered again."""
        since = -np.inf if self.base is None else self.base.time
        held = {d.order: d for d in found if d.time > since}
        new = [held[order] for order in sorted(held)]
        if self.base is None:
            new = list(dropwhile(lambda d: not _starts(d), new))
        pairs = zip(new, self.found[: len(self.states)], strict=False)
        same = next((k for k, (d, f) in enumerate(pairs) if d.order != f.order), len(new))
        self.found = new
        del self.states[same:]

    def stranger(self) -> Key | None:
        """Return the track whose detections lie farthest beyond `SPLIT_PROBABILITY` of what is
        expected of this UAV; None: none does."""
        beyond: dict[Key | None, float] = {None: 1.0}
        for key in self.members if len(self.members) > 1 else ():
            tests = [s.test for d, s in zip(self.found, self.states, strict=True) if d.key == key]
            beyond[key] = sum(tests) / gate(SPLIT_PROBABILITY, 4 * len(tests)) if tests else 0.0
        return max(beyond, key=lambda key: beyond[key])


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
        of_uav = [*[INITIAL_POSITION_STD_LIMIT] * 3, *INITIAL_SPEED_STD, *[acceleration_std] * 3]
        of_pose = np.tile(np.repeat([*POSE_STD, ATTITUDE_STD], 3), len(terminals))
        self._prior = np.diag(np.square([*of_uav, *of_pose, *np.zeros(len(links))]))

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
            by_key.setdefault(d.key, []).append(d)
        self._take(by_key, kept)
        self._part(time)
        states = self._join(time)
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
            uav.change([*uav.found, *(d for key in uav.members for d in by_key.get(key, ()))])
        known = {key for uav in self.state.uavs for key in uav.members}
        for key, found in by_key.items():
            if key in kept and key not in known:
                uav = FusedUav(found[-1].name, {key: Name(found[-1].since, *key)})
                uav.change(found)
                self.state.uavs.append(uav)
        self.state.uavs = [
            uav for uav in self.state.uavs if uav.members and (uav.found or uav.base)
        ]

    def _part(self, time: float) -> None:
        """Make tracks whose detections are not those of their UAV UAVs of their own."""
        self._at(self.state.uavs, time)
        for uav in list(self.state.uavs):
            key = uav.stranger()
            if key is not None:
                name, found = uav.members.pop(key), uav.found
                alone = FusedUav(name, {key: name})
                alone.change([d for d in found if d.key == key])
                uav.change([d for d in found if d.key != key])
                self.state.uavs.append(alone)
        # detections without a direction may fix no place
        self.state.uavs = [uav for uav in self.state.uavs if uav.found or uav.base]

    def _join(self, time: float) -> list[Gaussian]:
        """Join UAVs of different terminals, or nearer than UAVs fly, as many as the gate allows, of
        the greatest likelihood, where one filter fits the detections of both. Return the states."""
        uavs = self.state.uavs
        states = self._at(uavs, time)
        origins = [{key.origin for key in uav.members} for uav in uavs]
        cost = distances(states, states)
        for i, j in np.ndindex(cost.shape):
            near = np.linalg.norm(states[i].mean[:3] - states[j].mean[:3]) < CLEAR_M
            if i >= j or (origins[i] & origins[j] and not near):
                cost[i, j] = np.inf
        joined: set[int] = set()
        for i, j in assign(cost):
            if {i, j} & joined:
                continue
            a, b = uavs[i], uavs[j]
            both = FusedUav(min(a.name, b.name), a.members | b.members, base=a.base)
            both.change([*a.found, *b.found])
            self._at([both], time)
            if both.stranger() is None:
                uavs[i] = uavs[j] = both
                joined |= {i, j}
        self.state.uavs = list({id(uav): uav for uav in uavs}.values())
        return self._at(self.state.uavs, time)

    def _call(self, by_key: Mapping[Key, list[Detection]]) -> None:
        """Give names: the earliest that any member is known by, but none that another UAV has, nor
        one of another UAV's track."""
        whose = {key: uav for uav in self.state.uavs for key in uav.members}
        given: set[Name] = set()
        for uav in self.state.uavs:
            told = [by_key[key][-1].name for key in uav.members if key in by_key]
            names = {uav.name, *told, *uav.members.values()} - given
            uav.name = min(n for n in names if whose.get(Key(*n[1:]), uav) is uav)
            given.add(uav.name)

    def _at(self, uavs: Sequence[FusedUav], time: float) -> list[Gaussian]:
        """Return the positions and velocities of UAVs at a time [s], after filtering what is new
        among their detections, those of a frame at once, and let go those that are older than
        `HOLD_S`."""
        while waiting := [uav for uav in uavs if len(uav.states) < len(uav.found)]:
            first = min(uav.next_found.frame for uav in waiting)
            now = [uav for uav in waiting if uav.next_found.frame == first]
            after, tests = self._updated([(uav.latest, uav.next_found) for uav in now])
            for uav, mean, P, test in zip(now, *after, tests, strict=True):
                uav.states.append(Instant(first[0], Gaussian(mean, P), float(test)))
        for uav in uavs:
            while uav.found and uav.found[0].time < time - HOLD_S:
                del uav.found[0]
                uav.base = uav.states.pop(0)
        means, covariances = self._predicted([uav.latest for uav in uavs if uav.latest], time)
        states = zip(means[:, :SIZE], covariances[:, :SIZE, :SIZE], strict=True)
        return [Gaussian(*of) for of in states]

    def _predicted(self, before: Sequence[Instant], time: float) -> Gaussian:
        """Return states (K, S) at a time [s]; errors stay as they are."""
        if not before:
            return Gaussian(np.zeros((0, SIZE)), np.zeros((0, SIZE, SIZE)))
        mean, P = (np.array(of) for of in zip(*(b.state for b in before), strict=True))
        still, uav = (np.eye(STATES), np.zeros((STATES, STATES))), slice(STATES)
        intervals = [time - b.time for b in before]
        model = [singer(t, self._acceleration_std) if t else still for t in intervals]
        F, Q = (np.array(of) for of in zip(*model, strict=True))
        mean[:, uav] = (F @ mean[:, uav, None])[..., 0]
        P[:, uav] = F @ P[:, uav]
        P[:, :, uav] = P[:, :, uav] @ np.swapaxes(F, 1, 2)
        P[:, uav, uav] += Q
        return Gaussian(mean, P)

    def _updated(
        self, pairs: Sequence[tuple[Instant | None, Detection]]
    ) -> tuple[Gaussian, np.ndarray]:
        """Return states (K, S) conditioned on detections of one frame of a link, and their squared
        Mahalanobis distances (K,). Without a state before it a detection starts one at rest."""
        found = [d for _, d in pairs]
        d, z, std = found[0], *(np.array([of[-k] for of in found]) for k in (2, 1))
        rest = np.zeros((len(found), len(self._prior)))
        rest[:, :STATES] = resting(z, d.own, d.sender)
        before = [
            b or Instant(d.time, Gaussian(mean, self._prior))
            for (b, _), mean in zip(pairs, rest, strict=True)
        ]
        g = self._predicted(before, d.time)
        bias = self._bias[d.key.origin]
        variance = g.covariance[:, bias, bias]  # 0 before the link's first
        g.covariance[:, bias, bias] = np.where(variance, variance, [of.bias_std**2 for of in found])
        uav = Gaussian(g.mean[:, :STATES], g.covariance[:, :STATES, :STATES])
        R, errors = measurement_covariance(std, uav.mean), self._levers(uav.mean, d)
        rows = np.flatnonzero(np.isfinite(z[0]))
        ix = (slice(None), rows[:, None], rows)

        def seen(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            state = x[:, :STATES]
            off = z - measure(state, d.own, d.sender) - (errors @ x[:, STATES:, None])[..., 0]
            H = np.concatenate([jacobian(state, d.own, d.sender), errors], axis=2)
            return off[:, rows], H[:, rows]

        left = narrowed(uav, R, d.own, d.sender) if rows.size == 4 else uav
        new = np.array([b is None for b, _ in pairs])
        if new.any():  # a place that all of it fixes
            of_all = conditioned(g, R[ix], seen).covariance[new, :STATES, :STATES]
            left.covariance[new] = of_all
        R = (R + curvature(left, d.own, d.sender))[ix]
        y, H = seen(g.mean)
        tests, _ = mahalanobis(y, H @ g.covariance @ np.swapaxes(H, 1, 2) + R)
        return conditioned(g, R, seen), tests

    def _levers(self, uav: np.ndarray, d: Detection) -> np.ndarray:
        """Return the derivatives (K, 4, E) of what is measured of UAVs (K, 9) in the frame of a
        detection by the errors of terminals and links."""
        tx, _, rx = d.key.origin.partition("->")
        out = np.zeros((len(uav), 4, len(self._prior)))
        segment = jacobian(uav, d.own, d.sender)[..., :SIZE]
        if d.sender is not None:
            of_sender = transmitter_jacobian(uav, d.sender)
            segment = segment + of_sender
            out[..., self._pose[tx] : self._pose[tx] + SIZE] = of_sender
        mine = self._pose[rx]
        out[..., mine : mine + SIZE] = -segment
        e = uav[:, :3] - d.own.position
        e /= np.linalg.norm(e, axis=1)[:, None]
        # R^T (I - [a]) e = R^T e + R^T [e] a, for an attitude that is off by a
        turned = np.cross(d.own.rotation.T[[0, 2]], e[:, None])
        out[:, 2:, mine + SIZE : mine + POSE_ERRORS] = turned
        out[:, 0, self._bias[d.key.origin]] = 1.0
        return out[..., STATES:]


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
