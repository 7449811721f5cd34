"""The propagation model that a scenario asks for."""

from __future__ import annotations

from dataclasses import dataclass

from isac_rt.frame.waveform import Waveform
from isac_rt.propagation import settings
from isac_rt.propagation.clutter.merging import NoiseFloor
from isac_rt.propagation.clutter.rayleigh import RayleighClutter
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Propagation
from isac_rt.registry import PROPAGATION_MODELS
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Swarm


@dataclass(frozen=True)
class Ground:
    """Inputs from which propagation models are made.

    Attributes
    ----------
    propagation, clutter : settings
    swarm, city, waveform : of the run
    free : closed forms of the lines of sight and echoes in free space
    sample_spacing : flight between the places from which rays search for walls [m]; 0: they search
        from where a terminal is (`segments.chains`)
    floor : noise that covers scatterers of the clutter field, which then are merged; None: all stay
    """

    propagation: settings.Propagation
    clutter: settings.Clutter
    swarm: Swarm
    city: CityMesh
    waveform: Waveform
    free: FreeSpace
    sample_spacing: float = 0.0
    floor: NoiseFloor | None = None


def free_space(ground: Ground) -> Propagation:
    """Lines of sight and echoes alone."""
    return ground.free


def ray_traced(ground: Ground) -> Propagation:
    """Paths over the city's walls too; starts the JIT back end."""
    from isac_rt import runtime

    runtime.activate()
    from isac_rt.propagation.raytrace import RayTracer

    g = ground
    carrier = g.waveform.carrier_frequency
    return RayTracer(
        g.propagation, g.clutter, g.swarm, g.free, g.city, carrier, g.sample_spacing, g.floor
    )


def make_propagation(ground: Ground) -> Propagation:
    """Make the model that `propagation.model` names, with Rayleigh clutter where that is asked
    for."""
    model: Propagation = PROPAGATION_MODELS.load(ground.propagation.model)(ground)
    if ground.clutter.model == "rayleigh":
        return RayleighClutter(model, ground.free, ground.clutter, ground.waveform)
    return model
