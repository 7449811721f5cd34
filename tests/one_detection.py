"""A track's state after one detection."""

from __future__ import annotations

import numpy as np

from isac_rt.track.filter import Gaussian, initiate_all


def initiate(measurement, std, own, transmitter=None, **settings) -> Gaussian | None:
    """The state after a detection (4,) with deviations (4,); None if it fixes no position."""
    one = measurement[None], std[None], own, transmitter
    which, states = initiate_all(*one, **settings)
    return Gaussian(*(np.array(of[0]) for of in states)) if which.size else None
