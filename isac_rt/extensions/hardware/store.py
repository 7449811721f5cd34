"""IF cubes and captures as NetCDF."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pydantic import TypeAdapter

from isac_rt.extensions.hardware.types import Capture
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import Waveform
from isac_rt.results.files import ResultsError, read_dataset, write_dataset
from isac_rt.runtime import shortly
from isac_rt.storage import BAD_DATA

_SAMPLE_AXES = ("group", "rx", "chirp", "sample")


def cube_dataset(cube: IFCube) -> xr.Dataset:
    """An IF cube as labelled arrays; NetCDF knows no complex numbers, so real and imaginary parts
    stand apart.

    Returns
    -------
    Dataset with `samples_re`, `samples_im` (group, rx, chirp, sample) float32 [sqrt(W)], `schedule`
    (group, chirp), the start of each slot `slot_time` (chirp,) and fast time `time` (sample,) [s];
    the waveform is the JSON attribute `waveform`
    """
    w = cube.waveform
    values = {
        "samples_re": (
            _SAMPLE_AXES,
            cube.samples.real,
            {"units": "W0.5", "long_name": "in-phase part of the IF samples"},
        ),
        "samples_im": (
            _SAMPLE_AXES,
            cube.samples.imag,
            {"units": "W0.5", "long_name": "quadrature part of the IF samples"},
        ),
        "schedule": (
            ("group", "chirp"),
            np.asarray(cube.schedule),
            {"units": "1", "long_name": "transmit antenna of each chirp"},
        ),
    }
    slots = cube.start_time + np.arange(w.num_chirps) * w.slot_duration
    coordinates = {
        "slot_time": ("chirp", slots, {"units": "s", "long_name": "start of the reference chirp"}),
        "time": (
            "sample",
            np.arange(w.num_samples) / w.sampling_rate,
            {"units": "s", "long_name": "time since that"},
        ),
    }
    attributes = {
        "waveform": json.dumps(asdict(w)),
        "start_time_s": cube.start_time,
        "Conventions": "CF-1.11",
    }
    return xr.Dataset(values, coordinates, attributes)


def save_cube(cube: IFCube, file: str | Path) -> None:
    """Write an IF cube as NetCDF (see `cube_dataset`); the file appears whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> import isac_rt as irt
    >>> setup = irt.prepare(irt.load("scenes/paper_swarm_consistent.yaml"))
    >>> cube = setup.frame(0).samples(("AT", "PT1"))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     irt.save_cube(cube, f"{folder}/cube.nc")
    ...     again = irt.load_cube(f"{folder}/cube.nc")
    >>> bool((again.samples == cube.samples).all())
    True
    """
    write_dataset(cube_dataset(cube), Path(file))


def load_cube(file: str | Path) -> IFCube:
    """An IF cube that `save_cube` or `save_capture` wrote.

    Raises
    ------
    ResultsError  If the file is not one.
    """
    return load_capture(file).cube


def save_capture(capture: Capture, file: str | Path) -> None:
    """Write a measured frame as NetCDF: its cube (see `cube_dataset`), `tx_place` and `rx_place`
    (element, axis) [m] where they are known, and the JSON attribute `source`."""
    dataset = cube_dataset(capture.cube)
    if capture.antennas is not None:
        for name in ("tx", "rx"):
            positions = getattr(capture.antennas, f"{name}_positions")[:, [0, 2]]
            about = {"units": "m", "long_name": f"{name} elements to the right (x) and up (z)"}
            dataset[f"{name}_place"] = ((f"{name}_element", "axis"), positions, about)
    dataset.attrs["source"] = json.dumps(dict(capture.source))
    write_dataset(dataset, Path(file))


def load_capture(file: str | Path) -> Capture:
    """A measured frame that `save_capture` wrote, or a cube that `save_cube` wrote.

    Raises
    ------
    ResultsError  If the file is not one.
    """
    try:
        d = read_dataset(Path(file))
        cube = checked_cube(
            d.samples_re.values + 1j * d.samples_im.values,
            json.loads(d.attrs["waveform"]),
            d.schedule.values,
            d.attrs["start_time_s"],
        )
        antennas = None
        if "tx_place" in d:
            antennas = Antennas.placed(d.tx_place.values, d.rx_place.values)
            seen = (antennas.num_tx, antennas.num_rx)
            if seen != (cube.waveform.num_tx, cube.samples.shape[1]):
                raise ValueError(f"places of {seen} elements do not fit its antennas")
        source = {str(k): str(v) for k, v in json.loads(d.attrs.get("source", "{}")).items()}
        return Capture(cube=cube, antennas=antennas, source=source)
    except (OSError, MemoryError, *BAD_DATA) as problem:
        raise ResultsError(
            f"cannot read an IF cube from {file}: {shortly(problem)}; give a file that `save_cube` "
            "wrote"
        ) from problem


def checked_cube(samples: np.ndarray, waveform: Any, schedule: np.ndarray, start: Any) -> IFCube:
    """A cube whose parts fit each other.

    Raises
    ------
    ValueError
    """
    if waveform.keys() != {field.name for field in fields(Waveform)}:
        raise ValueError("its waveform has other keys")
    w = TypeAdapter(Waveform).validate_python(waveform)
    shape = (w.num_groups, *samples.shape[1:2], w.num_chirps, w.num_samples)
    if samples.shape != shape or schedule.shape != (w.num_groups, w.num_chirps):
        raise ValueError(f"samples {samples.shape} and schedule {schedule.shape} are not {shape}")
    cube = IFCube(
        samples=np.ascontiguousarray(samples, np.complex64),
        waveform=w,
        schedule=schedule,
        start_time=float(start),
    )
    derived = (cube.start_time, w.slope, w.delay_step, w.frame_duration)
    if (
        not samples.size
        or not np.isfinite([*derived, w.carrier_frequency, w.filter_transition]).all()
        or min(derived[1:]) <= 0
        or not np.isfinite(cube.samples).all()
        or schedule.dtype.kind not in "iu"
        or not ((schedule >= 0) & (schedule < w.num_tx)).all()
    ):
        raise ValueError("a sample, a time or a transmit antenna cannot be")
    return cube
