"""Numbers of the paper's settings (notes, section 1), each from a formula of its own."""

from __future__ import annotations

import pytest

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform


def test_beat_of_the_largest_delay_is_the_sampling_rate():
    w = Waveform(
        bandwidth=523e6,
        sampling_rate=17.3e6,
        num_samples=900,
        num_chirps=44,
        num_tx=4,
        num_groups=2,
    )
    assert w.slope * w.max_delay == pytest.approx(w.sampling_rate, rel=1e-12)
    assert w.delay_step * w.num_samples == pytest.approx(w.max_delay, rel=1e-12)


def test_resource_blocks_are_counted_in_integers():
    """floor() of the float quotient is one too low for some settings; planted bug: int(T-/(2
    T_d))."""
    for ratio in range(3, 200):
        w = Waveform(bandwidth=ratio * 13.7e6, sampling_rate=13.7e6)
        assert w.num_resource_blocks == (ratio - 2 + 2 + 2 * 3) // 2


def test_wavelength_of_the_carrier():
    assert Waveform().wavelength == pytest.approx(SPEED_OF_LIGHT / 77e9, rel=1e-15)


def test_refusals_say_what_to_do():
    with pytest.raises(ValueError, match="raise the bandwidth"):
        Waveform(bandwidth=40e6)
    with pytest.raises(ValueError, match="multiple"):
        Waveform(num_chirps=121)
    with pytest.raises(ValueError, match="groups"):
        Waveform(num_groups=4)
