"""A package that brings along one part of each kind; its entry points stand in the dist-info."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from isac_rt.propagation.build import Ground
from isac_rt.propagation.model import Census, Propagation, Traced
from isac_rt.receive.sense import Cfar
from isac_rt.receive.symbols import ByPowers, Symbols
from isac_rt.world.city.materials import MaterialUse
from isac_rt.world.city.mesh import Surface
from isac_rt.world.city.sources import CityParts
from isac_rt.world.settings import City


def wall(city: City, folder: Path) -> CityParts:
    """A wall of concrete 60 m in front of the origin."""
    corners = np.array([[-20.0, 60, 0], [20, 60, 0], [20, 60, 30], [-20, 60, 30]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return CityParts("wall", [Surface(corners, faces, MaterialUse("concrete"))])


@dataclass(frozen=True)
class Attenuated:
    """Another model's paths at a tenth of their amplitude."""

    model: Propagation

    def trace(self, poses, epoch, links) -> Traced:
        """Trace the other model's paths and attenuate them."""
        traced = self.model.trace(poses, epoch, links)
        return Traced({k: replace(p, gain=0.1 * p.gain) for k, p in traced.paths.items()})

    def census(self) -> Census:
        """Count what the other model holds."""
        return self.model.census()


def attenuated(ground: Ground) -> Attenuated:
    """Make the model from the closed forms of free space."""
    return Attenuated(ground.free)


def far(settings, estimator) -> Cfar:
    """Make a CFAR that finds nothing within 10 km."""
    return Cfar(settings.model_copy(update={"min_range_m": 1e4}), estimator)


class Late(ByPowers):
    """Reads every delay symbol one too high."""

    def read(self, cube, prediction, antennas) -> Symbols:
        """Read as by powers, and add one."""
        found = super().read(cube, prediction, antennas)
        return replace(found, delay=found.delay + 1)


def count_walls(scenario: Path) -> None:
    """Print how many faces the city of a SCENARIO has."""
    import isac_rt as irt

    print(irt.city_of(irt.load(scenario)).num_faces, "faces")
