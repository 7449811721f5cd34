"""A terminal's frame held against the truth.

A UAV is found by a detection that its own path explains, and tracked by a confirmed track within
three resolutions of it. Errors are those of detections and tracks that its own path caused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from isac_rt.frame.antennas import Arrays, azimuth_elevation
from isac_rt.frame.cube import Transmission
from isac_rt.frame.link import Link
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.plain import Stateful
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections, Reception
from isac_rt.results.bounds import CramerRao
from isac_rt.results.labels import Aim, MapPositions, explain, owners
from isac_rt.results.losses import Chance, Channels, Sensitivity, cause_of
from isac_rt.results.metrics import (
    GATE_RESOLUTIONS,
    GOSPA_CUTOFF_M,
    Resolution,
    SymbolCount,
    Truth,
    assigned,
    count_symbols,
    score_tracks,
    truth_of,
    within_view,
)
from isac_rt.results.records import (
    DetectionLabels,
    LateRecord,
    ObserverRecord,
    TrackTable,
    UavScores,
    UavValues,
)
from isac_rt.track.parts import Late
from isac_rt.track.tracker import TrackSet
from isac_rt.world.settings import TERMINAL_ROLES
from isac_rt.world.swarm import Pose, Swarm

MISREAD = 0.5
"""Share of wrong delay symbols from which on a data frame shows nothing in its place."""


@dataclass(frozen=True)
class LinkResult:
    """Outcome of one frame at a terminal: reception, tracks and the state it is in then
    (`TerminalState`), and the earlier frames that it made readable."""

    reception: Reception
    tracks: TrackSet
    state: int
    late: tuple[Late, ...] = ()


@dataclass
class Remembered:
    """Memory of a link's tracks: by number kind, UAV and path's owner of the detection that fed
    each last, and by UAV the track that followed it last."""

    labels: dict[int, list[int]] = field(default_factory=dict)
    followed: dict[int, int] = field(default_factory=dict)


class Scorer(Stateful):
    """Holds the frames of one link's receiver against the truth. From frame to frame it remembers
    what explained the latest detection of each track, and which track follows each UAV."""

    def __init__(
        self,
        link: Link,
        arrays: Arrays,
        swarm: Swarm,
        timetable: Timetable,
        receivers: Receivers,
    ) -> None:
        self.link, self._arrays, self._swarm, self._timetable = link, arrays, swarm, timetable
        self._antennas = antennas = arrays.at(link)
        self._passes = 2 if link[0] == link[1] else 1
        self._resolution = Resolution.of(timetable.waveform, antennas, self._passes)
        self._least = CramerRao.of(timetable.waveform, antennas, self._passes)
        self._receivers = receivers
        self._objects = np.array([role == "object" for role in timetable.first_roles.values()])
        self.state = Remembered()

    def record(
        self,
        frame: int,
        paths: PathSet,
        sent: Transmission,
        received: LinkResult,
        noise_power: float,
        parts: PathSet | None = None,
    ) -> ObserverRecord:
        """Score one frame and describe it.

        Parameters
        ----------
        frame : its number
        paths : from the link's transmitter, as they were synthesised
        sent : what that transmitter sent
        received : what the receiver made of it
        noise_power : per sample at the receiver [W]
        parts : which label detections: `paths`, those of targets replaced by those of their parts
        """
        reception, timetable, tracks = received.reception, self._timetable, received.tracks
        parts = paths if parts is None else parts
        view = self._view(frame, paths)
        sees = self._sensitivity(frame, sent, noise_power)
        labels = self._labels_of(reception.detections, parts, sees, view.pose)
        reported = self._reported(frame)
        seen = np.isin(np.arange(len(view.truth)), list(view.seen))
        causes = self._latest(tracks, labels)
        places, scored = tracks.mean[tracks.confirmed, :3], seen & ~reported
        distance, false = score_tracks(places, view.positions, scored)
        moving = false & self._of_objects(causes)[tracks.confirmed]
        if moving.any():
            distance = score_tracks(places[~moving], view.positions, scored)[0]
        table, caused = self._table(view, tracks, causes, (false, moving))
        symbols = SymbolCount()
        if self._passes == 1:
            symbols = count_symbols(sent.payload, reception, timetable.groups(self.link))
        read = symbols.delay_errors <= MISREAD * symbols.delay_total
        read &= symbols.frames == 0 or reception.placed
        chances = self._chances(view, paths, sees, sent.pose)
        raw = reception.raw_delay_symbols
        return ObserverRecord(
            transmitter=self.link.tx,
            paths=paths,
            reception=reception,
            labels=labels,
            uavs=self._uavs(view, received, labels, caused, reported, chances, sees, read),
            tracks=table,
            state=received.state,
            gospa=distance,
            symbols=symbols,
            latency=0 if reception.is_read else -1,
            slips=int(((raw < 0) | (raw >= timetable.waveform.num_delay_symbols)).sum()),
            fell_back=sent.schedule is not timetable.schedule,
            reference_snr=_reference_snr(paths, sent.amplitude, noise_power),
        )

    def _uavs(
        self,
        view: _View,
        received: LinkResult,
        labels: DetectionLabels,
        caused: dict[int, int],
        reported: np.ndarray,
        chances: dict[int, Chance],
        sees: Sensitivity,
        read: bool,
    ) -> UavScores:
        """Return what the frame shows of each UAV; `caused`: the track that its path feeds."""
        d, count, observed = received.reception.detections, len(reported), self._resolution.observed
        best, hit = self._found(view, d, labels.uav)
        loss = np.full(count, -1, np.int8)
        for i, chance in chances.items():
            beside = labels.kind[self._beside(view.seen[i], d)]
            detected = bool((labels.uav == i).any())
            loss[i] = cause_of(bool(hit[i]), detected, beside, chance, sees, read)

        def by_uav(value: Callable[[Chance], float]) -> np.ndarray:
            return np.array([value(chances[i]) if i in chances else np.nan for i in range(count)])

        return UavScores(
            truth=_values([None if t is None else np.array(t)[[0, 1, 4, 5]] for t in view.truth]),
            detected=_estimates(count, d.measured, best, observed),
            tracked=_estimates(count, received.tracks.measured, caused, observed),
            bound=self._bound(view, chances),
            in_view=view.inside,
            occluded=view.inside & ~view.direct,
            hit=hit,
            loss=loss,
            target_snr=by_uav(lambda c: c.matched),
            target_cell_snr=by_uav(lambda c: c.channels),
            target_straddling=by_uav(lambda c: c.straddling),
            target_whitened_snr=by_uav(lambda c: c.whitened),
            target_clutter=by_uav(lambda c: c.clutter),
            cooperative=reported,
            genie=by_uav(lambda c: sees.genie(c.matched)),
            clutter_free=by_uav(lambda c: sees.clutter_free(c.cell)),
            whitened=by_uav(lambda c: sees.whitened(c.whitened)),
        )

    def late(self, frame: int, received: LinkResult) -> list[LateRecord]:
        """Return the records of earlier frames that frame number `frame` made readable."""
        timetable, tx = self._timetable, self.link.tx
        records = []
        for one in received.late:
            since = one.time - timetable.epoch(0, tx)
            number = round(since / timetable.interval)
            payload, groups = timetable.payload(tx, number), timetable.groups(self.link)
            symbols = count_symbols(payload, one.reception, groups)
            latency = frame - number if one.reception.is_read else -1
            records.append(LateRecord(number, one.reception, symbols, latency))
        return records

    def _view(self, frame: int, paths: PathSet) -> _View:
        tx, rx = self.link
        poses = self._swarm.poses(self._timetable.epoch(frame, tx))  # of this link's own chirps
        pose, active = poses[rx], poses[tx]
        names = list(self._swarm.uavs)
        truth: list[Truth | None] = []
        for name in names:
            transmitter = active if self._passes == 1 and name != tx else None
            truth.append(None if name == rx else truth_of(pose, poses[name], transmitter))
        inside = np.array(
            [name != rx and within_view(self._arrays, self.link, poses, name) for name in names]
        )
        inside &= ~self._objects
        own_paths = owners(paths.kind, paths.target, paths, names)
        rows = np.flatnonzero(own_paths >= 0)
        rows = rows[~paths.select(rows).bent]
        straight = np.full(len(paths), -1)
        straight[rows] = own_paths[rows]
        direct = np.isin(np.arange(len(names)), straight[rows])
        seen = {i: t for i, t in enumerate(truth) if t is not None and inside[i] and direct[i]}
        positions = np.array([poses[name].position - pose.position for name in names])
        return _View(pose, truth, inside, direct, straight, seen, positions)

    def _reported(self, frame: int) -> np.ndarray:
        """(U,) UAVs that are terminals in a frame and report their position; none in a swarm of
        terminals alone, whose terminals are its targets."""
        roles = [self._timetable.roles(frame), self._timetable.first_roles]
        now, first = (np.isin([*of.values()], TERMINAL_ROLES) for of in roles)
        return now & ~(first | self._objects).all()

    def _sensitivity(self, frame: int, sent: Transmission, noise_power: float) -> Sensitivity:
        timetable = self._timetable
        mine = timetable.groups(self.link) if timetable.modulated(frame) else None
        groups = timetable.waveform.num_groups if mine is None else len(mine)
        return Sensitivity.of(
            timetable.waveform,
            self._antennas,
            self._receivers,
            sent,
            noise_power,
            groups,
            self.link.own,
        )

    def _labels_of(
        self, d: Detections, paths: PathSet, sees: Sensitivity, pose: Pose
    ) -> DetectionLabels:
        beam = np.where(self._resolution.observed, self._resolution.width[2:], np.inf)
        aim = Aim(pose.to_body(paths.arrival)[:, ::2], beam)
        labels = explain(d, paths, self._timetable.waveform, self._passes, sees.cell, aim)
        names = list(self._swarm.uavs)
        uav = owners(labels.kind, labels.target, paths, names)
        index = np.array([names.index(name) for name in paths.target_names] + [-1], np.int16)
        return DetectionLabels(
            **labels._replace(target=index[labels.target])._asdict(),
            uav=np.where(labels.sidelobe, -1, uav),
        )

    def _found(
        self, view: _View, d: Detections, uav: np.ndarray
    ) -> tuple[dict[int, int], np.ndarray]:
        """Nearest detection of each UAV seen that its own path explains, within the gate, and
        whether it is within one resolution on all axes."""
        best, hit = {}, np.zeros(len(view.truth), bool)
        for i, truth in view.seen.items():
            off = np.where(uav == i, self._resolution.off(truth, d.measured), np.inf)
            if off.size and off.min() <= GATE_RESOLUTIONS:
                best[i] = int(off.argmin())
                hit[i] = off.min() <= 1
        return best, hit

    def _table(
        self,
        view: _View,
        tracks: TrackSet,
        causes: np.ndarray,
        far: tuple[np.ndarray, np.ndarray],
    ) -> tuple[TrackTable, dict[int, int]]:
        """Return the tracks with what explains them and whom they follow, and the rows of those
        that follow the UAV whose own path explains their latest detection.

        Confirmed tracks within the gate and, where both directions are observed, within the cutoff
        of GOSPA are assigned to UAVs one to one, a UAV to the track that followed it last before
        others.

        Parameters
        ----------
        causes : (T, 3) of `_latest`
        far : of the confirmed tracks, those far from every UAV and object, and those of them that
            objects feed
        """
        (false, moving), (kind, target, uav) = far, causes.T
        follows, rows = np.full(len(tracks), -1), np.flatnonzero(tracks.confirmed)
        off = np.full((len(view.seen), len(rows)), np.inf)
        for i, (u, truth) in enumerate(view.seen.items()):
            distance = np.linalg.norm(tracks.mean[rows, :3] - view.positions[u], axis=1)
            near = (distance < GOSPA_CUTOFF_M) | (not all(self._resolution.observed))
            off[i, near] = self._resolution.off(truth, tracks.measured[rows[near]])
        last = np.array([self.state.followed.get(i, -1) for i in view.seen], int)
        stays = (tracks.ids[rows] == last[:, None]) & (off < GATE_RESOLUTIONS)
        cost = np.where(stays, 0.0, (off + GATE_RESOLUTIONS) / 2)
        for i, k in assigned(cost, GATE_RESOLUTIONS):
            u, row = list(view.seen)[i], rows[k]
            follows[row], self.state.followed[u] = u, int(tracks.ids[row])
        first = {int(follows[k]): int(k) for k in rows if 0 <= follows[k] == uav[k]}
        of_nobody, of_object = np.zeros((2, len(tracks)), bool)
        places, nobody = tracks.mean[rows, None, :3], follows[rows] < 0
        off = np.linalg.norm(places - view.positions[self._objects], axis=2)
        of_nobody[rows] = false & ~moving & nobody
        of_object[rows] = (moving | (off < GOSPA_CUTOFF_M).any(axis=1)) & nobody
        table = TrackTable(
            id=tracks.ids,
            range=tracks.range,
            velocity=tracks.velocity,
            u_x=tracks.direction[:, 0],
            u_z=tracks.direction[:, 1],
            confirmed=tracks.confirmed,
            state=tracks.mean,
            covariance=tracks.covariance,
            kind=kind,
            target=target,
            uav=follows,
            false=of_nobody,
            object=of_object,
        )
        return table, first

    def _latest(self, tracks: TrackSet, labels: DetectionLabels) -> np.ndarray:
        """Return kind, target and path's owner (T, 3) of the detection that fed each track last."""
        columns = np.column_stack([labels.kind, labels.target, labels.uav])
        for track, row in zip(tracks.ids.tolist(), tracks.detection.tolist(), strict=True):
            if row >= 0:
                self.state.labels[track] = columns[row].tolist()
        mine = {track: self.state.labels.get(track, [-1, -1, -1]) for track in tracks.ids.tolist()}
        self.state.labels = mine
        return np.array([*mine.values()], int).reshape(-1, 3)

    def _of_objects(self, causes: np.ndarray) -> np.ndarray:
        """Mark the tracks (T,) that an object's own echo or its mirroring face feeds."""
        kind, target, _ = causes.T
        return (
            np.isin(kind, (PathKind.TARGET, PathKind.SPECULAR))
            & np.append(self._objects, False)[target]
        )

    def _chances(
        self, view: _View, paths: PathSet, sees: Sensitivity, tx: Pose
    ) -> dict[int, Chance]:
        """Return the detection chance of the strongest straight path of each UAV seen."""
        w, out = self._timetable.waveform, {}
        positions = MapPositions.of(paths, w, self._passes)
        wavenumber = 2 * np.pi * float(w.carrier()) / SPEED_OF_LIGHT
        channels = Channels(self._antennas, wavenumber, tx, view.pose)
        for i in view.seen:
            mine = np.flatnonzero(view.straight == i)
            strongest = int(mine[np.argmax(paths.power[mine])])
            out[i] = Chance.of(strongest, paths, positions, w, sees, channels)
        return out

    def _bound(self, view: _View, chances: dict[int, Chance]) -> UavValues:
        """Least standard deviations of an estimate of each UAV seen."""
        rows: list[np.ndarray | None] = [None] * len(view.truth)
        for i, chance in chances.items():
            if chance.matched > 0:
                rows[i] = self._least.of_path(chance.matched, view.seen[i])
        return _values(rows)

    def _beside(self, truth: Truth, d: Detections) -> np.ndarray:
        """(Q,) which detections lie within a cell of a UAV."""
        w = self._timetable.waveform
        rows, bins = MapPositions.at(d.range, d.velocity, w, self._passes).distances(*truth[:2])
        return (rows <= 1) & (bins <= 1)


@dataclass(frozen=True)
class _View:
    """Field of view of a frame's receiver.

    Attributes
    ----------
    pose : of the receiver
    truth : of each of U UAVs, None for the receiver itself
    inside : (U,) in the field of view
    direct : (U,) reached straight, without the city
    straight : (K,) index of the UAV whose own straight path each path is, -1: none's
    seen : the truth of those in view and unoccluded, by index
    positions : (U, 3) relative to the receiver [m]
    """

    pose: Pose
    truth: list[Truth | None]
    inside: np.ndarray
    direct: np.ndarray
    straight: np.ndarray
    seen: dict[int, Truth]
    positions: np.ndarray


def _reference_snr(paths: PathSet, amplitude: float, noise_power: float) -> float:
    """Per-sample SNR of the line of sight, or of the strongest echo on the terminal's own link; NaN
    where there is none."""
    kind = PathKind.TARGET if paths.tx == paths.rx else PathKind.LINE_OF_SIGHT
    power = paths.power[paths.kind == kind]
    return float(amplitude**2 * power.max() / noise_power) if power.size else float("nan")


def _values(rows: list[np.ndarray | None]) -> UavValues:
    table = np.array([np.full(4, np.nan) if r is None else r for r in rows])
    return UavValues(
        range=table[:, 0], velocity=table[:, 1], azimuth=table[:, 2], elevation=table[:, 3]
    )


def _estimates(
    count: int, points: np.ndarray, of_uav: dict[int, int], observed: tuple[bool, bool]
) -> UavValues:
    """Estimates by UAV; direction cosines become azimuth and elevation of the front half-space.

    On an axis that is not observed the angle is NaN, and the other is that in the array's plane.
    """
    rows: list[np.ndarray | None] = [None] * count
    for i, j in of_uav.items():
        r, v, u_x, u_z = points[j]
        u = np.where(observed, [u_x, u_z], 0.0)
        rows[i] = np.array([r, v, *np.where(observed, azimuth_elevation(u), np.nan)])
    return _values(rows)
