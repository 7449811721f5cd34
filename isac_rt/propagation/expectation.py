"""The clutter that a terminal predicts from its own copy of the mesh. Import only after `isac_rt.runtime.activate()`.

Its surfaces are cut as finely as the scenario's field, its points are its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from isac_rt.arrays import Antennas
from isac_rt.city.mesh import City
from isac_rt.propagation.clutter import ClutterField
from isac_rt.propagation.elements import element_amplitude
from isac_rt.propagation.expected import ExpectedClutter
from isac_rt.randomness import generator, seed_sequence
from isac_rt.scenario import Scenario
from isac_rt.swarm import Pose
from isac_rt.waveform import SPEED_OF_LIGHT


@dataclass(frozen=True)
class Mistakes:
    """How wrong a terminal is about itself and the mesh; all zero by default.

    Attributes
    ----------
    velocity : (3,) added to its own velocity [m/s]
    level_db : added to all levels
    mesh_std : of the error of each face along its normal, Gaussian, independent from face to face [m]
    seed : of the faces' errors
    """

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    level_db: float = 0.0
    mesh_std: float = 0.0
    seed: int = 1


class MeshExpectation:
    """Expected clutter along the flights of one scenario."""

    def __init__(self, scenario: Scenario, city: City, scene: mi.Scene, antennas: Antennas, wavelength: float) -> None:
        own = int(seed_sequence(scenario.seed, "expected clutter").generate_state(1)[0])
        self._field = ClutterField.plan(scenario.model_copy(update={"seed": own}), city, scene, wavelength)
        self._city, self._antennas = city, antennas

    def __len__(self) -> int:
        return len(self._field.cells)

    def clutter(self, name: str, pose: Pose, time: float, amplitude: float, mistakes: Mistakes | None = None) -> ExpectedClutter:
        """What the terminal's own link returns at a time, from where it believes to be.

        Parameters
        ----------
        name : of the terminal
        pose : in world coordinates
        amplitude : sqrt(transmit power of one antenna) [sqrt(W)]
        """
        wrong = mistakes or Mistakes()
        local = replace(pose, position=pose.position - self._city.origin, velocity=pose.velocity + np.array(wrong.velocity))
        seen = self._field.seen(name, name, local, local, time)
        elements = element_amplitude(self._antennas, local, local, seen.departure, seen.arrival)
        length = seen.length
        if wrong.mesh_std > 0:
            error = wrong.mesh_std * generator(wrong.seed, "mesh error").standard_normal(self._city.num_faces)
            face = self._field.cells.face[seen.index]
            length = length + 2 * error[face] * (self._city.normals[face] * seen.departure).sum(axis=1)
        power = (amplitude * seen.magnitude * elements) ** 2 * 10 ** (wrong.level_db / 10)
        body = local.to_body(seen.departure)
        some = power > 0
        return ExpectedClutter(length[some] / SPEED_OF_LIGHT, seen.rate[some] / SPEED_OF_LIGHT, power[some], body[some], body[some])
