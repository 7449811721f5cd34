"""Propagation: poses in, path sets out, for both models."""

from __future__ import annotations

from typing import Protocol

from isac_rt.arrays import Antennas
from isac_rt.city.mesh import City
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths, merge
from isac_rt.scenario import Scenario
from isac_rt.swarm import Pose
from isac_rt.waveform import Waveform

__all__ = ["FreeSpace", "PathKind", "PathSet", "Propagation", "make_paths", "make_propagation", "merge"]


class Propagation(Protocol):
    """What simulate needs of a propagation model."""

    dropped: int
    """Paths left out because float64 geometry contradicts the ray tracer."""

    def paths(self, poses: dict[str, Pose], epoch: float, links: list[tuple[str, str]]) -> dict[tuple[str, str], PathSet]:
        """Paths of every link at the middle of a frame."""
        ...


def make_propagation(scenario: Scenario, waveform: Waveform, antennas: Antennas, city: City) -> Propagation:
    """The model that the scenario asks for. `ray_traced` starts the JIT back end."""
    if scenario.propagation.model == "free_space":
        return FreeSpace(scenario.swarm, antennas, waveform.wavelength, scenario.seed)
    from isac_rt import runtime

    runtime.activate()
    from isac_rt.propagation.raytrace import RayTracer

    return RayTracer(scenario, city, antennas, waveform.wavelength, waveform.carrier_frequency)
