"""A threshold map: the power of a cell against the noise and the clutter that the mesh predicts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import gammainccinv

from isac_rt.receive.clutter.detectors import ClutterDetector, Judged
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate
from isac_rt.receive.types import ExpectedClutter


class ThresholdMap(ClutterDetector):
    """The mean power over the channels against its law under noise and expected clutter."""

    def judge(
        self, frames: Sequence[np.ndarray], known: Known, clutter: ExpectedClutter | None = None
    ) -> list[Judged]:
        powers = [accumulate(maps) for maps in frames]
        _, expected, noise = self.expectation(powers, known, clutter)
        rate = self.settings.false_alarm_rate
        limits = [n * map_factor(expected / n, known.channels, rate) for n in noise]
        return [
            Judged.everywhere(power / limit, n + expected)
            for power, n, limit in zip(powers, noise, limits, strict=True)
        ]


def map_factor(level: np.ndarray, looks: int, false_alarm_rate: float) -> np.ndarray:
    """What the mean power over the channels, in units of the noise, exceeds at a rate where the
    expected clutter is `level`.

    Noise is a mean of `looks` exponentials. Clutter of one direction is alike on all channels, one
    exponential: of the laws with this mean the one that reaches highest. The sum is taken as the
    Gamma variable of its mean and variance.
    """
    c = np.asarray(level, float)
    mean, variance = 1 + c, 1 / looks + c**2
    return gammainccinv(mean**2 / variance, false_alarm_rate) * (variance / mean)
