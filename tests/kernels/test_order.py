"""Medians by bits against numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.kernels.order import median, medians


@pytest.mark.parametrize("count", [1, 2, 7, 64, 65, 1037, 4096])
def test_medians_are_those_of_numpy(count: int):
    """To the last bit, with zeros and equal numbers among them. Planted bugs: the lower of both
    middle ones alone; what fills no vector left out; the middle of equal numbers passed over."""
    rng = np.random.default_rng(1)
    powers = rng.exponential(size=(3, 2, count)).astype(np.float32)
    powers[1] = np.round(powers[1])
    powers[2, :, : count // 2 + 1] = 0.0
    assert np.array_equal(medians(powers), np.median(powers, axis=-1))
    assert median(powers) == np.median(powers)
