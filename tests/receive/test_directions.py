"""Searches of cells for directions against sums written out in numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS

from isac_rt.frame.waveform import Waveform
from isac_rt.receive.arms import all_channels
from isac_rt.receive.directions import (
    Search,
    denominators,
    line_bounds,
    receiver_search,
    search_plain,
)
from isac_rt.receive.known import Known

ROUNDING = 1e-5  # float32


def noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal((*shape, 2)) @ [1, 1j]).astype(np.complex64)


@pytest.mark.parametrize("cells", [5, 83])
def test_bounds_are_the_largest_power_over_a_lines_directions(cells: int):
    """Planted bugs: the looks' amplitudes added, not their powers; the last cells, which fill no
    vector, left out; every second direction left out."""
    rng = np.random.default_rng(1)
    maps, spectra = noise(rng, 20, cells), noise(rng, 6, 7)
    channels = rng.permutation(20)[:14].reshape(2, 7)
    power = (np.abs(np.einsum("gn,tns->tgs", spectra, maps[channels])) ** 2).sum(axis=0)
    found = line_bounds(maps, channels, spectra)
    np.testing.assert_allclose(found, power.max(axis=0), rtol=ROUNDING)


def coherent_search(antennas) -> Search:
    known = Known.unmodulated(Waveform(), np.zeros((1, 120), int), antennas, 2)
    return Search.of(all_channels(antennas), known.wavenumber, antennas.view_limit)


def test_the_bounds_of_the_coherent_search_miss_nothing():
    """Noise and paths of all directions beside a search of every cell: what reaches the threshold
    has the same statistic, what does not has none or a bound. Peaks between the grid's directions
    are a tenth higher at most (`PRUNED`).

    Planted bugs: either bound a fifth too low; channels in another order in the second one; the
    lines along X alone.
    """
    search, rng, least, count = coherent_search(ANTENNAS), np.random.default_rng(7), 16.0, 900
    x = noise(rng, 1, len(search.channels), count) / np.float32(np.sqrt(2))
    paths = search.steering(rng.uniform(-0.6, 0.6, (count, 2))).T * noise(rng, 1, count)
    x += np.float32(0.5) * paths
    every, found = search_plain(x, search, 1.0, 0.0), search_plain(x, search, 1.0, least)
    assert every.cell.size == count > found.cell.size
    peak, place = np.zeros(count), np.full((count, 2), np.nan)
    peak[found.cell], place[found.cell] = found.peak, found.cosines
    over = every.peak >= least / 0.9
    assert 200 < over.sum() < 700
    np.testing.assert_allclose(place[over], every.cosines[over], atol=1e-6)
    np.testing.assert_allclose(peak[over], every.peak[over], rtol=ROUNDING)
    bounded = np.setdiff1d(found.cell, np.flatnonzero(np.isfinite(place[:, 0])))
    assert bounded.size > 20
    assert (peak[bounded] < least).all()
    assert (peak[bounded] > 0.9 * every.peak[bounded]).all()


@pytest.mark.parametrize("antennas", [ANTENNAS, replace(ANTENNAS, rx_x=5, rx_z=6)])
def test_a_wave_between_the_grids_directions_passes_the_bounds(antennas):
    """Half a step off on both axes, without noise, a hundredth over the threshold, of which cells
    below 0.9 are not looked at further. Planted bugs: either bound not raised; a raise of steps
    half as wide."""
    search, limit = coherent_search(antennas), 16.0
    step = search.cosines[1] - search.cosines[0]
    u = step * np.array([[0, 0], [3, -4], [-8, 5], [11, 6]])
    waves = np.sqrt(1.01 * limit / len(search.channels)) * search.steering(u).T
    found = search_plain(waves[None].astype(np.complex64), search, 1.0, 0.9 * limit)
    np.testing.assert_allclose(found.peak, 1.01 * limit, rtol=2e-3)
    np.testing.assert_allclose(found.cosines, u, atol=0.1 * step)


@pytest.mark.parametrize("antennas", [ANTENNAS, replace(ANTENNAS, rx_x=5, rx_z=6)])
@pytest.mark.parametrize("one_way", [False, True])
def test_denominators_are_the_quadratic_forms_of_the_steering_vectors(antennas, one_way: bool):
    """Every direction of the grid, 18 matrices. Planted bugs: what couples both axes once and not
    twice; turns of two lines not conjugated; channels in another order; the last matrices left
    out."""
    search = receiver_search(antennas, 30.0) if one_way else coherent_search(antennas)
    rng, size = np.random.default_rng(4), len(search.channels)
    mixed = noise(rng, 18, size, size)
    Q = np.eye(size) + mixed @ mixed.conj().transpose(0, 2, 1)
    u = np.stack(np.meshgrid(search.cosines, search.cosines, indexing="ij"), axis=-1)
    a = search.steering(u.reshape(-1, 2)).astype(complex)
    expected = np.einsum("gi,sij,gj->sg", a.conj(), Q, a, optimize=True).real
    found = denominators(Q, search).reshape(18, -1)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * expected.mean())
