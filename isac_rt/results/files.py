"""One self-describing file per run: what is recorded of every frame, how it is summed up, saved and
loaded.

`Recorder` collects frames and makes one `xarray.Dataset` with named dimensions; what differs in
number from frame to frame (detections, tracks, paths) is ragged: flat arrays beside their frame and
observer. Nothing that depends on the clock of the machine is in the dataset, so two runs of one
scenario give bit-identical variables.
"""

from __future__ import annotations

import io
import json
import math
import mmap
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

from isac_rt.results.losses import LOSSES
from isac_rt.results.recorder import Results
from isac_rt.runtime import UserError, available_memory, shortly
from isac_rt.scenario.file import to_yaml
from isac_rt.storage import (
    BAD_DATA,
    MOST_JSON_BYTES,
    StorageError,
    check_heaps,
    check_unfolded,
    read_whole,
    write_whole,
)

if TYPE_CHECKING:
    import xarray as xr

FILE = "results.nc"
ROOM_BYTES = 50_000_000
"""Free on the disk before a run: a short one writes 10 MB, and its log as much while it runs."""

COMPRESSION = {"compression": "gzip", "compression_opts": 4, "shuffle": True, "fletcher32": True}
HDF5_FORMAT = ("v110", "v110")
"""Format of HDF5 1.10, of 2016: its metadata have checksums, so that a flipped byte cannot make one
variable's numbers another's."""


RENAMED = {
    "shadowed": "occluded",
    "hidden": "occluded",
    "not_read": "erased",
    "empty_m": "no_tracks_m",
    "bits_room": "bits_capacity",
    "unheard_per_frame": "filtered_per_frame",
    "judged": "tested",
    "picture": "owner",
    "picture_room": "fused_capacity",
    "fused_picture": "fused_owner",
}
"""New names of variables and of figures of earlier versions."""


class ResultsError(UserError):
    """Results cannot be read; the text says why and what to do."""


class _Block(BaseModel):
    """First lines about a terminal."""

    hit_rate: float | None
    ser_delay: float | None
    ser_dpsk: float | None


class _Summary(BaseModel):
    frames: int
    seed: int
    terminals: dict[str, _Block]


def write_dataset(dataset: xr.Dataset, file: Path) -> None:
    """Write a NetCDF-4 file, compressed and with checksums, that appears whole or not at all.

    It is made in memory: on a full disk the HDF5 library may end the process. xarray would load
    dask to write it.
    """
    import h5netcdf
    import h5py

    made = io.BytesIO()
    auxiliary = {name: {*c.dims} for name, c in dataset.coords.items() if name not in dataset.dims}
    with h5netcdf.File(made, "w", libver=HDF5_FORMAT) as whole:
        whole.dimensions = dict(dataset.sizes)
        whole.attrs.update(dataset.attrs)
        for name, variable in dataset.variables.items():
            values, attrs = np.asarray(variable.values), dict(variable.attrs)
            words = values.dtype.kind in "OU"
            packed = {} if words or not values.size or not values.ndim else COMPRESSION
            if values.dtype == bool:
                values, attrs["dtype"] = values.astype(np.int8), "bool"
            located = [str(other) for other, dims in auxiliary.items() if dims <= {*variable.dims}]
            if located and name not in dataset.coords:
                attrs["coordinates"] = " ".join(located)
            fill = np.nan if values.dtype.kind == "f" else None
            values = values.astype(h5py.string_dtype()) if words else values
            of = {"dtype": values.dtype, "data": values, "fillvalue": fill, **packed}
            whole.create_variable(str(name), variable.dims, **of).attrs.update(attrs)
    write_whole(file, made.getvalue())


def read_dataset(file: Path) -> xr.Dataset:
    """A NetCDF file that `write_dataset` wrote, in memory.

    Raises
    ------
    OSError, MemoryError or one of `BAD_DATA`  If it is none, or bent.
    """
    import h5py
    import xarray as xr

    if not file.is_file():
        raise OSError(f"{file} is no file" if file.exists() else f"there is no {file}")
    with open(file, "rb") as read:
        if file.stat().st_size:
            with mmap.mmap(read.fileno(), 0, access=mmap.ACCESS_READ) as content:
                check_heaps(content)
    with h5py.File(file) as whole:
        check_unfolded(whole, file.stat().st_size, available_memory() or math.inf)
        whole.attrs.get("_nc3_strict")  # where this fails, h5netcdf cannot close what it opened
    with xr.open_dataset(file, engine="h5netcdf") as opened:
        return opened.load()


NO_DATES: dict[str, dict[str, Any]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}
"""What keeps the clock and the library out of a figure of each form."""
PACKED: dict[str, dict[str, Any]] = {"png": {"pil_kwargs": {"compress_level": 3}}}
"""How hard a form is packed: a third of the time, for a twentieth more bytes."""


def write_figure(file: Path, figure: Any, **options: Any) -> None:
    """A matplotlib figure as a file of the form that its suffix names, PNG, SVG or PDF; it appears
    whole or not at all. Options as for its `savefig`."""
    form, drawn = file.suffix[1:], io.BytesIO()
    figure.savefig(drawn, format=form, metadata=NO_DATES[form], **PACKED.get(form, {}) | options)
    write_whole(file, drawn.getvalue())


def save(results: Results, folder: str | Path) -> None:
    """Write ``results.nc``, ``summary.json`` and ``scenario.yaml`` into `folder`; each appears
    whole or not at all.

    Raises
    ------
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    folder = Path(folder)
    write_dataset(results.dataset, folder / FILE)
    write_whole(folder / "scenario.yaml", to_yaml(results.scenario, folder))
    write_whole(
        folder / "summary.json", json.dumps(results.summary, indent=1, allow_nan=False) + "\n"
    )


def with_new_names(tree: Any) -> Any:
    """Replace keys of earlier versions in a summary or a sample's truth."""
    if not isinstance(tree, dict):
        return tree
    return {
        key if isinstance(value, dict) else RENAMED.get(key, key): with_new_names(value)
        for key, value in tree.items()
    }


def new_variables(dataset: xr.Dataset) -> xr.Dataset:
    """Replace names of earlier versions in a dataset."""
    old = [str(name) for name in dataset.variables]
    new = {name: RENAMED.get(name, name.replace("picture_", "fused_")) for name in old}
    dataset = dataset.rename({name: to for name, to in new.items() if to != name})
    if "loss" in dataset:
        dataset.loss.attrs["flag_meanings"] = " ".join(LOSSES)
    return dataset


def check_folder(folder: str | Path, room: float | None = None) -> None:
    """Refuse a folder that cannot be made or written, or has less room [bytes], before a long run
    rather than after it.

    Raises
    ------
    isac_rt.storage.StorageError
    """
    probe = Path(folder) / ".writable"
    write_whole(probe, "")
    probe.unlink(missing_ok=True)
    free = shutil.disk_usage(folder).free
    room = ROOM_BYTES if room is None else room
    if free < room:
        raise StorageError(
            f"{folder}: {free / 1e6:.0f} MB are free, {room / 1e6:.0f} MB are needed; choose "
            "another folder with --out, or make room"
        )


def open_results(folder: str | Path) -> Results:
    """Results that `save` wrote into `folder`.

    Raises
    ------
    ResultsError  If a file is missing or is not one of ours.
    """
    from isac_rt.scenario.file import load as load_scenario

    folder = Path(folder)
    try:
        dataset = new_variables(read_dataset(folder / FILE))
        summary = with_new_names(json.loads(read_whole(folder / "summary.json", MOST_JSON_BYTES)))
        _Summary.model_validate(summary)
    except (OSError, MemoryError, *BAD_DATA) as problem:
        raise ResultsError(
            f"cannot read results in {folder}: {shortly(problem)}; give the folder that "
            "`isac-rt run` wrote"
        ) from problem
    return Results(dataset, summary, load_scenario(folder / "scenario.yaml", without_removed=True))
