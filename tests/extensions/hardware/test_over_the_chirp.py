"""Gain over the chirp and errors of its frequency."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.hardware.sweep import READ_ERROR, Ramp, read_at, response_of, short_read
from isac_rt.frame.front_end import Response


def test_tables_are_decibels_and_degrees():
    """Straight lines from 2 dB by 0 dB to 1 dB, and from a quarter turn to none and back. Planted
    bugs: places from 0 to 1; beyond the swept band nothing, or the other end."""
    one = response_of(Response(table_db=(2, 0, 1), table_deg=(90, 0, 90)), 2, 1, "A")
    found = one.at(np.array([-1.0, 0.0, 0.5, 1.0]))
    truth = 10 ** (np.array([2, 0, 0.5, 1]) / 20) * np.exp(0.5j * np.pi * np.array([1, 0, 0.5, 1]))
    np.testing.assert_allclose(found, [truth, truth], atol=1e-12)
    assert one.common
    beyond = one.at(np.array([-1.3, -1.01, 1.01, 1.3]))
    np.testing.assert_allclose(beyond, np.repeat(truth[[0, 3]], 2)[None].repeat(2, axis=0))


def test_slopes_differ_by_element():
    one = response_of(Response(slope_std_db=1.0), 400, 1, "A")
    middle, end = one.at(np.array([0.0, 1.0])).T
    assert np.all(middle == 1)
    assert (20 * np.log10(np.abs(end))).std() == pytest.approx(1.0, rel=0.15)


def test_cycles_are_the_integral_of_the_frequency():
    """Planted bug: x^4/3."""
    ramp = Ramp(64e3, 5e3, 7e-6, 54e-6)
    time = np.linspace(0, 54e-6, 20001)
    steps = np.diff(ramp.cycles(time)) / np.diff(time)
    middle = (time[1:] + time[:-1]) / 2
    np.testing.assert_allclose(steps, ramp.frequency(middle), atol=0.5)
    assert ramp.cycles(np.array([27e-6]))[0] == pytest.approx(0, abs=1e-9)


def test_tones_are_read_between_samples():
    """A tone within a third of the sampling rate to both sides, at places up to two samples away,
    away from the ends: what a Kaiser window of 13 samples leaves, 60 dB lower. Planted bug: read to
    the other side."""
    n = np.arange(400)
    shift = 1.9 * np.sin(n / 60)
    first, weights = read_at(shift)
    for frequency in (-0.33, -0.1, 0.0, 0.21, 0.33):
        tone = np.exp(2j * np.pi * frequency * np.arange(first, 400 + len(weights)))
        found = sum(weights[t] * tone[t : t + 400] for t in range(len(weights)))
        truth = np.exp(2j * np.pi * frequency * (n + shift))
        assert np.abs(found - truth).max() < 2e-3, frequency


@pytest.mark.parametrize("most", [0.01, 0.05, 0.1])
def test_few_taps_read_places_nearby(most):
    """The same tones up to a tenth of a sample away: by the stated bound at most, while the place
    itself is off by ten times as much. Beyond, few taps do not. Planted bugs: read to the other
    side; the bend left out."""
    n = np.arange(8, 200)
    shift = most * np.sin(n / 9)
    taps = short_read(most)
    for frequency in (-0.33, -0.1, 0.0, 0.21, 0.33):
        tone = np.exp(2j * np.pi * frequency * np.arange(210))
        slope = sum(a * (tone[n + t] - tone[n - t]) for t, (a, _) in enumerate(taps))
        curvature = taps[0, 1] * tone[n]
        curvature = curvature + sum(
            b * (tone[n + t] + tone[n - t]) for t, (_, b) in enumerate(taps) if t
        )
        truth = np.exp(2j * np.pi * frequency * (n + shift))
        found = tone[n] + shift * (slope + shift * curvature)
        assert np.abs(found - truth).max() < 1.05 * READ_ERROR, frequency
    assert short_read(0.4) is None
