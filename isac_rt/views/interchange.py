"""Files and objects that others read: path ledgers as NetCDF, IF cubes as SigMF, Sionna's path
sets, detections for Stone Soup.

SigMF and Stone Soup are the extra ``interchange`` (`pip install isac_rt[interchange]`).
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from isac_rt.frame.antennas import unit_vector
from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.results.columns import DIMENSIONLESS, PATHS, Column
from isac_rt.results.dataset import stacked
from isac_rt.results.files import write_dataset
from isac_rt.results.records import KINDS
from isac_rt.runtime import needed
from isac_rt.storage import write_whole

if TYPE_CHECKING:
    import sionna.rt as rt
    from stonesoup.types.detection import Detection

EXTRA = "interchange"


def write_ledger(
    paths: Mapping[Link, PathSet],
    file: str | Path,
    carrier_frequency: Mapping[str, float],
    attributes: Mapping[str, str | int],
) -> None:
    """Write the path ledger of one frame, all links, as NetCDF.

    Rows over the dimension ``path`` with the columns of `PATHS`, ``doppler`` [Hz], wavefront radii,
    the transmitter and receiver of each, interaction points (path, bounce, axis) [m] and faces of
    the city mesh (path, bounce).

    Parameters
    ----------
    carrier_frequency : of the Doppler shifts, by transmitter [Hz]
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
            lambda p: -carrier_frequency[p.tx] * p.delay_rate,
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
    sigmf = needed("sigmf", EXTRA)
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
    needed("stonesoup", EXTRA)
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
    direction = np.maximum(unit_vector(u), [-1.0, 1e-6, -1.0])
    d, forward = rotation @ direction, direction[1]
    to_world = rotation @ np.array(
        [[1.0, 0.0], [-u[0] / forward, -u[1] / forward], [0.0, 1.0]]
    )  # d of direction by (u_x, u_z)
    level = d[0] ** 2 + d[1] ** 2
    jacobian = np.array(
        [to_world[2] / np.sqrt(level), (d[0] * to_world[1] - d[1] * to_world[0]) / level]
    )
    return np.array([np.arcsin(d[2]), np.arctan2(d[1], d[0])]), jacobian @ np.diag(
        std**2
    ) @ jacobian.T
