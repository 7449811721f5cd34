"""The Cramer-Rao bound against the information of a signal that is written out sample by sample."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.constants import speed_of_light as c

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.results.bounds import CramerRao
from isac_rt.results.metrics import Truth

WAVE = Waveform(num_samples=32, num_chirps=12, sampling_rate=20e6, bandwidth=640e6)


def information(antennas: Antennas, passes: int, azimuth: float, elevation: float) -> np.ndarray:
    """(4,) least deviations at unit SNR of the whole frame, from the samples of one path written
    out over chirps, channels and samples, differentiated numerically by range, velocity, azimuth
    and elevation, beside an unknown amplitude and phase."""
    tx = antennas.tx_positions if passes == 2 else np.zeros((1, 3))
    places = (tx[:, None] + antennas.rx_positions[None]).reshape(-1, 3)
    t = WAVE.sample_interval * (np.arange(32) - 15.5)
    slot = WAVE.slot_duration * (np.arange(12) - 5.5)
    carrier = float(WAVE.carrier())

    def samples(p: np.ndarray) -> np.ndarray:
        length, rate, az, el, gain, phase = p
        u = np.array([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)])
        turns = WAVE.slope * t * passes * length / c
        turns = turns + carrier * slot[:, None, None] * passes * rate / c
        turns = turns - carrier * (places @ u)[:, None] / c
        return gain * np.exp(2j * np.pi * turns + 1j * phase).ravel()

    at = np.array([0.3, -0.2, azimuth, elevation, 1.0, 0.4])
    steps = np.array([1e-5, 1e-5, 1e-6, 1e-6, 1e-6, 1e-6])
    slopes = [(samples(at + d) - samples(at - d)) / (2 * d.sum()) for d in np.diag(steps)]
    g = np.array(slopes)
    fisher = 2 * np.real(g.conj() @ g.T) / g.shape[1]
    return np.sqrt(np.diag(np.linalg.inv(fisher)))[:4]


@pytest.mark.parametrize("passes", [1, 2])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 0.0), (0.61, -0.37), (-0.9, 0.5)])
def test_the_bound_is_that_of_the_samples(passes, azimuth, elevation):
    """Echoes and bistatic paths, ahead and off it, to the bound's leading order: the array is small
    to the frame. Planted bugs: one pass for two; the wavenumber without 2 pi; azimuth without the
    part of u_z; variance of N samples without the mean taken off."""
    antennas = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.0019)
    expected = information(antennas, passes, azimuth, elevation)
    u_x, u_z = np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    truth = Truth(40.0, 1.0, u_x, u_z, azimuth, elevation)
    found = CramerRao.of(WAVE, antennas, passes).of_path(7.0, truth) * np.sqrt(7.0)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_a_row_knows_no_elevation():
    """Positions along X alone."""
    row = Antennas.placed([(0, 0)], [(0.002 * k, 0) for k in range(4)])
    found = CramerRao.of(WAVE, row, 2).of_path(1.0, Truth(9.0, 0.0, 0.3, 0.2, 0.3, 0.2))
    assert np.isnan(found[3]) and np.isfinite(found[:3]).all()
    # sigma of u_x = 1 / (k std sqrt 2), ahead in the row's plane
    k = 2 * np.pi * float(WAVE.carrier()) / c
    spread = 0.002 * np.std(np.arange(4))
    assert found[2] == pytest.approx(1 / (np.sqrt(2) * k * spread * np.sqrt(1 - 0.09)))
