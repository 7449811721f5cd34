"""Receivers in closed form: noise of quantisation, images, compression."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.hardware.chain import Work, finish
from isac_rt.extensions.hardware.converter import converter_of, saturated, watts
from isac_rt.frame.front_end import Converter

TURNS = (5**0.5 - 1) / 10  # no sine that comes round soon


def tone(amplitude=1.0, count=2**15):
    n = np.arange(count)
    return (amplitude * np.exp(2j * np.pi * TURNS * n)).astype(np.complex64).reshape(1, 1, 1, -1)


def behind(samples, **stated):
    """Samples behind a converter with a full scale of 1."""
    c = converter_of(Converter(**stated))
    out = samples.copy()
    work = Work(
        saturation=0.0 if np.isinf(c.saturation) else c.saturation,
        mixing=c.mixing,
        constant=c.constant,
        real=c.real,
        step=2.0 / 2**c.bits if c.bits else 0.0,
        most=2.0 ** (c.bits - 1),
    )
    finish(out, work)
    return out.ravel()


def lines(samples):
    """Complex amplitude at the tone, at its image, at zero."""
    n, window = np.arange(samples.size), np.hanning(samples.size)
    at = np.array([TURNS, -TURNS, 0.0])
    return np.exp(-2j * np.pi * np.outer(at, n)) @ (samples * window) / window.sum()


@pytest.mark.parametrize("bits", [6, 8, 10, 12])
def test_quantisation_noise_is_that_of_a_full_sine(bits):
    """-6.02 b - 1.76 dB, to 0.3 dB for six bits (32 steps of a sine are not quite white). Planted
    bugs: 2^b - 1 steps; values at the steps' edges."""
    made = behind(tone(), bits=bits)
    noise = np.mean(np.abs(made - tone().ravel()) ** 2)
    assert 10 * np.log10(noise) == pytest.approx(-6.0206 * bits - 1.7609, abs=0.3)
    assert np.unique(made.real).size <= 2**bits


def test_beyond_full_scale_the_converter_clips():
    """Planted bug: values that wrap round."""
    made = behind(tone(3.0), bits=12)
    assert np.abs(made.real).max() == pytest.approx(1 - 2.0**-12, abs=1e-6)
    assert np.abs(made.imag).max() == pytest.approx(1 - 2.0**-12, abs=1e-6)


@pytest.mark.parametrize(("gain", "angle"), [(0.5, 0.0), (0.0, 3.0), (1.0, -4.0)])
def test_image_of_an_imbalance(gain, angle):
    """|1 - g e^(j a)|^2 / |1 + g e^(j a)|^2: -30.8 dB for half a decibel. Planted bug: the angle
    applied to both."""
    line, image, _ = lines(behind(tone(), iq_gain_db=gain, iq_phase_deg=angle))
    g = 10 ** (gain / 20) * np.exp(1j * np.radians(angle))
    truth = 20 * np.log10(abs((1 - g) / (1 + g)))
    assert 20 * np.log10(abs(image / line)) == pytest.approx(truth, abs=0.01)


def test_a_real_sampler_has_an_equal_image():
    """Planted bug: the imaginary part kept."""
    made = behind(tone(), real=True)
    line, image, _ = lines(made)
    assert abs(line) == pytest.approx(0.5, rel=1e-4)
    assert abs(image) == pytest.approx(0.5, rel=1e-4)
    assert not made.imag.any()
    assert not behind(tone(), real=True, bits=8).imag.any()


def test_constant_has_its_power():
    """-60 dBm is a nanowatt. Planted bug: as much in I and in Q."""
    *_, zero = lines(behind(tone(0.0), dc_dbm=-60.0))
    assert abs(zero) ** 2 == pytest.approx(1e-9, rel=1e-3)


def test_one_decibel_of_compression_where_it_is_stated():
    """And the third-order rule of Rapp: far below, nothing; far above, the saturation. Planted bug:
    1 dB of power taken for 1 dB of amplitude."""
    for level, loss in ((-10.0, 1.0), (-40.0, 0.0)):
        amplitude = np.sqrt(watts(level))
        line, *_ = lines(behind(tone(amplitude), compression_dbm=-10.0))
        assert -20 * np.log10(abs(line) / amplitude) == pytest.approx(loss, abs=1e-3)
    assert 20 * np.log10(saturated(1.0, 1.0)) == pytest.approx(-10 * np.log10(2) / 2)
    assert saturated(1e-4, 1.0) == pytest.approx(1.0, abs=1e-8)
    driven = 2.0 * watts(-10.0) * np.geomspace(1e-3, 1e3, 64)
    for power in driven:  # by a polynomial, 4e-6, and float32
        made = behind(np.full((1, 1, 1, 40), np.sqrt(power), np.complex64), compression_dbm=-10.0)
        ratio = saturated(power, watts(-10.0) / (10**0.2 - 1) ** 0.5)
        np.testing.assert_allclose(made, np.sqrt(power) * ratio, rtol=6e-6)
    assert saturated(1e4, 1.0) * 100 == pytest.approx(1.0, abs=1e-8)
