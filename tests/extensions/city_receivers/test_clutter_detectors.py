"""Detectors in clutter: covariance against cubes written from the signal's equation, thresholds
against drawn noise, filters against the formulas of Robey and of Reed, Mallett and Brennan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame, known
from scipy import stats

from isac_rt.extensions.city_receivers.adaptive import expected_count, noise_level, scanned
from isac_rt.extensions.city_receivers.angle_doppler import (
    AngleDoppler,
    over_walls,
)
from isac_rt.extensions.city_receivers.covariance import Bucketed
from isac_rt.extensions.city_receivers.power import Taper, expected_power
from isac_rt.extensions.city_receivers.waves import waves_of
from isac_rt.frame.antennas import Antennas, antennas_of, resolutions
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.settings import Array
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.active import receive_active
from isac_rt.receive.arms import Channels, all_channels
from isac_rt.receive.cfar import CfarRule
from isac_rt.receive.directions import channel_search, search_plain, search_white
from isac_rt.receive.estimate import Estimate, near_beam
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate, channel_maps
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.types import Detections, ExpectedClutter, Hints

SHORT = Waveform(num_samples=256, num_chirps=60)
FEW = replace(ANTENNAS, rx_x=3, rx_z=2)
EXACT = Taper(range_cells=0.0, doppler_bins=0.0, cosine=0.0)
FALSE_FAILURE = 1e-6  # statistical


def silent(w: Waveform, antennas: Antennas) -> Known:
    """What is known of a frame of echoes without data, where the schedule does not matter."""
    return Known.unmodulated(w, conventional_schedule(3, w.num_chirps, 3), antennas, 2)


def scatterers(
    count: int, seed: int, ranges: tuple[float, float], speed: float = 9.3
) -> list[Path]:
    """Points at rest around a terminal that flies at `speed` along u = (0.6, 0.3), each with its
    power's square root as amplitude."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-0.6, 0.6, (count, 2))
    lengths = 2 * rng.uniform(*ranges, count)
    forward = np.array([0.6, np.sqrt(1 - 0.45), 0.3])
    rates = [-2 * speed * forward @ np.array([a, np.sqrt(1 - a * a - b * b), b]) for a, b in u]
    powers = rng.uniform(0.2, 2.0, count)
    return [
        Path(length, rate, np.sqrt(p), tuple(c), tuple(c))
        for length, rate, p, c in zip(lengths, rates, powers, u.tolist(), strict=True)
    ]


def expected(paths: list[Path]) -> ExpectedClutter:
    u = np.array(
        [
            [p.arrival[0], np.sqrt(1 - p.arrival[0] ** 2 - p.arrival[1] ** 2), p.arrival[1]]
            for p in paths
        ]
    )
    delay, rate = (
        np.array([p.length for p in paths]) / SPEED_OF_LIGHT,
        np.array([p.rate for p in paths]) / SPEED_OF_LIGHT,
    )
    return ExpectedClutter(delay, rate, np.array([abs(p.amplitude) ** 2 for p in paths]), u, u)


def maps_of(
    w: Waveform,
    schedule,
    payload,
    paths: list[Path],
    antennas,
    rows: int,
    noise: float = 0.0,
    seed: int = 0,
) -> np.ndarray:
    one = cube(w, schedule, payload, paths, antennas, noise, seed)
    sent = known(w, schedule, payload, antennas)
    return channel_maps(clean_spectrum(one, sent, rows), sent)


def draw(R: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, L) circular Gaussian vectors of covariance R."""
    white = rng.standard_normal((count, len(R), 2)) @ np.array([1, 1j]) / np.sqrt(2)
    return white @ np.linalg.cholesky(R).T


def test_covariance_is_the_sum_over_single_scatterers():
    """x x^H of one scatterer at a time, through the receiver's own chain, data included, summed.
    Discretisation: tables of 1/32 cell (3 %), curvature and migration left out. Planted bugs:
    steering conjugated (1.3), sign of Doppler (1.0), the scatterer's place in its cell left out
    (0.5)."""
    w, schedule, payload = frame(waveform=SHORT)
    paths, rows = scatterers(7, 5, (8.0, 26.0)), 120
    channels = all_channels(FEW)
    sent = known(w, schedule, payload, FEW)
    truth = np.zeros((rows, w.num_chirps, len(channels), len(channels)), complex)
    for path in paths:
        maps = maps_of(w, schedule, payload, [path], FEW, rows)
        x = np.moveaxis(maps[channels.tx, channels.rx], 0, -1)
        truth += x[..., :, None] * x[..., None, :].conj()
    power = np.einsum("rpii->rp", truth).real
    wanted = np.nonzero(power > 1e-2 * power.max())
    noise = 1e-4 * power.max()
    search = channel_search(FEW, sent.wavenumber)
    found = Bucketed.of(expected(paths), sent, search, noise, EXACT).covariances(*wanted)
    found = noise * (found - np.eye(len(channels)))
    assert wanted[0].size > 40
    error = np.linalg.norm(found - truth[wanted]) / np.linalg.norm(truth[wanted])
    assert error < 0.06


def test_whitened_directions_are_those_of_the_wave_beside_clutter():
    """A wave with clutter of 16 times its power 0.25 beside it in one cell, whose covariance is
    known: the likelihood of all channels lies at the wave in the mean of 40 draws, whose scatter is
    under a fifth of a lobe, and the beam against the clutter hears 0.05 of it; the plain beam is
    drawn to the clutter. Planted bugs: the whitener left out of the values; steering conjugated in
    the weights."""
    w, rng = SHORT, np.random.default_rng(4)
    sent = silent(w, ANTENNAS)
    every = all_channels(ANTENNAS)
    true, other = np.array([0.1, -0.2]), np.array([0.3, -0.05])
    a, b = (every.steering(np.array([[u[0], 0.0, u[1]]]), sent)[0] for u in (true, other))
    inverse = np.linalg.inv(np.eye(a.size) + 16.0 * np.outer(b, b.conj()))
    found, plain = [], []
    for _ in range(40):
        noise, drawn = (rng.standard_normal((n, 2)) @ [1, 1j] / np.sqrt(2) for n in (a.size, 1))
        values = np.zeros((ANTENNAS.num_tx, ANTENNAS.num_rx), complex)
        values[every.tx, every.rx] = a + 4.0 * drawn * b + noise
        one = Estimate(1e-7, 0.0, values)
        found.append(near_beam(one, sent, true + 0.02, inverse))
        plain.append(near_beam(one, sent, true + 0.02, np.eye(a.size)))
    assert np.abs(np.mean(found, axis=0) - true).max() < 0.01
    assert np.abs(np.array(found) - true).max() < 0.03
    assert np.abs(np.array(plain) - true).max() > 0.05
    heard = np.abs((inverse @ a).conj() @ np.stack([a, b], axis=1))
    assert heard[1] < 0.05 * heard[0]


@pytest.mark.parametrize("white", [False, True])
def test_search_finds_the_largest_statistic_over_directions(white: bool):
    """T(u) by its definition on a grid four times as fine, for coloured and for white noise, with a
    wave in every cell. What lies between 32 directions is found to 6 % and never exceeded
    (discretisation). Planted bugs: spectra conjugated; the turn of the other axis left out; the
    denominator's product of an X and a Z line once instead of twice."""
    w, rng, count = Waveform(), np.random.default_rng(3), 6
    antennas = replace(ANTENNAS, rx_x=6, rx_z=5)
    known_ = silent(w, antennas)
    channels = all_channels(antennas)
    search = channel_search(antennas, known_.wavenumber)
    size = len(channels)
    mixed = rng.standard_normal((size, size, 2)) @ np.array([1, 1j])
    R = np.eye(size) + (0 if white else 0.2) * mixed @ mixed.conj().T
    u = np.zeros((count, 3))
    u[:, [0, 2]] = rng.uniform(-0.6, 0.6, (count, 2))
    x = draw(R, count, rng) + 3.0 * channels.steering(u, known_)
    if white:
        found = search_plain(x.T[None].astype(np.complex64), search, 1.0, 0.0)
    else:
        same = np.broadcast_to(R, (count, size, size))
        given = x[:, None].astype(np.complex64), same.astype(np.complex64)
        found, _ = search_white(*given, np.arange(count), search)
    line = np.linspace(-1, 1, 129) * antennas.view_limit
    grid = np.zeros((line.size**2, 3))
    grid[:, 0], grid[:, 2] = (g.ravel() for g in np.meshgrid(line, line))
    grid = grid[(grid**2).sum(axis=1) <= 1]
    a = channels.steering(grid, known_)
    weighted = a.conj() @ np.linalg.inv(R)
    T = np.abs(weighted @ x.T) ** 2 / (weighted * a).sum(axis=1).real[:, None]
    assert np.array_equal(found.cell, np.arange(count))
    np.testing.assert_allclose(found.peak, T.max(axis=0), rtol=0.06)
    assert (found.peak <= 1.03 * T.max(axis=0)).all()  # the grid's own loss
    assert np.abs(found.cosines - grid[T.argmax(axis=0)][:, [0, 2]]).max() < 0.03


def test_detections_and_births_keep_their_rates_in_noise():
    """White noise in 15,000 cells and no clutter: at the design rate or below it, by what the grid
    of directions misses, and above a third of it. Planted bugs: the threshold of the arms for all
    channels; both rates alike."""
    w, rng = Waveform(num_samples=256), np.random.default_rng(12)
    sent = silent(w, ANTENNAS)
    shape = (3, ANTENNAS.num_rx, 128, w.num_chirps, 2)
    maps = (rng.standard_normal(shape) @ np.array([1, 1j])).astype(np.complex64)
    nothing = ExpectedClutter(*np.zeros((3, 0)), *np.zeros((2, 0, 3)))
    settings = Receivers(
        clutter_detector="angle_doppler", false_alarm_rate=4e-3, update_false_alarm_rate=2e-2
    )
    detector = AngleDoppler(settings)
    usual, _, test = detector.test_cells(maps, accumulate(maps), sent, nothing)
    sure = usual * test.limits[0] / test.limits[1]
    for ratio, rate in ((usual, 2e-2), (sure, 4e-3)):
        hits, cells = int((ratio > 1).sum()), ratio.size
        assert stats.binom.ppf(FALSE_FAILURE, cells, rate / 3) <= hits
        assert hits <= stats.binom.isf(FALSE_FAILURE, cells, rate)


def test_power_map_is_the_mean_power_of_random_clutter():
    """60 draws of 40 circular Gaussian scatterers, moving, through the receiver's chain; speckle of
    an average over the map is 3 %. Planted bug: amplitude in place of power in the Doppler
    kernel."""
    w, schedule, payload = frame(waveform=SHORT)
    paths, rng = scatterers(40, 8, (10.0, 24.0)), np.random.default_rng(2)
    single = [maps_of(w, schedule, payload, [p], FEW, 110) for p in paths]
    power = np.zeros((110, w.num_chirps))
    for _ in range(60):
        a = rng.standard_normal((40, 2)) @ np.array([1, 1j]) / np.sqrt(2)
        power += accumulate(np.einsum("s,s...->...", a, single).astype(np.complex64)) / 60
    sent = known(w, schedule, payload, FEW)
    predicted = expected_power(expected(paths), sent, 110, Taper(0.0, 0.0, 0.0))
    some = predicted > 1e-3 * predicted.max()
    ratio = power[some] / predicted[some]
    assert power[some].sum() / predicted[some].sum() == pytest.approx(1, abs=4 / np.sqrt(60 * 20))
    assert np.median(ratio) == pytest.approx(1, abs=0.12)


def test_expected_count_is_that_of_a_fine_scan():
    """One arm scanned 16 times as finely: crossings of t = 7 against the Euler characteristic.
    Planted bug: sqrt(t/pi) without pi."""
    w, rng, draws = Waveform(), np.random.default_rng(4), 40000
    row = np.arange(16)
    place = ANTENNAS.spacing * row
    channels = Channels(row, row, np.stack([place, 0 * place, 0 * place], axis=1))
    u = np.zeros((513, 3))
    u[:, 0] = np.linspace(-1, 1, 513) * np.sin(ANTENNAS.half_view)
    k = 2 * np.pi * w.effective_carrier / SPEED_OF_LIGHT
    length = 2 * np.sin(ANTENNAS.half_view) * k * channels.positions[:, 0].std()
    fine = channels.steering(u, silent(w, ANTENNAS))
    x = rng.standard_normal((draws, 16, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    above = np.concatenate(
        [(np.abs(part @ fine.conj().T) ** 2).max(axis=1) / 16 > 7 for part in np.array_split(x, 20)]
    )
    p = float(expected_count(7.0, (length,), 0.0))
    assert above.mean() == pytest.approx(p, abs=5 * np.sqrt(p / draws) + 0.05 * p)


def test_noise_level_from_the_quietest_cells():
    """Means of few exponentials: their median is less than their mean, which Wilson and Hilferty's
    cube makes up for to 0.3 %; and half of the map under clutter that the mesh foretells. Planted
    bugs: the cube left out; the loudest cells taken."""
    rng = np.random.default_rng(14)
    for looks in (5, 21):
        power = 0.37 * rng.gamma(looks, 1 / looks, (400, 500))
        spread = 5 * 1.3 / np.sqrt(looks * power.size)
        assert noise_level(power, None, looks) == pytest.approx(0.37, rel=3e-3 + spread)
        expected = np.where(np.arange(400)[:, None] < 200, 0.0, 10.0) * np.ones(power.shape)
        loud = power + expected * rng.exponential(1.0, power.shape)
        assert noise_level(loud, expected, looks) == pytest.approx(0.37, rel=3e-3 + 2 * spread)


def test_background_is_noise_and_expected_clutter():
    """White noise through the receiver's chain where the mesh foretells clutter: the level is its
    power over the foretold one's, alike in all cells. Planted bug: the clutter taken off."""
    w, schedule, payload = frame(waveform=SHORT)
    guess = expected(scatterers(7, 5, (8.0, 26.0)))
    maps = maps_of(w, schedule, payload, [], FEW, 110, noise=0.7, seed=2)
    settings = Receivers(clutter_detector="angle_doppler")
    sent = known(w, schedule, payload, FEW)
    detector = AngleDoppler(settings)
    _, _, test = detector.test_cells(maps, accumulate(maps), sent, guess)
    assert np.array_equal(test.expected, expected_power(guess, sent, 110))
    mean = (np.abs(maps) ** 2).mean()
    assert test.noise == pytest.approx(mean, rel=0.05)  # the median of a third of the cells


def test_ratio_of_the_cfar_is_its_decision():
    """Planted bugs: multiplied by the factor; the factor of other rows."""
    rng, settings = np.random.default_rng(15), Receivers(false_alarm_rate=1e-2)
    power = rng.gamma(15, 1 / 15, (90, 60))
    ratio, level = CfarRule.of(settings, 15).ratio(power)
    above, same = CfarRule.of(settings, 15).detect(power)
    assert above.sum() > 20 and np.array_equal(ratio > 1, above) and np.array_equal(level, same)


def test_size_of_the_scanned_directions():
    """Sides and area in correlation lengths, k sin(half view) apart, from the places' variances
    written out. Planted bugs: the variance for the deviation; the area without the covariance of
    the two arms."""
    w, antennas = Waveform(), replace(ANTENNAS, rx_x=3, rx_z=4)
    channels = all_channels(antennas)
    x, z = (
        channels.positions[:, 0] - channels.positions[:, 0].mean(),
        channels.positions[:, 2] - channels.positions[:, 2].mean(),
    )
    k = 2 * np.pi * w.effective_carrier / SPEED_OF_LIGHT
    side = 2 * np.pi / (k * antennas.spacing)  # what the elements tell apart is all in view
    lengths, area = scanned(channel_search(antennas, k))
    assert lengths == pytest.approx(
        (side * k * np.sqrt((x * x).mean()), side * k * np.sqrt((z * z).mean())), rel=1e-9, abs=0
    )
    determinant = (x * x).mean() * (z * z).mean() - (x * z).mean() ** 2
    assert area == pytest.approx(side**2 * k**2 * np.sqrt(determinant), rel=1e-9, abs=0)


def test_direction_within_a_filters_beam():
    """Power of the filter's beam from exact responses, and the place of the most of it, to the last
    step of the search. Planted bugs: conjugated; the other arm's axis."""
    w, antennas = Waveform(), replace(ANTENNAS, rx_x=6, rx_z=5)
    u, k = np.array([0.37, -0.21]), 2 * np.pi * w.effective_carrier / SPEED_OF_LIGHT
    wave = [
        np.exp(-1j * k * (positions[:, [0, 2]] @ u))
        for positions in (antennas.tx_positions, antennas.rx_positions)
    ]
    estimate = Estimate(1e-7, 1e-8, 2.3j * np.outer(*wave))
    size = len(all_channels(antennas))
    found = near_beam(estimate, silent(w, antennas), u + np.array([0.043, -0.038]), np.eye(size))
    assert np.abs(found - u).max() < 0.003
    steering = all_channels(antennas).steering(np.array([[u[0], 0.0, u[1]]]), silent(w, antennas))
    weights = steering[0].reshape(antennas.num_tx, -1)
    assert abs((weights.conj() * np.outer(*wave)).sum()) == pytest.approx(
        size, rel=2e-3
    )  # the window's middle is 9 samples off


def test_receiver_finds_what_clutter_hides():
    """60 strong scatterers around a flying terminal, known in power and place but not in phase, and
    in their midst a target 13 dB weaker than them: CFAR is lost in false alarms, the filter has the
    target, its direction and at most two more. Planted bug: steering conjugated."""
    w, schedule, payload = frame(waveform=SHORT)
    antennas, rng = replace(ANTENNAS, rx_x=6, rx_z=3), np.random.default_rng(3)
    truth = scatterers(60, 21, (14.0, 21.0))
    guess = expected(truth)
    guess = replace(guess, power=20 * guess.power)
    for path in truth:
        path.amplitude = (
            np.sqrt(20)
            * abs(path.amplitude)
            * (rng.standard_normal() + 1j * rng.standard_normal())
            / np.sqrt(2)
        )
    target = Path(2 * 17.3, -2 * 9.3 * 0.74, 1.1, (-0.5, -0.3), (-0.5, -0.3))
    received = cube(w, schedule, payload, [*truth, target], antennas, 20.0, 1)
    count = {}
    for detector in ("cfar", "angle_doppler"):
        settings = Receivers(clutter_detector=detector, false_alarm_rate=1e-5)
        d = receive_active(received, payload, antennas, settings, clutter=guess).detections
        near = (np.abs(d.range - 17.3) < w.range_cell(2)) & (
            np.abs(d.velocity - target.rate / 2) < w.velocity_cell(2)
        )
        count[detector] = int(near.sum()), int((~near).sum())
    assert count["cfar"][1] > 4
    assert count["angle_doppler"][0] == 1
    assert count["angle_doppler"][1] <= 2
    assert (
        np.abs(d.direction[near][0] - target.arrival).max() < 0.08
    )  # half a lobe of 12 elements, pulled by the clutter that is left
    # the paper's estimates here too: centres of cells. Planted bug: refined all the same
    d = receive_active(
        received,
        payload,
        antennas,
        settings.model_copy(update={"refinement": "grid"}),
        clutter=guess,
    ).detections
    bins = d.velocity / w.velocity_cell(2)
    assert len(d) and np.abs(bins - np.round(bins)).max() < 1e-9


def test_snr_of_a_detection_in_clutter_is_power_over_background():
    """A lone echo where the mesh foretells next to nothing: the highest cell of the mean map over
    the mean of noise that went the same way. Planted bug: times the background."""
    w, schedule, payload = frame(waveform=SHORT)
    guess = expected(scatterers(7, 5, (8.0, 26.0)))
    guess = replace(guess, power=1e-9 * guess.power)
    echo = [Path(2 * 17.3, 2 * 3.3, 2.0, (0.2, 0.1), (0.2, 0.1))]
    received = cube(w, schedule, payload, echo, FEW, 20.0, 1)
    settings = Receivers(clutter_detector="angle_doppler")
    d = receive_active(received, payload, FEW, settings, clutter=guess).detections
    powers = [
        (np.abs(maps_of(w, schedule, payload, p, FEW, 110, noise=20.0, seed=1)) ** 2).mean(
            axis=(0, 1)
        )
        for p in (echo, [])
    ]
    assert d.snr.max() == pytest.approx(
        powers[0].max() / powers[1].mean(), rel=0.1
    )  # the level is a median of a third of the cells


def test_a_mesh_detector_without_a_mesh_says_so():
    w, schedule, payload = frame(waveform=SHORT)
    with pytest.raises(ValueError, match="clutter that the mesh predicts"):
        receive_active(
            cube(w, schedule, payload, [], FEW, 1.0),
            payload,
            FEW,
            Receivers(clutter_detector="angle_doppler"),
        )


STRAIGHT, PROBES_M = (0.3, 0.0), (-0.2, 0.3)


@pytest.mark.parametrize(
    ("ways", "beside", "clutter", "starts"),
    [
        ((STRAIGHT, STRAIGHT), 0.0, False, True),
        ((STRAIGHT, STRAIGHT), 0.2, False, True),
        ((STRAIGHT, PROBES_M), 0.0, False, False),
        ((STRAIGHT, PROBES_M), 0.0, True, True),
    ],
    ids=["straight", "beside a wall", "over a wall", "in clutter"],
)
def test_an_echo_over_a_wall_on_one_way_starts_no_track(ways, beside, clutter, starts):
    """A UAV's echo leaves and comes from one direction; of a wall it may have a fifth of its power
    in its cell. Over a wall on one of the ways two equal waves arrive, which leave where the other
    comes from, and no direction explains both. In a cell with clutter, where other waves are
    anyway, that says nothing. Planted bugs: what the channels leave not asked; asked where clutter
    is; `MIXED` instead of `TWO_WAVES`."""
    w, schedule, payload = frame(waveform=SHORT)
    sent = known(w, schedule, payload, ANTENNAS)
    there, back = ways
    paths = [Path(60.0, 9.0, 0.5, there, back), Path(60.0, 9.0, 0.5, back, there)]
    paths += [
        Path(60.0, 9.0, np.sqrt(beside), PROBES_M, PROBES_M)
    ]  # the straight ones add up to one
    spectra = clean_spectrum(cube(w, schedule, payload, paths, ANTENNAS, noise=1.0, seed=5), sent)
    guess = expected([Path(60.0, 9.0, 0.05, (0.1, -0.1), (0.1, -0.1))])
    guess = guess if clutter else guess.select(np.zeros(1, bool))
    settings = Receivers(clutter_detector="angle_doppler")
    d = AngleDoppler(settings).sense(spectra, sent, Hints(guess)).detections
    best = d.snr.argmax()
    assert abs(d.range[best] - 30.0) < w.range_cell(2)
    assert bool(d.starts[best]) is starts


def no_clutter() -> Hints:
    """A city of which nothing is heard."""
    guess = expected([Path(60.0, 9.0, 0.05, (0.1, -0.1), (0.1, -0.1))])
    return Hints(guess.select(np.zeros(1, bool)))


@pytest.mark.parametrize("clutter", [False, True])
def test_uavs_in_one_cell_are_told_apart_by_their_directions(clutter):
    """Three UAVs of one range and rate, 15 to 30 degrees apart, of which the weakest is 4 dB under
    the strongest: each is found at its direction and may start a track. Planted bugs: one wave a
    cell; the further ones sought in all of the cell; the others left in an estimate's channels."""
    w, schedule, payload = frame(waveform=SHORT)
    sent = known(w, schedule, payload, ANTENNAS)
    directions = [(0.05, 0.02), (-0.31, 0.05), (0.33, -0.12)]
    amplitudes = (0.5, 0.4, 0.32)
    paths = [
        Path(60.0 + 0.02 * k, 9.0, a, u, u)
        for k, (a, u) in enumerate(zip(amplitudes, directions, strict=True))
    ]
    spectra = clean_spectrum(cube(w, schedule, payload, paths, ANTENNAS, noise=1.0, seed=5), sent)
    hints = no_clutter()
    if clutter:
        hints = Hints(expected([Path(60.0, 9.0, 0.02, (0.1, -0.5), (0.1, -0.5))]))
    settings = Receivers(clutter_detector="angle_doppler")
    d = AngleDoppler(settings).sense(spectra, sent, hints).detections
    for u in directions:
        off = np.where(d.starts, np.abs(d.direction - u).max(axis=1), np.inf)
        assert off.min() < (0.04 if clutter else 0.02)
        assert abs(d.range[off.argmin()] - 30.0) < 0.1 * w.range_cell(2)


def test_a_strong_wave_is_one():
    """40 dB over the noise of a cell, between the grid's cells: nothing further is found in what
    its removal leaves. Planted bug: `RESIDUAL_SHARE` nothing."""
    w, schedule, payload = frame(waveform=SHORT)
    sent = known(w, schedule, payload, ANTENNAS)
    path = Path(60.0 + w.range_cell(1) * 0.47, 9.13, 6.0, (0.05, 0.02), (0.05, 0.02))
    spectra = clean_spectrum(cube(w, schedule, payload, [path], ANTENNAS, noise=1.0, seed=6), sent)
    settings = Receivers(clutter_detector="angle_doppler")
    d = AngleDoppler(settings).sense(spectra, sent, no_clutter()).detections
    assert (np.abs(d.range - path.length / 2) < 2 * w.range_cell(2)).sum() == 1


@pytest.mark.parametrize("clutter", [0.0, 1e4])
def test_an_axis_whose_channels_hold_clutter_is_not_told(clutter):
    """One wave on an L whose upright arm may be covered by clutter: what is left of it, a row, has
    the same likelihood at all elevations. Planted bug: the likelihood of white noise."""
    w = Waveform()
    search = channel_search(ANTENNAS, 2 * np.pi / w.wavelength)
    x = 9 * search.steering(np.array([0.2, 0.1]))
    z = search.channels.positions[:, 2]
    upright = z > z.min() + 1e-6
    inverse = np.diag(1 / (1 + clutter * upright)).astype(np.complex64)
    (wave,) = waves_of(x, inverse, np.array([0.2, 0.1]), search, 20.0)
    assert wave.told.tolist() == [True, clutter == 0]


def test_a_single_channel_holds_one_wave():
    """The bug that was there: a second wave sought in what one leaves of a single channel, whose
    statistic is 0 over 0."""
    search = channel_search(replace(ANTENNAS, tx_x=1, tx_z=1, rx_x=1, rx_z=1), 1600.0)
    one = np.ones((1, 1), np.complex64)
    (wave,) = waves_of(9 * one[0], one, np.zeros(2), search, 20.0)
    assert wave.share == pytest.approx(1) and wave.told.all()


def test_waves_of_an_echo_over_a_wall_start_no_track():
    """A UAV at 20 m, a pair of waves in one cell at 25 m of which one comes from there, a pair from
    elsewhere, and one wave alone behind the UAV. Planted bugs: one of the pair spared; a wave alone
    marked; directions not asked; the source's strength not asked."""
    u = np.array([[0.1, 0], [0.12, 0.01], [0.7, 0], [-0.4, 0], [0.5, 0.2], [0.1, 0]])
    d = Detections(
        range=np.array([20.0, 25, 25, 26, 26, 31]),
        velocity=np.zeros(6),
        direction=u,
        snr=np.array([50.0, 4, 5, 4, 4, 3]),
        std=np.full((6, 4), 1e-2),
        is_reference=np.zeros(6, bool),
        starts=np.ones(6, bool),
    )
    cells = np.array([[80, 3], [100, 4], [100, 4], [104, 4], [104, 4], [124, 3]])
    w, schedule, payload = frame(waveform=SHORT)
    sent = known(w, schedule, payload, ANTENNAS)
    assert over_walls(d, cells, sent).tolist() == [False, True, True, False, False, False]
    weak = replace(d, snr=np.array([2.0, 4, 5, 4, 4, 3]))
    leaked = replace(d, starts=np.arange(6) > 0)
    assert not over_walls(weak, cells, sent).any() and not over_walls(leaked, cells, sent).any()


ARRAYS = {
    "plane": ([[0, 0], [2, 0], [0, 2]], {"shape": "planar", "columns": 4, "rows": 4}),
    "board": ([[0, 0], [1, 0.5], [2, 0]], {"shape": "linear", "columns": 4}),
}


@pytest.mark.parametrize("passes", [2, 1])
@pytest.mark.parametrize("name", ARRAYS)
def test_a_target_is_found_with_any_array(name, passes):
    """A UAV at an active terminal, beside a wave in its cell that is 10 dB stronger and foretold,
    and at a passive one, 32 dB under a line of sight: one detection is off by less than 4 of its
    deviations and a quarter of a resolution on every axis that the array observes, and has no
    direction on another. Planted bugs: X and Z exchanged in the search's steering; channels with
    the next element's place; a direction on the axis that the board does not observe."""
    w, schedule, payload = frame(waveform=SHORT)
    tx, rx = ARRAYS[name]
    antennas = antennas_of(Array.model_validate({"tx": {"positions": tx}, "rx": rx}), w)
    place, u = np.array([17.31, 3.3]), (0.21, -0.13)
    if passes == 2:
        beside = Path(*2 * place, 1.0, (-0.55, 0.3), (-0.55, 0.3))
        settings = Receivers(clutter_detector="angle_doppler")
        paths = [Path(*2 * place, 0.3, u, u), beside]
        samples = cube(w, schedule, payload, paths, antennas, 1.0, 3)
        found = receive_active(samples, payload, antennas, settings, clutter=expected([beside]))
    else:
        sight, target = Path(11.2, 5.1, 6.0, (0.4, 0.1)), Path(*place, 0.15, u)
        samples = cube(w, schedule, unmodulated(w), [sight, target], antennas, 1.0, 3)
        settings = Receivers(passive_detector="beams")
        found = receive_passive(samples, antennas, settings, 8, None, False)
    d, sees = found.detections, np.array([True, True, *antennas.observes(passes)])
    allowed = np.minimum(4 * d.std, resolutions(w, antennas, passes) / 4)
    off = np.abs(d.measured - [*place, *u])
    hit = np.flatnonzero((off < allowed)[:, sees].all(axis=1))
    assert len(hit) == 1 and np.array_equal(np.isfinite(d.measured[hit[0]]), sees)
