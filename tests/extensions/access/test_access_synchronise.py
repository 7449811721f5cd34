"""Two-round synchronisation: closed form, consistency of its covariance, and real receptions of
unmodulated frames."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.access.protocol import Network, establish
from isac_rt.extensions.access.synchronise import (
    ClockEstimate,
    Round,
    estimate_clock,
    line_of_sight,
    measured_alone,
    path_acceleration,
)
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.clock import Clock
from isac_rt.frame.cube import ReceiveArray, Reference, Transmission
from isac_rt.frame.link import Link
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.randomness import seed_sequence
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.signal.if_signal import add_noise, if_signal
from isac_rt.world.swarm import Pose

C = SPEED_OF_LIGHT
OFFSET, DRIFT = -23.7e-9, 0.0131e-6


def rounds(length, speed, accel, gap, stds=((0.011, 0.17), (0.013, 0.19)), rng=None, epoch=5.1):
    """One round each way of a path with its motion, by the equations of motion alone."""
    out = []
    for t, forward, (a, b) in ((0.0, True, stds[0]), (gap, False, stds[1])):
        s = 1 if forward else -1
        noise = rng.normal(size=2) if rng else np.zeros(2)
        apparent = length + speed * t + accel * t**2 / 2 + s * C * (OFFSET + DRIFT * t)
        out.append(
            Round(
                epoch + t,
                forward,
                apparent + a * noise[0],
                speed + accel * t + s * C * DRIFT + b * noise[1],
                a,
                b,
            )
        )
    return out


def error(estimate: ClockEstimate, length, speed) -> np.ndarray:
    return np.array(
        [
            estimate.offset - OFFSET,
            estimate.drift - DRIFT,
            estimate.range - length,
            estimate.velocity - speed,
        ]
    )


def test_the_solution_of_two_rounds_is_the_one_on_paper():
    """drift = (v1 - v2 + a dt)/2c and offset = (r1 - r2 + v2 dt - a dt^2/2)/2c with the variances
    of these sums, exact for a path that accelerates as told. Planted bugs: the acceleration left
    out of the range, of the velocity."""
    gap, accel = 0.31, 2.9
    one, two = rounds(47.31, -8.37, accel, gap, rng=np.random.default_rng(8))
    found = estimate_clock([two, one], accel)
    assert found.drift == pytest.approx(
        (one.velocity - two.velocity + accel * gap) / (2 * C), rel=1e-9, abs=0
    )
    assert found.offset == pytest.approx(
        (one.range - two.range + two.velocity * gap - accel * gap**2 / 2) / (2 * C), rel=1e-9, abs=0
    )
    variance = (0.17**2 + 0.19**2) / (4 * C**2)
    assert found.covariance[1, 1] == pytest.approx(variance, rel=2e-9, abs=0)
    variance = (0.011**2 + 0.013**2 + (0.19 * gap) ** 2) / (4 * C**2)
    assert found.offset_std == pytest.approx(np.sqrt(variance), rel=1e-9, abs=0)
    assert found.offset_std_at(found.time) == pytest.approx(found.offset_std, rel=1e-12, abs=0)
    exact = estimate_clock(rounds(47.31, -8.37, accel, gap), accel)
    assert np.abs(error(exact, 47.31, -8.37) * [C, C, 1, 1]).max() < 1e-10


def test_the_errors_are_those_that_the_covariance_states():
    """Mean NEES of 2000 links is 4 (chi-square with 4 degrees of freedom) within 4.5 sigma, 4.5
    sqrt(8/2000).

    Planted bug: standard deviations of one round used for both."""
    rng, trials = np.random.default_rng(9), 2000
    total = 0.0
    for _ in range(trials):
        length, speed, accel = rng.uniform(10, 90), rng.uniform(-14, 14), rng.normal() * 4.1
        stds = ((0.011, 0.17), (0.034, 0.43))
        found = estimate_clock(rounds(length, speed, accel, 0.083, stds, rng), accel)
        e = error(found, length, speed)
        scale = np.sqrt(np.diag(found.covariance))
        total += (e / scale) @ np.linalg.solve(found.covariance / np.outer(scale, scale), e / scale)
    assert abs(total / trials - 4) < 4.5 * np.sqrt(8 / trials)


def test_a_path_accelerates_as_its_ends_report():
    """Second difference of the distance of two curved flights over 20 ms, to its change within
    them. Planted bug: the acceleration of passing by (v^2/R) left out."""
    x, v, a = np.random.default_rng(6).normal(size=(3, 2, 3)) * np.array([20, 7, 3])[:, None, None]
    step = 0.02

    def flight(time: float) -> tuple[Pose, Pose]:
        places = x + v * time + a * time**2 / 2
        one, other = (Pose(places[k], v[k] + a[k] * time, a[k], np.eye(3)) for k in range(2))
        return one, other

    def length(time: float) -> float:
        one, other = flight(time)
        return float(np.linalg.norm(other.position - one.position))

    truth = (length(step + 1e-3) - length(step - 1e-3) - length(1e-3) + length(-1e-3)) / 2e-3 / step
    assert path_acceleration(flight(0.0), flight(step), step) == pytest.approx(truth, rel=1e-4)
    assert abs(truth) > 1


def test_one_direction_is_not_enough():
    with pytest.raises(ValueError, match="one from each end"):
        estimate_clock(rounds(30.0, 1.0, 0.0, 0.1)[:1])


def received(w, antennas, forward, time, offset, held, seed, snr):
    """Detections of an unmodulated frame of the other end at the passive (forward) or active
    terminal; the path is 47.31 m at t = 0, -8.37 m/s, 1.9 m/s^2."""
    rng = np.random.default_rng(2)
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    along = np.array([[0.13, 0.9, -0.21]]) / np.linalg.norm([0.13, 0.9, -0.21])
    paths = make_paths(
        gain=np.array([0.6 - 0.8j]),
        delay=np.array([(47.31 - 8.37 * time + 0.95 * time**2) / C]),
        delay_rate=(-8.37 + 1.9 * time) / C,
        delay_accel=1.9 / C,
        departure=along,
        arrival=along,
        kind=PathKind.LINE_OF_SIGHT,
        epoch=time,
        tx="A",
        rx="B",
    )
    still = Pose.at_rest()
    s = 1 if forward else -1
    sent = Transmission(
        name="A",
        pose=still,
        antennas=antennas,
        schedule=schedule,
        payload=unmodulated(w),
        clock_offset=s * (offset + DRIFT * time) + held,
        clock_drift=s * DRIFT,
    )
    start = time - w.frame_duration / 2
    cube = if_signal(w, [(sent, paths)], ReceiveArray(still, antennas), Reference(start))
    add_noise(cube, 1 / snr, seed_sequence(seed, "noise", forward).generate_state(2))
    return sight_in(cube, antennas)


def sight_in(cube, antennas):
    found = receive_passive(cube, antennas, Receivers(), 8, None, False).detections
    return measured_alone(found, cube, antennas)


PLACES = np.array([[0, 0, 30], [-6, 14, 28], [9, 11, 33], [2, 22, 31]], float)
"""Of one active and three passive terminals, each moved by up to 4 m [m]."""


def swarm(seed: int, snr_db: float) -> Network:
    """Stages of random swarms and clocks on lines of sight of unit gain, on curved flights of
    some 6 m/s and 3 m/s^2."""
    w, rng = Waveform(num_samples=256, num_chirps=60), np.random.default_rng(seed)
    names = ("A", "P", "Q", "R")
    x = PLACES + rng.uniform(-4, 4, (4, 3))
    v, a = rng.normal(size=(2, 4, 3)) * np.array([[[4.0]], [[2.0]]])

    def scene(time, links):
        poses = {
            name: Pose(x[k] + v[k] * time + a[k] * time**2 / 2, v[k] + a[k] * time, a[k], np.eye(3))
            for k, name in enumerate(names)
        }
        paths = {}
        for tx, rx in links:
            away, speed, change = poses[rx].motion() - poses[tx].motion()
            length = float(np.linalg.norm(away))
            along = away / length
            rate = float(along @ speed)
            paths[Link(tx, rx)] = make_paths(
                gain=np.ones(1),
                delay=np.array([length / C]),
                delay_rate=rate / C,
                delay_accel=float(along @ change + (speed @ speed - rate**2) / length) / C,
                departure=along[None],
                arrival=-along[None],
                tx_radius=length,
                rx_radius=length,
                kind=PathKind.LINE_OF_SIGHT,
                epoch=time,
                tx=tx,
                rx=rx,
            )
        return poses, paths

    clocks = {n: Clock(rng.uniform(-2e-8, 2e-8), rng.uniform(-2e-8, 2e-8)) for n in names}
    return Network(
        waveform=w,
        arrays=Arrays(Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5774 * w.wavelength)),
        schedule=pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng),
        receivers=Receivers(),
        scene=scene,
        wishes={"A": 4},
        listeners={"A": names[1:]},
        noise_power=dict.fromkeys(names, 10 ** (-snr_db / 10)),
        seed=seed,
        clocks=clocks,
    )


@pytest.mark.slow
def test_clocks_are_as_sure_as_stated():
    """120 links of 40 drawn swarms at -12 to 30 dB per sample, two rounds on the exact signal: RMS
    of errors over their stated deviations is 0.8 to 1.25 (chi-square: 0.94 to 1.06 at one sigma) of
    offset and of drift. Planted bugs: the floors of a path among others; the path's acceleration
    left out."""
    errors = []
    for seed in range(40):
        n = swarm(seed, (-12, 2, 16, 30)[seed % 4])
        for (at, pt), link in establish(n).links.items():
            assert link.clock is not None
            one, other, got = n.clocks[at], n.clocks[pt], link.clock
            offset = got.offset - one.late(got.time) + other.late(got.time)
            drift = got.drift - one.drift + other.drift
            errors.append([offset / got.offset_std, drift / np.sqrt(got.covariance[1, 1])])
    ratio = np.sqrt(np.mean(np.square(errors), axis=0))
    print(ratio)
    assert len(errors) == 120
    assert (ratio > 0.8).all() and (ratio < 1.25).all()


def test_other_paths_pull_a_line_of_sight_as_stated():
    """30 frames of a line of sight and a wave 3 to 20 dB weaker from nearly the same direction, 3
    to 6 cells later and up to 2 bins faster, of any phase: RMS of the error in range over the
    stated deviation is 0.7 to 1.4, and of the velocity 0.7 to 1.6. Planted bug: other paths not
    counted."""
    w, rng, off = Waveform(num_samples=256, num_chirps=60), np.random.default_rng(3), []
    antennas = Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5774 * w.wavelength)
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    still = Pose.at_rest()
    for seed in range(30):
        length = 20.3 + rng.uniform(0, 1) + np.array([0, rng.uniform(3, 6)]) * w.range_cell(1)
        speed = np.array([2.1, 2.1 + rng.uniform(0, 2) * w.velocity_cell(1)])
        along = np.array([[0.1, 0.9, -0.2], [0.14, 0.9, -0.18]])
        along /= np.linalg.norm(along, axis=1)[:, None]
        gain = np.array([1.0, 10 ** -rng.uniform(0.15, 1.0) * np.exp(2j * np.pi * rng.random())])
        paths = make_paths(
            gain=gain,
            delay=length / C,
            delay_rate=speed / C,
            departure=along,
            arrival=along,
            kind=[PathKind.LINE_OF_SIGHT, PathKind.SPECULAR],
            epoch=0.0,
            tx="A",
            rx="B",
        )
        sent = Transmission(
            name="A", pose=still, antennas=antennas, schedule=schedule, payload=unmodulated(w)
        )
        reference = Reference(-w.frame_duration / 2)
        cube = if_signal(w, [(sent, paths)], ReceiveArray(still, antennas), reference)
        add_noise(cube, 1e-4, seed_sequence(seed, "noise").generate_state(2))
        d = sight_in(cube, antennas)
        i = line_of_sight(d, w.range_cell(1))
        if len(d) == 1:
            continue
        off.append([(d.range[i] - length[0]) / d.std[i, 0], (d.velocity[i] - 2.1) / d.std[i, 1]])
    ratio = np.sqrt(np.mean(np.square(off), axis=0))
    print(ratio)
    assert 0.7 < ratio[0] < 1.4
    assert 0.7 < ratio[1] < 1.6
