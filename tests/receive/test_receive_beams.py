"""Symbol decisions from beams and soft bits, beside the paper's on the same samples."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame
from scipy import special, stats

from isac_rt.extensions.city_receivers.beams import _likelihood, demodulate_beams
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import gray_bits
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.symbols import demodulate
from isac_rt.receive.types import Prediction

LENGTH, RATE, ARRIVAL = 43.817, -11.37, (0.31, -0.22)
SHORT = Waveform(num_samples=256, num_chirps=120)
ORDER = 8


def predict(*rows: tuple[float, float, tuple[float, float], float]) -> Prediction:
    """(length, rate, direction, weight) of the reference and of other paths."""
    count = len(rows)
    return Prediction(
        range=np.array([r[0] for r in rows]),
        velocity=np.array([r[1] for r in rows]),
        direction=np.array([r[2] for r in rows]),
        range_std=np.full(count, 0.03),
        velocity_std=np.full(count, 0.1),
        weight=np.array([r[3] for r in rows]),
    )


@lru_cache
def link(*paths: tuple[float, float, complex, tuple[float, float]]):
    w, schedule, payload = frame(ORDER, waveform=SHORT)
    return payload, cube(
        w, schedule, payload, [Path(length, rate, a, arrival) for length, rate, a, arrival in paths]
    )


def noisy(clean: IFCube, snr_db: float, seed: int) -> IFCube:
    noise = (
        np.random.default_rng(seed)
        .standard_normal((*clean.samples.shape, 2), np.float32)
        .view(np.complex64)[..., 0]
    )
    return replace(
        clean, samples=clean.samples + np.float32(np.sqrt(10 ** (-snr_db / 10) / 2)) * noise
    )


ALONE = ((LENGTH, RATE, 1.0, ARRIVAL),)
NEAR = predict((LENGTH + 0.05, RATE - 0.1, (0.315, -0.218), 1.0))


def errors(symbols, payload) -> tuple[float, float]:
    return float((symbols.raw != payload.delay_symbols).mean()), float(
        (symbols.transitions != payload.transitions).mean()
    )


def test_beams_read_what_powers_lose():
    """At -24 dB (256 samples: -30 dB of the paper's 1024) half of the delay symbols are lost with
    powers; with beams the orthogonal signal's union bound (S-1)/2 exp(-g/2), g = N L_rx SNR, allows
    6 %. Planted bug: the steering with the other sign."""
    payload, clean = link(*ALONE)
    signal = noisy(clean, -24.0, 3)
    powers, beams = demodulate(signal, NEAR, ORDER), demodulate_beams(signal, NEAR, ANTENNAS, ORDER)
    allowed = 135 / 2 * np.exp(-256 * 15 * 10**-2.4 / 2)
    assert errors(powers, payload)[0] > 0.25
    assert errors(beams, payload)[0] < allowed + 4 * np.sqrt(allowed / 360)
    assert errors(beams, payload)[1] < errors(powers, payload)[1] - 0.2


@pytest.mark.parametrize("decided", [demodulate, demodulate_beams])
def test_confidence_in_a_flat_spectrum_is_one(decided):
    """One sample that is not zero has the same power in every cell: peak and mean of the other
    cells are equal. Planted bug: the mean taken over one cell fewer."""
    _, clean = link(*ALONE)
    impulse = np.zeros_like(clean.samples)
    impulse[..., 77] = 0.37 - 0.81j
    arguments = (ANTENNAS, ORDER) if decided is demodulate_beams else (ORDER,)
    sure = decided(replace(clean, samples=impulse), NEAR, *arguments).delay_confidence
    assert sure == pytest.approx(
        np.ones(sure.shape), abs=1e-4
    )  # float32 phasors; one cell of 136 is 7e-3


def test_likelihood_of_cells_knows_the_noise_and_the_signal():
    """Drawn cells: 39 of noise and one with the path in it. The noise's power within its
    statistics, the SNR that the median of |a + n|^2 (a non-central chi-square) gives less the
    noise's own share, and ln I_0 of the definition. Planted bugs: that share added; the median
    taken for the mean; amplitude for power in the argument."""
    rng, g, noise, draws = np.random.default_rng(12), 23.7, 0.37, 40000
    spectra = np.sqrt(noise / 2) * (
        rng.standard_normal((1, draws, 40)) + 1j * rng.standard_normal((1, draws, 40))
    )
    spectra[..., 7] += np.sqrt(g * noise) * np.exp(2j * np.pi * rng.random(draws))
    found, snr, likelihood = _likelihood(spectra)
    cells = 40 * draws
    median = np.log(
        2 * 39 / 38
    )  # of the noise's exponential: half of 40 cells lie below, the path's above
    assert found == pytest.approx(noise * median / np.log(2), rel=5 / np.sqrt(cells) / np.log(2))
    expected = stats.ncx2(2, 2 * g).median() / 2 * noise / found - 1
    assert snr == pytest.approx(expected, abs=5 * np.sqrt(2 * g) * 1.26 / np.sqrt(draws))
    some = likelihood[0, :50]
    truth = np.log(special.iv(0, 2 * np.sqrt(snr * np.abs(spectra[0, :50]) ** 2 / found)))
    assert some == pytest.approx(truth, rel=1e-9, abs=1e-9)


@pytest.mark.slow
def test_gain_of_beams_over_signal_to_noise():
    """Both decisions on the same samples; run with -s for the table."""
    payload, clean = link(*ALONE)
    print(
        "\nSNR dB  delay SER powers, beams   DPSK SER powers, beams   bit: soft, hard information"
    )
    for snr_db in range(-27, -13, 2):
        rates = np.zeros((2, 2))
        soft, hard = 0.0, 0.0
        for seed in range(6):
            signal = noisy(clean, snr_db, 100 + seed)
            beams = demodulate_beams(signal, NEAR, ANTENNAS, ORDER)
            rates += (
                np.array([errors(demodulate(signal, NEAR, ORDER), payload), errors(beams, payload)])
                / 6
            )
            soft, hard = (
                soft + information(beams.soft_bits, payload.bits) / 6,
                hard + binary(np.mean(beams.bits != payload.bits)) / 6,
            )
        (d0, p0), (d1, p1) = rates
        print(
            f"{snr_db:6d}  {d0:12.4f}, {d1:6.4f}  {p0:18.4f}, {p1:6.4f}  {soft:16.3f}, {hard:5.3f}"
        )
        assert (
            d1 <= d0 and p1 <= p0 and soft >= hard - 1e-5
        )  # what a ratio of e^-15 costs where nothing is wrong


def information(soft: np.ndarray, bits: np.ndarray) -> float:
    """Bits per bit that a decoder may draw from the ratios."""
    return float(1 - np.logaddexp(0, -soft * (1 - 2.0 * bits)).mean() / np.log(2))


def binary(rate: float) -> float:
    """The same from hard decisions at an error rate."""
    p = min(max(rate, 1e-12), 0.5)
    return float(1 + p * np.log2(p) + (1 - p) * np.log2(1 - p))


def test_soft_bits_are_worth_what_they_say():
    """Bits of a ratio of L are wrong in 1/(1 + e^|L|) of all cases: six frames, delay and phase
    bits apart, bins of |L|, four deviations of a binomial of a third as many trials, for the bits
    of one symbol err together. They hold more than the hard decisions. Planted bugs: ln I_0 without
    the factor 2; bits in another order."""
    payload, clean = link(*ALONE)
    soft, wrong, gain = [], [], 0.0
    for seed in range(6):
        found = demodulate_beams(noisy(clean, -26.0, seed), NEAR, ANTENNAS, ORDER)
        assert (
            (found.soft_bits < 0) == found.bits
        ).mean() > 0.95  # a symbol's best bits are nearly always the bits' best
        soft.append(found.soft_bits)
        wrong.append((found.soft_bits < 0) != payload.bits)
        gain += (
            information(found.soft_bits, payload.bits) - binary(np.mean(found.bits != payload.bits))
        ) / 6
    size, missed = np.abs(soft), np.array(wrong)
    for part in (slice(0, payload.num_delay_bits), slice(payload.num_delay_bits, None)):
        for low, high in ((0.0, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0)):
            inside = (size[:, part] >= low) & (size[:, part] < high)
            expected = float((1 / (1 + np.exp(size[:, part][inside]))).mean())
            assert inside.sum() > 500
            assert abs(missed[:, part][inside].mean() - expected) < 4 * np.sqrt(
                3 * expected * (1 - expected) / inside.sum()
            )
    assert gain > 0.05


def test_gray_bits_are_those_of_the_payload():
    assert gray_bits(8).astype(int).tolist() == [
        [0, 0, 0],
        [0, 0, 1],
        [0, 1, 1],
        [0, 1, 0],
        [1, 1, 0],
        [1, 1, 1],
        [1, 0, 1],
        [1, 0, 0],
    ]


def test_a_wrong_velocity_is_found_from_the_phases():
    """3 m/s turns the longest transitions, five slots, by half a symbol and more: powers lose some
    of them, beams none. Planted bug: the correction's sign."""
    payload, clean = link(*ALONE)
    signal, off = noisy(clean, 0.0, 5), predict((LENGTH, RATE - 3.0, ARRIVAL, 1.0))
    off = replace(off, velocity_std=np.array([1.0]))
    assert errors(demodulate(signal, off, ORDER), payload)[1] > 0.02
    assert errors(demodulate_beams(signal, off, ANTENNAS, ORDER), payload)[1] == 0


def test_paths_of_one_cell_are_kept_apart_by_their_directions():
    """A path as strong, in the same cell, 56 m/s faster: their sum fades and turns, and powers
    misread the phases. Planted bug: the other path not kept out of the beam."""
    other = (LENGTH - 0.04, RATE + 56.0, (-0.3, 0.25))
    payload, clean = link((LENGTH, RATE, 1.0, ARRIVAL), (other[0], other[1], 0.9j, other[2]))
    both = predict((LENGTH, RATE, ARRIVAL, 1.0), (*other, 0.81))
    signal = noisy(clean, 0.0, 8)
    assert errors(demodulate(signal, both, ORDER), payload)[1] > 0.2
    assert errors(demodulate_beams(signal, both, ANTENNAS, ORDER), payload) == (0.0, 0.0)


def test_two_paths_carry_each_other():
    """Two equal paths 30 cells apart at -23 dB each: their beams together lose fewer delay symbols
    than the first alone. Planted bug: the second one's offset with the other sign."""
    far = (LENGTH + 30 * SHORT.range_cell(1), RATE + 5.0, (-0.3, 0.25))
    payload, clean = link((LENGTH, RATE, 1.0, ARRIVAL), (far[0], far[1], 1.0j, far[2]))
    signal = noisy(clean, -24.0, 2)
    one = demodulate_beams(signal, predict((LENGTH, RATE, ARRIVAL, 1.0)), ANTENNAS, ORDER)
    two = demodulate_beams(
        signal, predict((LENGTH, RATE, ARRIVAL, 1.0), (*far, 1.0)), ANTENNAS, ORDER
    )
    assert errors(two, payload)[0] < 0.3 * errors(one, payload)[0]


def test_reception_with_beams():
    """Through the receiver: bits and their ratios; noise alone is not decoded; without a direction
    the powers decide. Planted bug: the confidence held against the law of 15 receivers."""
    settings, (payload, clean) = Receivers(symbol_decision="beams"), link(*ALONE)
    r = receive_passive(noisy(clean, -10.0, 4), ANTENNAS, settings, ORDER, NEAR, True)
    assert r.decoded and np.array_equal(r.bits, payload.bits) and r.confidence_looks == 1
    assert ((r.soft_bits < 0) == payload.bits).all()
    silent = replace(clean, samples=np.zeros_like(clean.samples))
    for seed in range(3):
        assert not receive_passive(
            noisy(silent, 0.0, seed), ANTENNAS, settings, ORDER, NEAR, True
        ).decoded
    blind = replace(NEAR, direction=np.full((1, 2), np.nan))
    r = receive_passive(noisy(clean, -10.0, 4), ANTENNAS, settings, ORDER, blind, True)
    assert r.decoded and r.soft_bits.size == 0 and r.confidence_looks == 15
