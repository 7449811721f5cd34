"""Frames over places in Munich, made to be compared: the same clutter, noise and targets for
whoever looks at them.

One scenario holds all places as hovering active terminals, so that one field of scatterers serves
them; a terminal "in flight" has the same position and a velocity. Clutter is the diffuse one of one
bounce; mirror flashes and corners, single cells which the mesh predicts too, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from isac_rt.extensions.city_receivers.expectation import MeshExpectation
from isac_rt.frame.antennas import unit_vector
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference, Transmission
from isac_rt.frame.level import thermal_noise_power, transmit_amplitude
from isac_rt.frame.link import Link
from isac_rt.frame.payload import Payload, random_payload
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.free_space import radar_amplitude
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive.types import ExpectedClutter
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.if_signal import add_noise, if_signal
from isac_rt.signal.methods import Auto
from isac_rt.simulation.setup import Setup, prepare
from isac_rt.world.swarm import Pose, attitude
from reproduce.waves import waves

SPEED = 10.0
"""Speed of a terminal in flight [m/s], along its boresight over ground."""
LEFT_OUT_DB = 20.0
"""Scatterers this far below the noise of one range-Doppler cell are left out: 1 % of the clutter's
power at 27 m, 7 % at 60 m."""
WIDEST = np.sin(np.deg2rad(45))
"""Direction cosine from boresight within which targets are drawn. Elements of 10 dBi are 12 dB down
there, both ways together; farther out noise alone hides small UAVs at 100 m, and a comparison would
count that."""
SMALL_UAV_M2 = 10 ** (-12.81 / 10)
"""TR 38.901's small UAV."""


@dataclass(frozen=True)
class Place:
    """Where a terminal is and where it looks.

    Attributes
    ----------
    text : for people
    position, boresight : world axes [m]
    """

    text: str
    position: tuple[float, float, float]
    boresight: tuple[float, float, float]


PLACES = {
    "square": Place("27 m over the open square", (34.0, 54.0, 27.0), (1.0, -0.12, -0.1)),
    "high": Place("60 m over the open square", (34.0, 54.0, 60.0), (1.0, -0.12, -0.3)),
    "street": Place("12 m up in a street of 25 m", (83.5, -5.0, 12.0), (0.35, 0.94, 0.0)),
    "roofs": Place("19 m above the roofs", (40.0, 0.0, 45.0), (0.6, 0.8, -0.35)),
}


def scenario(
    places: tuple[str, ...],
    seed: int,
    cell_area: float,
    power_dbm: float,
    partners: float | None = None,
) -> Scenario:
    """Places of `PLACES` as active terminals that hover.

    Parameters
    ----------
    cell_area : largest area of a scatterer over its distance [m^2/m]
    power_dbm : of one antenna
    partners : distance [m] of a passive terminal ahead of each over ground, NAME-pt; None: there
        are none
    """
    uavs: dict[str, dict] = {}
    for name in places:
        uavs[name] = {
            "role": "active",
            "position_m": PLACES[name].position,
            "boresight": PLACES[name].boresight,
        }
    for name in places if partners else ():
        p = PLACES[name]
        flat = partners / np.hypot(*p.boresight[:2])
        ahead = [
            p.position[0] + flat * p.boresight[0],
            p.position[1] + flat * p.boresight[1],
            p.position[2],
        ]
        uavs[f"{name}-pt"] = {
            "role": "passive",
            "position_m": ahead,
            "boresight": [-p.boresight[0], -p.boresight[1], p.boresight[2]],
        }
    return Scenario.model_validate(
        {
            "name": "places_over_munich",
            "seed": seed,
            "frames": 4,
            "swarm": uavs,
            "array": {"element_gain_dbi": 10.0},
            "receiver_preset": "plain",
            "city": {"source": "builtin", "name": "munich", "keep_radius_m": 110.0},
            "propagation": {"model": "ray_traced", "max_bounces": 1, "leakage": {"enabled": False}},
            "clutter": {
                "model": "field",
                "cell_area_per_metre_m": cell_area,
                "smallest_cell_m2": 0.05,
            },
            "noise": {"tx_power_dbm": power_dbm, "noise_figure_db": 10.0},
            "receivers": {"clutter_detector": "angle_doppler", "false_alarm_rate": 1e-3},
        }
    )


class Scenes:
    """All places, ready for frames."""

    def __init__(self, scene: Scenario) -> None:
        from isac_rt.propagation.raytrace import RayTracer

        self.setup: Setup = prepare(scene)
        tracer, expectation = self.setup.propagation, self.setup.expectation
        assert isinstance(tracer, RayTracer)
        assert expectation is not None
        assert tracer.field is not None
        self.field = tracer.field.whole()
        self._expectations = {0.0: expectation}
        self.amplitude = transmit_amplitude(scene.noise)
        self.noise = thermal_noise_power(scene.noise, self.setup.waveform)
        self.epoch = self.setup.waveform.frame_duration / 2

    def expected(self, place: str, pose: Pose, mesh_std: float = 0.0) -> ExpectedClutter:
        """Clutter that the terminal expects at a pose, from a mesh whose planes are off [m]."""
        s = self.setup
        if mesh_std not in self._expectations:
            city = s.city.displaced(mesh_std, generator(s.scenario.seed, "mesh error"))
            about = s.scenario.clutter, s.swarm, city, s.waveform, s.arrays, s.scenario.seed
            self._expectations[mesh_std] = MeshExpectation(*about)
        copy = self._expectations[mesh_std]
        return copy.clutter(place, pose, self.epoch, self.amplitude)

    def pose(self, place: str, speed: float) -> Pose:
        """Pose of a terminal that flies over ground along its boresight."""
        p = PLACES[place]
        ahead = np.array([p.boresight[0], p.boresight[1], 0.0])
        return Pose(
            np.array(p.position),
            speed * ahead / np.linalg.norm(ahead),
            np.zeros(3),
            attitude(np.array(p.boresight)),
        )

    def clutter(self, place: str, speed: float, draw: int) -> PathSet:
        """Diffuse clutter of the terminal's own link: the field's scatterers, with amplitudes of
        their own for each draw.

        What is too weak to matter in a range-Doppler cell is left out (`LEFT_OUT_DB`).
        """
        pose = self.pose(place, speed)
        local = replace(pose, position=pose.position - self.setup.city.origin)
        state = LinkState(Link(place, place), self.epoch, local, local)
        seen, paths = self.field.seen(state), self.field.paths(state, self.setup.arrays)
        mean = seen.magnitude * state.elements(self.setup.arrays, seen)
        mean = mean[mean > 0]  # behind the antennas there is no path
        rng = generator(self.setup.scenario.seed, "amplitudes", place, draw)
        drawn = rng.standard_normal((len(paths), 2)) @ np.array([1, 1j]) / np.sqrt(2)
        w = self.setup.waveform
        cell = self.noise * 2.25 / (w.num_samples * w.num_chirps)
        kept = self.amplitude**2 * np.abs(mean) ** 2 > cell * 10 ** (-LEFT_OUT_DB / 10)
        return replace(paths, gain=mean * drawn).select(kept)

    def transmission(self, place: str, speed: float, payload: Payload) -> Transmission:
        """What the terminal sends."""
        s = self.setup
        return Transmission(
            name=place,
            pose=self.pose(place, speed),
            antennas=s.antennas,
            schedule=s.schedule,
            payload=payload,
            amplitude=self.amplitude,
        )

    def payload(self, *name: str | int) -> Payload:
        """Random data for a frame."""
        rng = generator(self.setup.scenario.seed, "data", *name)
        return random_payload(
            self.setup.waveform, self.setup.schedule, self.setup.scenario.modulation.dpsk_order, rng
        )

    def samples(self, paths: PathSet, sent: Transmission) -> IFCube:
        """IF samples of paths, without noise."""
        s = self.setup
        return if_signal(
            s.waveform,
            [(sent, paths)],
            ReceiveArray(sent.pose, s.antennas),
            Reference(0.0),
            Auto(self.noise),
        )

    def noisy(self, parts: list[IFCube], *name: str | int) -> IFCube:
        """Sum of cubes with the receiver's noise of this name."""
        w, antennas = self.setup.waveform, self.setup.antennas
        total = np.zeros((w.num_groups, antennas.num_rx, w.num_chirps, w.num_samples), np.complex64)
        for part in parts:
            total += part.samples
        cube = IFCube(samples=total, waveform=w, schedule=self.setup.schedule, start_time=0.0)
        return add_noise(
            cube,
            self.noise,
            seed_sequence(self.setup.scenario.seed, "noise", *name).generate_state(2),
        )

    def sees(self, place: str, points: np.ndarray) -> np.ndarray:
        """(K,) whether the terminal sees points (K, 3) in the air."""
        from isac_rt.propagation.segments.rays import LosTest
        from isac_rt.world.city.scene import shared_scenes

        s = self.setup
        shadows = LosTest(shared_scenes(s.city, s.waveform.carrier_frequency).faces)
        return shadows.sees(
            np.array(PLACES[place].position) - s.city.origin,
            points - s.city.origin,
            np.zeros_like(points),
        )


@dataclass(frozen=True)
class Targets:
    """Small UAVs around one terminal.

    Attributes
    ----------
    range, velocity : (Q,) [m, m/s], receding positive
    direction : (Q, 3) unit vectors in world axes
    """

    range: np.ndarray
    velocity: np.ndarray
    direction: np.ndarray

    def __len__(self) -> int:
        return self.range.size

    def select(self, which: np.ndarray) -> Targets:
        """The targets that a mask or an index array chooses."""
        return Targets(self.range[which], self.velocity[which], self.direction[which])

    def paths(self, scenes: Scenes, place: str, speed: float) -> PathSet:
        """Their echoes, by the radar equation."""
        pose, antennas = scenes.pose(place, speed), scenes.setup.antennas
        wavelength, seed = scenes.setup.waveform.wavelength, scenes.setup.scenario.seed
        amplitude = radar_amplitude(wavelength, SMALL_UAV_M2, self.range, self.range)
        phase = generator(seed, "echo", place).uniform(0, 2 * np.pi, len(self))
        pattern = antennas.element_gain(pose.to_body(self.direction))
        return waves(
            scenes.epoch,
            2 * self.range / SPEED_OF_LIGHT,
            2 * self.velocity / SPEED_OF_LIGHT,
            gain=amplitude * pattern * np.exp(1j * phase),
            ends=(self.direction, self.direction),
            kind=PathKind.TARGET,
            radius=self.range,
            link=Link(place, place),
        )


def in_the_air(
    scenes: Scenes, place: str, ranges: np.ndarray, velocities: np.ndarray, rng: np.random.Generator
) -> Targets:
    """Targets at these ranges and radial velocities, each in a direction (`WIDEST`) in which the
    terminal sees it; those for which 30 draws find none are left out."""
    pose = scenes.pose(place, 0.0)
    count = ranges.size
    direction, found = np.zeros((count, 3)), np.zeros(count, bool)
    for _ in range(30):
        left = np.flatnonzero(~found)
        if not left.size:
            break
        u = rng.uniform(-WIDEST, WIDEST, (left.size, 2))
        inside = (u**2).sum(axis=1) < WIDEST**2
        body = unit_vector(u)
        world = pose.to_world(body)
        points = pose.position + ranges[left, None] * world
        good = inside & (points[:, 2] > 1.0) & (points[:, 2] < 120.0)
        good[good] = scenes.sees(place, points[good])
        direction[left[good]], found[left[good]] = world[good], True
    return Targets(ranges, velocities, direction).select(found)
