"""The receivers' noise against published words and laws."""

from __future__ import annotations

import numpy as np
from scipy import stats

from isac_rt.kernels.signal_noise import random_words
from isac_rt.randomness import seed_sequence
from isac_rt.signal.noise import add_white_noise
from truths.case import case


@case("known answers published with Random123 for Threefry-2x32, 20 rounds", "0 words", "exact")
def counter_based_random_numbers() -> float:
    """The generator behind the noise gives the published words."""
    counters = 0, 2**64 - 1, 0x85A308D3_243F6A88
    keys = [0, 0], [0xFFFFFFFF] * 2, [0x13198A2E, 0x03707344]
    answers = [0x6B200159, 0x99BA4EFE], [0x1CB996FC, 0xBB002BE7], [0xC4923A9C, 0x483DF7A0]
    wrong = 0
    for first, key, answer in zip(counters, keys, answers, strict=True):
        words = np.empty((2, 4), np.uint32)
        random_words(*words, np.uint64(first), *np.array(key, np.uint32))
        wrong += int((words[:, 0] != answer).sum())
    return float(wrong)


@case(
    "moments and tail of the complex Gaussian law",
    "5 sigma",
    "ten statistics, each beyond 5 sigma once in 2e6",
)
def white_noise() -> float:
    """Power, moments, tail and whiteness of a million samples of noise."""
    count, power = 1 << 20, 3.7e-11
    z = np.zeros(count, np.complex64)
    add_white_noise(z, power, seed_sequence(7, "validation noise").generate_state(2))
    z = (z / np.sqrt(power / 2)).astype(complex)
    scores = []
    for part in (z.real, z.imag):
        for order, moment, variance in ((1, 0, 1), (2, 1, 2), (4, 3, 96)):
            scores.append(abs((part**order).mean() - moment) / np.sqrt(variance / count))
        tail = 2 * stats.norm.sf(4.0) * count
        scores.append(abs((np.abs(part) > 4).sum() - tail) / np.sqrt(tail))
    scores.append(abs((z[1:] * z[:-1].conj()).mean()) / 2 * np.sqrt(count))
    scores.append(abs((z**2).mean()) / 2 * np.sqrt(count / 2))
    return float(max(scores))


@case("the samples of another partition and another number of threads", "0 samples", "bit for bit")
def noise_does_not_know_the_order_of_work() -> float:
    """A cube's noise filled in one piece and in pieces, last piece first, is the same bit for
    bit."""
    key = seed_sequence(3, "validation order").generate_state(2)
    whole, parts = np.zeros(9973, np.complex64), np.zeros(9973, np.complex64)
    add_white_noise(whole, 1.3, key)
    for low, high in ((7001, 9973), (0, 311), (311, 7001)):
        add_white_noise(parts[low:high], 1.3, key, low)
    return float((whole != parts).sum())
