"""Speckle and Doppler of the clutter field: each filled cell's amplitude over many seeds, and its
spectrum under four kinds of flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_clutter_coherence import F_C, LAMBDA, C, crossing

from isac_rt import scenario
from isac_rt.frame.link import Link
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.simulation.setup import propagation_in, swarm_of

pytestmark = pytest.mark.sionna
CELL = 0.25
PULSE, PULSES = 1.013e-4, 64
DOPPLER_CELL = 1 / (PULSE * PULSES)


def flown(flight: dict, seed: int = 3):
    """A field of the crossing planned for one terminal (isotropic, 0 dBi) in flight for a fifth of
    a second, and the flight."""
    s = scenario.Scenario.model_validate(
        {
            "seed": seed,
            "frames": 26,
            "swarm": {"A": {"role": "active", **flight}},
            "receiver_preset": "plain",
            "city": {"source": "canyon"},
            "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
            "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
            "clutter": {"model": "field", "cell_area_per_metre_m": 0.3, "smallest_cell_m2": 0.2},
        }
    )
    return propagation_in(crossing(), s), swarm_of(s).trajectories["A"]


def at(model, flight, time: float):
    """What the terminal sees at a time, the coherent contribution of each scatterer, and the pose
    in local coordinates."""
    pose = flight.pose(time)
    local = replace(pose, position=pose.position - crossing().origin)
    seen = model.field.seen(LinkState(Link("A", "A"), time, local, local))
    wave = (
        model.field.cells.amplitude[seen.index]
        * seen.magnitude
        * np.exp(-2j * np.pi * np.mod(seen.length / LAMBDA, 1.0))
    )
    return seen, wave, local


CRUISE = {"position_m": [-2.1, -9.7, 7.3], "velocity_mps": [1.3, 9.1, 0.4]}


def test_every_filled_cell_is_rayleigh():
    """Cells of range and Doppler that hold 1e-4 of the power or more, 18 seeds: |sum|^2 over its
    mean is exponential (Kolmogorov-Smirnov, level 1e-4) and so is its tail: beyond 5 and 8 times
    the mean within 4 sigma of the binomial. A test of the sampling: a cell of a large surface has
    Gaussian speckle. Planted bug: amplitudes of fixed modulus."""
    level = []
    for seed in range(18):
        seen, wave, _ = at(*flown(CRUISE, seed), 0.09)
        doppler = -seen.rate / LAMBDA
        cell = (
            (seen.length / 2 / CELL).astype(int) * 4096
            + np.rint(doppler / DOPPLER_CELL).astype(int)
            + 2048
        )
        _, inverse = np.unique(cell, return_inverse=True)
        mean = np.bincount(inverse, seen.magnitude.astype(float) ** 2)
        total = np.bincount(inverse, wave.real) + 1j * np.bincount(inverse, wave.imag)
        filled = mean > 1e-4 * mean.sum()
        level.append(np.abs(total[filled]) ** 2 / mean[filled])
    sample = np.concatenate(level)
    assert sample.size > 5_000
    assert stats.kstest(sample, stats.expon.cdf).pvalue > 1e-4
    for beyond in (5.0, 8.0):
        expected = sample.size * np.exp(-beyond)
        assert abs((sample > beyond).sum() - expected) < 4 * np.sqrt(expected)


FLIGHTS = {
    "hovering": {"position_m": [-2.1, -9.7, 7.3], "velocity_mps": [0.0, 0.0, 0.0]},
    "cruising": CRUISE,
    "climbing": {"position_m": [1.7, -12.2, 6.4], "velocity_mps": [0.3, 0.9, 7.7]},
    "turning": {
        "waypoints": [
            {"time_s": 0.0, "position_m": [-1.1, -6.2, 8.1]},
            {"time_s": 0.1, "position_m": [-0.7, -5.3, 8.1]},
            {"time_s": 0.2, "position_m": [0.3, -4.9, 8.2]},
        ]
    },
}


@pytest.mark.parametrize("name", FLIGHTS)
def test_doppler_of_each_range_cell_is_that_of_its_surfaces(name):
    """Spectra of 64 pulses, each from the scatterers as seen at its own time: in every range cell
    that holds 1e-3 of the power, 98 % of the energy lies where 2 v.u/lambda of the cell's
    scatterers (from their points and the flight alone) says, two Doppler cells (the half width of
    Hann's main lobe) aside. Planted bug: points that fly along with the terminal."""
    model, flight = flown(FLIGHTS[name])
    times = 0.09 + PULSE * (np.arange(PULSES) - PULSES / 2)
    profiles = []
    first, _, start = at(model, flight, 0.09)
    for time in times:
        seen, wave, _ = at(model, flight, time)
        span = np.linalg.norm(
            model.field.cells.points[seen.index] - start.position, axis=1
        )  # a scatterer stays in its range cell
        cell = (span / CELL).astype(int)
        profiles.append(
            np.bincount(cell, wave.real, 1200) + 1j * np.bincount(cell, wave.imag, 1200)
        )
    spectrum = (
        np.abs(np.fft.fft(np.array(profiles) * np.hanning(PULSES + 1)[:PULSES, None], axis=0)) ** 2
    )
    towards = model.field.cells.points[first.index] - start.position
    span = np.linalg.norm(towards, axis=1)
    expected = 2 * F_C / C * (towards / span[:, None]) @ start.velocity
    cell, share = (span / CELL).astype(int), first.magnitude.astype(float) ** 2
    filled = np.flatnonzero(np.bincount(cell, share, 1200) > 1e-3 * share.sum())
    assert filled.size > 30
    bins = np.arange(PULSES)
    for i in filled:
        inside = np.zeros(PULSES, bool)
        for doppler in expected[cell == i]:
            off = (bins - doppler / DOPPLER_CELL + PULSES / 2) % PULSES - PULSES / 2
            inside |= np.abs(off) <= 2.0
        assert spectrum[inside, i].sum() > 0.98 * spectrum[:, i].sum()
        if name == "hovering":
            assert inside.sum() == 5
    if name != "hovering":
        assert np.ptp(expected) > 5 * DOPPLER_CELL
