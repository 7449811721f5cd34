"""Errors of elements: what is stated and drawn, in delays and factors, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.hardware.channels import Elements as Errors
from isac_rt.extensions.hardware.channels import elements_of
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.front_end import Elements

C = 299_792_458.0
WAVE = C / 77e9
ARRAYS = Antennas(
    tx_x=2, tx_z=2, rx_x=3, rx_z=2, spacing=0.5774 * WAVE, gain=10**0.5, pattern="cosine"
)


def directions(*degrees):
    """Unit vectors at azimuths in the horizontal plane."""
    a = np.radians(degrees)
    return np.stack([np.sin(a), np.cos(a), 0 * a], axis=1)


def built(**stated):
    return elements_of(Elements(**stated), ARRAYS.rx_positions, WAVE, 7, "PT", "rx")


def factors(one, u):
    return one.factors(u, ARRAYS.rx_positions, 77e9)


def test_gain_and_phase_are_those_stated():
    """6 dB is a factor of 1.995. Planted bug: 10^(dB/10)."""
    one = built(gain_db=(6, 0, 0, -20), phase_deg=(0, 90, 0, 180))
    truth = [10**0.3, 1j, 1, -0.1]
    np.testing.assert_allclose(factors(one, directions(0, 40)), [truth, truth], atol=1e-12)
    assert np.all(one.delay == 0)


def test_draws_scatter_as_stated_and_differ_by_terminal():
    """400 terminals of 4 elements: 1.8 % of one standard deviation. Planted bugs: one draw for all
    quantities; one for all antennas of a terminal."""
    stated = Elements(gain_std_db=1.0, phase_std_deg=3.0, delay_std_ps=5.0)
    drawn = [elements_of(stated, ARRAYS.rx_positions, WAVE, 1, f"U{i}") for i in range(400)]
    gain = np.concatenate([one.gain for one in drawn])
    delay = np.concatenate([one.delay for one in drawn])
    db, turn = 20 * np.log10(np.abs(gain)), np.degrees(np.angle(gain))
    assert db.std() == pytest.approx(1.0, rel=0.07)
    assert turn.std() == pytest.approx(3.0, rel=0.07)
    assert delay.std() == pytest.approx(5e-12, rel=0.07)
    assert abs(np.corrcoef(db, turn)[0, 1]) < 0.1
    assert abs(np.corrcoef(db, delay)[0, 1]) < 0.1
    for values in (db, turn, delay):  # of one terminal's antennas against each other
        assert abs(np.corrcoef(*values.reshape(400, -1)[:, :2].T)[0, 1]) < 0.2


def test_coupling_by_level_falls_with_the_square_of_the_distance():
    """Three in a row, half a wavelength apart: -20 dB turned by half a turn between neighbours,
    -32 dB and a whole turn between the ends. Planted bug: the distance itself."""
    row = np.array([[i * WAVE / 2, 0, 0] for i in range(3)])
    one = elements_of(Elements(coupling_db=-20), row, WAVE, 1, "x")
    truth = [[1, -0.1, 0.025], [-0.1, 1, -0.1], [0.025, -0.1, 1]]
    np.testing.assert_allclose(one.coupling, truth, atol=1e-12)


def test_coupling_adds_what_the_neighbours_hear():
    """Two elements half a wavelength apart, a wave from 30 degrees: waves exp(j k r.u) of
    the antennas, coupled, then conjugated by the mixer, over what the element alone would give.
    Planted bug: the matrix not conjugated."""
    pair = np.array([[0.25 * WAVE, 0, 0], [-0.25 * WAVE, 0, 0]])
    matrix = np.array([[1, 0.1j], [0.2, 1]])
    one = Errors(np.ones(2, complex), np.zeros(2), matrix)
    found = one.factors(directions(30), pair, 77e9)[0]
    k = 2 * np.pi / WAVE
    waves = np.exp(1j * k * 0.5 * np.array([0.25, -0.25]) * WAVE)
    truth = np.conj(matrix @ waves) / np.conj(waves)
    np.testing.assert_allclose(found, truth, atol=1e-12)


def test_one_value_is_that_of_all_elements():
    """Planted bug: the first element's alone."""
    one = built(delay_ps=(228,), gain_db=(6,))
    np.testing.assert_allclose(one.delay, np.full(4, 228e-12), rtol=1e-12)
    np.testing.assert_allclose(one.gain, np.full(4, 10**0.3), rtol=1e-12)
