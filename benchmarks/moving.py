"""Cost and error of many scattering centres that move: a pedestrian of 128 points before a radar of
3 x 4 antennas, 128 chirps of each transmitter and 256 samples a chirp.

The chirps are of 40 MHz/us at 77 GHz in slots of 65 us, sampled at 4.4 MHz. The pedestrian walks an
ellipse of 5 m by 1.5 m in 30 s, 7 m before the radar, which is 1 m high. Cost is that of paths,
copies to centres and samples of a frame. Errors are measured on a tenth of the chirps against the
exact model: the sum over all points in float64 with every point's place at every sample.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmarks.measure import cpu_seconds, floor_seconds
from isac_rt.extensions.street.centres import MovingCentres, body_axes
from isac_rt.extensions.street.walker import walker_of
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Direct
from isac_rt.simulation.setup import prepare

LINK = Link("radar", "radar")
HIP_M, TURN_S, BEFORE_M = 0.93, 30.0, 7.0
SEMI_AXES_M = (5.0, 1.5)
START = 1.0
"""Angle on the ellipse in the frame: neither along nor across the view [rad]."""


class Job:
    """The radar, the pedestrian and one frame."""

    def __init__(self, chirps: int = 128) -> None:
        self.setup = prepare(scenario(3 * chirps))
        self.frame = self.setup.frame(0)
        s = self.setup
        uav = s.swarm.uavs["person"]
        assert uav.waypoints is not None
        section = 10 ** (uav.rcs.value_dbsm / 10)
        speed = float(np.linalg.norm(self.frame.poses["person"].velocity))
        self.walker = walker_of(HIP_M / 0.53, speed, section, np.random.default_rng(4))
        self.amplitudes = self.walker.amplitude.conj()
        centres = [("person", self.walker)]
        self.moving = MovingCentres(s.swarm, s.reference.sections, s.waveform, s.arrays, centres)

    def samples(self) -> np.ndarray:
        """(1, 4, 384, 256) complex64."""
        epoch = self.setup.timetable.epoch(0)
        paths = self.moving.with_centres(self.frame.paths[LINK], self.frame.poses, epoch)
        links = [(self.frame.sent["radar"], paths)]
        ears = self.frame._listening(LINK)
        return if_signal(self.setup.waveform, links, *ears, Direct()).samples

    def truth(self, chirps: range) -> np.ndarray:
        """Return the samples of some chirps (1, 4, C, 256) complex128 by places at every sample."""
        s, frame = self.setup, self.frame
        w, pose, antennas = s.waveform, frame.poses["radar"], s.arrays.of("radar")
        rx = pose.position + pose.to_world(antennas.rx_positions)
        tx = pose.position + pose.to_world(antennas.tx_positions)
        section = s.reference.sections["person"].square_metres(*2 * [np.array([0.0, 1.0, 0.0])])
        sent, echo = frame.sent["radar"], frame.paths[LINK]
        gain = sent.amplitude * echo.gain[0] / np.sqrt(section)
        flight, start = s.swarm.trajectories["person"], pose.position
        far = np.linalg.norm(frame.poses["person"].position - start)
        pattern = antennas.element_gain(pose.to_body(echo.departure))
        out = np.zeros((1, len(rx), len(chirps), w.num_samples), complex)
        for c, p in enumerate(chirps):
            time = p * w.slot_duration + w.fast_time
            place = flight.positions(time)
            axes = body_axes(s.swarm, "person", float(time.mean()))
            points = place[:, None] + self.walker.motion(time).place @ axes.T
            near = np.linalg.norm(points - start, axis=2)
            ahead = pose.to_body((points - start) / near[..., None])
            share = (far / near) ** 2 * antennas.element_gain(ahead) / pattern
            there = np.linalg.norm(points - tx[sent.schedule[0, p]], axis=2)
            for r, element in enumerate(rx):
                back = np.linalg.norm(points - element, axis=2)
                tau = (there + back) / SPEED_OF_LIGHT
                tones = np.exp(2j * np.pi * w.phase(tau, w.fast_time[:, None]))
                out[0, r, c] = np.conj(gain) * (tones * share * self.amplitudes).sum(axis=1)
        return out


def scenario(chirps: int) -> Scenario:
    """Return the scenario of the job."""
    angle = np.linspace(0, 2 * np.pi, 33)
    across, deep = SEMI_AXES_M
    waypoints = [
        {
            "time_s": float(TURN_S * a / (2 * np.pi)),
            "position_m": [
                float(across * np.cos(a + START)),
                float(BEFORE_M + deep * np.sin(a + START)),
                HIP_M,
            ],
        }
        for a in angle
    ]
    chirp = {"slope_mhz_per_us": 40, "idle_us": 0.4, "adc_start_us": 6, "ramp_end_us": 64.6}
    return Scenario.model_validate(
        {
            "frames": 2,
            "sensor": "awr1843",
            "radio": {
                "samples_per_chirp": 256,
                "sampling_rate_hz": 4.4e6,
                "chirps_per_frame": chirps,
                "chirp": chirp,
            },
            "accuracy": {"preset": "everything"},
            "swarm": {
                "radar": {"role": "active", "position_m": [0, 0, 1], "boresight": [0, 1, 0]},
                "person": {
                    "role": "target",
                    "waypoints": waypoints,
                    "extent": {"kind": "pedestrian"},
                    "rcs": {"model": "constant", "value_dbsm": -1.37},
                },
            },
        }
    )


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    """RMS error over the RMS of the truth."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def rows(quick: bool) -> list[dict[str, Any]]:
    """Return the rows of the benchmark (`benchmarks`): the program, and all points placed at every
    sample of some chirps, whose cost is scaled to all."""
    job = Job()
    shape = job.samples().shape
    some = range(0, shape[2], 40 if quick else 10)
    truths: list[np.ndarray] = []
    slow = cpu_seconds(lambda: truths.append(job.truth(some)), 1, 0) * shape[2] / len(some)
    error = relative(job.samples()[:, :, some.start :: some.step], truths[0])
    floor, fast = floor_seconds(shape), cpu_seconds(partial(job.samples), 3 if quick else 9)
    same = {
        "kind": "moving",
        "size": len(job.amplitudes),
        "unit": "points",
        "error_of": "relative RMS against all points placed at every sample",
        "job": "3 x 4 antennas x 128 chirps x 256 samples",
        "floor_s": floor,
    }
    each = ("pedestrian, motion within chirps", error, fast), ("exact, float64", 0.0, slow)
    return [
        same
        | {"method": method, "error": error, "oracle": not error}
        | {"seconds": seconds, "cost": seconds / floor}
        for method, error, seconds in each
    ]
