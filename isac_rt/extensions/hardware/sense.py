"""The program's receiver on measured samples, and a picture over range and azimuth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from isac_rt.extensions.hardware.types import Capture, CaptureError
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.active import receive_active
from isac_rt.receive.estimate import Estimate
from isac_rt.receive.known import Known
from isac_rt.receive.sense import describe
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections, Reception
from isac_rt.track.filter import Ambiguity
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Tracker, in_plane
from isac_rt.world.swarm import Pose

AT_ORIGIN = Pose(np.zeros(3), np.zeros(3), np.zeros(3), np.eye(3))
"""A board that stands still and looks along y."""


def sense(capture: Capture, settings: Receivers) -> Reception:
    """Detect paths in a measured frame with the active terminal's receiver; return them with the
    map.

    Images in the upper half of the range cells, where a board samples one of I and Q alone or both
    bands, are left out. Where every antenna sends one chirp only there is no velocity: what is
    found is taken to be at rest, and its direction is that of all channels at its range.

    Raises
    ------
    CaptureError  If the positions of the elements are unknown, or the settings ask for what a
        measured frame does not have.
    """
    cube = capture.cube
    for key, able in (("clutter_detector", ("cfar",)), ("refinement", ("local", "grid"))):
        if (value := getattr(settings, key)) not in able:
            raise CaptureError(
                f"receivers.{key}: {value} is not made for a measured frame, which comes without a "
                f"city's mesh; use {' or '.join(able)}"
            )
    found = receive_active(
        cube, unmodulated(cube.waveform), _antennas(capture), settings, maps=True
    )
    detections = found.detections
    if cube.waveform.num_chirps == cube.waveform.num_tx:
        detections = _at_rest(capture, detections)
    if capture.one_sided:
        farthest = cube.waveform.num_samples / 2 * cube.waveform.range_cell(2)
        detections = detections.select(detections.range < farthest)
    return replace(found, detections=detections)


def sense_all(
    captures: Sequence[Capture],
    settings: Receivers,
    tracking: Tracking,
    interval: float | None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> xr.Dataset:
    """Detect in all frames of a recording and track from frame to frame, as a terminal at rest.

    Parameters
    ----------
    interval : from frame to frame [s]; None: detections alone

    Returns
    -------
    As `as_dataset`, with the map of the last frame, `det_frame`, and variables `track_*` in the
    axes of the board (x to the right, y ahead, z up)

    Raises
    ------
    CaptureError  As `sense`.
    """
    tracker = Tracker(tracking, Ambiguity.of(captures[0].cube.waveform, 2))
    found, tracks = [], []
    for k, capture in enumerate(captures):
        report(k, len(captures))
        found.append(sense(capture, settings))
        if interval is not None:
            tracker.predict(k * interval)
            tracker.update(in_plane(found[-1].detections), AT_ORIGIN)
        tracks.append(tracker.snapshot(AT_ORIGIN))
    report(len(captures), len(captures))
    every = Detections.joined([one.detections for one in found])
    out = as_dataset(replace(found[-1], detections=every))
    of = {"units": "1", "long_name": "frame"}
    counts = [len(one.detections) for one in found]
    out["det_frame"] = ("detection", np.repeat(np.arange(len(found)), counts), of)
    out["track_frame"] = ("track", np.repeat(np.arange(len(found)), [len(t) for t in tracks]), of)
    states = ("track", "component"), np.concatenate([t.mean for t in tracks])
    for name, (dims, values), unit, meaning in (
        ("id", ("track", np.concatenate([t.ids for t in tracks])), "1", "number of the track"),
        ("state", states, "m, m/s", "position and velocity from the board"),
        ("range", ("track", np.concatenate([t.range for t in tracks])), "m", "range, one way"),
        (
            "confirmed",
            ("track", np.concatenate([t.confirmed for t in tracks])),
            "1",
            "whether enough detections confirm it",
        ),
    ):
        out[f"track_{name}"] = (dims, values, {"units": unit, "long_name": meaning})
    return out


def _at_rest(capture: Capture, found: Detections) -> Detections:
    """The same ranges with directions of what does not move."""
    y, w, antennas = capture.channels(), capture.cube.waveform, _antennas(capture)
    known = Known.unmodulated(w, capture.cube.schedule, antennas, 2)
    delay = found.range / known.metres
    window = _hann(w.num_samples)
    beat = np.multiply.outer(delay * w.slope / w.sampling_rate, np.arange(w.num_samples))
    channels = y @ (window / window.sum() * np.exp(-2j * np.pi * beat)).T  # (L_rx, L_tx, Q)
    estimates = [Estimate(tau, 0.0, channels[..., q].T) for q, tau in enumerate(delay.tolist())]
    return describe(estimates, found.snr, known)


def range_azimuth(capture: Capture, azimuth: np.ndarray, farthest: float) -> xr.DataArray:
    """Power (range, azimuth) of the sum of all channels, each turned by the way of a wave from
    there and back, under a Hann window in range; transmitters' and receivers' ways add.

    The mean chirp of each pair of antennas is taken: what moves fades.

    Parameters
    ----------
    azimuth : (K,) from the boresight to the right, at the height of the array [rad]
    farthest : range that is shown [m]

    Raises
    ------
    CaptureError  If the positions of the elements are unknown.
    """
    antennas, w = _antennas(capture), capture.cube.waveform
    y = capture.channels()
    size = y.shape[-1]
    rows = min(int(farthest / w.range_cell(2)) + 1, size)
    spectra = np.fft.fft(y * _hann(size), axis=-1)[..., :rows]
    distance = np.maximum(np.arange(rows) * w.range_cell(2), w.range_cell(2))
    points = np.stack([np.sin(azimuth), np.cos(azimuth), 0 * azimuth], axis=-1)
    points = distance[:, None, None] * points
    power = np.empty((rows, len(azimuth)))
    wave = -2j * np.pi * float(w.effective_carrier) / SPEED_OF_LIGHT
    for row in range(rows):
        rx, tx = (
            np.exp(wave * (np.linalg.norm(points[row, :, None] - at, axis=-1) - distance[row]))
            for at in (antennas.rx_positions, antennas.tx_positions)
        )
        power[row] = np.abs(np.einsum("kr,rt,kt->k", rx, spectra[:, :, row], tx)) ** 2
    return xr.DataArray(
        power,
        {"range": np.arange(rows) * w.range_cell(2), "azimuth": np.rad2deg(azimuth)},
        ("range", "azimuth"),
        "power",
        {"units": "1", "long_name": "power of the sum of all channels"},
    )


def _hann(size: int) -> np.ndarray:
    """Hann window (size,) whose zeros lie half a sample before the chirp and behind it."""
    return np.asarray(np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2)


def _antennas(capture: Capture) -> Antennas:
    if capture.antennas is None:
        raise CaptureError(
            "the positions of the elements are unknown, so no direction can be told; state "
            "elements in the description"
        )
    return capture.antennas


def as_dataset(found: Reception) -> xr.Dataset:
    """Detections and the range-Doppler map, named as in the results of a run."""
    d, m = found.detections, found.maps
    assert m is not None
    values = {
        "range": (d.range, "m", "range, one way"),
        "velocity": (d.velocity, "m/s", "radial velocity, positive receding"),
        "u_x": (d.direction[:, 0], "1", "direction cosine to the right"),
        "u_z": (d.direction[:, 1], "1", "direction cosine upwards"),
    }
    out: dict[str, Any] = {}
    for i, (name, (column, unit, meaning)) in enumerate(values.items()):
        about = {"units": unit, "long_name": meaning}
        out[f"det_{name}"] = ("detection", column, about)
        spread = {"units": unit, "long_name": f"standard deviation of the {meaning}"}
        out[f"det_{name}_std"] = ("detection", d.std[:, i], spread)
    level = {"units": "1", "long_name": "power over the background of its cell"}
    out["det_snr"] = ("detection", d.snr, level)
    power = {"units": "1", "long_name": "power, accumulated over the channels"}
    out["map_power"] = (("map_range", "map_velocity"), m.range_doppler, power)
    axes = {
        "map_range": ("map_range", m.range_axis, {"units": "m", "long_name": "range"}),
        "map_velocity": (
            "map_velocity",
            m.velocity_axis,
            {"units": "m/s", "long_name": "radial velocity, positive receding"},
        ),
    }
    return xr.Dataset(out, axes)
