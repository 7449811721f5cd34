"""CFAR that knows combs: the lines of rotors, folded by the slots, fill all velocities of a UAV's
range cells. The background is at least the median over these, which a few targets do not move. Of
Gamma(L)/L, the power of L channels in noise, the mean is 1: the median of the cells over that of
the distribution estimates it, and the factor of the false-alarm rate holds as for noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from isac_rt.receive.cfar import CfarRule
from isac_rt.receive.known import Known
from isac_rt.receive.sense import Cfar


@dataclass(frozen=True)
class CombRule(CfarRule):
    """Greatest-of CFAR before and behind a cell in range, and over all velocities of its range."""

    def background(self, power: np.ndarray, keep: np.ndarray) -> np.ndarray:
        """Return the background of each cell (rows, P)."""
        median = np.median(power, axis=1, keepdims=True) * self.looks
        over_velocities = median / gammaincinv(self.looks, 0.5)
        return np.maximum(super().background(power, keep), over_velocities)


@dataclass(frozen=True)
class CombCfar(Cfar):
    """CFAR by `CombRule`."""

    def rule(self, known: Known) -> CfarRule:
        """Return the rule of a frame."""
        return CombRule(**vars(super().rule(known)))
