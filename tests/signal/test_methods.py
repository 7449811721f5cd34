"""Which paths the automatic method makes one by one, and which noise covers; and the twins of the
synthesis and of the noise."""

from __future__ import annotations

import numpy as np
import pytest
from test_gridding import scene
from twins import assert_twins_agree

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.signal.methods import GRID_PATHS, Auto
from isac_rt.signal.noise import WhiteNoise


def tones_of(count, **changes):
    """Slow paths of equal power that live for the whole frame."""
    w, t = scene(count, np.random.default_rng(31), num_chirps=6)
    equal = {"power": np.full(count, 2.3e-9), "rate": np.zeros(count), "accel": np.zeros(count)}
    return w, t._replace(begin=np.full(count, -np.inf), **equal | changes)


@pytest.mark.parametrize(("count", "gridded"), [(10, False), (11, True)])
def test_few_paths_go_one_by_one(count, gridded):
    """Fifteen elements: ten paths are `GRID_PATHS`. Planted bug: the elements not counted."""
    assert GRID_PATHS == 150
    w, t = tones_of(count)
    alone, faint = Auto(noise_power=1.0).choose(w, t)
    assert alone.all() != gridded and not faint.any()


def test_sights_and_fast_paths_go_one_by_one_whatever_their_power():
    """80 m/s is beyond what the grid holds to 1e-4. Planted bugs: sights gridded; speeds compared
    without the half of the two-way path."""
    rate = np.zeros(40)
    rate[7] = 2 * 80.0 / SPEED_OF_LIGHT
    rate[8] = 2 * 40.0 / SPEED_OF_LIGHT
    w, t = tones_of(40, rate=rate, is_los=np.arange(40) == 3)
    alone, _ = Auto(noise_power=1.0).choose(w, t)
    assert np.flatnonzero(alone).tolist() == [3, 7]


def test_of_strong_paths_the_strongest_go_one_by_one():
    """Over noise that their error could show in, and no more than `max_direct`. Planted bug: the
    weakest of the strong ones."""
    power = np.full(60, 1e-9)
    power[20:26] = 1.0 + np.arange(6)
    w, t = tones_of(60, power=power)
    size = 3 * 15 * 6 * 1024
    quiet = Auto(noise_power=0.5 * (5e-5) ** 2 * size, max_direct=4)
    assert np.flatnonzero(quiet.choose(w, t)[0]).tolist() == [22, 23, 24, 25]
    loud = Auto(noise_power=2 * 6.0 * (5e-5) ** 2 * size, max_direct=4)
    assert not loud.choose(w, t)[0].any()


def test_what_noise_covers_is_decided_cell_by_cell():
    """All paths of one cell together keep under the noise, or none is covered. Planted bug: each
    path held against the noise by itself."""
    w, t = tones_of(64)
    delay = np.where(np.arange(64) < 32, 0.31, 0.62) * w.max_delay  # two cells, 32 paths each
    power = np.where(np.arange(64) < 32, 1e-9, 1e-6)
    t = t._replace(delay=delay, power=power)
    size = float(3 * 15 * 6 * 1024)
    from isac_rt.kernels.signal_below_noise import below_noise_error
    from isac_rt.kernels.signal_gridded import OVERSAMPLING, WIDTH, grid_size

    error = below_noise_error(w, t, grid_size(w.num_samples, OVERSAMPLING, WIDTH))
    sums = [(power * error**2)[some].sum() for some in (slice(0, 32), slice(32, 64))]
    for share, below_noise in ((0.5 * sums[0], 0), (2 * sums[0], 32), (2 * sums[1], 64)):
        method = Auto(noise_power=1.0, below_noise=share * size, max_direct=0)
        assert method.choose(w, t)[1].sum() == below_noise


def test_synthesis_is_its_twin():
    """Grid, single paths and noise against the exact sum. Planted bug: `faint` of the whole set
    handed to the grid's part."""
    w, t = scene(30, np.random.default_rng(5), num_chirps=6)
    samples = np.full((w.num_groups, 15, 6, w.num_samples), 7j, np.complex64)
    noise = WhiteNoise(0.02, np.array([3, 5], np.uint32))
    alone, none = np.arange(30) % 7 == 2, np.zeros(30, bool)
    name = "isac_rt.signal.methods.add_up"
    # the grid's error of 1e-4 RMS, a few times that at the worst sample
    assert_twins_agree(name, samples, w, t, noise, alone, none, rtol=5e-4)
    assert_twins_agree(name, samples, w, t, noise, ~none, none, rtol=1e-6)


def test_noise_is_its_twin():
    """Across the counter's 32 bits. Planted bug: a rotation of 14 for 15."""
    out = np.linspace(-1, 1, 2 * 1300).astype(np.float32)
    numbers = WhiteNoise(0.37, np.array([0x9E3779B9, 12345], np.uint32)).numbers
    first = np.uint64(2**32 - 700)
    # float32 of a logarithm and a sine
    assert_twins_agree("isac_rt.signal.noise.add_stream", out, *numbers, first, rtol=2e-6)


@pytest.mark.parametrize("between", [False, True])
def test_paths_of_a_slot_sound_in_its_chirps_alone(between):
    """Paths that live for a slot or half a one, also from one group's chirp on, are the twin's, who
    asks each of them in every chirp. Planted bugs: `latest` without the spacing of the groups;
    `slots[p]` for `slots[p + 1]`; those that live for a slot left to the grid."""
    w, t = tones_of(300)
    rng = np.random.default_rng(8)
    later = between * (w.fast_time[w.num_samples // 2] + w.group_spacing / 2)
    begin = rng.integers(-1, 6, 300) * w.slot_duration + later - w.frame_duration / 2
    begin[:20] = -np.inf
    life = np.where(np.arange(300) % 3, 1.0, 0.5) * w.slot_duration
    t = t._replace(begin=begin, end=np.where(np.isinf(begin), np.inf, begin + life))
    alone, faint = Auto(noise_power=1.0, below_noise=1.0).choose(w, t)
    assert alone[20:].all() and not faint[20:].any()
    samples = np.zeros((w.num_groups, 15, 6, w.num_samples), np.complex64)
    every, noise = np.ones(300, bool), WhiteNoise(0.0, np.array([3, 5], np.uint32))
    arguments = samples, w, t, noise, every, ~every
    assert_twins_agree("isac_rt.signal.methods.add_up", *arguments, rtol=3e-6)
