"""The experiment of real front ends: closed forms and small parts of it."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.scenario.front_end import FrontEnd
from isac_rt.studies.paper import hardware


@pytest.mark.parametrize(
    ("sigma", "order", "rate"),
    [(1.272, 2, 0.217), (1.272, 4, 0.537), (1.272, 8, 0.758), (1.272, 16, 0.877), (0.1, 2, 0.0)],
)
def test_rates_of_two_free_oscillators(sigma, order, rate):
    """Two Wiener phases of 1987 Hz linewidth each over 64.8 us. Planted bug: one side
    of the normal distribution."""
    assert hardware.wrapped(sigma, order) == pytest.approx(rate, abs=1e-3)


def test_mean_over_the_chirp_takes_a_walk_in():
    """A walk of variance D t between means over T, spaced S apart, has D (S - T/3): 1.272 rad from
    slot to slot become 1.272 sqrt(1 - 51.2/(3 64.8)) = 1.092 rad. Planted bug: sinc without the
    square."""
    w = hardware.link_waveform(1024)
    one = hardware._oscillators()["free -95"]
    found = hardware.closed_form(one, w, 4, np.array([1]))
    assert found == pytest.approx(hardware.wrapped(1.092, 4), abs=0.005)


def test_eight_bits_beside_a_leakage_lift_the_floor():
    """8.8 dB by closed form, to 0.5 dB. Planted bug: the headroom left out."""
    node = FrontEnd.model_validate({"converter": {"bits": 8}})
    found, truth = hardware._floor(node, 5)
    assert truth == pytest.approx(8.8, abs=0.1)
    assert found == pytest.approx(truth, abs=0.5)


def test_symbols_follow_the_closed_form():
    """A frame of 117 symbols, half a slot's walk of a radian: 4.6 % of one standard deviation.
    Planted bug: one oscillator at both ends."""
    rows = hardware._symbols("free -95", hardware._oscillators()["free -95"], 1, 11)
    for _, _, rate, truth, *_ in rows:
        assert rate == pytest.approx(truth, abs=0.19)
