"""Noise and transmit power in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.level import link_budget, noise_power, thermal_noise_power, transmit_amplitude
from isac_rt.frame.settings import Noise
from isac_rt.frame.waveform import Waveform

WAVEFORM = Waveform()
PUBLISHED = 0.005  # decibel figures given to two decimals


def test_transmit_amplitude():
    """12.7 dBm are 18.62 mW; with an SNR the scale is 1."""
    assert transmit_amplitude(Noise(tx_power_dbm=12.7)) ** 2 == pytest.approx(
        18.62e-3, rel=1e-4, abs=0
    )
    assert transmit_amplitude(Noise(model="snr")) == 1.0


def test_noise_of_an_snr():
    """The reference path stands snr_db above the noise. Seen failing with 10^(snr/20)."""
    level = noise_power(Noise(model="snr", snr_db=-13.7), WAVEFORM, 3.1e-5)
    assert 10 * np.log10(3.1e-5**2 / level) == pytest.approx(-13.7, abs=1e-12)
    assert noise_power(Noise(), WAVEFORM, 3.1e-5) == thermal_noise_power(Noise(), WAVEFORM)


def test_budget_of_the_papers_link():
    """Section 0, 14 of the notes: 10 dBm, isotropic, noise figure 10 dB, 11.31 m: about +10 dB per
    sample at a PT."""
    noise = Noise(tx_power_dbm=10.0, noise_figure_db=10.0)
    antennas = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=1e-3)
    amplitude = WAVEFORM.wavelength / (4 * np.pi * 11.31)
    powers = (
        (transmit_amplitude(noise) * amplitude) ** 2,
        noise_power(noise, WAVEFORM, amplitude),
    )
    row = link_budget(("AT", "PT1"), "line of sight", 11.31, powers, WAVEFORM, antennas)
    loss = 20 * np.log10(4 * np.pi * 11.31 / WAVEFORM.wavelength)
    assert row.link == "AT->PT1"
    assert row.received_dbm == pytest.approx(10 - loss, abs=1e-9)
    assert row.noise_dbm == pytest.approx(-90.965, abs=PUBLISHED)
    assert row.snr_db == pytest.approx(10 - loss + 90.965, abs=PUBLISHED)
    assert row.snr_db == pytest.approx(10.0, abs=1.0)
    # 1024 samples and 120 chirps, two Hann windows (1.76 dB each), 45 channels added in power
    assert row.processing_gain_db == pytest.approx(50.895 - 3.522 + 8.266, abs=PUBLISHED)
    assert row.processed_snr_db == pytest.approx(row.snr_db + row.processing_gain_db, abs=1e-12)
