"""The paper's clutter filter: the runs that it finds, and what it does at either kind of terminal
(notes, section 4)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame, known
from scipy import ndimage

from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.active import receive_active
from isac_rt.receive.clutter_filter import occupied_factor, remove_static, runs
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.symbols import demodulate
from isac_rt.receive.types import Prediction

SHORT = Waveform(num_samples=256)  # the paper's range cells, a quarter of its range and time
FEW = replace(ANTENNAS, rx_x=3, rx_z=2)


def test_runs_are_found_with_gaps_and_short_ones_are_not():
    """20 cells of which two fade, 8 alone, one spike. Planted bug: no closing of gaps."""
    power = np.ones(200)
    power[50:70] = 10
    power[[55, 56]] = 1
    power[100:108] = 10
    power[150] = 1e4
    found = np.flatnonzero(runs(power, 1e4, 15))
    assert np.array_equal(found, np.arange(48, 72))
    assert runs(power, 1e4, 8)[100:108].all()


@pytest.mark.parametrize(("least", "cells"), [(1, 64), (4, 97), (12, 300)])
def test_runs_are_a_closing_then_an_opening(least: int, cells: int):
    """By scipy's binary morphology, occupied cells in clumps at random, up to the edges. Planted
    bugs: a gap of four cells closed; a run at the edge forgotten; the margin wrapped."""
    rng = np.random.default_rng(least)
    clumps = np.cumsum(rng.standard_normal((200, cells)), axis=1) > 2
    clumps[0] = False
    power = np.where(clumps & (rng.random(clumps.shape) < 0.8), 10.0, 1.0)
    power[clumps.mean(axis=1) > 0.4] = 1.0  # the median is that of what is empty
    power[:, [0, -1]] *= rng.choice([1.0, 10.0], (200, 2))
    occupied = np.pad(power > 2.5, [(0, 0), (8, 8)])
    closed = ndimage.binary_closing(occupied, np.ones((1, 4)))
    long = ndimage.binary_opening(closed, np.ones((1, least)))
    expected = ndimage.binary_dilation(long, np.ones((1, 5)))[:, 8:-8]
    assert expected.any()
    assert np.array_equal(runs(power, 1e4, least), expected)


def test_all_chirps_of_all_receivers_tell_a_run_from_noise():
    """One group, 12 chirps, 15 receivers: cells 6 dB over the noise are occupied, for the mean of
    180 exponentials scatters by a thirteenth. Planted bug: looks per receiver, with which only
    cells 10 dB over it would be."""
    rng = np.random.default_rng(12)
    spectra = (rng.standard_normal((1, 15, 90, 12, 2)) @ np.array([1, 1j])).astype(np.complex64)
    spectra[:, :, 40:60] *= 2
    rows = remove_static(spectra, np.zeros((1, 12), np.int64), 15)
    assert np.array_equal(np.flatnonzero(rows), np.arange(38, 62))  # and the margin of two cells


def test_noise_alone_makes_no_run():
    """15 looks, 400 spectra of 512 cells: a run of 15 cells at an occupancy of 1e-3 would be a
    wonder."""
    power = np.random.default_rng(9).gamma(15, 1 / 15, (400, 512))
    assert not runs(power, 15, 15).any()
    assert occupied_factor(1e6) == 2.0 and occupied_factor(1) > 5


def clutter_paths(passes: int, level: float, seed: int, centre: float) -> list[Path]:
    """45 range cells around `centre`, circular Gaussian amplitudes of mean power `level`, at rest,
    anywhere in the view."""
    rng, cell = np.random.default_rng(seed), SHORT.range_cell(passes)
    ranges = (round(centre / cell) - 22 + np.arange(45) + rng.uniform(-0.5, 0.5, 45)) * cell
    amplitudes = np.sqrt(level / 2) * (rng.standard_normal(45) + 1j * rng.standard_normal(45))
    arrivals = rng.uniform(-0.6, 0.6, (45, 2))
    return [
        Path(passes * r, 0.0, a, tuple(u), tuple(u))
        for r, a, u in zip(ranges, amplitudes, arrivals, strict=True)
    ]


def test_what_stands_still_is_removed_and_what_moves_is_not():
    """A cell of standing clutter falls to the rounding of complex64; a target of 5 m/s in it keeps
    its power but for what its mean holds over 40 slots. Planted bug: the mean over all antennas."""
    w, schedule, payload = frame(waveform=SHORT)
    still = clutter_paths(2, 10.0, 3, 25.0)
    target = [Path(2 * 24.3, 2 * 5.1, 1.0, (0.2, 0.1), (0.2, 0.1))]
    row = round(24.3 / w.range_cell(2))
    alone, both = (
        clean_spectrum(cube(w, schedule, payload, p, FEW), known(w, schedule, payload, FEW, 1), 256)
        for p in (target, still + target)
    )
    bare = clean_spectrum(
        cube(w, schedule, payload, still, FEW), known(w, schedule, payload, FEW, 1), 256
    )
    before = np.abs(bare[..., row, :]).max()
    rows = remove_static(bare, schedule, 15)
    assert rows[row] and np.abs(bare[..., row, :]).max() < 3e-5 * before
    remove_static(both, schedule, 15)
    change = np.linalg.norm(both[..., row, :] - alone[..., row, :]) / np.linalg.norm(
        alone[..., row, :]
    )
    assert change < 0.2  # the mean of a tone over 40 random slots is about 1/sqrt(40) of it


def test_all_cells_can_be_filtered():
    """A lone cell that stands still makes no run; without a least number of cells it goes as well,
    to rounding. A tone at bin 21 of 120 loses what each antenna's mean over its 40 slots holds of
    it, by hand. Planted bug: runs of one cell, which leave what is weak."""
    _, schedule, _ = frame(waveform=SHORT)
    tone = np.exp(2j * np.pi * 21 * np.arange(120) / 120).astype(np.complex64)
    spectra = np.zeros((3, 2, 64, 120), np.complex64)
    spectra[:, :, 17] = 100.0
    spectra[:, :, 40] = tone
    kept = spectra.copy()
    assert not remove_static(kept, schedule, 15).any()
    assert np.array_equal(kept, spectra)
    assert remove_static(spectra, schedule, None).all()
    assert np.abs(spectra[:, :, 17]).max() < 1e-4
    for m, tx in ((0, 0), (2, 1)):
        sent = schedule[m] == tx
        assert np.abs(spectra[m, 1, 40, sent] - (tone[sent] - tone[sent].mean())).max() < 1e-6


@cache
def beside_clutter(speed: float, seed: int) -> tuple[Payload, IFCube]:
    """A target of a speed within clutter 10 dB over it, as the active terminal hears it."""
    w, schedule, payload = frame(waveform=SHORT)
    target = Path(2 * 24.31, 2 * speed, 1.0, (0.21, 0.1), (0.21, 0.1))
    paths = [*clutter_paths(2, 10.0, seed, 25.0), target]
    return payload, cube(w, schedule, payload, paths, FEW, noise=25.0, seed=seed)


@pytest.mark.parametrize(
    ("speed", "clutter_filter", "allowed"),
    [
        (5.3, "none", (0, 1, 2)),
        (5.3, "runs", (3,)),
        (0.0, "runs", (0,)),
        (5.3, "zero_doppler", (3,)),
        (0.0, "zero_doppler", (0,)),
    ],
)
def test_the_filter_at_the_active_terminal(speed, clutter_filter, allowed):
    """Notes, section 4: with the filter a moving target inside the clutter is always found, one
    that stands still never. Without the filter it is found in some draws (the two-dimensional CFAR
    looks at other Doppler cells; the notes' map of one range row found none). -14 dB per sample of
    these short chirps (as -20 dB of the paper's); three draws."""
    w, hits = SHORT, 0
    for seed in range(3):
        payload, samples = beside_clutter(speed, seed)
        d = receive_active(
            samples, payload, FEW, Receivers(clutter_filter=clutter_filter)
        ).detections
        near = (np.abs(d.range - 24.31) < w.range_cell(2)) & (
            np.abs(d.velocity - speed) < w.velocity_cell(2)
        )
        if near.any() and speed == 0.0:  # a clutter peak may pass for it: its direction is another
            near &= np.abs(d.direction[:, 0] - 0.21) < 0.03
        hits += bool(near.any())
    assert hits in allowed


@pytest.mark.parametrize(
    ("centre", "clutter_filter", "low", "high"),
    [(30.0, None, 0.9, 1.0), (33.0, 15, 0.0, 0.05), (16.0, 15, 0.9, 1.0)],
)
def test_the_filter_at_a_passive_terminal(centre, clutter_filter, low, high):
    """Notes, section 4: delay symbols are lost to the strongest clutter cell; leaving the run out
    mends it while the line of sight, here at 12.31 m, is outside of the run, and does not where it
    is inside."""
    w, schedule, payload = frame(waveform=SHORT)
    prediction = Prediction(
        range=np.array([12.31]),
        velocity=np.zeros(1),
        direction=np.zeros((1, 2)),
        range_std=np.full(1, 0.05),
        velocity_std=np.full(1, 0.1),
        weight=np.ones(1),
    )
    paths = [Path(12.31, 0.0, 1.0, (0.1, 0.05), (0.0, 0.0)), *clutter_paths(1, 10.0, 4, centre)]
    samples = cube(w, schedule, payload, paths, FEW, noise=2.5, seed=2)
    symbols = demodulate(samples, prediction, 8, clutter_filter)
    rate = np.mean(symbols.delay != payload.delay_symbols)
    assert low <= rate <= high
