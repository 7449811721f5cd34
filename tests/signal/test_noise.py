"""Noise: known answers of the generator, distribution, independence. False-failure rates are
stated; seeds are fixed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from isac_rt.frame.cube import IFCube
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.signal_noise import random_words
from isac_rt.randomness import seed_sequence
from isac_rt.signal.if_signal import add_noise
from isac_rt.signal.noise import add_white_noise

COUNT = 1 << 20
SIGMAS = 5  # statistical: a false failure in 1.7 million


def draw(*purpose, count=COUNT, power=1.0):
    out = np.zeros(count, np.complex64)
    add_white_noise(out, power, seed_sequence(7, "noise", *purpose).generate_state(2))
    return out


def words(first, key, count):
    """(2, count) words of the samples from `first` on."""
    out = np.zeros((2, count), np.uint32)
    random_words(*out, np.uint64(first), *np.array(key, np.uint32))
    return out


def test_known_answers_of_threefry():
    """Published with the Random123 library for Threefry-2x32, 20 rounds: of counters alone, and in
    each of the four places of a block. Planted bugs: rotation 16 for 15; the third place's counter
    one too large; no carry."""
    counters = 0, 2**64 - 1, 0x85A308D3_243F6A88
    keys = [0, 0], [0xFFFFFFFF] * 2, [0x13198A2E, 0x03707344]
    answers = [0x6B200159, 0x99BA4EFE], [0x1CB996FC, 0xBB002BE7], [0xC4923A9C, 0x483DF7A0]
    for counter, key, answer in zip(counters, keys, answers, strict=True):
        for size in (4, 512):
            for place in range(0, size, size // 4):
                first = (counter - place) % 2**64
                assert words(first, key, size)[:, place].tolist() == answer  # published, exact


def test_each_sample_is_box_and_mullers():
    """sqrt(-P ln u) exp(j 2 pi v) in float64 from the words themselves, many of them: the
    polynomials are good to float32. Planted bugs: the sign of the last term of the cosine, 7e-6;
    the logarithm's third term without its half."""
    key, power, count = np.array([0x13198A2E, 0x03707344], np.uint32), 1.0, 300_000
    z = np.zeros(count, np.complex64)
    add_white_noise(z, power, key)
    first, second = words(0, key, count).astype(float)
    square, turn = -power * np.log((first + 0.5) / 2**32), np.exp(2j * np.pi * second / 2**32)
    off = np.abs(np.abs(z.astype(complex)) ** 2 - square)
    assert (
        off[square < np.log(2) / 2].max() < 2.4e-7
    )  # four half ulps of 1; the series' last terms are 1e-7 and 3e-7 at the end
    assert (off < 5e-7 * np.maximum(square, 1)).all()
    some = square > 0.1
    assert (
        np.abs(z[some] / np.abs(z[some].astype(complex)) - turn[some]).max() < 3e-7
    )  # the last terms are 3e-7 and 4e-6


def test_moments():
    """Planted bug: power/2 in both parts twice (variance halved)."""
    power = 3.7e-11
    z = draw("moments", power=power) / np.sqrt(power / 2)
    for part in (z.real.astype(float), z.imag.astype(float)):
        for order, moment, variance in (
            (1, 0, 1),
            (2, 1, 2),
            (3, 0, 15),
            (4, 3, 96),
            (6, 15, 10170),
        ):
            assert abs((part**order).mean() - moment) < SIGMAS * np.sqrt(variance / COUNT)
    assert abs((z.real * z.imag).mean()) < SIGMAS / np.sqrt(COUNT)


def test_distribution_and_tails():
    """Kolmogorov-Smirnov at 1e-6; counts beyond 3, 4, 4.5 and 5 sigma by the Poisson law at 1e-6
    each."""
    z = draw("tails", count=8 * COUNT, power=2.0)
    parts = np.concatenate([z.real, z.imag])
    assert stats.kstest(z.real[:COUNT].astype(float), "norm").pvalue > 1e-6
    assert stats.kstest(np.angle(z[:COUNT]) / np.pi, stats.uniform(-1, 2).cdf).pvalue > 1e-6
    for level in (3, 4, 4.5, 5):
        _assert_tail((np.abs(parts) > level).sum(), level, parts.size)
    edges = stats.norm.ppf(np.linspace(0, 1, 101))
    assert stats.chisquare(np.histogram(parts, edges)[0]).pvalue > 1e-6


def _assert_tail(beyond, level, count):
    low, high = stats.poisson.interval(1 - 1e-6, 2 * stats.norm.sf(level) * count)
    assert low <= beyond <= high


@pytest.mark.slow
def test_tails_to_five_and_a_half_sigma():
    """In 2^29 real numbers 20 are expected beyond 5.5 sigma."""
    beyond, blocks, size = {5.0: 0, 5.25: 0, 5.5: 0}, 64, 1 << 22
    z, key = np.empty(size, np.complex64), seed_sequence(7, "noise", "far tails").generate_state(2)
    for block in range(blocks):
        z[:] = 0
        add_white_noise(z, 2.0, key, block * size)
        parts = z.view(np.float32)
        far = np.abs(parts[np.abs(parts) > 5])
        for level in beyond:
            beyond[level] += int((far > level).sum())
    for level, found in beyond.items():
        _assert_tail(found, level, 2 * blocks * size)
    assert beyond[5.5] > 5


@pytest.mark.parametrize("shift", [1, 2, 1024, 122880])
def test_white(shift):
    z = draw("white")
    product = z[shift:] * z[:-shift].conj()
    for part in (product.real, product.imag):
        assert abs(part.mean(dtype=float)) < SIGMAS / np.sqrt(2 * COUNT)
    powers = np.abs(z) ** 2 - 1
    assert abs((powers[shift:] * powers[:-shift]).mean(dtype=float)) < SIGMAS / np.sqrt(COUNT)


def test_streams_are_independent():
    a, b, again = draw("PT1", 4), draw("PT1", 5), draw("PT1", 4)
    np.testing.assert_array_equal(a, again)
    for other in (b, b.conj()):
        assert abs((a * other).mean(dtype=complex)) < SIGMAS / np.sqrt(COUNT)


def test_parts_make_the_whole():
    """The counter is the index: planted bug: `first` ignored."""
    key = seed_sequence(7, "parts").generate_state(2)
    whole, split = np.zeros(5003, np.complex64), np.zeros(5003, np.complex64)
    add_white_noise(whole, 0.3, key)
    for start, stop in ((1234, 5003), (0, 7), (7, 1234)):
        add_white_noise(split[start:stop], 0.3, key, start)
    np.testing.assert_array_equal(split, whole)


def test_counters_beyond_32_bits():
    """Planted bug: no carry to the upper word."""
    low, high = np.zeros(64, np.complex64), np.zeros(64, np.complex64)
    key = np.array([1, 2], np.uint32)
    add_white_noise(low, 1.0, key, 0)
    add_white_noise(high, 1.0, key, 1 << 32)
    assert not np.array_equal(low, high)
    across = np.zeros(64, np.complex64)
    add_white_noise(across, 1.0, key, (1 << 32) - 40)
    np.testing.assert_array_equal(across[40:], high[:24])


def test_noise_is_added_to_the_samples_of_a_cube():
    w = Waveform(num_samples=64, num_chirps=6)
    samples = np.full((3, 2, 6, 64), 2 - 1j, np.complex64)
    cube = IFCube(
        samples=samples, waveform=w, schedule=conventional_schedule(3, 6, 3), start_time=0.0
    )
    words = seed_sequence(3, "noise", "PT2", 0).generate_state(2)
    noise = np.zeros(samples.size, np.complex64)
    add_white_noise(noise, 0.04, words)
    found = add_noise(cube, 0.04, words).samples - (2 - 1j)
    np.testing.assert_allclose(found.ravel(), noise, atol=5e-7)  # rounding of 2 + noise
