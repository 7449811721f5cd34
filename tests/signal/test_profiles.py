"""Range profiles made directly, against transforms of the exact samples, and their noise against
its covariance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from receiver_cubes import ANTENNAS

from isac_rt.document import ScenarioError
from isac_rt.frame.cube import ReceiveArray, Reference, Transmission
from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform, hann
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.receive.active import receive_active
from isac_rt.receive.known import Known
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.scenario.file import load
from isac_rt.signal.gridded import ACCURATE, GRIDDED_ERROR, PROFILES
from isac_rt.signal.if_signal import add_noise, if_signal, range_profiles
from isac_rt.signal.methods import Auto, Exact
from isac_rt.signal.noise import WhiteNoise
from isac_rt.simulation.simulate import run
from isac_rt.world.swarm import Pose

SCENES = Path(__file__).parents[2] / "scenes"
POSE = Pose.at_rest(boresight=[0.1, 1.0, 0.05])

HEARD = ReceiveArray(POSE, ANTENNAS), Reference(0.0)


def sender(w: Waveform, name: str, seed: int, **more) -> Transmission:
    rng = np.random.default_rng(seed)
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    return Transmission(
        name=name,
        pose=POSE,
        antennas=ANTENNAS,
        schedule=schedule,
        payload=random_payload(w, schedule, 8, rng),
        **more,
    )


def paths(w: Waveform, name: str, count: int, seed: int, speed: float = 15.0) -> PathSet:
    """Anywhere in the passband, |u| up to 0.87, one of eleven born in the frame."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = np.radians(rng.uniform(-60, 60, (2, count)))
    u = np.stack(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ],
        axis=1,
    )
    born = np.where(np.arange(count) % 11 == 3, w.slot_duration - w.frame_duration / 2, -np.inf)
    return make_paths(
        epoch=w.frame_duration / 2,
        tx=name,
        rx="A",
        gain=rng.normal(size=count) + 1j * rng.normal(size=count),
        delay=rng.uniform(0.003, 0.997, count) * w.max_delay,
        delay_rate=2 * rng.uniform(-speed, speed, count) / SPEED_OF_LIGHT,
        delay_accel=rng.normal(size=count) * 20 / SPEED_OF_LIGHT,
        departure=u,
        arrival=u,
        tx_radius=np.inf,
        rx_radius=np.inf,
        kind=PathKind.DIFFUSE,
        begin=born,
    )


def both(w: Waveform, links: list, cells: int, setting) -> tuple[np.ndarray, np.ndarray]:
    """Profiles made directly, and exact samples transformed."""
    own = links[0][0].payload
    found = range_profiles(w, links, *HEARD, own, num_cells=cells, setting=setting)
    cube = if_signal(w, links, *HEARD, Exact())
    return found.spectra, clean_spectrum(cube, Known.of(cube, own, ANTENNAS, 2), cells)


def relative(found, truth):
    return np.linalg.norm(found - truth) / np.linalg.norm(truth)


@pytest.mark.parametrize(("setting", "bound"), [(PROFILES, GRIDDED_ERROR), (ACCURATE, 1e-5)])
@pytest.mark.parametrize("cells", [512, 217])
def test_profiles_are_transforms_of_the_exact_samples(setting, bound, cells):
    """Own data and another terminal's, whose chirps come 0.7 cells late. The bounds:
    `GRIDDED_ERROR`; what is cut of tails. Planted bug: the window's own start left out of a chirp's
    origin (`middle` without `start`)."""
    w = replace(Waveform(filter_transition=0.41e6), num_chirps=9)
    links = [
        (sender(w, "A", 1), paths(w, "A", 30, 2)),
        (sender(w, "B", 3, clock_offset=0.7 * w.delay_step), paths(w, "B", 7, 4)),
    ]
    found, truth = both(w, links, cells, setting)
    assert relative(found, truth) < bound


def test_paths_below_the_first_cell_leave_their_tails():
    """A beat just under zero, which the filter's skirt lets pass: its tail is in the first cells.
    Planted bug: `pad` of 0, which takes such a path for one at the far end."""
    w = replace(Waveform(filter_transition=0.41e6), num_chirps=9)
    low = paths(w, "A", 5, 6)
    low = replace(low, delay=np.array([-0.9, -0.4, 0.3, 0.8, 1.6]) * w.delay_step)
    found, truth = both(
        w, [(sender(w, "A", 1, clock_offset=0.2 * w.delay_step), low)], 512, ACCURATE
    )
    assert (
        relative(found, truth) < 1e-5
    )  # the settings', and tails that are cut 32 cells away (1e-5 of a path, in few cells)


def test_paths_of_the_last_cells_leave_their_tails_too():
    """Beats just under the sampling rate, which small delay symbols let through: samples have them
    below zero, so that their tails lie in the first cells, with the phase of the window's place.
    The bound: tails cut 32 cells away, 1e-5 of a path. Planted bug: a folded path without its turn,
    `cycles` left as they are (0.54)."""
    w = replace(Waveform(filter_transition=0.41e6), num_chirps=9)
    own = sender(w, "A", 1)
    small = replace(own.payload, delay_symbols=own.payload.delay_symbols % 16)
    high = paths(w, "A", 4, 6)
    high = replace(high, delay=w.max_delay - np.array([0.6, 1.4, 2.7, 5.3]) * w.delay_step)
    ordinary = replace(paths(w, "A", 1, 7), delay=np.array([0.37 * w.max_delay]))
    found, truth = both(
        w,
        [(replace(own, payload=small), high), (replace(own, payload=small), ordinary)],
        512,
        ACCURATE,
    )
    assert relative(found, truth) < 1e-5


def test_a_sky_without_paths_and_too_many_cells():
    w = replace(Waveform(filter_transition=0.41e6), num_chirps=9, num_samples=180)
    links = [(sender(w, "A", 1), paths(w, "A", 0, 2))]
    assert not both(w, links, 90, PROFILES)[0].any()
    with pytest.raises(ValueError, match="three quarters"):
        both(w, links, 136, PROFILES)


def test_noise_is_that_of_windowed_white_samples():
    """Covariance over cells, from 3 x 15 x 12 chirps: the transform of w^2 to 5 sigma /
    sqrt(looks), at lags 0 to 4; white over chirps, receivers and groups. Planted bug: noise of the
    samples' power in the fewer samples of the band."""
    w, power = replace(Waveform(filter_transition=0.41e6), num_chirps=12), 1.7e-3
    silent = [(sender(w, "A", 1), paths(w, "A", 0, 2))]
    noise = WhiteNoise(power, np.array([5, 9], np.uint32))
    own = silent[0][0].payload
    y = range_profiles(w, silent, *HEARD, own, noise=noise).spectra.astype(complex)
    square = hann(np.arange(w.num_samples), w.window_length) ** 2
    for lag in range(5):
        truth = (
            power
            * (square * np.exp(-2j * np.pi * lag * np.arange(w.num_samples) / w.num_samples)).sum()
        )
        products = y[:, :, lag:] * y[:, :, : y.shape[2] - lag].conj()
        # neighbouring cells are correlated: a third of the products count as independent
        assert abs(products.mean() - truth) < 5 * power * square.sum() / np.sqrt(products.size / 3)
    scale, count = power * square.sum(), y[:, :, ::4].size
    for other in (np.roll(y, 1, axis=3), np.roll(y, 1, axis=1), np.roll(y, 1, axis=0)):
        assert abs((y * other.conj())[:, :, ::4].mean()) < 5 * scale / np.sqrt(count)


def test_the_active_terminal_makes_the_same_of_both():
    """Detections from profiles and from samples, with noise 107 dB under the strongest path's cell:
    the same paths, estimates apart by the noise (1e-5 cells) and the error of the method. Planted
    bug: `turn` of the cells with the other sign."""
    w = Waveform(filter_transition=0.41e6)
    few = paths(w, "A", 4, 8, speed=5.0)
    delay, gain = (
        np.array([41.3, 77.8, 120.1, 200.6]) * w.delay_step,
        np.array([1, 0.7j, -0.5, 0.4]),
    )
    few = replace(few, delay=delay, gain=gain, begin=np.full(4, -np.inf))
    link = [(sender(w, "A", 1), few)]
    own, noise = link[0][0].payload, WhiteNoise(1e-4, np.array([3, 4], np.uint32))
    samples = add_noise(if_signal(w, link, *HEARD, Auto(noise.power)), *noise)
    settings = Receivers(velocity_method="latin_union")
    profiles = range_profiles(w, link, *HEARD, own, noise=noise)
    a = receive_active(profiles, own, ANTENNAS, settings, maps=True)
    b = receive_active(samples, own, ANTENNAS, settings)
    assert len(b.detections) == 4
    np.testing.assert_allclose(a.detections.range, b.detections.range, atol=1e-4 * w.range_cell(2))
    np.testing.assert_allclose(
        a.detections.velocity, b.detections.velocity, atol=1e-4 * w.velocity_cell(2)
    )
    np.testing.assert_allclose(a.detections.direction, b.detections.direction, atol=1e-4)
    assert a.maps.equivalent_range.size == 0


def test_a_run_on_profiles():
    """The active terminal finds all targets; its picture before data removal is absent, the passive
    terminals' are there. Planted bug: `Frame.heard` that gives everybody samples."""
    options = ["receivers.active_input=profiles", "modulation.acquisition_frames=2"]
    scenario = load(SCENES / "paper_swarm_consistent.yaml", options, frames=3)
    results = run(scenario, snapshots=1)
    assert results.summary["terminals"]["AT"]["hit_rate"] == 1.0
    before = np.isfinite(results.dataset.map_equivalent_range.values).any(axis=(0, 2, 3))
    assert before.tolist() == [
        not name.startswith("AT->AT") and name != "AT" for name in results.dataset.observer.values
    ]


def test_joint_refinement_needs_samples():
    """Planted bug: `problems` of the receivers left out, so that such a run refines locally without
    a word."""
    with pytest.raises(ScenarioError, match="joint refinement needs samples"):
        load(
            SCENES / "paper_swarm_consistent.yaml",
            ["receivers.active_input=profiles", "receivers.refinement=joint"],
        )
