"""Cost and error of the IF synthesis: each method over the number of paths, range profiles by way
of samples and directly, and noise.

The job is the full cube 3 x 120 x 1024 x 15 with data on, |v| <= 15 m/s and directions up to 60
degrees to both sides in azimuth and elevation. Errors are measured on 40 such paths in three chirps
per group (they hardly depend on either) against the exact float64 model, nothing removed:
"narrowband" rows against the model whose receive elements only turn the phase, the others against
the full one.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from benchmarks import nufft
from benchmarks.measure import cpu_seconds, floor_seconds
from isac_rt.extensions.hardware.front_end import Ends, front_end_of
from isac_rt.extensions.hardware.received import received
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference, Transmission
from isac_rt.frame.front_end import FrontEnd
from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.known import Known
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Auto, Direct, Exact, Gridded, Method
from isac_rt.signal.noise import WhiteNoise, add_white_noise
from isac_rt.signal.tones import tones_of
from isac_rt.world.swarm import Pose

SIZES = (3, 30, 1000, 10_000, 50_000, 200_000)
QUICK_SIZES = (3, 1000)
MOST_DIRECT = 30
REAL_SIZE = 1000
PROFILE_SIZES = (3, 30, 1000, 10_000)
BOTH = "samples (gridded), Hann window, transform, data out"
JOB = "3 x 120 x 1024 x 15, data on, |v| <= 15 m/s"
ERROR_OF = "relative RMS against the exact model"
GRIDS = (
    ("gridded", Gridded()),
    ("gridded, of what noise covers", Gridded(faint=True)),
)


REAL: dict[str, dict[str, Any]] = {
    "oscillators": {"preset": "pll_good"},
    "elements": {
        "transmit": {"gain_std_db": 1, "delay_std_ps": 5, "coupling_db": -25},
        "receive": {"gain_std_db": 1, "delay_std_ps": 5, "coupling_db": -25},
    },
    "responses": {
        "transmit_response": {"table_db": [0, -1, -3]},
        "receive_response": {"table_db": [0, -1, -3], "slope_std_db": 0.2},
    },
    "converters": {"converter": {"compression_dbm": 50, "iq_gain_db": 0.3, "bits": 12}},
    "ramps": {"ramp": {"quadratic_hz": 2e4, "ripple_hz": 1e4}},
}
"""Parts of front ends whose cost is measured by itself, and together."""


class Job:
    """A receiver and a sender with data; paths by their number, of which none is faster than
    `speed` [m/s]."""

    def __init__(self, num_chirps: int, num_groups: int = 3, speed: float = 15.0) -> None:
        rng = np.random.default_rng(1)
        w = replace(Waveform(), num_chirps=num_chirps, num_groups=num_groups)
        self.waveform, self.speed = w, speed
        self.antennas = Antennas(
            tx_x=2, tx_z=w.num_tx - 1, rx_x=8, rx_z=8, spacing=0.5774 * w.wavelength
        )
        self.pose = Pose.at_rest()
        self.receiver = ReceiveArray(self.pose, self.antennas)
        schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
        payload = random_payload(w, schedule, 8, rng)
        self.sender = Transmission(
            name="A", pose=self.pose, antennas=self.antennas, schedule=schedule, payload=payload
        )

    def paths(self, count: int) -> list:
        w, rng = self.waveform, np.random.default_rng(count)
        azimuth, elevation = np.radians(rng.uniform(-60, 60, (2, count)))
        u = np.stack(
            [
                np.sin(azimuth) * np.cos(elevation),
                np.cos(azimuth) * np.cos(elevation),
                np.sin(elevation),
            ],
            axis=1,
        )
        return [
            (
                self.sender,
                make_paths(
                    epoch=w.frame_duration / 2,
                    tx="A",
                    rx="B",
                    gain=rng.normal(size=count) + 1j * rng.normal(size=count),
                    delay=rng.uniform(0.01, 0.99, count) * w.max_delay,
                    delay_rate=2 * rng.uniform(-self.speed, self.speed, count) / SPEED_OF_LIGHT,
                    delay_accel=np.zeros(count),
                    departure=u,
                    arrival=u,
                    tx_radius=np.inf,
                    rx_radius=np.inf,
                    kind=PathKind.DIFFUSE,
                ),
            )
        ]

    def cube(self, links: list, method: Method) -> IFCube:
        return if_signal(self.waveform, links, self.receiver, Reference(0.0), method)

    def samples(self, links: list, method: Method) -> np.ndarray:
        return self.cube(links, method).samples

    def transformed(self, links: list, method: Method) -> np.ndarray:
        """Range profiles of a receiver that knows the data, by way of the samples."""
        cube = self.cube(links, method)
        return clean_spectrum(cube, Known.of(cube, self.sender.payload, self.antennas, 2))

    def ends(self, stated: dict[str, Any]) -> Ends:
        """One terminal to another with such front ends."""
        node = FrontEnd.model_validate(stated)
        tx, rx = (front_end_of(node, self.waveform, self.antennas, 1, name) for name in "AB")
        return Ends(rx, (tx,))

    def behind(self, links: list, ends: Ends) -> np.ndarray:
        """The samples with noise behind real front ends."""
        noise = WhiteNoise(1e3, np.array([1, 2], np.uint32))
        job = self.waveform, links, self.receiver, Reference(0.0)
        return received(*job, ends, Auto(noise_power=noise.power), noise).samples

    def by_finufft(self, links: list) -> np.ndarray:
        """The samples by a library's transform, narrowband."""
        w = self.waveform
        return nufft.by_finufft(w, tones_of(w, links, self.receiver, w.frame_duration / 2, 0))

    def narrowband(self, links: list) -> np.ndarray:
        """The exact model path by path with one element in the middle of the array, times the
        elements' phases at mid-window."""
        w, (sender, paths) = self.waveform, links[0]
        middle = ReceiveArray(self.pose, replace(self.antennas, rx_x=1, rx_z=1))
        total = np.zeros(())
        for k in range(len(paths)):
            link = [(sender, paths.select(np.array([k])))]
            one = if_signal(w, link, middle, Reference(0.0), Exact()).samples
            delay = (
                -(self.pose.to_world(self.antennas.rx_positions) @ paths.arrival[k])
                / SPEED_OF_LIGHT
            )
            cycles = (
                w.carrier_frequency + w.slope * w.fast_time[w.num_samples // 2]
            ) * delay - w.slope * delay**2 / 2
            total = total + one * np.exp(2j * np.pi * cycles)[None, :, None, None]
        return total


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    """RMS error over the RMS of the truth."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def errors() -> dict[str, float]:
    """Error of every method on 40 paths and 3 chirps per group."""
    job = Job(3)
    links = job.paths(40)
    full = job.samples(links, Exact())
    found = {"direct": relative(job.samples(links, Direct()), full)}
    for name, method in GRIDS:
        found[name] = relative(job.samples(links, method), full)
    if nufft.missing() is None:
        found[nufft.NAME] = relative(job.by_finufft(links), job.narrowband(links))
    whole = job.transformed(links, Exact())
    found[BOTH] = relative(job.transformed(links, Gridded()), whole)
    return found


def left_out() -> dict[str, str]:
    """The methods that cannot be measured here, and why."""
    reason = nufft.missing()
    return {} if reason is None else {"finufft": reason}


def rows(quick: bool) -> list[dict[str, Any]]:
    """Rows of the benchmark (`benchmarks`): cost in floors and error of each method,
    over the number of paths.

    The floor is measured before each size and at the end: what else the machine does changes it
    from minute to minute.
    """
    job, repeats = Job(120), 3 if quick else 5
    w = job.waveform
    shape = (w.num_groups, job.antennas.num_rx, w.num_chirps, w.num_samples)
    floors, error = [floor_seconds(shape, repeats)], errors()
    out: list[dict[str, Any]] = []

    def add(
        method: str,
        size: int,
        unit: str,
        seconds: float,
        deviation: float | None,
        oracle: bool = False,
    ) -> None:
        out.append(
            {
                "kind": "synthesis",
                "method": method,
                "size": size,
                "unit": unit,
                "error": deviation,
                "error_of": ERROR_OF,
                "seconds": seconds,
                "oracle": oracle,
                "job": JOB,
            }
        )

    for size in QUICK_SIZES if quick else SIZES:
        links = job.paths(size)
        times = repeats if size <= 10_000 else 3
        floors.append(floor_seconds(shape, repeats))
        if size <= MOST_DIRECT:
            add(
                "direct",
                size,
                "paths",
                cpu_seconds(partial(job.samples, links, Direct()), times),
                error["direct"],
            )
        if size == SIZES[0]:
            add(
                "exact",
                size,
                "paths",
                cpu_seconds(partial(job.samples, links, Exact()), 1, 0),
                0.0,
                oracle=True,
            )
        for name, method in GRIDS:
            seconds = cpu_seconds(partial(job.samples, links, method), times)
            add(name, size, "paths", seconds, error[name])
        if size == REAL_SIZE:
            together = {key: value for part in REAL.values() for key, value in part.items()}
            behind: dict[str, dict[str, Any]] = {"ideal": {}, **REAL, "all": together}
            for name, stated in behind.items():
                seconds = cpu_seconds(partial(job.behind, links, job.ends(stated)), times)
                add(f"with noise, front ends: {name}", size, "paths", seconds, None)
        if size in PROFILE_SIZES and nufft.NAME in error:
            seconds = cpu_seconds(partial(job.by_finufft, links), times)
            add(nufft.NAME, size, "paths", seconds, error[nufft.NAME])
        if size in PROFILE_SIZES:
            add(
                BOTH,
                size,
                "paths",
                cpu_seconds(partial(job.transformed, links, Gridded()), times),
                error[BOTH],
            )
    cube = np.zeros(shape, np.complex64)
    words = np.array([1, 2], np.uint32)
    add(
        "noise",
        cube.size,
        "samples",
        cpu_seconds(lambda: add_white_noise(cube, 1.0, words), repeats),
        None,
    )
    floor = median([*floors, floor_seconds(shape, repeats)])
    return [row | {"cost": row["seconds"] / floor, "floor_s": floor} for row in out]
