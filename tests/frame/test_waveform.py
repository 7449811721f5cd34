"""Numbers of the paper's settings (notes, section 1), each from a formula of its own."""

from __future__ import annotations

import pytest

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform

PRINTED = 5e-5  # published: the settings are printed with five to seven digits


def test_settings_of_the_paper():
    """Planted bug: T_d = f_s T / B (the paper's misprint) gives 1.6 us."""
    w = Waveform()
    assert w.max_delay == pytest.approx(2 / 60 * 51.2e-6, rel=1e-12)  # rounding
    assert w.chirp_duration == pytest.approx(64 / 60 * 51.2e-6, rel=1e-12)
    assert w.slot_duration == pytest.approx(76 / 60 * 51.2e-6, rel=1e-12)
    assert w.slope * w.sampled_duration == pytest.approx(600e6, rel=1e-12)
    assert w.frame_duration == pytest.approx(7.7824e-3, rel=1e-12)
    assert w.num_resource_blocks == 19


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


@pytest.mark.parametrize(("order", "bits"), [(2, 3591), (4, 3942), (8, 4293), (16, 4644)])
def test_bits_per_frame(order, bits):
    assert Waveform().bits_per_frame(order) == bits  # published, exact


def test_resolutions():
    w = Waveform()
    assert w.range_cell(2) == pytest.approx(0.24983, rel=PRINTED)
    assert w.range_cell(1) == pytest.approx(0.49965, rel=PRINTED)
    # the table uses f_c; the Doppler scale is the effective carrier, 0.44 % above
    assert w.velocity_cell(2) * w.effective_carrier / w.carrier_frequency == pytest.approx(
        0.25014, rel=PRINTED
    )
    assert w.max_velocity(1) * w.effective_carrier / w.carrier_frequency == pytest.approx(
        30.017, rel=PRINTED
    )
    assert w.effective_carrier == pytest.approx(77.34e9, rel=PRINTED)


def test_wavelength_of_the_carrier():
    assert Waveform().wavelength == pytest.approx(SPEED_OF_LIGHT / 77e9, rel=1e-15)


def test_refusals_say_what_to_do():
    with pytest.raises(ValueError, match="raise the bandwidth"):
        Waveform(bandwidth=40e6)
    with pytest.raises(ValueError, match="multiple"):
        Waveform(num_chirps=121)
    with pytest.raises(ValueError, match="groups"):
        Waveform(num_groups=4)
