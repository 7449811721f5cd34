"""Occlusion by the city of points that are no part of it."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from isac_rt import runtime
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.world.city.mesh import CityMesh


class Occlusion:
    """Surfaces of a city that hide points from terminals; None: open space."""

    def __init__(self, city: CityMesh | None, carrier: float) -> None:
        self._city, self._carrier = city, carrier

    @cached_property
    def _line_of_sight(self) -> Any:
        runtime.activate()
        from isac_rt.propagation.segments.rays import LosTest
        from isac_rt.world.city.scene import shared_scenes

        assert self._city is not None
        return LosTest(shared_scenes(self._city, self._carrier).faces)

    def hidden(self, state: LinkState, points: np.ndarray) -> np.ndarray:
        """Mark the points (K,) that a surface hides from either end."""
        hidden = np.zeros(len(points), bool)
        if self._city is None or not self._city.num_faces:
            return hidden
        for end in (state.start, state.end):
            start = np.broadcast_to(end.position, points.shape) - self._city.origin
            hidden |= ~self._line_of_sight.clear(start, points - self._city.origin)
        return hidden
