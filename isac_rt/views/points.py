"""Detections as point clouds: PCD files of every link and frame with one table; a ROS 2 bag."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from isac_rt.runtime import needed
from isac_rt.storage import write_whole
from isac_rt.track.filter import POSITION, jacobian, resting
from isac_rt.views.samples import staged
from isac_rt.world.swarm import Pose

_COVARIANCE = ("xx", "xy", "xz", "yy", "yz", "zz")
_UPPER = np.triu_indices(3)
_MEASURED = "range", "velocity", "u_x", "u_z"
_FIELDS = [*"xyz", *(f"cov_{name}" for name in _COVARIANCE), "velocity", "snr", "label"]
_INT32, _FLOAT32 = 5, 7
"""Types of `sensor_msgs/msg/PointField`."""


def point_cloud(dataset: xr.Dataset) -> pd.DataFrame:
    """Detections of a run as points in the world.

    Returns
    -------
    A row for each detection with a place: `frame`, `time` [s], `observer`, `x`, `y`, `z` [m], the
    covariance of the place `cov_xx` to `cov_zz` [m^2], `velocity` (range rate, positive receding)
    [m/s], `snr` (linear), `label` (kind of the path that explains it) and `target`. A passive
    terminal's points lie on their ellipsoids, by its transmitter's true place.
    """
    d, uavs = dataset, [str(name) for name in dataset.uav.values]
    of = np.array([uavs.index(str(name)) for name in d.receiver.values])
    sender = np.array([uavs.index(str(name)) for name in d.transmitter.values])
    rows = []
    kinds, targets = np.append(d.kind.values, "none"), np.append(uavs, "")
    for k in range(d.sizes["detection"]):
        frame, observer = int(d.det_frame.values[k]), int(d.det_observer.values[k])
        own, other = of[observer], sender[observer]
        at = [d[f"uav_{what}"].values[frame] for what in ("position", "velocity", "attitude")]
        pose = Pose(at[0][own], at[1][own], np.zeros(3), at[2][own])
        there = None if own == other else np.concatenate([at[0][other], at[1][other]])
        located = _place(d, k, pose, there)
        if located is None:
            continue
        place, covariance = located
        rows.append(
            {
                "frame": int(d.frame.values[frame]),
                "time": float(d.time.values[frame]),
                "observer": str(d.observer.values[observer]),
                **dict(zip("xyz", place.tolist(), strict=True)),
                **{
                    f"cov_{name}": float(v)
                    for name, v in zip(_COVARIANCE, covariance[_UPPER], strict=True)
                },
                "velocity": float(d.det_velocity.values[k]),
                "snr": float(d.det_snr.values[k]),
                "label": str(kinds[int(d.det_kind.values[k])]),
                "target": str(targets[int(d.det_target.values[k])]),
            }
        )
    return pd.DataFrame(rows, columns=["frame", "time", "observer", *_FIELDS, "target"])


@np.errstate(invalid="ignore", divide="ignore")  # beyond the view, in the place of a terminal
def _place(
    d: xr.Dataset, k: int, own: Pose, transmitter: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Place (3,) and covariance (3, 3) of a detection; None where it has none: outside the field of
    view, on the line of sight, or with a deviation that is infinite."""
    if d.det_is_reference.values[k]:
        transmitter = None
    measured = np.array([float(d[f"det_{name}"].values[k]) for name in _MEASURED])
    std = np.array([float(d[f"det_{name}_std"].values[k]) for name in _MEASURED])[POSITION]
    state = resting(measured[None], own, transmitter)[0]
    J = jacobian(state, own, transmitter)[POSITION, :3]
    if not np.isfinite([*J.flat, *std]).all() or np.linalg.cond(J) > 1 / np.finfo(float).eps:
        return None
    back = np.linalg.inv(J)
    return state[:3], back @ np.diag(std**2) @ back.T


def write_points(dataset: xr.Dataset, folder: Path) -> list[Path]:
    """`points.csv` with all points, and `OBSERVER_FRAME.pcd` for each link and frame that has any:
    PCD 0.7 in text, with the kind of path as the number that `points.csv` names.

    Raises
    ------
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    cloud = point_cloud(dataset)
    files = [folder / "points.csv"]
    write_whole(files[0], cloud.to_csv(index=False, lineterminator="\n"))
    for (observer, frame), part in cloud.groupby(["observer", "frame"]):
        table = _numbered(dataset, part)
        files.append(folder / f"{str(observer).replace('->', '_to_')}_{frame:04d}.pcd")
        write_whole(files[-1], _header(_FIELDS, len(table)) + _rows(table))
    return files


def _numbered(dataset: xr.Dataset, part: pd.DataFrame) -> pd.DataFrame:
    """Return the columns `_FIELDS` of points, the kind of path as its number, -1 for none."""
    number = {str(kind): k for k, kind in enumerate(dataset.kind.values)} | {"none": -1}
    return part.assign(label=part.label.map(number))[_FIELDS]


def write_bag(dataset: xr.Dataset, folder: Path) -> list[Path]:
    """Write a bag of ROS 2, a folder: a `PointCloud2` of each frame on a topic `/OBSERVER/points`,
    in the frame `world`, stamped with the time since the start of the run; fields as in the PCD
    files.

    Raises
    ------
    isac_rt.runtime.MissingPackage  Without the package `rosbags`.
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    needed("rosbags", "interchange")
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, cloud = get_typestore(Stores.ROS2_HUMBLE), point_cloud(dataset)
    kind = "sensor_msgs/msg/PointCloud2"
    with staged(folder.parent) as made:
        with Writer(made.stage / folder.name, version=9) as bag:
            for observer in map(str, dataset.observer.values):
                topic = f"/{observer.replace('->', '_to_').replace('-', '_')}/points"
                to = bag.add_connection(topic, kind, typestore=store)
                for frame, time in zip(dataset.frame.values, dataset.time.values, strict=True):
                    mine = cloud[(cloud.frame == frame) & (cloud.observer == observer)]
                    stamp = round(float(time) * 1e9)
                    message = _message(store.types, _numbered(dataset, mine), stamp)
                    bag.write(to, stamp, store.serialize_cdr(message, kind))
        if (folder / "metadata.yaml").is_file():  # an earlier bag
            shutil.rmtree(folder)
    return made.files


def _message(types: Any, table: pd.DataFrame, stamp: int) -> Any:
    """Return points as a `PointCloud2` of a time [ns]."""
    whole = [name == "label" for name in _FIELDS]
    dtype = [(n, "<i4" if w else "<f4") for n, w in zip(_FIELDS, whole, strict=True)]
    points = np.zeros(len(table), dtype)
    for name in _FIELDS:
        points[name] = table[name]
    field = types["sensor_msgs/msg/PointField"]
    fields = [
        field(name, 4 * i, _INT32 if w else _FLOAT32, 1)
        for i, (name, w) in enumerate(zip(_FIELDS, whole, strict=True))
    ]
    at = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    return types["sensor_msgs/msg/PointCloud2"](
        header=types["std_msgs/msg/Header"](at, "world"),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.nbytes,
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=True,
    )


def _header(fields: list[str], count: int) -> str:
    types = ["F"] * (len(fields) - 1) + ["I"]
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(fields)}\nSIZE {' '.join('8' * (len(fields) - 1))} 4\n"
        f"TYPE {' '.join(types)}\nCOUNT {' '.join('1' * len(fields))}\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA ascii\n"
    )


def _rows(table: pd.DataFrame) -> str:
    lines = (
        " ".join([*(f"{v:.9g}" for v in row[:-1]), str(int(row[-1]))])
        for row in table.itertuples(index=False, name=None)
    )
    return "\n".join(lines) + "\n"
