"""Thresholds where UAVs are expected: rates in drawn noise, weak waves put where the gate is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from receiver_cubes import ANTENNAS
from scipy import stats

from isac_rt.extensions.city_receivers.angle_doppler import AngleDoppler
from isac_rt.extensions.city_receivers.gates import gates_of, seek
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.directions import searches
from isac_rt.receive.known import Known
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import ExpectedClutter, Gates, Hints

W = Waveform(num_samples=256, num_chirps=60)
ARRAY = replace(ANTENNAS, rx_x=4, rx_z=3)
SENT = Known.unmodulated(W, conventional_schedule(3, 60, 3), ARRAY, 2)
NOTHING = ExpectedClutter(*np.zeros((3, 0)), *np.zeros((2, 0, 3)))
ROWS = 120
FALSE_FAILURE = 1e-6  # statistical


def noise(rng: np.random.Generator, rows: int = ROWS) -> np.ndarray:
    shape = (3, ARRAY.num_rx, rows, W.num_chirps, 2)
    return (rng.standard_normal(shape) @ np.array([1, 1j]) / np.sqrt(2)).astype(np.complex64)


def at(row: float, column: float, u: tuple[float, float]) -> np.ndarray:
    """(4,) range, velocity and cosines of an echo in a row and Doppler bin."""
    delay_rate = column / (W.frame_duration * W.carrier_frequency)
    beat_of_rate = float(W.beat_cells(0.0, delay_rate, 0.0))
    delay = (row - beat_of_rate) / float(W.beat_cells(1e-9, 0.0, 0.0)) * 1e-9
    return np.array([delay * SENT.metres, delay_rate * SENT.metres, *u])


def test_noise_passes_a_gate_at_its_rate():
    """400 gates of some dozens of cells in white noise, and with a covariance that couples the
    channels: at the design or under it, for neighbouring directions are alike, and over a tenth of
    it. Planted bugs: the threshold of one cell (4 times the rate); that of one direction (2.5
    times)."""
    rng, rate, count = np.random.default_rng(5), 0.1, 400
    search = searches(ARRAY, SENT.wavenumber)[1]
    size = len(search.channels)
    mixed = rng.standard_normal((size, size, 2)) @ np.array([1, 1j])
    R = np.eye(size) + 0.3 * mixed @ mixed.conj().T
    root = np.linalg.cholesky(R)
    mean = np.array([at(50, 4, (0.2, -0.1))])
    (gate,) = gates_of(Gates(mean, np.array([[0.4, 0.8, 0.03, 0.03]])), SENT, ROWS)
    limit, n = gate.threshold(search, rate), gate.cell.size
    hits = np.zeros(2, int)
    for _ in range(count):
        x = rng.standard_normal((n, 1, size, 2)) @ np.array([1, 1j]) / np.sqrt(2)
        hits[0] += seek(gate, x, None, search).peak[0] > limit
        same = np.broadcast_to(R, (n, size, size))
        hits[1] += seek(gate, x @ root.T, same, search).peak[0] > limit
    assert n > 9
    assert (stats.binom.ppf(FALSE_FAILURE, count, rate / 10) <= hits).all()
    assert (hits <= stats.binom.isf(FALSE_FAILURE, count, rate)).all()


def test_a_weak_echo_is_found_where_it_is_expected_and_nowhere_else():
    """Waves of T = 11 in white noise, under the threshold of 1e-6 a cell. With gates at three of
    six of them, one at an approaching speed, these are found, in their cells and from their
    directions, and start no track; the others are not. Planted bugs: Doppler's sign; gates'
    verdicts taken for sure ones; the gate's cells Doppler centred."""
    rng = np.random.default_rng(7)
    places = [(20, 5), (35, -9), (50, 0), (65, 12), (80, -20), (95, 7)]
    towards = [(0.1, 0.2), (-0.3, 0.1), (0.4, -0.2), (0.0, 0.0), (0.2, 0.3), (-0.2, -0.3)]
    maps = 0.1 * noise(rng)
    c = searches(ARRAY, SENT.wavenumber)[0].channels
    for (row, column), (x, z) in zip(places, towards, strict=True):
        wave = c.steering(np.array([[x, 0.0, z]]), SENT)[0]
        maps[c.tx, c.rx, row, column] = np.sqrt(0.01 * 11 / len(c)) * wave
    settings = Receivers(clutter_detector="angle_doppler", gate_false_alarm_rate=1e-2)
    sought = np.array([at(*p, u) for p, u in zip(places[:3], towards[:3], strict=True)])
    gates = Gates(sought, np.tile([0.02, 0.05, 0.01, 0.01], (3, 1)))
    (without,) = AngleDoppler(settings).test_cells([maps], SENT, Hints(NOTHING))
    (judged,) = AngleDoppler(settings).test_cells([maps], SENT, Hints(NOTHING, gates))
    half = W.num_chirps // 2
    found = {(int(r), int(b) - half) for r, b in np.argwhere(judged.ratio > 1)}
    assert not (without.ratio > 1).any()
    near = [min(abs(r - p) + abs(b - q) for r, b in found) for p, q in places]
    assert [d <= 1 for d in near] == [True] * 3 + [False] * 3
    assert not (judged.sure > 1).any()
    for (row, column), u in zip(places[:3], towards[:3], strict=True):
        near_it = np.s_[row - 1 : row + 2, column + half - 1 : column + half + 2]
        seen = judged.cosines[near_it].reshape(-1, 2)
        assert np.nanmin(np.abs(seen - u).max(axis=1)) < 0.1


def test_a_strong_echo_from_elsewhere_is_none_of_a_gate():
    """A wave 33 dB over the noise in the cells of a gate, 0.5 beside it in both cosines: what it
    leaves there is over the gate's threshold, and all that is found comes from the wave. Planted
    bug: cells sought that hold something already."""
    maps, away = 0.1 * noise(np.random.default_rng(11)), (-0.3, 0.3)
    c = searches(ARRAY, SENT.wavenumber)[0].channels
    wave = c.steering(np.array([[away[0], 0.0, away[1]]]), SENT)[0]
    maps[c.tx, c.rx, 50, 4] += np.sqrt(0.01 * 2000 / len(c)) * wave
    settings = Receivers(clutter_detector="angle_doppler", gate_false_alarm_rate=1e-2)
    gates = Gates(np.array([at(50, 4, (0.2, -0.2))]), np.array([[0.02, 0.05, 0.01, 0.01]]))
    (judged,) = AngleDoppler(settings).test_cells([maps], SENT, Hints(NOTHING, gates))
    seen = judged.cosines[judged.ratio > 1]
    assert len(seen) and np.abs(seen - away).max() < 0.1


def test_gates_out_of_view_or_too_wide_are_none():
    """By hand: a direction beyond the view, rows beyond the map, and 30 m and
    30 m/s of uncertainty."""
    mean = np.array([at(50, 0, u) for u in ((0.0, 0.0), (0.99, 0.0), (0.0, 0.0), (0.0, 0.0))])
    mean[2] = at(500, 0, (0.0, 0.0))
    std = np.tile([0.02, 0.05, 0.01, 0.01], (4, 1))
    std[3, :2] = 30.0
    gates = list(gates_of(Gates(mean, std), SENT, ROWS))
    assert len(gates) == 1
    assert (gates[0].cell // W.num_chirps == 50).any()
