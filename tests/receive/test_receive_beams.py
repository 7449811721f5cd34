"""Symbol decisions from beams, beside the paper's on the same samples."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame
from scipy import special, stats

from isac_rt.extensions.city_receivers.beams import _likelihood, demodulate_beams
from isac_rt.frame.cube import IFCube
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
    print("\nSNR dB  delay SER powers, beams   DPSK SER powers, beams")
    for snr_db in range(-27, -13, 2):
        rates = np.zeros((2, 2))
        for seed in range(6):
            signal = noisy(clean, snr_db, 100 + seed)
            powers = errors(demodulate(signal, NEAR, ORDER), payload)
            beams = errors(demodulate_beams(signal, NEAR, ANTENNAS, ORDER), payload)
            rates += np.array([powers, beams]) / 6
        (d0, p0), (d1, p1) = rates
        print(f"{snr_db:6d}  {d0:12.4f}, {d1:6.4f}  {p0:18.4f}, {p1:6.4f}")
        assert d1 <= d0 and p1 <= p0


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
    """Through the receiver: bits; noise alone is not decoded; without a direction
    the powers decide. Planted bug: the confidence held against the law of 15 receivers."""
    settings, (payload, clean) = Receivers(symbol_decision="beams"), link(*ALONE)
    r = receive_passive(noisy(clean, -10.0, 4), ANTENNAS, settings, ORDER, NEAR, True)
    assert r.decoded and np.array_equal(r.bits, payload.bits) and r.confidence_looks == 1
    silent = replace(clean, samples=np.zeros_like(clean.samples))
    for seed in range(3):
        assert not receive_passive(
            noisy(silent, 0.0, seed), ANTENNAS, settings, ORDER, NEAR, True
        ).decoded
    blind = replace(NEAR, direction=np.full((1, 2), np.nan))
    r = receive_passive(noisy(clean, -10.0, 4), ANTENNAS, settings, ORDER, blind, True)
    assert r.decoded and r.confidence_looks == 15
