"""Links acquired from data frames alone, on cubes from the equation of the IF signal
(`receiver_cubes`): path, symbols, what must not lock, and what a terminal does with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, C, Path, cube, frame

from isac_rt.extensions.city_receivers.blind import (
    Peaks,
    _Chirps,
    _comb,
    acquire,
    find_peaks,
    read_peaks,
)
from isac_rt.extensions.city_receivers.out_of_sequence import OutOfSequence
from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.passive import PassiveReceiver
from isac_rt.receive.settings import Receivers
from isac_rt.track.parts import Equipment
from isac_rt.track.reference import TerminalState
from isac_rt.track.settings import Tracking
from isac_rt.track.terminal import PassiveTerminal
from isac_rt.world.swarm import Pose

W = Waveform(num_samples=256, num_chirps=48)
INTERVAL = 0.0041
"""Of the frames [s], which last 0.8 ms."""
ORDER = 8
START, RATE, BEND, ARRIVAL = 23.71, -17.3, 4.1, (0.31, -0.22)


def payloads(count, seed=5):
    """A schedule and so many frames' data."""
    _, schedule, _ = frame(waveform=W)
    rng = np.random.default_rng(seed)
    return schedule, [random_payload(W, schedule, ORDER, rng) for _ in range(count)]


def path_at(n, amplitude=1.0, start=START):
    t = n * INTERVAL
    length, rate = start + RATE * t + BEND * t * t / 2, RATE + BEND * t
    return Path(length, rate, amplitude, arrival=ARRIVAL)


def flight(sent, schedule, amplitude, noise=1.0, seed=7, start=START):
    """Frames with one path, each kept as its peaks."""
    out = []
    for n, payload in enumerate(sent):
        paths = [path_at(n, amplitude, start)]
        made = cube(W, schedule, payload, paths, noise=noise, seed=seed + n)
        out.append(find_peaks(made, n * INTERVAL, bool(payload.delay_symbols.any())))
    return out


def narrow(payload, low, high):
    """The same frame with all of its delay symbols from `low` to `high`."""
    return replace(payload, delay_symbols=low + payload.delay_symbols % (high - low + 1))


def test_a_path_is_found_and_read_without_a_pilot():
    """Three frames at -13 dB a sample (11 dB in a cell, 23 in the beam): length, rate and direction
    within what 432 chirps show, every symbol right. Planted bugs: the path's Doppler left in its
    length, the phases not brought back from the middle of the samples."""
    schedule, sent = payloads(3)
    kept = flight(sent, schedule, 10 ** (-13 / 20))
    found = acquire(kept, ANTENNAS, ORDER)
    assert found is not None
    truth = path_at(2)
    deviations = np.sqrt(np.diag(found.covariance))
    assert deviations[0] < 0.05 * W.range_cell(1) and deviations[1] < 0.5
    assert abs(found.mean[0] - truth.length) < max(4 * deviations[0], 0.02 * W.range_cell(1))
    assert abs(found.mean[1] - truth.rate) < 4 * deviations[1]
    # 432 chirps in a beam of 0.2: a thousandth; the search ends at steps of 0.001
    assert np.abs(found.direction - ARRIVAL).max() < 0.01
    for n, (one, payload) in enumerate(zip(kept, sent, strict=True)):
        there = found.at(n * INTERVAL).prediction
        symbols = read_peaks(one, there, ANTENNAS, ORDER)
        assert np.array_equal(symbols.delay, payload.delay_symbols)
        assert np.array_equal(symbols.transitions, payload.transitions)
        assert np.array_equal(symbols.bits, payload.bits)


def test_the_path_over_frames_far_apart():
    """Frames of full size, 45 ms apart, in which 31 m/s are half a cell within a frame and 2.8
    cells to the next: cells straight from the beat's equation, 0.08 cells off, one in fifteen
    anywhere, one in ten from another direction. Planted bugs: the rate within frames with the
    other sign, chirps off the comb counted among the symbols."""
    w, rng = Waveform(), np.random.default_rng(23)
    length, rate, curvature, arrival = 141.27, -31.3, 5.0, np.array([-0.42, 0.17])
    slope = w.bandwidth / w.chirp_duration
    kept = []
    for n in range(4):
        t = 0.045 * n + w.chirp_time + w.chirp_duration / 2 - w.frame_duration / 2
        tau = (length + rate * t + curvature * t * t / 2) / C
        doppler = (rate + curvature * t) / C * (w.carrier_frequency + slope * w.chirp_duration / 2)
        cells = (slope * tau + doppler) * w.sampled_duration + rng.integers(0, 512, t.shape)
        cells += 0.08 * rng.standard_normal(t.shape)
        lost = rng.random(t.shape) < 1 / 15
        cells[lost] = rng.uniform(0, 1024, lost.sum())
        from_there = np.where(lost[..., None], rng.uniform(-0.6, 0.6, (*t.shape, 2)), arrival)
        x, z = ANTENNAS.rx_positions[:, [0, 2]].T
        ahead = from_there[..., :1] * x + from_there[..., 1:] * z
        values = 4 * np.exp(-2j * np.pi * w.effective_carrier * ahead / C)
        values += rng.standard_normal((*values.shape, 2)).view(complex)[..., 0] / np.sqrt(2)
        parts = (a[:, :, None] for a in (cells, values))
        kept.append(Peaks(0.045 * n, True, w, None, *parts, 1.0))
    found = acquire(kept, ANTENNAS, ORDER)
    t = 0.135
    truth = length + rate * t + curvature * t * t / 2, rate + curvature * t
    deviations = np.sqrt(np.diag(found.covariance))
    assert deviations[0] < 0.01 and deviations[1] < 0.2
    # the window's middle lies 6 us beside the chirp's: 0.2 mm
    assert np.all(np.abs(found.mean[:2] - truth) < 4 * deviations[:2] + 0.0005)
    assert np.abs(found.direction - arrival).max() < 0.01


def test_whole_cells_from_frame_to_frame_are_no_rate():
    """Paths of the paper's frames (7.8 ms, 45 ms apart), 0.013 cells of noise: a rate one cell an
    interval off (11.1 m/s) fits the frames' phases as well, and only each frame's own rate tells.
    Of 60 paths that bend as diffracted ones do, each over two to eight frames, all rates are right.
    Planted bug: the frames' own rates not asked for (6 are 11.1 m/s off)."""
    w, rng, wrong = Waveform(), np.random.default_rng(3), 0
    time = np.broadcast_to(w.middle_time[0], (3, w.num_chirps)).ravel()
    cell = w.range_cell(1)
    for draw in range(60):
        count = 2 + draw % 7
        rate, curvature = rng.uniform(-38, 38) / cell, rng.uniform(-20, 20) / cell
        seen = []
        for middle in 0.045 * np.arange(1 - count, 1):
            t = middle + time
            place = 141.3 + rate * t + curvature * np.minimum(t + 0.1, 0.0) ** 2 / 2
            symbols = rng.integers(0, 512, time.size)
            noise = 0.013 * rng.standard_normal(time.size)
            seen.append(_Chirps(True, middle, time, place + symbols + noise))
        found = _comb(seen, w)
        wrong += found is not None and abs(found[0][1] - rate) > 0.25 / 0.045
    assert wrong == 0


def test_peaks_lie_where_the_tones_do():
    """Without noise, over all fractions of a cell: within 0.02 cells, what the path's rate moves a
    chirp's tone while it is sampled and what other symbols delay it. Planted bug: the parabola's
    top as it is (0.05 cells off)."""
    schedule, sent = payloads(1)
    for start in np.linspace(20, 20.5, 7):
        path = Path(start, 11.0, 1.0, arrival=ARRIVAL)
        kept = find_peaks(cube(W, schedule, sent[0], [path]), 0.0, True)
        beats = W.beat_cells(start / C, 11.0 / C) + sent[0].delay_symbols
        assert np.abs(kept.cells[..., 0] - beats).max() < 0.02


def test_symbols_that_leave_whole_cells_open_are_not_read():
    """Data that use 100 of the 128 symbols fit at 29 shifts; a pilot, whose symbols are 0, tells
    which. Planted bug: the lowest symbol taken for 0."""
    schedule, sent = payloads(4)
    some = [narrow(p, 9, 108) for p in sent]
    kept = flight(some, schedule, 0.4)
    assert acquire(kept, ANTENNAS, ORDER) is None
    with_pilot = flight([*some, unmodulated(W)], schedule, 0.4)
    assert not with_pilot[-1].modulated
    found = acquire(with_pilot, ANTENNAS, ORDER)
    assert abs(found.mean[0] - path_at(4).length) < 0.05 * W.range_cell(1)
    symbols = read_peaks(with_pilot[0], found.at(0.0).prediction, ANTENNAS, ORDER)
    assert np.array_equal(symbols.delay, some[0].delay_symbols)


def test_one_frame_whose_rate_is_not_known_well_enough_is_not_read():
    """At -19 dB a sample one frame's rate is known to some 2 m/s, and 1.25 m/s turn every DPSK
    symbol by half a step; the third frame settles it. Planted bug: any deviation accepted."""
    _, schedule, payload = frame(order=ORDER, seed=1, waveform=W)
    full = payload.delay_symbols.copy()
    full.flat[:2] = 0, W.num_delay_symbols - 1  # one shift is left
    sent = [replace(payload, delay_symbols=full)] * 3
    kept = flight(sent, schedule, 10 ** (-16 / 20))
    assert acquire(kept[:1], ANTENNAS, ORDER) is None
    assert acquire(kept, ANTENNAS, ORDER) is not None


@pytest.mark.parametrize("kind", ["noise", "others", "standing"])
def test_what_holds_no_data_of_a_path_does_not_lock(kind):
    """Noise; five paths of as many strangers' data, none of which moves with another's; a tone that
    stands still. Planted bug for the last: as many shifts as there are taken for one."""
    rng = np.random.default_rng(17)
    schedule, sent = payloads(6)
    for trial in range(1 if kind == "others" else 2):
        kept = []
        for n in range(3):
            paths = []
            if kind == "others":
                paths = [
                    Path(
                        10 + 50 * rng.random(),
                        rng.uniform(-20, 20),
                        np.exp(2j * np.pi * rng.random()),
                        arrival=tuple(rng.uniform(-0.6, 0.6, 2)),
                    )
                    for _ in range(5)
                ]
            made = cube(W, schedule, sent[n], paths[:1], noise=0.5, seed=100 * trial + n)
            samples = made.samples
            for path, payload in zip(paths[1:], sent[1:], strict=False):
                samples = samples + cube(W, schedule, payload, [path]).samples
            if kind == "standing":
                samples = samples + np.exp(2j * np.pi * 0.123 * np.arange(W.num_samples))
            made = replace(made, samples=samples.astype(np.complex64))
            kept.append(find_peaks(made, n * INTERVAL, True))
        assert acquire(kept, ANTENNAS, ORDER) is None, trial


ROW = replace(ANTENNAS, rx_z=1)


def terminal(amplitude, groups=None, antennas=ANTENNAS):
    """A passive terminal for which a path of 25 m has a `amplitude` of free space."""
    receivers = Receivers(link_acquisition="blind", symbol_decision="beams")
    free = antennas.gain * W.wavelength / (4 * np.pi * 25)
    sent = amplitude / free
    blind = OutOfSequence(PassiveReceiver.of(antennas, receivers, ORDER, groups), W, None)
    settings = W, antennas, receivers, Tracking(), ORDER, sent, groups
    return PassiveTerminal(*settings, Equipment(other_paths=blind))


OWN = Pose.at_rest()


def play(receiver, cubes, first=0):
    """Receptions at once and late of frames with data, by their numbers."""
    out = {}
    for n, made in enumerate(cubes, first):
        out[n, n], _ = receiver.step(made, OWN, n * INTERVAL, True)
        for late in receiver.late:
            out[round(late.time / INTERVAL), n] = late.reception
    return out


def cubes_of(sent, schedule, amplitude, antennas=ANTENNAS):
    return [
        cube(W, schedule, payload, [path_at(n, amplitude)], antennas, noise=1.0, seed=50 + n)
        for n, payload in enumerate(sent)
    ]


@pytest.mark.parametrize("antennas", [ANTENNAS, ROW], ids=["L", "row"])
def test_a_terminal_reads_in_retrospect_and_goes_on(antennas):
    """No pilot at all. What is read late and at once is what was sent; as strong as free space, the
    path is the line of sight once it is read, and sensing goes on from it; 20 dB weaker it carries
    data only. Stopped and resumed with a batch that waits, all is as in one go. Planted bugs: late
    frames not handed out, the batch not restored, a mirror path taken for the line of sight, a
    direction asked on the axis that a row of antennas does not observe."""
    schedule, sent = payloads(6)
    cubes = cubes_of(sent, schedule, 0.5, antennas)
    for weaker, sees in ((1.0, True), (0.1, False)):
        whole, first, second = (terminal(0.5 / weaker, None, antennas) for _ in range(3))
        heard = play(whole, cubes)
        read = {n: (now, r) for (n, now), r in heard.items() if r.decoded}
        assert sorted(read) == list(range(6)) and any(now > n for n, (now, _) in read.items())
        for n, (_, reception) in read.items():
            assert np.array_equal(reception.bits, sent[n].bits), n
            assert np.array_equal(reception.delay_symbols, sent[n].delay_symbols)
        last = read[5][1]
        assert last.line_of_sight == sees and bool(len(last.detections)) == sees
        assert (whole.status == TerminalState.TRACKING) == sees
        parts = play(first, cubes[:1])
        assert not parts[0, 0].decoded
        second.restore(first.memory())
        parts |= play(second, cubes[1:], 1)
        assert parts.keys() == heard.keys()
        for key, reception in heard.items():
            assert np.array_equal(parts[key].bits, reception.bits), key


@pytest.mark.parametrize("antennas", [ANTENNAS, ROW], ids=["L", "row"])
def test_a_pilot_without_a_reference_goes_on_over_a_path(antennas):
    """Two mirror paths in each of two pilots: over the stronger one, and in the second pilot over
    the same, though the other is 6 dB stronger there; the data that follow are read over it.
    Planted bugs: the strongest each time; the weakest; directions asked on both axes."""
    schedule, sent = payloads(1)
    receiver = terminal(5.0, None, antennas)
    for n, other in enumerate((0.25, 1.0, 0.0)):
        payload = sent[0] if n == 2 else unmodulated(W)
        paths = [path_at(n, 0.5), Path(31.3, 6.1, other, arrival=(-0.5, 0.1))]
        made = cube(W, schedule, payload, paths, antennas, noise=1.0, seed=50 + n)
        reception, _ = receiver.step(made, OWN, n * INTERVAL, n == 2)
        path = receiver.equipment.other_paths.state.path
        assert path.mean[0] == pytest.approx(path_at(n).length, abs=0.1 * W.range_cell(1))
        assert path.direction[0] == pytest.approx(ARRIVAL[0], abs=0.02)
        assert not reception.line_of_sight
    assert reception.decoded and np.array_equal(reception.bits, sent[0].bits)


def test_a_path_is_found_again_within_what_was_predicted_of_it():
    """After four frames over a mirror path its rate is told 0.53 cells too high, 1.6 deviations:
    the next frame brings it back to 0.1 cells. Told to 0.1 cells, what is found is another path,
    and the frame is not read. Planted bugs: a gate of the same width whatever is known; none."""
    schedule, sent = payloads(5)
    cubes, cell = cubes_of(sent, schedule, 0.5), W.velocity_cell(1)
    for std, back in ((0.34, True), (0.1, False)):
        receiver = terminal(5.0)
        play(receiver, cubes[:4])
        kept = receiver.equipment.other_paths
        path, off = kept.state.path, 0.53 * cell
        mean = path.mean + np.array([0.0, off, 0.0])
        covariance = np.diag([1e-3, (std * cell) ** 2, 1e-2])
        kept.state.path = replace(path, mean=mean, covariance=covariance)
        heard = play(receiver, cubes[4:], 4)
        assert heard[4, 4].decoded is back and not heard[4, 4].line_of_sight
        if back:
            now = RATE + BEND * 4 * INTERVAL
            assert abs(kept.state.path.mean[1] - now) / cell < 0.1


@pytest.mark.parametrize("shift", [0, 7])
def test_a_path_from_elsewhere_is_another_one(shift):
    """A mirror path ends, and one from 40 degrees beside it, 7 cells longer or of equal length,
    carries on: read over the old one all symbols would be 7 too high, or right by chance. The frame
    is refused. Planted bug: directions not compared."""
    schedule, sent = payloads(5)
    cubes = cubes_of(sent, schedule, 0.5)
    receiver = terminal(5.0)
    assert play(receiver, cubes[:4])[3, 3].decoded
    longer = path_at(4, 0.5).length + shift * W.range_cell(1)
    other = replace(path_at(4, 0.5), length=longer, arrival=(-0.5, 0.1))
    last = cube(W, schedule, sent[4], [other], noise=1.0, seed=54)
    assert not play(receiver, [last], 4)[4, 4].decoded


def test_a_line_of_sight_at_the_edge_of_the_view_carries_data_only():
    """From a cosine of 0.84 a wave has the phases of one from -0.89, beyond the view: read, and no
    track begins. Planted bug: any direction taken."""
    schedule, sent = payloads(3)
    receiver = terminal(0.5)
    paths = [replace(path_at(n, 0.5), arrival=(0.84, 0.0)) for n in range(3)]
    cubes = [cube(W, schedule, p, [q], noise=0.1) for p, q in zip(sent, paths, strict=True)]
    heard = play(receiver, cubes)
    assert heard[2, 2].decoded and np.array_equal(heard[2, 2].bits, sent[2].bits)
    assert not heard[2, 2].line_of_sight and receiver.reference.track is None


def test_a_terminal_reads_its_own_groups_late():
    """Two of three groups are meant for it: their symbols, and nothing in the third. Planted bug:
    the late frame in the shapes of its own groups."""
    schedule, sent = payloads(6)
    receiver = terminal(0.5, groups=(0, 2))
    heard = play(receiver, cubes_of(sent, schedule, 0.5))
    late = {n: r for (n, now), r in heard.items() if now > n}
    assert late
    for n, reception in late.items():
        assert (reception.delay_symbols[1] == -1).all() and (reception.transitions[1] == -1).all()
        mine = sent[n].delay_symbols[[0, 2]]
        assert np.array_equal(reception.delay_symbols[[0, 2]], mine)
        assert np.array_equal(reception.bits, sent[n].bits_of((0, 2)))
