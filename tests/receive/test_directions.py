"""Searches of cells for directions against sums written out in numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.directions import (
    Search,
    channel_search,
    denominators,
    inverses,
    receiver_search,
    search_plain,
    search_white,
)
from isac_rt.receive.known import Known

ROUNDING = 1e-5  # float32


def noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal((*shape, 2)) @ [1, 1j]).astype(np.complex64)


def coherent_search(antennas) -> Search:
    known = Known.unmodulated(Waveform(), np.zeros((1, 120), int), antennas, 2)
    return channel_search(antennas, known.wavenumber)


def placed(kind: str) -> Antennas:
    """A row, a board of 3 x 4, 20 channels without a common line, and 3 x 8 with a row up."""
    tx, rx = {
        "row": ([(0, 0), (2, 0)], [(i / 2, 0) for i in range(4)]),
        "board": ([(0, 0), (1, 0.8), (2, 0)], [(i / 2, 0) for i in range(4)]),
        "sparse": (
            [(0, 0), (0.31, 1.7), (1.93, 0.9), (2.6, 2.2)],
            [(0, 0), (0.47, 0.2), (0.83, 1.1), (1.7, 0.71), (3.3, 1.9)],
        ),
        "planar": ([(0, 0), (2, 0), (0, 1)], [(i / 2, k / 2) for k in range(2) for i in range(4)]),
    }[kind]
    scale = Waveform().wavelength
    return Antennas.placed(scale * np.array(tx), scale * np.array(rx), half_view=np.pi / 3)


@pytest.mark.parametrize("kind", ["row", "board", "sparse", "planar"])
def test_the_search_finds_what_every_direction_says(kind: str):
    """Waves in noise and in clutter from (0.2, 0.1) on arrays of any shape: statistic and direction
    are the largest of |a^H R^-1 x|^2 / (a^H R^-1 a) written out in float64 over all directions of a
    grid much finer than a resolution, to 2 % (the climb's last step), and the direction is one in
    which the statistic is as stated. Planted bugs: the lines' places on
    the other axis left out; a channel that belongs to two lines; the grid of the other axis."""
    a = ANTENNAS if kind == "l" else placed(kind)
    search, rng, count = coherent_search(a), np.random.default_rng(3), 12
    size, places = len(search.channels), a.virtual_positions[:, [0, 2]]
    seen = a.observes(2)
    u = rng.uniform(-0.5, 0.5, (count, 2)) * seen
    half = search.steps * [len(values) / 2 for values in search.cosines]
    axes = [
        np.linspace(-h, h, 121) if on else np.zeros(1) for h, on in zip(half, seen, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[(grid**2).sum(axis=1) <= 1]

    def statistic(u: np.ndarray, white: np.ndarray, x: np.ndarray) -> np.ndarray:
        a = np.exp(-1j * search.wavenumber * u @ places.T)
        norm = np.einsum("gl,lm,gm->g", a.conj(), white, a).real
        return np.abs(a.conj() @ white @ x.T) ** 2 / norm[:, None]

    clutter = np.exp(-1j * search.wavenumber * places @ (np.array([0.2, 0.1]) * seen))
    R = np.eye(size) + 9 * np.outer(clutter, clutter.conj())
    waves = np.exp(-1j * search.wavenumber * u @ places.T)
    x = (waves + 0.5 * noise(rng, count, size)).astype(np.complex64)
    inverse = np.linalg.inv(R)
    for white, found in (
        (np.eye(size), search_plain(x.T[None], search, 1.0, 0.0)),
        (inverse, search_white(x[:, None], np.tile(R, (count, 1, 1)), np.arange(count), search)[0]),
    ):
        truth = statistic(grid, white, x).max(axis=0)
        np.testing.assert_allclose(found.peak, truth, rtol=0.02)
        at = np.diag(statistic(found.cosines, white, x))
        np.testing.assert_allclose(found.peak, at, rtol=1e-4)


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
    step = search.steps
    u = step * np.array([[0, 0], [3, -4], [-8, 5], [11, 6]])
    waves = np.sqrt(1.01 * limit / len(search.channels)) * search.steering(u).T
    found = search_plain(waves[None].astype(np.complex64), search, 1.0, 0.9 * limit)
    np.testing.assert_allclose(found.peak, 1.01 * limit, rtol=2e-3)
    np.testing.assert_allclose(found.cosines, u, atol=0.1 * step.max())


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
    u = np.stack(np.meshgrid(*search.cosines, indexing="ij"), axis=-1)
    a = search.steering(u.reshape(-1, 2)).astype(complex)
    expected = np.einsum("gi,sij,gj->sg", a.conj(), Q, a, optimize=True).real
    found = denominators(Q, search).reshape(18, -1)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * expected.mean())


@pytest.mark.parametrize("size", [12, 128, 131])
def test_inverses_of_any_size(size: int):
    """Against numpy in double precision, on both sides of the change to LAPACK. Planted bugs: one
    half left out; the other half not conjugated."""
    rng = np.random.default_rng(8)
    waves = noise(rng, 3, size, 5).astype(complex)
    R = (np.eye(size) + 1e4 * waves @ waves.conj().transpose(0, 2, 1)).astype(np.complex64)
    assert inverses(R) == pytest.approx(np.linalg.inv(R.astype(complex)), abs=1e-5)
