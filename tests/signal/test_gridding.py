"""The fast kernels of the gridded synthesis against plain numpy, and its stated errors against the
exact model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from oracles import tones_to_second_order

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import ReceiveArray, Transmission
from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform, hann
from isac_rt.kernels.fourier import ROW, plan, transform
from isac_rt.kernels.signal_below_noise import CHIRPS_PER_BATCH, LINES, batches, below_noise_error
from isac_rt.kernels.signal_direct import add_direct
from isac_rt.kernels.signal_gridded import (
    GRIDDED_ERROR,
    OVERSAMPLING,
    WIDTH,
    grid_size,
    make_gridded,
)
from isac_rt.kernels.vector import aligned, cos_sin, cos_sin_exact, load, store
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.signal.exact import exact
from isac_rt.signal.methods import Auto, Direct, Exact, Gridded, Separable
from isac_rt.signal.noise import WhiteNoise, add_white_noise
from isac_rt.signal.tones import tones_of
from isac_rt.world.swarm import Pose


@pytest.mark.parametrize("size", [1024, 1280, 1536, 2048, 90, 4])
def test_transform_of_rows(size):
    rng = np.random.default_rng(size)
    rows = (rng.normal(size=(size, 16)) + 1j * rng.normal(size=(size, 16))).astype(np.complex64)
    table = aligned((size + 1) * ROW)
    table[ROW:] = np.concatenate([rows.real, rows.imag], axis=1).ravel()
    radices, twiddles, order = plan(size)
    transform(table, ROW, size, radices, twiddles)
    found = table[ROW:].reshape(size, 2, 16)[order]
    truth = np.fft.ifft(rows.astype(complex), axis=0, norm="forward")
    error = np.linalg.norm(found[:, 0] + 1j * found[:, 1] - truth) / np.linalg.norm(truth)
    assert error < 6e-8 * np.log2(size)  # a float32 rounding in every stage


def test_a_size_with_another_factor_is_refused():
    with pytest.raises(ValueError, match="factors 2, 3 and 5"):
        plan(14)


def test_cosine_and_sine():
    cycles = np.linspace(-0.55, 0.55, 16 * 1000).astype(np.float32)
    c, s = np.empty_like(cycles), np.empty_like(cycles)

    @njit
    def run(cycles, c, s):
        for i in range(0, cycles.size, 16):
            a, b = cos_sin(load(cycles, i))
            store(c, i, a)
            store(s, i, b)

    run(cycles, c, s)
    truth = np.exp(2j * np.pi * cycles.astype(float))
    assert (
        np.abs(c + 1j * s.astype(float) - truth).max() < 1.5e-6
    )  # the double angle amplifies roundings of 6e-8


def test_cosine_and_sine_for_the_direct_method():
    """Planted bug: the last two terms of the cosine left out."""
    cycles = np.linspace(-0.5, 0.5, 16 * 1000)
    c, s = np.empty(cycles.size, np.float32), np.empty(cycles.size, np.float32)

    @njit
    def run(cycles, c, s):
        for i in range(0, cycles.size, 16):
            a, b = cos_sin_exact(load(cycles, i))
            store(c, i, a)
            store(s, i, b)

    run(cycles, c, s)
    truth = np.exp(2j * np.pi * cycles)
    assert np.abs(c.astype(float) - truth.real).max() < 3.1e-8  # half an ulp below 1, and 1e-10
    assert np.abs(s.astype(float) - truth.imag).max() < 3.1e-8


def scene(count, rng, speed=15.0, view=60.0, **change):
    """Paths in the field of view, |u| up to 0.87, of one sender with data; and the tones at a full
    L of 15 elements."""
    w = replace(Waveform(filter_transition=0.41e6), **({"num_chirps": 6} | change))
    array = Antennas(tx_x=2, tx_z=w.num_tx - 1, rx_x=8, rx_z=8, spacing=0.5774 * w.wavelength)
    pose = Pose.at_rest(boresight=[0.1, 1.0, 0.05])
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    sender = Transmission(
        name="A",
        pose=pose,
        antennas=array,
        schedule=schedule,
        payload=random_payload(w, schedule, 8, rng),
    )
    azimuth, elevation = np.radians(rng.uniform(-view, view, (2, count)))
    u = np.stack(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ],
        axis=1,
    )
    born = np.where(np.arange(count) % 11 == 3, w.slot_duration - w.frame_duration / 2, -np.inf)
    paths = make_paths(
        epoch=w.frame_duration / 2,
        tx="A",
        rx="B",
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
    return w, tones_of(w, [(sender, paths)], ReceiveArray(pose, array), w.frame_duration / 2, 0)


def gridded(w, tones, faint=None):
    samples = np.full(
        (w.num_groups, tones.rx_delay.shape[1], w.num_chirps, w.num_samples), 7j, np.complex64
    )
    none = np.zeros(tones.size, bool)
    make_gridded(samples, w, tones, none if faint is None else faint, tones.select(none))
    return samples


@pytest.mark.parametrize(("speed", "samples"), [(15.0, 1024), (60.0, 1024), (15.0, 90)])
def test_error_of_the_direct_method(speed, samples):
    """Against float64: roundings of float32 products, 4e-8 each, and the square of what turns
    within sixteen samples (1e-7 at 60 m/s). Planted bug: `cross` counted from the first of the
    sixteen samples."""
    w, tones = scene(5, np.random.default_rng(9), speed=speed, num_chirps=3, num_samples=samples)
    found = np.full((w.num_groups, 15, w.num_chirps, w.num_samples), 7j, np.complex64)
    add_direct(found, w, tones, fresh=True)
    assert relative(found, exact(w, tones)) < 2e-7
    again = found.copy()
    add_direct(again, w, tones)
    assert relative(again, 2 * found) < 1e-7


def relative(found, truth):
    return np.linalg.norm(found - truth) / np.linalg.norm(truth)


@pytest.mark.parametrize("count", [1, 16, 37])
def test_kernel_is_its_equation(count):
    """Up to what four weights' division leaves of it, at a speed that shows the cross term. Planted
    bug: `_SKEW` of 1/3 (9e-5)."""
    w, tones = scene(count, np.random.default_rng(count), num_chirps=3, speed=600.0)
    truth = tones_to_second_order(w, tones)
    assert relative(gridded(w, tones), truth) < 4.5e-5


def test_many_paths_go_several_chirps_at_a_time():
    w, tones = scene(4100, np.random.default_rng(2), num_samples=96, num_chirps=5, num_tx=5)
    halves = [gridded(w, tones.select(np.arange(4100) % 2 == i)) for i in (0, 1)]
    assert relative(gridded(w, tones), halves[0] + halves[1]) < 2e-6  # rounding


def test_error_of_the_full_model():
    """Up to |u| = 0.87."""
    w, tones = scene(40, np.random.default_rng(22), num_chirps=3)
    assert relative(gridded(w, tones), exact(w, tones)) < GRIDDED_ERROR


@pytest.mark.parametrize("samples", [96, 90])
def test_paths_past_the_grid_are_those_of_the_direct_method(samples):
    """To the bit, where the last block of samples is not full too. Planted bug: sums of one element
    left to the next."""
    w, tones = scene(12, np.random.default_rng(4), num_samples=samples)
    strong = np.arange(12) % 4 == 1
    rest, alone = tones.select(~strong), tones.select(strong)
    apart = gridded(w, rest)
    add_direct(apart, w, alone)
    together = np.full_like(apart, 7j)
    make_gridded(together, w, rest, np.zeros(rest.size, bool), alone)
    assert np.array_equal(together, apart)


@pytest.mark.parametrize("samples", [96, 90])
def test_noise_is_that_of_its_own_pass(samples):
    """To the bit, by a grid and past it, for chirps whose samples fill no block of words. Planted
    bugs: the draw of the chirp before; noise before the paths one by one."""
    w, tones = scene(12, np.random.default_rng(4), num_samples=samples)
    strong = np.arange(12) % 4 == 1
    rest, alone = tones.select(~strong), tones.select(strong)
    noise = WhiteNoise(0.03 * rest.power.mean(), np.array([3, 5], np.uint32))
    none = np.zeros(rest.size, bool)
    apart, together = gridded(w, tones), gridded(w, tones)
    make_gridded(apart, w, rest, none, alone)
    add_white_noise(apart, *noise)
    make_gridded(together, w, rest, none, alone, noise.numbers)
    assert np.array_equal(together, apart)
    twice = (np.concatenate([one, one], axis=-1) for one in (tones.rx_delay, tones.cross))
    many = tones._replace(**dict(zip(("rx_delay", "cross"), twice, strict=True)))  # 30 elements
    for method in (Exact(), Separable(), Direct(), Gridded(), Auto()):
        apart = method.samples(w, many)
        add_white_noise(apart, *noise)
        assert np.array_equal(method.samples(w, many, noise), apart)


@pytest.mark.parametrize(
    ("speed", "size", "change"),
    [
        (0.0, 1, {}),
        (0.3, 1, {}),
        (8.0, 1, {}),
        (40.0, 1, {}),
        (8.0, 1, {"num_groups": 1}),
        (3.0, 1, {"num_tx": 6, "num_groups": 2}),
        (0.0, 10, {"num_groups": 1}),
        (5.0, 1, {"bandwidth": 2.5e9, "num_groups": 2}),
    ],
)
def test_error_of_paths_that_noise_covers(speed, size, change):
    """The stated bound of each of eight paths, which lies within four times of the truth: over a
    whole frame, with few and many chirps of an element at once, larger arrays and bandwidths.
    Planted bugs: `late` of zero; `MAX_LINE_SHIFT` of 2 in `part_slots` alone; `beyond` without the
    elements' delays; `_time_spread` of 0."""
    count = 8
    w, t = scene(count, np.random.default_rng(23), speed=speed, **({"num_chirps": 60} | change))
    t = t._replace(
        rate=np.sign(t.rate) * 2 * speed / SPEED_OF_LIGHT,
        delay=0.45 * t.delay,  # no skirt of the filter: the bound is of what passes it whole
        begin=np.full(count, -np.inf),
        tx_delay=size * t.tx_delay,
        rx_delay=size * t.rx_delay,
    )
    bound = below_noise_error(w, t, grid_size(w.num_samples, OVERSAMPLING, WIDTH))
    found = np.zeros(count)
    for k in range(count):
        one = t.select(np.arange(count) == k)
        sampled = gridded(w, one, np.ones(1, bool))
        truth = np.zeros_like(sampled)
        add_direct(truth, w, one, fresh=True)
        found[k] = relative(sampled, truth)
    assert (found < bound).all()
    assert (found > bound / 4).all()


@pytest.mark.parametrize("speed", [0.0, 8.0, 15.0])
def test_error_of_the_others_beside_what_noise_covers(speed):
    """Planted bug: a division fitted to the
    four weights alone, without the further ones fitted to it."""
    w, tones = scene(14, np.random.default_rng(23), speed=speed)
    assert relative(gridded(w, tones), exact(w, tones)) < GRIDDED_ERROR


@pytest.mark.slow
def test_covered_paths_near_each_other_and_far_apart():
    """Lines on one grid step, on neighbouring ones, some steps apart and beyond a block of them.
    Planted bugs: lines two steps apart taken for neighbours; weights of the next place in a step;
    what the last paths of a block leave to the next one lost."""
    count = 400
    w, t = scene(count, np.random.default_rng(28), speed=3.0, num_chirps=3)
    size = grid_size(w.num_samples, OVERSAMPLING, WIDTH)
    line = 1 / (w.slope * w.sample_interval * size * LINES)
    gaps = line * 10 ** np.random.default_rng(29).uniform(-1.0, 1.7, count)
    t = t._replace(delay=0.05 * w.max_delay + gaps.cumsum(), begin=np.full(count, -np.inf))
    bound = below_noise_error(w, t, size).max()
    assert relative(gridded(w, t, np.ones(count, bool)), exact(w, t)) < bound


def test_covered_paths_of_two_senders_and_of_the_group_before():
    """Chirps that are made together are sent by other elements of the second sender, and of the
    group before, whose late paths are heard. Planted bugs: one element for all chirps of a batch;
    the data of the receiver's own group."""
    w, t = scene(24, np.random.default_rng(26), num_chirps=9, view=30.0)
    late = np.arange(24) % 3 == 2
    both = {name: np.repeat(getattr(t, name), 2, axis=0) for name in ("send", "symbol_delay")}
    antenna = np.concatenate([t.antenna, t.antenna[:, :, ::-1]])
    both["symbol_delay"][1] = both["symbol_delay"][1, :, ::-1]
    delay = t.delay * 0.4 + late * w.group_spacing
    tones = t._replace(link=np.arange(24) % 2, delay=delay, antenna=antenna, **both)
    truth = exact(w, tones)
    assert relative(gridded(w, tones, np.ones(24, bool)), truth) < 5e-3
    assert relative(truth, exact(w, tones.select(~late))) > 0.1  # they are heard


def test_every_chirp_is_made_once_with_others_of_its_element():
    """Of a schedule of 3 groups and 50 slots. Planted bug: batches that end with a part's first
    element."""
    antenna = np.random.default_rng(27).integers(0, 3, (3, 50))
    chirp, parts = batches(antenna, 24)
    assert sorted(chirp.tolist()) == list(range(150))
    assert parts[:, 1].sum() == 150 and parts[:, 1].max() <= CHIRPS_PER_BATCH
    for first, count, part in parts:
        some = chirp[first : first + count]
        assert len(set(antenna.ravel()[some])) == 1
        assert set(some % 50 // 24) == {part}


def test_covered_paths_share_the_grid_with_the_others():
    """Both classes at once are the sum of each by itself, whatever their order in delay. Planted
    bug: blocks that hold paths of both."""
    w, tones = scene(300, np.random.default_rng(24), num_chirps=3)
    faint = np.arange(300) % 3 > 0
    apart = gridded(w, tones.select(~faint)) + gridded(w, tones.select(faint), np.ones(200, bool))
    assert relative(gridded(w, tones, faint), apart) < 1e-6  # rounding


def test_the_error_of_a_covered_path_stays_in_its_cell():
    """Under Hann's window nearly all of it lies within two cells of the path, in every chirp.
    Planted bug: weights of the full class, whose response is another, over four points."""
    w, tones = scene(1, np.random.default_rng(25), num_chirps=3)
    tones = tones._replace(delay=np.full(1, 0.41 * w.max_delay), begin=np.full(1, -np.inf))
    error = gridded(w, tones, np.ones(1, bool)) - exact(w, tones)
    spectrum = np.abs(np.fft.fft(error * hann(np.arange(w.num_samples), w.num_samples))) ** 2
    power = np.abs(np.fft.fft(exact(w, tones) * hann(np.arange(w.num_samples), w.num_samples))) ** 2
    peak = power.sum(axis=1).argmax(axis=-1)
    near = (np.arange(-3, 4) + peak[..., None]) % w.num_samples
    held = np.take_along_axis(spectrum.sum(axis=1), near, axis=-1).sum()
    assert held > 0.99 * spectrum.sum()
