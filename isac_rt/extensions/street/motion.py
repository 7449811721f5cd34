"""Motion of scattering centres in the axes of a UAV."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class Motion(NamedTuple):
    """Places, velocities and accelerations, (T, K, 3) each [m, m/s, m/s^2]."""

    place: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


class CentreModel(Protocol):
    """Scattering centres that move in the axes of a UAV's body (right, ahead, up)."""

    def amplitudes(self) -> np.ndarray:
        """(K,) square root of each centre's cross-section [m]."""
        ...

    def motion(self, time: np.ndarray) -> Motion:
        """Return the centres' motion from the UAV's position at times (T,) [s]."""
        ...
