"""The propagation model that a scenario asks for."""

from __future__ import annotations

from isac_rt.frame.waveform import Waveform
from isac_rt.propagation import settings
from isac_rt.propagation.clutter.merging import NoiseFloor
from isac_rt.propagation.clutter.rayleigh import RayleighClutter
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Propagation
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Swarm


def make_propagation(
    propagation: settings.Propagation,
    clutter: settings.Clutter,
    swarm: Swarm,
    free: FreeSpace,
    city: CityMesh,
    waveform: Waveform,
    knot_spacing: float = 0.0,
    floor: NoiseFloor | None = None,
) -> Propagation:
    """The model that a scenario asks for. `ray_traced` starts the JIT back end.

    Rays search for chains of walls from knots that are at most `knot_spacing` of flight apart [m];
    0: from where a terminal is (`legs.chains`). With `floor` scatterers of the
    clutter field are merged where noise covers them.
    """
    model: Propagation = free
    if propagation.model == "ray_traced":
        from isac_rt import runtime

        runtime.activate()
        from isac_rt.propagation.raytrace import RayTracer

        model = RayTracer(
            propagation, clutter, swarm, free, city, waveform.carrier_frequency, knot_spacing, floor
        )
    if clutter.model == "rayleigh":
        return RayleighClutter(model, free, clutter, waveform)
    return model
