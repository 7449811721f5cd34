"""Radar cross-sections of the swarm's UAVs: constant, or 3GPP TR 38.901's UAVs, with a
fluctuation that is smooth in aspect."""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.special import i0

from isac_rt.randomness import generator
from isac_rt.world.aspect import in_table
from isac_rt.world.settings import Rcs

SMALL_MEAN_DBSM = -12.81  # TR 38.901 v19 table 7.9.2.1-1
TR38901_STD_DB = {"small": 3.74, "large": 2.50}
"""Standard deviation of the random component, by the size of the UAV."""


class Lobe(NamedTuple):
    """One lobe of TR 38.901: azimuth (0 ahead, 90 left; None: about the vertical), its 3 dB width,
    zenith angle and its width [deg], peak [dBsm] and depth [dB]."""

    azimuth: float | None
    azimuth_width: float
    zenith: float
    zenith_width: float
    peak: float
    depth: float


LARGE_BISTATIC = (6.05, 1.33)  # k_1, k_2 of eq. 7.9.2-3 for the large UAV
LARGE_LOBES = (
    Lobe(0.0, 14.19, 90.0, 16.53, 1.02, 7.89),
    Lobe(90.0, 7.13, 90.0, 8.68, 7.43, 14.30),
    Lobe(180.0, 10.09, 90.0, 11.43, 3.99, 10.86),
    Lobe(270.0, 7.13, 90.0, 8.68, 7.43, 14.30),
    Lobe(None, np.inf, 0.0, 4.93, 13.55, 20.42),
    Lobe(None, np.inf, 180.0, 4.93, 13.55, 20.42),
)
"""TR 38.901 v19 table 7.9.2.1-2. Every lobe ends on the same floor, peak - depth = -6.87 dBsm, well
inside its sector."""

NUM_WAVES = 24
_WAVE = np.sqrt(2 / NUM_WAVES)  # amplitude of each, for a field of unit standard deviation
ASPECT_SCALE = 6.0
"""Wave number of the aspect field [1/rad]: it decorrelates over about a sixth of a radian."""


class CrossSection:
    """Radar cross-section of one UAV as a function of aspect, the same for all links and frames.

    The fluctuation in dB is a sum of plane waves over the bisector of the directions of incidence
    and observation in the body's frame: a fixed, smooth random field of the stated standard
    deviation, seeded by the UAV's name. Its mean in dB lies below zero by as much as makes the mean
    power one (-ln(10)/20 std^2 for a Gaussian field, as in TR 38.901; exact here for the sum of
    waves), so that it leaves the mean cross-section as it is. It takes the place of TR 38.901's
    random component, whose independent draws per direction would not be coherent between frames.
    """

    def __init__(self, rcs: Rcs, name: str, seed: int) -> None:
        self._rcs = rcs
        default = TR38901_STD_DB[rcs.size] if rcs.model == "tr38901" else 0.0
        self._std_db = default if rcs.fluctuation_db is None else rcs.fluctuation_db
        rng = generator(seed, "rcs", name)
        waves = rng.standard_normal((NUM_WAVES, 3))
        self._waves = ASPECT_SCALE * waves / np.linalg.norm(waves, axis=1, keepdims=True)
        self._phases = rng.uniform(0, 2 * np.pi, NUM_WAVES)

    def square_metres(self, incident: np.ndarray, observed: np.ndarray) -> np.ndarray:
        """Cross-section [m^2].

        Parameters
        ----------
        incident, observed : (..., 3) unit vectors in the body's frame, from the body towards source
            and observer
        """
        total = incident + observed
        norm = np.linalg.norm(total, axis=-1)  # 2 cos(beta/2)
        half_bistatic = np.arccos(np.clip(norm / 2, 0.0, 1.0))
        bisector = total / np.maximum(norm, 1e-9)[..., None]
        field = _WAVE * np.cos(bisector @ self._waves.T + self._phases).sum(axis=-1)
        # towards forward scattering the bisector turns ever faster: the field fades there, or it
        # would not be smooth
        std = self._std_db * norm / 2
        mean_db = self._mean_db(bisector, half_bistatic) - excess_db(std)
        return 10 ** ((mean_db + std * field) / 10)

    def _mean_db(self, bisector: np.ndarray, half_bistatic: np.ndarray) -> np.ndarray:
        if self._rcs.table is not None:
            return in_table(self._rcs.table, bisector)
        if self._rcs.model != "tr38901":
            return np.full(half_bistatic.shape, self._rcs.value_dbsm)
        if self._rcs.size == "small":
            return SMALL_MEAN_DBSM - 3 * np.sin(half_bistatic)  # eq. 7.9.2-2
        return large_uav_db(bisector, half_bistatic)


def excess_db(std_db: np.ndarray) -> np.ndarray:
    """Mean power of a sum of `NUM_WAVES` waves in dB, of zero mean there and a standard deviation.

    The mean of 10^(a cos(phase)/10) over the phase is I_0(a ln(10)/10), for each wave by itself.
    """
    return NUM_WAVES * 10 * np.log10(i0(_WAVE * std_db * np.log(10) / 10))


def large_uav_db(bisector: np.ndarray, half_bistatic: np.ndarray) -> np.ndarray:
    """TR 38.901 eq. 7.9.2-3 for the large UAV [dBsm], the largest of its lobes."""
    each = (lobe_db(lobe, LARGE_BISTATIC, bisector, half_bistatic) for lobe in LARGE_LOBES)
    return reduce(np.maximum, each)


def lobe_db(
    lobe: Lobe, constants: tuple[float, float], bisector: np.ndarray, half_bistatic: np.ndarray
) -> np.ndarray:
    """Cross-section by one lobe, TR 38.901 eq. 7.9.2-3 [dBsm].

    Parameters
    ----------
    constants : k_1 and k_2 of the kind of target
    bisector : (..., 3) unit vectors in the body's frame (X right, Y forward, Z up)
    half_bistatic : (...) half of the bistatic angle [rad]
    """
    zenith = np.degrees(np.arccos(np.clip(bisector[..., 2], -1, 1)))
    azimuth = np.degrees(
        np.arctan2(-bisector[..., 0], bisector[..., 1])
    )  # the table's: 0 forward, 90 left
    k1, k2 = constants
    bistatic = -k1 * np.sin(k2 * half_bistatic) + 5 * np.log10(
        np.maximum(np.cos(half_bistatic), 1e-12)
    )
    loss = np.minimum(12 * ((zenith - lobe.zenith) / lobe.zenith_width) ** 2, lobe.depth)
    if lobe.azimuth is not None:
        off = (azimuth - lobe.azimuth + 180) % 360 - 180
        loss = loss + np.minimum(12 * (off / lobe.azimuth_width) ** 2, lobe.depth)
    value = lobe.peak - np.minimum(loss, lobe.depth) + bistatic
    return np.maximum(value, lobe.peak - lobe.depth)
