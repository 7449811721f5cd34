"""A finished run for other programs: CSV tables, one MAT file, point clouds as PCD or in a ROS 2
bag, a scene as GLB, Stone Soup's detections as YAML."""

from __future__ import annotations

import datetime
import io
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.colors import to_rgba

from isac_rt.results.dataset import tracked_states
from isac_rt.results.recorder import Results
from isac_rt.storage import write_whole
from isac_rt.views.interchange import stonesoup_detections
from isac_rt.views.points import write_bag, write_points
from isac_rt.views.scene import path_lines
from isac_rt.views.style import KIND_COLOURS, colour_of
from isac_rt.world.city.mesh import CityMesh

if TYPE_CHECKING:
    import trimesh

FORMATS = ("csv", "mat", "pcd", "rosbag", "glb", "stonesoup")
TABLES: dict[str, tuple[str, ...]] = {
    "uavs": ("frame", "uav"),
    "links": ("frame", "observer"),
    "seen": ("frame", "observer", "uav"),
    "detections": ("detection",),
    "tracks": ("track",),
    "paths": ("path",),
}
"""A table of each name has a row for each entry of these dimensions."""
_INSIDE = ("kind", "symbol", "axis", "body_axis", "component", "component_2", "bounce")
"""Dimensions that become columns."""
MOST_PATHS = 200
"""Paths of a kind that are drawn, the strongest."""
LONGEST_NAME = 63
"""Characters of a MATLAB variable's name."""
Colour = tuple[float, float, float, float]
START = datetime.datetime(2000, 1, 1)
"""Time zero of the run where timestamps are asked for."""


def table(dataset: xr.Dataset, name: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """One of `TABLES`: a column for each quantity and component, frames and names in place of
    positions; and what the columns are.

    Returns
    -------
    rows, and one row for each column with its name, unit and meaning
    """
    rows = TABLES[name]
    columns, about = {}, []
    for key, v in dataset.data_vars.items():
        if v.dims[: len(rows)] != rows or not set(v.dims[len(rows) :]) <= set(_INSIDE):
            continue
        for column, values in _columns(str(key), v, len(rows)):
            columns[column] = values
            flags = enumerate(v.attrs.get("flag_meanings", "").split())
            meaning = ", ".join([v.attrs["long_name"], *(f"{k}: {word}" for k, word in flags)])
            about.append((name, column, v.attrs["units"], meaning))
    about = [row for row in about if not row[1].endswith(("_frame", "_observer"))]
    flat = xr.Dataset(columns)
    made = flat.to_dataframe(dim_order=list(rows)).reset_index(drop=len(rows) == 1)
    if len(rows) > 1:
        made.insert(1, "time", np.repeat(dataset.time.values, len(made) // dataset.sizes["frame"]))
    else:
        _name_places(made, dataset, rows[0])
    return made, pd.DataFrame(about, columns=["table", "column", "units", "meaning"])


def _columns(key: str, v: xr.DataArray, rows: int) -> Iterator[tuple[str, xr.DataArray]]:
    """A variable's components as columns, named by their coordinates or numbers."""
    inside = v.dims[rows:]
    for index in np.ndindex(*v.shape[rows:]):
        part = v[dict(zip(inside, index, strict=True))]
        labels = [
            str(part.coords[dim].item() if dim in part.coords else i)
            for dim, i in zip(inside, index, strict=True)
        ]
        yield "_".join([key, *labels]), part.drop_vars(inside, errors="ignore")


def _name_places(made: pd.DataFrame, dataset: xr.Dataset, dim: str) -> None:
    """Frame numbers, times and names in place of positions along dimensions."""
    prefix = {"detection": "det", "track": "track", "path": "path"}[dim]
    frames = made.pop(f"{prefix}_frame").to_numpy()
    made.insert(0, "frame", dataset.frame.values[frames])
    made.insert(1, "time", dataset.time.values[frames])
    made.insert(2, "observer", dataset.observer.values[made.pop(f"{prefix}_observer").to_numpy()])
    for key, names in (
        (f"{prefix}_kind", dataset.kind.values),
        (f"{prefix}_target", dataset.uav.values),
        (f"{prefix}_uav", dataset.uav.values),
    ):
        if key in made:
            made[key] = np.append(names, "")[made[key].to_numpy()]  # -1: none


def write_csv(dataset: xr.Dataset, folder: Path) -> list[Path]:
    """A file for each of `TABLES` and ``columns.csv``, which says what their columns are.

    Raises
    ------
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    made = {name: table(dataset, name) for name in TABLES}
    frames = {name: rows for name, (rows, _) in made.items()}
    frames["columns"] = pd.concat([about for _, about in made.values()])
    files = []
    for name, rows in frames.items():
        files.append(folder / f"{name}.csv")
        write_whole(files[-1], rows.to_csv(index=False, lineterminator="\n"))
    return files


def write_mat(dataset: xr.Dataset, file: Path) -> None:
    """All variables under their names, and in the structs ``dimensions``, ``units`` and
    ``meaning`` what they are over, in and of; positions count from 0, as in ``results.nc``.

    Raises
    ------
    isac_rt.storage.StorageError  If the file cannot be written.
    """
    from scipy.io import savemat

    out: dict[str, Any] = {"dimensions": {}, "units": {}, "meaning": {}}
    for key, v in dataset.variables.items():
        name = str(key)[:LONGEST_NAME]
        out[name] = v.values.astype(object) if v.dtype.kind in "OUT" else v.values
        out["dimensions"][name] = " ".join(map(str, v.dims))
        out["units"][name], out["meaning"][name] = v.attrs["units"], v.attrs["long_name"]
    drawn = io.BytesIO()
    savemat(drawn, out, long_field_names=True, do_compression=True, oned_as="column")
    write_whole(file, drawn.getvalue())


def scene(dataset: xr.Dataset, city: CityMesh) -> trimesh.Scene:
    """City, flights, confirmed tracks and the strongest paths of the kept frames, each an object of
    its own name; x east, y up, z south, as glTF wants it [m].

    Of every kind of path at most `MOST_PATHS` are drawn.
    """
    import trimesh

    made = trimesh.Scene()
    if city.num_faces:
        corners = (city.corners + city.origin).reshape(-1, 3)
        mesh = trimesh.Trimesh(_turned(corners), np.arange(len(corners)).reshape(-1, 3))
        mesh.merge_vertices()
        made.add_geometry(mesh, geom_name="city", node_name="city")
    for name, (lines, colour) in _lines(dataset).items():
        ends = np.cumsum([0, *map(len, lines)])
        path = trimesh.path.Path3D(
            [
                trimesh.path.entities.Line(np.arange(low, high), color=np.multiply(255, colour))
                for low, high in pairwise(ends)
            ],
            _turned(np.vstack(lines)),
            process=False,
        )
        made.add_geometry(path, geom_name=name, node_name=name)
    return made


def _turned(points: np.ndarray) -> np.ndarray:
    """East, north, up to glTF's axes, whose y is up."""
    return np.asarray(points)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]


def _lines(dataset: xr.Dataset) -> dict[str, tuple[list[np.ndarray], Colour]]:
    """Polylines (N, 3) in world axes with their colour, by name."""
    out: dict[str, tuple[list[np.ndarray], Colour]] = {}
    position = dataset.uav_position.values
    for u, name in enumerate(dataset.uav.values):
        out[f"flight of {name}"] = [position[:, u]], to_rgba(colour_of(u))
    states = tracked_states(dataset)[:, :3]
    for o, observer in enumerate(dataset.observer.values):
        mine = (dataset.track_observer.values == o) & dataset.track_confirmed.values
        number = dataset.track_id.values
        lines = [states[mine & (number == k)] for k in np.unique(number[mine])]
        if lines := [line for line in lines if len(line) > 1]:
            out[f"tracks of {observer}"] = lines, to_rgba(colour_of(o))
    for k, kind in enumerate(dataset.kind.values):
        lines = list(path_lines(dataset, np.flatnonzero(dataset.path_kind.values == k), MOST_PATHS))
        if lines:
            out[f"paths, {kind}"] = lines, to_rgba(KIND_COLOURS[kind])
    return out


def write_glb(dataset: xr.Dataset, city: CityMesh, file: Path) -> None:
    """The `scene` as binary glTF.

    Raises
    ------
    isac_rt.storage.StorageError  If the file cannot be written.
    """
    write_whole(file, scene(dataset, city).export(file_type="glb"))


def write_stonesoup(dataset: xr.Dataset, folder: Path) -> list[Path]:
    """Each observer's detections as ``OBSERVER.yaml``, which Stone Soup's own `YAML` loads: a list
    of sets, one for each frame, timed from the year 2000.

    Raises
    ------
    isac_rt.runtime.MissingPackage  Without the package `stonesoup`.
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    frames: Mapping[str, Any] = {
        str(name): stonesoup_detections(dataset, str(name), START)
        for name in dataset.observer.values
    }
    from stonesoup.serialise import YAML

    files = []
    for name, detections in frames.items():
        files.append(folder / f"{name.replace('->', '_to_')}.yaml")
        write_whole(files[-1], YAML().dumps(detections))
    return files


def write(results: Results, kind: str, folder: Path, city: Callable[[], CityMesh]) -> list[Path]:
    """Write a run in one of `FORMATS` into a folder.

    Parameters
    ----------
    city : of the run; asked for where it is drawn

    Raises
    ------
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    if kind == "csv":
        return write_csv(results.dataset, folder)
    if kind == "pcd":
        return write_points(results.dataset, folder)
    if kind == "rosbag":
        return write_bag(results.dataset, folder / f"{results.scenario.name}_bag")
    if kind == "stonesoup":
        return write_stonesoup(results.dataset, folder)
    file = folder / f"{results.scenario.name}.{kind}"
    if kind == "mat":
        write_mat(results.dataset, file)
    else:
        write_glb(results.dataset, city(), file)
    return [file]
