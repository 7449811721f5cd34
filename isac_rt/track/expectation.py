"""Clutter that a terminal expects from its copy of the mesh, as the simulation needs it."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.receive.types import ExpectedClutter
from isac_rt.world.swarm import Pose


class ClutterExpectation(Protocol):
    """Clutter by a terminal's copy of the mesh, as simulate needs it."""

    def clutter(self, name: str, pose: Pose, time: float, amplitude: float) -> ExpectedClutter:
        """Clutter of the own link of a terminal at a pose, in world coordinates; amplitude is
        sqrt(transmit power) [sqrt(W)]."""
        ...

    def between(
        self, link: Link, amplitude: float, sender: np.ndarray, own: Pose
    ) -> ExpectedClutter:
        """Clutter of a link from a transmitter in a state (6,) to a passive terminal at a pose, in
        world coordinates."""
        ...
