"""Virtual channels of an array: where their phase centres lie, and when a spherical wave reaches
them."""

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
    positions : (L, 3) by which their phases tell the direction, in the body frame [m]
    """

    tx: np.ndarray
    rx: np.ndarray
    positions: np.ndarray

    def __len__(self) -> int:
        return self.tx.size

    def steering(self, cosines: np.ndarray, known: Known) -> np.ndarray:
        """(K, L) exp(-j k v.u) of paths from body directions (K, 3), at the frequency of the
        window's middle."""
        return np.exp(-1j * known.wavenumber * (cosines @ self.positions.T))


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
    flat = positions[:, [0, 2]]
    along = direction @ flat.T
    axes = flat.T.reshape(2, *(1,) * (along.ndim - 1), -1)
    delay = (-along + ((positions**2).sum(axis=1) - along**2) / (2 * radius)) / SPEED_OF_LIGHT
    return delay, (-(1 + along / radius) * axes) / SPEED_OF_LIGHT
