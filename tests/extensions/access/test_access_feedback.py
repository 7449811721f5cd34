"""Feedback: whole-cell slips planted at a passive terminal and repaired by what the active one
knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube
from scipy import stats

from isac_rt.extensions.access.feedback import Feedback, correct, frames_to_repair, summarise
from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Prediction

W = Waveform(num_samples=256, num_chirps=60)
FEW = replace(ANTENNAS, rx_x=2, rx_z=2, spacing=0.5774 * W.wavelength)
CELL = W.range_cell(1)
SIGMAS = 4.5  # statistical: fails by chance once in 10^5


def decoded(frame, error_cells):
    """A data frame at 0 dB per sample from 21.317 m, read with a range that is wrong by so many
    cells."""
    rng = np.random.default_rng([31, frame])
    schedule = pseudo_random_schedule(W.num_groups, W.num_chirps, W.num_tx, rng)
    sent = random_payload(W, schedule, 8, rng)
    samples = cube(W, schedule, sent, [Path(21.317, -3.1)], FEW, noise=1.0, seed=frame)
    known = Prediction(
        range=np.array([21.317 + error_cells * CELL]),
        velocity=np.array([-3.1]),
        direction=np.zeros((1, 2)),
        range_std=np.array([0.02]),
        velocity_std=np.array([0.1]),
        weight=np.ones(1),
    )
    got = receive_passive(samples, FEW, Receivers(), 8, known, True)
    return got, float((got.delay_symbols != sent.delay_symbols).mean())


@pytest.mark.parametrize("slip", [-3, -1, 1, 3])
def test_planted_slips_are_repaired_by_the_next_feedback(slip):
    """A slip from frame 2 on, feedback after every 4th frame, one frame of travel: frames 2, 3 and
    4 are wrong (delay SER over 0.9) and none before or after. The echo is good to 0.09 m, a fifth
    of a cell.

    Planted bug: the sign of the correction."""
    period, error, pending = 4, 0, None
    rng = np.random.default_rng(abs(slip))
    wrong = []
    for frame in range(8):
        error += slip if frame == 2 else 0
        got, ser = decoded(frame, error)
        assert got.decoded
        wrong.append(ser > 0.9)
        assert ser > 0.9 or ser == 0
        if pending is not None:
            error -= pending
            pending = None
        if frame % period == period - 1:
            told = summarise(got, 21.317 + error * CELL + 0.01 * rng.normal(), 0.01, 3, W)
            answer = correct(told, 21.317 + 0.09 * rng.normal(), 0.09, 20e-12, W)
            assert answer.sure
            assert answer.cells == error
            pending = answer.cells
    assert sum(wrong) == frames_to_repair(2, period) == 3
    assert wrong == [False, False, True, True, True, False, False, False]


def test_one_wrong_decision_at_either_end_does_no_harm():
    """The surest two symbols of a frame read far outside the alphabet: the ends are those of all
    others. Planted bugs: the lowest and the highest taken; the third ones."""
    got, _ = decoded(1, 0)
    raw, order = got.raw_delay_symbols.copy(), np.argsort(got.delay_confidence, axis=None)
    others = np.sort(raw.ravel()[order[:-2]])
    raw.ravel()[order[-2:]] = -41, 733
    told = summarise(replace(got, raw_delay_symbols=raw), 21.3, 0.01, 3, W)
    assert told.decided == raw.size
    assert (told.lowest, told.highest) == (others[0], others[-1])


@pytest.mark.parametrize("share", [0.21, 0.33])
def test_without_symbols_the_echo_decides_as_the_normal_law_says(share):
    """The likeliest slip is wrong with 2 Q(1/2 cell / sigma), and is sure only when its posterior
    is 0.999; then it is wrong at most once in 1000. Planted bug: the echo's spread left out of
    sigma."""
    rng, trials = np.random.default_rng(12), 4000
    hits = sure = sure_wrong = 0
    expected = 0.0
    for _ in range(trials):
        slip, a, b = rng.integers(-5, 6), rng.normal(), rng.normal()
        std = share * CELL * np.array([0.6, 0.8])  # 0.6^2 + 0.8^2 = 1
        told = Feedback(40.0 + slip * CELL + std[0] * a, std[0], None, None, 0)
        answer = correct(told, 40.0 + std[1] * b, std[1], 0.0, W)
        hits += abs(std[0] * a + std[1] * b) < CELL / 2
        expected += answer.probability
        sure += answer.sure
        sure_wrong += answer.sure and answer.cells != slip
    right = 1 - 2 * stats.norm.sf(0.5 / share)
    assert abs(hits - trials * right) < SIGMAS * np.sqrt(trials * right * (1 - right))
    # the mean posterior of the likeliest is its rate of being right
    assert abs(expected - trials * right) < SIGMAS * np.sqrt(trials * right * (1 - right))
    assert (sure > 0) == (
        share < 0.25
    )  # 2 exp(-1/2 share^2) is 2 % at 0.33 even in the middle of a cell
    assert sure_wrong <= 0.001 * sure + SIGMAS * np.sqrt(0.001 * sure) + 1


def test_the_alphabet_bounds_the_slip():
    """Symbols read -2 .. 124 of 128 allow slips of 2 and 3 only; a poor echo (1 cell) then chooses
    between two and is not sure, one that says 2.1 cells with 0.15 is; an echo of something else is
    none. Planted bug: bounds of the other sign."""
    told = Feedback(40.0, 0.001, -2, 124, 300)
    poor = correct(told, 40.0 - 2.1 * CELL, 1.0 * CELL, 0.0, W)
    assert not poor.sure
    assert poor.cells == 0
    assert 0.5 < poor.probability < 0.7
    good = correct(told, 40.0 - 2.1 * CELL, 0.15 * CELL, 0.0, W)
    assert good.sure
    assert good.cells == 2
    assert correct(told, 40.0 - 9.4 * CELL, 0.15 * CELL, 0.0, W).probability == 0
    # symbols from both ends outside the alphabet: no slip explains them
    assert correct(Feedback(40.0, 0.001, -2, 129, 300), 40.0, 0.1, 0.0, W).probability == 0


@pytest.mark.parametrize(("first", "frames"), [(0, 26), (24, 2), (25, 26), (13, 13)])
def test_the_frames_to_repair_are_those_that_go_by(first, frames):
    """Counted by hand for a period of 25 and one frame of travel. Planted bug: the travel left
    out."""
    assert frames_to_repair(first, 25) == frames
