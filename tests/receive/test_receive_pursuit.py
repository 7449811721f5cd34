"""Matching pursuit off the grid beside the paper's OMP and a slow pursuit on the same samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, known

from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive import pursuit
from isac_rt.receive.active import receive_active
from isac_rt.receive.chain import passive_detector_of
from isac_rt.receive.estimate import Estimate, LocalSpectra
from isac_rt.receive.pursuit import Pursuit, _add, _Path, _subtract
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum

FEW = replace(ANTENNAS, rx_x=3, rx_z=3)
W = Waveform(num_samples=256, num_groups=1)


def received(paths: list[Path], method: str, noise: float, seed: int = 5):
    schedule = pseudo_random_schedule(1, W.num_chirps, 3, np.random.default_rng(seed))
    payload = random_payload(W, schedule, 8, np.random.default_rng(seed + 1))
    signal = cube(W, schedule, payload, paths, FEW, noise=noise, seed=seed)
    return receive_active(signal, payload, FEW, Receivers(velocity_method=method)).detections


@pytest.mark.parametrize("ratio_db", [26.0, 40.0])
def test_a_weak_path_in_the_row_of_a_strong_one(ratio_db: float):
    """Off the grid, one group, that is a third of the samples. OMP on the grid loses the weak path;
    pursuit finds both at their places and nothing else. Planted bug: the orthogonal step left out
    (twenty detections)."""
    strong, weak, u, v = (18.43, 9.71), (18.47, -21.3), (0.45, -0.31), (-0.2, 0.1)
    amplitude = 10 ** (ratio_db / 20)
    paths = [
        Path(2 * strong[0], 2 * strong[1], amplitude, u, u),
        Path(2 * weak[0], 2 * weak[1], 1.0, v, v),
    ]
    d = received(paths, "auto", noise=1.0)
    assert len(d) == 2
    for i, (r, rate) in enumerate((strong, weak)):
        assert abs(d.range[i] - r) < 0.1 * W.range_cell(2) and abs(
            d.velocity[i] - rate
        ) < 0.1 * W.velocity_cell(2)
    assert np.abs(d.direction[1] - v).max() < 0.05
    plain = received(paths, "omp", noise=1.0)
    assert not (np.abs(plain.velocity - weak[1]) < W.velocity_cell(2)).any()


@pytest.mark.parametrize("passes", [2, 1])
def test_a_path_is_taken_out_whole_and_put_back(passes: int):
    """An exact path, off all grids, moving, with data, leaves a thousandth of itself in the rows
    that it reaches; put back it is there again. Planted bugs: the elements' delays left out, or
    those of the transmitters at a PT taken in; time without the data; the middle of the
    window for its start."""
    schedule = pseudo_random_schedule(1, W.num_chirps, 3, np.random.default_rng(5))
    payload = random_payload(W, schedule, 8, np.random.default_rng(6))
    path = Path(
        43.817, 21.3, 0.7 - 0.4j, (0.45, -0.31), (0.45, -0.31) if passes == 2 else (-0.2, 0.1)
    )
    chirps = known(W, schedule, payload, FEW, passes)
    spectra = clean_spectrum(cube(W, schedule, payload, [path], FEW), chirps, 128)
    k = 2 * np.pi * W.effective_carrier / SPEED_OF_LIGHT
    sent, received = (
        np.exp(1j * k * places[:, [0, 2]] @ u)
        for places, u in (
            (FEW.tx_positions, np.array(path.departure)),
            (FEW.rx_positions, np.array(path.arrival)),
        )
    )
    near = LocalSpectra(spectra, chirps, round(43.817 / W.range_cell(1)))
    delay, rate = 43.817 / SPEED_OF_LIGHT, 21.3 / SPEED_OF_LIGHT
    exact = Estimate(delay, rate, near.respond(delay, rate))
    turned = (
        exact.channels * np.outer(sent, received).conj()
        if passes == 2
        else exact.channels * received.conj()
    )
    assert np.abs(np.abs(turned) - abs(path.amplitude)).max() < 0.02
    left, whole = spectra.copy(), _Path(exact, 1.0, 1.0)
    _subtract(left, whole, chirps, 1e-12)
    assert whole.rows[1] - whole.rows[0] == 49
    assert (
        np.abs(left).max() < 3e-3 * np.abs(spectra).max()
    )  # the wavefront is plane here and spherical there
    _add(left, whole, chirps, 1.0)
    assert np.abs(left - spectra).max() < 1e-6 * np.abs(spectra).max()
    # 40 dB over the noise it is felt in fewer rows, and leaves less than a hundredth of the noise
    power = np.abs(left) ** 2
    noise = 1e-4 * float(power.max())
    less = _Path(exact, float(power.max()), 1.0)
    _subtract(left, less, chirps, noise)
    assert less.rows[1] - less.rows[0] < 29
    outside = np.ones(len(left[0, 0]), bool)
    outside[slice(*less.rows)] = False
    assert (np.abs(left[:, :, outside]) ** 2).max() < 0.01 * noise


def test_noise_and_one_path_are_left_as_they_are():
    """No remainder of a path 50 dB over the noise of a sample is reported, and nothing in noise
    alone."""
    for seed in range(2):
        assert len(received([], "auto", 1.0, seed)) == 0
        assert (
            len(
                received(
                    [Path(2 * 13.31, -17.7, 10**2.5, (0.6, 0.3), (0.6, 0.3))], "auto", 1.0, seed
                )
            )
            == 1
        )


def scene(seed: int, groups: int, count: int):
    """Cleaned spectra of paths over 25 dB, half of them in one range row, and what is known."""
    w, rng = Waveform(num_samples=256, num_groups=groups), np.random.default_rng([seed, groups])
    schedule = pseudo_random_schedule(groups, w.num_chirps, 3, rng)
    payload = random_payload(w, schedule, 8, rng)
    paths = []
    for i in range(count):
        u = (float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-0.5, 0.5)))
        row = rng.uniform(10, 60) if i % 2 else 30 + rng.uniform(-0.3, 0.3)
        level = 10 ** (rng.uniform(-10, 15) / 20) * np.exp(2j * np.pi * rng.random())
        rate = 2 * w.max_velocity(2) * rng.uniform(-0.9, 0.9)
        paths.append(Path(2 * row * w.range_cell(2), rate, level, u, u))
    chirps = known(w, schedule, payload, FEW)
    signal = cube(w, schedule, payload, paths, FEW, noise=10.0, seed=seed)
    return clean_spectrum(signal, chirps), chirps, paths


@pytest.mark.parametrize("groups", [1, 2])
def test_alarms_in_noise_come_at_the_rate_of_the_design(groups: int):
    """Through the default receiver, 24 frames and 147,456 cells at 1e-3: 147 alarms are expected,
    of which neighbours count once; within a factor 1.5. Planted bug: OMP's support asked besides
    (a quarter)."""
    w = Waveform(num_samples=256, num_chirps=48, num_groups=groups)
    three, alarms = replace(ANTENNAS, rx_x=2, rx_z=2), 0
    settings = Receivers(false_alarm_rate=1e-3, min_range_m=0, max_detections=1000)
    for seed in range(24):
        rng = np.random.default_rng([seed, groups, 7])
        schedule = pseudo_random_schedule(groups, 48, 3, rng)
        payload = random_payload(w, schedule, 8, rng)
        signal = cube(w, schedule, payload, [], three, noise=1.0, seed=seed)
        chirps = known(w, schedule, payload, three, 1)
        spectra = clean_spectrum(signal, chirps)
        alarms += len(passive_detector_of(settings).sense(spectra, chirps).detections)
    assert 147.456 / 1.5 < alarms < 147.456 * 1.5


def test_work_grows_with_the_paths_that_touch(monkeypatch: pytest.MonkeyPatch):
    """Seven paths apart in range are estimated once each, though they share velocities; of two that
    share a row of one group's sparse sampling both are estimated again. Planted bug: all within six
    rows."""
    calls = []

    def counted(local, delay, rate, steps=None):
        calls.append(delay)
        return refine(local, delay, rate, *([] if steps is None else [steps]))

    refine = pursuit.refine
    monkeypatch.setattr(pursuit, "refine", counted)
    for groups, rows, velocities, expected in (
        (3, 12 + 14.3 * np.arange(7), np.full(7, 3.1), range(7, 8)),
        (3, np.full(2, 31.2), np.array([-31.0, 27.3]), range(2, 3)),
        (1, np.full(2, 31.2), np.array([-31.0, 27.3]), range(4, 2 + 2 * pursuit.CYCLES)),
    ):
        w = Waveform(num_samples=256, num_groups=groups)
        schedule = pseudo_random_schedule(groups, w.num_chirps, 3, np.random.default_rng(3))
        payload = random_payload(w, schedule, 8, np.random.default_rng(4))
        paths = [
            Path(2 * r * w.range_cell(2), 2 * v, 1.0, (0.1, 0.2), (0.1, 0.2))
            for r, v in zip(rows, velocities, strict=True)
        ]
        chirps = known(w, schedule, payload, FEW)
        signal = cube(w, schedule, payload, paths, FEW, noise=10.0)
        calls.clear()
        found = Pursuit(Receivers()).sense(clean_spectrum(signal, chirps), chirps)
        assert len(found.detections) == len(rows)
        assert len(calls) in expected
