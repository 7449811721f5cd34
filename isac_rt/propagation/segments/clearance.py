"""UAVs so near to a surface that the ray tracer passes over its reflections in silence."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np

from isac_rt.world.city.mesh import CityMesh, distance_to_triangles

CLEARANCE = 0.01
"""Sionna's rays start a little off where they should: a transmitter within a millimetre of a wall
loses its reflection, one exactly on it sees both sides; from a centimetre on all is well [m]."""


class ClearanceWarning(UserWarning):
    """A UAV so near to a surface that paths over it may be missing."""


class Clearance:
    """Watches the UAVs of a run and warns once of each that comes too near to the city."""

    def __init__(self, city: CityMesh) -> None:
        self._city = city
        self._warned: set[str] = set()

    def check(self, positions: Mapping[str, np.ndarray], time: float) -> None:
        """Warn of UAVs at local positions (3,)."""
        city, names = self._city, [name for name in positions if name not in self._warned]
        every = np.array([positions[name] for name in names]).reshape(-1, 3)
        uav, face = _beside(city.normals, city.plane_offsets, *city.boxes, every, CLEARANCE)
        for number in np.unique(uav):
            name, near = names[number], face[uav == number]
            distance = float(distance_to_triangles(city.corners[near], positions[name]).min())
            if distance < CLEARANCE:
                self._warned.add(name)
                warnings.warn(
                    f"{name} is {distance:.3f} m from a surface of {city.name} at {time:.4g} s: "
                    f"within {CLEARANCE} m the ray tracer loses "
                    "reflections and may see through the surface; fly it farther off",
                    ClearanceWarning,
                    stacklevel=2,
                )


def _beside(
    normals: np.ndarray,
    offsets: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    positions: np.ndarray,
    most: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Find positions (K, 3) within a margin of faces (F,): numbers of both."""
    near = np.abs(normals @ positions.T - offsets[:, None]) < most
    face, point = np.nonzero(near)
    here = positions[point]
    inside = ((low[face] - most < here) & (here < high[face] + most)).all(axis=1)
    return point[inside], face[inside]
