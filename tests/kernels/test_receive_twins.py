"""Kernels of the receivers against their numpy twins, on generic numbers."""

from __future__ import annotations

import numpy as np
import pytest
from receiver_cubes import ANTENNAS
from twins import assert_twins_agree

from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.jit import TWINS
from isac_rt.kernels.receive_directions import REACH, TABLE_STEPS
from isac_rt.kernels.receive_maps import ROWS
from isac_rt.kernels.vector import PART, aligned
from isac_rt.receive import cfar, directions, estimate, maps, spectrum  # noqa: F401  # their twins
from isac_rt.receive.clutter import covariance  # noqa: F401  # its twin
from isac_rt.receive.known import Known

SINGLE = 3e-6  # float32 sums of some hundred numbers


def complex_noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal((*shape, 2)) @ [1, 1j]).astype(np.complex64)


def test_tones():
    """Planted bug in the kernel: a tone begins at sample 1."""
    frequency = np.random.default_rng(1).uniform(-0.7, 0.7, 11)
    out = np.zeros((11, 304), np.complex64)
    assert_twins_agree("isac_rt.receive.spectrum.fill_tones", frequency, out, rtol=5e-7)


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("chirps", [60, 45])
def test_maps(kept: bool, chirps: int):
    """Even and odd numbers of bins. Planted bugs in the kernel: the opposite bins not conjugated;
    the last row of a block left out."""
    rng, w = np.random.default_rng(2), Waveform(num_samples=64, num_chirps=chirps)
    schedule = conventional_schedule(3, chirps, 3)
    payload = random_payload(w, schedule, 8, rng)
    known = Known(w, schedule, payload.delay_symbols, payload.phases, ANTENNAS, 1)
    spectra = complex_noise(rng, 3, 4, 29, chirps)
    ends, places, factors = maps._operators(known)
    places = 2 * (places[0] * np.uint64(spectra[0].size) + places[1])
    room = aligned(4 * ROWS * len(factors) * PART)
    made = np.zeros((3 if kept else 0, 4, 29, chirps), np.complex64)
    args = spectra.reshape(-1).view(np.float32), spectra.shape, ends, places, factors
    kernel_made, twin_made = made.copy(), made.copy()
    power, twin_power = np.zeros((2, 29, chirps), np.float32)
    kernel, twin = TWINS["isac_rt.receive.maps.make_maps"]
    kernel(*args, room, kernel_made, np.empty((ROWS, chirps), np.complex64), power)
    twin(*args, room, twin_made, np.empty((ROWS, chirps), np.complex64), twin_power)
    np.testing.assert_allclose(power, twin_power, rtol=0, atol=SINGLE * twin_power.max())
    np.testing.assert_allclose(kernel_made, twin_made, rtol=0, atol=SINGLE * 60)


def test_background_of_cells():
    """Rows at both ends, where a side has few cells or none, and blocks in which hardly any cell is
    kept. Planted bugs in the kernel: bins that do not wrap; the smaller of both sides."""
    rng = np.random.default_rng(3)
    power, keep = rng.gamma(3.0, 0.4, (41, 33)).astype(np.float32), rng.random((41, 33)) < 0.7
    keep[10:22, 5:25] = False
    index = np.arange(41)
    sides = np.clip(np.stack([index - 2, 38 - index], axis=1), 0, 5)
    sides = np.where(sides >= 2, sides, 0)
    args = power, keep, sides, 2, 4, 0.25, np.zeros((41, 33))
    assert_twins_agree("isac_rt.receive.cfar.fill_background", *args, rtol=1e-12)


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    angle = rng.uniform(-np.pi, np.pi, shape)
    return np.stack([np.cos(angle), np.sin(angle)]).astype(np.float32)


def test_bounds_of_a_line():
    """Planted bug in the kernel: every second direction left out."""
    rng = np.random.default_rng(4)
    channels = rng.permutation(20)[:14].reshape(2, 7)
    maps = complex_noise(rng, 20, 48).view(np.float32)
    args = maps, channels, complex_noise(rng, 6, 7), np.zeros(48, np.float32)
    assert_twins_agree("isac_rt.receive.directions.fill_line_bounds", *args, rtol=SINGLE)


@pytest.mark.parametrize("scales", [1, 9])
def test_search_over_directions(scales: int):
    """Planted bugs in the kernel: the looks added in amplitude; the turns of both axes exchanged;
    beyond the disc too."""
    rng, grid = np.random.default_rng(5), 32
    lines = complex_noise(rng, 9, 3, 2, grid), complex_noise(rng, 9, 3, 3, grid)
    scale = rng.uniform(0.5, 1.5, (scales, grid, grid)).astype(np.float32)
    inside = (rng.uniform(size=grid * grid) < 0.7).astype(np.float32)
    out = np.zeros(9, np.float32), np.zeros((9, 2), np.float32)
    args = *lines, unit(rng, 2, grid), unit(rng, 3, grid), inside, scale, *out
    # the parabola's offset is a quotient of differences of logarithms
    assert_twins_agree("isac_rt.receive.directions.search_directions", *args, rtol=1e-4)


@pytest.mark.parametrize("one_way", [False, True])
def test_quadratic_forms(one_way: bool):
    """Planted bug in the kernel: what couples both axes once and not twice."""
    rng, make = np.random.default_rng(6), [directions.searches, directions.receiver_search]
    search = make[one_way](ANTENNAS, 1613.0)
    search = search if one_way else search[0]
    size = len(search.channels)
    mixed = complex_noise(rng, 18, size, size)
    Q = (np.eye(size) + mixed @ mixed.conj().transpose(0, 2, 1)).astype(np.complex64)
    out = np.zeros((18, 32, 32), np.float32)
    args = Q, *search.axes, out
    # sums of some 2000 numbers that cancel
    assert_twins_agree("isac_rt.receive.directions.quadratic_forms", *args, rtol=1e-5)


def test_covariances_of_clutter():
    """Cells at the ends of both axes too. Planted bugs in the kernel: the Doppler axis does not
    wrap; rows from `REACH` too low."""
    rng, bins, size, count = np.random.default_rng(7), 30, 5, 400
    bucket = np.sort(rng.integers(0, 40 * bins, count))
    power = rng.gamma(1.0, 3.0, count).astype(np.float32)
    order = np.lexsort((-power, bucket))
    start = np.searchsorted(bucket, np.arange(40 * bins + 1))
    offsets = rng.uniform(-0.5, 0.5, (2, count)).astype(np.float32)
    tables = tuple(
        np.exp(-np.arange((REACH + 1) * TABLE_STEPS + 2) / w).astype(np.float32) for w in (37, 23)
    )
    steer = np.exp(1j * rng.uniform(-np.pi, np.pi, (count, size))).astype(np.complex64)
    taper = rng.uniform(0.3, 0.9, (size, size))
    taper = np.tril(taper, -1) + np.tril(taper, -1).T + np.eye(size)
    cells = np.array([0, 3, 21, 39]), np.array([0, 29, 11, 17]), bins
    scatterers = start, *offsets, power[order], steer
    out = np.zeros((4, size, size), np.complex64)
    args = cells, scatterers, tables, taper.astype(np.float32), out
    assert_twins_agree("isac_rt.receive.clutter.covariance.fill_covariances", *args, rtol=SINGLE)


@pytest.mark.parametrize("fine", [False, True])
def test_the_strongest_direction_of_an_arm(fine: bool):
    """Planted bug in the kernel: one parabola fewer."""
    rng = np.random.default_rng(8)
    apart = 3.1 * np.arange(7.0) + rng.uniform(-0.2, 0.2, 7)
    values = np.exp(-1j * rng.uniform(-0.9, 0.9, (6, 1, 1)) * apart)
    values = values * (rng.standard_normal((6, 3, 1, 2)) @ [1, 1j])
    values = values + 0.1 * (rng.standard_normal((6, 3, 7, 2)) @ [1, 1j])
    args = values, apart, 0.97, 57, fine, np.zeros(6)
    assert_twins_agree("isac_rt.receive.estimate.fill_strongest", *args, rtol=1e-9)
