"""The IF signal: the exact model against mixed chirps in long double, the fast methods against the
exact one, signs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import mixed_chirps

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import ReceiveArray, Reference, Transmission
from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.signal_gridded import GRIDDED_ERROR
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.signal.exact import exact
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Auto, Direct, Exact, Gridded
from isac_rt.signal.tones import tones_of
from isac_rt.world.swarm import Pose

C = SPEED_OF_LIGHT
START = 3.217
SKIRT = 0.43e6
COMPLEX64 = 2e-7  # rounding: two float32 roundings of the result
# rounding: a delay of 5e-6 s is summed of 8 terms, 8 half ulps of 4e-22 s at 77 GHz are 2e-10
# cycles at worst, 3e-11 RMS
FLOAT64 = 1e-10
SMALL = Waveform(
    bandwidth=523e6,
    sampling_rate=17.3e6,
    num_samples=90,
    num_chirps=10,
    num_tx=5,
    num_groups=3,
    filter_transition=SKIRT,
)


def antennas(w, **change):
    return Antennas(
        **{"tx_x": 2, "tx_z": w.num_tx - 1, "rx_x": 3, "rx_z": 2, "spacing": 0.5774 * w.wavelength}
        | change
    )


def pose(x, y, z):
    return Pose.at_rest(boresight=[x, y, z])


def sender(w, rng, *, data=True, **change):
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    payload = random_payload(w, schedule, 8, rng) if data else unmodulated(w)
    fields = {
        "pose": pose(0.31, 1.2, -0.17),
        "antennas": antennas(w),
        "schedule": schedule,
        "payload": payload,
    }
    return Transmission(name="A", **(fields | change))


def directions(rng, count):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1)[:, None]


def paths(w, rng, count, *, reach=0.9, speed=30.0, **change):
    fields = {
        "gain": rng.normal(size=count) + 1j * rng.normal(size=count),
        "delay": rng.uniform(0.01, reach, count) * w.max_delay,
        "delay_rate": 2 * rng.uniform(-speed, speed, count) / C,
        "delay_accel": rng.normal(size=count) * 20 / C,
        "departure": directions(rng, count),
        "arrival": directions(rng, count),
        "tx_radius": rng.uniform(7, 70, count),
        "rx_radius": np.where(np.arange(count) % 3, rng.uniform(7, 70, count), np.inf),
        "kind": PathKind.DIFFUSE,
    }
    return make_paths(epoch=START + w.frame_duration / 2, tx="A", rx="B", **(fields | change))


def synthesise(w, links, method, *, array=None, schedule=None):
    receiver = ReceiveArray(pose(0.2, 1.0, 0.3), array or antennas(w))
    return if_signal(w, links, receiver, Reference(START, schedule=schedule), method).samples


def relative(found, truth):
    assert np.any(truth)
    return np.linalg.norm(found - truth) / np.linalg.norm(truth)


def hard_links(w, rng):
    """Two senders: clocks, on-off keying, data, neighbour groups, births and deaths, a near line of
    sight."""
    first = paths(w, rng, 7, reach=2.8)
    born = np.where(np.arange(5) == 2, 0.13 * w.frame_duration, -np.inf)
    dies = np.where(np.arange(5) == 3, -0.21 * w.frame_duration, np.inf)
    u = directions(rng, 5)
    kinds = np.array([PathKind.LINE_OF_SIGHT, 4, 4, 4, 1])
    second = paths(
        w,
        rng,
        5,
        begin=born,
        end=dies,
        kind=kinds,
        departure=u,
        arrival=-u,
        tx_radius=0.61,
        rx_radius=0.61,
    )
    active = rng.uniform(size=(w.num_groups, w.num_chirps)) < 0.7
    return [
        (sender(w, rng, amplitude=0.37, clock_offset=-3.1e-8, clock_drift=2.3e-7), first),
        (sender(w, rng, active=active), second),
    ]


def test_exact_model_is_what_mixing_gives():
    """Planted bugs: + alpha tau^2/2; conj(beta); 2 (m - m') T_d with the other sign; rotation
    transposed."""
    links = hard_links(SMALL, np.random.default_rng(11))
    truth = mixed_chirps(SMALL, links, pose(0.2, 1.0, 0.3), antennas(SMALL), START)
    receiver = ReceiveArray(pose(0.2, 1.0, 0.3), antennas(SMALL))
    tones = tones_of(SMALL, links, receiver, START + SMALL.frame_duration / 2, 0)
    assert relative(exact(SMALL, tones), truth) < FLOAT64
    assert relative(synthesise(SMALL, links, Exact()), truth) < COMPLEX64


@pytest.mark.parametrize("block", [0, 2, 4])
def test_resource_blocks_are_what_mixing_gives(block):
    """Two senders in the blocks 2..4 and 3..5, received in blocks from `block` on, the paths given
    for the middle of the slots: partly the right blocks, partly neighbours that pass the filter.
    Planted bugs: first_block with the other sign; the paths not moved to the cube's own middle."""
    w, links = SMALL, hard_links(SMALL, np.random.default_rng(17))
    links = [(replace(links[i][0], first_block=2 + i), links[i][1]) for i in (0, 1)]
    start = START + block * w.group_spacing
    truth = mixed_chirps(w, links, pose(0.2, 1.0, 0.3), antennas(w), start, block)
    receiver = ReceiveArray(pose(0.2, 1.0, 0.3), antennas(w))
    found = if_signal(w, links, receiver, Reference(start, block), Exact())
    assert np.abs(truth).max() > 0.1
    assert relative(found.samples, truth) < COMPLEX64


@pytest.mark.parametrize("shape", [(90, 10, 5, 3), (128, 12, 3, 1), (77, 9, 1, 1), (101, 8, 2, 2)])
@pytest.mark.parametrize("data", [True, False])
def test_direct_is_exact(shape, data):
    """Planted bug: no turn of the phasors between blocks (the quadratic term)."""
    n, p, num_tx, groups = shape
    w = replace(SMALL, num_samples=n, num_chirps=p, num_tx=num_tx, num_groups=groups)
    rng = np.random.default_rng(n)
    array = antennas(w, tx_x=1, tx_z=num_tx)
    links = [(sender(w, rng, data=data, antennas=array), paths(w, rng, 6, reach=2.5))]
    assert (
        relative(
            synthesise(w, links, Direct(), array=array), synthesise(w, links, Exact(), array=array)
        )
        < COMPLEX64
    )


@pytest.mark.parametrize("speed", [0.0, 3.3, 30.0])
@pytest.mark.parametrize(("samples", "count"), [(1024, 9), (1000, 40), (255, 130)])
def test_gridded_against_exact(samples, count, speed):
    """At 30 m/s and for the full L. Planted bugs: no second order of motion; no `lag`; modes not
    taken modulo the grid."""
    w = replace(Waveform(filter_transition=SKIRT), num_samples=samples, num_chirps=6)
    rng = np.random.default_rng(samples + count)
    array = antennas(w, rx_x=8, rx_z=8)
    links = [(sender(w, rng, data=count != 40), paths(w, rng, count, speed=speed, reach=1.2))]
    truth = synthesise(w, links, Direct(), array=array)
    assert relative(synthesise(w, links, Gridded(), array=array), truth) < GRIDDED_ERROR


def test_paths_at_the_ends_of_the_passband():
    """Frequencies 0 and 1 wrap around the grid; planted bug: margins not wrapped."""
    w = replace(Waveform(filter_transition=SKIRT), num_chirps=3)
    ends = np.array([-0.011, 0.0, 1e-7, 0.9999999, 1.0, 1.013]) * w.max_delay
    links = [
        (
            sender(w, np.random.default_rng(3), data=False),
            paths(w, np.random.default_rng(4), 6, delay=ends),
        )
    ]
    assert relative(synthesise(w, links, Gridded()), synthesise(w, links, Exact())) < GRIDDED_ERROR


@pytest.mark.parametrize("method", [Direct(), Gridded()])
def test_a_birth_within_a_chirp_costs_half_a_chirp_at_most(method):
    """What the plan says: 1/(2 P) of a path's amplitude. Planted bug: lives judged at the start of
    a chirp."""
    w, worst = SMALL, 0.0
    for share in np.linspace(0.03, 0.97, 9):
        rng = np.random.default_rng(6)
        born = (4 + share) * w.slot_duration - w.frame_duration / 2
        one = paths(w, rng, 1, begin=np.array([born]), end=np.inf, reach=0.4)
        links = [(sender(w, rng), one)]
        off = np.abs(synthesise(w, links, method) - synthesise(w, links, Exact()))
        whole = np.abs(synthesise(w, links, Exact()))[:, :, -1:].sum(axis=3)  # of the last chirp
        off = np.where(off > 0.1 * whole[..., None] / w.num_samples, off, 0.0)
        worst = max(worst, float((off.sum(axis=(2, 3)) / (whole[..., 0] * w.num_chirps)).max()))
    assert worst <= 1.03 / (2 * w.num_chirps)  # the middle sample is no exact middle
    assert worst > 0.6 / (2 * w.num_chirps)


@pytest.mark.parametrize("method", [Auto(), Exact(), Direct(), Gridded()])
def test_nothing_gives_nothing(method):
    w, rng = SMALL, np.random.default_rng(9)
    s = sender(w, rng)
    assert not synthesise(w, [(s, paths(w, rng, 0))], method).any()
    assert not synthesise(w, [], method, schedule=s.schedule).any()
    assert not synthesise(w, [(s, paths(w, rng, 6, gain=np.zeros(6)))], method).any()


@pytest.mark.parametrize("method", [Exact(), Gridded()])
def test_the_epoch_is_only_where_the_polynomial_is_written(method):
    """Paths said for another instant, delays expanded about it by hand, and births counted from it,
    give the same samples. Accelerations of 1e6 m/s^2 so that their square shows: 0.3 mm.
    Planted bugs: the acceleration's half left out or subtracted; the rate not moved; births not."""
    w, rng = SMALL, np.random.default_rng(14)
    accel = rng.normal(size=9) * 1e6 / C
    born = np.where(np.arange(9) % 3 == 1, 0.13 * w.frame_duration, -np.inf)
    dies = np.where(np.arange(9) % 3 == 2, 0.21 * w.frame_duration, np.inf)
    links = [(sender(w, rng), paths(w, rng, 9, delay_accel=accel, begin=born, end=dies))]
    shift = 0.83 * w.slot_duration
    s = links[0][1]
    other = replace(
        s,
        epoch=s.epoch + shift,
        delay=s.delay + s.delay_rate * shift + s.delay_accel * shift**2 / 2,
        delay_rate=s.delay_rate + s.delay_accel * shift,
        begin=s.begin - shift,
        end=s.end - shift,
    )
    change = np.abs(s.delay_accel).max() * shift**2 / 2 * w.carrier_frequency
    assert change > 1e-2  # cycles
    assert (
        relative(synthesise(w, [(links[0][0], other)], method), synthesise(w, links, method))
        < 2 * COMPLEX64
    )


def test_a_wrong_epoch_is_refused():
    w, rng = SMALL, np.random.default_rng(12)
    late = replace(paths(w, rng, 2), epoch=START)
    with pytest.raises(ValueError, match="middle of the frame"):
        synthesise(w, [(sender(w, rng), late)], Auto())
