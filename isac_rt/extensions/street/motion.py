"""Motion of scattering centres in the axes of a UAV."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from isac_rt.frame.waveform import Waveform

PHASE_ERROR = 1e-3
"""Largest phase error [rad] at the ends of a piece; 0.06 % of its samples on average."""


class Motion(NamedTuple):
    """Places, velocities and accelerations, (T, K, 3) each [m, m/s, m/s^2]."""

    place: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


class CentreModel(Protocol):
    """Scattering centres that move in the axes of a UAV's body (right, ahead, up).

    Attributes
    ----------
    speed, jerk : largest of all centres against the body [m/s, m/s^3]
    fading : largest rate at which amplitudes change [1/s of the largest]
    replaces_echo : the UAV's own point echo is left out
    """

    replaces_echo: ClassVar[bool]

    @property
    def speed(self) -> float: ...

    @property
    def jerk(self) -> float: ...

    @property
    def fading(self) -> float: ...

    def described(self, *towards: np.ndarray) -> str:
        """Return what is modelled, in words for the plan, as seen from directions (3,)."""
        ...

    def amplitudes(
        self, incident: np.ndarray, observed: np.ndarray, time: np.ndarray
    ) -> np.ndarray:
        """(K,) square root of each centre's cross-section [m] towards source and observer, unit
        vectors (3,) in the body's axes; (T, K) where it changes with time (T,) [s]."""
        ...

    def square_metres(self, incident: np.ndarray, observed: np.ndarray) -> Any:
        """Return the cross-section of all centres, added by power and over time [m^2]."""
        ...

    def motion(self, time: np.ndarray) -> Motion:
        """Return the centres' motion from the UAV's position at times (T,) [s]."""
        ...


def pieces(w: Waveform, slots: int, later: float) -> tuple[np.ndarray, np.ndarray]:
    """Return when pieces of a frame of so many slots begin and the last ends (T + 1,), and their
    middles (T,) [s since the epoch], the middle of the frame `later` than the epoch."""
    first = np.append(np.arange(0, w.num_chirps, slots), w.num_chirps)
    begin = first * w.slot_duration - w.frame_duration / 2 + later
    samples = w.window_start, w.chirp_duration + (w.num_groups - 1) * w.group_spacing
    middle = (begin[:-1] + begin[1:] - w.slot_duration + sum(samples)) / 2
    return (np.array([-np.inf, np.inf]) if middle.size == 1 else begin), middle
