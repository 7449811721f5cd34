"""Bodies so near to a surface that the ray tracer passes over its reflections in silence."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np

from isac_rt.world.city.mesh import CityMesh, distance_to_triangles

CLEARANCE = 0.01
"""Sionna's rays start a little off where they should: a transmitter within a millimetre of a wall
loses its reflection, one exactly on it sees both sides; from a centimetre on all is well [m]."""


class ClearanceWarning(UserWarning):
    """A body is so near to a surface that paths over it may be missing."""


class Clearance:
    """Watches the bodies of a run and warns once of each that comes too near to the city."""

    def __init__(self, city: CityMesh) -> None:
        self._city = city
        self._warned: set[str] = set()

    def check(self, places: Mapping[str, np.ndarray], time: float) -> None:
        """Warn of bodies at local positions (3,)."""
        city = self._city
        for name, place in places.items():
            if name in self._warned or not city.num_faces:
                continue
            near = np.flatnonzero(np.abs(city.normals @ place - city.plane_offsets) < CLEARANCE)
            if (
                near.size
                and (apart := float(distance_to_triangles(city.corners[near], place).min()))
                < CLEARANCE
            ):
                self._warned.add(name)
                warnings.warn(
                    f"{name} is {apart:.3f} m from a surface of {city.name} at {time:.4g} s: "
                    f"within {CLEARANCE} m the ray tracer loses "
                    "reflections and may see through the surface; fly it farther off",
                    ClearanceWarning,
                    stacklevel=2,
                )
