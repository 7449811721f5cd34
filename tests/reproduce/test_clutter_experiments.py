"""The clutter experiments' own pieces: statistics against closed forms, symbol counts against the
formula, what is left out, thresholds."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.types import ExpectedClutter
from isac_rt.world.swarm import Pose
from reproduce.clutter import (
    PT_SNR,
    Bench,
    Kind,
    _found,
    earlier,
    pt_errors,
    resting,
    strongest_mean,
    without_weakest,
)
from reproduce.clutter_statistics import statistics
from reproduce.detectors import RATE, Tally, summarise

W = Waveform()


def test_statistics_of_even_clutter_with_two_speeds():
    """One level over all of 20 to 100 m, half of each cell's power receding at 3 m/s and half
    closing: rms 3 m/s, two Doppler cells, correlation |cos(4 pi v T/lambda)|, fourth moment 2.
    Planted bugs: one-way Doppler, power not squared in the moment."""
    cells = np.repeat(np.arange(60, 420), 2)
    n, v = cells.size, np.tile([3.0, -3.0], cells.size // 2)
    clutter = ExpectedClutter(
        cells * W.delay_step,
        2 * v / SPEED_OF_LIGHT,
        np.full(n, 2.5e-9),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
    )
    found = statistics(clutter, W, 1.0, 1.0)
    assert found["fourth_moment"] == pytest.approx(2, rel=1e-9)
    assert found["doppler_rms_mps"] == pytest.approx(3, rel=1e-9)
    assert found["doppler_cells"] == 2
    assert found["cells_within_20_db"] == 360
    turn = np.cos(4 * np.pi * 3 * W.frame_duration * W.effective_carrier / SPEED_OF_LIGHT)
    assert found["frame_correlation"] == pytest.approx(abs(turn), rel=1e-6)
    sigma, r = 10 ** (-12.81 / 10), np.arange(81, 400) * SPEED_OF_LIGHT * W.delay_step / 2
    uav = (W.wavelength**2 * sigma) / ((4 * np.pi) ** 3 * r**4)
    assert found["level_over_uav_db"] == pytest.approx(
        np.median(10 * np.log10(5e-9 / uav)), abs=0.1
    )


def test_symbols_without_clutter_have_the_known_error_rate():
    """One frame at the paper's settings: none wrong from -22 dB on, delay symbols at -32 dB near
    the independent prototype's 0.82 (0.70 to 0.95 of 120). Planted bug: known phase left out of the
    DPSK decision."""
    antennas = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * W.wavelength)
    schedule = pseudo_random_schedule(3, 120, 3, np.random.default_rng(2))
    pose = Pose.at_rest()

    def flying(place: str, speed: float) -> Pose:
        return Pose(pose.position, np.array([0.0, speed, 0.0]), np.zeros(3), pose.rotation)

    setup = SimpleNamespace(waveform=W, antennas=antennas, schedule=schedule)
    scenes = SimpleNamespace(setup=setup, epoch=W.frame_duration / 2, pose=flying)
    wrong = pt_errors(Bench(scenes, 4), Kind("gaussian", 0.0), False, 0)
    high = PT_SNR >= -22
    for name, counts in wrong.items():
        assert (counts[high] == 0).all(), name
    assert 0.70 < wrong["delay", "strongest cell"][0] / 120 < 0.95


def test_run_and_weakest():
    """45 equal cells and a weak floor: their mean is found, the floor is left out, the run is not.
    Planted bug: mean over the whole profile."""
    ranges = np.arange(1, 400) * W.range_cell(2)
    gains = np.where((np.arange(1, 400) >= 100) & (np.arange(1, 400) < 145), 3.0, 0.01)
    paths = resting(ranges, gains, 2, 0.0, np.array([0.0, 1.0, 0.0]))
    assert strongest_mean(paths, W) == pytest.approx(9, rel=1e-6)
    assert len(without_weakest(paths)) == 45


def test_paths_of_some_frames_before():
    """Delay and rate of ways over points at rest, seen in steady flight: closed forms at both
    times; the third derivative of the distance, 3 v^3/r^2 at most, leaves a micrometre. Planted
    bugs: later in place of earlier; the half of the acceleration's term left out."""
    rng = np.random.default_rng(5)
    points, place, v = (
        rng.uniform((-90, -90, 60), (90, 90, 240), (40, 3)),
        np.array([3.1, -2.2, 1.7]),
        np.array([7.7, -5.1, 3.3]),
    )
    ago = 0.0071

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        span = place + v * t - points
        return np.linalg.norm(span, axis=1), span @ v / np.linalg.norm(span, axis=1)

    (r, rate), (r_before, rate_before) = at(0.0), at(-ago)
    ways = resting(r, np.ones(40), 2, 0.3, np.array([0.0, 1.0, 0.0]))
    ways = replace(
        ways,
        delay_rate=2 * rate / SPEED_OF_LIGHT,
        delay_accel=2 * (v @ v - rate**2) / r / SPEED_OF_LIGHT,
    )
    before = earlier(ways, ago)
    assert (
        np.abs(before.delay * SPEED_OF_LIGHT / 2 - r_before).max()
        < 3 * (v @ v) ** 1.5 / r.min() ** 2 * ago**3 / 6
    )
    assert (
        np.abs(before.delay_rate * SPEED_OF_LIGHT / 2 - rate_before).max()
        < 3 * (v @ v) ** 1.5 / r.min() ** 2 * ago**2 / 2
    )
    np.testing.assert_array_equal(before.gain, ways.gain)


def test_false_alarms_are_counted_where_no_target_is():
    """Crossings in noise of one level far from three targets, all of which are found; crossings in
    their rows count for nothing. Planted bug: rows near targets counted."""
    maps = np.full((4, 3, 120, 60), 1.0 + 0j, np.complex64)
    targets = np.array([[30, 10], [60, 59], [90, 31]])
    alarms = np.array([[5 + 11 * k, 7 * k % 60] for k in range(10)])
    alarms = alarms[np.abs(alarms[:, :1] - targets[:, 0]).min(axis=1) > 4]
    for row, column in [*targets, *alarms, (31, 40), (62, 20)]:
        maps[:, :, row, (column + 30) % 60] = (
            3.0  # zero Doppler is in the middle of the map that targets are told in
        )
    hits, crossed, free = _found(maps, targets)
    assert hits == 3 and crossed == len(alarms) > 5
    assert free == (120 - 3 * 9) * 60


def test_thresholds_are_scaled_on_one_frame_and_counted_on_the_other():
    """Exponential ratios: the scale is -ln(RATE) of the tuning frame's mean, and the other frame's
    rate is its own. Planted bug: counted on the tuning frame."""
    rng = np.random.default_rng(1)
    tally = Tally(
        [rng.exponential(size=400_000)],
        [rng.exponential(2.0, 400_000)],
        [np.array([0.0, 100.0, 100.0, 0.0])],
    )
    targets = pd.DataFrame(
        {"clutter_db": [25.0, 30.0, 0.0, -5.0], "speed_mps": [0.0, 10.0, 0.0, 10.0]}
    )
    table, hits = summarise({"x": tally}, targets)
    assert table.scale["x"] == pytest.approx(-np.log(RATE), rel=0.03)
    assert table.rate["x"] == pytest.approx(np.sqrt(RATE), rel=0.05)
    assert table.pd["x"] == 0.5 and table.pd_strong["x"] == 0.5 and table.pd_strong_moving["x"] == 1
    assert hits["x"].tolist() == [False, True, True, False]
