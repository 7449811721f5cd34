"""Maps, CFAR, off-grid estimates and angles at the receivers, on cubes written from the signal's
equation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame, known
from scipy import stats
from scipy.integrate import quad

from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform, hann
from isac_rt.receive.active import receive_active
from isac_rt.receive.cfar import (
    CfarRule,
    hann_envelope,
    independent_cells,
    without_sidelobes,
)
from isac_rt.receive.chain import passive_detector_of
from isac_rt.receive.estimate import (
    LocalSpectra,
    directions,
    excess,
    hann_response,
    newton,
    refine,
    standard_deviations,
    start_point,
)
from isac_rt.receive.known import Known
from isac_rt.receive.maps import (
    Conventional,
    LatinUnion,
    accumulate,
    channel_maps,
    correlation_operator,
)
from isac_rt.receive.omp import Omp
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.sense import Cfar
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum

FEW = replace(ANTENNAS, rx_x=2, rx_z=2)  # three receivers: what needs no aperture runs faster
SETTINGS = Receivers()
GUARD, TRAINING = SETTINGS.guard_cells, SETTINGS.training_cells
FALSE_FAILURE = 1e-6  # statistical


# --- Doppler


def test_sparse_correlation_is_the_sum_over_the_samples():
    """Planted bug: group offsets left out."""
    w = Waveform(num_groups=2)
    schedule, payload = frame(waveform=w)[1:]
    times = known(w, schedule, payload).slots[schedule == 2]
    values = np.random.default_rng(3).standard_normal(times.size)
    got = correlation_operator(w, times) @ values
    for k in (0, 7, 59, 60, 113):
        number = k if k < 60 else k - 120
        slow = sum(
            v * np.sin(np.pi * (int(t) + 0.5) / 120) ** 2 * np.exp(-2j * np.pi * number * t / 120)
            for v, t in zip(values, times, strict=True)
        )
        assert abs(got[k] - slow) < 1e-5 * np.abs(values).sum()  # rounding of complex64


@pytest.mark.parametrize("in_phase", [False, True])
def test_power_of_a_beam_is_that_of_the_responses(in_phase: bool):
    """Seventeen receivers, more than lie side by side. Planted bugs: receivers beyond the
    sixteenth left out; the energy of another antenna's chirps."""
    w, schedule, payload = frame(waveform=Waveform(num_chirps=36))
    rng, sent = np.random.default_rng(4), known(w, schedule, payload)
    spectra = (rng.standard_normal((3, 17, 20, 36, 2)) @ [1, 1j]).astype(np.complex64)
    beam = rng.standard_normal((w.num_tx, 17, 2)) @ [1, 1j]
    local = LocalSpectra(spectra, sent, 9, beam=beam, in_phase=in_phase)
    delays, rates = np.array([8.8, 9.3]) * w.delay_step, np.array([1.1e-8, -2.3e-8])
    got = local.powers(delays, rates)
    for power, delay, rate in zip(got, delays, rates, strict=True):
        towards = (beam * local.respond(delay, rate)).sum(axis=1)
        expected = abs(towards.sum()) ** 2 if in_phase else np.linalg.norm(towards) ** 2
        assert power == pytest.approx(expected, rel=1e-12, abs=0)  # rounding


def test_method_follows_the_schedule():
    _, schedule, _ = frame()
    two = Waveform(num_groups=2)

    def way(method: str, w: Waveform, slots: np.ndarray) -> type:
        sent = Known.unmodulated(w, slots, ANTENNAS, 2)
        return type(passive_detector_of(Receivers(velocity_method=method)).doppler_method(sent))

    assert way("auto", Waveform(), schedule) is LatinUnion
    assert way("auto", two, schedule[:2]) is Omp
    assert way("auto", two, conventional_schedule(2, 120, 3)) is Conventional
    assert way("omp", Waveform(), schedule) is Omp
    assert way("latin_union", two, schedule[:2]) is LatinUnion


# --- CFAR


@pytest.mark.parametrize("count", [1, 2, 7, 19])
def test_independent_cells_of_a_windowed_axis(count: int):
    """From the transform of the squared window. Planted bug: neighbours taken for independent."""
    squared = np.fft.fft(np.sin(np.pi * (np.arange(120) + 0.5) / 120) ** 4)
    alike = np.abs(squared / squared[0]) ** 2
    pairs = sum(alike[abs(i - j)] for i in range(count) for j in range(count))
    assert independent_cells(count) == pytest.approx(count**2 / pairs, rel=1e-9)  # rounding


@pytest.mark.parametrize(("guard", "training"), [((1, 0), (2, 1)), ((3, 2), (5, 1))])
def test_threshold_of_a_map_by_its_integral(guard: tuple[int, int], training: tuple[int, int]):
    """A cell over the greater mean of two blocks of training[0] rows and 2 (guard + training) + 1
    bins each, neighbours weighed by the window; in the first row over the block behind alone.
    Planted bugs: a bin more; the guard's rows among the training's."""

    def independent(count: int) -> float:
        squared = np.fft.fft(np.sin(np.pi * (np.arange(120) + 0.5) / 120) ** 4)
        alike = np.abs(squared / squared[0]) ** 2
        return count**2 / sum(alike[abs(i - j)] for i in range(count) for j in range(count))

    looks, rate, quadrature = (
        3,
        2e-3,
        1e-3,
    )  # of the rate; the factor is good to 1e-4 and the tail is steep
    size = looks * independent(training[0]) * independent(2 * (guard[1] + training[1]) + 1)
    cell, mean = stats.gamma(looks, scale=1 / looks), stats.gamma(size, scale=1 / size)
    rule = CfarRule(rate, guard, training, looks)
    z = rule.threshold
    both = quad(
        lambda y: 2 * mean.pdf(y) * mean.cdf(y) * cell.sf(z * y),
        0,
        12,
        points=[0.3, 1, 2],
        limit=200,
    )[0]
    assert both == pytest.approx(rate, rel=quadrature, abs=0)
    first = rule.factors(60)[0]
    one = quad(lambda y: mean.pdf(y) * cell.sf(first * y), 0, 12, points=[0.3, 1, 2], limit=200)[0]
    assert one == pytest.approx(rate, rel=quadrature, abs=0)


def test_background_against_plain_loops():
    """Guard and training of four different sizes, cells left out, both ends of the range axis,
    Doppler round its ends: the greater of both sides' means. Planted bugs: the guard of Doppler in
    range; the rows of the other side; a side of too few cells that counts."""
    rng, guard, training = np.random.default_rng(17), (2, 1), (5, 3)
    power, keep = rng.exponential(1.0, (23, 17)), rng.random((23, 17)) > 0.3
    found = CfarRule(1e-3, guard, training, 1).background(power, keep)
    for row in range(23):
        for column in range(17):
            columns = np.arange(column - 4, column + 5) % 17
            means = []
            for rows in (range(max(row - 7, 0), max(row - 2, 0)), range(row + 3, min(row + 8, 23))):
                block = np.ix_(list(rows), columns)
                if len(rows) >= 2 and keep[block].sum() >= 0.25 * 9 * len(rows):
                    means.append(power[block][keep[block]].mean())
            assert found[row, column] == pytest.approx(max(means, default=np.inf), rel=1e-9)


def test_a_clutter_edge_raises_no_alarms():
    """A step of 20 dB in range. Planted bug: the mean of both sides, which gives thousands of
    alarms before the edge's far side."""
    rng = np.random.default_rng(4)
    power = rng.gamma(45, 1 / 45, (200, 120))
    power[100:] *= 100
    above, _ = CfarRule(1e-4, GUARD, TRAINING, 45).detect(power)
    # the four rows behind the edge see it in their guard cells only: their own side holds the rate
    # to a few times the design
    assert above.sum() <= stats.binom.isf(FALSE_FAILURE, power.size, 3e-4)


def test_hann_envelope_bounds_the_window_spectrum():
    """Against the transform of the window itself. Planted bug: exponent of the sidelobes."""
    n = np.arange(4096)
    spectrum = np.abs(np.fft.fft(np.sin(np.pi * n / 4096) ** 2, 16 * 4096)[: 16 * 40]) ** 2
    relative, distance = spectrum / spectrum[0], np.arange(16 * 40) / 16
    bound = hann_envelope(distance)
    assert (relative <= bound * 1.01).all()
    peak = [
        relative[(distance >= k) & (distance < k + 1)].max() / bound[16 * k + 8]
        for k in range(3, 30)
    ]
    assert min(peak) > 0.7  # not loose either


# --- estimates


def test_peaks_that_lobes_explain_are_those_of_plain_numpy():
    """Planted bugs: the lobes of peaks that are none; bins apart not counted round the end; the
    floor left out."""
    rng = np.random.default_rng(8)
    rows, bins = rng.integers(0, 40, 200), rng.integers(0, 120, 200)
    power = np.zeros((40, 120), np.float32)
    power[rows, bins] = 10 ** rng.uniform(-6, 0, 200)
    order = np.argsort(-power[rows, bins], kind="stable")
    rows, bins = rows[order], bins[order]
    keep = np.zeros(200, bool)
    for i in range(200):
        some = np.flatnonzero(keep[:i])
        across = np.abs(bins[i] - bins[some])
        lobes = hann_envelope(np.minimum(across, 120 - across)) + 1e-5
        bound = 4 * power[rows, bins][some] * hann_envelope(rows[i] - rows[some]) * lobes
        keep[i] = not (power[rows[i], bins[i]] <= bound).any()
    assert 50 < keep.sum() < 150
    assert without_sidelobes(rows, bins, power, 120, 1e-5).tolist() == keep.tolist()


def test_window_transform_is_closed_form():
    """Planted bug: the transform about the first sample."""
    w = Waveform()
    n, length = np.arange(w.num_samples), w.window_length
    for offset in (0.0, 0.37, -1.2, 2.6):
        slow = (
            hann(n, length) * np.exp(2j * np.pi * offset * (n - length / 2) / w.num_samples)
        ).sum()
        assert abs(slow - hann_response(w, np.array(offset))) < 1e-4 * length / 2


def test_one_way_angles_use_the_receive_arm_only():
    """Arrival and departure differ. Planted bug: the virtual array at a PT."""
    w, schedule, _ = frame()
    pilot = unmodulated(w)
    signal = cube(w, schedule, pilot, [Path(83.71, 6.6, 1.0, (0.37, -0.21), (-0.55, 0.42))])
    spectra = clean_spectrum(signal, known(w, schedule, pilot, ANTENNAS, 1), 512)
    d = Cfar(SETTINGS).sense(spectra, known(w, schedule, pilot, ANTENNAS, 1)).detections
    assert len(d) == 1 and abs(d.range[0] - 83.71) < 2e-4 and abs(d.velocity[0] - 6.6) < 1e-5
    assert np.abs(d.direction[0] - [0.37, -0.21]).max() < 2e-4


def test_outside_the_field_of_view_there_is_no_direction():
    w, schedule, payload = frame()
    narrow = replace(ANTENNAS, half_view=np.deg2rad(30.0))
    signal = cube(w, schedule, payload, [Path(61.4, 2.2, 1.0, (0.7, 0.1), (0.7, 0.1))])
    d = receive_active(signal, payload, narrow, SETTINGS).detections
    assert np.isnan(d.direction[0, 0]) and abs(d.direction[0, 1] - 0.1) < 1e-3


def test_each_of_many_detections_has_its_own_direction_and_other_waves():
    """Spherical waves from 4 to 60 m, by the exact distances to each antenna: alone and with a
    second one in the cell, looked at at once. Directions of single ones are within 1e-4; another
    one's distance would turn them by 2e-4 to 7e-4. What a wave leaves is held against least squares
    on its exact channels, to 1 % for the phases of the second order. One without a direction
    has no other waves. Planted bugs: the delay, or the signal-to-noise ratio, of another detection
    where some have no direction; the first one's deviations for all."""
    w, a = Waveform(num_samples=256, num_chirps=60), ANTENNAS
    sent = Known.unmodulated(w, conventional_schedule(3, w.num_chirps, 3), a, 2)

    def wave(distance, x, z):
        source = distance * np.array([x, np.sqrt(1 - x * x - z * z), z])
        tx, rx = (np.linalg.norm(source - e, axis=1) for e in (a.tx_positions, a.rx_positions))
        return np.exp(2j * np.pi * w.effective_carrier * (tx[:, None] + rx) / SPEED_OF_LIGHT)

    places = [(60.0, -0.42, 0.23), (4.0, 0.31, -0.17), (11.0, 0.05, 0.37), (4.6, -0.2, -0.3)]
    beside = [0.0, 0.5, 0.7, 0.0]
    waves = [wave(*place) for place in places]
    channels = np.array(
        [one + q * wave(9.0, 0.6, 0.1) for one, q in zip(waves, beside, strict=True)]
    )
    distances, snr = np.array([place[0] for place in places]), np.array([50.0, 9.0, 20.0, 1e6])
    delays = 2 * distances / SPEED_OF_LIGHT
    u = directions(channels, delays, sent)
    for k in (0, 3):
        assert u[k] == pytest.approx(places[k][1:], abs=1e-4)
    u = np.insert(u, 1, [np.nan, 0.2], axis=0)  # nothing is known of the second one's direction
    rows = [0, 0, 1, 2, 3]
    others = excess(channels[rows], delays[rows], u, snr[rows], sent)
    assert others[1] == 0
    for k, row in ((0, 0), (1, 2), (2, 3), (3, 4)):
        column, seen = wave(distances[k], *u[row]).ravel(), channels[k].ravel()
        strength = np.vdot(column, seen) / column.size
        left = (np.abs(seen - strength * column) ** 2).sum() / (column.size - 1)
        left -= (np.abs(seen) ** 2).mean() / snr[k]
        expected = max(left, 0.0) / abs(strength) ** 2
        assert others[row] == pytest.approx(expected, rel=0.01, abs=1e-5)
        assert (expected > 0.05) == (beside[k] > 0)
    stated = standard_deviations(snr[rows], others, sent)
    for row, k in enumerate(rows):
        assert stated[row] == pytest.approx(standard_deviations(snr[k], others[row], sent))


@pytest.mark.parametrize("passes", [1, 2])
def test_pictures_hold_the_first_groups_mean_power_and_their_axes(passes: int):
    """The equivalent range map by its definition, and a path of the frame where the axes say.
    Planted bugs: divided by the chirps; speed of the other sign, of one pass for two."""
    w, schedule, _ = frame(waveform=Waveform(num_samples=256))
    length, rate = passes * 40.3 * w.range_cell(passes), passes * 17.2 * w.velocity_cell(passes)
    pilot = unmodulated(w)
    signal = cube(w, schedule, pilot, [Path(length, rate)], FEW, noise=0.3)
    maps = sense_pictures(signal, pilot, passes)
    truth = np.sqrt(
        (np.abs(np.fft.fft(signal.samples[0].astype(complex), axis=2)) ** 2).mean(axis=0).T
    )
    assert maps.equivalent_range == pytest.approx(truth, rel=1e-4, abs=0)
    row, column = np.unravel_index(maps.range_doppler.argmax(), maps.range_doppler.shape)
    assert abs(maps.range_axis[row] - length / passes) < 0.6 * w.range_cell(passes)
    assert abs(maps.velocity_axis[column] - rate / passes) < 0.6 * w.velocity_cell(passes)


def sense_pictures(signal: IFCube, pilot, passes: int):
    if passes == 2:
        return receive_active(signal, pilot, FEW, SETTINGS, maps=True).maps
    return receive_passive(signal, FEW, SETTINGS, 8, None, False, maps=True).maps


@pytest.mark.parametrize("passes", [1, 2])
def test_stated_deviations_are_the_bound_of_a_tone(passes: int):
    """Fisher information of a tone's frequency on each axis by differences, with all the SNR on
    range and velocity, Hann's loss of 2 there, and that of both directions by the places of all
    channels; the floors at high SNR. Planted bugs: the loss taken twice; the receivers' aperture
    alone for an echo; both directions as if the other one were known."""
    w, few, snr = Waveform(), replace(ANTENNAS, rx_x=5, rx_z=3), 37.3
    sent = known(w, frame()[1], unmodulated(w), few, passes)
    stated = standard_deviations(snr / sent.channels, 0.0, sent)
    x = np.linspace(-0.5, 0.5, 20001)  # the share of the axis: its frequency is in cells
    tone = 1 / np.sqrt(2 * snr * np.mean((2 * np.pi * x) ** 2))
    assert stated[0] == pytest.approx(np.sqrt(2) * tone * w.range_cell(passes), rel=1e-3, abs=0)
    assert stated[1] == pytest.approx(np.sqrt(2) * tone * w.velocity_cell(passes), rel=1e-3, abs=0)
    k = 2 * np.pi * w.effective_carrier / SPEED_OF_LIGHT
    senders = few.tx_positions if passes == 2 else np.zeros((3, 3))
    places = np.array([r + t for r in few.rx_positions for t in senders])[:, [0, 2]]
    places -= places.mean(axis=0)
    inverse = np.linalg.inv(2 * snr * k**2 * places.T @ places / len(places))
    # the window's middle is 9 samples off
    assert stated[2:] == pytest.approx(np.sqrt(np.diag(inverse)), rel=1e-4, abs=0)
    floors = [2e-3 * w.range_cell(passes), 4e-3 * w.velocity_cell(passes), 2e-4, 2e-4]
    assert standard_deviations(1e9, 0.0, sent) == pytest.approx(floors)
    least = 1 / sent.channels
    assert (standard_deviations(0.1 * least, 0, sent) == standard_deviations(least, 0, sent)).all()


@pytest.mark.parametrize("passes", [1, 2])
def test_two_paths_in_a_cell_are_not_stated_as_sure_as_one(passes: int):
    """Echoes at the active terminal, the line of sight and another path at a passive one, less than
    a cell and a bin apart, 0 to 10 dB, in drawn directions, merged to one detection: its errors
    from the nearer of the two over its deviations. Nine in ten are within 3 of range and
    velocity and within 6 of direction; pairs from one direction, of which the
    channels tell nothing, leave 4 rms. One path alone keeps its deviations: within 1.5 of 1 rms (30
    frames: 0.13), and may start a track; of pairs, whose second
    is down to 10 dB weaker, fewer than 0.6 may. Planted bugs: what the wave
    leaves not counted to the noise; without the pull."""
    w, schedule, payload = frame(waveform=Waveform(num_samples=128, num_chirps=48))
    six = replace(ANTENNAS, rx_x=3, rx_z=4)
    sent, rng = known(w, schedule, payload, six, passes), np.random.default_rng(9)
    cell = np.array([w.range_cell(passes), w.velocity_cell(passes)])
    off: dict[int, list[float]] = {1: [], 2: []}
    starts: dict[int, list[bool]] = {1: [], 2: []}
    for count in (1, 2):
        for seed in range(30 * count):
            first = np.array([rng.uniform(8, 50), rng.uniform(-15, 15)])
            truth = [first, first + rng.uniform(-1, 1, 2)][:count]
            places = [np.append(t * cell, rng.uniform(-0.5, 0.5, 2)) for t in truth]
            paths = [
                Path(
                    passes * p[0],
                    passes * p[1],
                    10 ** (-i * rng.uniform(0, 0.5)) * np.exp(2j * np.pi * rng.random()),
                    (p[2], p[3]),
                    (p[2], p[3]) if passes == 2 else tuple(rng.uniform(-0.5, 0.5, 2)),
                )
                for i, p in enumerate(places)
            ]
            signal = cube(w, schedule, payload, paths, six, noise=10.0, seed=seed)
            d = Cfar(SETTINGS).sense(clean_spectrum(signal, sent), sent).detections
            if len(d) == 1 and np.isfinite(d.direction).all():
                found = np.array([d.range[0], d.velocity[0], *d.direction[0]])
                errors = [((found - p) / d.std[0]) ** 2 for p in places]
                off[count].append(min(errors, key=np.sum))
                starts[count].append(bool(d.starts[0]))
    one, two = (np.sqrt(np.mean(off[count], axis=0)) for count in (1, 2))
    assert (one < 1.5).all() and len(off[1]) > 25
    assert (two < 4).all() and len(off[2]) > 50
    assert (np.quantile(off[2], 0.9, axis=0) < [9, 9, 36, 36]).all()
    assert np.mean(starts[1]) > 0.9 and np.mean(starts[2]) < 0.6


def test_the_active_terminal_reports_no_symbols():
    """`Reception` says -1 for what was not decided, at the symbols' shapes. Planted bugs: another
    number."""
    w, schedule, payload = frame(waveform=Waveform(num_samples=256))
    r = receive_active(cube(w, schedule, payload, [Path(30.0, 2.0)], FEW), payload, FEW, SETTINGS)
    assert (r.delay_symbols == -1).all() and r.delay_symbols.shape == payload.delay_symbols.shape
    assert (r.transitions == -1).all() and r.transitions.shape == payload.transitions.shape
    assert (
        not r.decoded
        and not r.bits.size
        and not r.delay_confidence.any()
        and not r.transition_confidence.any()
    )


@pytest.mark.parametrize(
    ("groups", "method", "strongest"),
    [(3, "latin_union", 5.0), (3, "omp", 0.07), (2, "auto", 0.07), (1, "auto", 0.05)],
)
def test_three_targets_in_noise(groups: int, method: str, strongest: float):
    """Two of them in one range cell, one stronger (40 dB with the union; with sparse sampling
    nearly alike, for off the grid the stronger one uses up OMP's atoms). Sparse sampling's
    sidelobes are not reported. Planted bugs: sidelobes of the strong one kept; OMP's correlation
    updated with the transposed Gram matrix."""
    w, schedule, payload = frame(waveform=Waveform(num_groups=groups), seed=7)
    targets = [(33.371, 3.3, strongest), (33.47, -5.1, 0.05), (51.12, -7.9, 0.05)]
    signal = cube(
        w,
        schedule,
        payload,
        [Path(2 * r, 2 * v, a, (0.2, 0.1), (0.2, 0.1)) for r, v, a in targets],
        noise=0.1,
    )
    d = receive_active(signal, payload, ANTENNAS, Receivers(velocity_method=method)).detections
    assert len(d) == 3
    for r, v, _ in targets:
        i = int(np.argmin(np.abs(d.range - r) + np.abs(d.velocity - v)))
        assert (
            abs(d.range[i] - r) < 0.05 and abs(d.velocity[i] - v) < 0.08
        )  # a fifth, a third of a cell beside the strong one


def test_leakage_is_passed_over_and_hides_nothing():
    """60 dB over an echo at 12 m that stands still as well. Planted bug: min_range_m ignored."""
    w, schedule, payload = frame()
    paths = [
        Path(0.3, 0.0, 30.0),
        Path(2 * 12.34, 0.0, 0.03, (0.1, 0.0), (0.1, 0.0)),
        Path(2 * 30.1, 2 * 4.0, 0.03),
    ]
    d = receive_active(
        cube(w, schedule, payload, paths, FEW, noise=0.1, seed=1), payload, FEW, SETTINGS
    ).detections
    assert sorted(np.round(d.range, 2).tolist()) == [12.34, 30.1]


def test_start_point_is_near_and_refinement_moves_to_the_truth():
    w, schedule, payload = frame()
    signal = cube(w, schedule, payload, [Path(57.77, 9.21)], FEW)
    spectra = clean_spectrum(signal, known(w, schedule, payload, ANTENNAS, 1), 512)
    power = accumulate(channel_maps(spectra, known(w, schedule, payload, passes=1)))
    row, column = (int(i) for i in np.unravel_index(power.argmax(), power.shape))
    delay, rate = start_point(power, row, column, w)
    assert abs(delay * SPEED_OF_LIGHT - 57.77) < 0.2 * w.range_cell(1)
    assert abs(rate * SPEED_OF_LIGHT - 9.21) < 0.1 * w.velocity_cell(1)
    found = refine(LocalSpectra(spectra, known(w, schedule, payload), row), delay, rate)
    assert (
        abs(found.delay * SPEED_OF_LIGHT - 57.77) < 2e-4
        and abs(found.delay_rate * SPEED_OF_LIGHT - 9.21) < 1e-5
    )
    assert np.abs(np.abs(found.channels) - 1).max() < 2e-3  # the amplitude of a sample


@pytest.mark.parametrize("curvature", [[[3.1, 1.7], [1.7, 2.3]], [[2.3, -1.1], [-1.1, 4.7]]])
def test_one_step_of_the_refinement_reaches_the_top_of_a_paraboloid(curvature):
    """Newton's step is exact there, with the mixed derivative in it. Planted bugs: its sign, or a
    half of it; the gradient over a step for over two; one end of the reach left open. Where the
    paraboloid is none the step is up, and a far top is come near by no more than three times the
    stencil, for the power is no paraboloid as far as that."""
    stencil = np.array(
        [[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [-1, 1], [1, -1], [1, 1]]
    )

    def moved(
        top: tuple[float, float], curvature: np.ndarray, mixed: float | None = None
    ) -> list[float]:
        off = 0.2 * stencil[: 9 if mixed is None else 5] - top
        powers = np.exp(-np.einsum("ki,ij,kj->k", off, curvature, off) / 2)
        down, across, found = newton(powers, 0.2, 0.0 if mixed is None else mixed)
        assert found == pytest.approx(-curvature[0][1], abs=1e-9)
        return [down, across]

    for top in ((0.31, -0.22), (-0.17, -0.35)):
        assert moved(top, np.array(curvature)) == pytest.approx(top, abs=1e-9)
        assert moved(top, np.array(curvature), -curvature[0][1]) == pytest.approx(top, abs=1e-9)
    assert moved((0.3, -0.3), -np.eye(2)) == [-0.2, 0.2]  # of a valley
    for far in ((4.3, -5.1), (-2.9, 3.7)):
        assert moved(far, np.eye(2)) == pytest.approx(0.6 * np.sign(far), abs=1e-9)


def test_two_cells_of_a_hann_tone_give_its_place():
    """Exact at any fraction, by the window's closed form. Planted bugs: the ratio's two for a one;
    the side of the greater neighbour."""
    w = Waveform()
    length = w.window_length / w.num_samples
    for d in (-0.49, -0.2, 0.0, 0.13, 0.5):
        three = hann_response(w, (np.array([-1.0, 0.0, 1.0]) - d) / length)
        power = np.zeros((40, w.num_chirps))
        power[19:22, 33] = three**2
        power[20, 32:35] = three**2
        found, rate = start_point(power, 20, 33, w)
        bins = rate * w.frame_duration * w.effective_carrier
        assert bins == pytest.approx(33 - w.num_chirps // 2 + d, abs=1e-9)
        assert (w.slope * found + rate * w.effective_carrier) * w.sampled_duration == pytest.approx(
            20 + d, abs=1e-9
        )


def test_a_strong_path_does_not_hide_a_target_beside_it():
    """A target 20 dB over the noise, 10 rows and 5 bins from a path at 60 dB, whose lobes fill part
    of the target's training block. Planted bug: all cells train."""
    rng = np.random.default_rng(4)
    power = rng.gamma(45, 1 / 45, (200, 120))
    rows, bins = np.abs(np.arange(200) - 90), np.abs(np.arange(120) - 50)
    power += (
        1e6
        * np.outer(hann_envelope(rows), hann_envelope(bins))
        * (np.maximum.outer(rows, bins) < 40)
    )
    power[100, 55] += 100
    above, _ = CfarRule(1e-6, (3, 3), (8, 6), 45).detect(power)
    assert above[100, 55]
    assert above[90, 50]
