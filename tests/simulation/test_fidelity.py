"""Decisions of the budget and their bounds: each bound against a truth that is computed without
it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isac_rt.frame.antennas import antennas_of
from isac_rt.frame.schedule import schedule_of
from isac_rt.frame.waveform import SPEED_OF_LIGHT, waveform_of
from isac_rt.propagation import PathKind, PathSet, make_paths
from isac_rt.randomness import generator
from isac_rt.scenario.file import load
from isac_rt.signal.tones import sources
from isac_rt.simulation.plan import (
    Plan,
    faintest,
    frame_reach,
    missed_paths,
    plane_bound,
    straight_bound,
)
from isac_rt.simulation.setup import plan_of as plan_of_scenario
from isac_rt.simulation.setup import swarm_of, timetable_of

SCENES = Path(__file__).parents[2] / "scenes"
K_MIDDLE = 2 * np.pi * 77.32e9 / SPEED_OF_LIGHT  # of the middle of the sweep [rad/m]


def plan_of(scene: str = "paper_swarm_consistent.yaml", *overrides: str) -> Plan:
    s = load(SCENES / scene, overrides)
    w = waveform_of(s.radio, s.array)
    timetable = timetable_of(s, w, schedule_of(s.array.schedule, w, generator(s.seed, "schedule")))
    return plan_of_scenario(s, antennas_of(s.array, w), timetable, swarm_of(s))


def some_paths(count: int, seed: int, **changes) -> PathSet:
    """Random paths of the city."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((2, count, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    radius = rng.uniform(3.0, 90.0, (2, count))
    values = {
        "gain": rng.standard_normal(count) * 1e-6 + 1j * rng.standard_normal(count) * 1e-6,
        "delay": radius.sum(axis=0) / SPEED_OF_LIGHT,
        "delay_rate": rng.uniform(-12, 12, count) / SPEED_OF_LIGHT,
        "delay_accel": rng.uniform(-9, 9, count) / SPEED_OF_LIGHT,
        "departure": directions[0],
        "arrival": directions[1],
        "tx_radius": radius[0],
        "rx_radius": radius[1],
        "kind": PathKind.SPECULAR,
        "epoch": 0.3,
        "tx": "AT",
        "rx": "PT1",
    } | changes
    return make_paths(**values)


def test_a_plane_wavefront_errs_by_no_more_than_its_bound():
    """Truth: distances of every pair of elements of the two arrays, one point source each, against
    the plane wave. The bound holds everywhere and is within ten of the truth in nine paths of ten.
    Planted bug: r for r^2 in the bound, or the radius squared."""
    plan = plan_of()
    a = plan.antennas
    paths = some_paths(400, 7)
    truth = np.zeros(len(paths))
    for positions, direction, radius in (
        (a.tx_positions, paths.departure, paths.tx_radius),
        (a.rx_positions, paths.arrival, paths.rx_radius),
    ):
        source = (direction * radius[:, None]).astype(np.longdouble)
        exact = (
            np.linalg.norm(source[:, None] - positions, axis=2).astype(np.longdouble)
            - radius[:, None]
        )
        truth += np.abs(exact + direction @ positions.T).max(axis=1).astype(float) * K_MIDDLE
    bound = plane_bound(paths, a, plan.waveform)
    assert (truth <= bound).all()
    assert np.mean(bound <= 10 * truth) >= 0.9


def test_a_line_of_sight_seen_plane_errs_by_no_more_than_its_bound():
    """Truth: the distance of every transmit element from every receive element. Planted bug: the
    joint term left out."""
    plan = plan_of()
    a = plan.antennas
    rng = np.random.default_rng(11)
    paths = some_paths(300, 11, kind=PathKind.LINE_OF_SIGHT)
    length = rng.uniform(2.0, 80.0, len(paths))
    u = paths.departure
    paths = replace(paths, tx_radius=length, rx_radius=length, arrival=-u)
    turn = np.linalg.qr(rng.standard_normal((len(paths), 3, 3)))[0]  # the receiver's attitude
    tx, rx = a.tx_positions, np.einsum("kij,rj->kri", turn, a.rx_positions)
    span = (length[:, None] * u)[:, None, None] + rx[:, None] - tx[None, :, None]
    exact = np.linalg.norm(span, axis=3) - length[:, None, None]
    plane = -(u @ tx.T)[:, :, None] + np.einsum("ki,kri->kr", u, rx)[:, None]
    truth = np.abs(exact - plane).max(axis=(1, 2)) * K_MIDDLE
    bound = plane_bound(paths, a, plan.waveform)
    assert (truth <= bound).all()
    assert np.mean(bound <= 10 * truth) >= 0.9


def test_flight_taken_as_straight_errs_by_no_more_than_its_bound():
    """Truth: distances to a body that flies a circle of 9 m radius at 8 m/s, over the chirps of a
    frame, against the tangent. Planted bug: half a frame for the whole reach, which the groups
    prolong."""
    plan = plan_of()
    w = plan.waveform
    t = np.linspace(-1, 1, 41) * frame_reach(w)
    turn = 8.0 / 9.0
    for phase in np.linspace(0.1, 6.2, 23):

        def distance(time, phase=phase):
            angle = phase + turn * time
            return np.hypot(31.7 + 9 * np.cos(angle), -14.1 + 9 * np.sin(angle))

        h = 1e-3
        rate = (distance(h) - distance(-h)) / (2 * h)
        accel = (distance(h) - 2 * distance(0.0) + distance(-h)) / h**2
        truth = 2 * np.abs(distance(t) - distance(0.0) - rate * t).max() * K_MIDDLE
        one = some_paths(
            1, 3, delay_rate=2 * rate / SPEED_OF_LIGHT, delay_accel=2 * accel / SPEED_OF_LIGHT
        )
        bound = float(straight_bound(one, w)[0])
        assert truth <= bound * 1.01 + 1e-4  # the jerk, which is not in the bound
        assert bound <= 10 * truth + 1e-3


@pytest.mark.parametrize("limit", [0.0, 2.9, 41.0])
def test_the_faintest_are_left_out_and_no_cell_loses_more_than_the_limit(limit):
    """By brute force, cell by cell. Planted bug: one running sum over all cells."""
    rng = np.random.default_rng(5)
    power, cell = rng.exponential(3.0, 500), rng.integers(-3, 40, 500)
    power[rng.integers(0, 500, 60)] = np.inf
    mask, most = faintest(power, cell, limit)
    largest = 0.0
    for c in np.unique(cell):
        here = np.flatnonzero(cell == c)
        lost, total = set(), 0.0
        for i in here[np.argsort(power[here])]:
            if total + power[i] > limit:
                break
            total += power[i]
            lost.add(int(i))
        assert set(here[mask[here]].tolist()) == lost
        largest = max(largest, total)
    assert most == pytest.approx(largest, rel=1e-12, abs=0)
    assert faintest(np.zeros(0), np.zeros(0, int), limit)[1] == 0.0


def test_what_is_out_of_reach_is_what_the_synthesis_cannot_hear():
    """`longest_delay` against the filter as the kernels know it (`synthesis.sources`), with every
    data delay. Planted bug: the groups' offsets left out, which put a mirror image 2 T_d late into
    the next group."""
    plan = plan_of("paper_swarm_consistent.yaml", "accuracy.preset=budget")
    w = plan.waveform
    late = plan.longest_delay + np.linspace(-0.9, 0.9, 60) * w.max_delay
    paths = some_paths(60, 2, delay=late, delay_rate=0.0, delay_accel=0.0)
    kept, use = plan.apply(paths, 1e-30)

    class Tones:
        rate = accel = np.zeros(60)
        delay = late
        symbol_delay = np.array([0.0, w.max_delay / 2])

    heard = np.unique(sources(w, Tones)[0])
    assert set(kept.delay) == set(late[heard])
    assert use.unheard == 60 - heard.size


def test_what_a_cell_loses_stays_under_the_noise_by_the_budget():
    """A hundred equal paths in one cell, each a tenth of the limit: ten go, not all. Planted bug:
    paths judged one by one."""
    plan = plan_of("munich_swarm.yaml", "propagation.weakest_path_db=20", "noise.tx_power_dbm=30")
    w = plan.waveform
    noise = 3.7e-13
    gain = np.sqrt(1e-2 * noise / (w.num_samples * w.num_chirps) / 10.0001)
    paths = some_paths(100, 4, gain=np.full(100, gain), delay=np.full(100, 3.2e-7), delay_rate=0.0)
    kept, use = plan.apply(paths, noise)
    assert len(kept) == 90
    assert use.weak == 10
    assert use.left_out == pytest.approx(1e-2, rel=1e-3, abs=0)


def test_approximations_go_where_their_bounds_allow_and_nowhere_else():
    """Planted bug: the bound of the paths that keep their wavefront reported."""
    plan = plan_of("paper_swarm_consistent.yaml", "accuracy.max_phase_error_rad=0.031")
    paths = some_paths(200, 9)
    kept, use = plan.apply(paths, 1e-30)
    plane, straight = np.isinf(kept.rx_radius), kept.delay_accel == 0
    assert 0 < plane.sum() < len(kept)
    assert 0 < straight.sum() < len(kept)
    assert np.array_equal(plane, plane_bound(paths, plan.antennas, plan.waveform) <= 0.0155)
    assert np.array_equal(straight, straight_bound(paths, plan.waveform) <= 0.0155)
    assert (use.plane, use.straight) == (plane.sum(), straight.sum())
    assert use.plane_error <= 0.0155 >= use.straight_error


def test_everything_leaves_nothing_out_and_fastest_does_what_it_can():
    """Planted bug: the preset everything with the budget's threshold for weak paths."""
    paths = some_paths(120, 6)
    for noise in (1e-30, 1e10):
        kept, use = plan_of("paper_swarm_consistent.yaml", "accuracy.preset=everything").apply(
            paths, noise
        )
        assert len(kept) == 120
        assert np.array_equal(kept.rx_radius, paths.rx_radius)
        assert np.array_equal(kept.delay_accel, paths.delay_accel)
        assert use.left_out == use.plane_error == use.straight_error == 0
    kept, _ = plan_of("paper_swarm_consistent.yaml", "accuracy.preset=fastest").apply(paths, 1e-30)
    assert np.isinf(kept.tx_radius).all()
    assert not kept.delay_accel.any()


@pytest.mark.sionna
def test_knots_lie_as_far_apart_as_the_plan_says():
    """Along waypoints no terminal flies farther between two knots than the limit, nor much less;
    the presets have limits of their own. Planted bug: the flight's own spacing."""
    from isac_rt.propagation.clutter.sight import Flight

    plan = plan_of("munich_swarm.yaml", "accuracy.max_untraced_m=1.7")
    assert plan.max_untraced == 1.7
    for name in plan.swarm.terminals:
        flight = Flight(plan.swarm.trajectories[name], plan.swarm.duration, np.zeros(3), 1.7)
        apart = np.linalg.norm(np.diff(flight.knots, axis=0), axis=1)
        assert 1.5 < apart.min() and apart.max() <= 1.7
    limits = {"everything": 0.0, "fastest": 4.0}
    for preset, limit in limits.items():
        assert plan_of("munich_swarm.yaml", f"accuracy.preset={preset}").max_untraced == limit


def test_what_two_searches_missed_is_as_much_as_said():
    """Truth: 4000 frames of 30 paths each, which two searches find with chances of 0.9 and 0.7,
    independently: 0.03 of the paths are missed. Tolerance: 4 sigma of the count. Planted bug: the
    paths found by both counted twice."""
    rng = np.random.default_rng(17)
    even, odd = rng.random((2, 4000 * 30)) < np.array([[0.9], [0.7]])
    counts = (even & ~odd).sum(), (odd & ~even).sum(), (even & odd).sum()
    missed = int((~even & ~odd).sum())
    assert missed_paths(*map(float, counts)) == pytest.approx(missed, abs=4 * np.sqrt(missed))
