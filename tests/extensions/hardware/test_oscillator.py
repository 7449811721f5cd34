"""Phase noise: closed forms of the increments, the spectrum, one process whatever is asked for
first."""

from __future__ import annotations

from math import erfc, pi, sqrt

import numpy as np
import pytest
from scipy.signal import welch

from isac_rt.extensions.hardware.chain import add_phases
from isac_rt.extensions.hardware.oscillator import Mask, Oscillator, Record, _between, cubic, spread

RATE = 20e6
SLOT = 64.8e-6
FREE = Mask(((1e4, -55.0), (1e7, -115.0)), locked=False)
"""-95 dBc/Hz at 1 MHz and 20 dB less for each decade."""
LOCKED = Mask(((3e5, -90.0), (1e7, -90.0 - 20 * np.log10(1e7 / 3e5))))


def oscillator(mask=FREE, name="A"):
    return Oscillator(mask, RATE, 5, name)


def increments(one, apart, begin):
    """Phase differences over `apart`, one after the other for 7 ms."""
    record = one.record(begin, begin + 7e-3)
    times = begin + np.arange(int(7e-3 / apart)) * apart
    return np.diff(record.at(times))


def test_a_free_oscillator_walks_as_its_linewidth_says():
    """A Lorentzian of linewidth 2 pi f^2 L(f) = 1987 Hz turns by sqrt(2 pi 1987 T) = 0.899 rad in
    64.8 us, two of them by 1.272 rad. 2100 increments: 1.5 % of one standard deviation, 5 % here.
    Planted bug: S(f) = L(f)."""
    assert 2 * pi * 1e12 * FREE.level(np.array([1e6]))[0] == pytest.approx(1987, rel=1e-3)
    begins = 0.37 * np.arange(20)
    a = np.concatenate([increments(oscillator(), SLOT, t) for t in begins])
    b = np.concatenate([increments(oscillator(name="B"), SLOT, t) for t in begins])
    assert a.std() == pytest.approx(0.8995, rel=0.05)
    assert (a - b).std() == pytest.approx(1.272, rel=0.05)
    wrong = [np.mean(np.abs((d := a - b) - 2 * pi * np.rint(d / 2 / pi)) > pi / D) for D in (2, 8)]
    # 2100 trials: 0.9 % and 1.0 % of one standard deviation
    assert wrong == pytest.approx([0.217, 0.758], abs=0.04)


@pytest.mark.parametrize(
    ("slope", "turn", "of_sixteen"), [(20, 0.0693, 0.0046), (10, 0.1039, 0.0588)], ids=str
)
def test_a_locked_oscillator_lets_eight_phases_through(slope, turn, of_sixteen):
    """Plateau of -90 dBc/Hz to 300 kHz, then 20 or 10 dB less a decade up to 10 MHz. Two of them
    turn the phase from chirp to chirp by sqrt(8 10^-9 3e5 (1 + 1)) or sqrt(8 10^-9 3e5 (1 + ln
    33.3)) rad: 8-DPSK works, and of 16 phases 0.5 or 6 % are wrong. 1300 increments: 2 %
    of one standard deviation. Planted bug: a mask that goes on rising below its first point."""
    mask = Mask(((3e5, -90.0), (1e7, -90.0 - slope * np.log10(1e7 / 3e5))))
    begins = 0.1 * np.arange(12)
    a, b = (
        np.concatenate([increments(oscillator(mask, name), SLOT, t) for t in begins])
        for name in "AB"
    )
    sigma = (a - b).std()
    assert sigma == pytest.approx(turn, rel=0.06)
    assert erfc(pi / 8 / (sigma * sqrt(2))) < 4e-4
    assert erfc(pi / 16 / (turn * sqrt(2))) == pytest.approx(of_sixteen, rel=0.02)


@pytest.mark.parametrize(("distance", "level"), [(10, -102.6), (50, -88.6), (100, -82.6)], ids=str)
def test_one_oscillator_both_ways_hears_near_echoes_clean(distance, level):
    """At 100 kHz, where the oscillator has -75.0 dBc/Hz, the echo's skirt is 4 sin^2(pi f tau)
    lower. Welch's mean over 60 lines of 31 parts: 0.15 dB of one standard deviation. Planted
    bug: sin^2 without the 4."""
    delay = 2 * distance / 299_792_458
    record = oscillator().record(0.5, 0.528)
    times = 0.5 + 1e-5 + np.arange(2**19) / RATE
    heard = record.at(times) - record.at(times - delay)
    offset, density = welch(heard, RATE, nperseg=2**15)
    here = np.abs(offset - 1e5) < 2e4
    middle = 10 * np.log10((density[here] / 2).mean())
    assert middle == pytest.approx(level, abs=1.0)


def test_spectrum_is_the_mask_across_the_bands():
    """1/f^3, plateau and floor, over the border of the two fastest bands at 19.5 kHz: each level
    is the mask's, within the scatter of Welch's mean. Planted bug: a band that begins at its
    highest frequency."""
    mask = Mask(((1e3, -60.0), (1e4, -90.0), (1e5, -90.0), (1e6, -120.0), (1e7, -120.0)), False)
    record = oscillator(mask).record(3.0, 3.11)
    offset, density = welch(record.values, 1 / record.step, nperseg=2**16)
    for at, level in ((3e3, -74.31), (1.2e4, -90.0), (3e4, -90.0), (3e5, -104.3), (6e6, -120.0)):
        here = np.abs(offset / at - 1) < 0.15
        found = 10 * np.log10((density[here] / 2).mean())
        assert found == pytest.approx(level, abs=1.5), at


def test_any_instant_is_made_without_those_before():
    """The same values whatever stretch they are asked in; other terminals have others. Planted
    bug: a block drawn from the first place that is asked for."""
    one = oscillator()
    late, later = one.record(7.0, 7.004), one.record(7.002, 7.006)
    times = np.linspace(7.0021, 7.0039, 77)
    # the two are read at places between samples that differ by the rounding of 7 s: 1e-15 s, times
    # at most 1e5 rad/s
    np.testing.assert_allclose(late.at(times), later.at(times), atol=1e-8)
    other = oscillator(name="B").record(7.0, 7.004)
    assert abs(np.corrcoef(np.diff(late.values), np.diff(other.values))[0, 1]) < 0.02


def test_no_step_where_blocks_and_bands_meet():
    """Largest difference of neighbours within six standard deviations, over several blocks of the
    two fastest bands. Planted bug: weights cos and sin in place of sin and cos."""
    record = oscillator(LOCKED).record(0.0, 0.03)
    steps = np.diff(record.values)
    assert np.abs(steps).max() < 6.5 * steps.std()
    # the power of the process does not change where blocks meet
    parts = record.values[: 2**20].reshape(64, -1).var(axis=1)
    assert parts.max() < 2.2 * parts.min()


def test_cubic_goes_through_cubics():
    """Planted bug: x - n of the other sample."""
    x = np.array([0.0, 0.21, 0.5, 0.93])
    n = np.arange(-1, 3)
    for power in range(4):
        np.testing.assert_allclose(cubic(x) @ n.astype(float) ** power, x**power, atol=1e-13)


def test_means_are_integrals_of_the_phase():
    """Over 51.2 us from any instant: the trapezoid through every value, whose ends are the cubic's.
    What is left is the curve between two values. Planted bugs: sums of one block fewer; half of
    the value left out."""
    record = oscillator(LOCKED).record(0.0, 0.002)
    begin = np.array([[1.3e-5, 2.71e-4], [9.002e-4, 1.717e-3]])
    found = record.means(51.2e-6)(begin)
    fine = np.arange(64 * 2048 + 1) * record.step / 64
    truth = np.array([np.trapezoid(record.at(t + fine), fine) for t in begin.ravel()]) / 51.2e-6
    # a record's own scatter is 0.05 rad; values that lie 25 ns apart
    np.testing.assert_allclose(found, truth.reshape(begin.shape), atol=1e-6)
    assert np.ptp(found) > 1e-3


def test_spread_adds_up():
    """A white floor of -120 dBc/Hz over 10 MHz has 2e-5 rad^2, twice that between two instants
    far apart, of which next to nothing is left in the mean over a chirp. Planted bug: sinc without
    the square."""
    white = Mask(((1e3, -120.0), (1e7, -120.0)))
    mean, inside = spread(white, 1e-3, 50e-6, RATE)
    assert mean + inside == pytest.approx(4e-5, rel=0.03)  # sin^2 of 10,000 turns on 4000 places
    assert mean == pytest.approx(2 * 2e-12 / (2 * 50e-6), rel=0.05)  # its noise bandwidth: 1/(2 T)


def test_bands_are_read_between_their_values():
    """A third-degree polynomial is exact. Planted bug: a window that begins one value later."""
    poly = np.polynomial.Polynomial([0.3, -1.1, 0.07, 0.013])
    for first, count in ((19, 61), (7, 1), (14, 7), (20, 3)):
        found = _between(poly(np.arange(14)), 7, first, count)
        np.testing.assert_allclose(found, poly((first + np.arange(count)) / 7), atol=1e-11)


def test_rows_of_samples_lie_in_the_phase():
    """Rows that are not a multiple of the vector's length, against a polynomial of the time."""
    poly = np.polynomial.Polynomial([0.4, 31.0, -170.0, 900.0])
    step, start, begin = 1e-3, -0.02, np.array([-0.0117, 0.00031])
    record = Record(start, step, poly(start + step * np.arange(140)))
    out = np.full((2, 37), 0.25)
    add_phases(out, record, begin, -1.0)
    time = begin[:, None] + 2 * step * np.arange(37)
    np.testing.assert_allclose(out, 0.25 - poly(time) / (2 * pi), atol=1e-9)
