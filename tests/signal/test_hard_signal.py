"""The IF signal and the receivers at their edges: right within a bound, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truths import stage
from truths.stage import FEW, SMALL

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.signal_gridded import GRIDDED_ERROR
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.receive.active import receive_active
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Prediction
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.methods import Auto, Direct, Exact, Gridded, Method

C = SPEED_OF_LIGHT
COMPLEX64 = 1e-6  # rounding of complex64 samples, in both of what is compared
W = Waveform(num_samples=128)
METHODS = [Exact(), Direct(), Gridded()]
SETTINGS = Receivers()


def paths(w: Waveform, delay, gain=1.0, rate=0.0, radius=np.inf) -> PathSet:
    delay = np.atleast_1d(np.asarray(delay, float))
    along = np.tile([0.0, 1.0, 0.0], (delay.size, 1))
    gain = np.broadcast_to(gain, delay.shape)
    return make_paths(
        gain=gain,
        delay=delay,
        delay_rate=rate,
        departure=along,
        arrival=along,
        rx_radius=radius,
        tx_radius=radius,
        kind=PathKind.TARGET,
        epoch=w.frame_duration / 2,
        tx="A",
        rx="P",
    )


def samples(
    w: Waveform, of: PathSet, method: Method, data: bool = False, antennas: Antennas | None = None
) -> np.ndarray:
    antennas = antennas or stage.arrays(w)
    sender = stage.sender(
        w, np.random.default_rng(5), data, pose=stage.pose((0, 0, 0), boresight=(0, 1, 0))
    )
    return stage.synthesise(
        w, [(sender, of)], stage.pose((0, 0, 0), boresight=(0, 1, 0)), method, 0.0, antennas
    )


def prediction(length: float, rate: float) -> Prediction:
    one = np.ones(1)
    return Prediction(
        range=length * one,
        velocity=rate * one,
        direction=np.zeros((1, 2)),
        range_std=one,
        velocity_std=one,
        weight=one,
    )


@pytest.mark.parametrize("cell", [20.0, 20.25, 20.5, 21.0])
def test_whole_and_half_cells(cell):
    """Range and velocity on, beside and exactly between the cells of both axes, noise-free. Written
    against: the peak's neighbour on the wrong side at a tie."""
    _, schedule, payload = stage.frame(w=W)
    length, rate = cell * W.range_cell(1), (cell - 13) * W.velocity_cell(1)
    cube = stage.cube_of(W, schedule, payload, [(length, rate, 1.0)])
    found = receive_passive(cube, FEW, SETTINGS, 8, prediction(length, rate), True)
    assert np.array_equal(found.bits, payload.bits)
    assert abs(found.detections.range[0] - length) < 1e-3 * W.range_cell(
        1
    )  # element delays of opposite sign do not cancel in power
    assert abs(found.detections.velocity[0] - rate) < 1e-3 * W.velocity_cell(1)


@pytest.mark.parametrize("method", METHODS)
def test_no_delay_at_all(method):
    """A path of delay 0 is a constant: its gain in every sample. Written against: the phase of the
    window's start left in."""
    one = Antennas(tx_x=2, tx_z=4, rx_x=2, rx_z=2, spacing=1e-12)
    w = SMALL
    sender = stage.sender(
        w, np.random.default_rng(5), False, pose=stage.pose((0, 0, 0)), antennas=one
    )
    found = stage.synthesise(
        w, [(sender, paths(w, 0.0, 0.3 - 0.7j))], stage.pose((0, 0, 0)), method, 0.0, one
    )
    error = GRIDDED_ERROR if method == Gridded() else COMPLEX64
    assert (
        np.abs(found - (0.3 + 0.7j)).max() < 30 * error
    )  # RMS bound; a single sample may be off by more


@pytest.mark.parametrize("speed", [16.0, -21.3, 44.9])
def test_velocities_beyond_the_limit_are_aliases_of_a_known_span(speed):
    """An echo beyond the unambiguous velocity is reported one span off (30 m/s at the AT), at the
    right range but for the coupling of what was aliased. Written against: bins from 0 to P."""
    _, schedule, payload = stage.frame(w=W)
    cube = stage.cube_of(W, schedule, payload, [(2 * 14.3, 2 * speed, 1.0)])
    found = receive_active(cube, payload, FEW, SETTINGS).detections
    span = 2 * W.max_velocity(2)
    alias = speed - span * np.round(speed / span)
    best = int(np.argmax(found.snr))
    assert abs(found.velocity[best] - alias) < 0.1 * W.velocity_cell(2)
    coupling = (
        (speed - alias)
        / W.velocity_cell(2)
        * W.sampled_duration
        / W.frame_duration
        * W.range_cell(2)
    )
    assert abs(found.range[best] - 14.3 - coupling) < 0.1 * W.range_cell(2)


def test_one_path_80_db_above_another():
    """With the default method the weak path is right to a hundredth beside the strong one, among
    twelve (so that most are gridded). Written against: the strongest gridded as well."""
    rng = np.random.default_rng(3)
    every = stage.random_paths(SMALL, rng, 14, SMALL.frame_duration / 2)
    gain = every.gain.copy()
    gain[0] = 1e4 * abs(gain).max()
    strong = replace(every, gain=gain)
    without = strong.select(np.arange(14) > 0)
    rest = samples(SMALL, strong, Auto()) - samples(
        SMALL, strong.select(np.arange(14) == 0), Exact()
    )
    truth = samples(SMALL, without, Exact())
    assert (
        stage.relative(rest, truth) < 1e-2
    )  # complex64 of the strong one: 1e4 * 6e-8 * a few roundings


@pytest.mark.parametrize("times", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_million_paths(times):
    """A thousand paths over and over, with a part of the gain each, are the thousand paths. Written
    against: an index of 16 bits.

    Rounding: sqrt(1e6) * 6e-8 of the largest partial sums, a few times the total, beside the
    method's own 1e-4 on both sides.
    """
    w = Waveform(num_samples=64, num_chirps=3, num_groups=1)
    few = stage.random_paths(w, np.random.default_rng(8), 1000, w.frame_duration / 2)
    many = few.select(np.tile(np.arange(1000), times))
    many = replace(many, gain=many.gain / times)
    antennas = stage.arrays(w, tx_z=2, rx_x=2)
    found, truth = (samples(w, p, Gridded(), antennas=antennas) for p in (many, few))
    assert stage.relative(found, truth) < 5e-4


def test_ten_thousand_paths_at_one_delay():
    """Their sum is one path with the sum of the gains. Written against: equal frequencies counted
    once."""
    rng = np.random.default_rng(2)
    gain = rng.normal(size=10_000) + 1j * rng.normal(size=10_000) + 0.3
    w = Waveform(num_samples=64, num_chirps=3, num_groups=1)
    antennas = stage.arrays(w, tx_z=2, rx_x=2)
    found = samples(
        w, paths(w, np.full(10_000, 0.37 * w.max_delay), gain), Gridded(), antennas=antennas
    )
    truth = samples(w, paths(w, 0.37 * w.max_delay, gain.sum()), Exact(), antennas=antennas)
    assert (
        stage.relative(found, truth) < GRIDDED_ERROR * 10
    )  # |sum| is a fortieth of the sum of the moduli


@pytest.mark.parametrize("method", [*METHODS, Auto()])
def test_denormal_and_zero_gains(method):
    """They add nothing and make no NaN, alone and beside a path of size 1."""
    tiny = paths(SMALL, [0.1 * SMALL.max_delay, 0.3 * SMALL.max_delay], np.array([0.0, 5e-324]))
    with np.errstate(all="ignore"):
        alone = samples(SMALL, tiny, method)
    assert np.isfinite(alone).all() and np.abs(alone).max() < 1e-37
    both = paths(
        SMALL,
        [0.1 * SMALL.max_delay, 0.3 * SMALL.max_delay, 0.6 * SMALL.max_delay],
        np.array([0.0, 5e-324, 1.0]),
    )
    one = paths(SMALL, 0.6 * SMALL.max_delay)
    assert stage.relative(samples(SMALL, both, method), samples(SMALL, one, method)) < COMPLEX64


@pytest.mark.parametrize(("size", "chirps", "tx"), [(90, 10, 5), (100, 21, 3), (250, 28, 4)])
def test_sizes_that_are_no_powers_of_two(size, chirps, tx):
    """N = 90, 100, 250 and P = 10, 21, 28: the fast methods hold their bounds, and a frame is
    decoded."""
    w = Waveform(num_samples=size, num_chirps=chirps, num_tx=tx, num_groups=min(tx, 3))
    every = stage.random_paths(w, np.random.default_rng(size), 30, w.frame_duration / 2)
    truth = samples(w, every, Exact(), True)
    assert stage.relative(samples(w, every, Direct(), True), truth) < COMPLEX64
    assert stage.relative(samples(w, every, Gridded(), True), truth) < GRIDDED_ERROR
    _, schedule, payload = stage.frame(4, 3, w)
    antennas = Antennas(tx_x=2, tx_z=tx - 1, rx_x=2, rx_z=2, spacing=2e-3)
    length = 0.31 * size * w.range_cell(1)
    cube = stage.cube_of(w, schedule, payload, [(length, 2.3, 1.0)], antennas)
    assert np.array_equal(
        receive_passive(cube, antennas, SETTINGS, 4, prediction(length, 2.3), True).bits,
        payload.bits,
    )


def test_chirps_that_do_not_divide_among_the_antennas_are_refused():
    with pytest.raises(ValueError, match="not a multiple of the 3 transmit antennas"):
        Waveform(num_chirps=121)
    swarm = {"A": {"role": "active", "position_m": [0, 0, 9]}}
    with pytest.raises(ValueError, match="not a multiple of the 3 transmit antennas"):
        Scenario.model_validate({"swarm": swarm, "radio": {"chirps_per_frame": 121}})


@pytest.mark.parametrize("modulated", [True, False])
def test_one_group_and_one_antenna(modulated):
    """M = 1, L_tx = 1: data come through without an error, range and velocity are found, at both
    kinds of terminal."""
    w = Waveform(num_samples=256, num_chirps=60, num_groups=1, num_tx=1)
    schedule = np.zeros((1, 60), np.int64)
    _, _, payload = stage.frame(8, 3, w)
    payload = payload if modulated else unmodulated(w)
    single = Antennas(tx_x=1, tx_z=1, rx_x=2, rx_z=2, spacing=2e-3)
    length, rate = 31.7, -3.9
    cube = stage.cube_of(w, schedule, payload, [(length, rate, 1.0)], single)
    found = receive_passive(cube, single, SETTINGS, 8, prediction(length, rate), modulated)
    assert found.line_of_sight and np.array_equal(found.bits, payload.bits)
    echo = receive_active(
        stage.cube_of(w, schedule, payload, [(2 * 12.3, 2 * 4.1, 1.0)], single),
        payload,
        single,
        SETTINGS,
    ).detections
    for d, (r, v) in ((found.detections, (length, rate)), (echo, (12.3, 4.1))):
        assert abs(d.range[0] - r) < 2e-3 and abs(d.velocity[0] - v) < 2e-3
