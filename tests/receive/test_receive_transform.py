"""The fast passes of a reception against sums and searches written out."""

from __future__ import annotations

import numpy as np
import pytest
from receiver_cubes import ANTENNAS
from scipy import ndimage

from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.cfar import peaks
from isac_rt.receive.known import Known
from isac_rt.receive.maps import (
    power_map,
    slow_window,
)
from isac_rt.receive.spectrum import _factors, tones, transform, transform_plain

ROUNDING = 1e-6
"""Of sums in float32 over some hundred terms, relative RMS: some eps = 6e-8 times the root of the
stages."""


def drawn(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


@pytest.mark.parametrize(("size", "chirps"), [(40, 3), (96, 37), (256, 16), (56, 17), (100, 5)])
@pytest.mark.parametrize("plain", [False, True])
def test_transform_is_the_sum(size: int, chirps: int, plain: bool):
    """Blocks of sixteen chirps that are full and not; sizes with a factor 5, 3, 7 (scipy's) and one
    that is no multiple of 8.

    Planted bugs: the cells of the lane transform read at k instead of -k, which turns the other
    way; under Hann's window the first cell's neighbour is the one before the last.
    """
    rng = np.random.default_rng(size)
    samples, factor = drawn(rng, 2, chirps, size), drawn(rng, chirps, size)
    cells = np.array([-3, 0, 5, size // 2 + 1, size - 3])  # the first and the last are one
    phasor, power, tapered, out = (
        drawn(rng, cells.size, chirps),
        np.full((chirps, size), 0.37, np.float32),
        np.full((chirps, size), 0.21, np.float32),
        np.empty((2, 5, chirps), np.complex64),
    )
    method = transform_plain if plain else transform
    method(samples, factor, cells, out, phasor=phasor, power=power, tapered=tapered)
    wave = np.exp(-2j * np.pi * np.outer(np.arange(size), np.arange(size)) / size)
    every = np.einsum("kn,rpn->rpk", wave, samples.astype(complex) * factor)
    expected = every[:, :, cells % size].transpose(0, 2, 1) * phasor
    assert np.linalg.norm(out - expected) < ROUNDING * np.linalg.norm(expected)
    added = (np.abs(every) ** 2).sum(axis=0)
    assert np.linalg.norm(power - 0.37 - added) < ROUNDING * np.linalg.norm(added)
    window = (1 - np.cos(2 * np.pi * np.arange(size) / size)) / 2
    every = np.einsum("kn,rpn->rpk", wave, window * samples.astype(complex) * factor)
    added = (np.abs(every) ** 2).sum(axis=0)
    assert np.linalg.norm(tapered - 0.21 - added) < ROUNDING * np.linalg.norm(added)
    transform(samples, factor, cells, out)
    every = np.einsum("kn,rpn->rpk", wave, samples.astype(complex) * factor)
    expected = every[:, :, cells % size].transpose(0, 2, 1)
    assert np.linalg.norm(out - expected) < ROUNDING * np.linalg.norm(expected)


def test_tones_are_exponentials():
    """Planted bugs: the phase of the fine steps reduced modulo 3/2; factors rounded to complex64
    before their product."""
    frequency = np.array([0.37213, -211.0921, 1e6 + 0.2913])
    expected = np.exp(2j * np.pi * np.outer(frequency, np.arange(75)))
    # one rounding to complex64, and that of a float64 phase of 75e6 cycles in `expected`
    assert np.abs(tones(frequency, 75)[:2] - expected[:2]).max() < 5e-8
    assert np.abs(tones(frequency, 75) - expected).max() < 2e-7


def test_window_and_derotation_are_their_formulas():
    """Windows that begin before the first sample, end after the last, or lie between two samples.
    Planted bugs: what is before a window's start counted from the end; one sample of a window left
    out at its end."""
    size, length, n = 75, 61.3, np.arange(75)
    symbols, starts = np.array([0, 3, -4, 71, 9]), np.array([0.0, 2.71, -3.2, 20.4, 8.0])
    x = n - starts[:, None]
    window = np.where((x >= 0) & (x <= length), 0.5 - 0.5 * np.cos(2 * np.pi * x / length), 0)
    expected = window * np.exp(-2j * np.pi * symbols[:, None] * n / size)
    found = _factors(size, symbols, starts, length)
    assert np.abs(found - expected).max() < 3e-7  # roundings of tones and window


@pytest.mark.parametrize(("groups", "chirps"), [(3, 36), (3, 33), (2, 36)])
def test_power_map_is_the_mean_over_antennas(groups: int, chirps: int):
    """Samples that follow a tone of a fraction of a bin, with delays of the data: the united groups
    show what one antenna that sends in every slot would; two groups the plain correlation. Even and
    odd numbers of chirps.

    Planted bug: the conjugate bin from b x + a y in place of a y - b x.
    """
    w, rng = Waveform(num_groups=groups, num_chirps=chirps), np.random.default_rng(5)
    schedule = pseudo_random_schedule(groups, chirps, w.num_tx, rng)
    symbols = rng.integers(0, w.num_delay_symbols, schedule.shape)
    tone, amplitude = np.array([3.3, -7.2]), drawn(rng, w.num_tx, 2, 2)  # tx, rx, row
    known = Known(w, schedule, symbols, np.ones(schedule.shape, complex), ANTENNAS, 2)
    times = known.slots
    spectra = amplitude[schedule].transpose(0, 2, 3, 1) * np.exp(
        2j * np.pi * tone[:, None] * times[:, None, None, :] / chirps
    )
    got = power_map(spectra.astype(np.complex64), known)
    bins = np.fft.fftshift(np.fft.fftfreq(chirps, 1 / chirps))
    window = slow_window(w).astype(float)
    expected = np.zeros((2, chirps))
    for tx in range(w.num_tx):
        sent = schedule == tx
        slots = np.arange(chirps)[None] + np.zeros((groups, 1), int)
        at = slots[sent] if groups == 3 else times[sent]
        for row in range(2):
            seen = (
                np.exp(2j * np.pi * (tone[row] - bins)[:, None] * at / chirps) @ window[slots[sent]]
            )
            expected[row] += np.abs(seen) ** 2 * (np.abs(amplitude[tx, :, row]) ** 2).sum()
    expected /= w.num_tx * 2
    # the resampling of the united groups leaves -60 dB at other velocities; the correlation only
    # rounds
    tolerance = 3e-3 if groups == 3 else 1e-5
    assert np.abs(np.sqrt(got) - np.sqrt(expected)).max() < tolerance * np.sqrt(expected.max())


@pytest.mark.parametrize("reach", [(1, 1), (8, 8), (2, 40)])
def test_peaks_against_a_maximum_filter(reach: tuple[int, int]):
    """Planted bug: the window along range ends a row early."""
    power = np.random.default_rng(2).gamma(2.0, size=(60, 35)).astype(np.float32)
    above = power > 4.0
    largest = ndimage.maximum_filter(
        power, size=(2 * reach[0] + 1, 2 * min(reach[1], 17) + 1), mode=("nearest", "wrap")
    )
    rows, bins = peaks(power, above, reach)
    assert rows.size and set(zip(rows, bins, strict=True)) == set(
        zip(*np.nonzero(above & (power == largest)), strict=True)
    )
    assert (np.diff(power[rows, bins]) <= 0).all()
