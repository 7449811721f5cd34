"""Matching pursuit off the grid beside the paper's OMP on the same samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube

from isac_rt.arrays import pseudo_random_schedule
from isac_rt.payload import random_payload
from isac_rt.receive import receive_active
from isac_rt.scenario import Receivers
from isac_rt.waveform import Waveform

FEW = replace(ANTENNAS, rx_x=3, rx_z=3)
W = Waveform(num_samples=256, num_groups=1)


def heard(paths: list[Path], method: str, noise: float, seed: int = 5):
    schedule = pseudo_random_schedule(1, W.num_chirps, 3, np.random.default_rng(seed))
    payload = random_payload(W, schedule, 8, np.random.default_rng(seed + 1))
    signal = cube(W, schedule, payload, paths, FEW, noise=noise, seed=seed)
    return receive_active(signal, payload, FEW, Receivers(velocity_method=method)).detections


@pytest.mark.parametrize("ratio_db", [26.0, 40.0])
def test_a_weak_path_in_the_row_of_a_strong_one(ratio_db: float):
    """Off the grid, one group, that is a third of the samples. OMP on the grid loses the weak path; pursuit finds both at their places and
    nothing else. Planted bug: the orthogonal step left out (twenty detections)."""
    strong, weak, u, v = (18.43, 9.71), (18.47, -21.3), (0.45, -0.31), (-0.2, 0.1)
    amplitude = 10 ** (ratio_db / 20)
    paths = [Path(2 * strong[0], 2 * strong[1], amplitude, u, u), Path(2 * weak[0], 2 * weak[1], 1.0, v, v)]
    d = heard(paths, "pursuit", noise=1.0)
    assert len(d) == 2
    for i, (r, rate) in enumerate((strong, weak)):
        assert abs(d.range[i] - r) < 0.1 * W.range_cell(2) and abs(d.velocity[i] - rate) < 0.1 * W.velocity_cell(2)
    assert np.abs(d.direction[1] - v).max() < 0.05
    plain = heard(paths, "omp", noise=1.0)
    assert not (np.abs(plain.velocity - weak[1]) < W.velocity_cell(2)).any()


def test_noise_and_one_path_are_left_as_they_are():
    """No remainder of a path 50 dB over the noise of a sample is reported, and nothing in noise alone."""
    for seed in range(2):
        assert len(heard([], "pursuit", 1.0, seed)) == 0
        assert len(heard([Path(2 * 13.31, -17.7, 10**2.5, (0.6, 0.3), (0.6, 0.3))], "pursuit", 1.0, seed)) == 1
