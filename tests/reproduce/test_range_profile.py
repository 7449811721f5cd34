"""Delay symbols in clutter that is stronger than the line of sight, by the strongest cell and by
the range profile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame

from isac_rt.frame.payload import unmodulated
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.symbols import decide
from isac_rt.receive.types import Prediction
from reproduce.range_profile import correlate, derotation, learn_profile

SHORT = Waveform(num_samples=256, num_chirps=60)


def scene(seed: int) -> tuple[list[Path], Prediction]:
    """A line of sight and 40 cells of standing Rayleigh clutter from a cell behind it on, 10 dB
    stronger each."""
    rng, cell = np.random.default_rng(seed), SHORT.range_cell(1)
    amplitude = np.sqrt(10 / 2) * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
    ranges = 11.31 + cell * (1 + np.arange(40) + rng.uniform(-0.5, 0.5, 40))
    there, here = rng.uniform(-0.7, 0.7, (2, 40, 2))
    clutter = [
        Path(r, 0.0, a, tuple(u), tuple(v))
        for r, a, u, v in zip(ranges, amplitude, there, here, strict=True)
    ]
    one = np.ones(1)
    expected = Prediction(
        range=11.31 * one,
        velocity=0 * one,
        direction=np.zeros((1, 2)),
        range_std=0.01 * one,
        velocity_std=0.1 * one,
        weight=one,
    )
    return [Path(11.31, 0.0), *clutter], expected


@pytest.mark.parametrize("snr_db", [-18.0, -8.0])
@pytest.mark.slow
def test_the_profile_reads_what_the_strongest_cell_does_not(snr_db: float):
    """Per-sample SNR of the line of sight. The strongest cell is one of the clutter's in most
    chirps; the learned profile has at most one symbol in 180 wrong. Planted bug: correlation not
    conjugated, so that the template lies before the reference."""
    w, schedule, payload = frame(waveform=SHORT)
    paths, expected = scene(5)
    noise = 10 ** (-snr_db / 10)
    profile = learn_profile(cube(w, schedule, unmodulated(w), paths, ANTENNAS, noise, 1), expected)
    received = cube(w, schedule, payload, paths, ANTENNAS, noise, 2).samples
    wrong = {"cell": 0, "profile": 0}
    for group, turn, sent in zip(
        received, derotation(w, expected), payload.delay_symbols, strict=True
    ):
        power = (np.abs(np.fft.fft(group * turn, axis=2)) ** 2).sum(axis=0)
        wrong["cell"] += int((decide(power, [], w)[0] != sent).sum())
        wrong["profile"] += int((decide(correlate(power, profile), [], w)[0] != sent).sum())
    assert wrong["cell"] > 0.8 * payload.delay_symbols.size and wrong["profile"] <= 1


def test_profile_is_the_cells_power_over_noise():
    """The reference and a path 3 cells behind it: N times their SNR in their cells, next to nothing
    far away. Planted bugs: cells counted from range 0; the velocity left out or in other units."""
    w, schedule, _ = frame(waveform=SHORT)
    expected = replace(
        scene(5)[1], velocity=np.array([23.7])
    )  # a tenth of a cell of coupling, and of migration
    paths = [Path(11.31, 23.7, 0.3), Path(11.31 + 3 * w.range_cell(1), 23.7, 0.2)]
    profile = learn_profile(cube(w, schedule, unmodulated(w), paths, ANTENNAS, 1.0, 1), expected)
    spread = 6 / np.sqrt(180 * 15)  # statistical
    assert profile[0] == pytest.approx(0.09 * 256, rel=0.02 + spread)
    assert profile[3] == pytest.approx(0.04 * 256, rel=0.02 + spread)
    assert (profile[20:240] > 0).sum() < 6


def test_noise_keeps_mean_and_spread_in_the_metric():
    """2000 chirps of noise, a template of 25 cells: mean and variance of the metric are those of a
    cell's power. Planted bug: divided by the sum of the weights."""
    # each row's own median is taken for its noise, which takes a few per cent of the spread with it
    power = np.random.default_rng(8).gamma(15, 1 / 15, (2000, 256))
    profile = np.zeros(256)
    profile[:25] = 2.0
    metric = correlate(power, profile)
    assert metric.mean() == pytest.approx(1, abs=0.15)
    assert metric.var() == pytest.approx(1 / 15, rel=0.12)
