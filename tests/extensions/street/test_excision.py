"""Excision of foreign chirps: false alarms of noise, and a pulse beside a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from isac_rt.extensions.street.excision import LEAST_WINDOW, excised
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.active import receive_active
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.scenario.file import load
from isac_rt.simulation.simulate import run
from isac_rt.track.settings import Tracking
from isac_rt.track.terminal import ActiveTerminal, PassiveTerminal
from isac_rt.world.swarm import Pose

SCENE = Path(__file__).parents[3] / "scenes" / "foreign_swarm.yaml"
WAVEFORM = Waveform(num_samples=512, num_chirps=60, num_groups=2)


def cube_of(samples: np.ndarray) -> IFCube:
    schedule = conventional_schedule(2, 60, 3)
    return IFCube(
        samples=samples.astype(np.complex64), waveform=WAVEFORM, schedule=schedule, start_time=0.0
    )


def noise() -> np.ndarray:
    rng = np.random.default_rng(4)
    return rng.standard_normal((2, 5, 60, 512, 2)) @ np.array([1, 1j]) / np.sqrt(2)


def test_samples_of_nothing_stay_nothing():
    """Planted bug: nothing divided by nothing."""
    assert not excised(cube_of(np.zeros((2, 5, 60, 512))), 1e-4).samples.any()


def pulse() -> np.ndarray:
    """A chirp through the band in 40 samples, in every second chirp."""
    u = np.arange(512) - 200.3
    out = 10.0 * np.exp(1j * np.pi * u**2 / 40) * (np.abs(u) < 20) * np.ones((2, 5, 60, 1))
    out[:, :, ::2] = 0
    return out


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
    floor = noise()
    error = excised(cube_of(line + pulse() + floor), 1e-6).samples - line
    assert np.mean(np.abs(floor + pulse()) ** 2) > 4.5
    assert np.mean(np.abs(error) ** 2) < 1.1


def test_a_line_stays_under_a_pulse_that_is_far_stronger():
    """A line 25 dB over the noise and a crossing 15 dB over the line, whose spectrum would hide it:
    by projection what the crossing has in the line's bins, 0.7 dB. Planted bug: `cut` of 1."""
    shape = np.exp(2j * np.pi * 0.0137 * np.arange(512))
    line = 10 ** (25 / 20) * shape * np.ones((2, 5, 60, 1))
    weight = np.sin(np.pi * (np.arange(512) + 0.5) / 512) ** 2
    after = excised(cube_of(line + 10 * pulse() + noise()), 1e-6).samples
    level = np.abs(after @ (weight * shape.conj())) / weight.sum() / 10 ** (25 / 20)
    assert np.abs(20 * np.log10(level[:, :, 1::2])).max() < 0.8


def test_every_receiver_excises():
    """A pulse in every chirp, through the functions and the terminals of both roles: none of it
    shows in their maps. Planted bug: no excision in one of them."""
    cube, payload = cube_of(noise() / 100 + pulse()), unmodulated(WAVEFORM)
    antennas = Antennas(tx_x=2, tx_z=2, rx_x=3, rx_z=3, spacing=WAVEFORM.wavelength / 2)
    pose, settings = Pose.at_rest(), Receivers(excision_rate=1e-6)
    active = ActiveTerminal(WAVEFORM, antennas, settings, Tracking())
    passive = PassiveTerminal(WAVEFORM, antennas, settings, Tracking(), 8, 1.0)
    found = [
        receive_active(cube, payload, antennas, settings, maps=True),
        receive_passive(cube, antennas, settings, 8, None, False, maps=True),
        active.step(cube, payload, pose, 0.0, maps=True)[0],
        passive.step(cube, pose, 0.0, False, maps=True)[0],
    ]
    plain = receive_active(cube, payload, antennas, Receivers(), maps=True)
    for one in found:
        assert one.maps.range_doppler.mean() < 0.01 * plain.maps.range_doppler.mean()


@pytest.mark.slow
@pytest.mark.sionna
def test_a_foreign_swarm_costs_what_the_page_says():
    """The scene, all sets on the same samples: crossings hide U1 and PT1 from AT, whose detector
    knows the noise, until they are excised; `twin`, a line of whole chirps, hides U1 from PT1 in
    two frames. Planted bug: samples as they were."""
    summary = run(load(SCENE), progress=False).summary
    sets = {name: one["terminals"] for name, one in summary["compared"].items()}
    sets["own"] = summary["terminals"]
    found = {
        name: (of["AT"]["hit_rate"], of["AT"]["false_tracks_per_frame"], of["PT1"]["hit_rate"])
        for name, of in sets.items()
    }
    assert found["own"] == pytest.approx((0.25, 0.75, 0.75), abs=0.3)
    assert found["excised"] == pytest.approx((1.0, 0.0, 0.75), abs=0.13)
    assert found["plain"] == pytest.approx((1.0, 2.75, 0.0), abs=0.13)
    assert {of["PT1"]["ser_dpsk"] for of in sets.values()} == {0.0}


@pytest.mark.slow
def test_a_strong_radar_nearby_takes_the_data_unless_it_is_excised():
    """`wing` 5 m before PT1, 36 dBm of EIRP, in free space. Planted bug: samples as they were."""
    wing = "{position_m: [4.2, 8.7, 11.4], velocity_mps: [-0.3, -3.1, 0.2], boresight: [0, 1, 0], "
    wing += "power_dbm: 31, start_hz: 77.3e9, slope_mhz_per_us: 35, ramp_us: 18, idle_us: 4.5, "
    wing += "clock_drift_ppm: 5}"
    changes = [
        "clutter.model=none",
        "propagation={model: free_space}",
        f"emitters={{wing: {wing}}}",
    ]
    changes.append("compare={excised: {receivers: {excision_rate: 1.0e-6}}}")
    summary = run(load(SCENE, changes), progress=False, snapshots=0).summary
    assert summary["terminals"]["PT1"]["ser_dpsk"] > 0.7
    assert summary["compared"]["excised"]["terminals"]["PT1"]["ser_dpsk"] == 0
