"""The paper's benchmarks: conventional TDM-MIMO FMCW and mmWave-LoRadar."""

from __future__ import annotations

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube
from scipy import stats

from isac_rt.arrays import pseudo_random_schedule
from isac_rt.baselines import fmcw_frame, receive_fmcw, resolution
from isac_rt.ifsignal import IFCube
from isac_rt.scenario import Receivers
from isac_rt.waveform import Waveform

SETTINGS = Receivers()


def echo(rng, farthest=100.0, fastest=4.65):
    """A random target in range, within 93 % of the FMCW's velocity limit, in view, and its echo's path."""
    r, v = rng.uniform(5, farthest), rng.uniform(-fastest, fastest)
    az, el = np.deg2rad(rng.uniform(-50, 50, 2))
    u = (float(np.cos(el) * np.sin(az)), float(np.sin(el)))
    return np.array([r, v, *u]), Path(2 * r, 2 * v, np.exp(2j * np.pi * rng.random()), arrival=u, departure=u)


def hits(found, truth, bound):
    estimate = np.column_stack([found.range, found.velocity, found.direction])
    return bool((np.abs(estimate - truth) < bound).all(axis=1).any())


def binomial_bounds(rate, trials, probability=1e-4):
    """Least and most successes that a rate gives but with this probability."""
    return stats.binom.ppf(probability, trials, rate), stats.binom.isf(probability, trials, rate)


def fmcw_errors(snr_db, trials, farthest=100.0, seed=5):
    w, schedule, payload = fmcw_frame(Waveform())
    rng, bound, out, count = np.random.default_rng(seed), resolution(w, ANTENNAS), [], 0
    for k in range(trials):
        truth, path = echo(rng, farthest)
        noise = 10 ** (-snr_db / 10) if np.isfinite(snr_db) else 0.0
        found = receive_fmcw(cube(w, schedule, payload, [path], noise=noise, seed=100 + k), ANTENNAS, SETTINGS)
        count += hits(found, truth, bound)
        out += [[found.range[0], found.velocity[0], *found.direction[0]] - truth] if len(found) else []
    return count, np.array(out), bound


def test_fmcw_without_noise():
    """Off the grid, out to the far half of the range that the ISAC waveform keeps for data: within 0.1 cell (discretisation: the two-cell
    ratio beside migration, up to 0.15 cell over the frame at 4.65 m/s) and 0.02 in u (wideband narrowing). One detection each.
    Planted bug: no compensation of the antennas' time offsets."""
    count, errors, bound = fmcw_errors(np.inf, 6, farthest=240.0)
    assert count == 6
    assert (np.abs(errors) < [0.1 * bound[0], 0.1 * bound[1], 0.02, 0.02]).all()


def test_fmcw_folds_its_velocity_at_a_third():
    """7.3 m/s is beyond c/(4 L_tx T_slot f) = 4.981 m/s with f = 77.34 GHz amid the window (notes: 15.0085/3, with f_c) and appears twice
    that lower; 0.1 cell."""
    w, schedule, payload = fmcw_frame(Waveform())
    found = receive_fmcw(cube(w, schedule, payload, [Path(2 * 41.3, 2 * 7.3)]), ANTENNAS, SETTINGS)
    limit = w.max_velocity(2) / 3
    assert limit == pytest.approx(4.981, abs=1e-3)
    assert found.velocity[0] == pytest.approx(7.3 - 2 * limit, abs=0.025)


@pytest.mark.parametrize(("snr_db", "least", "most"), [(-44, 0.54, 0.54), (-38, 1.0, 1.0)])
def test_fmcw_hit_rate(snr_db, least, most):
    """Prototype: 0.54 of 24 frames at -44 dB, 1 from -40 dB up. Both samples are binomial: the bounds join a 1e-3 interval on
    the prototype's rate and ours. Planted bug: one channel instead of the sum of 45."""
    trials = 16
    count, _, _ = fmcw_errors(snr_db, trials)
    low = stats.beta.ppf(1e-3, least * 24, 24 - least * 24 + 1) if least else 0.0
    high = stats.beta.isf(1e-3, most * 24 + 1, 24 - most * 24) if most < 1 else 1.0
    assert binomial_bounds(low, trials)[0] <= count <= binomial_bounds(high, trials)[1]


def test_fmcw_refuses_a_pseudo_random_schedule():
    w, schedule, payload = fmcw_frame(Waveform())
    samples = cube(w, schedule, payload, [Path(30.0, 0.0)]).samples
    other = pseudo_random_schedule(1, w.num_chirps, w.num_tx, np.random.default_rng(2))
    with pytest.raises(ValueError, match="antennas in turn"):
        receive_fmcw(IFCube(samples=samples, waveform=w, schedule=other, start_time=0.0), ANTENNAS, SETTINGS)
