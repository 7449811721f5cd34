"""A terminal's frame held against the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.frame.antennas import Antennas, azimuth_elevation
from isac_rt.frame.cube import Transmission
from isac_rt.frame.link import Link
from isac_rt.frame.timetable import Timetable
from isac_rt.propagation import PathKind, PathSet
from isac_rt.receive import Reception
from isac_rt.results.metrics import (
    SensingScore,
    SymbolCount,
    Truth,
    associate,
    count_symbols,
    direct_targets,
    explain,
    resolutions,
    truth_of,
    within_view,
)
from isac_rt.results.records import ObserverRecord, TrackTable, UavValues
from isac_rt.terminal.tracker import TrackSet
from isac_rt.world.swarm import Swarm


@dataclass(frozen=True)
class Heard:
    """What a terminal made of one frame: reception, tracks and the state it is in then
    (`TerminalState`)."""

    reception: Reception
    tracks: TrackSet
    state: int


class Scorer:
    """Holds the frames of one link's receiver against the truth, and keeps the score."""

    def __init__(self, link: Link, antennas: Antennas, swarm: Swarm, timetable: Timetable) -> None:
        self.link, self._antennas, self._swarm, self._timetable = link, antennas, swarm, timetable
        self._passes = 2 if link[0] == link[1] else 1
        self.score = SensingScore(resolutions(timetable.waveform, antennas, self._passes))

    def record(
        self, frame: int, paths: PathSet, sent: Transmission, heard: Heard, noise_power: float
    ) -> ObserverRecord:
        """Score one frame and describe it.

        Parameters
        ----------
        frame : its number
        paths : from the link's transmitter, as they were synthesised
        sent : what that transmitter sent
        heard : what the receiver made of it
        noise_power : per sample at the receiver [W]
        """
        (tx, rx), reception, timetable = self.link, heard.reception, self._timetable
        poses = self._swarm.poses(timetable.epoch(frame, tx))  # of this link's own chirps
        names, own, active = list(self._swarm.uavs), poses[rx], poses[tx]
        truth: list[Truth | None] = []
        for name in names:
            by_way = active if self._passes == 1 and name != tx else None
            truth.append(None if name == rx else truth_of(own, poses[name], by_way))
        in_view = np.array(
            [name != rx and within_view(self._antennas, own, active, poses[name]) for name in names]
        )
        direct = direct_targets(paths, names)
        seen = [i for i in range(len(names)) if in_view[i] and direct[i]]
        targets = [t for i in seen if (t := truth[i]) is not None]
        explained = explain(reception.detections, paths, timetable.waveform, self._passes)
        self.score.add(targets, reception.detections, heard.tracks, explained.kind)
        d, tracks = reception.detections, heard.tracks
        detected = np.column_stack([d.range, d.velocity, d.direction])
        tracked = np.column_stack([tracks.range, tracks.velocity, tracks.direction])
        sure = np.flatnonzero(tracks.confirmed | tracks.is_reference)
        to_detection = associate(targets, detected, self.score.resolution)
        to_track = [
            (i, int(sure[j])) for i, j in associate(targets, tracked[sure], self.score.resolution)
        ]
        followed = np.full(len(tracks), -1)
        followed[[j for _, j in to_track]] = [seen[i] for i, _ in to_track]
        stray = np.ones(len(d), bool)
        stray[[j for _, j in to_detection]] = False
        raw = reception.raw_delay_symbols
        return ObserverRecord(
            transmitter=tx,
            reception=reception,
            paths=paths,
            truth=_values([None if t is None else np.array(t)[[0, 1, 4, 5]] for t in truth]),
            detected=_estimates(len(names), detected, to_detection, seen),
            tracked=_estimates(len(names), tracked, to_track, seen),
            in_view=in_view,
            shadowed=in_view & ~direct,
            tracks=TrackTable(
                id=tracks.ids,
                range=tracks.range,
                velocity=tracks.velocity,
                u_x=tracks.direction[:, 0],
                u_z=tracks.direction[:, 1],
                confirmed=tracks.confirmed,
                uav=followed,
            ),
            state=heard.state,
            **{f"detection_{name}": value for name, value in explained._asdict().items()},
            symbols=count_symbols(sent.payload, reception, timetable.groups(self.link))
            if self._passes == 1
            else SymbolCount(),
            fell_back=sent.schedule is not timetable.schedule,
            num_false=int((stray & (explained.kind < 0)).sum()),
            slips=int(((raw < 0) | (raw >= timetable.waveform.num_delay_symbols)).sum()),
            reference_snr=_reference_snr(paths, sent.amplitude, noise_power),
        )


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
    count: int, found: np.ndarray, pairs: list[tuple[int, int]], seen: list[int]
) -> UavValues:
    """Estimates by UAV; direction cosines become azimuth and elevation of the front half-space."""
    rows: list[np.ndarray | None] = [None] * count
    for i, j in pairs:
        r, v, u_x, u_z = found[j]
        rows[seen[i]] = np.array([r, v, *azimuth_elevation([u_x, u_z])])
    return _values(rows)
