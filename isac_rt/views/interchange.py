"""Files and objects that others read: path ledgers and IF cubes as NetCDF, cubes as SigMF, Sionna's
path sets, detections for Stone Soup.

SigMF and Stone Soup are the extra ``interchange`` (`pip install isac_rt[interchange]`).
"""

from __future__ import annotations

import datetime
import hashlib
import importlib
import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from pydantic import TypeAdapter

from isac_rt.frame.antennas import unit_vector
from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.results.dataset import DIMENSIONLESS, PATHS, Column, stacked
from isac_rt.results.files import ResultsError, read_dataset, write_dataset
from isac_rt.results.records import KINDS
from isac_rt.runtime import MissingPackage
from isac_rt.storage import BAD_DATA, read_whole, write_whole

if TYPE_CHECKING:
    import sionna.rt as rt
    from stonesoup.types.detection import Detection

EXTRA = "pip install 'isac_rt[interchange]'"
MOST_META_BYTES = 64 * 1024**2
"""No description of a recording is larger."""
_SAMPLE_AXES = ("group", "rx", "chirp", "sample")


def write_ledger(
    paths: Mapping[Link, PathSet],
    file: str | Path,
    carrier_frequency: float,
    attributes: Mapping[str, str | int],
) -> None:
    """Write the path ledger of one frame, all links, as NetCDF.

    Rows over the dimension ``path`` with the columns of `PATHS`, ``doppler`` [Hz], wavefront radii,
    the transmitter and receiver of each, interaction points (path, bounce, axis) [m] and faces of
    the city mesh (path, bounce).

    Parameters
    ----------
    carrier_frequency : of the Doppler shifts [Hz]
    attributes : of the file, such as `isac_rt.results.provenance.provenance` gives

    Raises
    ------
    isac_rt.storage.StorageError  If the file cannot be written.
    """
    curvature = "radius of curvature of the wavefront at the"
    columns = {
        "transmitter": _names("transmitting terminal", "tx"),
        "receiver": _names("receiving terminal", "rx"),
        **PATHS,
        "doppler": Column(
            float,
            "Hz",
            "Doppler shift at the carrier, positive closing",
            lambda p: -carrier_frequency * p.delay_rate,
        ),
        "tx_radius": Column(float, "m", f"{curvature} transmitter", "tx_radius"),
        "rx_radius": Column(float, "m", f"{curvature} receiver", "rx_radius"),
    }
    out: dict[str, xr.Variable] = {}
    for name, column in columns.items():
        values = stacked([np.asarray(column.read(p), column.dtype) for p in paths.values()], column)
        about = {"units": column.units, "long_name": column.meaning}
        out[name] = xr.Variable(("path", *column.dims), values, about)
    uavs = next((p.target_names for p in paths.values() if p.target_names), ())
    for name, dim, names, meaning in (
        ("kind_name", "kind", KINDS, "name of each kind of path"),
        ("target_name", "uav", uavs, "name that target indexes"),
    ):
        about = {"units": DIMENSIONLESS, "long_name": meaning}
        out[name] = xr.Variable([dim], np.array(names, object), about)
    epoch = next((p.epoch for p in paths.values()), np.nan)
    write_dataset(xr.Dataset(out, attrs={**attributes, "epoch_s": epoch}), Path(file))


def _names(meaning: str, end: str) -> Column:
    return Column(
        object, DIMENSIONLESS, meaning, lambda p: np.full(len(p), getattr(p, end), object)
    )


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
    """An IF cube that `save_cube` wrote.

    Raises
    ------
    ResultsError  If the file is not one.
    """
    try:
        d = read_dataset(Path(file))
        return _checked_cube(
            d.samples_re.values + 1j * d.samples_im.values,
            json.loads(d.attrs["waveform"]),
            d.schedule.values,
            d.attrs["start_time_s"],
        )
    except (OSError, MemoryError, *BAD_DATA) as problem:
        raise ResultsError(
            f"cannot read an IF cube from {file}: {_short(problem)}; give a file that `save_cube` "
            "wrote"
        ) from problem


def _checked_cube(samples: np.ndarray, waveform: Any, schedule: np.ndarray, start: Any) -> IFCube:
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


def _short(problem: BaseException) -> str:
    return " ".join(str(problem).split())[:300]


def write_sigmf(cube: IFCube, file: str | Path, description: str = "") -> tuple[Path, Path]:
    """Write IF samples as a SigMF recording: ``FILE.sigmf-data`` and ``FILE.sigmf-meta``.

    Channels are the receive antennas of group 0, then of group 1 and so on; samples run through the
    chirps one after the other with the pauses between them left out. Each chirp is an annotation
    with its transmit antennas. What SigMF has no field for stands under ``isac_rt:`` (waveform,
    schedule, start time).

    Raises
    ------
    isac_rt.runtime.MissingPackage  Without the package `sigmf`.
    """
    sigmf = _imported("sigmf")
    w, base = cube.waveform, Path(file)
    groups, antennas = cube.samples.shape[:2]
    data, meta = (
        base.with_name(base.name + ".sigmf-data"),
        base.with_name(base.name + ".sigmf-meta"),
    )
    rows = cube.samples.transpose(2, 3, 0, 1).reshape(-1, groups * antennas).astype("<c8")
    write_whole(data, rows.tobytes())
    made = sigmf.SigMFFile(
        data_file=str(data),
        global_info={
            "core:datatype": "cf32_le",
            "core:sample_rate": w.sampling_rate,
            "core:num_channels": groups * antennas,
            "core:description": description or "dechirped IF samples",
            "core:recorder": "isac_rt",
            "core:extensions": [{"name": "isac_rt", "version": "1.0.0", "optional": True}],
            "isac_rt:waveform": asdict(w),
            "isac_rt:schedule": np.asarray(cube.schedule).tolist(),
            "isac_rt:start_time_s": cube.start_time,
        },
    )
    made.add_capture(0, metadata={"core:frequency": w.carrier_frequency})
    for p in range(w.num_chirps):
        senders = " ".join(str(int(row[p])) for row in cube.schedule)
        made.add_annotation(
            p * w.num_samples,
            w.num_samples,
            metadata={"core:label": f"chirp {p}", "core:comment": f"transmit antennas {senders}"},
        )
    made.validate()
    write_whole(meta, made.dumps())
    return data, meta


def read_sigmf(file: str | Path) -> IFCube:
    """An IF cube from a recording that `write_sigmf` made; `file` without the suffix.

    Raises
    ------
    ResultsError  If it is none, or its data are not those of its checksum.
    """
    base = Path(file)
    try:
        meta = read_whole(base.with_name(base.name + ".sigmf-meta"), MOST_META_BYTES)
        data = read_whole(base.with_name(base.name + ".sigmf-data"))
        info = json.loads(meta)["global"]
        if hashlib.sha512(data).hexdigest() != info["core:sha512"]:
            raise ValueError("the data are not those of its checksum")
        w, schedule = info["isac_rt:waveform"], np.array(info["isac_rt:schedule"])
        shape = (w["num_chirps"], w["num_samples"], len(schedule), -1)
        samples = np.frombuffer(data, "<c8").reshape(shape).transpose(2, 3, 0, 1)
        return _checked_cube(samples, w, schedule, info["isac_rt:start_time_s"])
    except (OSError, MemoryError, *BAD_DATA) as problem:
        raise ResultsError(
            f"cannot read an IF cube from {base}: {_short(problem)}; give a recording that "
            "`write_sigmf` made"
        ) from problem


def from_sionna(
    paths: rt.Paths,
    carrier_frequency: float,
    *,
    transmitter: int = 0,
    receiver: int = 0,
    epoch: float = 0.0,
) -> PathSet:
    """The paths of one link from a Sionna RT `Paths` object, for the signal model here.

    Sionna's delays are float32: at 100 m they are good to some 10 um, 0.1 rad of phase at 77 GHz,
    and the phases of two paths against each other no better. Doppler shifts are Sionna's;
    accelerations are zero, wavefronts plane.

    Parameters
    ----------
    paths : of single-element arrays, or synthetic arrays whose first elements are taken
    carrier_frequency : of the scene [Hz]
    transmitter, receiver : positions in the scene's lists
    epoch : time that the paths belong to [s]
    """
    end = receiver, transmitter

    def flat(values: Any, dtype: type = np.float64) -> np.ndarray:
        array: np.ndarray = np.asarray(values, dtype)
        if array.ndim == 5:  # antennas are apart: the first of each
            array = array[:, 0, :, 0]
        return array[end]

    valid = np.asarray(paths.valid)
    valid = (valid[:, 0, :, 0] if valid.ndim == 5 else valid)[end]
    real, imag = (np.asarray(part, np.float64)[receiver, 0, transmitter, 0] for part in paths.a)
    interactions = np.asarray(paths.interactions)
    interactions = interactions[:, :, 0, :, 0] if interactions.ndim == 6 else interactions
    kinds = interactions[:, receiver, transmitter]  # depth, paths; 0 none, 2 diffuse
    theta_t, phi_t, theta_r, phi_r = (
        flat(getattr(paths, name)) for name in ("theta_t", "phi_t", "theta_r", "phi_r")
    )
    bounces = (kinds != 0).sum(axis=0)
    kind = np.where(
        bounces == 0,
        PathKind.LINE_OF_SIGHT,
        np.where((kinds == 2).any(axis=0), PathKind.DIFFUSE, PathKind.SPECULAR),
    )
    every = make_paths(
        gain=real + 1j * imag,
        delay=flat(paths.tau),
        delay_rate=-flat(paths.doppler) / carrier_frequency,
        departure=_unit(theta_t, phi_t),
        arrival=_unit(theta_r, phi_r),
        kind=kind,
        bounces=bounces,
        epoch=epoch,
        tx=f"tx{transmitter}",
        rx=f"rx{receiver}",
    )
    return every.select(np.flatnonzero(valid))


def _unit(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Zenith and azimuth angles to unit vectors (..., 3)."""
    return np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    )


def stonesoup_detections(
    dataset: xr.Dataset, observer: str, start: datetime.datetime
) -> list[set[Detection]]:
    """A run's detections as Stone Soup `Detection` objects, one set per frame, each with its
    measurement model.

    The state is (x, vx, y, vy, z, vz) in world axes [m, m/s]; a detection is (elevation, bearing,
    range, range rate) in world axes as seen from the moving observer, with the covariance of the
    estimate. An active terminal's detections are all there; of a passive one only the line of
    sight, since a bistatic range has no such model.

    Parameters
    ----------
    dataset : of a run's results
    observer : its name
    start : of the run, the timestamps' zero

    Raises
    ------
    isac_rt.runtime.MissingPackage  Without the package `stonesoup`.
    KeyError  If there is no such observer.
    """
    _imported("stonesoup")
    from stonesoup.models.measurement.nonlinear import CartesianToElevationBearingRangeRate
    from stonesoup.types.array import CovarianceMatrix, StateVector
    from stonesoup.types.detection import Detection

    index = {str(name): i for i, name in enumerate(dataset.observer.values)}[observer]
    name = str(dataset.receiver.values[index])
    own, bistatic = (
        list(dataset.uav.values).index(name),
        str(dataset.transmitter.values[index]) != name,
    )
    mine = (dataset.det_observer.values == index) & (
        dataset.det_is_reference.values | (not bistatic)
    )
    out: list[set[Detection]] = [set() for _ in range(dataset.sizes["frame"])]
    for k in np.flatnonzero(mine):
        frame = int(dataset.det_frame.values[k])
        rotation = dataset.uav_attitude.values[frame, own]
        u, std = (
            np.array([dataset[f"det_{c}{s}"].values[k] for c in ("u_x", "u_z")])
            for s in ("", "_std")
        )
        angles, covariance = _world_angles(u, std, rotation)
        spread = np.zeros((4, 4))
        spread[:2, :2] = covariance
        spread[2, 2], spread[3, 3] = (
            dataset.det_range_std.values[k] ** 2,
            dataset.det_velocity_std.values[k] ** 2,
        )
        model = CartesianToElevationBearingRangeRate(
            ndim_state=6,
            mapping=np.array([0, 2, 4]),
            velocity_mapping=np.array([1, 3, 5]),
            noise_covar=CovarianceMatrix(spread),
            translation_offset=StateVector(dataset.uav_position.values[frame, own]),
            velocity=StateVector(dataset.uav_velocity.values[frame, own]),
        )
        measured = StateVector(
            [*angles, dataset.det_range.values[k], dataset.det_velocity.values[k]]
        )
        when = start + datetime.timedelta(seconds=float(dataset.time.values[frame]))
        out[frame].add(
            Detection(
                measured,
                timestamp=when,
                measurement_model=model,
                metadata={"snr": float(dataset.det_snr.values[k])},
            )
        )
    return out


def _world_angles(
    u: np.ndarray, std: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(elevation, bearing) in world axes [rad] of body direction cosines (u_x, u_z), and their
    covariance by linear propagation."""
    body = np.maximum(unit_vector(u), [-1.0, 1e-6, -1.0])
    d, forward = rotation @ body, body[1]
    turn = rotation @ np.array(
        [[1.0, 0.0], [-u[0] / forward, -u[1] / forward], [0.0, 1.0]]
    )  # d of direction by (u_x, u_z)
    level = d[0] ** 2 + d[1] ** 2
    jacobian = np.array([turn[2] / np.sqrt(level), (d[0] * turn[1] - d[1] * turn[0]) / level])
    return np.array([np.arcsin(d[2]), np.arctan2(d[1], d[0])]), jacobian @ np.diag(
        std**2
    ) @ jacobian.T


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as problem:
        raise MissingPackage(f"this needs the package {name}: {EXTRA}") from problem
