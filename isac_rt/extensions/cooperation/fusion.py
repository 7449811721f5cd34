"""One set of fused tracks from the tracks of several terminals: which of them are one UAV, what
they say of it together, and its name in the whole swarm.

A terminal is wrong about its own pose and clock, and so about all its tracks alike. These errors
are states beside the UAVs: what two terminals see, and what they say of themselves, tells them,
and that helps all other UAVs. What else tracks have in common is not known: they follow the same
manoeuvres, and may rest on one transmitter's pose. Covariance intersection is consistent whatever
it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import gammaincinv

from isac_rt.plain import Stateful
from isac_rt.track.filter import Gaussian, mahalanobis, singer
from isac_rt.track.fused import Fused, Key, Name
from isac_rt.track.parts import POSE_STD
from isac_rt.track.tracker import TrackSet, assign
from isac_rt.world.swarm import Pose

MIN_SEPARATION_M = 0.5
"""UAVs keep farther from each other than this [m]: tracks part beyond twice this."""
SIZE = 6
"""Position and velocity in world axes [m, m/s]: what terminals tell each other of a UAV."""
DATUM_STD = (0.05, 0.05)
"""And of what all terminals are wrong alike, for they receive the same satellites [m, m/s]: nothing
that they tell each other shows it, and all UAVs of a set of fused tracks have it."""
_DATUM = np.diag(np.repeat(np.square(DATUM_STD), 3))
ATTITUDE_STD = np.radians(0.3)
"""Deviation of a terminal's attitude about each axis [rad]: across the line of sight, times the
range, it adds to what it says of others. Small inertial sensors with two antennas hold it."""
ERRORS = 10
"""Errors of a terminal: of its position, velocity and attitude, and of its ranges by its clock."""
OWN_NOISE = 1e-3
"""What is left of a terminal's word of itself without the errors of its pose: rounding [m, m/s]."""
JOIN_PROBABILITY = 0.99
SPLIT_PROBABILITY = 1 - 1e-6
"""Two tracks are joined within the first gate and parted beyond the second, so that noise does not
join and part them in turns."""

MASKED_CELLS = 3.0
"""An echo that comes no more range cells than this behind a passive terminal's line of sight is
pushed away from it: by the line's sidelobes, and by what is left where these were taken out."""
PULL = 0.5
"""Range cells of that push. It is alike from frame to frame, so that a track's own deviation knows
nothing of it. Near the line of sight a metre of path length moves a UAV by thirty and more."""
MOST_PULLED = 1e6
"""On the line of sight a metre moves it by infinitely many. So many say as much as that nothing is
known of it along its direction, and leave the digits of its covariance across it."""
SAME_M = 1e-9
"""Lengths that differ by less are the same [m]."""


class Reported(NamedTuple):
    """Reported target in world axes: its position and velocity (6,), covariance (6, 6) without the
    reporter's errors, and (6, `ERRORS`) the effect of these errors, one deviation each."""

    state: Gaussian
    lever: np.ndarray

    @property
    def whole(self) -> Gaussian:
        """The state with the errors of who tells."""
        return Gaussian(self.state.mean, self.state.covariance + self.lever @ self.lever.T)

    def after(self, interval: float, acceleration_std: float) -> Reported:
        """The same an interval [s] later."""
        lever = self.lever.copy()
        lever[:3] += interval * lever[3:]
        return Reported(advance(self.state, interval, acceleration_std), lever)


@dataclass(frozen=True)
class Report:
    """Report of a terminal about one of its tracks.

    Attributes
    ----------
    key : the track
    since : when it was confirmed [s]
    name : by which it knows the UAV
    time : that the state is of [s]
    state, lever : as in `Reported`; by default the errors of who tells do nothing
    """

    key: Key
    since: float
    name: Name
    time: float
    state: Gaussian
    lever: np.ndarray = field(default_factory=lambda: np.zeros((SIZE, ERRORS)))

    @property
    def own_name(self) -> Name:
        """The name that the track alone would give."""
        return Name(self.since, *self.key)

    @cached_property
    def whole(self) -> Gaussian:
        """The state with the errors of who tells."""
        return Reported(self.state, self.lever).whole


def at_once(reports: Iterable[Report], time: float, acceleration_std: float) -> list[Report]:
    """Reports at one time [s]: `Reported.after` of each."""
    some = list(reports)
    if not some:
        return []
    intervals = [time - report.time for report in some]
    still = np.eye(SIZE), np.zeros((SIZE, SIZE))
    moved = [_coasting(t, acceleration_std) if t else still for t in intervals]
    each = [(*r.state, r.lever, *of) for r, of in zip(some, moved, strict=True)]
    means, covariances, levers, *model = (np.array(of) for of in zip(*each, strict=True))
    F, Q = model
    levers[:, :3] += np.array(intervals)[:, None, None] * levers[:, 3:]
    means = (F @ means[..., None])[..., 0]
    covariances = F @ covariances @ np.swapaxes(F, 1, 2) + Q
    return [
        Report(r.key, r.since, r.name, time, Gaussian(*state), lever)
        for r, *state, lever in zip(some, means, covariances, levers, strict=True)
    ]


def advance(state: Gaussian, interval: float, acceleration_std: float) -> Gaussian:
    """Position and velocity (6,) after an interval [s] of Singer's model. The acceleration is not
    told: it is zero with `acceleration_std` [m/s^2] per axis."""
    if interval == 0:
        return state
    F, Q = _coasting(interval, acceleration_std)
    return Gaussian(F @ state.mean, F @ state.covariance @ F.T + Q)


@lru_cache(maxsize=64)
def _coasting(interval: float, acceleration_std: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition (6, 6) of `advance`, and what it adds to the covariance."""
    F, Q = singer(interval, acceleration_std)
    unknown = acceleration_std * F[:SIZE, SIZE:]
    return F[:SIZE, :SIZE].copy(), Q[:SIZE, :SIZE] + unknown @ unknown.T


def in_world(
    tracks: TrackSet, row: int, own: Pose, clock_std: float = 0.0, cell: float = 0.0
) -> Reported:
    """A track as it is told to others: its own covariance, and apart from it what the errors of the
    terminal do to it: of its position and velocity (`POSE_STD`), of its attitude (`ATTITUDE_STD`),
    which turns place and motion about the terminal, and of its clock (`clock_std`, the speed of
    light times the deviation of what is left of its offset [m]). Its own covariance has what the
    line of sight pulls, by the `cell` of ranges [m]."""
    baseline = np.zeros(0)
    if not tracks.is_reference[row] and tracks.is_reference.any():
        baseline = tracks.mean[tracks.is_reference.argmax(), :3]
    pulled, lever = _levers(tracks.mean[row], baseline, clock_std, cell)
    mean = tracks.mean[row] + np.concatenate([own.position, own.velocity])
    return Reported(Gaussian(mean, tracks.covariance[row] + np.outer(pulled, pulled)), lever)


def _levers(
    mean: np.ndarray, baseline: np.ndarray, clock_std: float, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the effect of the line of sight on a track (6,) and of its terminal's errors, (6,
    `ERRORS`); `baseline` (3,) is to a passive terminal's transmitter, (0,) where the track does not
    depend on it."""
    lever, pulled = np.zeros((SIZE, ERRORS)), np.zeros(SIZE)
    lever[:3, :3], lever[3:, 3:6] = POSE_STD[0] * np.eye(3), POSE_STD[1] * np.eye(3)
    lever[:3, 6:9], lever[3:, 6:9] = (
        -ATTITUDE_STD * cross(mean[:3]),
        -ATTITUDE_STD * cross(mean[3:]),
    )
    lever[:3, 9] = clock_std * _by_clock(mean[:3], baseline)
    pulled[:3] = PULL * cell * _by_length(mean[:3], baseline, MASKED_CELLS * cell)
    return pulled, lever


def _norm(x: np.ndarray) -> float:
    return float(np.linalg.norm(x))


def _by_length(offset: np.ndarray, baseline: np.ndarray, masked: float) -> np.ndarray:
    """Return the shift of a passive terminal's target (3,) per metre of path length.

    It moves along its direction. Zero if the way is more than `masked` [m] longer than the line of
    sight, and at an active terminal.
    """
    if not baseline.size:
        return np.zeros(3)
    rho = _norm(offset)
    length = rho + _norm(offset - baseline)
    if length - _norm(baseline) > masked:
        return np.zeros(3)
    u = offset / rho
    # of rho = (L^2 - d^2) / (2 (L - d.u)) by L; on the line of sight L = d.u
    apart_m = max(length - float(baseline @ u), (length - rho) / MOST_PULLED, SAME_M)
    return u * (length - rho) / apart_m


def _by_clock(offset: np.ndarray, baseline: np.ndarray) -> np.ndarray:
    """Return the shift of a target (3,) for each metre that a terminal's clock adds to its ranges:
    along its direction, by its path length and its reference's, which are both too long."""
    rho = _norm(offset)
    u = offset / rho
    if not baseline.size:
        return u
    d = _norm(baseline)
    length, ahead = rho + _norm(offset - baseline), baseline @ u
    if length - ahead < SAME_M:  # on the line of sight
        return u * (rho / d) ** 2
    # of rho = (L^2 - d^2) / (2 (L - d.u)), L and d both by one metre
    return u * (length - d - rho * (1 - ahead / d)) / (length - ahead)


def report_of(itself: Gaussian) -> Reported:
    """The same (`of_itself`) with the errors of its pose apart."""
    lever = np.zeros((SIZE, ERRORS))
    lever[range(SIZE), range(SIZE)] = np.repeat(POSE_STD, 3)
    return Reported(Gaussian(itself.mean, OWN_NOISE**2 * np.eye(SIZE)), lever)


def in_datum(state: Gaussian) -> Gaussian:
    """A UAV (6,) with what all terminals are wrong alike."""
    return Gaussian(state.mean, state.covariance + _DATUM)


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
    mean, P, _ = _intersection(*a, *b)
    return Gaussian(mean, P)


def _intersection(
    a: np.ndarray, of_a: np.ndarray, b: np.ndarray, of_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and covariance, of two, and the weight w of the first."""
    A, B = np.linalg.inv(of_a), np.linalg.inv(of_b)
    root = np.linalg.inv(np.linalg.cholesky((B + B.T) / 2))
    values, U = np.linalg.eigh(root @ ((A + A.T) / 2) @ root.T)
    V = root.T @ U
    lengths = np.sum(V**2, axis=0)

    def slope(w: float) -> float:
        return float(np.sum(lengths * (values - 1) / (w * values + 1 - w) ** 2))

    if slope(0.0) <= 0:
        w = 0.0
    elif slope(1.0) >= 0:
        w = 1.0
    else:
        w = brentq(slope, 0.0, 1.0, xtol=1e-15)
    P = (V / (w * values + 1 - w)) @ V.T
    return P @ (w * (A @ a) + (1 - w) * (B @ b)), P, w


def intersection_of(states: Sequence[Gaussian]) -> Gaussian:
    """Covariance intersection of one or more, one after the other, the surest first."""
    return states[0] if len(states) == 1 else _intersected(states)[0]


def _intersected(states: Sequence[Gaussian]) -> tuple[Gaussian, np.ndarray]:
    """And the weight of each in it."""
    if len(states) == 1:
        return states[0], np.ones(1)
    order = sorted(range(len(states)), key=lambda k: float(states[k].covariance.trace()))
    fused, weights = states[order[0]], np.ones(len(states))
    for at, k in enumerate(order[1:], 1):
        mean, P, w = _intersection(*fused, *states[k])
        fused = Gaussian(mean, P)
        weights[order[:at]] *= w
        weights[k] = 1 - w
    return fused, weights


def joint_states(
    uavs: Sequence[Sequence[Report]], itself: Mapping[int, tuple[str, Reported]]
) -> list[Gaussian]:
    r"""UAVs from their tracks, jointly with the errors of the terminals that tell of them.

    A track says :math:`y = b + L_y e + n` with the errors e of its terminal, one deviation each and
    independent of all else, and with its own error n. Of the n of one UAV the correlation is not
    known: each has the weight w of covariance intersection, which is consistent whatever it is. The
    information of all, of the errors' own and of what terminals say of themselves is added up:

    .. math:: \sum_y w_y A_y^T P_y^{-1} A_y + E + \sum_t B_t^T Q_t^{-1} B_t,\quad A_y = [I, L_y]

    Parameters
    ----------
    uavs : by body the reports of its tracks, all of one instant
    itself : by number of a UAV the terminal that it is, and what that one says of itself
    """
    if not uavs:
        return []
    owners = {name for name, _ in itself.values()}
    owners |= {_teller(report.key) for reports in uavs for report in reports}
    links = dict.fromkeys(report.key.origin for reports in uavs for report in reports)
    count = ERRORS - 1
    of_pose = {name: range(count * k, count * (k + 1)) for k, name in enumerate(sorted(owners))}
    size = count * len(of_pose)
    clock = {origin: size + k for k, origin in enumerate(links)}
    size += len(clock)
    words: list[tuple[int, list[int], Reported, float]] = []
    for k, reports in enumerate(uavs):
        _, weights = _intersected([report.whole for report in reports])
        for report, w in zip(reports, weights, strict=True):
            errors = [*of_pose[_teller(report.key)], clock[report.key.origin]]
            words.append((k, errors, Reported(report.state, report.lever), w))
    # no clock is in a terminal's word of itself
    words += [(k, [*of_pose[name], size], word, 1.0) for k, (name, word) in itself.items()]
    return _solved(len(uavs), size, words)


def _solved(
    num_uavs: int, num_errors: int, words: Sequence[tuple[int, list[int], Reported, float]]
) -> list[Gaussian]:
    """The UAVs of `joint_states`, whose information of each other is by way of the errors alone:
    the errors first, then each UAV.

    Parameters
    ----------
    words : a UAV's number, the numbers of the errors in what is told of it (`num_errors`: one that
        is in none), what is told, and its weight
    """
    numbers, errors, reports, weights = zip(*words, strict=True)
    given = [np.array(numbers), np.array(errors), np.array(weights, float)]
    states = [[t.state.mean for t in reports], [t.state.covariance for t in reports]]
    arrays = [np.array(of) for of in (*states, [t.lever for t in reports])]
    every = _solution(num_uavs, num_errors + 1, *given, *arrays)
    return [Gaussian(m, p) for m, p in zip(*every, strict=True)]


def _solution(
    num_uavs: int,
    num_errors: int,
    numbers: np.ndarray,
    errors: np.ndarray,
    weights: np.ndarray,
    means: np.ndarray,
    covariances: np.ndarray,
    levers: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances of the UAVs from W words, of which the last error is in none."""
    B, b = np.zeros((num_uavs, SIZE, SIZE)), np.zeros((num_uavs, SIZE))
    C = np.zeros((num_uavs, num_errors, SIZE))
    E, e = np.eye(num_errors), np.zeros(num_errors)
    A = np.concatenate([np.broadcast_to(np.eye(SIZE), (len(levers), SIZE, SIZE)), levers], axis=2)
    gain = weights[:, None, None] * np.swapaxes(np.linalg.solve(covariances, A), 1, 2)
    each, more = gain @ A, (gain @ means[..., None])[..., 0]
    np.add.at(B, numbers, each[:, :SIZE, :SIZE])
    np.add.at(b, numbers, more[:, :SIZE])
    np.add.at(e, errors, more[:, SIZE:])
    np.add.at(C, (numbers[:, None], errors), each[:, SIZE:, :SIZE])
    np.add.at(E, (errors[:, :, None], errors[:, None, :]), each[:, SIZE:, SIZE:])
    D, d = np.linalg.solve(B, np.swapaxes(C, 1, 2)), np.linalg.solve(B, b[..., None])[..., 0]
    E -= (C @ D).sum(axis=0)
    e -= (C @ d[..., None])[..., 0].sum(axis=0)
    rest = np.linalg.inv(E)
    P = np.linalg.inv(B) + D @ rest @ np.swapaxes(D, 1, 2)
    return d - D @ (rest @ e), (P + np.swapaxes(P, 1, 2)) / 2


def _teller(key: Key) -> str:
    """The terminal that tells of a track."""
    return key.origin.rpartition("->")[2]


def distances(
    a: Sequence[Gaussian], b: Sequence[Gaussian], probability: float
) -> tuple[np.ndarray, np.ndarray]:
    """(len(a), len(b)) squared Mahalanobis distances and ln det S, S = A + B; infinite both where
    the distance is outside the `gate`.

    What the errors have in common makes the true S smaller, so that this gate lets in more than
    its share.
    """
    if not len(a) or not len(b):
        return np.zeros((len(a), len(b))), np.zeros((len(a), len(b)))
    means = [np.array([g.mean for g in of]) for of in (a, b)]
    covariances = [np.array([g.covariance for g in of]) for of in (a, b)]
    y = means[0][:, None] - means[1][None]
    trace = covariances[0].trace(axis1=1, axis2=2)[:, None] + covariances[1].trace(axis1=1, axis2=2)
    most = gate(probability)
    i, j = np.nonzero((y**2).sum(axis=-1) <= most * trace)  # no variance is larger
    d2, log_det = np.full((2, *y.shape[:2]), np.inf)
    near, of_near = mahalanobis(y[i, j], covariances[0][i] + covariances[1][j])
    inside = near <= most
    d2[i[inside], j[inside]] = near[inside]
    log_det[i[inside], j[inside]] = of_near[inside]
    return d2, log_det


def cross(e: np.ndarray) -> np.ndarray:
    """(3, 3) matrix of the cross product with e from the left."""
    x, y, z = e
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@lru_cache(maxsize=8)
def gate(probability: float) -> float:
    """Squared distance within which two estimates of one UAV lie with a probability."""
    return float(2 * gammaincinv(SIZE / 2, probability))


@dataclass
class _FusedUav:
    name: Name
    members: list[Key]

    def origins(self) -> set[str]:
        return {key.origin for key in self.members}


@dataclass
class FusedTracks(Stateful):
    """Fused tracks of a listener over all tracks that it knows, with memory of which of them are
    one target, and its name."""

    uavs: list[_FusedUav] = field(default_factory=list)

    def update(
        self, reports: Iterable[Report], known: Mapping[str, Reported] | None = None
    ) -> list[Fused]:
        """The UAVs of one instant.

        Parameters
        ----------
        reports : all of that instant (`at_once`), one per track
        known : what terminals say of themselves (`report_of`), likewise
        """
        by_key = {report.key: report for report in reports}
        whole = {key: report.whole for key, report in by_key.items()}
        self._keep(whole, by_key)
        self._join(whole)
        self._unite(whole)
        self._call(by_key)
        known = known or {}
        states = [intersection_of([whole[k] for k in b.members]) for b in self.uavs]
        whose = recognise(states, {name: word.whole for name, word in known.items()})
        itself = {k: (name, known[name]) for k, name in enumerate(whose) if name is not None}
        if self.uavs:
            members = [[by_key[k] for k in b.members] for b in self.uavs]
            states = joint_states(members, itself)
        return [
            Fused(uav.name, in_datum(state), tuple(uav.members), terminal)
            for uav, state, terminal in zip(self.uavs, states, whose, strict=True)
        ]

    def _keep(self, whole: Mapping[Key, Gaussian], by_key: Mapping[Key, Report]) -> None:
        """UAVs of the tracks that are still there: those that have left their body, and new
        ones, stand alone."""
        kept, alone = [], dict.fromkeys(by_key)
        for uav in self.uavs:
            members = [key for key in uav.members if key in by_key]
            if not members:
                continue
            if len(members) == 1:
                uav.members = members
                kept.append(uav)
                del alone[members[0]]
                continue
            members.sort(key=lambda k: float(np.trace(whole[k].covariance)))
            surely = SPLIT_PROBABILITY
            d2, _ = distances([whole[members[0]]], [whole[k] for k in members], surely)
            surest = {k.origin: k for k in reversed(members)}
            gaps = [_gap(whole[k], whole[surest[k.origin]]) for k in members]
            uav.members = [
                k
                for k, d, gap in zip(members, d2[0], gaps, strict=True)
                if np.isfinite(d) and gap <= 2 * MIN_SEPARATION_M
            ]
            kept.append(uav)
            for key in uav.members:
                del alone[key]
        self.uavs = kept + [_FusedUav(by_key[key].name, [key]) for key in alone]

    def _join(self, whole: Mapping[Key, Gaussian]) -> None:
        """Tracks that stand alone join UAVs that their terminal has no track of, origin by
        origin: as many as the gate allows, of the greatest likelihood."""
        for origin in dict.fromkeys(key.origin for key in sorted(whole)):
            single = [b for b in self.uavs if len(b.members) == 1 and origin in b.origins()]
            others = [b for b in self.uavs if origin not in b.origins()]
            if not single:
                continue
            d2, log_det = distances(
                [intersection_of([whole[k] for k in b.members]) for b in others],
                [whole[b.members[0]] for b in single],
                JOIN_PROBABILITY,
            )
            for i, j in assign(d2 + log_det):
                others[i].members += single[j].members
                others[i].name = min(others[i].name, single[j].name)
                self.uavs.remove(single[j])

    def _unite(self, whole: Mapping[Key, Gaussian]) -> None:
        """UAVs of one terminal's tracks that lie nearer to each other than UAVs fly are one."""
        states = [intersection_of([whole[k] for k in b.members]) for b in self.uavs]
        d2, _ = distances(states, states, JOIN_PROBABILITY)
        merged: set[int] = set()
        for i, j in np.argwhere(np.tril(np.isfinite(d2), -1)).tolist():
            if {i, j} & merged:
                continue
            uav, other = self.uavs[i], self.uavs[j]
            pairs = product(uav.members, other.members)
            gaps = [_gap(whole[a], whole[b]) for a, b in pairs if a.origin == b.origin]
            if gaps and max(gaps) < MIN_SEPARATION_M:
                other.members += uav.members
                other.name = min(uav.name, other.name)
                merged.add(i)
        self.uavs = [b for i, b in enumerate(self.uavs) if i not in merged]

    def _call(self, by_key: Mapping[Key, Report]) -> None:
        """Names: the earliest that any member is known by; two UAVs never have the same. The one
        with the track that the name is of keeps it, else the one that had it before."""
        for uav in self.uavs:
            uav.name = min(uav.name, *(by_key[key].name for key in uav.members))
        holder: dict[Name, _FusedUav] = {}
        waiting = sorted(self.uavs, key=lambda b: Key(*b.name[1:]) not in b.members)
        for uav in waiting:
            if uav.name in holder:
                uav.name = min(by_key[key].own_name for key in uav.members)
            if uav.name in holder:  # by a UAV that lacks the track; it takes its own in its turn
                waiting.append(holder[uav.name])
            holder[uav.name] = uav


def _gap(a: Gaussian, b: Gaussian) -> float:
    """Distance of two places [m]."""
    return float(np.linalg.norm(a.mean[:3] - b.mean[:3]))


def recognise(states: Sequence[Gaussian], known: Mapping[str, Gaussian]) -> list[str | None]:
    """The terminal that each UAV is, by what terminals say of themselves."""
    whose: list[str | None] = [None] * len(states)
    names = list(known)
    d2, log_det = distances(list(known.values()), states, JOIN_PROBABILITY)
    for i, j in assign(d2 + log_det):
        whose[j] = names[i]
    return whose
