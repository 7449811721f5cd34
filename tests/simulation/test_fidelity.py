"""Decisions of the budget and their bounds: each bound against a truth that is computed without
it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isac_rt.frame.antennas import Arrays, antennas_of
from isac_rt.frame.schedule import schedule_of
from isac_rt.frame.waveform import SPEED_OF_LIGHT, waveform_of
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.randomness import generator
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.exact import filter_gain
from isac_rt.signal.tones import Tones as SynthesisTones
from isac_rt.simulation.plan import (
    Plan,
    faintest,
    frame_reach,
    next_slot_delay,
    plane_bound,
    straight_bound,
    turning_bound,
)
from isac_rt.simulation.setup import plan_of as plan_of_scenario
from isac_rt.simulation.setup import prepare, swarm_of, timetable_of

SCENES = Path(__file__).parents[2] / "scenes"
K_MIDDLE = 2 * np.pi * 77.32e9 / SPEED_OF_LIGHT  # of the middle of the sweep [rad/m]


def plan_of(scene: str = "paper_swarm_consistent.yaml", *overrides: str) -> Plan:
    s = load(SCENES / scene, overrides)
    w = waveform_of(s.radio, s.array)
    timetable = timetable_of(s, w, schedule_of(s.array.schedule, w, generator(s.seed, "schedule")))
    return plan_of_scenario(s, Arrays(antennas_of(s.array, w)), timetable, swarm_of(s))


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
    a = plan.arrays.common
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
    a = plan.arrays.common
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


def near_pass(seed: int) -> Scenario:
    """Three bodies that pass within metres of one another, two of them on curves."""
    rng = np.random.default_rng(seed)
    swarm = {}
    for name, role, y, look in (
        ("A", "active", 0.0, 1),
        ("P", "passive", 5.0, -1),
        ("U", "target", 2.5, 1),
    ):
        steps = rng.normal(0, 1, (3, 3)) * [1.0, 1.0, 0.3] * rng.uniform(0.5, 1.6)
        places = np.array([rng.uniform(-1.5, 1.5), y, 40.0]) + np.cumsum(steps, axis=0) - steps[0]
        swarm[name] = {
            "role": role,
            "rcs": {"model": "constant"},
            "waypoints": [
                {"time_s": t, "position_m": p.tolist()}
                for t, p in zip((-0.07, 0.004, 0.09), places, strict=True)
            ],
        }
        if name != "A":  # which looks where it flies to, and so turns
            swarm[name]["boresight"] = [0, look, 0]
    tree = {
        "swarm": swarm,
        "frames": 2,
        "modulation": {"acquisition_frames": 1},
        "array": {"element_pattern": "isotropic", "element_gain_dbi": 0, "rx_x": 5, "tx_z": 3},
        "radio": {"chirps_per_frame": 120},
        "receivers": {"min_range_m": 0.0},
    }
    return Scenario.model_validate(tree)


@pytest.mark.filterwarnings("ignore::isac_rt.scenario.file.ScenarioWarning")
def test_directions_turn_by_no_more_than_their_bound():
    """Truth: distances of every pair of elements where bodies and elements are at the ends of the
    frame, against those of the centroids. Near passes, bodies that turn; echoes, reflections and
    lines of sight. Planted bugs: one end of two; the speed of the fastest body for the sum of two;
    the bodies' own turning left out."""
    kinds, close = set(), []
    for seed in range(14):
        setup = prepare(near_pass(seed))
        reach, epoch, a = frame_reach(setup.waveform), setup.timetable.epoch(0), setup.antennas
        lags = []
        for t in (0.0, -reach, reach):
            p = setup.swarm.poses(epoch + t)

            def way(tx, rx, body, p=p, a=a):
                """Elements' ways less the centroids'."""
                first = p[tx].position + np.vstack([np.zeros(3), p[tx].to_world(a.tx_positions)])
                last = p[rx].position + np.vstack([np.zeros(3), p[rx].to_world(a.rx_positions)])
                if body is None:
                    length = np.linalg.norm(first[:, None] - last[None], axis=2)
                else:
                    there, back = (
                        np.linalg.norm(e - p[body].position, axis=1) for e in (first, last)
                    )
                    length = there[:, None] + back
                return length - length[0, 0]

            lags.append(way)
        for (tx, rx), paths in setup.find(0)[1].items():
            bound = turning_bound(paths, a, setup.waveform, setup.swarm)
            for k, (kind, target) in enumerate(zip(paths.kind, paths.target, strict=True)):
                if kind == PathKind.LEAKAGE:
                    assert bound[k] == 0
                    continue
                body = paths.target_names[target] if target >= 0 else None
                now, *then = (way(tx, rx, body) for way in lags)
                truth = K_MIDDLE * max(np.abs(at - now).max() for at in then)
                assert truth <= bound[k], (seed, kind)
                kinds.add(int(kind))
                close.append(bound[k] / truth)
    assert kinds == {PathKind.LINE_OF_SIGHT, PathKind.TARGET}
    assert np.median(close) < 4  # velocities are rarely across, and elements not in line with them


@pytest.mark.filterwarnings("ignore::isac_rt.scenario.file.ScenarioWarning")
@pytest.mark.parametrize("moving", ["A", "U"])
def test_an_echo_beside_a_terminal_turns_by_a_radian(moving):
    """3.5 m ahead and 28 m/s across, by hand: k (r_tx + r_rx) v t / R, 1.2 rad. Planted bugs: the
    terminal's own flight left out; the target's left out."""
    across = {"velocity_mps": [28.0, 0, 0]}
    swarm = {
        "A": {"role": "active", "position_m": [0, 0, 40], "boresight": [0, 1, 0]},
        "U": {"role": "target", "position_m": [0, 3.5, 40]},
    }
    swarm[moving] |= across
    tree = {"swarm": swarm, "frames": 4, "propagation": {"leakage": {"enabled": False}}}
    setup = prepare(Scenario.model_validate(tree))
    paths = setup.find(0)[1]["A", "A"]
    half = setup.waveform.frame_duration / 2
    spacing = 0.5774 * SPEED_OF_LIGHT / 77e9
    reach = spacing * (np.hypot(16 / 3, 8 / 3) + np.hypot(77 / 15, 28 / 15))  # from the centroids
    expected = K_MIDDLE * reach * 28.0 * half / 3.5
    assert expected == pytest.approx(1.2, abs=0.1)
    found = turning_bound(paths, setup.antennas, setup.waveform, setup.swarm)
    assert found == pytest.approx([expected], rel=0.08)  # room and the top of the sweep on top


def test_the_last_block_reaches_the_next_slot_where_it_is_said_to():
    """Truth: every pair of blocks of two transmitters, every tenth symbol, against the filter.
    Planted bugs: the groups of the last transmitter left out; the data's delay left out (1023 for
    767 m with all blocks in use)."""
    w = plan_of().waveform
    assert next_slot_delay(w, [0, 16]) * SPEED_OF_LIGHT == pytest.approx(
        767.5 - 0.4e6 / w.slope * SPEED_OF_LIGHT, abs=0.1
    )
    for blocks in ([0], [2, 9], [13, 5, 0]):
        expected = next_slot_delay(w, blocks)
        sent = [b + m for b in blocks for m in range(3)]
        heard = np.inf
        for late in np.linspace(-0.3, 0.3, 25) * w.group_spacing:
            symbols = np.arange(0, w.num_delay_symbols + 1, 32) * w.delay_step
            apart = np.array(
                [[w.slot_duration + (b - f) * w.group_spacing for b in sent] for f in sent]
            )
            beat = w.slope * (expected + late + symbols - apart[..., None])
            if (filter_gain(w, beat) > 0).any():
                heard = min(heard, late)
        assert 0 <= heard < 0.6 / 24 * w.group_spacing + 1e-12


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

    heard = np.unique(SynthesisTones.sources(Tones, w)[0])
    assert set(kept.delay) == set(late[heard])
    assert use.filtered == 60 - heard.size


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
    antennas = plan.arrays.at(paths.link)
    assert np.array_equal(plane, plane_bound(paths, antennas, plan.waveform) <= 0.0155)
    assert np.array_equal(straight, straight_bound(paths, plan.waveform) <= 0.0155)
    assert (use.plane, use.straight) == (plane.sum(), straight.sum())
    assert use.plane_error <= 0.0155 >= use.straight_error


def test_everything_leaves_nothing_out():
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


@pytest.mark.sionna
def test_knots_lie_as_far_apart_as_the_plan_says():
    """Along waypoints no terminal flies farther between two time samples than the limit, nor much
    less; the preset everything has none. Planted bug: the flight's own spacing."""
    from isac_rt.propagation.clutter.visibility import Flight

    plan = plan_of("munich_swarm.yaml", "accuracy.max_untraced_m=1.7")
    assert plan.max_untraced == 1.7
    for name in plan.swarm.terminals:
        flight = Flight(plan.swarm.trajectories[name], plan.swarm.duration, np.zeros(3), 1.7)
        apart = np.linalg.norm(np.diff(flight.time_samples, axis=0), axis=1)
        assert 1.5 < apart.min() and apart.max() <= 1.7
    assert plan_of("munich_swarm.yaml", "accuracy.preset=everything").max_untraced == 0.0
