"""Virtual channels of the L: which antennas go together, where their phase centres lie, and when a
spherical wave reaches them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.known import Known


@dataclass(frozen=True)
class Channels:
    """Virtual channels that are looked at together.

    Attributes
    ----------
    tx, rx : (L,) antennas
    places : (L, 3) by which their phases tell the direction, in the body frame [m]
    """

    tx: np.ndarray
    rx: np.ndarray
    places: np.ndarray

    def __len__(self) -> int:
        return self.tx.size

    def steering(self, cosines: np.ndarray, known: Known) -> np.ndarray:
        """(K, L) exp(-j k v.u) of paths from body directions (K, 3), at the frequency of the
        window's middle."""
        return np.exp(-1j * known.wavenumber * (cosines @ self.places.T))


@lru_cache(maxsize=32)
def arm(antennas: Antennas, axis: int, passes: int = 2) -> Channels:
    """Channels along X (axis 0) or Z (axis 2) of the L: transmit and receive elements of the axis
    together for an echo, whose places add; for one pass the receive arm with every transmit
    antenna, whose direction of departure is another."""
    a = antennas
    rx = np.arange(a.rx_x) if axis == 0 else np.arange(a.rx_x - 1, a.num_rx)
    along = np.arange(a.tx_x) if axis == 0 else np.arange(a.tx_x - 1, a.num_tx)
    tx = along if passes == 2 else np.arange(a.num_tx)
    t, r = (i.ravel() for i in np.meshgrid(tx, rx, indexing="ij"))
    places = a.rx_positions[r] + (a.tx_positions[t] if passes == 2 else 0.0)
    for array in (t, r, places):
        array.setflags(write=False)
    return Channels(t, r, places)


@lru_cache(maxsize=32)
def all_channels(antennas: Antennas) -> Channels:
    """Every virtual channel of an echo."""
    a = antennas
    t, r = (i.ravel() for i in np.indices((a.num_tx, a.num_rx)))
    return Channels(t, r, a.tx_positions[t] + a.rx_positions[r])


def element_delays(
    positions: np.ndarray, direction: np.ndarray, radius: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Delay of elements (E, 3) against the centroid for spherical waves from directions (..., 2)
    [s], (..., E), and its derivative with respect to u_x, u_z (2, ..., E); `radius` [m] one for all
    or (..., 1)."""
    place = positions[:, [0, 2]]
    along = direction @ place.T
    axes = place.T.reshape(2, *(1,) * (along.ndim - 1), -1)
    delay = (-along + ((positions**2).sum(axis=1) - along**2) / (2 * radius)) / SPEED_OF_LIGHT
    return delay, (-(1 + along / radius) * axes) / SPEED_OF_LIGHT
