"""Motion of scattering centres in the axes of a UAV."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from isac_rt.frame.waveform import Waveform

PHASE_ERROR = 1e-3
"""Largest phase error [rad] at the ends of a piece; 0.06 % of its samples on average."""


class Motion(NamedTuple):
    """Places, velocities and accelerations, (T, K, 3) each [m, m/s, m/s^2]."""

    place: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray

    def length(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the distance from the origin, and its first and second derivative."""
        place, velocity, acceleration = self
        length = np.sqrt(np.vecdot(place, place))
        rate = np.vecdot(place, velocity) / length
        accel = np.vecdot(velocity, velocity) + np.vecdot(place, acceleration) - rate * rate
        return length, rate, accel / length


class CentreModel(ABC):
    """Scattering centres that move in the axes of a UAV's body (right, ahead, up).

    Attributes
    ----------
    amplitude : (K,) square root of each centre's cross-section [m], with its phase
    speed, jerk : largest of all centres against the body [m/s, m/s^3]
    fading : largest rate at which amplitudes change [1/s of the largest]
    replaces_echo : the UAV's own point echo is left out
    """

    amplitude: np.ndarray
    replaces_echo: ClassVar[bool] = True

    @property
    def speed(self) -> float:
        return 0.0

    @property
    def jerk(self) -> float:
        return 0.0

    @property
    def fading(self) -> float:
        return 0.0

    @abstractmethod
    def described(self) -> str:
        """Return what is modelled, in words for the plan."""

    def amplitudes(
        self, incident: np.ndarray, observed: np.ndarray, time: np.ndarray
    ) -> np.ndarray:
        """(K,) square root of each centre's cross-section [m], or (T, K), towards source and
        observer, unit vectors (3,) or (T, K, 3) in the body's axes, at times (T,) [s]."""
        return self.amplitude

    def square_metres(self, incident: np.ndarray, observed: np.ndarray) -> Any:
        """Return the cross-section of all centres, added by power and over time [m^2]."""
        return (np.abs(self.amplitude) ** 2).sum()

    @abstractmethod
    def motion(self, time: np.ndarray) -> Motion:
        """Return the centres' motion from the UAV's position at times (T,) [s]."""


def pieces(w: Waveform, slots: int, later: float) -> tuple[np.ndarray, np.ndarray]:
    """Return when pieces of a frame of so many slots begin and the last ends (T + 1,), and their
    middles (T,) [s since the epoch], the middle of the frame `later` than the epoch."""
    first = np.append(np.arange(0, w.num_chirps, slots), w.num_chirps)
    begin = first * w.slot_duration - w.frame_duration / 2 + later
    samples = w.window_start, w.chirp_duration + (w.num_groups - 1) * w.group_spacing
    middle = (begin[:-1] + begin[1:] - w.slot_duration + sum(samples)) / 2
    return (np.array([-np.inf, np.inf]) if middle.size == 1 else begin), middle
