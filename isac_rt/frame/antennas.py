"""L-shaped arrays in the body frame, element patterns, and the antenna schedules of TDM-MIMO.

Body frame: X to the right, Y along the boresight, Z up. Each of the two arrays is given about its
own centroid, which is the body's position.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from isac_rt.frame.waveform import Waveform
from isac_rt.scenario.radio import Array

PatternModel = Literal["isotropic", "sector", "cosine"]


@lru_cache(maxsize=64)
def l_shape(num_x: int, num_z: int, spacing: float, step_x: int = 1, step_z: int = 1) -> np.ndarray:
    """Elements of an L (num_x + num_z - 1, 3) [m] about their centroid.

    Order as in the paper: element 0 is farthest along X, then inwards to the corner (index
    ``num_x - 1``), then up along Z. Neighbours stand `step_x` (`step_z`) spacings apart.
    """
    x = np.concatenate([np.arange(num_x)[::-1] * step_x, np.zeros(num_z - 1)])
    z = np.concatenate([np.zeros(num_x), np.arange(1, num_z) * step_z])
    positions = spacing * np.stack([x, np.zeros_like(x), z], axis=1)
    positions -= positions.mean(axis=0)
    positions.setflags(write=False)
    return positions


def unit_vector(cosines: npt.ArrayLike) -> np.ndarray:
    """Body-frame unit vectors (..., 3) of direction cosines (u_x, u_z) (..., 2) in the front
    half-space; outside the unit disc the Y component is 0."""
    u_x, u_z = np.moveaxis(np.asarray(cosines), -1, 0)
    forward = np.sqrt(np.maximum(1 - u_x**2 - u_z**2, 0.0))
    return np.stack([u_x, forward, u_z], axis=-1)


def azimuth_elevation(cosines: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation [rad] (...) of direction cosines (u_x, u_z) (..., 2) in the front
    half-space; NaN outside the unit disc."""
    u_x, u_z = np.moveaxis(np.asarray(cosines), -1, 0)
    forward = 1 - u_x**2 - u_z**2
    seen = np.where(forward >= 0, 1.0, np.nan)
    return np.arctan2(u_x, np.sqrt(np.maximum(forward, 0.0))) * seen, np.arcsin(u_z * seen)


@dataclass(frozen=True, kw_only=True)
class Antennas:
    """The transmit and receive arrays of a terminal and the pattern of their elements.

    Attributes
    ----------
    tx_x, tx_z, rx_x, rx_z : elements along each arm, the corner counted in both
    spacing : distance of neighbouring receive elements d_a [m]; transmit elements stand rx_x (rx_z)
        of these apart, so that an echo sees a gapless virtual L
    gain : power gain of an element on boresight (linear); with ``isotropic`` everywhere
    pattern : "isotropic"; "sector": `gain` inside the field of view, nothing outside;
        "cosine": gain * cos(angle)^q in the front hemisphere, q = gain/2 - 1 so that it radiates
        its own power, and at least 0
    half_view : half of the field of view per axis [rad]; what lies outside has no place in the
        estimates (for "sector" nothing is sent or received there)
    """

    tx_x: int
    tx_z: int
    rx_x: int
    rx_z: int
    spacing: float
    gain: float = 1.0
    pattern: PatternModel = "isotropic"
    half_view: float = np.pi / 3

    @property
    def num_tx(self) -> int:
        return self.tx_x + self.tx_z - 1

    @property
    def num_rx(self) -> int:
        return self.rx_x + self.rx_z - 1

    @property
    def tx_positions(self) -> np.ndarray:
        """(num_tx, 3) [m] body frame, about the centroid."""
        return l_shape(self.tx_x, self.tx_z, self.spacing, self.rx_x, self.rx_z)

    @property
    def rx_positions(self) -> np.ndarray:
        """(num_rx, 3) [m] body frame, about the centroid."""
        return l_shape(self.rx_x, self.rx_z, self.spacing)

    @property
    def view_limit(self) -> float:
        """Largest |u_x| and |u_z| of the field of view."""
        return float(np.sin(min(self.half_view, np.pi / 2)))

    def in_view(self, direction: np.ndarray) -> np.ndarray:
        """Whether body-frame unit vectors (..., 3) lie inside the field of view of both arms."""
        limit = self.view_limit
        return (
            (direction[..., 1] > 0)
            & (np.abs(direction[..., 0]) <= limit)
            & (np.abs(direction[..., 2]) <= limit)
        )

    def element_gain(self, direction: np.ndarray) -> np.ndarray:
        """Power gain of an element towards body-frame unit vectors (..., 3) (linear)."""
        if self.pattern == "isotropic":
            return np.full(direction.shape[:-1], self.gain)
        if self.pattern == "sector":
            return np.where(self.in_view(direction), self.gain, 0.0)
        exponent = max(self.gain / 2 - 1, 0.0)
        forward = np.clip(direction[..., 1], 0.0, None)
        return self.gain * np.where(forward > 0, forward**exponent, 0.0)


def antennas_of(a: Array, waveform: Waveform) -> Antennas:
    """The arrays that a scenario states; the spacing is in wavelengths of the carrier f_c."""
    return Antennas(
        tx_x=a.tx_x,
        tx_z=a.tx_z,
        rx_x=a.rx_x,
        rx_z=a.rx_z,
        spacing=a.spacing_wavelengths * waveform.wavelength,
        gain=10 ** (a.element_gain_dbi / 10),
        pattern=a.element_pattern,
        half_view=np.deg2rad(a.field_of_view_deg) / 2,
    )


def resolutions(waveform: Waveform, antennas: Antennas, passes: int) -> np.ndarray:
    """Resolution of range [m], velocity [m/s], u_x and u_z (4,).

    The array's is wavelength over aperture: that of the virtual array (transmit times receive
    elements of an arm) for an echo (passes = 2), of the receive array alone for one pass.
    """
    across = antennas.rx_x * (antennas.tx_x if passes == 2 else 1)
    up = antennas.rx_z * (antennas.tx_z if passes == 2 else 1)
    step = waveform.wavelength / antennas.spacing
    return np.array(
        [waveform.range_cell(passes), waveform.velocity_cell(passes), step / across, step / up]
    )
