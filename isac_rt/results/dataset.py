"""Records of frames to rows of tables, and tables to one labelled dataset.

What every link has in every frame is an array over frame and observer; what differs in number
(detections, tracks, paths) is ragged: flat columns beside the frame and the observer of each row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from isac_rt.frame.timetable import Timetable
from isac_rt.results.columns import (
    COMPONENTS,
    DIMENSIONLESS,
    ERRORS,
    FRAMES,
    FUSED_SETS,
    MAPS,
    MEASURES,
    OBSERVERS,
    PARTS,
    PATHS,
    SIZES,
    SYMBOLS,
    TABLES,
    Column,
)
from isac_rt.results.losses import LOSSES
from isac_rt.results.records import KINDS, FrameRecord
from isac_rt.results.rows import Table

if TYPE_CHECKING:
    import xarray as xr

Row = dict[str, dict[str, Any]]
"""A frame: of each of `TABLES`, and of a snapshot's ``path`` and ``maps``, what each observer or
owner has."""
Tables = Mapping[str, Mapping[str, Table]]
"""The frames so far: of each of `TABLES`, what each observer or owner has."""
Columns = Mapping[str, np.ndarray] | np.ndarray
"""Rows of a table: arrays by name, or an array with named fields."""


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
    receivers = [list(dataset.uav.values).index(name) for name in dataset.receiver.values]
    frame, uav = dataset.track_frame.values, np.array(receivers)[dataset.track_observer.values]
    of = [dataset[f"uav_{name}"].values[frame, uav] for name in ("position", "velocity")]
    return np.asarray(dataset.track_state.values + np.concatenate(of, axis=1))


def fused_positions(dataset: xr.Dataset, frame: int, owner: str) -> np.ndarray:
    """(B, 3) where the set of fused tracks of a terminal, or of the swarm, has UAVs that are no
    terminals [m]; none where terminals do not cooperate."""
    if "owner" not in dataset.variables:
        return np.zeros((0, 3))
    mine = (
        (dataset.fused_frame.values == frame)
        & (dataset.fused_owner.values == list(dataset.owner.values).index(owner))
        & (dataset.fused_terminal.values < 0)
    )
    return np.column_stack([dataset[f"fused_{axis}"].values[mine] for axis in "xyz"])


LATE_VARIABLES = ("decoded", "latency_frames", "symbol_errors", "symbol_erased", "symbols")
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
    """Return the kept data of a frame: numbers and arrays only. The paths themselves and the maps
    are kept of snapshots alone."""
    uavs = list(record.poses)

    def rows(kind: str, of: Mapping[Any, Any]) -> dict[str, np.ndarray]:
        return {str(label): read(kind, one, len(uavs)) for label, one in of.items()}

    out: Row = {
        "frame": rows("frame", {"": record}),
        **{kind: rows(kind, record.observers) for kind in ("observer", "det", "track")},
        "use": rows("use", record.uses),
        **{kind: rows(kind, record.fused_records) for kind in ("fused_set", "fused")},
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

    labels = list(timetable.labels.values())
    uavs, roles = list(timetable.first_roles), list(timetable.first_roles.values())
    out: dict[str, xr.Variable] = {}

    def put(name: str, dims: Sequence[str], values: Any, units: str, meaning: str) -> None:
        attrs, values = {"units": units, "long_name": meaning}, np.asarray(values)
        # another look at the array would load dask, which takes as long as three figures
        if [name] == list(dims):
            out[name] = xr.IndexVariable(name, pd.Index(values, dtype=values.dtype), attrs)
        else:
            out[name] = xr.Variable(tuple(dims), values, attrs, fastpath=True)

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
    variables = {
        part: [
            (i, j, shot[part][label])
            for i, shot in shots.items()
            for j, label in enumerate(labels)
            if label in shot.get(part, {})
        ]
        for part in ("path", "maps")
    }
    _put_paths(put, variables["path"])
    _put_maps(put, variables["maps"], len(labels))
    _put_fused(put, tables, sizes)
    numbers = {"frame_interval_s": timetable.interval}
    waveforms = [timetable.of(link.tx).waveform for link in timetable.labels]
    for name, unit, values in (
        ("carrier_hz", "Hz", [w.carrier_frequency for w in waveforms]),
        ("effective_carrier_hz", "Hz", [w.effective_carrier for w in waveforms]),
        ("frame_duration_s", "s", [w.frame_duration for w in waveforms]),
        ("range_cell_m", "m", [w.range_cell(1) for w in waveforms]),
        ("velocity_cell_mps", "m s-1", [w.velocity_cell(1) for w in waveforms]),
    ):
        if timetable.own:
            put(name, ["observer"], values, unit, "of the observer's chirp, of one pass")
        else:
            numbers[name] = values[0]
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
    _put_index(put, kind, dim, along, np.column_stack([frame, number])[order])
    for name, column in TABLES[kind].items():
        values = rows[name][order]
        put(f"{kind}_{name}", [dim, *column.dims], values, column.units, column.meaning)


def _put_index(
    put: Callable[..., None], prefix: str, dim: str, along: str, index: np.ndarray
) -> None:
    """Put the frame, and the index along another dimension, of each row (K, 2)."""
    for k, name in enumerate(("frame", along)):
        meaning = f"position along the dimension {name}"
        put(f"{prefix}_{name}", [dim], index[:, k].astype(np.int32), DIMENSIONLESS, meaning)


def _put_paths(put: Callable[..., None], found: Sequence[tuple[int, int, Columns]]) -> None:
    """The paths of the snapshots."""
    index = np.array([[i, j] for i, j, _ in found], int).reshape(-1, 2)
    count = [len(ledger["delay"]) for _, _, ledger in found]
    _put_index(put, "path", "path", "observer", np.repeat(index, count, axis=0))
    for name, column in PATHS.items():
        parts: list[np.ndarray] = [np.asarray(of[name], column.dtype) for _, _, of in found]
        values = stacked(parts, column)
        put(f"path_{name}", ["path", *column.dims], values, column.units, column.meaning)


def _put_fused(put: Callable[..., None], tables: Tables, sizes: Mapping[str, int]) -> None:
    """The set of fused tracks of terminals that cooperate; nothing where none does."""
    names = list(tables["fused_set"])
    if not names:
        return
    for name, words, meaning in (
        ("owner", names, "terminal whose fused tracks they are, or the whole swarm"),
        ("part", PARTS, "part of the GOSPA distance"),
        ("measure", ERRORS, "measure of an error"),
    ):
        put(name, [name], np.array(list(words), object), DIMENSIONLESS, meaning)
    of = list(tables["fused_set"].values())
    _put_dense(put, "owner", FUSED_SETS, of, sizes, "fused_")
    _put_ragged(put, "fused", "fused", "owner", list(tables["fused"].values()))


def _put_maps(
    put: Callable[..., None],
    maps: list[tuple[int, int, Mapping[str, np.ndarray]]],
    num_observers: int,
) -> None:
    """The maps of the snapshots, padded with NaN to the largest."""
    shots = sorted({i for i, _, _ in maps})
    put(
        "snapshot_frame",
        ["snapshot"],
        np.array(shots, np.int32),
        DIMENSIONLESS,
        "position along the dimension frame",
    )

    def padded(name: str, dtype: type, snapshots: bool = True) -> np.ndarray:
        shapes = [m[name].shape for _, _, m in maps]
        size = [max(n, default=0) for n in zip(*shapes, strict=True)] or [0] * (1 + snapshots)
        head = (len(shots), num_observers) if snapshots else (num_observers,)
        out = np.full((*head, *size), np.nan if dtype is not bool else False, dtype)
        for i, j, m in maps:
            at = (shots.index(i), j) if snapshots else (j,)
            out[(*at, *map(slice, m[name].shape))] = m[name]
        return out

    for name, source, dtype, dims, units, meaning in MAPS:
        wide = len(dims) > 1
        along = ["snapshot", "observer", *dims] if wide else ["observer", *dims]
        put(name, along, padded(source, dtype, wide), units, meaning)
