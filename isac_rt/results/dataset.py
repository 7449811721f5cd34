"""Records of frames to one labelled dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import numpy as np
import xarray as xr

from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathSet
from isac_rt.results.metrics import SymbolCount
from isac_rt.results.records import KINDS, _Slim, _SlimFrame, _sparse
from isac_rt.scenario.tree import Scenario

SYMBOLS = ("delay", "dpsk", "bit")


MEASURES = {
    "range": ("m", "range_m"),
    "velocity": ("m s-1", "velocity_mps"),
    "azimuth": ("rad", "azimuth_deg"),
    "elevation": ("rad", "elevation_deg"),
}
"""What is estimated of a UAV: unit inside, key in the summary."""


def errors_of(dataset: xr.Dataset, group: str, name: str) -> np.ndarray:
    """ "detected" or "tracked" value less the truth (frame, observer, uav), NaN where none; angles
    [rad] wrapped to (-pi, pi]."""
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

    def put(
        self, name: str, dims: Sequence[str], values: Any, units: str, long_name: str, **attrs: Any
    ) -> None:
        self.out[name] = xr.Variable(
            tuple(dims), np.asarray(values), {"units": units, "long_name": long_name, **attrs}
        )

    def over(self, value: Callable[[_Slim], Any], missing: Any, dtype: type) -> np.ndarray:
        """(frame, observer, ...) of a value of each record; `missing` where an observer did not
        receive in a frame."""
        rows = [
            [value(f.observers[o]) if o in f.observers else missing for o in self.observers]
            for f in self.frames
        ]
        return np.array(rows, dtype=dtype).reshape(
            len(self.frames), len(self.observers), *np.shape(missing)
        )

    def records(self) -> list[tuple[int, int, _Slim]]:
        """(position of the frame, of the observer, record) in order."""
        return [
            (i, j, f.observers[o])
            for i, f in enumerate(self.frames)
            for j, o in enumerate(self.observers)
            if o in f.observers
        ]

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
            "carrier_hz": w.carrier_frequency,
            "effective_carrier_hz": w.effective_carrier,
            "frame_duration_s": w.frame_duration,
            "frame_interval_s": self.scenario.frame_interval_s or w.frame_duration,
            "range_cell_m": w.range_cell(1),
            "velocity_cell_mps": w.velocity_cell(1),
        }
        return xr.Dataset(self.out, attrs=numbers)

    def frame_values(self) -> None:
        names = list(self.scenario.swarm)
        self.put(
            "frame",
            ["frame"],
            np.array([f.frame for f in self.frames], np.int64),
            DIMENSIONLESS,
            "index of the frame",
        )
        self.put(
            "observer",
            ["observer"],
            np.array(self.observers, object),
            DIMENSIONLESS,
            "link, by its receiver where that is enough",
        )
        self.put("uav", ["uav"], np.array(names, object), DIMENSIONLESS, "unmanned aerial vehicle")
        self.put(
            "role",
            ["uav"],
            np.array([self.scenario.swarm[n].role for n in names], object),
            DIMENSIONLESS,
            "role of the UAV at the start",
        )
        self.put("kind", ["kind"], np.array(KINDS, object), DIMENSIONLESS, "kind of path")
        self.put("symbol", ["symbol"], np.array(SYMBOLS, object), DIMENSIONLESS, "kind of symbol")
        self.put(
            "axis",
            ["axis"],
            np.array(list("xyz"), object),
            DIMENSIONLESS,
            "world axis: east, north, up",
        )
        self.put(
            "body_axis",
            ["body_axis"],
            np.array(["right", "boresight", "up"], object),
            DIMENSIONLESS,
            "body axis",
        )
        self.put(
            "time",
            ["frame"],
            np.array([f.time for f in self.frames], float),
            "s",
            "time of the middle of the frame",
        )
        self.put(
            "modulated",
            ["frame"],
            np.array([f.modulated for f in self.frames], bool),
            DIMENSIONLESS,
            "the frame carries data",
        )
        for i, end in enumerate(("transmitter", "receiver")):
            ends = np.array([link[i] for link in self.timetable.labels], object)
            self.put(end, ["observer"], ends, DIMENSIONLESS, f"{end} of the observer's link")
        for name, units in (("position", "m"), ("velocity", "m s-1"), ("acceleration", "m s-2")):
            values = np.array(
                [[getattr(f.poses[n], name) for n in names] for f in self.frames], float
            ).reshape(-1, len(names), 3)
            self.put(
                f"uav_{name}",
                ["frame", "uav", "axis"],
                values,
                units,
                f"{name} of the UAV in world axes",
            )
        turned = np.array(
            [[f.poses[n].rotation for n in names] for f in self.frames], float
        ).reshape(-1, len(names), 3, 3)
        self.put(
            "uav_attitude",
            ["frame", "uav", "axis", "body_axis"],
            turned,
            DIMENSIONLESS,
            "body axes of the UAV in world axes",
        )

    def uav_values(self) -> None:
        count = len(self.scenario.swarm)
        none, no = np.full(count, np.nan), np.zeros(count, bool)
        dims = ["frame", "observer", "uav"]
        meaning = {"truth": "true", "detected": "detected", "tracked": "tracked"}
        for group, word in meaning.items():
            for name, (units, _) in MEASURES.items():
                values = self.over(attrgetter(f"record.{group}.{name}"), none, float)
                self.put(
                    f"{group}_{name}",
                    dims,
                    values,
                    units,
                    f"{word} {name} of the UAV, seen by the observer",
                )
        self.put(
            "in_view",
            dims,
            self.over(lambda s: s.record.in_view, no, bool),
            DIMENSIONLESS,
            "UAV inside the field of view",
        )
        self.put(
            "shadowed",
            dims,
            self.over(lambda s: s.record.shadowed, no, bool),
            DIMENSIONLESS,
            "UAV hidden by the city",
        )

    def counts(self) -> None:
        two, zero = ["frame", "observer"], np.zeros(len(KINDS))
        self.put(
            "processed",
            two,
            self.over(lambda s: True, False, bool),
            DIMENSIONLESS,
            "the observer processed the frame",
        )
        self.put(
            "state",
            two,
            self.over(lambda s: s.record.state, -1, np.int8),
            DIMENSIONLESS,
            "state of the terminal, -1: not processed",
            flag_values=np.arange(len(self.states), dtype=np.int8),
            flag_meanings=" ".join(self.states),
        )
        for name, text, get in (
            ("decoded", "data symbols were decided", lambda s: s.record.reception.decoded),
            (
                "line_of_sight",
                "the receiver says that it sees its reference path",
                lambda s: s.record.reception.line_of_sight,
            ),
            (
                "fell_back",
                "sent by the conventional schedule in place of the random one",
                lambda s: s.record.fell_back,
            ),
        ):
            self.put(name, two, self.over(get, False, bool), DIMENSIONLESS, text)
        self.put(
            "sparse",
            two,
            self.over(_sparse, -1, np.int8),
            DIMENSIONLESS,
            "the receiver found the scene sparse: 1, not: 0, not judged: -1",
        )
        power = self.over(lambda s: s.record.reception.reference_power, np.nan, float)
        self.put(
            "reference_power",
            two,
            power,
            "W",
            "mean power of the reference path per sample and antenna, as received",
        )
        self.put(
            "reference_snr",
            two,
            self.over(lambda s: s.record.reference_snr, np.nan, float),
            DIMENSIONLESS,
            "SNR of the reference path per sample and antenna before processing, linear",
        )
        self.put(
            "num_false",
            two,
            self.over(lambda s: s.record.num_false, 0, np.int32),
            DIMENSIONLESS,
            "detections that no path explains",
        )
        self.put(
            "slips",
            two,
            self.over(lambda s: s.record.slips, 0, np.int32),
            DIMENSIONLESS,
            "symbols decided outside their alphabet",
        )
        self.put(
            "path_count",
            [*two, "kind"],
            self.over(lambda s: s.counts, zero, np.int32),
            DIMENSIONLESS,
            "number of paths",
        )
        self.put(
            "path_power",
            [*two, "kind"],
            self.over(lambda s: s.power, zero, float),
            DIMENSIONLESS,
            "sum of |gain|^2 of the paths",
        )
        symbols = self.over(lambda s: _by_symbol(s.record.symbols), np.zeros((3, 3)), np.int64)
        for i, (name, text) in enumerate(
            (
                ("errors", "wrong or undecided"),
                ("erased", "undecided"),
                ("total", "sent to the observer"),
            )
        ):
            self.put(
                f"symbol_{name}",
                [*two, "symbol"],
                symbols[:, :, i],
                DIMENSIONLESS,
                f"symbols, {text}",
            )

    def ragged(
        self,
        prefix: str,
        dim: str,
        rows: Sequence[tuple[int, int, Mapping[str, np.ndarray]]],
        columns: Mapping[str, tuple],
    ) -> None:
        """Flat columns over `dim` with the frame and the observer of every row; a column is (dtype,
        unit, meaning)."""
        count = [len(next(iter(r[2].values()))) for r in rows]
        index = np.repeat(np.array([r[:2] for r in rows], np.int32).reshape(-1, 2), count, axis=0)
        self.put(
            f"{prefix}_frame",
            [dim],
            index[:, 0],
            DIMENSIONLESS,
            "position along the dimension frame",
        )
        self.put(
            f"{prefix}_observer",
            [dim],
            index[:, 1],
            DIMENSIONLESS,
            "position along the dimension observer",
        )
        for name, (dtype, units, text) in columns.items():
            parts = [np.asarray(r[2][name], dtype) for r in rows]
            self.put(
                f"{prefix}_{name}",
                [dim],
                np.concatenate(parts) if parts else np.zeros(0, dtype),
                units,
                text,
            )

    def detections(self) -> None:
        rows = []
        for i, j, s in self.records():
            d = s.record.reception.detections
            rows.append(
                (
                    i,
                    j,
                    {
                        "range": d.range,
                        "velocity": d.velocity,
                        "u_x": d.direction[:, 0],
                        "u_z": d.direction[:, 1],
                        "snr": d.snr,
                        "range_std": d.std[:, 0],
                        "velocity_std": d.std[:, 1],
                        "u_x_std": d.std[:, 2],
                        "u_z_std": d.std[:, 3],
                        "is_reference": d.is_reference,
                        "kind": s.record.detection_kind,
                        "target": s.record.detection_target,
                        "order": s.record.detection_order,
                        "face": s.record.detection_face,
                    },
                )
            )
        self.ragged(
            "det",
            "detection",
            rows,
            {
                "range": (
                    float,
                    "m",
                    "range of the detection; one way at the AT, path length at a PT",
                ),
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
                "order": (
                    np.int16,
                    DIMENSIONLESS,
                    "interactions with the city of the path that explains it, 0: direct, -1: no "
                    "path",
                ),
                "face": (
                    np.int32,
                    DIMENSIONLESS,
                    "first face of the city's mesh on the path that explains it, -1: none",
                ),
            },
        )

    def tracks(self) -> None:
        rows = [(i, j, vars(s.record.tracks)) for i, j, s in self.records()]
        self.ragged(
            "track",
            "track",
            rows,
            {
                "id": (np.int32, DIMENSIONLESS, "number of the track, unique at its observer"),
                "range": (float, "m", "range of the track"),
                "velocity": (float, "m s-1", "radial velocity of the track, positive receding"),
                "u_x": (float, DIMENSIONLESS, "direction cosine along the body's X axis"),
                "u_z": (float, DIMENSIONLESS, "direction cosine along the body's Z axis"),
                "confirmed": (bool, DIMENSIONLESS, "the track is confirmed"),
                "uav": (np.int16, DIMENSIONLESS, "index of the UAV that it follows, -1: none"),
            },
        )

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
        shots = [
            i
            for i, f in enumerate(self.frames)
            if any(s.record.reception.maps is not None for s in f.observers.values())
        ]
        place = {i: k for k, i in enumerate(shots)}
        found = [
            (place[i], j, maps)
            for i, j, s in self.records()
            if (maps := s.record.reception.maps) is not None
        ]
        rows, doppler = (
            max((m.range_doppler.shape[a] for _, _, m in found), default=0) for a in (0, 1)
        )
        cells, chirps = (
            max((m.equivalent_range.shape[a] for _, _, m in found), default=0) for a in (0, 1)
        )
        head = (len(shots), len(self.observers))
        power, equivalent = (
            np.full((*head, rows, doppler), np.nan, np.float32),
            np.full((*head, cells, chirps), np.nan, np.float32),
        )
        marked = np.zeros((*head, cells, chirps), bool)
        ranges, speeds = np.full((head[1], rows), np.nan), np.full((head[1], doppler), np.nan)
        for k, j, m in found:
            power[k, j, : m.range_doppler.shape[0], : m.range_doppler.shape[1]] = m.range_doppler
            equivalent[k, j, : m.equivalent_range.shape[0], : m.equivalent_range.shape[1]] = (
                m.equivalent_range
            )
            marked[k, j, : m.equivalent_range.shape[0], : m.equivalent_range.shape[1]] = (
                m.equivalent_detections
            )
            ranges[j, : m.range_axis.size], speeds[j, : m.velocity_axis.size] = (
                m.range_axis,
                m.velocity_axis,
            )
        self.put(
            "snapshot_frame",
            ["snapshot"],
            np.array(shots, np.int32),
            DIMENSIONLESS,
            "position along the dimension frame",
        )
        self.put(
            "map_power",
            ["snapshot", "observer", "row", "doppler"],
            power,
            "W",
            "range-Doppler map, accumulated over antennas",
        )
        self.put("map_range", ["observer", "row"], ranges, "m", "range of the map's rows")
        self.put(
            "map_velocity",
            ["observer", "doppler"],
            speeds,
            "m s-1",
            "velocity of the map's columns",
        )
        self.put(
            "map_equivalent_range",
            ["snapshot", "observer", "cell", "chirp"],
            equivalent,
            "W0.5",
            "magnitude over range cell and chirp before data removal",
        )
        self.put(
            "map_equivalent_detections",
            ["snapshot", "observer", "cell", "chirp"],
            marked,
            DIMENSIONLESS,
            "cells that the one-dimensional CFAR finds, chirp by chirp",
        )


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
    **{
        f"departure_{a}": (
            float,
            DIMENSIONLESS,
            f"{a} of the unit vector along the first segment, world axes",
        )
        for a in "xyz"
    },
    **{
        f"arrival_{a}": (
            float,
            DIMENSIONLESS,
            f"{a} of the unit vector towards where the wave comes from, world axes",
        )
        for a in "xyz"
    },
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
    columns |= {
        name: getattr(p, name)
        for name in (
            "delay",
            "delay_rate",
            "delay_accel",
            "kind",
            "target",
            "bounces",
            "begin",
            "end",
        )
    }
    columns |= {
        f"{end}_{a}": getattr(p, end)[:, i]
        for end in ("departure", "arrival")
        for i, a in enumerate("xyz")
    }
    return columns
