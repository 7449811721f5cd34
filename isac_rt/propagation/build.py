"""The propagation model that a scenario asks for."""

from __future__ import annotations

from collections.abc import Sequence

from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.clutter.rayleigh import RayleighClutter
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Propagation
from isac_rt.scenario import environment
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Swarm


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
        return RayleighClutter(model, free, clutter, waveform)
    return model
