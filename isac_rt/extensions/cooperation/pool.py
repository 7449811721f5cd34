"""One filter of the detections of several terminals, with the errors of their poses and clocks as
states beside the bodies.

The covariance of all of it is kept together, so that what an error does to one body shows in the
others. Detections may come late: the filter goes back to their time and takes up what followed
again, so that its picture does not depend on the order in which they came.
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
    STD_FLOOR,
    Ambiguity,
    Gaussian,
    birth,
    conditioned,
    costs,
    expected,
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

BODY = 9
"""States of a body."""
POSE = ERRORS - 1
"""Those of a terminal are the errors of its pose [m, m/s, rad]; each link has one of its clocks."""
ERROR_TIME = 10.0
"""Correlation time of a terminal's errors [s]: satellites and inertial sensors drift in seconds to
minutes. A clock's error stays, and grows as looks state."""
MOST_LATE = 0.5
"""Detections that come later count for nothing [s]."""
_POSITION = np.array([0, 2, 3])


@dataclass(frozen=True)
class Look:
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
    names : by which the terminal knows the bodies, None: by none
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

    def select(self, rows: np.ndarray) -> Look:
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
class Body:
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
class Pool:
    """All states at a time: `POSE` of each terminal, one of the clocks of each link that states
    that they may be off, then `BODY` of each body; `clocks` is the variance of ranges by a link's
    clocks that its looks have stated [m^2]."""

    time: float
    mean: np.ndarray
    covariance: np.ndarray
    bodies: tuple[Body, ...] = ()
    clocks: Mapping[str, float] = field(default_factory=dict)

    def without(self, gone: set[int]) -> Pool:
        """The same without some bodies."""
        first = len(self.mean) - BODY * len(self.bodies)
        keep = [k for k in range(len(self.bodies)) if k not in gone]
        rows = [np.arange(first), *(first + BODY * k + np.arange(BODY) for k in keep)]
        at = np.concatenate(rows)
        bodies = tuple(self.bodies[k] for k in keep)
        covariance = self.covariance[np.ix_(at, at)]
        return replace(self, mean=self.mean[at], covariance=covariance, bodies=bodies)


@dataclass(frozen=True)
class Lives:
    """When bodies begin and end.

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
    def of(cls, s: Tracking, period: float) -> Lives:
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

    begin: Pool
    looks: list[tuple[Look, np.ndarray | None]] = field(default_factory=list)


class PooledTracker(Stateful):
    """The picture that a listener makes of all detections that it knows.

    Parameters
    ----------
    terminals : names of all that detect
    settings : Tracking
    lives : when bodies begin and end
    ambiguities : what detections of an active and of a passive terminal leave open
    """

    def __init__(
        self,
        terminals: Sequence[str],
        settings: Tracking,
        lives: Lives,
        ambiguities: tuple[Ambiguity, Ambiguity],
    ) -> None:
        self._terminals, self._settings, self._lives = list(terminals), settings, lives
        self._ambiguities = ambiguities
        variance = np.tile(_error_variance(), len(self._terminals))
        self.state = _Known(Pool(-np.inf, np.zeros(variance.size), np.diag(variance)))
        self._pools: list[Pool] = []

    def add(self, look: Look, transmitter: np.ndarray | None) -> bool:
        """Take up detections; whether they came in time.

        Parameters
        ----------
        transmitter : (6,) what the transmitter says of its position and velocity then, of a passive
            terminal's detections
        """
        if look.time <= self.state.begin.time:
            return False
        at = bisect([one.key for one, _ in self.state.looks], look.key)
        self.state.looks.insert(at, (look, transmitter))
        self._replay(at)
        return True

    def _replay(self, first: int) -> None:
        del self._pools[first:]
        for look, transmitter in self.state.looks[first:]:
            before = self._pools[-1] if self._pools else self.state.begin
            self._pools.append(self._step(before, look, transmitter))

    def forget(self, time: float) -> None:
        """Nothing that is older than `MOST_LATE` at a time [s] can come any more."""
        old = [look.time < time - MOST_LATE for look, _ in self.state.looks].count(True)
        if old:
            self.state.begin = self._pools[old - 1]
            del self.state.looks[:old], self._pools[:old]

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on from a `memory`; what the looks show is worked out again."""
        super().restore(memory)
        self._replay(0)

    @property
    def latest(self) -> Pool:
        """After the latest look."""
        return self._pools[-1] if self._pools else self.state.begin

    def at(self, time: float, known: Mapping[str, Gaussian] | None = None) -> list[Fused]:
        """The confirmed bodies at a time [s].

        Parameters
        ----------
        known : what terminals say of themselves, at that time
        """
        pool = self._alive(self._predicted(self.latest, time))
        sure = [k for k, body in enumerate(pool.bodies) if body.confirmed]
        pairs = [self._marginal(pool, k) for k in sure]
        states = [Gaussian(m[:SIZE], P[:SIZE, :SIZE]) for m, P in pairs]
        whose = recognise(states, known or {})
        return [
            Fused(
                pool.bodies[k].name,
                in_datum(state),
                tuple(Key(origin, number) for origin, (number, _) in pool.bodies[k].fed.items()),
                terminal,
            )
            for k, state, terminal in zip(sure, states, whose, strict=True)
        ]

    def names_of(self, look: Look) -> tuple[Name | None, ...]:
        """By which it knows the bodies of a look's detections."""
        fed = {
            Key(origin, number): body.name
            for body in self.latest.bodies
            for origin, (number, _) in body.fed.items()
        }
        return tuple(fed.get(Key(look.origin, int(n))) for n in look.numbers)

    def _first(self, pool: Pool, k: int) -> int:
        return POSE * len(self._terminals) + len(pool.clocks) + BODY * k

    def _marginal(self, pool: Pool, k: int) -> tuple[np.ndarray, np.ndarray]:
        at = slice(self._first(pool, k), self._first(pool, k) + BODY)
        return pool.mean[at], pool.covariance[at, at]

    def _predicted(self, pool: Pool, time: float) -> Pool:
        """At a later time."""
        interval = time - pool.time
        if not np.isfinite(interval) or interval <= 0:
            return replace(pool, time=time) if interval else pool
        F, Q = singer(interval, self._settings.acceleration_std_mps2)
        kept = np.exp(-interval / ERROR_TIME)
        count, terminals, clocks = len(pool.bodies), len(self._terminals), len(pool.clocks)
        drift = np.tile(_error_variance() * (1 - kept**2), terminals)
        stays = np.append(np.full(POSE * terminals, kept), np.ones(clocks))
        step = block_diag(np.diag(stays), *[F] * count)
        noise = block_diag(np.diag(np.append(drift, np.zeros(clocks))), *[Q] * count)
        P = step @ pool.covariance @ step.T + noise
        return replace(pool, time=time, mean=step @ pool.mean, covariance=(P + P.T) / 2)

    def _alive(self, pool: Pool) -> Pool:
        """Without the bodies whose time is over."""
        lives, gone = self._lives, set[int]()
        for k, body in enumerate(pool.bodies):
            longest = lives.drop if body.confirmed else lives.window
            if pool.time - body.hits[-1] > longest - ROUNDING:
                gone.add(k)
        return pool.without(gone) if gone else pool

    def _step(self, pool: Pool, look: Look, transmitter: np.ndarray | None) -> Pool:
        """One look: prediction, association, updates, births, and what is one body."""
        pool = self._alive(self._predicted(pool, look.time))
        pool = self._with_clock(pool, look)
        clocks = [*pool.clocks]
        clock = self._first(pool, 0) - len(clocks)
        view = _View(
            look,
            transmitter,
            self._terminals,
            clock + clocks.index(look.origin) if look.origin in clocks else None,
        )
        free = list(range(len(look)))
        for confirmed in (True, False):
            rows = [k for k, body in enumerate(pool.bodies) if body.confirmed is confirmed]
            cost = self._costs(pool, view, rows, free)
            pairs = [(rows[i], free[j]) for i, j in assign(cost)]
            for k, q in pairs:
                pool = self._update(pool, view, k, q)
            free = [q for q in free if q not in {q for _, q in pairs}]
        for q in free:
            if not self._strays(pool, look, q):
                pool = self._born(pool, view, q)
        return _named_apart(self._merged(_kept(pool, look)))

    def _with_clock(self, pool: Pool, look: Look) -> Pool:
        """With the deviation of its clocks that the look states: what it has grown by counts as
        noise since the last one."""
        stated, at = look.clock_std**2, self._first(pool, 0)
        if not stated and look.origin not in pool.clocks:
            return pool
        mean, P = pool.mean, pool.covariance.copy()
        if look.origin in pool.clocks:
            at += [*pool.clocks].index(look.origin) - len(pool.clocks)
        else:
            mean = np.insert(mean, at, 0.0)
            P = np.insert(np.insert(P, at, 0.0, axis=0), at, 0.0, axis=1)
        before = pool.clocks.get(look.origin, 0.0)
        P[at, at] += max(stated - before, 0.0)
        clocks = {**pool.clocks, look.origin: max(stated, before)}
        return replace(pool, mean=mean, covariance=P, clocks=clocks)

    def _costs(
        self, pool: Pool, view: _View, rows: Sequence[int], free: Sequence[int]
    ) -> np.ndarray:
        """(rows, free) `costs`."""
        cost = np.full((len(rows), len(free)), np.inf)
        if not len(rows) or not len(free):
            return cost
        own, sender = view.corrected(pool.mean)
        z = view.look.z[free]
        states = [self._marginal(pool, k) for k in rows]
        known = None if sender is None else Gaussian(sender, np.zeros((SIZE, SIZE)))
        means = np.stack([m for m, _ in states])
        z_mean, S = expected(means, np.stack([P for _, P in states]), own, known)
        z_mean[:, 0] += view.clock(pool.mean)
        for i in range(len(rows)):
            H = np.zeros((4, len(pool.mean)))
            view.errors_into(H, means[i], own, sender)
            S[i] += H @ pool.covariance @ H.T
        probability = self._settings.gate_probability
        return costs(z, view.look.std[free], z_mean, S, self._ambiguity(view), probability)

    def _ambiguity(self, view: _View) -> Ambiguity:
        return self._ambiguities[0 if view.transmitter is None else 1]

    def _update(self, pool: Pool, view: _View, k: int, q: int) -> Pool:
        """Condition all states on one detection of a body: an iterated EKF in Joseph's form."""
        first = self._first(pool, k)
        at = slice(first, first + BODY)
        z, std = view.look.z[q], np.fmax(view.look.std[q], STD_FLOOR)
        seen = np.flatnonzero(np.isfinite(z))
        R = np.diag(std[seen] ** 2)

        def shown(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            own, sender = view.corrected(x)
            H = np.zeros((4, len(x)))
            H[:, at] = jacobian(x[at], own, sender)
            view.errors_into(H, x[at], own, sender)
            off = wrapped(z - view.measured(x, x[at], own, sender), self._ambiguity(view))
            return off[seen], H[seen]

        x, P = conditioned(Gaussian(pool.mean, pool.covariance), R, shown)
        body = self._fed(pool.bodies[k], view.look, q)
        bodies = (*pool.bodies[:k], body, *pool.bodies[k + 1 :])
        return replace(pool, mean=x, covariance=P, bodies=bodies)

    def _fed(self, body: Body, look: Look, q: int) -> Body:
        """A body after one more detection: its track, and the earliest name that is known of it."""
        lives, name = self._lives, look.names[q]
        hits = tuple(
            sorted({*(t for t in body.hits if look.time - t < lives.window - ROUNDING), look.time})
        )
        fed = {o: v for o, v in body.fed.items() if look.time - v[1] < lives.drop}
        return replace(
            body,
            name=body.name if name is None else min(body.name, name),
            hits=hits,
            fed=fed | {look.origin: (int(look.numbers[q]), look.time)},
            confirmed=body.confirmed
            or bool(look.sure[q])
            or (len(hits) >= lives.hits and len({*fed, look.origin}) > 1),
        )

    def _strays(self, pool: Pool, look: Look, q: int) -> bool:
        """Return whether the track of a detection that no target explains fed one lately: it is an
        outlier, and no target of its own unless this goes on."""
        feeds = [body.fed.get(look.origin, (None, -np.inf)) for body in pool.bodies]
        mine = [time for number, time in feeds if number == int(look.numbers[q])]
        return any(look.time - time < self._lives.window for time in mine)

    def _born(self, pool: Pool, view: _View, q: int) -> Pool:
        """One more body, from a detection that no other explains; its position has the terminal's
        errors with the opposite sign."""
        own, sender = view.corrected(pool.mean)
        known = None if sender is None else Gaussian(sender, np.zeros((SIZE, SIZE)))
        z, look = view.look.z[q], view.look
        made = birth(
            z,
            look.std[q],
            own,
            known,
            acceleration_std=self._settings.acceleration_std_mps2,
            ambiguity=self._ambiguity(view),
        )
        if made is None:
            return pool
        size = len(pool.mean)
        H = np.zeros((4, size))
        view.errors_into(H, made.mean, own, sender)
        J = jacobian(made.mean, own, sender)[_POSITION, :3]
        D = np.zeros((BODY, size))
        D[:3] = -np.linalg.solve(J, H[_POSITION])
        P = np.zeros((size + BODY, size + BODY))
        P[:size, :size] = pool.covariance
        P[size:, :size] = D @ pool.covariance
        P[:size, size:] = P[size:, :size].T
        P[size:, size:] = made.covariance + D @ pool.covariance @ D.T
        born = Name(look.time, look.origin, int(look.numbers[q]))
        body = self._fed(Body(born, born, (), {}), look, q)
        mean = np.append(pool.mean, made.mean)
        return replace(pool, mean=mean, covariance=P, bodies=(*pool.bodies, body))

    def _merged(self, pool: Pool) -> Pool:
        """Two bodies in one place that no receiver saw in one frame are one: the surer stays."""
        first, gone = self._first(pool, 0), set[int]()
        bodies = list(pool.bodies)
        for i in range(len(bodies)):
            for j in range(i):
                if {i, j} & gone or _apart(bodies[i], bodies[j]):
                    continue
                if not bodies[i].confirmed or not bodies[j].confirmed:
                    continue
                a, b = (first + BODY * k + np.arange(SIZE) for k in (i, j))
                C = pool.covariance
                S = C[np.ix_(a, a)] + C[np.ix_(b, b)] - C[np.ix_(a, b)] - C[np.ix_(b, a)]
                apart = pool.mean[a] - pool.mean[b]
                if apart @ np.linalg.solve(S + 1e-9 * np.eye(SIZE), apart) > gate(JOIN_PROBABILITY):
                    continue
                worse = i if np.trace(C[np.ix_(a, a)]) > np.trace(C[np.ix_(b, b)]) else j
                kept = i + j - worse
                bodies[kept] = replace(
                    bodies[kept],
                    name=min(bodies[i].name, bodies[j].name),
                    hits=tuple(sorted({*bodies[i].hits, *bodies[j].hits})),
                    fed={**bodies[worse].fed, **bodies[kept].fed},
                )
                gone.add(worse)
        return replace(pool, bodies=tuple(bodies)).without(gone) if gone else pool


@dataclass(frozen=True)
class _View:
    """A look with what says where its ends are, and which state its clocks have; None: they are
    right."""

    look: Look
    transmitter: np.ndarray | None
    terminals: list[str]
    clock_state: int | None = None

    def _at(self, name: str) -> int:
        return POSE * self.terminals.index(name)

    def corrected(self, x: np.ndarray) -> tuple[Pose, np.ndarray | None]:
        """The receiver's pose and the transmitter's state (6,) without the errors that are known of
        them."""
        tx, rx = self.look.ends
        at, own = self._at(rx), self.look.own
        turn = Rotation.from_rotvec(-x[at + 6 : at + 9]).as_matrix()
        pose = replace(
            own,
            position=own.position - x[at : at + 3],
            velocity=own.velocity - x[at + 3 : at + 6],
            rotation=turn @ own.rotation,
        )
        if self.transmitter is None:
            return pose, None
        other = self._at(tx)
        return pose, self.transmitter - x[other : other + SIZE]

    def clock(self, x: np.ndarray) -> float:
        """Return what the link's clocks add to its ranges [m]."""
        return 0.0 if self.clock_state is None else float(x[self.clock_state])

    def measured(
        self, x: np.ndarray, body: np.ndarray, own: Pose, sender: np.ndarray | None
    ) -> np.ndarray:
        """Return the measurement of a target (4,)."""
        z = measure(body, own, sender)
        z[0] += self.clock(x)
        return z

    def errors_into(
        self, H: np.ndarray, body: np.ndarray, own: Pose, sender: np.ndarray | None
    ) -> None:
        """Write the derivative of what is measured with respect to the errors of both ends into
        H (4, states)."""
        tx, rx = self.look.ends
        at = self._at(rx)
        H[:, at : at + SIZE] += jacobian(body, own)[:, :SIZE]
        away = body[:3] - own.position
        e = away / np.linalg.norm(away)
        H[2:, at + 6 : at + 9] = -(own.rotation.T @ cross(e))[[0, 2]]
        if self.clock_state is not None:
            H[0, self.clock_state] = 1.0
        if sender is not None:
            other = self._at(tx)
            H[:, other : other + SIZE] -= transmitter_jacobian(body, sender)[:, :SIZE]


def _error_variance() -> np.ndarray:
    """(`POSE`,) variances of the errors of a terminal's pose."""
    deviations = [*[POSE_STD[0]] * 3, *[POSE_STD[1]] * 3, *[ATTITUDE_STD] * 3]
    return np.square(deviations)


def _apart(a: Body, b: Body) -> bool:
    """Return whether a receiver saw both in one frame."""
    return any(of[1] == b.fed[link][1] for link, of in a.fed.items() if link in b.fed)


def _kept(pool: Pool, look: Look) -> Pool:
    """Without the bodies that rest on nothing but tracks that the look's receiver has given up."""
    bodies, gone = list(pool.bodies), set[int]()
    for k, body in enumerate(bodies):
        if body.fed.get(look.origin, (None, 0.0))[0] in (None, *look.kept):
            continue
        fed = {origin: of for origin, of in body.fed.items() if origin != look.origin}
        bodies[k] = replace(body, fed=fed)
        if not fed:
            gone.add(k)
    return replace(pool, bodies=tuple(bodies)).without(gone)


def _named_apart(pool: Pool) -> Pool:
    """No two bodies have one name: the one that has had it for longest keeps it."""
    holder: set[Name] = set()
    bodies = []
    for body in pool.bodies:
        if body.name in holder:
            body = replace(body, name=body.born)
        holder.add(body.name)
        bodies.append(body)
    return replace(pool, bodies=tuple(bodies))
