"""Pictures of the swarm held against the truth: what terminals know together of who else flies.

The swarm's own terminals are known by what they say of themselves and are not counted as found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from isac_rt.frame.link import Link
from isac_rt.frame.timetable import Timetable
from isac_rt.plain import Stateful
from isac_rt.propagation.pathset import PathKind
from isac_rt.results.dataset import Columns
from isac_rt.results.metrics import GOSPA_CUTOFF_M
from isac_rt.results.records import FusedRecord, ObserverRecord
from isac_rt.results.sensing import gospa_block
from isac_rt.track.fused import Fused, Key
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
    bits, room : of these messages, and that the ways to the terminal had in the frame
    left_out : tracks or detections that they had no room for
    """

    messages: int = 0
    lost: int = 0
    late: int = 0
    bits: int = 0
    room: int = 0
    left_out: int = 0

    def __add__(self, other: Traffic) -> Traffic:
        sums = {name: value + getattr(other, name) for name, value in vars(self).items()}
        return Traffic(**sums)


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
    """UAVs (U,) that each link saw last, and the UAV that fed each track last, -1: none."""

    seen: dict[Link, np.ndarray] = field(default_factory=dict)
    fed: dict[Key, int] = field(default_factory=dict)


class SwarmScorer(Stateful):
    """Holds fused tracks against the truth. It remembers which UAVs each link saw last, and what
    fed each track last."""

    def __init__(self, timetable: Timetable) -> None:
        self._timetable = timetable
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
        poses : of all UAVs at the time of each picture, by its name
        """
        timetable = self._timetable
        for link, o in observers.items():
            self.state.seen[link] = o.in_view & ~o.shadowed
            origin, t = str(link), o.tracks
            fed = np.where(t.kind == PathKind.TARGET, t.target, -1)
            self.state.fed |= {Key(origin, int(k)): int(u) for k, u in zip(t.id, fed, strict=True)}
        now = [uavs for link, uavs in self.state.seen.items() if timetable.holds(link, frame)]
        roles = timetable.roles(frame)
        target = np.array([role == "target" for role in roles.values()])
        seen = np.any(now, axis=0) & target
        return {name: self._score(view, seen, target, poses[name]) for name, view in views.items()}

    def _score(
        self, view: View, seen: np.ndarray, target: np.ndarray, poses: Mapping[str, Pose]
    ) -> FusedRecord:
        names, bodies = list(poses), view.fused
        truth = np.array([np.concatenate([p.position, p.velocity]) for p in poses.values()])
        mean = np.array([b.state.mean for b in bodies]).reshape(-1, 6)
        covariance = np.array([b.state.covariance for b in bodies]).reshape(-1, 6, 6)
        strange = np.array([b.terminal is None for b in bodies], bool)
        nearest = np.linalg.norm(mean[:, None, :3] - truth[None, :, :3], axis=-1)
        pairs = _paired(nearest[np.ix_(strange, seen)])
        rows, columns = np.flatnonzero(strange), np.flatnonzero(seen)
        stands = {int(columns[j]): int(rows[i]) for i, j in pairs}
        left = np.setdiff1d(rows, list(stands.values()))
        near = nearest[left] < GOSPA_CUTOFF_M
        friend = (near & ~target).any(axis=1)
        hidden = (near & target & ~seen).any(axis=1) & ~friend
        each = GOSPA_CUTOFF_M**2 / 2
        false = int((~friend & ~hidden).sum())
        follows = np.full(len(bodies), -1)
        error = np.full((len(names), 3), np.nan)
        for u, k in stands.items():
            if any(self.state.fed.get(key) == u for key in bodies[k].members):
                follows[k] = u
                error[u] = _errors(bodies[k], truth[u])
        return FusedRecord(
            gospa=np.array(
                [
                    sum(nearest[k, u] ** 2 for u, k in stands.items()),
                    each * (int(seen.sum()) - len(stands)),
                    each * false,
                ]
            ),
            seen=seen,
            found=np.isin(np.arange(len(names)), follows),
            error=error,
            false=false,
            hidden=int(hidden.sum()),
            unrecognised=int(friend.sum()),
            reports=len(view.ages),
            age=float(np.mean(view.ages)) if view.ages else np.nan,
            **vars(view.traffic),
            origin=np.array([self._origins.index(b.name.origin) for b in bodies], int),
            number=np.array([b.name.number for b in bodies], int),
            mean=mean,
            std=np.sqrt(covariance.diagonal(axis1=1, axis2=2)),
            members=np.array([len(b.members) for b in bodies], int),
            terminal=np.array(
                [-1 if b.terminal is None else names.index(b.terminal) for b in bodies], int
            ),
            uav=follows,
        )


def _paired(distance: np.ndarray) -> list[tuple[int, int]]:
    """GOSPA's pairs of (n, m) distances: of the least sum of squares, each under the cutoff."""
    if not distance.size:
        return []
    d2 = np.minimum(distance, GOSPA_CUTOFF_M) ** 2
    rows, columns = linear_sum_assignment(d2)
    near = distance[rows, columns] < GOSPA_CUTOFF_M
    return list(zip(rows[near].tolist(), columns[near].tolist(), strict=True))


def _errors(body: Fused, truth: np.ndarray) -> tuple[float, float, float]:
    """Errors of position [m] and velocity [m/s], and the squared error of position in the
    deviations stated, over its three axes."""
    e = body.state.mean - truth
    position = e[:3]
    nees = float(position @ np.linalg.solve(body.state.covariance[:3, :3], position)) / 3
    return float(np.linalg.norm(position)), float(np.linalg.norm(e[3:])), nees


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
    of = {name: _block(frames, bodies, names) for name, (frames, bodies) in fused_records.items()}
    together = of.pop(SWARM)
    return {**together, "terminals": of}


def _block(frames: Columns, bodies: Columns, names: Sequence[str]) -> dict[str, Any]:
    """The figures of One set of fused tracks."""
    seen, found = frames["seen"], frames["found"]
    error, ages, reports = frames["error"][found], frames["age"], frames["reports"]
    received = reports.sum()
    position, velocity, nees = np.mean(error ** [2, 2, 1], axis=0) if len(error) else [None] * 3
    in_view = int(seen.sum())

    def total(name: str) -> int:
        return int(frames[name].sum())

    return {
        "hit_rate": int(found.sum()) / in_view if in_view else None,
        "gospa": gospa_block(frames["gospa"], seen),
        **{
            f"{what}_per_frame": float(np.mean(frames[name]))
            for what, name in (
                ("false_tracks", "false"),
                ("hidden", "hidden"),
                ("unrecognised", "unrecognised"),
            )
        },
        "rmse": {
            "position_m": None if position is None else float(np.sqrt(position)),
            "velocity_mps": None if velocity is None else float(np.sqrt(velocity)),
        },
        "nees": None if nees is None else float(nees),
        "reports_per_frame": float(received / len(seen)),
        "age_s": float(np.nansum(ages * reports) / received) if received else None,
        "messages": total("messages"),
        "messages_lost": total("lost") - total("late"),
        "messages_late": total("late"),
        "bits": total("bits"),
        "bits_room": total("room"),
        "left_out": total("left_out"),
        "targets": {
            name: {
                "in_view": int(seen[:, u].sum()),
                "found": int(found[:, u].sum()),
                "switches": _switches(bodies, u),
            }
            for u, name in enumerate(names)
            if seen[:, u].any()
        },
    }


def _switches(bodies: Columns, u: int) -> int:
    """Times that a UAV had another name than when it was found last."""
    mine = bodies["uav"] == u
    names = zip(bodies["origin"][mine].tolist(), bodies["number"][mine].tolist(), strict=True)
    return sum(a != b for a, b in pairwise(names))
