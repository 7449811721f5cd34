"""Waves of a passive terminal: echoes in the cell of a line of sight, the delays of transmit
antennas that stand far apart, and what waves cost each other."""

from __future__ import annotations

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, C, Path, cube, frame

from isac_rt.extensions.city_receivers.echoes import Waves
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.directions import receiver_search
from isac_rt.receive.estimate import Estimate, LocalSpectra
from isac_rt.receive.known import Known
from isac_rt.receive.passive import PassiveReceiver, receive_passive
from isac_rt.receive.sense import Sensed, describe
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.types import Prediction

W = Waveform(num_samples=256, num_chirps=24)
CELL, BIN = W.range_cell(1), W.velocity_cell(1)
SIGHT = Path(100.31 * CELL, 2.2 * BIN, 1.0, (0.1, -0.05), (0.2, 0.1))


def spectra_of(paths: list[Path], antennas: Antennas = ANTENNAS, noise: float = 0.0, seed: int = 0):
    """Cleaned spectra of a pilot, and what the receiver knows."""
    w, schedule, _ = frame(waveform=W)
    samples = cube(w, schedule, unmodulated(w), paths, antennas, noise, seed)
    known = Known.unmodulated(w, schedule, antennas, 1)
    return clean_spectrum(samples, known), known


def waves_of(spectra: np.ndarray, known: Known, paths: list[Path], *, strong: bool) -> Waves:
    """The waves of paths, from starts beside them."""
    beam = receiver_search(known.antennas, known.wavenumber).beam
    out, waves = Waves(spectra.copy(), known, 0.1, beam), []
    for path in paths:
        start = path.length / C + 0.05 * W.delay_step, path.rate / C
        local = LocalSpectra(spectra, known, round(path.length / CELL))
        e = Estimate(*start, local.respond(*start))
        waves.append(out.wave(e, np.array(path.arrival) + 0.01, 1e6, strong=strong))
    out.take_out(waves)
    out._fit(out.waves)  # weak ones alone are not fitted again
    return out


@pytest.mark.parametrize("data", [False, True])
@pytest.mark.parametrize("off", [(0.5, 0.3), (0.2, 0.1)])
def test_an_echo_in_the_cell_of_a_line_of_sight_is_found(off, data):
    """43 dB below the line of sight, a part of a cell beside it and from elsewhere, in a pilot and
    in a frame with data: both are found, the echo within 4 deviations, and nothing else. Planted
    bugs: channels taken out in place of the wave (it goes with them); what is near the reference
    left out in all directions."""
    place = (100.31 + off[0]) * CELL, (2.2 + off[1]) * BIN
    echo = Path(*place, 10 ** (-43 / 20), (-0.2, 0.15), (-0.3, 0.2))
    w, schedule, payload = frame(waveform=W)
    payload, one = payload if data else unmodulated(w), np.ones(1)
    samples = cube(w, schedule, payload, [SIGHT, echo], noise=0.03, seed=4)
    known = Prediction(
        range=SIGHT.length * one,
        velocity=SIGHT.rate * one,
        direction=np.array([SIGHT.arrival]),
        range_std=0.01 * CELL * one,
        velocity_std=0.01 * BIN * one,
        weight=one,
    )
    settings = Receivers(passive_detector="beams")
    d = receive_passive(samples, ANTENNAS, settings, 8, known, data).detections
    assert len(d) == 2 and d.is_reference.tolist() == [True, False]
    miss = np.array([d.range[1], d.velocity[1], *d.direction[1]])
    miss -= [echo.length, echo.rate, *echo.arrival]
    assert (np.abs(miss) < 4 * d.std[1]).all()


def test_a_strong_path_that_is_not_sure_leaves_no_reference():
    """The strongest path is below the threshold of a reference, the sure ones more than 20 dB under
    it. Planted bug: the sure ones counted before their powers are asked (a crash)."""
    w, schedule, _ = frame(waveform=W)
    known = Known.unmodulated(w, schedule, ANTENNAS, 1)
    receiver = PassiveReceiver.of(ANTENNAS, Receivers(), 8)
    estimates = [Estimate(1e-7, 0.0, a * np.ones((3, ANTENNAS.num_rx))) for a in (1.0, 0.05)]
    detections = describe(estimates, np.array([1.0, 1e4]), known)
    sensed = Sensed(estimates, detections, np.ones((8, 24)), np.ones((8, 24)))
    assert receiver._earliest(sensed, known) == (detections, None)


def test_the_delays_of_transmit_antennas_are_fitted():
    """Antennas 3 wavelengths apart, seen from the side: a wave without delays of its own leaves a
    thousandth of the path, one with them no more than plane waves differ from spherical ones at
    50 m. Planted bugs: one delay for all; the mean of the delays not passed on to the wave."""
    wide = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=1.5 * C / 77e9, pattern="sector")
    path = Path(100.31 * CELL, 2.2 * BIN, 1.0, (0.1, -0.05), (0.6, -0.5))
    spectra, known = spectra_of([path], wide)
    power = (np.abs(spectra) ** 2).sum()
    left = {
        strong: (np.abs(waves_of(spectra, known, [path], strong=strong).left) ** 2).sum() / power
        for strong in (False, True)
    }
    assert left[True] < 2e-5 < 1e-3 < left[False]


def test_deviations_of_waves_that_share_a_cell():
    """Errors over 40 draws of noise of two waves, over those of one alone, are as `spread` says
    within chance, a fifth. Planted bug: no more than that of the wave alone."""
    second = Path(SIGHT.length + 0.5 * CELL, SIGHT.rate, 1.0, (0.06, -0.02), (-0.3, 0.2))
    errors: dict[int, list[np.ndarray]] = {1: [], 2: []}
    clean = {n: spectra_of([SIGHT, second][:n]) for n in errors}
    rng, spread = np.random.default_rng(3), np.ones(4)
    for _ in range(40):
        noise = rng.standard_normal((*clean[1][0].shape, 2)).astype(np.float32) @ [1, 1j]
        for n, (spectra, known) in clean.items():
            found = waves_of(
                (spectra + 3 * noise).astype(np.complex64), known, [SIGHT, second][:n], strong=False
            ).waves[0]
            truth = [SIGHT.length / C, SIGHT.rate / C, *SIGHT.arrival]
            errors[n].append(np.array([found.delay, found.rate, *found.cosines]) - truth)
            if n == 2:
                spread = found.spread
    wider = np.std(errors[2], axis=0) / np.std(errors[1], axis=0)
    assert spread.max() > 1.3
    np.testing.assert_allclose(wider, spread, rtol=0.3)


def test_a_strong_wave_leaves_an_echo_in_its_cell():
    """30 dB under a line of sight, a tenth of a cell beside it and sent the same way: what the wave
    leaves holds nine tenths of the echo. Planted bug: the receivers of the strong wave as the cell
    shows them (the part of rank one), which takes the echo with it."""
    place = SIGHT.length + 0.1 * CELL, SIGHT.rate
    echo = Path(*place, 10**-1.5, (-0.3, 0.2), SIGHT.departure)
    both, known = spectra_of([SIGHT, echo])
    alone, _ = spectra_of([echo])
    left = waves_of(both, known, [SIGHT], strong=True).left
    share = abs(np.vdot(alone, left)) ** 2 / np.vdot(alone, alone).real ** 2
    assert share > 0.9


def test_a_path_is_one_wave():
    """What is put beside a wave within a third of a cell and a seventh of a resolution is that wave
    again. Planted bug: directions not asked."""
    spectra, known = spectra_of([SIGHT])
    found = waves_of(spectra, known, [SIGHT], strong=True)
    e = found.estimate(found.waves[0])
    near, elsewhere = (
        found.wave(e, np.array(SIGHT.arrival) + turn, 1e6, strong=False) for turn in (0.02, 0.1)
    )
    assert found.holds(near) and not found.holds(elsewhere)
