"""Cost of a full reception of one frame (M = 3) at the active and at the passive terminal, over the
number of paths that are seen.

The frame is made by the program's own synthesis: the strongest path some 13 dB over the noise of a
sample, each further one 2 dB weaker. `error` is that of the estimated ranges of all paths in range
cells (RMS over those that have a detection within two cells). Beside it are the cost over that of
its transforms alone - `scipy.fft` of the cube once (AT) or twice (PT: to decode and to sense) and
once over the chirps of the range cells that are looked at - and the memory at most, the cube
included, in cubes. One thread, as a run gives every terminal.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.fft import fft
from threadpoolctl import threadpool_limits

from benchmarks.measure import cpu_seconds, floor_seconds
from isac_rt.frame.antennas import Antennas, unit_vector
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference, Transmission
from isac_rt.frame.payload import Payload, random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.active import receive_active
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections, Prediction, Reception
from isac_rt.signal.if_signal import add_noise, if_signal
from isac_rt.signal.methods import Direct
from isac_rt.world.swarm import Pose

SIZES = (1, 4, 8)
QUICK_SIZES = (4,)
_DPSK = 8
SETTINGS = {
    "": Receivers(),
    ", refinement joint": Receivers(refinement="joint"),
    ", velocity_method pursuit": Receivers(velocity_method="pursuit"),
}
"""Receivers by what is added to a row's name."""


def _frame(count: int) -> tuple[IFCube, Payload, Antennas, Prediction]:
    """A noisy cube of `count` paths at whole path lengths from 40 m on, and what a PT would expect
    of the first."""
    rng, w = np.random.default_rng(count), Waveform()
    antennas = Antennas(tx_x=2, tx_z=w.num_tx - 1, rx_x=8, rx_z=8, spacing=0.5774 * w.wavelength)
    pose = Pose.at_rest()
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    payload = random_payload(w, schedule, _DPSK, rng)
    sender = Transmission(
        name="A", pose=pose, antennas=antennas, schedule=schedule, payload=payload
    )
    length, speed = 40.0 + 9.37 * np.arange(count), rng.uniform(-8, 8, count)
    u = unit_vector(rng.uniform(-0.4, 0.4, (count, 2)))
    paths = make_paths(
        epoch=w.frame_duration / 2,
        tx="A",
        rx="B",
        gain=10 ** (-np.arange(count) / 10) * np.exp(1j * np.arange(count)),
        delay=length / SPEED_OF_LIGHT,
        delay_rate=speed / SPEED_OF_LIGHT,
        delay_accel=np.zeros(count),
        departure=u,
        arrival=u,
        tx_radius=np.inf,
        rx_radius=np.inf,
        kind=PathKind.TARGET,
    )
    cube = if_signal(w, [(sender, paths)], ReceiveArray(pose, antennas), Reference(0.0), Direct())
    cube = add_noise(cube, 0.05, np.array([3, count], np.uint32))
    one = np.ones(1)
    prediction = Prediction(
        range=length[:1],
        velocity=speed[:1],
        direction=u[:1, [0, 2]],
        range_std=0.05 * one,
        velocity_std=0.05 * one,
        weight=one,
    )
    return cube, payload, antennas, prediction


def _range_error(found: Detections, count: int, passes: int) -> float | None:
    """RMS of the range errors in cells, over the paths with a detection within two cells of them;
    None without any."""
    cell = Waveform().range_cell(passes)
    truth = (40.0 + 9.37 * np.arange(count)) / passes
    if not len(found):
        return None
    off = np.abs(found.range[None, :] - truth[:, None]).min(axis=1) / cell
    near = off[off < 2]
    return float(np.sqrt((near**2).mean())) if near.size else None


def _peak_cubes(work: Callable[[], object], cube: IFCube) -> float:
    """Memory at most, in cubes, the one that is received among them."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return 1 + peak / cube.samples.nbytes


def _jobs(
    cube: IFCube, payload: Payload, antennas: Antennas, prediction: Prediction
) -> list[tuple[str, int, Callable[[], Detections]]]:
    """Name, passes of the way and work of each reception."""
    out: list[tuple[str, int, Callable[[], Detections]]] = []
    for named, settings in SETTINGS.items():
        active = partial(receive_active, cube, payload, antennas, settings)
        passive = partial(receive_passive, cube, antennas, settings, _DPSK, prediction, True)
        out += [
            (f"active terminal (DCA-SPE){named}", 2, partial(_found, active)),
            (f"passive terminal (J-SPEDD){named}", 1, partial(_found, passive)),
        ]
    return out


def _found(receive: Callable[[], Reception]) -> Detections:
    return receive().detections


def _transform_seconds(cube: IFCube, repeats: int) -> tuple[float, float]:
    """CPU seconds of `scipy.fft` along the samples of a cube, and along the chirps of the cells
    that a map shows."""
    w, samples = cube.waveform, cube.samples
    cells = np.zeros(
        (w.num_tx, samples.shape[1], w.num_delay_symbols, samples.shape[2]), np.complex64
    )
    return cpu_seconds(lambda: fft(samples, axis=-1), repeats), cpu_seconds(
        lambda: fft(cells, axis=-1), repeats
    )


def rows(quick: bool) -> list[dict[str, object]]:
    """Rows of the benchmark (`benchmarks`): cost in floors of AT and PT receptions."""
    with threadpool_limits(limits=1):
        return _rows(quick)


def _rows(quick: bool) -> list[dict[str, object]]:
    out: list[dict[str, object]] = []
    repeats = 3 if quick else 7
    for size in QUICK_SIZES if quick else SIZES:
        cube, payload, antennas, prediction = _frame(size)
        floor = floor_seconds(cube.samples.shape, repeats)
        along_range, along_chirps = _transform_seconds(cube, repeats)
        for method, passes, work in _jobs(cube, payload, antennas, prediction):
            seconds, cubes = cpu_seconds(work, repeats), _peak_cubes(work, cube)
            ratio = seconds / (along_range * (3 - passes) + along_chirps)
            out.append(
                {
                    "kind": "reception",
                    "method": method,
                    "size": size,
                    "unit": "paths",
                    "error": _range_error(work(), size, passes),
                    "error_of": "RMS range error in cells",
                    "cost": seconds / floor,
                    "seconds": seconds,
                    "floor_s": floor,
                    "oracle": False,
                    "job": "one frame, M = 3, full reception",
                    "transforms": ratio,
                    "memory_cubes": cubes,
                    "also": f"{ratio:.2f} of its transforms, {cubes:.2f} cubes of memory",
                }
            )
    return out
