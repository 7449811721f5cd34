"""What a propagation model is: poses in, path sets out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathSet
from isac_rt.scenario import environment
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose, Swarm

if TYPE_CHECKING:
    from isac_rt.propagation.free_space import FreeSpace


class Traced(NamedTuple):
    """The paths of all links at one instant, and how many more were left out because float64
    geometry contradicts the ray tracer."""

    paths: dict[Link, PathSet]
    dropped: int = 0


@dataclass(frozen=True)
class Census:
    """What a propagation model holds of the city's clutter; None for what it does not model.

    Attributes
    ----------
    scatterers : in sight of a transmitter at some time of the run
    scatterer_cells : of the whole mesh, among which those were
    mirrors : by terminal the number of its mirrors, the share of its power that they send on and
        the share that all others would
    """

    scatterers: int | None = None
    scatterer_cells: int | None = None
    mirrors: dict[str, dict[str, float]] | None = None


class Propagation(Protocol):
    """What a run needs of a propagation model."""

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Paths of every link at an instant [s]."""
        ...

    def census(self) -> Census:
        """What the model holds, the same at all instants."""
        ...


def make_propagation(
    propagation: environment.Propagation,
    clutter: environment.Clutter,
    swarm: Swarm,
    free: FreeSpace,
    city: CityMesh,
    waveform: Waveform,
    instants: Sequence[float] = (),
) -> Propagation:
    """The model that a scenario asks for. `ray_traced` starts the JIT back end.

    With `instants` (rising, those of the first and the last frame among them) the city is traced
    then only; between them paths are unfolded anew (`legs.between`).
    """
    model: Propagation = free
    if propagation.model == "ray_traced":
        from isac_rt import runtime

        runtime.activate()
        from isac_rt.propagation.raytrace import RayTracer

        model = RayTracer(
            propagation, clutter, swarm, free, city, waveform.carrier_frequency, instants
        )
    if clutter.model == "rayleigh":
        from isac_rt.propagation.clutter.rayleigh import RayleighClutter

        return RayleighClutter(model, free, clutter, waveform)
    return model
