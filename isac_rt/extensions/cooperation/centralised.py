"""One filter of the detections of several terminals, with the errors of their poses and clocks as
states beside the UAVs.

The covariance of all of it is kept together, so that what an error does to one UAV shows in the
others. Detections may come late: the filter goes back to their time and takes up what followed
again, so that its fused tracks do not depend on the order in which they came.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from isac_rt.extensions.cooperation.fusion import (
    ATTITUDE_STD,
    ERRORS,
    JOIN_PROBABILITY,
    SIZE,
    cross,
    gate,
    in_datum,
    recognise,
)
from isac_rt.plain import Stateful
from isac_rt.track.filter import (
    POSITION,
    STD_FLOOR,
    Ambiguity,
    Gaussian,
    conditioned,
    costs,
    expected,
    initiate,
    jacobian,
    measure,
    singer,
    transmitter_jacobian,
    wrapped,
)
from isac_rt.track.fused import Fused, Key, Name
from isac_rt.track.parts import POSE_STD
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import ROUNDING, assign
from isac_rt.world.swarm import Pose

UAV_STATES = 9
"""States of a UAV."""
POSE = ERRORS - 1
"""Those of a terminal are the errors of its pose [m, m/s, rad]; each link has one of its clocks."""
ERROR_TIME = 10.0
"""Correlation time of a terminal's errors [s]: satellites and inertial sensors drift in seconds to
minutes. A clock's error stays, and grows as scans state."""
MOST_LATE = 0.5
"""Detections that come later count for nothing [s]."""


@dataclass(frozen=True)
class Scan:
    """Report of a terminal about one frame of a link: the detections that its tracks took.

    Attributes
    ----------
    origin : the link, as "TX->RX"
    frame, time : number and middle of the frame [s]
    own : pose as the terminal believes it
    clock_std : deviation of its ranges by its clock [m]
    numbers : (D,) of the tracks that took them
    z, std : (D, 4) range, rate, u_x, u_z and their deviations
    snr : (D,) linear
    sure : (D,) bool, whether its track is confirmed
    names : by which the terminal knows the UAVs, None: by none
    kept : numbers of all tracks that the receiver keeps
    """

    origin: str
    frame: int
    time: float
    own: Pose
    clock_std: float
    numbers: np.ndarray
    z: np.ndarray
    std: np.ndarray
    snr: np.ndarray
    sure: np.ndarray
    names: tuple[Name | None, ...]
    kept: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def key(self) -> tuple[float, str]:
        """Its place in time, and among those of one time."""
        return self.time, self.origin

    @property
    def ends(self) -> tuple[str, str]:
        """Transmitter and receiver."""
        tx, rx = self.origin.split("->")
        return tx, rx

    def select(self, rows: np.ndarray) -> Scan:
        """Some of its detections."""
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in ("numbers", "z", "std", "snr", "sure")},
            names=tuple(self.names[int(k)] for k in rows),
        )

    def best(self, count: int) -> np.ndarray:
        """Rows of the strongest, those of confirmed tracks before all others."""
        return np.sort(np.lexsort((-self.snr, ~self.sure))[:count])


@dataclass(frozen=True)
class TrackedUav:
    """Knowledge about a target besides its state.

    Attributes
    ----------
    name : in the swarm; `born`: what it is called by its own first detection
    hits : times of its latest detections [s]
    fed : by link the number of the track that took its latest detection, and when
    confirmed : there were enough detections
    """

    name: Name
    born: Name
    hits: tuple[float, ...]
    fed: Mapping[str, tuple[int, float]]
    confirmed: bool = False


@dataclass(frozen=True)
class JointState:
    """All states at a time: `POSE` of each terminal, one of the clocks of each link that states a
    clock error, then `UAV_STATES` of each UAV; `clocks` is the variance of ranges by a link's
    clocks that its scans have stated [m^2]."""

    time: float
    mean: np.ndarray
    covariance: np.ndarray
    uavs: tuple[TrackedUav, ...] = ()
    clocks: Mapping[str, float] = field(default_factory=dict)

    def without(self, removed: set[int]) -> JointState:
        """The same without some UAVs."""
        first = len(self.mean) - UAV_STATES * len(self.uavs)
        keep = [k for k in range(len(self.uavs)) if k not in removed]
        rows = [np.arange(first), *(first + UAV_STATES * k + np.arange(UAV_STATES) for k in keep)]
        at = np.concatenate(rows)
        uavs = tuple(self.uavs[k] for k in keep)
        covariance = self.covariance[np.ix_(at, at)]
        return replace(self, mean=self.mean[at], covariance=covariance, uavs=uavs)


@dataclass(frozen=True)
class TrackManagement:
    """When UAVs begin and end.

    Attributes
    ----------
    hits, window : detections within a time [s] that confirm one if they are of two links; one of a
        confirmed track does it alone. A tentative one ends after that time without any
    drop : time without a detection after which a confirmed one ends [s]
    """

    hits: int
    window: float
    drop: float

    @classmethod
    def of(cls, s: Tracking, period: float) -> TrackManagement:
        """As the tracker's settings have it for frames every `period` [s]."""
        drop = s.drop_misses * period
        return cls(
            s.confirm_hits,
            s.confirm_window * period,
            drop if s.drop_after_s is None else min(drop, s.drop_after_s),
        )


@dataclass
class _Known:
    """State of a centralised tracker: the states before the dwells that may still be preceded by
    late ones, and these dwells with the states (6,) of their transmitters."""

    begin: JointState
    scans: list[tuple[Scan, np.ndarray | None]] = field(default_factory=list)


class CentralisedTracker(Stateful):
    """The set of fused tracks that a listener makes of all detections that it knows.

    Parameters
    ----------
    terminals : names of all that detect
    settings : Tracking
    management : when UAVs begin and end
    ambiguities : what detections of an active and of a passive terminal leave open
    """

    def __init__(
        self,
        terminals: Sequence[str],
        settings: Tracking,
        management: TrackManagement,
        ambiguities: tuple[Ambiguity, Ambiguity],
    ) -> None:
        self._terminals, self._settings, self._lives = list(terminals), settings, management
        self._ambiguities = ambiguities
        variance = np.tile(_error_variance(), len(self._terminals))
        self.state = _Known(JointState(-np.inf, np.zeros(variance.size), np.diag(variance)))
        self._centralised: list[JointState] = []

    def add(self, scan: Scan, transmitter: np.ndarray | None) -> bool:
        """Take up detections; whether they came in time.

        Parameters
        ----------
        transmitter : (6,) what the transmitter says of its position and velocity then, of a passive
            terminal's detections
        """
        if scan.time <= self.state.begin.time:
            return False
        at = bisect([one.key for one, _ in self.state.scans], scan.key)
        self.state.scans.insert(at, (scan, transmitter))
        self._replay(at)
        return True

    def _replay(self, first: int) -> None:
        del self._centralised[first:]
        for scan, transmitter in self.state.scans[first:]:
            before = self._centralised[-1] if self._centralised else self.state.begin
            self._centralised.append(self._step(before, scan, transmitter))

    def forget(self, time: float) -> None:
        """Nothing that is older than `MOST_LATE` at a time [s] can come any more."""
        old = [scan.time < time - MOST_LATE for scan, _ in self.state.scans].count(True)
        if old:
            self.state.begin = self._centralised[old - 1]
            del self.state.scans[:old], self._centralised[:old]

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on from a `memory`; what the scans show is worked out again."""
        super().restore(memory)
        self._replay(0)

    @property
    def latest(self) -> JointState:
        """After the latest scan."""
        return self._centralised[-1] if self._centralised else self.state.begin

    def at(self, time: float, known: Mapping[str, Gaussian] | None = None) -> list[Fused]:
        """The confirmed UAVs at a time [s].

        Parameters
        ----------
        known : what terminals say of themselves, at that time
        """
        joint = self._alive(self._predicted(self.latest, time))
        sure = [k for k, uav in enumerate(joint.uavs) if uav.confirmed]
        pairs = [self._marginal(joint, k) for k in sure]
        states = [Gaussian(m[:SIZE], P[:SIZE, :SIZE]) for m, P in pairs]
        whose = recognise(states, known or {})
        return [
            Fused(
                joint.uavs[k].name,
                in_datum(state),
                tuple(Key(origin, number) for origin, (number, _) in joint.uavs[k].fed.items()),
                terminal,
            )
            for k, state, terminal in zip(sure, states, whose, strict=True)
        ]

    def names_of(self, scan: Scan) -> tuple[Name | None, ...]:
        """By which it knows the UAVs of a scan's detections."""
        fed = {
            Key(origin, number): uav.name
            for uav in self.latest.uavs
            for origin, (number, _) in uav.fed.items()
        }
        return tuple(fed.get(Key(scan.origin, int(n))) for n in scan.numbers)

    def _first(self, joint: JointState, k: int) -> int:
        return POSE * len(self._terminals) + len(joint.clocks) + UAV_STATES * k

    def _marginal(self, joint: JointState, k: int) -> tuple[np.ndarray, np.ndarray]:
        at = slice(self._first(joint, k), self._first(joint, k) + UAV_STATES)
        return joint.mean[at], joint.covariance[at, at]

    def _predicted(self, joint: JointState, time: float) -> JointState:
        """At a later time."""
        interval = time - joint.time
        if not np.isfinite(interval) or interval <= 0:
            return replace(joint, time=time) if interval else joint
        F, Q = singer(interval, self._settings.acceleration_std_mps2)
        kept = np.exp(-interval / ERROR_TIME)
        count, terminals, clocks = len(joint.uavs), len(self._terminals), len(joint.clocks)
        drift = np.tile(_error_variance() * (1 - kept**2), terminals)
        stays = np.append(np.full(POSE * terminals, kept), np.ones(clocks))
        step = block_diag(np.diag(stays), *[F] * count)
        noise = block_diag(np.diag(np.append(drift, np.zeros(clocks))), *[Q] * count)
        P = step @ joint.covariance @ step.T + noise
        return replace(joint, time=time, mean=step @ joint.mean, covariance=(P + P.T) / 2)

    def _alive(self, joint: JointState) -> JointState:
        """Without the UAVs whose time is over."""
        management, removed = self._lives, set[int]()
        for k, uav in enumerate(joint.uavs):
            longest = management.drop if uav.confirmed else management.window
            if joint.time - uav.hits[-1] > longest - ROUNDING:
                removed.add(k)
        return joint.without(removed) if removed else joint

    def _step(self, joint: JointState, scan: Scan, transmitter: np.ndarray | None) -> JointState:
        """One scan: prediction, association, update, initiation, merging of tracks of one UAV."""
        joint = self._alive(self._predicted(joint, scan.time))
        joint = self._with_clock(joint, scan)
        clocks = [*joint.clocks]
        clock = self._first(joint, 0) - len(clocks)
        view = _View(
            scan,
            transmitter,
            self._terminals,
            clock + clocks.index(scan.origin) if scan.origin in clocks else None,
        )
        free = list(range(len(scan)))
        for confirmed in (True, False):
            rows = [k for k, uav in enumerate(joint.uavs) if uav.confirmed is confirmed]
            cost = self._costs(joint, view, rows, free)
            pairs = [(rows[i], free[j]) for i, j in assign(cost)]
            for k, q in pairs:
                joint = self._update(joint, view, k, q)
            free = [q for q in free if q not in {q for _, q in pairs}]
        for q in free:
            if not self._strays(joint, scan, q):
                joint = self._born(joint, view, q)
        return _named_apart(self._merged(_kept(joint, scan)))

    def _with_clock(self, joint: JointState, scan: Scan) -> JointState:
        """With the deviation of its clocks that the scan states: what it has grown by counts as
        noise since the last one."""
        stated, at = scan.clock_std**2, self._first(joint, 0)
        if not stated and scan.origin not in joint.clocks:
            return joint
        mean, P = joint.mean, joint.covariance.copy()
        if scan.origin in joint.clocks:
            at += [*joint.clocks].index(scan.origin) - len(joint.clocks)
        else:
            mean = np.insert(mean, at, 0.0)
            P = np.insert(np.insert(P, at, 0.0, axis=0), at, 0.0, axis=1)
        before = joint.clocks.get(scan.origin, 0.0)
        P[at, at] += max(stated - before, 0.0)
        clocks = {**joint.clocks, scan.origin: max(stated, before)}
        return replace(joint, mean=mean, covariance=P, clocks=clocks)

    def _costs(
        self, joint: JointState, view: _View, rows: Sequence[int], free: Sequence[int]
    ) -> np.ndarray:
        """(rows, free) `costs`."""
        cost = np.full((len(rows), len(free)), np.inf)
        if not len(rows) or not len(free):
            return cost
        own, sender = view.corrected(joint.mean)
        z = view.scan.z[free]
        states = [self._marginal(joint, k) for k in rows]
        known = None if sender is None else Gaussian(sender, np.zeros((SIZE, SIZE)))
        means = np.stack([m for m, _ in states])
        z_mean, S = expected(means, np.stack([P for _, P in states]), own, known)
        z_mean[:, 0] += view.clock(joint.mean)
        for i in range(len(rows)):
            H = np.zeros((4, len(joint.mean)))
            view.errors_into(H, means[i], own, sender)
            S[i] += H @ joint.covariance @ H.T
        probability = self._settings.gate_probability
        return costs(z, view.scan.std[free], z_mean, S, self._ambiguity(view), probability)

    def _ambiguity(self, view: _View) -> Ambiguity:
        return self._ambiguities[0 if view.transmitter is None else 1]

    def _update(self, joint: JointState, view: _View, k: int, q: int) -> JointState:
        """Condition all states on one detection of a UAV: an iterated EKF in Joseph's form."""
        first = self._first(joint, k)
        at = slice(first, first + UAV_STATES)
        z, std = view.scan.z[q], np.fmax(view.scan.std[q], STD_FLOOR)
        seen = np.flatnonzero(np.isfinite(z))
        R = np.diag(std[seen] ** 2)

        def shown(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            own, sender = view.corrected(x)
            H = np.zeros((4, len(x)))
            H[:, at] = jacobian(x[at], own, sender)
            view.errors_into(H, x[at], own, sender)
            off = wrapped(z - view.measured(x, x[at], own, sender), self._ambiguity(view))
            return off[seen], H[seen]

        x, P = conditioned(Gaussian(joint.mean, joint.covariance), R, shown)
        uav = self._fed(joint.uavs[k], view.scan, q)
        uavs = (*joint.uavs[:k], uav, *joint.uavs[k + 1 :])
        return replace(joint, mean=x, covariance=P, uavs=uavs)

    def _fed(self, uav: TrackedUav, scan: Scan, q: int) -> TrackedUav:
        """A UAV after one more detection: its track, and the earliest name that is known of it."""
        management, name = self._lives, scan.names[q]
        hits = tuple(
            sorted(
                {*(t for t in uav.hits if scan.time - t < management.window - ROUNDING), scan.time}
            )
        )
        fed = {o: v for o, v in uav.fed.items() if scan.time - v[1] < management.drop}
        return replace(
            uav,
            name=uav.name if name is None else min(uav.name, name),
            hits=hits,
            fed=fed | {scan.origin: (int(scan.numbers[q]), scan.time)},
            confirmed=uav.confirmed
            or bool(scan.sure[q])
            or (len(hits) >= management.hits and len({*fed, scan.origin}) > 1),
        )

    def _strays(self, joint: JointState, scan: Scan, q: int) -> bool:
        """Return whether the track of a detection that no target explains fed one lately: it is an
        outlier, and no target of its own unless this goes on."""
        feeds = [uav.fed.get(scan.origin, (None, -np.inf)) for uav in joint.uavs]
        mine = [time for number, time in feeds if number == int(scan.numbers[q])]
        return any(scan.time - time < self._lives.window for time in mine)

    def _born(self, joint: JointState, view: _View, q: int) -> JointState:
        """One more body, from a detection that no other explains; its position has the terminal's
        errors with the opposite sign."""
        own, sender = view.corrected(joint.mean)
        known = None if sender is None else Gaussian(sender, np.zeros((SIZE, SIZE)))
        z, scan = view.scan.z[q], view.scan
        made = initiate(
            z,
            scan.std[q],
            own,
            known,
            acceleration_std=self._settings.acceleration_std_mps2,
            ambiguity=self._ambiguity(view),
        )
        if made is None:
            return joint
        size = len(joint.mean)
        H = np.zeros((4, size))
        view.errors_into(H, made.mean, own, sender)
        J = jacobian(made.mean, own, sender)[POSITION, :3]
        D = np.zeros((UAV_STATES, size))
        D[:3] = -np.linalg.solve(J, H[POSITION])
        P = np.zeros((size + UAV_STATES, size + UAV_STATES))
        P[:size, :size] = joint.covariance
        P[size:, :size] = D @ joint.covariance
        P[:size, size:] = P[size:, :size].T
        P[size:, size:] = made.covariance + D @ joint.covariance @ D.T
        born = Name(scan.time, scan.origin, int(scan.numbers[q]))
        uav = self._fed(TrackedUav(born, born, (), {}), scan, q)
        mean = np.append(joint.mean, made.mean)
        return replace(joint, mean=mean, covariance=P, uavs=(*joint.uavs, uav))

    def _merged(self, joint: JointState) -> JointState:
        """Two UAVs in one place that no receiver saw in one frame are one: the surer stays."""
        first, removed = self._first(joint, 0), set[int]()
        uavs = list(joint.uavs)
        for i in range(len(uavs)):
            for j in range(i):
                if {i, j} & removed or _distinct(uavs[i], uavs[j]):
                    continue
                if not uavs[i].confirmed or not uavs[j].confirmed:
                    continue
                a, b = (first + UAV_STATES * k + np.arange(SIZE) for k in (i, j))
                C = joint.covariance
                S = C[np.ix_(a, a)] + C[np.ix_(b, b)] - C[np.ix_(a, b)] - C[np.ix_(b, a)]
                d = joint.mean[a] - joint.mean[b]
                if d @ np.linalg.solve(S + 1e-9 * np.eye(SIZE), d) > gate(JOIN_PROBABILITY):
                    continue
                worse = i if np.trace(C[np.ix_(a, a)]) > np.trace(C[np.ix_(b, b)]) else j
                kept = i + j - worse
                uavs[kept] = replace(
                    uavs[kept],
                    name=min(uavs[i].name, uavs[j].name),
                    hits=tuple(sorted({*uavs[i].hits, *uavs[j].hits})),
                    fed={**uavs[worse].fed, **uavs[kept].fed},
                )
                removed.add(worse)
        return replace(joint, uavs=tuple(uavs)).without(removed) if removed else joint


@dataclass(frozen=True)
class _View:
    """A scan with what says where its ends are, and which state its clocks have; None: they are
    right."""

    scan: Scan
    transmitter: np.ndarray | None
    terminals: list[str]
    clock_state: int | None = None

    def _at(self, name: str) -> int:
        return POSE * self.terminals.index(name)

    def corrected(self, x: np.ndarray) -> tuple[Pose, np.ndarray | None]:
        """The receiver's pose and the transmitter's state (6,) without the errors that are known of
        them."""
        tx, rx = self.scan.ends
        at, own = self._at(rx), self.scan.own
        attitude_error = Rotation.from_rotvec(-x[at + 6 : at + 9]).as_matrix()
        pose = replace(
            own,
            position=own.position - x[at : at + 3],
            velocity=own.velocity - x[at + 3 : at + 6],
            rotation=attitude_error @ own.rotation,
        )
        if self.transmitter is None:
            return pose, None
        other = self._at(tx)
        return pose, self.transmitter - x[other : other + SIZE]

    def clock(self, x: np.ndarray) -> float:
        """Return what the link's clocks add to its ranges [m]."""
        return 0.0 if self.clock_state is None else float(x[self.clock_state])

    def measured(
        self, x: np.ndarray, uav: np.ndarray, own: Pose, sender: np.ndarray | None
    ) -> np.ndarray:
        """Return the measurement of a target (4,)."""
        z = measure(uav, own, sender)
        z[0] += self.clock(x)
        return z

    def errors_into(
        self, H: np.ndarray, uav: np.ndarray, own: Pose, sender: np.ndarray | None
    ) -> None:
        """Write the derivative of what is measured with respect to the errors of both ends into
        H (4, states)."""
        tx, rx = self.scan.ends
        at = self._at(rx)
        H[:, at : at + SIZE] += jacobian(uav, own)[:, :SIZE]
        away = uav[:3] - own.position
        e = away / np.linalg.norm(away)
        H[2:, at + 6 : at + 9] = -(own.rotation.T @ cross(e))[[0, 2]]
        if self.clock_state is not None:
            H[0, self.clock_state] = 1.0
        if sender is not None:
            other = self._at(tx)
            H[:, other : other + SIZE] -= transmitter_jacobian(uav, sender)[:, :SIZE]


def _error_variance() -> np.ndarray:
    """(`POSE`,) variances of the errors of a terminal's pose."""
    deviations = [*[POSE_STD[0]] * 3, *[POSE_STD[1]] * 3, *[ATTITUDE_STD] * 3]
    return np.square(deviations)


def _distinct(a: TrackedUav, b: TrackedUav) -> bool:
    """Return whether a receiver saw both in one frame."""
    return any(of[1] == b.fed[link][1] for link, of in a.fed.items() if link in b.fed)


def _kept(joint: JointState, scan: Scan) -> JointState:
    """Without the UAVs that rest on nothing but tracks that the scan's receiver has given up."""
    uavs, removed = list(joint.uavs), set[int]()
    for k, uav in enumerate(uavs):
        if uav.fed.get(scan.origin, (None, 0.0))[0] in (None, *scan.kept):
            continue
        fed = {origin: of for origin, of in uav.fed.items() if origin != scan.origin}
        uavs[k] = replace(uav, fed=fed)
        if not fed:
            removed.add(k)
    return replace(joint, uavs=tuple(uavs)).without(removed)


def _named_apart(joint: JointState) -> JointState:
    """No two UAVs have one name: the one that has had it for longest keeps it."""
    holder: set[Name] = set()
    uavs = []
    for uav in joint.uavs:
        if uav.name in holder:
            uav = replace(uav, name=uav.born)
        holder.add(uav.name)
        uavs.append(uav)
    return replace(joint, uavs=tuple(uavs))
