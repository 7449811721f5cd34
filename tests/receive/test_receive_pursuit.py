"""Matching pursuit off the grid beside the paper's OMP on the same samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, known

from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive import receive_active
from isac_rt.receive.estimate import Estimate, LocalSpectra
from isac_rt.receive.pursuit import _take_out
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.scenario.receivers import Receivers

FEW = replace(ANTENNAS, rx_x=3, rx_z=3)
W = Waveform(num_samples=256, num_groups=1)


def heard(paths: list[Path], method: str, noise: float, seed: int = 5):
    schedule = pseudo_random_schedule(1, W.num_chirps, 3, np.random.default_rng(seed))
    payload = random_payload(W, schedule, 8, np.random.default_rng(seed + 1))
    signal = cube(W, schedule, payload, paths, FEW, noise=noise, seed=seed)
    return receive_active(signal, payload, FEW, Receivers(velocity_method=method)).detections


@pytest.mark.parametrize("ratio_db", [26.0, 40.0])
def test_a_weak_path_in_the_row_of_a_strong_one(ratio_db: float):
    """Off the grid, one group, that is a third of the samples. OMP on the grid loses the weak path;
    pursuit finds both at their places and nothing else. Planted bug: the orthogonal step left out
    (twenty detections)."""
    strong, weak, u, v = (18.43, 9.71), (18.47, -21.3), (0.45, -0.31), (-0.2, 0.1)
    amplitude = 10 ** (ratio_db / 20)
    paths = [
        Path(2 * strong[0], 2 * strong[1], amplitude, u, u),
        Path(2 * weak[0], 2 * weak[1], 1.0, v, v),
    ]
    d = heard(paths, "pursuit", noise=1.0)
    assert len(d) == 2
    for i, (r, rate) in enumerate((strong, weak)):
        assert abs(d.range[i] - r) < 0.1 * W.range_cell(2) and abs(
            d.velocity[i] - rate
        ) < 0.1 * W.velocity_cell(2)
    assert np.abs(d.direction[1] - v).max() < 0.05
    plain = heard(paths, "omp", noise=1.0)
    assert not (np.abs(plain.velocity - weak[1]) < W.velocity_cell(2)).any()


@pytest.mark.parametrize("passes", [2, 1])
def test_a_path_is_taken_out_whole_and_put_back(passes: int):
    """An exact path, off all grids, moving, with data, leaves a thousandth of itself in the rows
    that it reaches; put back it is there again. Planted bugs: the elements' delays left out, or
    those of the transmitters at a PT taken in; time without the data; the middle of the
    window for its start."""
    schedule = pseudo_random_schedule(1, W.num_chirps, 3, np.random.default_rng(5))
    payload = random_payload(W, schedule, 8, np.random.default_rng(6))
    path = Path(
        43.817, 21.3, 0.7 - 0.4j, (0.45, -0.31), (0.45, -0.31) if passes == 2 else (-0.2, 0.1)
    )
    chirps = known(W, schedule, payload, FEW, passes)
    spectra = clean_spectrum(cube(W, schedule, payload, [path], FEW), chirps, 128)
    k = 2 * np.pi * W.effective_carrier / SPEED_OF_LIGHT
    sent, heard = (
        np.exp(1j * k * places[:, [0, 2]] @ u)
        for places, u in (
            (FEW.tx_positions, np.array(path.departure)),
            (FEW.rx_positions, np.array(path.arrival)),
        )
    )
    near = LocalSpectra(spectra, chirps, round(43.817 / W.range_cell(1)))
    delay, rate = 43.817 / SPEED_OF_LIGHT, 21.3 / SPEED_OF_LIGHT
    exact = Estimate(delay, rate, near.respond(delay, rate))
    turned = (
        exact.channels * np.outer(sent, heard).conj()
        if passes == 2
        else exact.channels * heard.conj()
    )
    assert np.abs(np.abs(turned) - abs(path.amplitude)).max() < 0.02
    left = spectra.copy()
    rows = _take_out(left, exact, chirps)
    assert rows.stop - rows.start == 49
    assert (
        np.abs(left).max() < 3e-3 * np.abs(spectra).max()
    )  # the wavefront is plane here and spherical there
    _take_out(left, exact, chirps, back=True)
    assert np.abs(left - spectra).max() < 1e-6 * np.abs(spectra).max()


def test_noise_and_one_path_are_left_as_they_are():
    """No remainder of a path 50 dB over the noise of a sample is reported, and nothing in noise
    alone."""
    for seed in range(2):
        assert len(heard([], "pursuit", 1.0, seed)) == 0
        assert (
            len(
                heard(
                    [Path(2 * 13.31, -17.7, 10**2.5, (0.6, 0.3), (0.6, 0.3))], "pursuit", 1.0, seed
                )
            )
            == 1
        )
