"""What a frame's clutter says of the terminal's own velocity and of the level it expects."""

from __future__ import annotations

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, frame, known

from isac_rt.extensions.city_receivers import angle_doppler, correction
from isac_rt.extensions.city_receivers.angle_doppler import AngleDoppler
from isac_rt.extensions.city_receivers.correction import UNTAPERED, fit
from isac_rt.extensions.city_receivers.power import TAPER, Response, expected_power
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.maps import accumulate
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import ExpectedClutter, Hints

C = 299_792_458.0
W = Waveform(num_samples=256)
VELOCITY = np.array([3.1, 7.7, -1.9])
MISTAKE = np.array([0.13, -0.1, 0.12])
ROWS, BORESIGHT_SAMPLES, COUNT = 128, 12, 3000


def surroundings(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (K, 3), ranges and mean powers of points at rest."""
    u = rng.uniform(-0.65, 0.65, (count, 2))
    towards = np.stack([u[:, 0], np.sqrt(1 - (u**2).sum(axis=1)), u[:, 1]], axis=1)
    return towards, rng.uniform(3.0, 29.0, count), rng.uniform(0.01, 0.1, count)


def power_of(
    amplitude: np.ndarray,
    ranges: np.ndarray,
    rates: np.ndarray,
    noise: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """(ROWS, P) mean power over the channels of tones in noise: two Hann windows and a transform
    written out; Doppler centred.

    amplitude (K, LOOKS); rates of the ranges [m/s].
    """
    n, p, size = np.arange(W.num_samples), np.arange(W.num_chirps), W.window_length
    carrier = W.carrier_frequency + W.slope * (W.chirp_duration - W.sampled_duration / 2)
    doppler = 2 * rates / C * carrier * W.num_chirps * W.slot_duration
    beat = (
        W.slope * 2 * ranges / C * W.sampled_duration
        + 2 * rates / C * W.carrier_frequency * W.sampled_duration
    )
    fast = (
        np.exp(2j * np.pi * np.outer(n, beat) / W.num_samples)
        * np.where(n < size, np.sin(np.pi * (n + 0.5) / size) ** 2, 0)[:, None]
    )
    slow = np.exp(2j * np.pi * np.outer(p, doppler) / W.num_chirps)
    window = np.sin(np.pi * (p + 0.5) / W.num_chirps) ** 2
    out = np.zeros((ROWS, W.num_chirps))
    for a in amplitude.T:
        white = np.sqrt(noise / 2) * (
            rng.standard_normal((W.num_samples, W.num_chirps, 2)) @ np.array([1, 1j])
        )
        white *= np.where(n < size, np.sin(np.pi * (n + 0.5) / size) ** 2, 0)[:, None]
        x = np.fft.fft(((fast * a) @ slow.T + white) * window, axis=0)[:ROWS]
        out += np.abs(np.fft.fft(x, axis=1)) ** 2 / BORESIGHT_SAMPLES
    return np.fft.fftshift(out, axes=1)


@pytest.mark.parametrize("targets", [0, 10])
def test_velocity_and_level_come_back_from_the_clutter(targets: int):
    """3000 points, places and mean powers known, a velocity 0.2 m/s off and 3 dB too little. With
    ten targets 25 dB over a point, a tenth of the cells, boresight's component comes back to 0.07
    m/s, the others to 0.13 m/s and the level to 0.6 dB; without them to 0.03 m/s, 0.13 m/s and 0.4
    dB: some three deviations of a dozen other draws. Planted bugs: the slope's sign; one way only;
    the level as a factor on amplitudes; targets counted in full (0.2 m/s, 2 dB)."""
    rng = np.random.default_rng(4)
    towards, ranges, powers = surroundings(COUNT, rng)
    noise = 0.02
    at = rng.uniform(3, 29, targets), rng.uniform(-12, 12, targets)
    wrong = VELOCITY + MISTAKE
    guess = ExpectedClutter(
        2 * ranges / C, -2 * (towards @ wrong) / C, powers / 2, towards, towards
    )
    _, schedule, payload = frame(waveform=W)
    floor = float(
        power_of(np.zeros((1, BORESIGHT_SAMPLES)), np.zeros(1), np.zeros(1), noise, rng).mean()
    )
    for _ in range(2):
        own = np.sqrt(powers / 2) * (rng.standard_normal((COUNT, 2)) @ np.array([1, 1j]))
        phase = np.exp(
            40j * (towards @ rng.standard_normal((3, BORESIGHT_SAMPLES)))
        )  # channels differ by their places
        amplitude = np.concatenate(
            [own[:, None] * phase, np.full((targets, BORESIGHT_SAMPLES), 4.0 + 0j)]
        )
        power = power_of(
            amplitude, np.append(ranges, at[0]), np.append(-(towards @ VELOCITY), at[1]), noise, rng
        )
        found = fit(power, floor, guess, known(W, schedule, payload))
        off = np.abs(found.velocity + MISTAKE)
        assert off[1] < (0.07 if targets else 0.03) and off.max() < 0.13
        mended = found.apply(guess)
        assert 10 * np.log10(mended.power.sum() / powers.sum()) == pytest.approx(
            0, abs=0.6 if targets else 0.4
        )
        np.testing.assert_allclose(
            mended.delay_rate, -2 * towards @ (wrong + found.velocity) / C, rtol=0, atol=1e-16
        )


@pytest.mark.parametrize("level_db", [-15.0, 10.0])
def test_slopes_that_are_used_again_follow_the_level(monkeypatch, level_db: float):
    """Mean powers without scatter, a level far off and a velocity 0.04 m/s off: the velocity comes
    out as if its slopes were computed in every step, to 0.003 m/s, a third of what the fit's own
    six steps leave. Planted bug: the slopes keep the level at which they were computed."""
    towards, ranges, powers = surroundings(COUNT, np.random.default_rng(4))
    _, schedule, payload = frame(waveform=W)
    one, noise = known(W, schedule, payload), 0.02 * W.num_samples * W.num_chirps

    def clutter_at(velocity: np.ndarray, factor: float) -> ExpectedClutter:
        rate = -2 * (towards @ velocity) / C
        return ExpectedClutter(2 * ranges / C, rate, factor * powers, towards, towards)

    truth = clutter_at(VELOCITY + np.array([0.02, -0.03, 0.01]), 10 ** (level_db / 10))
    power = expected_power(truth, one, ROWS, UNTAPERED) + noise
    guess = clutter_at(VELOCITY, 1.0)
    found = fit(power, noise, guess, one)
    monkeypatch.setattr(correction, "ALIKE", -1.0)
    assert found.velocity == pytest.approx(fit(power, noise, guess, one).velocity, abs=0.003)
    assert 10 * np.log10(np.exp(found.level)) == pytest.approx(level_db, abs=0.1)


@pytest.mark.parametrize("too_low_db", [8.0, 15.0])
def test_a_level_expected_far_too_low_is_found(too_low_db: float):
    """Exponential cells of the clutter's mean beside noise of 45 channels. As the mesh predicts it,
    fewer than a hundred cells hold more clutter than noise; in truth 600 do. The level comes back
    to 0.6 dB, three deviations of some 300 cells, and of noise alone nothing is said. Planted bugs:
    the fit given up; the least level that counts taken for the most."""
    rng = np.random.default_rng(4)
    towards, ranges, powers = surroundings(COUNT, rng)
    _, schedule, payload = frame(waveform=W)
    one = known(W, schedule, payload)
    truth = ExpectedClutter(2 * ranges / C, -2 * (towards @ VELOCITY) / C, powers, towards, towards)
    mean = expected_power(truth, one, ROWS, UNTAPERED)
    noise = float(np.sort(mean, axis=None)[-600])
    low = ExpectedClutter(
        truth.delay, truth.delay_rate, powers / 10 ** (too_low_db / 10), towards, towards
    )
    white = noise * rng.gamma(45, 1 / 45, mean.shape)
    factor = 10 ** (too_low_db / 10)
    assert (mean > factor * noise).sum() < correction.FEWEST
    found = fit(mean * rng.exponential(size=mean.shape) + white, noise, low, one)
    assert 10 * np.log10(np.exp(found.level)) == pytest.approx(too_low_db, abs=0.6)
    assert fit(white, noise, low, one).level == 0


def test_detectors_judge_with_the_corrected_clutter(monkeypatch: pytest.MonkeyPatch):
    """Circular Gaussian cells of the clutter's own mean; the terminal believes in a third of the
    power and 0.15 m/s too much. The level that its detector rests on is the true one: 15 % at
    the median over cells with clutter, 5 % in all. Planted bugs: the map not made anew; the
    correction left out."""
    towards, ranges, powers = surroundings(COUNT, np.random.default_rng(4))
    truth = ExpectedClutter(2 * ranges / C, -2 * (towards @ VELOCITY) / C, powers, towards, towards)
    wrong = ExpectedClutter(
        truth.delay, truth.delay_rate - 2 * 0.15 * towards[:, 1] / C, powers / 3, towards, towards
    )
    _, schedule, payload = frame(waveform=W)
    noise = 0.02 * W.num_samples * W.num_chirps
    mean = expected_power(truth, known(W, schedule, payload), ROWS) + noise
    rng = np.random.default_rng(8)
    white = (
        rng.standard_normal((ANTENNAS.num_tx, ANTENNAS.num_rx, *mean.shape, 2))
        @ np.array([1, 1j])
        / np.sqrt(2)
    )
    maps = (white * np.fft.ifftshift(np.sqrt(mean), axes=1)).astype(np.complex64)
    monkeypatch.setattr(angle_doppler, "maps_with_power", lambda *_: (maps, accumulate(maps)))
    detector = AngleDoppler(Receivers(clutter_detector="angle_doppler", max_detections=1))
    spectra = np.zeros((len(schedule), ANTENNAS.num_rx, *mean.shape), np.complex64)
    level = detector.sense(spectra, known(W, schedule, payload), Hints(wrong)).level
    strong = mean > 3 * noise
    off = level[strong] / mean[strong] - 1
    assert strong.sum() > 500 and np.median(np.abs(off)) < 0.15
    assert level[strong].sum() / mean[strong].sum() == pytest.approx(1, abs=0.05)


def test_noise_alone_corrects_nothing():
    """A mesh whose clutter is below the noise: no cell to fit to. Planted bug: the prior alone
    moves it."""
    towards, ranges, powers = surroundings(50, np.random.default_rng(4))
    guess = ExpectedClutter(2 * ranges / C, np.zeros(50), 1e-9 * powers, towards, towards)
    _, schedule, payload = frame(waveform=W)
    found = fit(np.ones((ROWS, W.num_chirps)), 1.0, guess, known(W, schedule, payload))
    assert found.level == 0 and not found.velocity.any()


def test_a_whole_bin_more_moves_expected_power_by_a_bin():
    """Power and its slopes, of scatterers between bins and across the ends of the Doppler axis: the
    same grid, places of which come round. Planted bug: the place after the last one is the last."""
    rng, count = np.random.default_rng(17), 40
    _, schedule, payload = frame(waveform=W)
    response = Response(W, ROWS, TAPER, known(W, schedule, payload).leaks)
    beat, power = rng.uniform(2, ROWS - 3, count), rng.uniform(0.5, 2.0, count)
    doppler, slope = rng.uniform(-0.5, 0.0, count) / 3, rng.normal(size=(count, 1))
    here = response.of(beat, doppler, power, slope)
    for bins in (1, 37, W.num_chirps // 2, -W.num_chirps // 2 - 1):
        there = response.of(beat, doppler + bins, power, slope)
        np.testing.assert_allclose(there, np.roll(here, bins, axis=2), atol=1e-12 * here.max())
    each = sum(
        response.of(beat[k : k + 1], doppler[k : k + 1], power[k : k + 1], slope[k : k + 1])
        for k in range(count)
    )
    np.testing.assert_allclose(here, each, atol=1e-12 * here.max())
