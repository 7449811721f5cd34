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
from isac_rt.kernels.receive_maps import ROWS
from isac_rt.kernels.vector import PART, aligned
from isac_rt.receive import cfar, maps, spectrum  # noqa: F401  # whose twins are compared
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
