"""CFAR over velocities: combs of rotors raise their own threshold, noise and targets do not."""

from __future__ import annotations

import numpy as np
import pytest

import isac_rt as irt
from isac_rt.extensions.street.comb import CombRule
from isac_rt.receive.cfar import CfarRule

LOOKS, RATE, COMB = 2, 1e-3, 40
SETTINGS = RATE, (3, 3), (8, 6), LOOKS


def noisy_map(comb_db, seed):
    """Powers (128, 96) of noise of mean 1, stronger in one range cell."""
    power = np.random.default_rng(seed).gamma(LOOKS, 1 / LOOKS, (128, 96))
    power[COMB] *= 10 ** (comb_db / 10)
    return power


def test_noise_is_found_as_often_as_the_rate_says():
    """The median leaves the level of noise where it is, and states that of a comb. Planted bugs:
    without `* self.looks`; the mean of Gamma in place of its median."""
    found, level = {CfarRule: 0.0, CombRule: 0.0}, 0.0
    for seed in range(20):
        level += CombRule(*SETTINGS).detect(noisy_map(15.0, seed))[1][COMB].mean() / 20
        for kind in found:
            found[kind] += kind(*SETTINGS).detect(noisy_map(0.0, seed))[0][12:-12].mean() / 20
    assert level == pytest.approx(10**1.5, rel=0.05)
    assert 0.5 * found[CfarRule] < found[CombRule] <= found[CfarRule] < 2 * RATE


def test_a_comb_is_no_target_but_hides_none_over_it():
    """A range cell 15 dB over noise at all velocities, and a target 10 dB over that. Planted bugs:
    `np.minimum`; the median over all ranges."""
    power = noisy_map(15.0, 1)
    power[COMB, 30] = power[COMB].mean() * 10
    without, level = CfarRule(*SETTINGS).detect(power)
    found, comb = CombRule(*SETTINGS).detect(power)
    assert without[COMB].mean() > 0.9
    assert found[COMB, 30] and found[COMB].sum() <= 2
    assert np.median(comb[COMB] / level[COMB]) == pytest.approx(10**1.5, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("detector", "least", "most"), [("cfar", 5, 20), ("comb_cfar", 0, 0.3)])
def test_false_detections_of_a_quadcopter(detector, least, most):
    """Regression: with blades of 0 dBsm, a frame of ten."""
    changes = ["frames=10", "swarm.Q.rotors.blade_dbsm=0", f"receivers.clutter_detector={detector}"]
    summary = irt.run(irt.load("scenes/quadcopter.yaml", changes), progress=False).summary
    figures = summary["terminals"]["radar"]
    assert figures["targets"]["Q"]["found"] == 10
    assert least <= figures["false_per_frame"] < most
