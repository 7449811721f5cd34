"""Scores on hand-made cases."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.stats import binom

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.types import Detections, Reception
from isac_rt.results.metrics import (
    ERROR_KEYS,
    SensingScore,
    SymbolCount,
    Truth,
    associate,
    binomial_interval,
    count_symbols,
    explain,
    gospa,
    resolutions,
    summary_block,
    truth_of,
)
from isac_rt.terminal.tracker import TrackSet
from isac_rt.world.swarm import Pose, attitude

WAVEFORM = Waveform()
ANTENNAS = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * WAVEFORM.wavelength)
SMALL = Waveform(num_samples=64, num_chirps=12, num_groups=2)
RESOLUTION = np.array([0.25, 0.25, 0.108, 0.108])


def pose(position, velocity, boresight=(0.0, 1.0, 0.0)) -> Pose:
    return Pose(
        np.array(position, float),
        np.array(velocity, float),
        np.zeros(3),
        attitude(np.array(boresight)),
    )


def detections(rows) -> Detections:
    z = np.array(rows, float).reshape(-1, 4)
    q = len(z)
    return Detections(
        range=z[:, 0].copy(),
        velocity=z[:, 1].copy(),
        direction=z[:, 2:].copy(),
        snr=np.ones(q),
        std=np.ones((q, 4)),
        is_reference=np.zeros(q, bool),
    )


def truth(r=20.3, v=1.7, u_x=0.31, u_z=-0.12) -> Truth:
    return Truth(
        r, v, u_x, u_z, float(np.arctan2(u_x, np.sqrt(1 - u_x**2 - u_z**2))), float(np.arcsin(u_z))
    )


def test_truth_one_way_and_bistatic():
    """A 3-4-5 triangle in a body frame that looks east; planted bug: azimuth towards -X."""
    observer = pose([1.0, 2.0, 3.0], [0.0, 0.5, 0.0], (1.0, 0.0, 0.0))
    uav = pose([5.0, 5.0, 3.0], [2.0, 0.5, 0.0])
    t = truth_of(observer, uav)
    # east is ahead (Y), south is right (X): 4 m ahead, 3 m to the left
    assert t == pytest.approx((5.0, 1.6, -0.6, 0.0, -np.arctan2(3, 4), 0.0), abs=1e-14)
    at = pose([5.0, 5.0, 15.0], [0.0, 0.0, 2.0])
    t = truth_of(observer, uav, at)
    assert t.range == pytest.approx(17.0) and t.velocity == pytest.approx(1.6 + 2.0)
    assert t.u_x == pytest.approx(-0.6)


def test_truth_rate_is_the_derivative_of_the_length():
    h = 1e-4
    poses = [
        ([1.3, 2.1, 3.7], [3.1, -2.7, 0.9]),
        ([15.1, 25.3, 8.8], [-4.1, 7.3, 1.1]),
        ([-21.7, 9.3, 33.1], [6.1, 2.9, -0.3]),
    ]
    ahead, behind = (
        [pose(np.array(p) + s * h * np.array(v), v) for p, v in poses] for s in (1, -1)
    )
    rate = (truth_of(*ahead).range - truth_of(*behind).range) / (2 * h)
    assert truth_of(*(pose(p, v) for p, v in poses)).velocity == pytest.approx(
        rate, abs=1e-7
    )  # h^2 and 80 m eps / h


def test_resolutions_of_table_one():
    """Published (notes, section 1): cells of range and velocity, and 16 or 8 elements at 0.5774
    wavelengths."""
    assert resolutions(WAVEFORM, ANTENNAS, 2) == pytest.approx(
        [0.24983, 0.249, 0.10824, 0.10824], rel=2e-3
    )
    assert resolutions(WAVEFORM, ANTENNAS, 1) == pytest.approx(
        [0.49965, 0.498, 0.21649, 0.21649], rel=2e-3
    )


def test_association_is_one_to_one_and_gated():
    """The nearest estimate of the first truth is the only one of the second; planted bug: greedy
    choice."""
    truths = [truth(20.0), truth(20.5)]
    rows = [[20.3, 1.7, 0.31, -0.12], [19.6, 1.7, np.nan, np.nan], [40.0, 1.7, 0.31, -0.12]]
    assert sorted(associate(truths, np.array(rows), RESOLUTION)) == [(0, 1), (1, 0)]
    assert associate(truths, np.array([[20.3, 1.7 + 3.1 * 0.25, 0.31, -0.12]]), RESOLUTION) == []
    assert associate([], np.array(rows), RESOLUTION) == []


def test_explain_takes_the_strongest_near_path():
    """Strongest within a cell, velocity modulo the unambiguous span, -1 where none is near; planted
    bug: the nearest path. The face is the first that the path meets, whether a UAV's point comes
    before it or not; planted bug: the first column of the faces."""
    passes, span = 2, 2 * WAVEFORM.max_velocity(2)
    delays = np.array([20.0, 20.2, 33.0, 47.0]) * passes / SPEED_OF_LIGHT
    rates = np.array([1.0, 1.1, span + 3.0, 0.0]) * passes / SPEED_OF_LIGHT
    paths = make_paths(
        gain=np.array([1.0, 3.0j, 0.2, 5.0]),
        delay=delays,
        delay_rate=rates,
        departure=np.tile([0.0, 1.0, 0.0], (4, 1)),
        arrival=np.tile([0.0, 1.0, 0.0], (4, 1)),
        kind=np.array([PathKind.TARGET, PathKind.SPECULAR, PathKind.GHOST, PathKind.DIFFUSE]),
        target=np.array([0, -1, 2, -1]),
        bounces=np.array([0, 1, 2, 1]),
        faces=np.array([[-1, -1, -1], [41, -1, -1], [-1, 17, 5], [8, -1, -1]]),
        points=np.zeros((4, 3, 3)),
        epoch=0.1,
        tx="AT",
        rx="AT",
        target_names=("a", "b", "c"),
    )
    found = detections(
        [[20.05, 1.02, 0, 0], [33.1, 3.1, 0, 0], [47.0, 0.6, 0, 0], [19.8, 0.9, 0, 0]]
    )
    kind, target, order, face = explain(found, paths, WAVEFORM, passes)
    assert kind.tolist() == [PathKind.SPECULAR, PathKind.GHOST, -1, PathKind.TARGET]
    assert target.tolist() == [-1, 2, -1, 0]
    assert order.tolist() == [1, 2, -1, 0] and face.tolist() == [41, 17, -1, -1]


def reception(payload, delay, transitions, bits, decoded=True) -> Reception:
    return Reception(
        detections=detections([]),
        decoded=decoded,
        delay_symbols=delay,
        transitions=transitions,
        bits=bits,
        delay_confidence=np.ones(delay.shape),
        transition_confidence=np.ones(transitions.shape),
        raw_delay_symbols=delay,
        line_of_sight=True,
        reference_power=1.0,
    )


def test_symbol_counts():
    """Two wrong delay symbols of which one is erased, three wrong transitions, four wrong bits; an
    undecoded frame is all errors; a pilot counts nothing. Planted bug: erased symbols left out of
    the errors."""
    schedule = conventional_schedule(2, 12, 3)
    p = random_payload(SMALL, schedule, 8, np.random.default_rng(2))
    delay, transitions, bits = p.delay_symbols.copy(), p.transitions.copy(), p.bits.copy()
    delay[0, 3], delay[1, 7] = -1, (delay[1, 7] + 1) % 32
    transitions[0, 1, :3] = (transitions[0, 1, :3] + 1) % 8
    bits[[1, 5, 9, 20]] ^= 1
    one = count_symbols(p, reception(p, delay, transitions, bits))
    assert one == SymbolCount(24, 2, 1, 18, 3, 0, p.bits.size, 4, p.bits.size, 1)
    blank = np.zeros(0, np.uint8)
    lost = count_symbols(
        p, reception(p, np.full((2, 12), -1), np.full((2, 3, 3), -1), blank, decoded=False)
    )
    assert lost == SymbolCount(24, 24, 24, 18, 18, 18, p.bits.size, p.bits.size, 0, 1)
    pilot = unmodulated(SMALL)
    assert (
        count_symbols(pilot, reception(pilot, delay, transitions, blank, decoded=False))
        == SymbolCount()
    )
    block = summary_block("passive", SensingScore(RESOLUTION), one + lost, duration=0.1)
    assert block["ser_delay"] == pytest.approx(26 / 48) and block["ser_dpsk"] == pytest.approx(
        21 / 36
    )
    assert block["ber"] == pytest.approx((4 + p.bits.size) / (2 * p.bits.size))
    assert block["erased"] == pytest.approx((1 + 24 + 18) / 84)
    assert block["bits"] == p.bits.size and block["bit_rate_bps"] == pytest.approx(
        p.bits.size / 0.1
    )
    assert block["hit_rate"] is None and block["rmse"] == dict.fromkeys(ERROR_KEYS)


def tracks(rows, confirmed) -> TrackSet:
    z, k = np.array(rows, float), len(rows)
    return TrackSet(
        ids=np.arange(k),
        mean=np.zeros((k, 6)),
        covariance=np.zeros((k, 6, 6)),
        range=z[:, 0],
        velocity=z[:, 1],
        direction=z[:, 2:],
        std=np.ones((k, 4)),
        age=np.zeros(k, int),
        confirmed=np.array(confirmed),
        is_reference=np.zeros(k, bool),
        detection=np.full(k, -1),
    )


def test_sensing_score():
    """Frame 1: a hit, one match beyond a resolution, one stray that a path explains and one that
    none does; frame 2: a match without direction. RMS by hand; planted bug: RMS over all
    target-frames."""
    score, first, second = SensingScore(RESOLUTION), truth(20.0, 1.7), truth(50.0, -3.1)
    rows = [
        [20.1, 1.6, 0.31, -0.12],
        [50.5, -3.1, 0.31, -0.12],
        [70.0, 0.0, 0.0, 0.0],
        [90.0, 0.0, 0.0, 0.0],
    ]
    score.add(
        [first, second],
        detections(rows),
        tracks(rows[:2], [True, False]),
        np.array([1, 1, 4, -1], np.int8),
    )
    score.add([first], detections([[20.2, 1.7, np.nan, np.nan]]))
    assert (score.frames, score.target_frames, score.hits, score.matched) == (2, 3, 1, 3)
    assert (score.false, score.clutter, score.matched_tracks) == (1, 1, 1)
    block = summary_block("active", score, None, 1.0)
    assert block["rmse"]["range_m"] == pytest.approx(np.sqrt((0.1**2 + 0.5**2 + 0.2**2) / 3))
    assert block["rmse"]["azimuth_deg"] == pytest.approx(0.0, abs=1e-9)
    assert block["rmse_tracked"]["range_m"] == pytest.approx(0.1)
    assert (
        block["hit_rate"] == pytest.approx(1 / 3)
        and block["matched"] == 1.0
        and block["bits"] is None
    )
    assert block["false_per_frame"] == 0.5 and block["ser_dpsk"] is None
    pooled = SensingScore(RESOLUTION)
    pooled.merge(score)
    pooled.merge(score)
    assert (
        pooled.target_frames == 6
        and pooled.detection_errors.rmse() == score.detection_errors.rmse()
    )


def test_angle_errors_are_in_degrees_of_azimuth_and_elevation():
    azimuth, elevation, score = np.deg2rad(31.0), np.deg2rad(-7.0), SensingScore(RESOLUTION)
    t = Truth(20.0, 1.0, np.sin(azimuth) * np.cos(elevation), np.sin(elevation), azimuth, elevation)
    a, e = azimuth + np.deg2rad(0.4), elevation - np.deg2rad(0.9)
    score.add([t], detections([[20.0, 1.0, np.sin(a) * np.cos(e), np.sin(e)]]))
    rmse = score.detection_errors.rmse()
    assert rmse["azimuth_deg"] == pytest.approx(0.4, abs=1e-9) and rmse[
        "elevation_deg"
    ] == pytest.approx(0.9, abs=1e-9)


def test_gospa_closed_forms():
    """Equal sets, one pair, a pair beyond the cut-off, cardinality alone; then all assignments
    tried one by one. Planted bug: c^2 instead of c^2/2 for a missed target."""
    c, x = 5.0, np.array([[1.3, 2.7, 0.4], [11.1, 3.3, 7.9]])
    assert gospa(x, x[::-1], c).distance == 0.0
    assert gospa(x[:1], x[:1] + np.array([3.0, 0.0, 4.0 - 1e-9]), c).distance == pytest.approx(5.0)
    assert gospa(x[:1], x[:1] + 100.0, c) == pytest.approx((5.0, 0.0, 12.5, 12.5))
    assert gospa(x, np.zeros((0, 3)), c).distance == pytest.approx(np.sqrt(2 * 12.5))
    assert gospa(np.zeros((0, 3)), np.zeros((0, 3)), c).distance == 0.0
    rng = np.random.default_rng(7)
    x, y = rng.normal(0, 4, (3, 3)), rng.normal(0, 4, (4, 3))
    best = min(
        sum(min(np.sum((x[i] - y[j]) ** 2), c**2) for i, j in enumerate(order)) + c**2 / 2
        for order in permutations(range(4), 3)
    )
    assert gospa(x, y, c).distance == pytest.approx(np.sqrt(best))


def test_binomial_interval():
    """Closed form at none of n; elsewhere the tails are what the binomial law says."""
    assert binomial_interval(0, 37) == pytest.approx((0.0, 1 - 0.025 ** (1 / 37)))
    assert binomial_interval(37, 37) == pytest.approx((0.025 ** (1 / 37), 1.0))
    low, high = binomial_interval(11, 53, 0.9)
    assert binom.sf(10, 53, low) == pytest.approx(0.05) and binom.cdf(
        11, 53, high
    ) == pytest.approx(0.05)
