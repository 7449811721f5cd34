"""Propagation: poses in, path sets out, for both models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.clutter.rayleigh import RayleighClutter
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths, merge
from isac_rt.scenario.tree import Scenario
from isac_rt.world.city.mesh import City
from isac_rt.world.swarm import Pose

__all__ = [
    "FreeSpace",
    "PathKind",
    "PathSet",
    "Propagation",
    "make_paths",
    "make_propagation",
    "merge",
]


class Propagation(Protocol):
    """What simulate needs of a propagation model."""

    @property
    def dropped(self) -> int:
        """Paths left out because float64 geometry contradicts the ray tracer."""
        ...

    def paths(
        self, poses: dict[str, Pose], epoch: float, links: list[tuple[str, str]]
    ) -> dict[tuple[str, str], PathSet]:
        """Paths of every link at the middle of a frame."""
        ...


def make_propagation(
    scenario: Scenario,
    waveform: Waveform,
    antennas: Antennas,
    city: City,
    instants: Sequence[float] = (),
) -> Propagation:
    """The model that the scenario asks for. `ray_traced` starts the JIT back end.

    With `instants` (rising, those of the first and the last frame among them) the city is traced
    then only; between them paths are unfolded anew (`between`).
    """
    free = FreeSpace(scenario.swarm, antennas, waveform.wavelength, scenario.seed)
    model: Propagation = free
    if scenario.propagation.model == "ray_traced":
        from isac_rt import runtime

        runtime.activate()
        from isac_rt.propagation.raytrace import RayTracer

        model = RayTracer(
            scenario, city, antennas, waveform.wavelength, waveform.carrier_frequency, instants
        )
    if scenario.clutter.model == "rayleigh":
        return RayleighClutter(model, free, scenario.clutter, waveform, antennas, scenario.seed)
    return model
