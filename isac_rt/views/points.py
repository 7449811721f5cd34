"""Detections as point clouds: PCD files of every link and frame, and one table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from isac_rt.storage import write_whole
from isac_rt.track.filter import POSITION, jacobian, resting
from isac_rt.world.swarm import Pose

_COVARIANCE = ("xx", "xy", "xz", "yy", "yz", "zz")
_UPPER = np.triu_indices(3)
_MEASURED = "range", "velocity", "u_x", "u_z"


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
        found = _place(d, k, pose, there)
        if found is None:
            continue
        place, covariance = found
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
    return pd.DataFrame(rows)


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
    number = {str(kind): k for k, kind in enumerate(dataset.kind.values)} | {"none": -1}
    fields = [*"xyz", *(f"cov_{name}" for name in _COVARIANCE), "velocity", "snr", "label"]
    for (observer, frame), part in cloud.groupby(["observer", "frame"]):
        table = part.assign(label=part.label.map(number))[fields]
        files.append(folder / f"{str(observer).replace('->', '_to_')}_{frame:04d}.pcd")
        write_whole(files[-1], _header(fields, len(table)) + _rows(table))
    return files


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
