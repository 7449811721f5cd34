"""Records of frames to rows of tables, and tables to one labelled dataset.

What every link has in every frame is an array over frame and observer; what differs in number
(detections, tracks, paths) is ragged: flat columns beside the frame and the observer of each row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, fields
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from isac_rt.frame.timetable import Timetable
from isac_rt.propagation.pathset import PathSet
from isac_rt.results.losses import LOSSES
from isac_rt.results.metrics import SymbolCount
from isac_rt.results.records import KINDS, FrameRecord, ObserverRecord, PictureRecord, Use
from isac_rt.results.rows import Table

if TYPE_CHECKING:
    import xarray as xr

Row = dict[str, dict[str, Any]]
"""A frame: of each of `TABLES`, and of a snapshot's ``path`` and ``maps``, what each observer or
picture has."""
Tables = Mapping[str, Mapping[str, Table]]
"""The frames so far: of each of `TABLES`, what each observer or picture has."""
Columns = Mapping[str, np.ndarray] | np.ndarray
"""Rows of a table: arrays by name, or an array with named fields."""
DIMENSIONLESS = "1"
COMPONENTS = ("x", "y", "z", "v_x", "v_y", "v_z")
SYMBOLS = ("delay", "dpsk", "bit")
PARTS = ("localisation", "missed", "false")
"""Of the GOSPA distance."""
ERRORS = ("position", "velocity", "squared")
"""Measures of a body's error."""
SIZES = {
    "kind": len(KINDS),
    "symbol": len(SYMBOLS),
    "part": len(PARTS),
    "measure": len(ERRORS),
    "count": len(fields(SymbolCount)),
    **dict.fromkeys(("axis", "body_axis"), 3),
    **dict.fromkeys(("component", "component_2"), len(COMPONENTS)),
}
"""Lengths of the dimensions of a row, but for that of the UAVs."""
MEASURES = {
    "range": ("m", "range_m"),
    "velocity": ("m s-1", "velocity_mps"),
    "azimuth": ("rad", "azimuth_deg"),
    "elevation": ("rad", "elevation_deg"),
}
"""What is estimated of a UAV: unit inside, key in the summary."""


def errors_of(values: xr.Dataset | Columns, group: str, name: str) -> np.ndarray:
    """Value of "detected" or "tracked" less the truth, NaN where none: (frame, observer, uav) of a
    dataset, (frame, uav) of an observer's table.

    Angles are wrapped to (-pi, pi] [rad].
    """
    e = np.asarray(values[f"{group}_{name}"]) - np.asarray(values[f"truth_{name}"])
    return np.angle(np.exp(1j * e)) if MEASURES[name][0] == "rad" else e


def tracked_states(dataset: xr.Dataset) -> np.ndarray:
    """(K, 6) state of every track in world axes [m, m/s]: what its observer tracked, added to where
    the observer is."""
    own = [list(dataset.uav.values).index(name) for name in dataset.receiver.values]
    frame, uav = dataset.track_frame.values, np.array(own)[dataset.track_observer.values]
    of = [dataset[f"uav_{name}"].values[frame, uav] for name in ("position", "velocity")]
    return np.asarray(dataset.track_state.values + np.concatenate(of, axis=1))


def fused_positions(dataset: xr.Dataset, frame: int, picture: str) -> np.ndarray:
    """(B, 3) where the picture of a terminal, or of the swarm, has bodies that are no terminals
    [m]; none where terminals do not cooperate."""
    if "picture" not in dataset.variables:
        return np.zeros((0, 3))
    mine = (
        (dataset.fused_frame.values == frame)
        & (dataset.fused_picture.values == list(dataset.picture.values).index(picture))
        & (dataset.fused_terminal.values < 0)
    )
    return np.column_stack([dataset[f"fused_{axis}"].values[mine] for axis in "xyz"])


class Column(NamedTuple):
    """How an array of the dataset is made: from which attribute (or by which function) of a record
    or a `PathSet`, over which dimensions beside frame and observer (or beside a
    row), and with which value where an observer did not receive (or a row is shorter)."""

    dtype: type
    units: str
    meaning: str
    source: str | Callable[[Any], Any]
    dims: tuple[str, ...] = ()
    missing: float = 0

    def read(self, record: object) -> Any:
        """The value of a record."""
        get = attrgetter(self.source) if isinstance(self.source, str) else self.source
        return get(record)


def _number(meaning: str, source: str | Callable[[Any], Any], dtype: type, **more: Any) -> Column:
    return Column(dtype, DIMENSIONLESS, meaning, source, **more)


def _found_sparse(o: ObserverRecord) -> int:
    return -1 if o.reception.sparse is None else int(o.reception.sparse)


def _path_counts(o: ObserverRecord) -> np.ndarray:
    return np.bincount(o.paths.kind, minlength=len(KINDS))


def _path_powers(o: ObserverRecord) -> np.ndarray:
    return np.bincount(o.paths.kind, weights=o.paths.power, minlength=len(KINDS))


def _of_poses(name: str) -> Callable[[FrameRecord], list[np.ndarray]]:
    return lambda record: [getattr(pose, name) for pose in record.poses.values()]


FRAMES: dict[str, Column] = {
    "frame": _number("index of the frame", "frame", np.int64),
    "time": Column(float, "s", "time of the middle of the frame", "time"),
    "modulated": _number("the frame carries data", "modulated", bool),
    **{
        f"uav_{name}": Column(
            float, units, f"{name} of the UAV in world axes", _of_poses(name), ("uav", "axis")
        )
        for name, units in (("position", "m"), ("velocity", "m s-1"), ("acceleration", "m s-2"))
    },
    "uav_attitude": _number(
        "body axes of the UAV in world axes",
        _of_poses("rotation"),
        float,
        dims=("uav", "axis", "body_axis"),
    ),
}
"""One value for each frame."""
OBSERVERS: dict[str, Column] = {
    **{
        f"{group}_{name}": Column(
            float,
            units,
            f"{word} {name} of the UAV, seen by the observer",
            f"{group}.{name}",
            ("uav",),
            np.nan,
        )
        for group, word in (("truth", "true"), ("detected", "detected"), ("tracked", "tracked"))
        for name, (units, _) in MEASURES.items()
    },
    **{
        f"bound_{name}": Column(
            float,
            units,
            f"least standard deviation of an estimate of the {name} in noise (Cramer-Rao)",
            f"bound.{name}",
            ("uav",),
            np.nan,
        )
        for name, (units, _) in MEASURES.items()
    },
    "in_view": _number("UAV inside the field of view", "in_view", bool, dims=("uav",)),
    "shadowed": _number("UAV hidden by the city", "shadowed", bool, dims=("uav",)),
    "hit": _number(
        "UAV found by its own path within one resolution on all four axes",
        "hit",
        bool,
        dims=("uav",),
    ),
    "loss": _number(
        "what became of a UAV in view and unshadowed, -1: not one",
        "loss",
        np.int8,
        dims=("uav",),
        missing=-1,
    ),
    "target_snr": _number(
        "SNR of the UAV's own path behind a matched filter over samples, chirps and antennas",
        "target_snr",
        float,
        dims=("uav",),
        missing=np.nan,
    ),
    "target_clutter": _number(
        "power of the diffuse paths in the UAV's cell over the noise of one channel's map",
        "target_clutter",
        float,
        dims=("uav",),
        missing=np.nan,
    ),
    "cooperative": _number("UAV that is a terminal", "cooperative", bool, dims=("uav",)),
    "genie": _number(
        "probability that a matched filter at the true parameters finds the UAV's own path",
        "genie",
        float,
        dims=("uav",),
        missing=np.nan,
    ),
    "clutter_free": _number(
        "probability that the receiver's detector would find the UAV in noise alone",
        "clutter_free",
        float,
        dims=("uav",),
        missing=np.nan,
    ),
    **{
        f"{of}_{part}": Column(
            float,
            "m2",
            f"{words} in the square of the GOSPA distance of the confirmed tracks{but}",
            f"{of}.{part}",
            missing=np.nan,
        )
        for of, but in (("gospa", ""), ("gospa_targets", ", terminals left out"))
        for part, words in (
            ("localisation", "errors of position"),
            ("missed", "UAVs without a track"),
            ("false", "tracks without a UAV"),
        )
    },
    "processed": _number("the observer processed the frame", lambda o: True, bool),
    "state": _number("state of the terminal, -1: not processed", "state", np.int8, missing=-1),
    "decoded": _number("data symbols were decided", "reception.decoded", bool),
    "latency_frames": _number(
        "frames after which the data were read, 0: at once, -1: not, or no data",
        "latency",
        np.int16,
        missing=-1,
    ),
    "line_of_sight": _number(
        "the receiver says that it sees its reference path", "reception.line_of_sight", bool
    ),
    "fell_back": _number(
        "sent by the conventional schedule in place of the random one", "fell_back", bool
    ),
    "sparse": _number(
        "the receiver found the scene sparse: 1, not: 0, not judged: -1",
        _found_sparse,
        np.int8,
        missing=-1,
    ),
    "reference_power": Column(
        float,
        "W",
        "mean power of the reference path per sample and antenna, as received",
        "reception.reference_power",
        missing=np.nan,
    ),
    "reference_snr": _number(
        "SNR of the reference path per sample and antenna before processing, linear",
        "reference_snr",
        float,
        missing=np.nan,
    ),
    "num_false": _number("detections that no path explains", "num_false", np.int32),
    "num_clutter": _number(
        "detections that something other than a UAV's own path explains", "num_clutter", np.int32
    ),
    "slips": _number("symbols decided outside their alphabet", "slips", np.int32),
    "path_count": _number("number of paths", _path_counts, np.int32, dims=("kind",)),
    "path_power": _number("sum of |gain|^2 of the paths", _path_powers, float, dims=("kind",)),
    "symbol_errors": _number(
        "symbols, wrong or undecided",
        lambda o: [o.symbols.delay_errors, o.symbols.dpsk_errors, o.symbols.bit_errors],
        np.int64,
        dims=("symbol",),
    ),
    "symbol_erased": _number(
        "symbols, undecided",
        lambda o: [
            o.symbols.delay_erased,
            o.symbols.dpsk_erased,
            o.symbols.bits_total - o.symbols.bits_decoded,
        ],
        np.int64,
        dims=("symbol",),
    ),
    "symbol_total": _number(
        "symbols, sent to the observer",
        lambda o: [o.symbols.delay_total, o.symbols.dpsk_total, o.symbols.bits_total],
        np.int64,
        dims=("symbol",),
    ),
}
"""One value for each frame and observer."""


def _of_detections(name: str, column: int | None = None) -> Callable[[ObserverRecord], np.ndarray]:
    def read(o: ObserverRecord) -> np.ndarray:
        values = getattr(o.reception.detections, name)
        return values if column is None else values[:, column]

    return read


DETECTIONS: dict[str, Column] = {
    "range": Column(
        float,
        "m",
        "range of the detection; one way at the AT, path length at a PT",
        _of_detections("range"),
    ),
    "velocity": Column(
        float, "m s-1", "rate of the range, positive receding", _of_detections("velocity")
    ),
    "u_x": _number(
        "direction cosine along the body's X axis", _of_detections("direction", 0), float
    ),
    "u_z": _number(
        "direction cosine along the body's Z axis", _of_detections("direction", 1), float
    ),
    "snr": _number("SNR of the range-Doppler cell, linear", _of_detections("snr"), float),
    **{
        f"{name}_std": Column(
            float, units, f"standard deviation of {article}{name}", _of_detections("std", i)
        )
        for i, (name, units, article) in enumerate(
            (
                ("range", "m", "the "),
                ("velocity", "m s-1", "the "),
                ("u_x", DIMENSIONLESS, ""),
                ("u_z", DIMENSIONLESS, ""),
            )
        )
    },
    "is_reference": _number("line of sight at a PT", _of_detections("is_reference"), bool),
    "kind": _number("kind of the path that explains it, -1: none", "detection_kind", np.int8),
    "target": _number("index of the UAV that explains it, -1: none", "detection_target", np.int16),
    "order": _number(
        "interactions with the city of the path that explains it, 0: direct, -1: no path",
        "detection_order",
        np.int16,
    ),
    "face": _number(
        "first face of the city's mesh on the path that explains it, -1: none",
        "detection_face",
        np.int32,
    ),
    "skirt": _number(
        "the path that explains it lies more than a cell away", "detection_skirt", bool
    ),
}
TRACKS: dict[str, Column] = {
    "id": _number("number of the track, unique at its observer", "tracks.id", np.int32),
    "range": Column(float, "m", "range of the track", "tracks.range"),
    "velocity": Column(
        float, "m s-1", "radial velocity of the track, positive receding", "tracks.velocity"
    ),
    "u_x": _number("direction cosine along the body's X axis", "tracks.u_x", float),
    "u_z": _number("direction cosine along the body's Z axis", "tracks.u_z", float),
    "confirmed": _number("the track is confirmed", "tracks.confirmed", bool),
    "state": _number(
        "position [m] and velocity [m/s] relative to the observer, world axes",
        "tracks.state",
        float,
        dims=("component",),
    ),
    "covariance": _number(
        "covariance of the state [m^2, m^2/s, m^2/s^2]",
        "tracks.covariance",
        float,
        dims=("component", "component_2"),
    ),
    "kind": _number(
        "kind of the path that explains its latest detection, -1: none", "tracks.kind", np.int8
    ),
    "target": _number(
        "index of the UAV on the path that explains its latest detection, -1: none",
        "tracks.target",
        np.int16,
    ),
    "uav": _number("index of the UAV in view that it follows, -1: none", "tracks.uav", np.int16),
}


def _of_picture(name: str, column: int) -> Callable[[PictureRecord], np.ndarray]:
    return lambda p: getattr(p, name)[:, column]


PICTURES: dict[str, Column] = {
    "gospa": Column(
        float,
        "m2",
        "square of the GOSPA distance: localisation, missed, false",
        "gospa",
        ("part",),
        np.nan,
    ),
    "seen": _number("target in view of a terminal", "seen", bool, dims=("uav",)),
    "found": _number("target in view that the picture has", "found", bool, dims=("uav",)),
    "error": _number(
        "of targets found: position [m], velocity [m s-1], squared error of position in the "
        "deviations stated over its axes",
        "error",
        float,
        dims=("uav", "measure"),
        missing=np.nan,
    ),
    "false": _number("bodies that stand for nobody", "false", np.int32),
    "hidden": _number("bodies that stand for a target in nobody's view", "hidden", np.int32),
    "unrecognised": _number(
        "bodies that stand for a terminal without being recognised", "unrecognised", np.int32
    ),
    "reports": _number("tracks or detections heard from others that count", "reports", np.int32),
    "age": Column(float, "s", "mean age of the tracks heard from others", "age", missing=np.nan),
    "messages": _number("messages that ended in the frame", "messages", np.int32),
    "lost": _number("those of them that were lost", "lost", np.int32),
    "late": _number(
        "earlier messages, lost until then, that came with a frame read late", "late", np.int32
    ),
    "bits": _number("bits of these messages", "bits", np.int64),
    "room": _number("bits that the ways to the terminal had for messages", "room", np.int64),
    "left_out": _number(
        "tracks or detections that the messages had no room for", "left_out", np.int32
    ),
}
"""One value for each frame and picture."""
FUSED: dict[str, Column] = {
    "origin": _number("link whose track names the body, along observer", "origin", np.int16),
    "number": _number("number of that track", "number", np.int32),
    **{
        f"{word}{axis}{suffix}": Column(
            float,
            units,
            f"{meaning} {axis} of the {what}",
            _of_picture(source, 3 * rate + i),
        )
        for source, suffix, meaning in (("mean", "", "world"), ("std", "_std", "deviation of"))
        for rate, (word, units, what) in enumerate(
            (("", "m", "position"), ("v", "m s-1", "velocity"))
        )
        for i, axis in enumerate("xyz")
    },
    "members": _number("tracks that are taken for the body", "members", np.int16),
    "terminal": _number(
        "index of the UAV of the swarm that it is recognised as, -1: none", "terminal", np.int16
    ),
    "uav": _number("index of the target that it is found as, -1: none", "uav", np.int16),
}
"""Bodies of the pictures."""


def _power_db(p: PathSet) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return 10 * np.log10(p.power)


def _component(end: str, axis: int) -> Callable[[PathSet], np.ndarray]:
    return lambda p: getattr(p, end)[:, axis]


PATHS: dict[str, Column] = {
    "gain_re": _number("real part of the complex gain without carrier phase", "gain.real", float),
    "gain_im": _number(
        "imaginary part of the complex gain without carrier phase", "gain.imag", float
    ),
    "power_db": Column(float, "dB", "|gain|^2", _power_db),
    "delay": Column(float, "s", "delay at the middle of the frame", "delay"),
    "delay_rate": _number("rate of the delay", "delay_rate", float),
    "delay_accel": Column(float, "s-1", "second derivative of the delay", "delay_accel"),
    **{
        f"{end}_{axis}": _number(
            f"{axis} of the unit vector {where}, world axes", _component(end, i), float
        )
        for end, where in (
            ("departure", "along the first segment"),
            ("arrival", "towards where the wave comes from"),
        )
        for i, axis in enumerate("xyz")
    },
    "kind": _number("kind of path, an index into the dimension kind", "kind", np.int8),
    "target": _number("index of the UAV involved, -1: none", "target", np.int16),
    "bounces": _number("interactions with the city", "bounces", np.int16),
    "begin": Column(float, "s", "start of the path's life since the middle of the frame", "begin"),
    "end": Column(float, "s", "end of the path's life since the middle of the frame", "end"),
    "points": Column(
        float,
        "m",
        "interaction points in world axes, NaN where there is none",
        "points",
        ("bounce", "axis"),
        np.nan,
    ),
    "faces": _number(
        "face of the city mesh at each point, -1 where there is none",
        "faces",
        np.int32,
        dims=("bounce",),
        missing=-1,
    ),
}
"""Columns of the path ledger, read off a `PathSet`."""
USES = {f.name: _number("", f.name, float) for f in fields(Use)} | {
    "kept": _number("", lambda use: [use.kept.get(kind, 0) for kind in KINDS], int, dims=("kind",))
}
"""Of a `Use`, which only the summary needs."""
TABLES: dict[str, dict[str, Column]] = {
    "frame": FRAMES | {"dropped": _number("", "dropped", int)},
    "observer": OBSERVERS
    | {"symbols": _number("", lambda o: astuple(o.symbols), np.int64, dims=("count",))},
    "det": DETECTIONS,
    "track": TRACKS,
    "use": USES,
    "picture": PICTURES,
    "fused": FUSED,
}
"""What is kept of every frame: in the dataset and beside it."""
READ_LATE = ("decoded", "latency_frames", "symbol_errors", "symbol_erased", "symbols")
"""Of an observer what changes when a frame is read after others have come."""


@cache
def row_type(kind: str, num_uavs: int) -> np.dtype:
    """Type of a row of one of `TABLES`."""
    sizes = SIZES | {"uav": num_uavs}
    return np.dtype(
        [(n, c.dtype, tuple(sizes[dim] for dim in c.dims)) for n, c in TABLES[kind].items()]
    )


def read(kind: str, record: object, num_uavs: int) -> np.ndarray:
    """A record as rows of one of `TABLES`: one, or of those that are ragged as many as it has."""
    values = {name: column.read(record) for name, column in TABLES[kind].items()}
    count = len(next(iter(values.values()))) if kind in ("det", "track", "fused") else 1
    out = np.zeros(count, row_type(kind, num_uavs))
    for name, value in values.items():
        out[name] = value
    return out


def stacked(parts: Sequence[np.ndarray], column: Column) -> np.ndarray:
    """The rows of all parts, one after the other, their further axes widened to the longest."""
    count = sum(len(part) for part in parts)
    least = tuple(SIZES.get(dim, 0) for dim in column.dims)
    tails = zip(least, *(part.shape[1:] for part in parts), strict=True)
    out = np.full((count, *map(max, tails)), column.missing, column.dtype)
    at = 0
    for part in parts:
        out[(slice(at, at + len(part)), *map(slice, part.shape[1:]))] = part
        at += len(part)
    return out


def row_of(record: FrameRecord) -> Row:
    """What is kept of a frame: numbers and arrays only. The paths themselves and the maps are kept
    of snapshots alone."""
    uavs = list(record.poses)

    def rows(kind: str, of: Mapping[Any, Any]) -> dict[str, np.ndarray]:
        return {str(label): read(kind, one, len(uavs)) for label, one in of.items()}

    out: Row = {
        "frame": rows("frame", {"": record}),
        **{kind: rows(kind, record.observers) for kind in ("observer", "det", "track")},
        "use": rows("use", record.uses),
        **{kind: rows(kind, record.pictures) for kind in ("picture", "fused")},
    }
    for label, o in record.observers.items() if record.snapshot else ():
        lookup = np.array([uavs.index(name) for name in o.paths.target_names] + [-1])
        ledger = {name: column.read(o.paths) for name, column in PATHS.items()}
        out.setdefault("path", {})[label] = ledger | {"target": lookup[o.paths.target]}
    for label, o in record.observers.items():
        if o.reception.maps is not None:
            out.setdefault("maps", {})[label] = vars(o.reception.maps)
    return out


def dataset_of(
    tables: Tables, shots: Mapping[int, Row], timetable: Timetable, states: Sequence[str]
) -> xr.Dataset:
    """The labelled arrays of a run.

    Parameters
    ----------
    tables : of its frames
    shots : ``path`` and ``maps`` of the snapshots by frame
    states : names of the terminals' state codes
    """
    import pandas as pd
    import xarray as xr  # as dear as a frame, and not needed before the last

    w, labels = timetable.waveform, list(timetable.labels.values())
    uavs, roles = list(timetable.first_roles), list(timetable.first_roles.values())
    out: dict[str, xr.Variable] = {}

    def put(name: str, dims: Sequence[str], values: Any, units: str, meaning: str) -> None:
        said, values = {"units": units, "long_name": meaning}, np.asarray(values)
        # another look at the array would load dask, which takes as long as three figures
        if [name] == list(dims):
            out[name] = xr.IndexVariable(name, pd.Index(values, dtype=values.dtype), said)
        else:
            out[name] = xr.Variable(tuple(dims), values, said, fastpath=True)

    for name, words, meaning in (
        ("observer", labels, "link, by its receiver where that is enough"),
        ("uav", uavs, "unmanned aerial vehicle"),
        ("kind", KINDS, "kind of path"),
        ("symbol", SYMBOLS, "kind of symbol"),
        ("axis", "xyz", "world axis: east, north, up"),
        ("body_axis", ("right", "boresight", "up"), "body axis"),
        ("component", COMPONENTS, "component of a track's state, world axes"),
        ("component_2", COMPONENTS, "the same, of its covariance's columns"),
    ):
        put(name, [name], np.array(list(words), object), DIMENSIONLESS, meaning)
    put("role", ["uav"], np.array(roles, object), DIMENSIONLESS, "role of the UAV at the start")
    for i, end in enumerate(("transmitter", "receiver")):
        ends = np.array([link[i] for link in timetable.labels], object)
        put(end, ["observer"], ends, DIMENSIONLESS, f"{end} of the observer's link")
    frames = tables["frame"][""].whole()
    for name, column in FRAMES.items():
        put(name, ["frame", *column.dims], frames[name].copy(), column.units, column.meaning)
    sizes = {"frame": len(frames), "observer": len(labels), "uav": len(uavs)}
    _put_dense(put, "observer", OBSERVERS, [tables["observer"][label] for label in labels], sizes)
    for name, flags in (("state", states), ("loss", LOSSES)):
        out[name].attrs |= {
            "flag_values": np.arange(len(flags), dtype=np.int8),
            "flag_meanings": " ".join(flags),
        }
    _put_ragged(put, "det", "detection", "observer", [tables["det"][label] for label in labels])
    _put_ragged(put, "track", "track", "observer", [tables["track"][label] for label in labels])
    found = {
        part: [
            (i, j, shot[part][label])
            for i, shot in shots.items()
            for j, label in enumerate(labels)
            if label in shot.get(part, {})
        ]
        for part in ("path", "maps")
    }
    _put_paths(put, found["path"])
    _put_maps(put, found["maps"], len(labels))
    _put_pictures(put, tables, sizes)
    numbers = {
        "carrier_hz": w.carrier_frequency,
        "effective_carrier_hz": w.effective_carrier,
        "frame_duration_s": w.frame_duration,
        "frame_interval_s": timetable.interval,
        "range_cell_m": w.range_cell(1),
        "velocity_cell_mps": w.velocity_cell(1),
    }
    return xr.Dataset(out, attrs=numbers)


def _put_dense(
    put: Callable[..., None],
    along: str,
    columns: Mapping[str, Column],
    of: Sequence[Table],
    sizes: Mapping[str, int],
    prefix: str = "",
) -> None:
    """One value for each frame and each table, which go along a dimension."""
    sizes = {**SIZES, **sizes, along: len(of)}
    dims = {name: ("frame", along, *column.dims) for name, column in columns.items()}
    values: dict[str, np.ndarray] = {
        name: np.full([sizes[dim] for dim in dims[name]], column.missing, column.dtype)
        for name, column in columns.items()
    }
    for j, table in enumerate(of):
        at, rows = table.frames(), table.whole()
        for name in columns:
            values[name][at, j] = rows[name]
    for name, column in columns.items():
        put(f"{prefix}{name}", dims[name], values[name], column.units, column.meaning)


def _put_ragged(
    put: Callable[..., None], kind: str, dim: str, along: str, of: Sequence[Table]
) -> None:
    """Rows of any number for each frame and each table, in this order."""
    frame = np.concatenate([table.frames() for table in of])
    order = np.argsort(frame, kind="stable")
    number = np.repeat(np.arange(len(of)), [len(table.frames()) for table in of])
    rows = np.concatenate([table.whole() for table in of])
    _put_places(put, kind, dim, along, np.column_stack([frame, number])[order])
    for name, column in TABLES[kind].items():
        values = rows[name][order]
        put(f"{kind}_{name}", [dim, *column.dims], values, column.units, column.meaning)


def _put_places(
    put: Callable[..., None], prefix: str, dim: str, along: str, places: np.ndarray
) -> None:
    """Of which frame, and which of another dimension, rows are (K, 2)."""
    for k, name in enumerate(("frame", along)):
        meaning = f"position along the dimension {name}"
        put(f"{prefix}_{name}", [dim], places[:, k].astype(np.int32), DIMENSIONLESS, meaning)


def _put_paths(put: Callable[..., None], found: Sequence[tuple[int, int, Columns]]) -> None:
    """The paths of the snapshots."""
    places = np.array([[i, j] for i, j, _ in found], int).reshape(-1, 2)
    count = [len(ledger["delay"]) for _, _, ledger in found]
    _put_places(put, "path", "path", "observer", np.repeat(places, count, axis=0))
    for name, column in PATHS.items():
        parts: list[np.ndarray] = [np.asarray(one[name], column.dtype) for _, _, one in found]
        values = stacked(parts, column)
        put(f"path_{name}", ["path", *column.dims], values, column.units, column.meaning)


def _put_pictures(put: Callable[..., None], tables: Tables, sizes: Mapping[str, int]) -> None:
    """The pictures of terminals that cooperate; nothing where none does."""
    names = list(tables["picture"])
    if not names:
        return
    for name, words, meaning in (
        ("picture", names, "terminal, or all of them together"),
        ("part", PARTS, "part of the GOSPA distance"),
        ("measure", ERRORS, "measure of an error"),
    ):
        put(name, [name], np.array(list(words), object), DIMENSIONLESS, meaning)
    of = list(tables["picture"].values())
    _put_dense(put, "picture", PICTURES, of, sizes, "picture_")
    _put_ragged(put, "fused", "fused", "picture", list(tables["fused"].values()))


MAPS = (
    (
        "map_power",
        "range_doppler",
        np.float32,
        ("row", "doppler"),
        "W",
        "range-Doppler map, accumulated over antennas",
    ),
    ("map_range", "range_axis", float, ("row",), "m", "range of the map's rows"),
    ("map_velocity", "velocity_axis", float, ("doppler",), "m s-1", "velocity of its columns"),
    (
        "map_equivalent_range",
        "equivalent_range",
        np.float32,
        ("cell", "chirp"),
        "W0.5",
        "magnitude over range cell and chirp before data removal",
    ),
    (
        "map_equivalent_detections",
        "equivalent_detections",
        bool,
        ("cell", "chirp"),
        DIMENSIONLESS,
        "cells that the one-dimensional CFAR finds, chirp by chirp",
    ),
)
"""(variable, attribute of `isac_rt.receive.types.Maps`, type, dimensions, unit, meaning)"""


def _put_maps(
    put: Callable[..., None],
    found: list[tuple[int, int, Mapping[str, np.ndarray]]],
    num_observers: int,
) -> None:
    """The maps of the snapshots, padded with NaN to the largest."""
    shots = sorted({i for i, _, _ in found})
    put(
        "snapshot_frame",
        ["snapshot"],
        np.array(shots, np.int32),
        DIMENSIONLESS,
        "position along the dimension frame",
    )

    def padded(name: str, dtype: type, snapshots: bool = True) -> np.ndarray:
        shapes = [m[name].shape for _, _, m in found]
        size = [max(n, default=0) for n in zip(*shapes, strict=True)] or [0] * (1 + snapshots)
        head = (len(shots), num_observers) if snapshots else (num_observers,)
        out = np.full((*head, *size), np.nan if dtype is not bool else False, dtype)
        for i, j, m in found:
            at = (shots.index(i), j) if snapshots else (j,)
            out[(*at, *map(slice, m[name].shape))] = m[name]
        return out

    for name, source, dtype, dims, units, meaning in MAPS:
        pictures = len(dims) > 1
        along = ["snapshot", "observer", *dims] if pictures else ["observer", *dims]
        put(name, along, padded(source, dtype, pictures), units, meaning)
