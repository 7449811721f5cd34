"""Excision of foreign chirps: false alarms of noise, and a pulse beside a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from isac_rt.extensions.street.excision import LEAST_WINDOW, excised
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import Waveform
from isac_rt.scenario.file import load
from isac_rt.simulation.simulate import run

SCENE = Path(__file__).parents[3] / "scenes" / "foreign_radar.yaml"
WAVEFORM = Waveform(num_samples=512, num_chirps=60, num_groups=2)


def cube_of(samples: np.ndarray) -> IFCube:
    schedule = np.zeros((2, 60), int)
    return IFCube(
        samples=samples.astype(np.complex64), waveform=WAVEFORM, schedule=schedule, start_time=0.0
    )


def noise() -> np.ndarray:
    rng = np.random.default_rng(4)
    return rng.standard_normal((2, 5, 60, 512, 2)) @ np.array([1, 1j]) / np.sqrt(2)


@pytest.mark.parametrize("rate", [1e-2, 1e-3])
def test_noise_loses_samples_at_the_stated_rate(rate):
    """Planted bug: the threshold of one antenna; the median for the mean."""
    before = noise()
    after = excised(cube_of(before), rate).samples
    window = np.sin(np.pi * (np.arange(512) + 0.5) / 512) ** 2 > LEAST_WINDOW
    changed = np.abs(after - before).max(axis=1)[..., window] > 1e-3
    assert changed.mean() == pytest.approx(rate, rel=0.25, abs=0)


def test_a_pulse_goes_and_a_line_of_50_db_stays():
    """A chirp through the band in 40 samples, 20 dB over the noise, beside a line 50 dB over it:
    the error of what is left is that of the noise. Planted bug: samples blanked, line and all."""
    n = np.arange(512)
    line = 10**2.5 * np.exp(2j * np.pi * 0.0137 * n) * np.ones((2, 5, 60, 1))
    u = n - 200.3
    pulse = 10.0 * np.exp(1j * np.pi * u**2 / 40) * (np.abs(u) < 20) * np.ones((2, 5, 60, 1))
    pulse[:, :, ::2] = 0
    floor = noise()
    error = excised(cube_of(line + pulse + floor), 1e-6).samples - line
    assert np.mean(np.abs(floor + pulse) ** 2) > 4.5
    assert np.mean(np.abs(error) ** 2) < 1.1


@pytest.mark.slow
@pytest.mark.sionna
def test_excision_gives_a_street_its_targets_back():
    """Four frames of the scene, both sets on the same samples: a car's chirps hide U1 and PT1 from
    AT, whose detector knows the noise. Planted bug: samples as they were."""
    more = ["frames=4", "compare={excised: {receivers: {excision_rate: 1.0e-6}}}"]
    summary = run(load(SCENE, more), progress=False).summary
    own, clean = summary["terminals"]["AT"], summary["compared"]["excised"]["terminals"]["AT"]
    assert own["hit_rate"] < 0.5 and own["false_per_frame"] > 35
    assert clean["hit_rate"] == 1.0 and clean["false_per_frame"] < 25
    assert summary["compared"]["excised"]["terminals"]["PT1"]["ser_dpsk"] == 0
