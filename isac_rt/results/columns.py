"""Columns recorded of every frame, declared once: each one's name, type, unit, meaning, source and
dimensions. Rows of tables and the dataset are made from these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, fields
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from isac_rt.propagation.pathset import PathSet
from isac_rt.results.metrics import SymbolCount
from isac_rt.results.records import KINDS, FrameRecord, FusedRecord, ObserverRecord, Use

DIMENSIONLESS = "1"
COMPONENTS = ("x", "y", "z", "v_x", "v_y", "v_z")
SYMBOLS = ("delay", "dpsk", "bit")
PARTS = ("localisation", "missed", "false")
"""Of the GOSPA distance."""
ERRORS = ("position", "velocity", "squared")
"""Measures of a fused track's error."""
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


class Column(NamedTuple):
    """Definition of an array of the dataset: from which attribute (or by which function) of a
    record or a `PathSet`, over which dimensions besides frame and observer (or besides a row), and
    with which value where an observer did not receive (or a row is shorter)."""

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


def _of_uavs(meaning: str, name: str, dtype: type = float, missing: float = np.nan) -> Column:
    return _number(meaning, f"uavs.{name}", dtype, dims=("uav",), missing=missing)


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
            float, units, meaning.format(name), f"uavs.{group}.{name}", ("uav",), np.nan
        )
        for group, meaning in (
            ("truth", "true {} of the UAV, seen by the observer"),
            ("detected", "detected {} of the UAV, seen by the observer"),
            ("tracked", "tracked {} of the UAV, seen by the observer"),
            ("bound", "least standard deviation of an estimate of the {} in noise (Cramer-Rao)"),
        )
        for name, (units, _) in MEASURES.items()
    },
    "in_view": _of_uavs("UAV inside the field of view, no object", "in_view", bool, 0),
    "occluded": _of_uavs("UAV occluded by the city", "occluded", bool, 0),
    "hit": _of_uavs(
        "UAV found by its own path within one resolution on all four axes", "hit", bool, 0
    ),
    "loss": _of_uavs(
        "what became of a UAV in view and unoccluded, -1: not one", "loss", np.int8, -1
    ),
    "target_snr": _of_uavs(
        "SNR of the UAV's own path behind a matched filter over samples, chirps and antennas",
        "target_snr",
    ),
    "target_cell_snr": _of_uavs(
        "SNR of that path in its cell of the Hann-windowed map, all channels in phase",
        "target_cell_snr",
    ),
    "target_straddling": _of_uavs(
        "share of that SNR which is left of it because it lies between cells", "target_straddling"
    ),
    "target_whitened_snr": _of_uavs(
        "SNR of that path in its cell, channels whitened by the true clutter", "target_whitened_snr"
    ),
    "target_clutter": _of_uavs(
        "power of the diffuse paths in the UAV's cell over the noise of one channel's map",
        "target_clutter",
    ),
    "cooperative": _of_uavs(
        "UAV that is a terminal and reports its position", "cooperative", bool, 0
    ),
    "genie": _of_uavs(
        "probability that a matched filter at the true parameters finds the UAV's own path", "genie"
    ),
    "clutter_free": _of_uavs(
        "probability that the receiver's detector would find the UAV in noise alone", "clutter_free"
    ),
    "whitened": _of_uavs(
        "probability that a detector whitened by the true clutter finds the UAV", "whitened"
    ),
    **{
        f"gospa_{part}": Column(
            float,
            "m2",
            f"{words} in the square of the GOSPA distance of confirmed tracks from targets",
            f"gospa.{part}",
            missing=np.nan,
        )
        for part, words in (
            ("localisation", "errors of position"),
            ("missed", "targets without a track"),
            ("false", "tracks without a target"),
        )
    },
    "processed": _number("the observer processed the frame", lambda o: True, bool),
    "state": _number("state of the terminal, -1: not processed", "state", np.int8, missing=-1),
    "decoded": _number("data symbols were decided", "reception.decoded", bool),
    "latency_frames": _number(
        "frames after which the data were read, 0: at once, -1: erased, or no data",
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
        lambda o: -1 if o.reception.sparse is None else o.reception.sparse,
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
    "num_false": _number(
        "detections that no path explains", lambda o: (o.labels.kind < 0).sum(), np.int32
    ),
    "num_clutter": _number(
        "detections that something other than a UAV's own path explains",
        lambda o: ((o.labels.kind >= 0) & (o.labels.uav < 0)).sum(),
        np.int32,
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
        "symbols, undecided or of a frame whose check sum fails",
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
    "kind": _number("kind of the path that explains it, -1: none", "labels.kind", np.int8),
    "target": _number("index of the UAV that explains it, -1: none", "labels.target", np.int16),
    "order": _number(
        "interactions with the city of the path that explains it, 0: direct, -1: no path",
        "labels.order",
        np.int16,
    ),
    "face": _number(
        "first face of the city's mesh on the path that explains it, -1: none",
        "labels.face",
        np.int32,
    ),
    "sidelobe": _number(
        "the path that explains it lies more than a cell away", "labels.sidelobe", bool
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
    "false": _number(
        "confirmed, follows no UAV and is 5 m or more from every one", "tracks.false", bool
    ),
    "object": _number(
        "confirmed, follows no UAV, and is within 5 m of an object or fed by one",
        "tracks.object",
        bool,
    ),
}


def _of_fused(name: str, column: int) -> Callable[[FusedRecord], np.ndarray]:
    return lambda p: getattr(p, name)[:, column]


FUSED_SETS: dict[str, Column] = {
    "gospa": Column(
        float,
        "m2",
        "square of the GOSPA distance: localisation, missed, false",
        "gospa",
        ("part",),
        np.nan,
    ),
    "seen": _number("target in view of a terminal", "seen", bool, dims=("uav",)),
    "found": _number("target found by a terminal", "found", bool, dims=("uav",)),
    "tracked": _number(
        "target with a fused track within 5 m and three resolutions", "tracked", bool, dims=("uav",)
    ),
    "error": _number(
        "errors of targets tracked: position [m], velocity [m s-1], normalised squared position "
        "error over its axes",
        "error",
        float,
        dims=("uav", "measure"),
        missing=np.nan,
    ),
    "false": _number("fused tracks 5 m or more from every UAV", "false", np.int32),
    "reports": _number("tracks or detections of others that are used", "reports", np.int32),
    "age": Column(float, "s", "mean age of the reports of others", "age", missing=np.nan),
    "messages": _number("messages that ended in the frame", "messages", np.int32),
    "lost": _number("those of them that were lost", "lost", np.int32),
    "late": _number(
        "earlier messages, lost until then, that came with a frame read late", "late", np.int32
    ),
    "bits": _number("bits of these messages", "bits", np.int64),
    "capacity": _number(
        "capacity of the links to the terminal for messages in bits", "capacity", np.int64
    ),
    "left_out": _number(
        "tracks or detections that the messages had no room for", "left_out", np.int32
    ),
}
"""One value for each frame and set of fused tracks."""
FUSED: dict[str, Column] = {
    "origin": _number("link whose track names the fused track, along observer", "origin", np.int16),
    "number": _number("number of that track", "number", np.int32),
    **{
        f"{word}{axis}{suffix}": Column(
            float,
            units,
            f"{meaning} {axis} of the {what}",
            _of_fused(source, 3 * rate + i),
        )
        for source, suffix, meaning in (("mean", "", "world"), ("std", "_std", "deviation of"))
        for rate, (word, units, what) in enumerate(
            (("", "m", "position"), ("v", "m s-1", "velocity"))
        )
        for i, axis in enumerate("xyz")
    },
    "members": _number("tracks that are fused", "members", np.int16),
    "terminal": _number(
        "index of the UAV of the swarm that it is recognised as, -1: none", "terminal", np.int16
    ),
    "uav": _number("index of the target that it tracks, -1: none", "uav", np.int16),
}
"""UAVs of the set of fused tracks."""


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
        "face of the city mesh at each point, -1 where there is none, -2 - n on the box of UAV n",
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
    "fused_set": FUSED_SETS,
    "fused": FUSED,
}
"""What is kept of every frame: in the dataset and beside it."""

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
