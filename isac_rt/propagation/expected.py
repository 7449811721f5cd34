"""What a terminal that has the city's mesh expects of its clutter: mean powers, delays, rates and directions, no phases.

A terminal knows the mesh, where it is and how it flies. It does not know the scatterers: in `expectation` it cuts the same
surfaces with points of its own, drawn from another seed, so that what it expects of a range-Doppler cell is the mean over the surface
there and not the very points that scatter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from isac_rt.arrays import Antennas
from isac_rt.city.mesh import City
from isac_rt.scenario import Scenario
from isac_rt.swarm import Pose
from isac_rt.waveform import Waveform

MESH_DETECTORS = ("map", "angle_doppler")
"""Values of `receivers.clutter_detector` that predict clutter from the mesh."""


@dataclass(frozen=True)
class ExpectedClutter:
    """K independent scatterers of known mean power, as one receiver expects them at the middle of a frame.

    Attributes
    ----------
    delay, delay_rate : (K,) [s, 1]
    power : (K,) mean received power per sample and antenna pair [W], elements included
    departure, arrival : (K, 3) unit vectors in the body frame of the transmitter and of the receiver
    """

    delay: np.ndarray
    delay_rate: np.ndarray
    power: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray

    def __len__(self) -> int:
        return self.delay.size

    def select(self, which: np.ndarray) -> ExpectedClutter:
        """The scatterers that a mask or an index array chooses."""
        return ExpectedClutter(*(a[which] for a in vars(self).values()))


def joined(parts: list[ExpectedClutter]) -> ExpectedClutter:
    """Several kinds of clutter as one."""
    names = ("delay", "delay_rate", "power", "departure", "arrival")
    return ExpectedClutter(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


class ClutterExpectation(Protocol):
    """What simulate needs of a terminal's copy of the mesh."""

    def clutter(self, name: str, pose: Pose, time: float, amplitude: float) -> ExpectedClutter:
        """Clutter of the own link of a terminal at a pose, in world coordinates; amplitude is sqrt(transmit power) [sqrt(W)]."""
        ...


def make_expectation(scenario: Scenario, waveform: Waveform, antennas: Antennas, city: City) -> ClutterExpectation | None:
    """The receivers' copy of the mesh where their detector needs one; starts the JIT back end."""
    if scenario.receivers.clutter_detector not in MESH_DETECTORS:
        return None
    from isac_rt import runtime

    runtime.activate()
    from isac_rt.city.scene import shared_scene
    from isac_rt.propagation.expectation import MeshExpectation

    scene = shared_scene(city, waveform.carrier_frequency).scene.mi_scene
    return MeshExpectation(scenario, city, scene, antennas, waveform.wavelength)
