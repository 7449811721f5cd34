"""The paper's benchmarks: conventional TDM-MIMO FMCW and mmWave-LoRadar."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube
from scipy import stats

from isac_rt.frame.cube import IFCube
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.settings import Receivers
from reproduce.baselines import (
    Echoes,
    LoRadar,
    detect_symbols,
    fmcw_frame,
    loradar_error_rate,
    loradar_frame,
    loradar_symbol_errors,
    receive_fmcw,
    receive_loradar,
    resolution,
    symbol_tones,
)

SETTINGS = Receivers()


def echo(rng, farthest=100.0, fastest=4.65):
    """A random target in range, within 93 % of the FMCW's velocity limit, in view, and its echo's
    path."""
    r, v = rng.uniform(5, farthest), rng.uniform(-fastest, fastest)
    az, el = np.deg2rad(rng.uniform(-50, 50, 2))
    u = (float(np.cos(el) * np.sin(az)), float(np.sin(el)))
    return np.array([r, v, *u]), Path(
        2 * r, 2 * v, np.exp(2j * np.pi * rng.random()), arrival=u, departure=u
    )


def hits(found, truth, bound):
    estimate = np.column_stack([found.range, found.velocity, found.direction])
    return bool((np.abs(estimate - truth) < bound).all(axis=1).any())


def agrees(count, trials, count_before, trials_before, probability=1e-3):
    """Whether a count could come from a rate within the Clopper-Pearson interval of an earlier
    sample; each tail `probability`."""
    low = (
        stats.beta.ppf(probability, count_before, trials_before - count_before + 1)
        if count_before > 0
        else 0.0
    )
    high = (
        stats.beta.isf(probability, count_before + 1, trials_before - count_before)
        if count_before < trials_before
        else 1.0
    )
    return (
        stats.binom.ppf(probability, trials, low)
        <= count
        <= stats.binom.isf(probability, trials, high)
    )


def fmcw_errors(snr_db, trials, farthest=100.0, seed=5):
    w, schedule, payload = fmcw_frame(Waveform())
    rng, bound, out, count = np.random.default_rng(seed), resolution(w, ANTENNAS), [], 0
    for k in range(trials):
        truth, path = echo(rng, farthest)
        noise = 10 ** (-snr_db / 10) if np.isfinite(snr_db) else 0.0
        found = receive_fmcw(
            cube(w, schedule, payload, [path], noise=noise, seed=100 + k), ANTENNAS, SETTINGS
        )
        count += hits(found, truth, bound)
        out += (
            [[found.range[0], found.velocity[0], *found.direction[0]] - truth] if len(found) else []
        )
    return count, np.array(out), bound


def test_fmcw_without_noise():
    """Off the grid, out to the far half of the range that the ISAC waveform keeps for data: within
    0.01 cell and 1e-3 in u (discretisation: two-cell ratios beside migration of up to 0.15 cell).
    Planted bug: no compensation of the antennas' time offsets, which turns the direction by 0.004
    to 0.016."""
    count, errors, bound = fmcw_errors(np.inf, 6, farthest=240.0)
    assert count == 6
    assert (np.abs(errors) < [0.01 * bound[0], 0.01 * bound[1], 1e-3, 1e-3]).all()


def test_fmcw_folds_its_velocity_at_a_third():
    """7.3 m/s is beyond c/(4 L_tx T_slot f) = 4.981 m/s with f = 77.34 GHz amid the window (notes:
    15.0085/3, with f_c) and appears twice that lower; 0.1 cell."""
    w, schedule, payload = fmcw_frame(Waveform())
    found = receive_fmcw(cube(w, schedule, payload, [Path(2 * 41.3, 2 * 7.3)]), ANTENNAS, SETTINGS)
    limit = w.max_velocity(2) / 3
    assert limit == pytest.approx(4.981, abs=1e-3)
    assert found.velocity[0] == pytest.approx(7.3 - 2 * limit, abs=0.025)


@pytest.mark.parametrize(("snr_db", "rate"), [(-44, 0.54), (-38, 1.0)])
@pytest.mark.slow
def test_fmcw_hit_rate(snr_db, rate):
    """Prototype: 0.54 of 24 frames at -44 dB, 1 from -40 dB up. Both samples are binomial: the
    bounds join a 1e-3 interval on the prototype's rate and ours. Planted bug: one channel instead
    of the sum of 45."""
    trials = 16
    count, _, _ = fmcw_errors(snr_db, trials)
    assert agrees(count, trials, rate * 24, 24)


def test_fmcw_refuses_a_pseudo_random_schedule():
    w, schedule, payload = fmcw_frame(Waveform())
    samples = cube(w, schedule, payload, [Path(30.0, 0.0)]).samples
    other = pseudo_random_schedule(1, w.num_chirps, w.num_tx, np.random.default_rng(2))
    with pytest.raises(ValueError, match="antennas in turn"):
        receive_fmcw(
            IFCube(samples=samples, waveform=w, schedule=other, start_time=0.0), ANTENNAS, SETTINGS
        )


SYSTEM = LoRadar(Waveform())


def test_loradar_numbers():
    """The paper's: SF 15, 2^16 points to 1024 (1/64), 1800 bits; published, exact. At half the time
    SF 14; B T must be a power of two."""
    assert (SYSTEM.spreading_factor, SYSTEM.compression, SYSTEM.bits_per_frame) == (
        15,
        1 / 64,
        1800,
    )
    assert LoRadar(Waveform(num_samples=512)).spreading_factor == 14
    with pytest.raises(ValueError, match="power of two"):
        LoRadar(Waveform(num_samples=1000))


def swept_cycles(symbol, points):
    """Cycles of a symbol's chirp at `points` of 1/(8 B): the swept frequency (h/H + t/T) mod 1,
    summed."""
    size = SYSTEM.num_symbols
    middle = (np.arange(8 * size) + 0.5) / (8 * size)
    frequency = (symbol / size + middle) % 1.0
    return np.concatenate([[0.0], np.cumsum(frequency / 8)])[points]


@pytest.mark.parametrize("symbol", [0, 1, 12345, 32767])
def test_dechirped_symbols_are_two_tones(symbol):
    """Against the summed sweep, symbol less base chirp; rounding of 2.6e5 additions of up to 3e4
    cycles: 1e-6 turns. Planted bug: the wrap at n = H - h."""
    n = np.arange(0, 2 * SYSTEM.num_symbols, 7)
    expected = np.exp(2j * np.pi * (swept_cycles(symbol, 4 * n) - swept_cycles(0, 4 * n)))
    assert np.abs(symbol_tones(SYSTEM, np.array([symbol]), n)[0] - expected).max() < 1e-5


def test_loradar_symbols_without_noise():
    """All edges of the alphabet, broken phase; exact. Planted bug: bin h + H left out, which loses
    symbols near H."""
    rng = np.random.default_rng(3)
    sent = np.array([0, 1, 16384, 16385, 32766, 32767])
    instants = np.sort(rng.choice(65536, 1024, replace=False))
    samples = symbol_tones(SYSTEM, sent, instants, 2 * np.pi * rng.random(6))[:, None, :] * np.exp(
        2j * np.pi * rng.random((6, 3, 1))
    )
    assert np.array_equal(detect_symbols(SYSTEM, samples, instants), sent)


@pytest.mark.parametrize(
    ("snr_db", "detector"), [(-28, "coherent"), (-27, "coherent"), (-25, "energy")]
)
def test_loradar_symbol_errors_against_theory(snr_db, detector):
    """Noncoherent detection of 32768 orthogonal symbols with square-law combining; binomial, 1e-4
    each tail. Planted bugs: 2 L_rx branches in the coherent
    detector's theory; noise of power 2."""
    trials = 100
    rate = loradar_error_rate(snr_db, SYSTEM, detector=detector)
    wrong = loradar_symbol_errors(
        snr_db,
        trials,
        np.random.default_rng(8),
        SYSTEM,
        detector=detector,
        broken_phase=detector == "energy",
    )
    assert 0.05 < rate < 0.95
    assert stats.binom.ppf(1e-4, trials, rate) <= wrong.sum() <= stats.binom.isf(1e-4, trials, rate)


def test_theory_of_a_single_branch():
    """One antenna, coherent detector, H = 1024, wrong symbols' powers of mean q = 1 + snr:
    P = sum_k (-1)^(k+1) C(H-1, k) q/(q+k) exp(-g k/(q+k)), g = N snr; the terms alternate, so 400
    digits. 1e-3 for the quadrature. Planted bug: g for 2 g in the noncentrality."""
    system = LoRadar(Waveform(num_samples=32))
    assert system.num_symbols == 1024
    snr = Decimal("0.3123")
    with localcontext(prec=400):
        q, g = 1 + snr, 32 * snr
        exact = sum(
            (-1) ** (k + 1) * math.comb(1023, k) * q / (q + k) * (-g * k / (q + k)).exp()
            for k in range(1, 1024)
        )
    assert loradar_error_rate(10 * math.log10(0.3123), system, 1, "coherent") == pytest.approx(
        float(exact), rel=1e-3, abs=0
    )


def test_breaking_the_phase_spoils_coherent_detection():
    """At -24 dB the coherent detector errs in 1e-4 with an unbroken phase, in a tenth with a broken
    one: a loss of sin^2 where the halves cancel. Binomial: 10 % of 100 gives none with probability
    3e-5."""
    broken = loradar_symbol_errors(-24, 100, np.random.default_rng(4), SYSTEM, detector="coherent")
    whole = loradar_symbol_errors(
        -24, 100, np.random.default_rng(4), SYSTEM, detector="coherent", broken_phase=False
    )
    assert broken.sum() > whole.sum()
    assert whole.sum() <= 1


def own_echo(seed, snr_db=np.inf, unmodulated=False):
    rng = np.random.default_rng(seed)
    truth, _ = echo(rng)
    echoes = Echoes(truth[:1], truth[1:2], truth[None, 2:], np.exp(2j * np.pi * rng.random(1)))
    return truth, loradar_frame(SYSTEM, echoes, ANTENNAS, 10 ** (-snr_db / 10), rng, unmodulated)


def test_loradar_echo_is_the_chirp_times_its_delayed_self():
    """Against the summed sweep of a symbol, a target at rest on boresight; between the points of
    the sweep it errs by alpha dt^2/8 = 5e-7 turns, and 77 GHz tau is rounded to 1e-11. Lost samples
    are exactly 0. Planted bug: no -B tau after the wrap."""
    r = 53.17
    echoes = Echoes(np.array([r]), np.zeros(1), np.zeros((1, 2)), np.ones(1))
    frame = loradar_frame(SYSTEM, echoes, ANTENNAS, 0.0, np.random.default_rng(6))
    tau = 2 * r / 299_792_458.0
    point = 1 / (8 * 640e6)
    for p in (0, 1, 2):
        n = 256 * np.arange(1024)
        cycles = swept_cycles(frame.symbols[p], np.arange(8 * SYSTEM.num_symbols + 1))
        late = n - tau / point
        kept = frame.samples[0, p] != 0
        expected = np.exp(
            2j * np.pi * (77e9 * tau + cycles[n] - np.interp(late, np.arange(cycles.size), cycles))
        )
        assert kept.sum() == pytest.approx(1024 * (1 - 2 * tau / 51.2e-6), abs=3)
        assert np.abs(frame.samples[0, p] - expected)[kept].max() < 1e-4


def test_loradar_senses_and_what_its_discontinuities_cost():
    """Noise-free, off the grid. In band order all parameters lie within a fifth of a cell. The hops
    leave a floor: without data the peak stands 54 dB (at least 40) higher over the background. Left
    uncompensated, the chirps do not add up. Planted bug: samples rolled the other way."""
    bound = resolution(SYSTEM.waveform, ANTENNAS)
    bound[0] = SYSTEM.range_cell
    for seed in (50, 51):
        truth, frame = own_echo(seed)
        found = receive_loradar(frame, SYSTEM, ANTENNAS, SETTINGS)
        first = np.array([found.range[0], found.velocity[0], *found.direction[0]])
        assert (np.abs(first - truth) < 0.2 * bound).all()
        plain = receive_loradar(own_echo(seed, unmodulated=True)[1], SYSTEM, ANTENNAS, SETTINGS)
        raw = receive_loradar(frame, SYSTEM, ANTENNAS, SETTINGS, "none")
        cost = 10 * np.log10(plain.snr[0] / found.snr[0])
        assert cost > 40
        assert raw.snr[0] < found.snr[0] / 10


@pytest.mark.parametrize(
    ("snr_db", "compensation", "least", "most"),
    [(-36, "ordered", 3, 3), (-36, "none", 0, 0), (-56, "ordered", 0, 0)],
)
def test_loradar_hit_rate_ends(snr_db, compensation, least, most):
    """3 frames each, where the rate is 1 (its transition lies near -42 dB), without the phases'
    compensation, and where nothing is."""
    bound = resolution(SYSTEM.waveform, ANTENNAS)
    bound[0] = SYSTEM.range_cell
    count = 0
    for seed in range(60, 63):
        truth, frame = own_echo(seed, snr_db)
        count += hits(
            receive_loradar(frame, SYSTEM, ANTENNAS, SETTINGS, compensation), truth, bound
        )
    assert least <= count <= most
