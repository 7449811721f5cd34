"""What several cases set up alike: bodies in flight, walls, ray tracers, cubes and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference, Transmission
from isac_rt.frame.payload import Payload, random_payload, unmodulated
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.model import Propagation
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.randomness import seed_sequence
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Method
from isac_rt.signal.noise import add_white_noise
from isac_rt.simulation.setup import propagation_in
from isac_rt.world.city import CityMesh, Material
from isac_rt.world.swarm import Pose, attitude

Triple = Sequence[float] | np.ndarray
SKIRT = 0.43e6


def pose(
    position: Triple,
    velocity: Triple = (0, 0, 0),
    acceleration: Triple = (0, 0, 0),
    boresight: Triple = (0.3, 1.0, 0.1),
) -> Pose:
    """A body at a place, in flight, with a boresight."""
    place, speed, change = (np.array(v, float) for v in (position, velocity, acceleration))
    return Pose(place, speed, change, attitude(np.array(boresight, float)))


def swarm(a: Triple, p: Triple, u: Triple, moving: bool = True) -> dict[str, Pose]:
    """Three bodies, in curved flight that is generic in every component, or at rest."""
    if not moving:
        return {"A": pose(a), "P": pose(p), "U": pose(u)}
    return {
        "A": pose(a, (4.3, -7.1, 1.9), (0.7, 1.1, -2.3)),
        "P": pose(p, (-6.2, 2.9, 3.1), (-1.3, 0.4, 0.9)),
        "U": pose(u, (3.7, 8.3, -2.2), (2.1, -0.6, 1.7)),
    }


def scenario(traced: bool = True, **changes: Any) -> Scenario:
    """A scenario of the swarm A (active), P (passive), U (target) with isotropic elements of 0 dBi;
    `changes` of its keys."""
    rcs = {"model": "constant", "value_dbsm": -11.7}
    roles = {"A": "active", "P": "passive", "U": "target"}
    tree: dict[str, Any] = {
        "swarm": {
            name: {"role": role, "position_m": [float(i), 0, 0], "rcs": rcs}
            for i, (name, role) in enumerate(roles.items())
        },
        "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
    }
    if traced:
        tree |= {
            "receiver_preset": "plain",
            "city": {"source": "canyon"},
            "propagation": {"model": "ray_traced", "leakage": {"enabled": False}},
        }
    for key, value in changes.items():
        tree[key] = tree.get(key, {}) | value if isinstance(value, dict) else value
    return Scenario.model_validate(tree)


def tracer(mesh: CityMesh, bounces: int = 2, **changes: Any) -> Propagation:
    """A ray tracer in a mesh, whatever city the scenario names."""
    s = scenario(**({"propagation": {"max_bounces": bounces}} | changes))
    return propagation_in(mesh, s)


def material(
    permittivity: float = 5.31,
    conductivity: float = 1.9,
    scattering: float = 0.0,
    thickness: float = 0.1,
) -> Material:
    """A slab's material."""
    return Material(
        "slab", permittivity, conductivity, scattering, "lambertian", 1, thickness, "validation"
    )


METAL = 1e7
"""Conductivity of the tracer's perfect conductor [S/m]; at 77 GHz it reflects 0.9991 of the
amplitude."""


def rectangle(
    corner: Triple, along: Triple, across: Triple, of: Material, origin: Triple = (0.0, 0.0, 0.0)
) -> CityMesh:
    """One flat wall of two triangles; world coordinates."""
    p, a, b = (np.array(v, float) for v in (corner, along, across))
    vertices = np.array([p, p + a, p + a + b, p + b]) - np.array(origin)
    return CityMesh(
        "wall",
        vertices,
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.zeros(2, np.int16),
        (of,),
        np.array(origin, float),
    )


SMALL = Waveform(
    bandwidth=523e6, sampling_rate=17.3e6, num_samples=90, num_chirps=10, num_tx=5, num_groups=3
)


def arrays(w: Waveform, **change: Any) -> Antennas:
    """Arrays that fit a waveform; `change` of their fields."""
    return Antennas(
        **(
            {
                "tx_x": 2,
                "tx_z": w.num_tx - 1,
                "rx_x": 3,
                "rx_z": 2,
                "spacing": 0.5774 * w.wavelength,
            }
            | change
        )
    )


FEW = Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5774 * SPEED_OF_LIGHT / 77e9)
FULL = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * SPEED_OF_LIGHT / 77e9)


def sender(w: Waveform, rng: np.random.Generator, data: bool = True, **change: Any) -> Transmission:
    """A transmitter of generic attitude with a random schedule and payload."""
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    payload = random_payload(w, schedule, 8, rng) if data else unmodulated(w)
    fields: dict[str, Any] = {
        "pose": pose((0, 0, 0), boresight=(0.31, 1.2, -0.17)),
        "antennas": arrays(w),
        "schedule": schedule,
        "payload": payload,
    }
    return Transmission(**({"name": "A"} | fields | change))


def random_paths(
    w: Waveform,
    rng: np.random.Generator,
    count: int,
    epoch: float,
    *,
    reach: float = 0.9,
    speed: float = 30.0,
) -> PathSet:
    """Paths all over the passband with generic directions, radii, rates up to 2 speed and
    accelerations."""

    def directions() -> np.ndarray:
        d = rng.normal(size=(count, 3))
        return d / np.linalg.norm(d, axis=1)[:, None]

    return make_paths(
        gain=rng.normal(size=count) + 1j * rng.normal(size=count),
        delay=rng.uniform(0.01, reach, count) * w.max_delay,
        delay_rate=2 * rng.uniform(-speed, speed, count) / SPEED_OF_LIGHT,
        delay_accel=rng.normal(size=count) * 20 / SPEED_OF_LIGHT,
        departure=directions(),
        arrival=directions(),
        tx_radius=rng.uniform(7, 70, count),
        rx_radius=np.where(np.arange(count) % 3, rng.uniform(7, 70, count), np.inf),
        kind=PathKind.DIFFUSE,
        epoch=epoch,
        tx="A",
        rx="P",
    )


def cube_of(
    w: Waveform,
    schedule: np.ndarray,
    payload: Payload,
    paths: list[tuple[float, float, complex]],
    antennas: Antennas = FEW,
    arrival: tuple[float, float] = (0.0, 0.0),
    departure: tuple[float, float] = (0.0, 0.0),
) -> IFCube:
    """Noise-free cube of plane waves (length [m], rate [m/s], amplitude) at mid-frame, from the
    equation of the IF phase in float64."""
    out = np.zeros((w.num_groups, antennas.num_rx, w.num_chirps, w.num_samples), np.complex64)
    window = w.num_samples / w.sampling_rate
    longest = w.sampling_rate * window / (w.bandwidth - 2 * w.sampling_rate)
    slope, slot = w.bandwidth / (window + 2 * longest), window + 2 * (1 + w.num_tx) * longest
    u = np.arange(w.num_samples) / w.sampling_rate + 2 * longest
    for m in range(w.num_groups):
        t = (
            u
            + (np.arange(w.num_chirps) * slot + 2 * m * longest - w.num_chirps * slot / 2)[:, None]
        )
        symbol = payload.delay_symbols[m][:, None] / (slope * window)
        sent = antennas.tx_positions[schedule[m]][:, [0, 2]] @ np.array(departure)
        for rx, place in enumerate(antennas.rx_positions[:, [0, 2]] @ np.array(arrival)):
            for length, rate, amplitude in paths:
                tau = (length + rate * t - sent[:, None] - place) / 299_792_458.0 + symbol
                cycles = (w.carrier_frequency * tau) % 1 + slope * tau * (u - tau / 2)
                out[m, rx] += (
                    amplitude * payload.phases[m][:, None] * np.exp(2j * np.pi * (cycles % 1))
                )
    return IFCube(samples=out, waveform=w, schedule=schedule, start_time=0.0)


def frame(
    order: int = 8, seed: int = 3, w: Waveform | None = None
) -> tuple[Waveform, np.ndarray, Payload]:
    """Waveform, a pseudo-random schedule and a random payload."""
    w, rng = w or Waveform(), np.random.default_rng(seed)
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    return w, schedule, random_payload(w, schedule, order, rng)


def noisy(clean: IFCube, power: float, seed: int) -> IFCube:
    """A copy with the program's own white noise, which has cases of its own."""
    samples = clean.samples.copy()
    add_white_noise(samples, power, seed_sequence(seed, "validation").generate_state(2))
    return IFCube(
        samples=samples,
        waveform=clean.waveform,
        schedule=clean.schedule,
        start_time=clean.start_time,
    )


def synthesise(
    w: Waveform,
    links: list,
    rx: Pose,
    method: Method,
    start: float,
    antennas: Antennas,
    first_block: int | None = None,
) -> np.ndarray:
    """Samples through a filter whose skirts are `SKIRT` wide."""
    w, receiver = replace(w, filter_transition=SKIRT), ReceiveArray(rx, antennas)
    return if_signal(w, links, receiver, Reference(start, first_block), method).samples


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    """RMS of the difference over RMS of the truth, which must not be zero."""
    level = float(np.linalg.norm(truth))
    if not level > 0:
        raise ValueError("the truth is zero")
    return float(np.linalg.norm(found - truth) / level)
