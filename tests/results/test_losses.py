"""How well a path can be seen, against samples and draws; and the order of the causes."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame, known

from isac_rt.frame.cube import Transmission
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.cfar import CfarRule
from isac_rt.receive.maps import channel_maps, power_map
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.results.labels import MapPositions, hann_response
from isac_rt.results.losses import Chance, Channels, Loss, Sensitivity, cause_of, coherent_detection
from isac_rt.world.swarm import Pose

W = Waveform(num_samples=128, num_chirps=24)
FEW = replace(ANTENNAS, rx_x=2, rx_z=2)
SEES = Sensitivity(1000.0, 10.0, CfarRule.of(Receivers(), 45))


def sent(schedule, payload, amplitude=1.0) -> Transmission:
    return Transmission(
        name="AT",
        pose=Pose.at_rest(),
        antennas=ANTENNAS,
        schedule=schedule,
        payload=payload,
        amplitude=amplitude,
    )


def echo(length, rate, amplitude, others=(), u=0.0):
    """A path set of an echo of U from u_x, and `others` of (length [m], rate [m/s], gain, kind, and
    u_x of departure and arrival)."""
    rows = [(length, rate, amplitude, PathKind.TARGET, u, u)]
    rows += [(*other, 0.0, 0.0)[:6] for other in others]
    lengths, rates, gains, kinds, out, back = zip(*rows, strict=True)
    ends = [np.column_stack([u, np.sqrt(1 - np.square(u)), np.zeros(len(u))]) for u in (out, back)]
    return make_paths(
        gain=np.array(gains),
        delay=np.array(lengths) / SPEED_OF_LIGHT,
        delay_rate=np.array(rates) / SPEED_OF_LIGHT,
        departure=ends[0],
        arrival=ends[1],
        kind=np.array(kinds),
        target=np.array([0] + [-1] * (len(rows) - 1)),
        epoch=0.0,
        tx="AT",
        rx="AT",
        target_names=("U",),
    )


def chance_of(paths, sees=SEES, waveform=W, own=0) -> Chance:
    wavenumber = 2 * np.pi * float(waveform.carrier()) / SPEED_OF_LIGHT
    channels = Channels(ANTENNAS, wavenumber, Pose.at_rest(), Pose.at_rest())
    return Chance.of(own, paths, MapPositions.of(paths, waveform, 2), waveform, sees, channels)


@pytest.mark.parametrize(("bins", "rows"), [(3.0, 11.0), (3.5, 11.0), (-2.3, 17.4)])
def test_snr_of_a_cell_is_that_of_the_map(bins, rows):
    """A tone through the receiver's own transforms, its peak over the mean of noise alone: on a
    cell, half a cell off, and anywhere. 1 %: noise averaged over 3072 cells and 45 channels, and
    the range-Doppler coupling within a frame. Planted bugs: one Hann window only; the loss off the
    grid left out."""
    w, schedule, payload = frame(waveform=W)
    amplitude, noise = 0.7, 2.9
    rate = bins * w.velocity_cell(1)
    length = rows * w.range_cell(1)
    # the beat also holds the Doppler: take it off, so that the peak lies where it was asked for
    length -= float(w.beat_cells(0.0, rate / SPEED_OF_LIGHT, 0.0)) * w.range_cell(1)
    about = known(w, schedule, payload)
    tone = cube(w, schedule, payload, [Path(length, rate, amplitude)])
    alone = cube(w, schedule, payload, [], noise=noise, seed=5)
    peak, level = (power_map(clean_spectrum(c, about), about) for c in (tone, alone))
    sees = Sensitivity.of(w, ANTENNAS, Receivers(), sent(schedule, payload), noise, 3)
    chance = chance_of(echo(length, rate, amplitude), sees, w)
    assert chance.cell == pytest.approx(peak.max() / level.mean(), rel=0.01)
    assert sees.rule.looks == 45


def test_matched_filter_adds_everything_in_phase():
    """Energy of the samples over the noise, of half a frame the half. Planted bug: the groups left
    out."""
    w, schedule, payload = frame(waveform=W)
    tone = cube(w, schedule, payload, [Path(7.3, 1.7, 0.7)])
    sees = Sensitivity.of(w, ANTENNAS, Receivers(), sent(schedule, payload), 2.9, 3)
    found = chance_of(echo(7.3, 1.7, 0.7), sees, w)
    energy = float((np.abs(tone.samples) ** 2).sum())
    assert found.matched == pytest.approx(energy / 2.9, rel=1e-5)
    half = make_paths(
        **{
            name: getattr(echo(7.3, 1.7, 0.7), name)
            for name in ("gain", "delay", "delay_rate", "departure", "arrival", "kind", "target")
        },
        begin=np.zeros(1),
        epoch=0.0,
        tx="AT",
        rx="AT",
        target_names=("U",),
    )
    assert chance_of(half, sees, w).matched == pytest.approx(found.matched / 2)
    assert chance_of(half, sees, w).cell == pytest.approx(found.cell / 4)


def test_conventional_velocities_are_not_united():
    """By choice of the receiver, although the groups sample every antenna in every slot."""
    w, schedule, payload = frame(waveform=W)
    settings = Receivers(velocity_method="conventional")
    assert Sensitivity.of(w, ANTENNAS, settings, sent(schedule, payload), 1.0, 3).rule.looks == 135


def test_fewer_groups_are_not_united():
    """Two of three groups, and a schedule that sends an antenna twice in a slot: a third of the
    chirps is added in phase, the rest in power."""
    w, schedule, payload = frame(waveform=W)
    whole, part = (
        Sensitivity.of(w, ANTENNAS, Receivers(), sent(schedule, payload), 1.0, n) for n in (3, 2)
    )
    assert (whole.rule.looks, part.rule.looks) == (45, 90)
    assert part.cell == pytest.approx(whole.cell / 3)
    assert part.matched == pytest.approx(whole.matched * 2 / 3)
    same = np.tile(conventional_schedule(1, w.num_chirps, 3), (3, 1))
    assert Sensitivity.of(w, ANTENNAS, Receivers(), sent(same, payload), 1.0, 3).rule.looks == 135


def test_probability_of_detection():
    """Draws of 45 channels with a steady path. Statistical: 4 deviations of 20,000 draws."""
    rng, draws = np.random.default_rng(9), 20_000
    noise = rng.standard_normal((draws, 45, 2)).view(np.complex128)[..., 0] / np.sqrt(2)
    for snr in (0.5, 0.9, 1.2):
        seen = (np.abs(noise + np.sqrt(snr)) ** 2).mean(axis=1) > 1.1 * SEES.rule.threshold
        p = SEES.detection_probability(snr, 0.1)
        assert seen.mean() == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / draws))


@pytest.mark.parametrize(
    ("rows", "bins", "power_db", "kind", "masked"),
    [
        (1.3, 0.4, 3.0, PathKind.SPECULAR, True),
        (1.3, 0.4, -3.0, PathKind.SPECULAR, False),
        (5.2, 0.0, 40.0, PathKind.LEAKAGE, False),
        (5.2, 0.0, 50.0, PathKind.LEAKAGE, True),
        (0.0, 9.3, 40.0, PathKind.GHOST, False),
        (0.0, 9.3, 50.0, PathKind.GHOST, True),
        (5.2, 9.3, 70.0, PathKind.GHOST, False),
        (1.3, 0.4, 3.0, PathKind.DIFFUSE, False),
    ],
)
def test_stronger_paths_mask(rows, bins, power_db, kind, masked):
    """At 5.2 cells the bound of a Hann window's sidelobes is 52.6 dB down (-10 log10 of (pi d (d^2
    - 1))^-2), and peaks within 6 dB of it are passed over; along Doppler at 9.3 cells the floor of
    the resampling, -50 dB, counts. Planted bug: the weaker path masks the stronger one."""
    gain = 10 ** (power_db / 20)
    other = 12.7 + rows * 2 * W.range_cell(2), 1.9 + bins * 2 * W.velocity_cell(2), gain, kind
    assert chance_of(echo(12.7, 1.9, 1.0, [other])).masked is masked


def test_clutter_of_a_cell():
    """Two scatterers at the UAV's place and one half a cell off, whose share is that of the window
    there, (8 / (3 pi))^2; those three cells off on either axis have none."""
    cell = 2 * W.range_cell(2)
    walls = [(12.7, 1.9, 0.3, PathKind.DIFFUSE), (12.7, 1.9, 0.4j, PathKind.DIFFUSE)]
    walls += [
        (12.7 + cell / 2, 1.9, 0.2, PathKind.DIFFUSE),
        (12.7 + 3 * cell, 1.9, 9.0, PathKind.DIFFUSE),
        (12.7, 1.9 + 6.5 * W.velocity_cell(2), 9.0, PathKind.DIFFUSE),
    ]
    expected = 10.0 * (0.09 + 0.16 + 0.04 * (8 / (3 * np.pi)) ** 2)
    assert chance_of(echo(12.7, 1.9, 1.0, walls)).clutter == pytest.approx(expected)


def background(*walls) -> float:
    """Of an echo at the middle of a map, from (rows and bins away, power over the noise) each."""
    place = 31 * W.range_cell(1), 0.0
    others = [
        (place[0] + r * W.range_cell(1), b * W.velocity_cell(1), np.sqrt(p / 10), PathKind.DIFFUSE)
        for r, b, p in walls
    ]
    return chance_of(echo(*place, 1.0, others)).background


@pytest.mark.parametrize("bins", [11.0, 11.4])
def test_whitened_channels_of_a_cell(bins):
    """The receiver's transforms of the echo and of each scatterer alone give their channels in the
    echo's cell, a and c_k; with the noise power of the maps a^H (N + sum c_k c_k^H)^-1 a is the SNR
    after whitening. Three scatterers 20 dB and more over the noise of a channel within the main
    lobe, one of them a beam aside at either end, cost 3 dB and more; another UAV's echo is no
    clutter. 1 %: noise averaged over all cells, range-Doppler coupling within a frame. Planted
    bugs: the window's response left out; departures for arrivals; the clutter of one group."""
    w, schedule, payload = frame(waveform=W)
    about, noise = known(w, schedule, payload), 2.9
    length, rate = bins * w.range_cell(1), 3.0 * w.velocity_cell(1)
    length -= float(w.beat_cells(0.0, rate / SPEED_OF_LIGHT, 0.0)) * w.range_cell(1)
    walls = [
        (length + r * w.range_cell(1), rate + b * w.velocity_cell(1), 0.5, kind, out, back)
        for r, b, kind, out, back in (
            (0.3, 0.0, PathKind.DIFFUSE, 0.02, 0.02),
            (-0.6, 0.4, PathKind.DIFFUSE, 0.0, -0.09),
            (0.2, -0.7, PathKind.SPECULAR, 0.11, 0.03),
        )
    ]

    def channels(paths, noise=0.0):
        made = cube(w, schedule, payload, paths, noise=noise, seed=5)
        return np.fft.fftshift(channel_maps(clean_spectrum(made, about), about), axes=-1)

    echo_alone = channels([Path(length, rate, 0.7, (0.05, 0.0), (0.05, 0.0))])
    at = np.unravel_index((np.abs(echo_alone) ** 2).sum(axis=(0, 1)).argmax(), (64, 24))
    a = echo_alone[:, :, *at].ravel()
    covariance = (np.abs(channels([], noise)) ** 2).mean() * np.eye(a.size, dtype=complex)
    for r, v, gain, _, out, back in walls:
        c = channels([Path(r, v, gain, (back, 0.0), (out, 0.0))])[:, :, *at].ravel()
        covariance += np.outer(c, c.conj())
    expected = (a.conj() @ np.linalg.solve(covariance, a)).real
    sees = Sensitivity.of(w, ANTENNAS, Receivers(), sent(schedule, payload), noise, 3)
    other = (length, rate, 9.0, PathKind.GHOST)
    found = chance_of(echo(length, rate, 0.7, [*walls, other], 0.05), sees, w)
    assert found.whitened < found.channels / 2
    assert found.whitened == pytest.approx(expected, rel=0.01)
    assert found.straddling == pytest.approx(float(hann_response(bins - 11.0)), rel=1e-4)


@pytest.mark.parametrize(
    ("cells", "bins", "u"),
    [
        (0.6, 0.3, (0.05, -0.04)),
        (0.2, 1.3, (0.1, 0.02)),
        (0.1, -0.1, (0.2, 0.1)),
        (3.3, 0.0, (0, 0)),
    ],
)
def test_energy_of_an_echo_beside_the_line_of_sight(cells, bins, u):
    """Samples of the echo, for each transmit antenna, less their projection on those of the line of
    sight and on what these change by with length, rate and direction. 0.01: slow time of an antenna
    is drawn at random within three slots. Planted bugs: the direction's derivatives left out; the
    line's norm forgotten; departures for arrivals; the line of sight subtracted from itself."""
    w, schedule, _ = frame(waveform=W)
    cell, bin_ = w.range_cell(1), w.velocity_cell(1)
    first = Path(11.0 * cell, 3.0 * bin_, 1.0, (0.12, -0.07), (0.3, 0.1))
    # the beat holds the Doppler too
    length = first.length + cells * cell - bins * cell * w.sampled_duration / w.frame_duration
    arrival = (first.arrival[0] + u[0], first.arrival[1] + u[1])
    second = Path(length, first.rate + bins * bin_, 1.0, arrival, (-0.2, 0.3))

    def made(path):
        part = cube(w, schedule, unmodulated(w), [path]).samples[..., -round(w.window_length) :]
        at = [part.astype(complex).swapaxes(1, 2)[schedule == n].ravel() for n in range(w.num_tx)]
        return np.array(at)

    step, start = 1e-3, made(first)
    moved = [
        replace(first, length=first.length + step * cell),
        replace(first, rate=first.rate + step * bin_),
        replace(first, arrival=(first.arrival[0] + step, first.arrival[1])),
        replace(first, arrival=(first.arrival[0], first.arrival[1] + step)),
    ]
    tangents = np.array([start] + [(made(path) - start) / step for path in moved])
    left = total = 0.0
    for n, echo_of in enumerate(made(second)):
        Q = np.linalg.qr(tangents[:, n].T)[0]
        left += float((np.abs(echo_of - Q @ (Q.conj().T @ echo_of)) ** 2).sum())
        total += float((np.abs(echo_of) ** 2).sum())
    ends = [(p.length, p.rate, p.departure, p.arrival) for p in (second, first)]
    lengths, rates, *sides = (np.array(each) for each in zip(*ends, strict=True))
    out, back = (
        np.column_stack([d[:, 0], np.sqrt(1 - (d**2).sum(axis=1)), d[:, 1]]) for d in sides
    )
    paths = make_paths(
        gain=np.array([0.01, 1.0]),
        delay=lengths / SPEED_OF_LIGHT,
        delay_rate=rates / SPEED_OF_LIGHT,
        departure=out,
        arrival=back,
        kind=np.array([PathKind.TARGET, PathKind.LINE_OF_SIGHT]),
        target=np.array([0, -1]),
        epoch=0.0,
        tx="AT",
        rx="PT",
        target_names=("U",),
    )
    found = chance_of(paths)
    assert found.whitened / found.channels == pytest.approx(left / total, abs=0.01)
    itself = chance_of(paths, own=1)
    assert itself.whitened == itself.channels


def test_background_is_the_greater_of_the_two_sides():
    """Behind and before the cell 4 and 2 times the noise, in 8 x 19 cells each, spread by 2.25; not
    the guard cells, nor what lies beyond the block on either axis, nor what is so strong that its
    lobes are kept out. Planted bugs: the sum of the sides; the lesser; no end along Doppler; strong
    paths in the training."""
    cells = 8 * 19
    near, far = (6.2, 3.1, 4.0), (-7.4, -8.2, 2.0)
    assert background(near) == pytest.approx(4 * 2.25 / cells)
    assert background(far) == pytest.approx(2 * 2.25 / cells)
    assert background(near, far, (8.8, 0.0, 1.0)) == pytest.approx(5 * 2.25 / cells)
    assert background(far, (-4.1, 0.0, 3.0), near) == pytest.approx(5 * 2.25 / cells)
    for outside in ((3.2, 0.0, 9.0), (12.1, 0.0, 9.0), (6.0, 10.2, 9.0), (6.0, 0.0, 1001.0)):
        assert background(outside) == 0.0


def test_background_is_that_of_the_map():
    """Scatterers of random phase behind the guard cells, made through the receiver's transforms:
    the mean of the training block on their side, averaged over draws, over the noise. 10 %: 40
    draws of 12 scatterers, and what their lobes leave outside the block. Planted bugs: both sides
    together; the spread of the Hann windows left out."""
    w, schedule, payload = frame(waveform=W)
    about, rng, noise = known(w, schedule, payload, FEW), np.random.default_rng(2), 1.0
    sees = Sensitivity.of(w, FEW, Receivers(), sent(schedule, payload), noise, 3)
    rows, bins = 4.5 + 6 * rng.random(12) + 1, rng.uniform(-7, 7, 12)
    place = 20 * w.range_cell(1), 0.0
    walls = [
        (place[0] + r * w.range_cell(1), b * w.velocity_cell(1), 0.03, PathKind.DIFFUSE)
        for r, b in zip(rows, bins, strict=True)
    ]
    level = 0.0
    for _ in range(40):
        turns = np.exp(2j * np.pi * rng.random(12))
        paths = [Path(r, v, g * t) for (r, v, g, _), t in zip(walls, turns, strict=True)]
        power = power_map(clean_spectrum(cube(w, schedule, payload, paths, FEW), about), about)
        level += power[24:32, 12 - 9 : 12 + 10].mean() / 40
    alone = power_map(
        clean_spectrum(cube(w, schedule, payload, [], FEW, noise=noise), about), about
    )
    found = chance_of(echo(*place, 1.0, walls), sees, w)
    assert found.background == pytest.approx(level / alone.mean(), rel=0.1)


STRONG = {"hit": False, "own": False, "beside": (), "read": True}
STRONG |= {"matched": 1e4, "cell": 10.0, "clutter": 0.1, "background": 0.0, "masked": False}
TRUTHS = {
    Loss.FOUND: {"hit": True},
    Loss.TOO_WEAK: {"matched": 19.0},
    Loss.ERASED: {"read": False},
    Loss.INACCURATE: {"own": True},
    Loss.NOISE: {"cell": 0.4},
    Loss.MASKED: {"masked": True},
    Loss.CLUTTER: {"background": 1.3, "cell": 2.0},
    Loss.THRESHOLD: {"cell": 1.0},
    Loss.OTHER: {},
}


def outcome(**changed) -> Loss:
    v = STRONG | changed
    chance = Chance(
        v["matched"], v["cell"], 0.0, 1.0, 0.0, v["clutter"], v["background"], v["masked"]
    )
    return cause_of(v["hit"], v["own"], np.array(v["beside"], int), chance, SEES, v["read"])


@pytest.mark.parametrize(("first", "second"), list(product(TRUTHS, TRUTHS)))
def test_of_two_causes_the_first_counts(first, second):
    """Every cause alone and before every later one. Planted bug: masked asked before noise."""
    both = TRUTHS[max(first, second)] | TRUTHS[min(first, second)]
    assert outcome(**both) is min(first, second)


@pytest.mark.parametrize(
    ("changed", "loss"),
    [
        ({"clutter": 1.1}, Loss.CLUTTER),
        ({"clutter": 0.9}, Loss.OTHER),
        ({"background": 1.3}, Loss.OTHER),
        ({"background": 9.0}, Loss.CLUTTER),
    ],
)
def test_clutter_in_the_cell_or_around_it(changed, loss):
    """Ten times the noise stands out of a background of 1 + 1.3, and not of 1 + 9."""
    assert outcome(**changed) is loss


@pytest.mark.parametrize(
    ("beside", "loss"),
    [
        ([PathKind.DIFFUSE], Loss.CLUTTER),
        ([PathKind.SPECULAR], Loss.MASKED),
        ([PathKind.TARGET], Loss.MASKED),
        ([-1], Loss.OTHER),
        ([PathKind.DIFFUSE, PathKind.LEAKAGE], Loss.MASKED),
    ],
)
def test_taken_for_something_else(beside, loss):
    """A detection in the UAV's cell that another path explains."""
    assert outcome(beside=beside) is loss


def test_what_a_matched_filter_and_a_beam_would_find():
    """Draws of one complex amplitude in unit noise over the threshold that noise passes once in
    1e-4. Albersheim's 13.1 dB finds a steady target in nine of ten at 1e-6. A detector by beams has
    the SNR of all channels in one test. Statistical: 4 deviations of 40,000 draws. Planted bugs: a
    degree of freedom a channel; the rate that starts tracks in place of that of detections."""
    rng, draws = np.random.default_rng(19), 40_000
    for snr in (2.0, 9.0):
        noise = rng.normal(size=draws) + 1j * rng.normal(size=draws)
        found = (np.abs(np.sqrt(2 * snr) + noise) ** 2 / 2 > -np.log(1e-4)).mean()
        allowed = 4 * np.sqrt(found * (1 - found) / draws)
        assert coherent_detection(snr, 1e-4) == pytest.approx(found, abs=allowed)
    assert coherent_detection(10**1.31, 1e-6) == pytest.approx(0.9, abs=0.02)  # good to 0.2 dB
    assert SEES.genie(10**1.31) == coherent_detection(10**1.31, 1e-6)
    assert SEES.clutter_free(0.4) == SEES.detection_probability(0.4)
    w, schedule, payload = frame(waveform=W)
    city = Receivers(clutter_detector="angle_doppler", update_false_alarm_rate=1e-4)
    for own in (False, True):
        sees = Sensitivity.of(w, ANTENNAS, city, sent(schedule, payload), 1.0, 3, own)
        expected = coherent_detection(0.2 * 45, 1e-4) if own else sees.detection_probability(0.2)
        assert sees.clutter_free(0.2) == expected
