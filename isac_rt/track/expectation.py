"""Clutter that a terminal expects from its copy of the mesh, as the simulation needs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.receive.types import ExpectedClutter
from isac_rt.world.swarm import Pose


@dataclass(frozen=True)
class Mistakes:
    """Errors of a terminal about itself and the mesh; all zero by default.

    Attributes
    ----------
    velocity : (3,) added to its own velocity [m/s]
    level_db : added to all levels
    mesh_std : of the error of each face along its normal, Gaussian, independent from face to face
        [m]
    seed : of the faces' errors
    """

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    level_db: float = 0.0
    mesh_std: float = 0.0
    seed: int = 1


class ClutterExpectation(Protocol):
    """Clutter by a terminal's copy of the mesh, as simulate needs it."""

    def clutter(
        self, name: str, pose: Pose, time: float, amplitude: float, mistakes: Mistakes | None = None
    ) -> ExpectedClutter:
        """Clutter of the own link of a terminal at a pose, in world coordinates; amplitude is
        sqrt(transmit power) [sqrt(W)]."""
        ...

    def between(
        self,
        link: Link,
        amplitude: float,
        sender: np.ndarray,
        own: Pose,
        mistakes: Mistakes | None = None,
    ) -> ExpectedClutter:
        """Clutter of a link from a transmitter in a state (6,) to a passive terminal at a pose, in
        world coordinates."""
        ...
