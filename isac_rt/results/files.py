"""One self-describing file per run: what is recorded of every frame, how it is summed up, saved and
loaded.

`Recorder` collects frames and makes one `xarray.Dataset` with named dimensions; what differs in
number from frame to frame (detections, tracks, paths) is ragged: flat arrays beside their frame and
observer. Nothing that depends on the clock of the machine is in the dataset, so two runs of one
scenario give bit-identical variables.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import xarray as xr

from isac_rt.results.recorder import Results
from isac_rt.runtime import UserError
from isac_rt.scenario.file import to_yaml

FILE = "results.nc"


class ResultsError(UserError):
    """Results cannot be written or read; the text says why and what to do."""


def _atomically(file: Path, write: Callable[[Path], object]) -> None:
    """Have `write` make a file under a temporary name beside `file`, then put it in place whole; or
    raise and leave nothing."""
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        os.replace(temporary, file)
    except OSError as problem:
        reason = problem.strerror or str(problem)
        raise ResultsError(
            f"cannot write {file}: {reason}; choose another place with --out, or make room"
        ) from problem
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
    _atomically(
        file, lambda temporary: dataset.to_netcdf(temporary, engine="h5netcdf", encoding=encoding)
    )


def save(results: Results, folder: str | Path) -> None:
    """Write ``results.nc``, ``summary.json`` and ``scenario.yaml`` into `folder`; each appears
    whole or not at all.

    Raises
    ------
    ResultsError  If the folder cannot be written.
    """
    folder = Path(folder)
    write_dataset(results.dataset, folder / FILE)
    write_text(folder / "scenario.yaml", to_yaml(results.scenario, folder))
    write_text(
        folder / "summary.json", json.dumps(results.summary, indent=1, allow_nan=False) + "\n"
    )


def check_folder(folder: str | Path) -> None:
    """Refuse a folder that cannot be made or written, before a long run rather than after it."""
    probe = Path(folder) / ".writable"
    write_text(probe, "")
    probe.unlink(missing_ok=True)


def open_results(folder: str | Path) -> Results:
    """Results that `save` wrote into `folder`.

    Raises
    ------
    ResultsError  If a file is missing or is not one of ours.
    """
    from isac_rt.scenario.file import load as load_scenario

    folder = Path(folder)
    try:
        with xr.open_dataset(folder / FILE, engine="h5netcdf") as opened:
            dataset = opened.load()
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise ResultsError(
            f"cannot read results in {folder}: {problem}; give the folder that `isac-rt run` wrote"
        ) from problem
    return Results(dataset, summary, load_scenario(folder / "scenario.yaml"))
