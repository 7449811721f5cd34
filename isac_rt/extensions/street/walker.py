r"""Scattering centres of a pedestrian: a trunk, and limbs that swing as pendulums.

A cycle of two steps lasts :math:`T = 1.346\sqrt{H/v}` at speed v with the hips at height H
(R. Boulic, N. Magnenat-Thalmann, D. Thalmann, A global human walking model with real-time kinematic
personification, 1990). Legs swing by :math:`\arcsin(vT/(4L))` about the hips, which spans a step;
arms by as much about the shoulders in the opposite phase. All centres share the pedestrian's
cross-section alike, with phases of their own that are drawn once: places of a body's surface within
a wavelength are unknown.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from isac_rt.extensions.street.motion import CentreModel, Motion
from isac_rt.randomness import generator
from isac_rt.world.settings import Extent
from isac_rt.world.swarm import Swarm

CYCLE = 1.346
LEG, SHOULDER, ARM = 0.53, 0.82, 0.44
"""Length of a leg, which is the height of the hips, height of the shoulders and length of an arm
over the body's height (Drillis and Contini, Body Segment Parameters, 1966)."""
HIP_X, SHOULDER_X = 0.055, 0.13
"""Sideways distance of hip and shoulder from the middle over the body's height."""
POINTS = {"trunk": 48, "leg": 24, "arm": 16}
"""Centres of each part: 128 of a pedestrian, 4 cm apart."""
PLACES = 1000
"""Places at which the length of a flight is measured."""
LARGEST_SWING = np.radians(40.0)


@dataclass(frozen=True)
class Walker(CentreModel):
    """Points on straight limbs.

    Attributes
    ----------
    hinge : (K, 3) place about which each point swings [m, axes of the body: right, ahead, up]
    length : (K,) distance below the hinge at rest [m]
    swing : (K,) largest angle ahead [rad]
    phase : (K,) of the swing at time 0 [rad]
    rate : angular frequency of the cycle [rad/s]
    amplitude : (K,) square root of each point's cross-section [m], with its phase
    """

    hinge: np.ndarray
    length: np.ndarray
    swing: np.ndarray
    phase: np.ndarray
    rate: float
    amplitude: np.ndarray

    @property
    def speed(self) -> float:
        return float((self.length * self.swing).max() * self.rate)

    @property
    def jerk(self) -> float:
        return 2 * self.speed * self.rate**2  # twice the first term, for swings below a radian

    def described(self) -> str:
        return f"trunk and four limbs as {self.length.size} points"

    def motion(self, time: np.ndarray) -> Motion:
        turn = self.phase + self.rate * time[:, None]
        angle, rate = self.swing * np.sin(turn), self.swing * self.rate * np.cos(turn)
        accel = -(self.rate**2) * angle
        ahead, up = self.length * np.sin(angle), -self.length * np.cos(angle)
        flat = np.zeros_like(ahead)
        velocity = np.stack([flat, -up * rate, ahead * rate], axis=-1)
        acceleration = np.stack(
            [flat, -up * accel - ahead * rate**2, ahead * accel - up * rate**2], axis=-1
        )
        return Motion(self.hinge + np.stack([flat, ahead, up], axis=-1), velocity, acceleration)


HUMAN_DBSM, HEIGHT_M = -1.37, 1.75
"""Mean cross-section (TR 38.901, human, RCS model 1) and height of an adult (table 7.9.1-3)."""


def walker_of_flight(extent: Extent, swarm: Swarm, seed: int, name: str) -> Walker:
    """Return the centres of a pedestrian who walks at the mean speed between the waypoints, with
    phases drawn by name."""
    flight, waypoints = swarm.trajectories[name], swarm.uavs[name].waypoints
    begin, end = (0.0, 1.0) if waypoints is None else (waypoints[0].time_s, waypoints[-1].time_s)
    times = np.linspace(begin, end, PLACES)
    way = np.linalg.norm(np.diff(flight.positions(times), axis=0), axis=1).sum()
    height = HEIGHT_M if extent.size_m is None else extent.size_m[2]
    speed, rng = float(way) / (end - begin), generator(seed, "walker", name)
    return walker_of(height, speed, 10 ** (HUMAN_DBSM / 10), rng)


def walker_of(height: float, speed: float, section: float, rng: np.random.Generator) -> Walker:
    """Return the centres of a pedestrian of a height [m] and a speed [m/s], whose position is the
    height of the hips, with a cross-section [m^2], and phases of steps and echoes from `rng`."""
    leg, start = LEG * height, rng.uniform(0, 2 * np.pi)
    rate = 2 * np.pi / CYCLE * np.sqrt(speed / leg)
    step = speed * 2 * np.pi / rate / (4 * leg) if rate else 0.0
    swing = min(np.arcsin(min(step, 1.0)), LARGEST_SWING)
    rows = [(0.0, z, 0.0, 0.0, 0.0) for z in np.linspace(0, 1 - LEG, POINTS["trunk"])]
    limbs = ("leg", LEG, HIP_X, 0.0), ("arm", ARM, SHOULDER_X, SHOULDER - LEG)
    for side, (kind, size, x, z) in itertools.product((1, -1), limbs):
        phase = start + np.pi * ((side < 0) != (kind == "arm"))
        below = np.linspace(0, size, POINTS[kind] + 1)[1:]
        rows += [(side * x, z, length, swing, phase) for length in below]
    x, z, length, swings, phases = np.array(rows).T
    hinge = height * np.stack([x, 0 * x, z], axis=1)
    amplitude = np.sqrt(section / x.size) * np.exp(2j * np.pi * rng.uniform(size=x.size))
    return Walker(hinge, height * length, swings, phases, rate, amplitude)
