"""Pictures of the swarm held against the truth: what terminals know together of who else flies.

The swarm's own terminals are known by what they say of themselves and are not counted as found.
Tracks keep their UAVs while they are near, as in CLEAR MOT (doi:10.1155/2008/246309).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.timetable import Timetable
from isac_rt.plain import Stateful
from isac_rt.results.columns import ERRORS
from isac_rt.results.dataset import Columns
from isac_rt.results.metrics import (
    GATE_RESOLUTIONS,
    GOSPA_CUTOFF_M,
    Resolution,
    assigned,
    score_tracks,
    truth_of,
)
from isac_rt.results.records import FusedRecord, ObserverRecord
from isac_rt.results.sensing import gospa_block, share
from isac_rt.track.fused import Fused, Name
from isac_rt.world.swarm import Pose

SWARM = "swarm"
"""The set of fused tracks of all terminals together; a terminal of this name has none of its
own."""


@dataclass(frozen=True)
class Traffic:
    """Messages to a terminal whose last frame a frame was.

    Attributes
    ----------
    messages, lost : how many, and how many of them were lost
    late : how many earlier ones, lost until then, came with a frame that was read late
    bits, capacity : of these messages, and of the links to the terminal in the frame
    left_out : tracks or detections that they had no room for
    """

    messages: int = 0
    lost: int = 0
    late: int = 0
    bits: int = 0
    capacity: int = 0
    left_out: int = 0

    def __add__(self, other: Traffic) -> Traffic:
        return Traffic(**{n: value + getattr(other, n) for n, value in vars(self).items()})


@dataclass(frozen=True)
class View:
    """A set of fused tracks after a frame.

    Attributes
    ----------
    time : that it is of [s]
    fused : its tracks
    ages : of the reports from others that it rests on [s]
    traffic : messages to the terminal
    """

    time: float
    fused: tuple[Fused, ...]
    ages: tuple[float, ...] = ()
    traffic: Traffic = Traffic()


@dataclass
class Remembered:
    """UAVs (U,) that links last saw and found; whom each set's tracks followed a frame ago."""

    seen: dict[Link, np.ndarray] = field(default_factory=dict)
    found: dict[Link, np.ndarray] = field(default_factory=dict)
    followed: dict[str, dict[Name, int]] = field(default_factory=dict)


class SwarmScorer(Stateful):
    """Scores fused tracks. It remembers which UAVs each link saw and found last."""

    def __init__(self, timetable: Timetable, arrays: Arrays) -> None:
        self._timetable = timetable
        self._resolutions = {
            link: Resolution.of(timetable.of(link.tx).waveform, arrays.at(link), link.passes)
            for link in timetable.all_links
        }
        self._origins = [str(link) for link in timetable.labels]
        self.state = Remembered()

    def record(
        self,
        frame: int,
        views: Mapping[str, View],
        observers: Mapping[Link, ObserverRecord],
        poses: Mapping[str, Mapping[str, Pose]],
    ) -> dict[str, FusedRecord]:
        """Score a frame's fused tracks.

        Parameters
        ----------
        views : by name
        observers : the frame's records, by link
        poses : of all UAVs at the time of each set of fused tracks, by its name
        """
        timetable, state = self._timetable, self.state
        for link, o in observers.items():
            u = o.uavs
            state.seen[link], state.found[link] = u.in_view & ~u.occluded, u.hit
        now = [link for link in state.seen if timetable.holds(link, frame)]
        target = np.array([role == "target" for role in timetable.roles(frame).values()])
        seen = {link: state.seen[link] & target for link in now}
        found = np.any([state.found[link] for link in now], axis=0) & target
        return {n: self._score(n, view, seen, found, poses[n]) for n, view in views.items()}

    def _score(
        self,
        name: str,
        view: View,
        seen_by: Mapping[Link, np.ndarray],
        found: np.ndarray,
        poses: Mapping[str, Pose],
    ) -> FusedRecord:
        names, tracks = list(poses), view.fused
        truth = np.array([np.concatenate([p.position, p.velocity]) for p in poses.values()])
        mean = np.array([b.state.mean for b in tracks]).reshape(-1, 6)
        covariance = np.array([b.state.covariance for b in tracks]).reshape(-1, 6, 6)
        seen = np.any([*seen_by.values()], axis=0)
        rows = np.flatnonzero([b.terminal is None for b in tracks])
        distance, false = score_tracks(mean[rows, :3], truth[:, :3], seen)
        off = self._off(mean[rows], seen_by, poses)
        follows = np.full(len(tracks), -1)
        error = np.full((len(names), len(ERRORS)), np.nan)
        followed = self.state.followed.get(name, {})
        for k, row in enumerate(rows):  # the miss of one shifts no others
            if (u := followed.get(tracks[row].name, -1)) >= 0 and off[k, u] < GATE_RESOLUTIONS:
                off[k], off[:, u], off[k, u] = np.inf, np.inf, 0.0
        pairs = [(rows[k], u) for k, u in assigned(off, GATE_RESOLUTIONS)]
        self.state.followed[name] = {tracks[k].name: u for k, u in pairs}
        for k, u in pairs:
            follows[k], error[u] = u, _errors(tracks[k], truth[u])
        return FusedRecord(
            gospa=np.array(distance[1:]),
            seen=seen,
            found=found,
            tracked=np.isin(np.arange(len(names)), follows),
            error=error,
            false=int(false.sum()),
            reports=len(view.ages),
            age=float(np.mean(view.ages)) if view.ages else np.nan,
            **vars(view.traffic),
            origin=np.array([self._origins.index(b.name.origin) for b in tracks], int),
            number=np.array([b.name.number for b in tracks], int),
            mean=mean,
            std=np.sqrt(covariance.diagonal(axis1=1, axis2=2)),
            members=np.array([len(b.members) for b in tracks], int),
            terminal=np.array([names.index(b.terminal) if b.terminal else -1 for b in tracks], int),
            uav=follows,
        )

    def _off(
        self, states: np.ndarray, seen_by: Mapping[Link, np.ndarray], poses: Mapping[str, Pose]
    ) -> np.ndarray:
        """(B, U) largest distance on any axis in resolutions of the link to which the state (B, 6)
        is nearest, of those that have the UAV in view; infinite where none has, and beyond the
        cutoff."""
        positions = np.array([pose.position for pose in poses.values()])
        near = np.linalg.norm(states[:, None, :3] - positions, axis=-1) < GOSPA_CUTOFF_M
        rows, out = np.flatnonzero(near.any(axis=1)), np.full(near.shape, np.inf)
        tracks = [replace(Pose.at_rest(s[:3]), velocity=s[3:]) for s in states[rows]]
        for link, seen in seen_by.items():
            receiver, at = poses[link.rx], None if link.own else poses[link.tx]
            points = np.array([truth_of(receiver, b, at)[:4] for b in tracks]).reshape(-1, 4)
            for u in np.flatnonzero(seen):
                truth = truth_of(receiver, [*poses.values()][u], at)
                out[rows, u] = np.minimum(out[rows, u], self._resolutions[link].off(truth, points))
        return np.where(near, out, np.inf)


def _errors(track: Fused, truth: np.ndarray) -> tuple[float, float, float]:
    """Errors of position [m] and velocity [m/s], and the squared error of position in the
    deviations stated, over its three axes."""
    e = track.state.mean - truth
    nees = float(e[:3] @ np.linalg.solve(track.state.covariance[:3, :3], e[:3])) / 3
    return float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:])), nees


def summary_of(
    fused_records: Mapping[str, tuple[Columns, Columns]], names: Sequence[str]
) -> dict[str, Any] | None:
    """The key `swarm` of the summary: the set of fused tracks of all terminals together, and under
    `terminals` that of each (`docs/outputs.md` says what each figure means); None without fused
    tracks.

    Parameters
    ----------
    fused_records : by name the frames, and the UAVs of all frames one after the other, of
        `isac_rt.results.columns.TABLES`
    names : of the UAVs
    """
    if not fused_records:
        return None
    of = {name: _block(frames, tracks, names) for name, (frames, tracks) in fused_records.items()}
    return {**of.pop(SWARM), "terminals": of}


def _block(frames: Columns, tracks: Columns, names: Sequence[str]) -> dict[str, Any]:
    """Summarise one set of fused tracks."""
    seen, found, tracked = frames["seen"], frames["found"], frames["tracked"]
    error, ages, reports = frames["error"][tracked], frames["age"], frames["reports"]
    received, in_view = reports.sum(), int(seen.sum())
    position, velocity, nees = np.mean(error ** [2, 2, 1], axis=0) if len(error) else [None] * 3
    rmse = [None if square is None else float(np.sqrt(square)) for square in (position, velocity)]

    def total(name: str) -> int:
        return int(frames[name].sum())

    return {
        "in_view": in_view,
        "hit_rate": share(int(found.sum()), in_view),
        "tracked_rate": share(int(tracked.sum()), in_view),
        "gospa": gospa_block(frames["gospa"], seen),
        "false_tracks_per_frame": float(np.mean(frames["false"])),
        "rmse": dict(zip(("position_m", "velocity_mps"), rmse, strict=True)),
        "nees": None if nees is None else float(nees),
        "reports_per_frame": float(received / len(seen)),
        "age_s": float(np.nansum(ages * reports) / received) if received else None,
        "messages": total("messages"),
        "messages_lost": total("lost") - total("late"),
        "messages_late": total("late"),
        "bits": total("bits"),
        "bits_capacity": total("capacity"),
        "left_out": total("left_out"),
        "targets": {
            name: {
                "in_view": int(seen[:, u].sum()),
                "found": int(found[:, u].sum()),
                "tracked": int(tracked[:, u].sum()),
                "switches": _switches(tracks, u),
            }
            for u, name in enumerate(names)
            if seen[:, u].any()
        },
    }


def _switches(tracks: Columns, u: int) -> int:
    """Times that a UAV had another name than when it was tracked last."""
    mine = tracks["uav"] == u
    names = zip(tracks["origin"][mine].tolist(), tracks["number"][mine].tolist(), strict=True)
    return sum(a != b for a, b in pairwise(names))
