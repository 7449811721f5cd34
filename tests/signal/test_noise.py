"""Noise: known answers of the generator, distribution, independence. False-failure rates are
stated; seeds are fixed."""

from __future__ import annotations

import numpy as np

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


def test_streams_are_independent():
    a, b, again = draw("PT1", 4), draw("PT1", 5), draw("PT1", 4)
    np.testing.assert_array_equal(a, again)
    for other in (b, b.conj()):
        assert abs((a * other).mean(dtype=complex)) < SIGMAS / np.sqrt(COUNT)


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
