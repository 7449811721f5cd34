"""One self-describing file per run: what is recorded of every frame, how it is summed up, saved and loaded.

`Recorder` collects frames and makes one `xarray.Dataset` with named dimensions; what differs in number from frame to
frame (detections, tracks, paths) is ragged: flat arrays beside their frame and observer. Nothing that depends on the
clock of the machine is in the dataset, so two runs of one scenario give bit-identical variables.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from isac_rt.metrics import SensingScore, SymbolCount, pool, summary_block
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.provenance import provenance, versions
from isac_rt.receive.types import Reception
from isac_rt.scenario import Scenario
from isac_rt.scenario_file import to_yaml
from isac_rt.swarm import Pose
from isac_rt.timetable import Link, Timetable
from isac_rt.waveform import Waveform

KINDS = tuple(kind.name.lower() for kind in PathKind)
SYMBOLS = ("delay", "dpsk", "bit")
MEASURES = {"range": ("m", "range_m"), "velocity": ("m s-1", "velocity_mps"), "azimuth": ("rad", "azimuth_deg"),
            "elevation": ("rad", "elevation_deg")}  # fmt: skip
"""What is estimated of a UAV: unit inside, key in the summary."""
TIMINGS = ("setup", "trace", "synthesis", "receive", "track", "total")
FILE = "results.nc"


class ResultsError(Exception):
    """Results cannot be written or read; the text says why and what to do."""


@dataclass(frozen=True, kw_only=True)
class UavValues:
    """One value per UAV of the scenario, in its order: truth, or estimates with NaN where a UAV was not matched.

    Attributes
    ----------
    range, velocity : (U,) as in `Detections` [m], [m/s, positive receding]: one way at the AT and of the transmitter itself,
        path length and its rate for what reflects to a PT
    azimuth, elevation : (U,) [rad] in the observer's body frame
    """

    range: np.ndarray
    velocity: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray


@dataclass(frozen=True, kw_only=True)
class TrackTable:
    """The tracks that an observer keeps after a frame, one row each: id, range [m], velocity [m/s], direction cosines,
    whether confirmed, and the index of the UAV that the track follows in truth (-1: none)."""

    id: np.ndarray
    range: np.ndarray
    velocity: np.ndarray
    u_x: np.ndarray
    u_z: np.ndarray
    confirmed: np.ndarray
    uav: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ObserverRecord:
    """What one link's receiving terminal had and made of one frame.

    Attributes
    ----------
    transmitter : whose chirps it received
    reception : what it found
    paths : what it received
    truth, detected, tracked : over all UAVs; estimates are NaN where none is associated
    in_view, shadowed : (U,) bool; whether a UAV is in the field of view; whether the city hides it
    tracks : after this frame
    state : code of the terminal's state, an index into the recorder's `states`
    detection_kind, detection_target, detection_order, detection_face : (Q,) what explains each detection, as `metrics.Explanation` says
    symbols : what was sent to it and became of it
    fell_back : whether the transmitter sent the conventional schedule in place of the scenario's (`isac_rt.fall_back`)
    num_false : detections that no path explains
    slips : symbols decided outside their alphabet
    reference_snr : per sample and antenna before processing (linear); NaN where there is no reference path
    """

    transmitter: str
    reception: Reception
    paths: PathSet
    truth: UavValues
    detected: UavValues
    tracked: UavValues
    in_view: np.ndarray
    shadowed: np.ndarray
    tracks: TrackTable
    state: int
    detection_kind: np.ndarray
    detection_target: np.ndarray
    detection_order: np.ndarray
    detection_face: np.ndarray
    symbols: SymbolCount = field(default_factory=SymbolCount)
    fell_back: bool = False
    num_false: int = 0
    slips: int = 0
    reference_snr: float = np.nan


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """One frame: its index, the time of its middle [s], all poses then, and by its label every observer that received in it.
    Of a `snapshot` frame the whole path ledger and the maps are kept."""

    frame: int
    time: float
    modulated: bool
    poses: Mapping[str, Pose]
    observers: Mapping[str, ObserverRecord]
    snapshot: bool = False


@dataclass(frozen=True)
class Results:
    """A run: labelled arrays, the summary of `summary.json`, and the scenario that made them."""

    dataset: xr.Dataset
    summary: dict[str, Any]
    scenario: Scenario

    def __repr__(self) -> str:
        def say(value: float | None, form: str) -> str:
            return "-" if value is None else format(value, form)

        kinds = {"hit_rate": ("hit rate", ".2f"), "ser_delay": ("delay SER", ".2e"), "ser_dpsk": ("DPSK SER", ".2e")}
        blocks = self.summary["terminals"].items()
        lines = [f"  {name}: " + ", ".join(f"{words} {say(b[key], form)}" for key, (words, form) in kinds.items()) for name, b in blocks]
        return "\n".join([f"<Results of {self.scenario.name}: {self.summary['frames']} frames, seed {self.summary['seed']}", *lines]) + ">"


@dataclass
class Recorder:
    """Collects the frames of a run. An observer is a link's receiver; `states` are the names of the terminals' state codes."""

    scenario: Scenario
    waveform: Waveform
    timetable: Timetable
    states: Sequence[str]
    _frames: list[_SlimFrame] = field(default_factory=list)

    def add(self, record: FrameRecord) -> None:
        """Append the next frame. Of frames that are no snapshots the paths are counted and let go."""
        rows = {name: _slim(o, record.snapshot) for name, o in record.observers.items()}
        self._frames.append(_SlimFrame(**{**vars(record), "observers": rows}))

    @property
    def count(self) -> int:
        """Frames so far."""
        return len(self._frames)

    def since(self, first: int) -> list[Any]:
        """The frames from number `first` on, for `restore`."""
        return self._frames[first:]

    def restore(self, frames: list[Any]) -> None:
        """Append frames that `since` gave."""
        self._frames += frames

    def finish(
        self,
        *,
        scores: Mapping[Link, SensingScore],
        timing: Mapping[str, float],
        fidelity: Mapping[str, Any],
        access: Mapping[str, Any] | None = None,
        materials: Mapping[str, Any] | None = None,
        link_budget: Sequence[Mapping[str, Any]] = (),
    ) -> Results:
        """The results of the frames so far. `scores` holds every link's sensing; `timing` [s] goes into the summary only, as does what
        became of the stages before the data (`access`); `materials` and `link_budget` (rows of a table) are kept as JSON attributes of
        the dataset."""
        dataset = _Builder(self.scenario, self.waveform, self.timetable, tuple(self.states), self._frames).dataset()
        dataset.attrs |= {
            **provenance(self.scenario),
            "fidelity": json.dumps(dict(fidelity)),
            "materials": json.dumps(dict(materials or {})),
            "link_budget": json.dumps([dict(row) for row in link_budget]),
        }
        summary = self.summary(scores=scores, timing=timing, fidelity=fidelity, access=access)
        return Results(dataset, summary, self.scenario)

    def summary(
        self,
        *,
        scores: Mapping[Link, SensingScore],
        timing: Mapping[str, float],
        fidelity: Mapping[str, Any],
        access: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """The fixed keys of `summary.json` alone; null stands for what does not apply."""
        frames = self._frames
        interval = self.scenario.frame_interval_s or self.waveform.frame_duration
        duration = (frames[-1].frame - frames[0].frame) * interval + self.waveform.frame_duration if frames else 0.0
        symbols = {link: self._symbols(link) for link in self.timetable.all_links}
        links = {}
        for (tx, rx), counted in symbols.items():
            role = "active" if tx == rx else "passive"
            links[f"{tx}->{rx}"] = summary_block(role, scores[tx, rx], counted, duration)
        terminals = {}
        for name in dict.fromkeys(rx for _, rx in self.timetable.all_links):
            mine = [link for link in self.timetable.all_links if link[1] == name]
            received = [c for link in mine if (c := symbols[link]) is not None]
            roles = self.timetable.roles_taken(name)
            pooled = sum(received, SymbolCount()) if received else None
            terminals[name] = summary_block(roles[0] if len(roles) == 1 else roles, pool([scores[link] for link in mine]), pooled, duration)
        of_kind = sum((o.counts for f in frames for o in f.observers.values()), np.zeros(len(KINDS), int))
        return {
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "frames": len(frames),
            "terminals": terminals,
            "links": links,
            "paths": {kind: int(n) for kind, n in zip(KINDS, of_kind, strict=True)},
            "timing_s": {key: float(timing[key]) if key in timing else None for key in TIMINGS},
            "fidelity": dict(fidelity),
            "access": None if access is None else dict(access),
            "sparsity": {f"{tx}->{rx}": row for tx, rx in symbols if (row := self._sparsity((tx, rx)))} or None,
            "versions": versions(),
        }

    def _sparsity(self, link: Link) -> dict[str, int] | None:
        """Frames whose receiver judged how sparse the scene is, those found dense, and those sent by the conventional schedule for that
        reason; None where no frame was judged."""
        label = self.timetable.labels[link]
        seen = [f.observers[label] for f in self._frames if label in f.observers]
        judged = [found for s in seen if (found := _sparse(s)) >= 0]
        fell_back = sum(s.record.fell_back for s in seen)
        return {"judged": len(judged), "dense": judged.count(0), "fell_back": fell_back} if judged else None

    def _symbols(self, link: Link) -> SymbolCount | None:
        """What was sent over a link and became of it; None for a terminal's own echoes."""
        if link[0] == link[1]:
            return None
        label = self.timetable.labels[link]
        return sum((f.observers[label].record.symbols for f in self._frames if label in f.observers), SymbolCount())


@dataclass(frozen=True)
class _Slim:
    """An `ObserverRecord` with its paths reduced to numbers and power by kind, and the ledger of a snapshot."""

    record: ObserverRecord
    counts: np.ndarray
    power: np.ndarray
    ledger: PathSet | None


@dataclass(frozen=True, kw_only=True)
class _SlimFrame:
    """A `FrameRecord` of such observers."""

    frame: int
    time: float
    modulated: bool
    poses: Mapping[str, Pose]
    observers: Mapping[str, _Slim]
    snapshot: bool


def _sparse(s: _Slim) -> int:
    return -1 if s.record.reception.sparse is None else int(s.record.reception.sparse)


def _slim(o: ObserverRecord, snapshot: bool) -> _Slim:
    kind, power = o.paths.kind, o.paths.power
    counts = np.bincount(kind, minlength=len(KINDS))
    total = np.bincount(kind, weights=power, minlength=len(KINDS))
    return _Slim(ObserverRecord(**{**vars(o), "paths": o.paths.select(np.zeros(0, int))}), counts, total, o.paths if snapshot else None)


def errors_of(dataset: xr.Dataset, group: str, name: str) -> np.ndarray:
    """"detected" or "tracked" value less the truth (frame, observer, uav), NaN where none; angles [rad] wrapped to (-pi, pi]."""
    e = (dataset[f"{group}_{name}"] - dataset[f"truth_{name}"]).values
    return np.angle(np.exp(1j * e)) if MEASURES[name][0] == "rad" else e


DIMENSIONLESS = "1"


@dataclass
class _Builder:
    """Turns recorded frames into a dataset."""

    scenario: Scenario
    waveform: Waveform
    timetable: Timetable
    states: tuple[str, ...]
    frames: list[_SlimFrame]
    out: dict[str, xr.Variable] = field(default_factory=dict)

    @property
    def observers(self) -> list[str]:
        return list(self.timetable.labels.values())

    def put(self, name: str, dims: Sequence[str], values: Any, units: str, long_name: str, **attrs: Any) -> None:
        self.out[name] = xr.Variable(tuple(dims), np.asarray(values), {"units": units, "long_name": long_name, **attrs})

    def over(self, value: Callable[[_Slim], Any], missing: Any, dtype: type) -> np.ndarray:
        """(frame, observer, ...) of a value of each record; `missing` where an observer did not receive in a frame."""
        rows = [[value(f.observers[o]) if o in f.observers else missing for o in self.observers] for f in self.frames]
        return np.array(rows, dtype=dtype).reshape(len(self.frames), len(self.observers), *np.shape(missing))

    def records(self) -> list[tuple[int, int, _Slim]]:
        """(position of the frame, of the observer, record) in order."""
        return [(i, j, f.observers[o]) for i, f in enumerate(self.frames) for j, o in enumerate(self.observers) if o in f.observers]

    def dataset(self) -> xr.Dataset:
        self.frame_values()
        self.uav_values()
        self.counts()
        self.detections()
        self.tracks()
        self.ledger()
        self.maps()
        w = self.waveform
        numbers = {
            "carrier_hz": w.carrier_frequency, "effective_carrier_hz": w.effective_carrier, "frame_duration_s": w.frame_duration,
            "frame_interval_s": self.scenario.frame_interval_s or w.frame_duration, "range_cell_m": w.range_cell(1),
            "velocity_cell_mps": w.velocity_cell(1),
        }  # fmt: skip
        return xr.Dataset(self.out, attrs=numbers)

    def frame_values(self) -> None:
        names = list(self.scenario.swarm)
        self.put("frame", ["frame"], np.array([f.frame for f in self.frames], np.int64), DIMENSIONLESS, "index of the frame")
        self.put("observer", ["observer"], np.array(self.observers, object), DIMENSIONLESS, "link, by its receiver where that is enough")
        self.put("uav", ["uav"], np.array(names, object), DIMENSIONLESS, "unmanned aerial vehicle")
        self.put(
            "role", ["uav"], np.array([self.scenario.swarm[n].role for n in names], object), DIMENSIONLESS, "role of the UAV at the start"
        )
        self.put("kind", ["kind"], np.array(KINDS, object), DIMENSIONLESS, "kind of path")
        self.put("symbol", ["symbol"], np.array(SYMBOLS, object), DIMENSIONLESS, "kind of symbol")
        self.put("axis", ["axis"], np.array(list("xyz"), object), DIMENSIONLESS, "world axis: east, north, up")
        self.put("body_axis", ["body_axis"], np.array(["right", "boresight", "up"], object), DIMENSIONLESS, "body axis")
        self.put("time", ["frame"], np.array([f.time for f in self.frames], float), "s", "time of the middle of the frame")
        self.put("modulated", ["frame"], np.array([f.modulated for f in self.frames], bool), DIMENSIONLESS, "the frame carries data")
        for i, end in enumerate(("transmitter", "receiver")):
            ends = np.array([link[i] for link in self.timetable.labels], object)
            self.put(end, ["observer"], ends, DIMENSIONLESS, f"{end} of the observer's link")
        for name, units in (("position", "m"), ("velocity", "m s-1"), ("acceleration", "m s-2")):
            values = np.array([[getattr(f.poses[n], name) for n in names] for f in self.frames], float).reshape(-1, len(names), 3)
            self.put(f"uav_{name}", ["frame", "uav", "axis"], values, units, f"{name} of the UAV in world axes")
        turned = np.array([[f.poses[n].rotation for n in names] for f in self.frames], float).reshape(-1, len(names), 3, 3)
        self.put("uav_attitude", ["frame", "uav", "axis", "body_axis"], turned, DIMENSIONLESS, "body axes of the UAV in world axes")

    def uav_values(self) -> None:
        count = len(self.scenario.swarm)
        none, no = np.full(count, np.nan), np.zeros(count, bool)
        dims = ["frame", "observer", "uav"]
        meaning = {"truth": "true", "detected": "detected", "tracked": "tracked"}
        for group, word in meaning.items():
            for name, (units, _) in MEASURES.items():
                values = self.over(attrgetter(f"record.{group}.{name}"), none, float)
                self.put(f"{group}_{name}", dims, values, units, f"{word} {name} of the UAV, seen by the observer")
        self.put("in_view", dims, self.over(lambda s: s.record.in_view, no, bool), DIMENSIONLESS, "UAV inside the field of view")
        self.put("shadowed", dims, self.over(lambda s: s.record.shadowed, no, bool), DIMENSIONLESS, "UAV hidden by the city")

    def counts(self) -> None:
        two, zero = ["frame", "observer"], np.zeros(len(KINDS))
        self.put("processed", two, self.over(lambda s: True, False, bool), DIMENSIONLESS, "the observer processed the frame")
        self.put("state", two, self.over(lambda s: s.record.state, -1, np.int8), DIMENSIONLESS, "state of the terminal, -1: not processed",
                 flag_values=np.arange(len(self.states), dtype=np.int8), flag_meanings=" ".join(self.states))  # fmt: skip
        for name, text, get in (
            ("decoded", "data symbols were decided", lambda s: s.record.reception.decoded),
            ("line_of_sight", "the receiver says that it sees its reference path", lambda s: s.record.reception.line_of_sight),
            ("fell_back", "sent by the conventional schedule in place of the random one", lambda s: s.record.fell_back),
        ):
            self.put(name, two, self.over(get, False, bool), DIMENSIONLESS, text)
        self.put("sparse", two, self.over(_sparse, -1, np.int8), DIMENSIONLESS,
                 "the receiver found the scene sparse: 1, not: 0, not judged: -1")  # fmt: skip
        power = self.over(lambda s: s.record.reception.reference_power, np.nan, float)
        self.put("reference_power", two, power, "W", "mean power of the reference path per sample and antenna, as received")
        self.put("reference_snr", two, self.over(lambda s: s.record.reference_snr, np.nan, float), DIMENSIONLESS,
                 "SNR of the reference path per sample and antenna before processing, linear")  # fmt: skip
        self.put("num_false", two, self.over(lambda s: s.record.num_false, 0, np.int32), DIMENSIONLESS, "detections that no path explains")
        self.put("slips", two, self.over(lambda s: s.record.slips, 0, np.int32), DIMENSIONLESS, "symbols decided outside their alphabet")
        self.put("path_count", [*two, "kind"], self.over(lambda s: s.counts, zero, np.int32), DIMENSIONLESS, "number of paths")
        self.put("path_power", [*two, "kind"], self.over(lambda s: s.power, zero, float), DIMENSIONLESS, "sum of |gain|^2 of the paths")
        symbols = self.over(lambda s: _by_symbol(s.record.symbols), np.zeros((3, 3)), np.int64)
        for i, (name, text) in enumerate((("errors", "wrong or undecided"), ("erased", "undecided"), ("total", "sent to the observer"))):
            self.put(f"symbol_{name}", [*two, "symbol"], symbols[:, :, i], DIMENSIONLESS, f"symbols, {text}")

    def ragged(
        self, prefix: str, dim: str, rows: Sequence[tuple[int, int, Mapping[str, np.ndarray]]], columns: Mapping[str, tuple]
    ) -> None:
        """Flat columns over `dim` with the frame and the observer of every row; a column is (dtype, unit, meaning)."""
        count = [len(next(iter(r[2].values()))) for r in rows]
        index = np.repeat(np.array([r[:2] for r in rows], np.int32).reshape(-1, 2), count, axis=0)
        self.put(f"{prefix}_frame", [dim], index[:, 0], DIMENSIONLESS, "position along the dimension frame")
        self.put(f"{prefix}_observer", [dim], index[:, 1], DIMENSIONLESS, "position along the dimension observer")
        for name, (dtype, units, text) in columns.items():
            parts = [np.asarray(r[2][name], dtype) for r in rows]
            self.put(f"{prefix}_{name}", [dim], np.concatenate(parts) if parts else np.zeros(0, dtype), units, text)

    def detections(self) -> None:
        rows = []
        for i, j, s in self.records():
            d = s.record.reception.detections
            rows.append((i, j, {
                "range": d.range, "velocity": d.velocity, "u_x": d.direction[:, 0], "u_z": d.direction[:, 1], "snr": d.snr,
                "range_std": d.std[:, 0], "velocity_std": d.std[:, 1], "u_x_std": d.std[:, 2], "u_z_std": d.std[:, 3],
                "is_reference": d.is_reference, "kind": s.record.detection_kind, "target": s.record.detection_target,
                "order": s.record.detection_order, "face": s.record.detection_face,
            }))  # fmt: skip
        self.ragged("det", "detection", rows, {
            "range": (float, "m", "range of the detection; one way at the AT, path length at a PT"),
            "velocity": (float, "m s-1", "rate of the range, positive receding"),
            "u_x": (float, DIMENSIONLESS, "direction cosine along the body's X axis"),
            "u_z": (float, DIMENSIONLESS, "direction cosine along the body's Z axis"),
            "snr": (float, DIMENSIONLESS, "SNR of the range-Doppler cell, linear"),
            "range_std": (float, "m", "standard deviation of the range"),
            "velocity_std": (float, "m s-1", "standard deviation of the velocity"),
            "u_x_std": (float, DIMENSIONLESS, "standard deviation of u_x"),
            "u_z_std": (float, DIMENSIONLESS, "standard deviation of u_z"),
            "is_reference": (bool, DIMENSIONLESS, "line of sight at a PT"),
            "kind": (np.int8, DIMENSIONLESS, "kind of the path that explains it, -1: none"),
            "target": (np.int16, DIMENSIONLESS, "index of the UAV that explains it, -1: none"),
            "order": (np.int16, DIMENSIONLESS, "interactions with the city of the path that explains it, 0: direct, -1: no path"),
            "face": (np.int32, DIMENSIONLESS, "first face of the city's mesh on the path that explains it, -1: none"),
        })  # fmt: skip

    def tracks(self) -> None:
        rows = [(i, j, vars(s.record.tracks)) for i, j, s in self.records()]
        self.ragged("track", "track", rows, {
            "id": (np.int32, DIMENSIONLESS, "number of the track, unique at its observer"), "range": (float, "m", "range of the track"),
            "velocity": (float, "m s-1", "radial velocity of the track, positive receding"),
            "u_x": (float, DIMENSIONLESS, "direction cosine along the body's X axis"),
            "u_z": (float, DIMENSIONLESS, "direction cosine along the body's Z axis"),
            "confirmed": (bool, DIMENSIONLESS, "the track is confirmed"),
            "uav": (np.int16, DIMENSIONLESS, "index of the UAV that it follows, -1: none"),
        })  # fmt: skip

    def ledger(self) -> None:
        kept = [(i, j, s.ledger) for i, j, s in self.records() if s.ledger is not None]
        rows = [(i, j, {**path_columns(p), "target": self._uav_index(p)}) for i, j, p in kept]
        self.ragged("path", "path", rows, PATH_COLUMNS)

    def _uav_index(self, paths: PathSet) -> np.ndarray:
        """Targets of a path set as indices of the scenario's UAVs."""
        order = list(self.scenario.swarm)
        lookup = np.array([order.index(name) for name in paths.target_names] + [-1])
        return lookup[paths.target]

    def maps(self) -> None:
        shots = [i for i, f in enumerate(self.frames) if any(s.record.reception.maps is not None for s in f.observers.values())]
        place = {i: k for k, i in enumerate(shots)}
        found = [(place[i], j, maps) for i, j, s in self.records() if (maps := s.record.reception.maps) is not None]
        rows, doppler = (max((m.range_doppler.shape[a] for _, _, m in found), default=0) for a in (0, 1))
        cells, chirps = (max((m.equivalent_range.shape[a] for _, _, m in found), default=0) for a in (0, 1))
        head = (len(shots), len(self.observers))
        power, equivalent = np.full((*head, rows, doppler), np.nan, np.float32), np.full((*head, cells, chirps), np.nan, np.float32)
        marked = np.zeros((*head, cells, chirps), bool)
        ranges, speeds = np.full((head[1], rows), np.nan), np.full((head[1], doppler), np.nan)
        for k, j, m in found:
            power[k, j, : m.range_doppler.shape[0], : m.range_doppler.shape[1]] = m.range_doppler
            equivalent[k, j, : m.equivalent_range.shape[0], : m.equivalent_range.shape[1]] = m.equivalent_range
            marked[k, j, : m.equivalent_range.shape[0], : m.equivalent_range.shape[1]] = m.equivalent_detections
            ranges[j, : m.range_axis.size], speeds[j, : m.velocity_axis.size] = m.range_axis, m.velocity_axis
        self.put("snapshot_frame", ["snapshot"], np.array(shots, np.int32), DIMENSIONLESS, "position along the dimension frame")
        self.put("map_power", ["snapshot", "observer", "row", "doppler"], power, "W", "range-Doppler map, accumulated over antennas")
        self.put("map_range", ["observer", "row"], ranges, "m", "range of the map's rows")
        self.put("map_velocity", ["observer", "doppler"], speeds, "m s-1", "velocity of the map's columns")
        self.put("map_equivalent_range", ["snapshot", "observer", "cell", "chirp"], equivalent, "W0.5",
                 "magnitude over range cell and chirp before data removal")  # fmt: skip
        self.put("map_equivalent_detections", ["snapshot", "observer", "cell", "chirp"], marked, DIMENSIONLESS,
                 "cells that the one-dimensional CFAR finds, chirp by chirp")  # fmt: skip


def _by_symbol(c: SymbolCount) -> tuple[tuple[int, int, int], ...]:
    """Errors, erased and total, each in the order of `SYMBOLS`."""
    return (
        (c.delay_errors, c.dpsk_errors, c.bit_errors),
        (c.delay_erased, c.dpsk_erased, c.bits_total - c.bits_decoded),
        (c.delay_total, c.dpsk_total, c.bits_total),
    )


PATH_COLUMNS: dict[str, tuple] = {
    "gain_re": (float, DIMENSIONLESS, "real part of the complex gain without carrier phase"),
    "gain_im": (float, DIMENSIONLESS, "imaginary part of the complex gain without carrier phase"),
    "power_db": (float, "dB", "|gain|^2"),
    "delay": (float, "s", "delay at the middle of the frame"),
    "delay_rate": (float, DIMENSIONLESS, "rate of the delay"),
    "delay_accel": (float, "s-1", "second derivative of the delay"),
    **{f"departure_{a}": (float, DIMENSIONLESS, f"{a} of the unit vector along the first segment, world axes") for a in "xyz"},
    **{f"arrival_{a}": (float, DIMENSIONLESS, f"{a} of the unit vector towards where the wave comes from, world axes") for a in "xyz"},
    "kind": (np.int8, DIMENSIONLESS, "kind of path, an index into the dimension kind"),
    "target": (np.int16, DIMENSIONLESS, "index of the UAV involved, -1: none"),
    "bounces": (np.int16, DIMENSIONLESS, "interactions with the city"),
    "begin": (float, "s", "start of the path's life since the middle of the frame"),
    "end": (float, "s", "end of the path's life since the middle of the frame"),
}


def path_columns(p: PathSet) -> dict[str, np.ndarray]:
    """The columns `PATH_COLUMNS` of a path set."""
    with np.errstate(divide="ignore"):
        power_db = 10 * np.log10(p.power)
    columns = {"gain_re": p.gain.real, "gain_im": p.gain.imag, "power_db": power_db}
    columns |= {name: getattr(p, name) for name in ("delay", "delay_rate", "delay_accel", "kind", "target", "bounces", "begin", "end")}
    columns |= {f"{end}_{a}": getattr(p, end)[:, i] for end in ("departure", "arrival") for i, a in enumerate("xyz")}
    return columns


def _atomically(file: Path, write: Callable[[Path], object]) -> None:
    """Have `write` make a file under a temporary name beside `file`, then put it in place whole; or raise and leave nothing."""
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        os.replace(temporary, file)
    except OSError as problem:
        reason = problem.strerror or str(problem)
        raise ResultsError(f"cannot write {file}: {reason}; choose another place with --out, or make room") from problem
    finally:
        try:
            temporary.unlink(missing_ok=True)
        except OSError:  # its folder is no folder: there is nothing to take away
            pass


def write_text(file: Path, text: str) -> None:
    """A text file that appears whole or not at all."""
    _atomically(Path(file), lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_bytes(file: Path, write: Callable[[Path], object]) -> None:
    """A file made by `write(temporary path)` that appears whole or not at all."""
    _atomically(Path(file), write)


def write_dataset(dataset: xr.Dataset, file: Path) -> None:
    """A NetCDF file, compressed, that appears whole or not at all."""
    encoding = {
        name: {"zlib": True, "complevel": 4, "shuffle": True}
        for name, v in dataset.variables.items()
        if v.dtype != object and v.ndim and v.size
    }
    _atomically(file, lambda temporary: dataset.to_netcdf(temporary, engine="h5netcdf", encoding=encoding))


def save(results: Results, folder: str | Path) -> None:
    """Write ``results.nc``, ``summary.json`` and ``scenario.yaml`` into `folder`; each appears whole or not at all.

    Raises
    ------
    ResultsError  If the folder cannot be written.
    """
    folder = Path(folder)
    write_dataset(results.dataset, folder / FILE)
    write_text(folder / "scenario.yaml", to_yaml(results.scenario, folder))
    write_text(folder / "summary.json", json.dumps(results.summary, indent=1, allow_nan=False) + "\n")


def check_folder(folder: str | Path) -> None:
    """Refuse a folder that cannot be made or written, before a long run rather than after it."""
    probe = Path(folder) / ".writable"
    write_text(probe, "")
    probe.unlink(missing_ok=True)


def load(folder: str | Path) -> Results:
    """Results that `save` wrote into `folder`.

    Raises
    ------
    ResultsError  If a file is missing or is not one of ours.
    """
    from isac_rt.scenario_file import load as load_scenario

    folder = Path(folder)
    try:
        with xr.open_dataset(folder / FILE, engine="h5netcdf") as opened:
            dataset = opened.load()
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise ResultsError(f"cannot read results in {folder}: {problem}; give the folder that `isac-rt run` wrote") from problem
    return Results(dataset, summary, load_scenario(folder / "scenario.yaml"))
