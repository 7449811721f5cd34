"""Association and management of tracks.

A track is the world position, velocity and acceleration of one UAV. The terminal that keeps it
knows its own pose, so what is reported is relative to it, and leaves the acceleration out. Names
outside, symbols inside: x, P mean and covariance; F, Q, H, R the model.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import dist
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from isac_rt.plain import Stateful
from isac_rt.receive.types import Detections, Prediction
from isac_rt.track import existence
from isac_rt.track.filter import (
    Ambiguity,
    Gaussian,
    costs,
    curvature,
    expected,
    gates,
    initiate_all,
    measurement_covariance,
    narrowed,
    predict,
    reported,
    update,
)
from isac_rt.track.settings import Tracking
from isac_rt.world.swarm import Pose

SURE_HITS = 2
"""With `tracking.initiation: unexplained` odds confirm a track if so many of its detections could
have started it: others pass a lower threshold, which strong clutter passes again and again."""
CLEAR_M = 0.5
"""No two UAVs are nearer to each other, and none is to a wall [m]: their arms are as long."""
ROUNDING = 1e-9
"""Of sums of frame intervals [s]."""
FLAT_STD = 0.1
"""Standard deviation of the direction cosine that is taken for 0 where an array does not observe
an axis: UAVs fly within some six degrees of the array's plane."""


def in_plane(detections: Detections) -> Detections:
    """Detections with a direction on the axes that the array does not observe: that of its plane,
    with `FLAT_STD`."""
    unseen = np.isinf(detections.std[:, 2:])
    if not unseen.any():
        return detections
    std = detections.std.copy()
    std[:, 2:][unseen] = FLAT_STD
    return replace(detections, direction=np.where(unseen, 0.0, detections.direction), std=std)


def spread(detections: Detections, size: float, acceleration_std: float, legs: int) -> np.ndarray:
    """Return deviations (Q, 4) of detections of any part of a target of some size [m], over one leg
    or two. Parts move: E[v^2] = -E[xa] is the product of the deviations of place and acceleration
    [m/s^2] against the target at most (Cauchy and Schwarz)."""
    std, of_place = detections.std.copy(), size / np.sqrt(12)
    of_parts = of_place, np.sqrt(of_place * acceleration_std)
    std[:, :2] = np.hypot(std[:, :2], legs * np.array(of_parts))
    std[:, 2:] = np.hypot(std[:, 2:], of_place / detections.range[:, None])
    return std


def strongest(rows: Sequence[int], found: Detections, std: np.ndarray, gate: float) -> list[int]:
    """Return rows of detections without other parts of the target of a stronger one, which differ
    in range and direction by less than a gate by their deviations (Q, 4)."""
    out, z = list[int](), found.measured
    for q in sorted(rows, key=lambda q: -found.snr[q]):
        apart = np.nan_to_num((z[out] - z[q]) / np.hypot(std[out], std[q]))[:, [0, 2, 3]]
        if ((apart**2).sum(axis=1) > gate).all():
            out.append(q)
    return out


def assign(cost: np.ndarray) -> list[tuple[int, int]]:
    """Global nearest neighbour: as many pairs (row, column) as the finite costs allow, of the least
    total."""
    if not np.isfinite(cost).any():
        return []
    finite = np.isfinite(cost)
    span = np.ptp(cost[finite]) + 1.0
    refused = cost[finite].max() + span * (min(cost.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(finite, cost, refused))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if finite[i, j]]


@dataclass
class Track:
    """One UAV that a terminal follows.

    Attributes
    ----------
    id : never used again
    state : Gaussian, world
    snr : of the last detection (linear)
    age : frames since the first detection
    recent : whether each of the latest frames held a detection, newest last, the first detection
        included
    missed : frames since the last detection
    hits : detections so far
    odds : logarithm of the odds that it follows a target (`isac_rt.track.existence`); infinite
        where tracks count on their hits alone
    confirmed : enough hits were reached, and no rule took that back
    detection : row among the frame's detections that updated it, -1: none
    last : time of the last detection [s]
    sure : detections that could have started it
    first_id : number of the first track that its first detection started, in another reading of its
        velocity
    """

    id: int
    state: Gaussian
    snr: float
    age: int = 0
    recent: list[bool] = field(default_factory=lambda: [True])
    missed: int = 0
    hits: int = 1
    odds: float = np.inf
    confirmed: bool = False
    detection: int = -1
    last: float = -np.inf
    sure: int = 1
    first_id: int = -1

    @property
    def credible(self) -> bool:
        """True where it is reported: confirmed, and a target more probably than not."""
        return self.confirmed and self.odds > 0

    @classmethod
    def of_state(
        cls, state: Gaussian, acceleration_std: float = 0.0, time: float = -np.inf
    ) -> Track:
        """Track of a reported UAV with position and velocity (6,)."""
        mean = np.concatenate([state.mean, np.zeros(3)])
        covariance = np.diag([0.0] * 6 + [acceleration_std**2] * 3)
        covariance[:6, :6] = state.covariance
        return cls(-1, Gaussian(mean, covariance), np.inf, confirmed=True, last=time)


@dataclass(frozen=True, kw_only=True)
class TrackSet:
    """Tracks of a terminal after a frame, relative to its own known pose, at the middle of the
    frame.

    Attributes
    ----------
    ids : (K,) int
    mean : (K, 6) position and velocity relative to the terminal, world axes [m, m/s]
    covariance : (K, 6, 6)
    range, velocity : (K,) as in `Detections` (path length and its rate for a PT's reflectors) [m,
        m/s]
    direction : (K, 2) u_x, u_z
    std : (K, 4) standard deviations of range, velocity, u_x, u_z
    age : (K,) int, frames since the first detection
    confirmed, is_reference : (K,) bool; `Track.credible`; the reference is a PT's track of its AT
    detection : (K,) int, row among the frame's detections that updated it, -1: none
    snr : (K,) of the last detection, infinite where others report a target
    """

    ids: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    range: np.ndarray
    velocity: np.ndarray
    direction: np.ndarray
    std: np.ndarray
    age: np.ndarray
    confirmed: np.ndarray
    is_reference: np.ndarray
    detection: np.ndarray
    snr: np.ndarray

    def __len__(self) -> int:
        return self.ids.shape[0]

    def select(self, which: np.ndarray) -> TrackSet:
        """The tracks that a mask or an index array chooses."""
        return TrackSet(**{name: of[which] for name, of in vars(self).items()})

    @property
    def measured(self) -> np.ndarray:
        """(K, 4) range, velocity, u_x, u_z."""
        return np.column_stack([self.range, self.velocity, self.direction])


def track_set(tracks: Sequence[Track], own: Pose, reference: Track | None = None) -> TrackSet:
    """Report tracks relative to `own`; a PT's `reference` comes first and makes the others
    bistatic."""
    everyone = ([] if reference is None else [reference]) + list(tracks)
    count = len(everyone)
    states = [t.state for t in everyone]
    mean = np.array([s.mean[:6] for s in states]).reshape(count, 6)
    covariance = np.array([s.covariance[:6, :6] for s in states]).reshape(count, 6, 6)
    is_reference = np.arange(count) < (reference is not None)
    if reference is None:
        z, std = reported(states, own)
    else:
        parts = reported(states[:1], own), reported(states[1:], own, reference.state)
        z, std = (np.concatenate(both) for both in zip(*parts, strict=True))
    return TrackSet(
        ids=np.array([t.id for t in everyone], np.int64),
        mean=mean - np.concatenate([own.position, own.velocity]),
        covariance=covariance,
        range=z[:, 0],
        velocity=z[:, 1],
        direction=z[:, 2:],
        std=std,
        age=np.array([t.age for t in everyone], np.int64),
        confirmed=np.array([t.credible for t in everyone], bool),
        is_reference=is_reference,
        detection=np.array([t.detection for t in everyone], np.int64),
        snr=np.array([t.snr for t in everyone], float),
    )


@dataclass
class Followed:
    """State that a tracker carries over: its tracks at a time, and the number of the next one."""

    tracks: list[Track] = field(default_factory=list)
    time: float = -np.inf
    next_id: int = 0


class Tracker(Stateful):
    """All tracks of one terminal but a PT's reference: prediction, association, initiation,
    confirmation and death.

    Parameters
    ----------
    settings : Tracking
    ambiguity : what its detections leave open
    """

    def __init__(self, settings: Tracking, ambiguity: Ambiguity) -> None:
        self.settings = settings
        self.by_odds = settings.initiation == "unexplained"
        self.ambiguity = ambiguity
        self.state = Followed()

    @property
    def tracks(self) -> list[Track]:
        """All of them, tentative ones included, oldest first."""
        return self.state.tracks

    def new_id(self) -> int:
        """Numbers in order of initiation."""
        self.state.next_id += 1
        return self.state.next_id - 1

    def clear(self) -> None:
        """Forget all tracks (their numbers stay used)."""
        self.state.tracks = []

    def drop(self, ids: Container[int]) -> None:
        """End some tracks."""
        self.state.tracks = [t for t in self.tracks if t.id not in ids]

    def doubt(self, ratios: Mapping[int, float]) -> None:
        """Take it that an artefact explains this frame's detections of tracks, {id: p_C of
        `existence`}; what is likelier as a target's is left alone."""
        for track in self.tracks:
            if track.detection >= 0 and track.id in ratios:
                track.odds += min(existence.explained(ratios[track.id]), 0.0)

    def predict(self, time: float) -> None:
        """Bring all tracks to `time` [s]."""
        for track in self.tracks:
            track.state = predict(
                track.state, time - self.state.time, self.settings.acceleration_std_mps2
            )
            track.detection = -1
        self.state.time = time

    def update(
        self, detections: Detections, own: Pose, transmitter: Gaussian | None = None
    ) -> None:
        """Associate one frame's detections (confirmed tracks choose first), update, start and drop
        tracks.

        Detections that are a PT's reference are passed over. With a transmitter all are taken as
        bistatic.
        """
        z, std, s = detections.measured, detections.std, self.settings
        free = [int(q) for q in np.flatnonzero(~detections.is_reference)]
        if s.target_size_m:
            legs = 1 if transmitter is None else 2
            std = spread(detections, s.target_size_m, s.acceleration_std_mps2, legs)
            free = strongest(free, detections, std, gates(s.gate_probability)[3])
        cost = self._costs(z, std, own, transmitter)
        hit: dict[int, int] = {}
        for confirmed in (True, False):
            rows = [k for k, t in enumerate(self.tracks) if t.confirmed is confirmed]
            pairs = assign(cost[np.ix_(rows, free)])
            hit |= {rows[i]: free[j] for i, j in pairs}
            assigned = {free[j] for _, j in pairs}
            free = [q for q in free if q not in assigned]
        for k, track in enumerate(self.tracks):
            q = hit.get(k)
            track.sure += q is not None and bool(detections.starts[q])
            self._live(track, q is not None)
            if q is not None:
                track.snr, track.detection = float(detections.snr[q]), q
                track.last = self.state.time
        self._one_reading_each()
        self._condition(hit, z, std, own, transmitter)
        self.state.tracks = [t for t in self._joined() if not self._dead(t)]
        free = [q for q in free if detections.starts[q]]
        about: Any = {"acceleration_std": s.acceleration_std_mps2, "ambiguity": self.ambiguity}
        which, states = initiate_all(z[free], std[free], own, transmitter, **about)
        first: dict[int, int] = {}
        for i, mean, covariance in zip(which.tolist(), *states, strict=True):
            q, state = free[i], Gaussian(mean, covariance)
            track = Track(self.new_id(), state, float(detections.snr[q]), detection=q)
            track.first_id = first.setdefault(q, track.id)
            track.last = self.state.time
            track.confirmed = s.confirm_hits == 1
            track.odds = existence.BIRTH if self.by_odds else np.inf
            self.tracks.append(track)

    def _condition(
        self,
        hit: Mapping[int, int],
        z: np.ndarray,
        std: np.ndarray,
        own: Pose,
        transmitter: Gaussian | None,
    ) -> None:
        """Condition tracks on their detections, {number among the tracks: row of z (Q, 4)}: those
        with and without a direction each at once."""
        sender = None if transmitter is None else transmitter.mean
        measured = np.isfinite(z)
        for kind in {tuple(measured[q].tolist()) for q in hit.values()}:
            pairs = [(k, q) for k, q in hit.items() if tuple(measured[q].tolist()) == kind]
            tracks, q = [self.tracks[k] for k, _ in pairs], [q for _, q in pairs]
            mean, covariance = (
                np.array(part) for part in zip(*(t.state for t in tracks), strict=True)
            )
            state = Gaussian(mean, covariance)
            R = measurement_covariance(std[q], mean, transmitter)
            left = narrowed(state, R, own, sender) if all(kind) else state
            R = R + curvature(left, own, sender)
            after = update(state, z[q], R, own, sender, ambiguity=self.ambiguity)
            for track, *of_track in zip(tracks, *after, strict=True):
                track.state = Gaussian(*of_track)

    def snapshot(self, own: Pose, reference: Track | None = None) -> TrackSet:
        """All tracks, tentative ones included, relative to `own`."""
        return track_set(self.tracks, own, reference)

    def to_prediction(self, own: Pose, reference: Track) -> Prediction:
        """Predict the paths of this frame at a PT: row 0 its line of sight, then the confirmed
        reflectors seen in the last frame, weighted by their last SNR over the strongest's."""
        seen = [t for t in self.tracks if t.confirmed and t.missed == 0]
        report = track_set(seen, own, reference)
        snr = np.array([reference.snr] + [t.snr for t in seen])
        return Prediction(
            range=report.range,
            velocity=report.velocity,
            direction=report.direction,
            range_std=report.std[:, 0],
            velocity_std=report.std[:, 1],
            weight=snr / snr.max(),
        )

    def _costs(
        self, z: np.ndarray, std: np.ndarray, own: Pose, transmitter: Gaussian | None
    ) -> np.ndarray:
        """(tracks, detections) `costs`."""
        if not self.tracks or not len(z):
            return np.full((len(self.tracks), len(z)), np.inf)
        mean = np.stack([t.state.mean for t in self.tracks])
        covariance = np.stack([t.state.covariance for t in self.tracks])
        z_mean, S = expected(mean, covariance, own, transmitter)
        return costs(z, std, z_mean, S, self.ambiguity, self.settings.gate_probability)

    def _one_reading_each(self) -> None:
        """Take back the confirmation of tracks in this frame while another reading of their first
        detection has as many hits."""
        hits: dict[int, list[int]] = {}
        for track in self.tracks:
            hits.setdefault(track.first_id, []).append(sum(track.recent))
        for track in self.tracks:
            if track.age < self.settings.confirm_window and track.first_id >= 0:
                most, own = hits[track.first_id], sum(track.recent)
                track.confirmed &= sum(count >= own for count in most) == 1

    def _joined(self) -> list[Track]:
        """Return the tracks, of confirmed ones in one place the oldest alone, with its record, as
        the one of them that was found last has it."""
        out: list[Track] = []
        for track in self.tracks:
            joins, place = self.by_odds and track.confirmed, track.state.mean[:3]
            older = [t for t in out if joins and t.confirmed]
            near = [t for t in older if dist(t.state.mean[:3], place) < CLEAR_M]
            if not near:
                out.append(track)
            elif track.missed < near[0].missed:
                record = {name: vars(near[0])[name] for name in ("id", "age", "hits")}
                vars(near[0]).update(vars(track) | record)
        return out

    def _live(self, track: Track, hit: bool) -> None:
        s = self.settings
        if self.by_odds:
            track.odds = existence.updated(track.odds, hit, track.hits, track.age + 1)
        track.age += 1
        track.hits += hit
        track.missed = 0 if hit else track.missed + 1
        track.recent = [*track.recent, hit][-s.confirm_window :]
        enough = sum(track.recent) >= s.confirm_hits
        if self.by_odds:
            enough = track.sure >= min(SURE_HITS, s.confirm_hits)
        track.confirmed = track.confirmed or (hit and enough)

    def _dead(self, track: Track) -> bool:
        """A confirmed track ends after `drop_misses` misses in a row, or `drop_after_s` without a
        detection, and where that is set also after as many misses as it had frames before; a
        tentative one once it can no longer be confirmed in its first `confirm_window` frames."""
        s = self.settings
        if track.confirmed:
            late = s.drop_after_s is not None and (
                self.state.time - track.last > s.drop_after_s - ROUNDING
                or 2 * track.missed > track.age
            )
            return late or track.missed >= s.drop_misses
        return sum(track.recent) + s.confirm_window - len(track.recent) < s.confirm_hits
