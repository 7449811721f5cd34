"""Delay symbols in clutter that is stronger than the line of sight, by the strongest cell and by
the range profile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame

from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.symbols.powers import confidence_threshold
from isac_rt.receive.symbols.profile import ByProfile, correlate, learn_profile
from isac_rt.receive.types import Detections, Prediction

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
def test_the_profile_reads_what_the_strongest_cell_does_not(snr_db: float):
    """Per-sample SNR of the line of sight. The strongest cell is one of the clutter's in most
    chirps; the learned profile has at most one symbol in 180 wrong. Planted bug: correlation not
    conjugated, so that the template lies before the reference."""
    w, schedule, payload = frame(waveform=SHORT)
    paths, expected = scene(5)
    noise = 10 ** (-snr_db / 10)
    profile = learn_profile(cube(w, schedule, unmodulated(w), paths, ANTENNAS, noise, 1), expected)
    received = cube(w, schedule, payload, paths, ANTENNAS, noise, 2)
    plain = ByProfile(8).read(received, expected, ANTENNAS)
    read = ByProfile(8).read(received, expected, ANTENNAS, profile)
    assert (plain.delay != payload.delay_symbols).mean() > 0.8
    assert (read.delay != payload.delay_symbols).sum() <= 1
    assert np.median(read.delay_confidence) > confidence_threshold(15, 136, 180)


def moving(paths: list[Path], frames: float, rng: np.random.Generator) -> list[Path]:
    """The same clutter after so many frames in which each scatterer has come a twentieth of a cell
    nearer: its carrier has turned by any angle."""
    cell, first = SHORT.range_cell(1), paths[0]
    turned = np.exp(2j * np.pi * rng.random(len(paths)))
    nearer = [
        replace(p, length=p.length - 0.05 * cell * frames, amplitude=p.amplitude * turn)
        for p, turn in zip(paths[1:], turned[1:], strict=True)
    ]
    return [first, *nearer]


def seen(expected: Prediction) -> Detections:
    """The reference as it was expected."""
    none = np.zeros((1, 4))
    yes = np.ones(1, bool)
    return Detections(
        range=expected.range,
        velocity=expected.velocity,
        direction=expected.direction,
        snr=np.ones(1),
        std=none,
        is_reference=yes,
    )


def test_the_profile_is_learned_anew_from_what_was_read():
    """At -18 dB a sample, clutter that moves by a cell in twenty frames: what a terminal learns of
    a data frame is what it would learn of one without data, and it reads on where the first
    profile is a cell off. Planted bug: the symbols not taken out."""
    w, schedule, _ = frame(waveform=SHORT)
    paths, expected = scene(5)
    rng, noise = np.random.default_rng(31), 10**1.8
    pilot = cube(w, schedule, unmodulated(w), paths, ANTENNAS, noise, 99)
    reader, first = ByProfile(8), learn_profile(pilot, expected)
    profile = first
    for n in (10, 20):
        payload = random_payload(w, schedule, 8, rng)
        received = cube(w, schedule, payload, moving(paths, n, rng), ANTENNAS, noise, n)
        read = reader.read(received, expected, ANTENNAS, profile)
        assert (read.delay != payload.delay_symbols).sum() <= 2
        profile = reader.learn(received, seen(expected), read.raw)
    old = reader.read(received, expected, ANTENNAS, first)
    assert (old.delay != payload.delay_symbols).mean() > 0.3


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
