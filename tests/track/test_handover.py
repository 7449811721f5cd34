"""What a terminal hands to its receiver and makes of what it gets back, with receivers that say
what the test tells them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from oracles import slopes, what_is_measured
from receiver_cubes import ANTENNAS

from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Correction, Detections, ExpectedClutter, Reception, no_detections
from isac_rt.track.filter import Gaussian
from isac_rt.track.reference import Followed, TerminalState, slip_cells
from isac_rt.track.settings import Tracking
from isac_rt.track.terminal import ActiveTerminal, PassiveTerminal
from isac_rt.track.tracker import Track
from isac_rt.world.swarm import Pose

W = Waveform(num_samples=256, num_chirps=36)
STEERED = replace(ANTENNAS, gain=3.7, pattern="cosine")
AMPLITUDE = 0.31
OWN = Pose.at_rest((3.1, -2.7, 31.3), (0.5, 1.2, -0.15))
SENDER = np.array([-11.3, 33.7, 40.9, 2.3, -2.1, 0.4, 0.0, 0.0, 0.0])
BODY = np.array([14.7, 28.9, 27.1, -3.7, 6.1, 1.3, 0.3, 0.2, -0.1])
STD = np.array([0.031, 0.083, 0.0047, 0.0061])
CELL = 299_792_458.0 / (W.slope * W.sampled_duration)
"""Of a path once through [m]: the beat of a delay is one cycle in the window."""
MIDDLE = W.carrier_frequency + W.slope * (W.chirp_duration - W.sampled_duration / 2)
"""What a chirp has reached in the middle of the window [Hz], where Doppler is read."""
BIN = 299_792_458.0 / MIDDLE / W.frame_duration
"""Of a path's rate [m/s]: one cycle in the frame."""
EMPTY: Any = IFCube(
    samples=np.zeros(0, np.complex64), waveform=W, schedule=np.zeros((3, 36), int), start_time=0.0
)


def friis(length: float) -> float:
    """Power of a line of sight between two elements of gain 3.7."""
    wavelength = 299_792_458.0 / W.carrier_frequency
    return AMPLITUDE**2 * (3.7 * wavelength / (4 * np.pi * length)) ** 2


def found(rows, reference: int | None = None, snr: float = 50.0, std=STD) -> Detections:
    z = np.array(rows, float).reshape(-1, 4)
    return Detections(
        range=z[:, 0].copy(),
        velocity=z[:, 1].copy(),
        direction=z[:, 2:].copy(),
        snr=snr + np.arange(len(z)),
        std=np.tile(std, (len(z), 1)),
        is_reference=np.arange(len(z)) == (-1 if reference is None else reference),
        starts=np.ones(len(z), bool),
    )


def heard(z=None, others=(), power: float | None = None, std=STD, **changes) -> Reception:
    """A reception with a line of sight (row 0) of the power that free space gives it."""
    if z is None:
        return replace(
            Reception.undecoded(W, found(others) if len(others) else no_detections()), **changes
        )
    detections = found([z, *others], 0, std=std)
    level = friis(z[0]) if power is None else power
    return replace(
        Reception.undecoded(W, detections), line_of_sight=True, reference_power=level, **changes
    )


def sight(time: float = 0.0) -> np.ndarray:
    """The line of sight to the sender at a time."""
    here = SENDER + np.concatenate([time * SENDER[3:6], np.zeros(6)])
    return np.asarray(what_is_measured(here, OWN), float)


@dataclass
class Told:
    """A receiver that gives back what the test has laid ready, and keeps what it was handed."""

    answers: list[Reception]
    handed: list[Any] = field(default_factory=list)

    def __call__(self, cube, given, *rest) -> Reception:
        self.handed.append((given, *rest))
        return self.answers.pop(0)


def passive(answers=(), state: Gaussian | None = None, **settings) -> tuple[PassiveTerminal, Told]:
    """A passive terminal with a told receiver and, if there is a state, a reference of this state
    at time 0."""
    pt = PassiveTerminal(W, STEERED, Receivers(), Tracking(**settings), 8, AMPLITUDE)
    reports = Told(list(answers))
    vars(pt)["receive"] = reports  # in place of the method
    if state is not None:
        track = Track(pt.tracker.new_id(), state, 80.0, confirmed=True)
        pt.reference.state = Followed(track, -1e-6, TerminalState.TRACKING)
        pt.tracker.state.time = -1e-6
    return pt, reports


def known(position: float = 0.02, velocity: float = 0.1) -> Gaussian:
    return Gaussian(SENDER.copy(), np.diag([position] * 3 + [velocity] * 3 + [0.5] * 3) ** 2)


def test_a_prediction_is_what_its_samples_measure():
    """Reference and reflector flown on for 60 ms, 40,000 samples of both with the accelerations of
    3 m/s^2 that Singer's model adds (steady ones: the time is short), through the exact
    measurement: ranges, rates, directions and the deviations of each, 2 % (five deviations of a
    deviation). Planted bugs: range and velocity deviations exchanged, or squared; the reference's
    doubt left out of a reflector's; the prediction of the frame before."""
    rng, count, later = np.random.default_rng(4), 40_000, 0.06
    root = (
        np.diag([0.05, 0.07, 0.04, 0.4, 0.5, 0.3, 1, 1, 1])
        @ np.linalg.qr(rng.normal(size=(9, 9)))[0]
    )
    states = [Gaussian(SENDER, root @ root.T), Gaussian(BODY, 2.3 * root @ root.T)]
    pt, reports = passive([heard()], states[0])
    pt.tracker.state.tracks = [
        Track(5, states[1], 20.0, confirmed=True),
        Track(6, Gaussian(BODY + 3, root @ root.T), 30.0, confirmed=False),
        Track(7, Gaussian(BODY - 3, root @ root.T), 30.0, confirmed=True, missed=1),
    ]
    pt.step(EMPTY, OWN, later, True)
    ((prediction, modulated, _maps),) = reports.handed
    flown = []
    for g in states:
        x = g.mean + rng.normal(size=(count, 9)) @ np.linalg.cholesky(g.covariance).T
        # over 60 ms the acceleration forgets 6 % of itself and is given the variance anew
        a = np.exp(-later / 2) * x[:, 6:]
        x[:, :3] += later * x[:, 3:6] + later**2 / 2 * a
        x[:, 3:6] += later * a + 3.0 * np.sqrt(2 / 3 * later**3) * rng.normal(size=(count, 3))
        flown.append(x)
    rows = np.stack([what_is_measured(flown[0], OWN), what_is_measured(flown[1], OWN, flown[0])])
    assert modulated and len(prediction.range) == 2
    for k, z in enumerate(rows.astype(float)):
        mean, std = z.mean(axis=0), z.std(axis=0)
        assert prediction.range_std[k] == pytest.approx(std[0], rel=0.02)
        assert prediction.velocity_std[k] == pytest.approx(std[1], rel=0.02)
        assert prediction.range[k] == pytest.approx(mean[0], abs=0.1 * std[0])
        assert prediction.velocity[k] == pytest.approx(mean[1], abs=0.1 * std[1])
        assert prediction.direction[k] == pytest.approx(mean[2:], abs=0.1 * std[2:].min())
    assert prediction.weight == pytest.approx([1.0, 20 / 80])


def test_the_strongest_of_all_weighs_one():
    """A reflector above the line of sight. Planted bug: weights over the reference's."""
    pt, reports = passive([heard()], known())
    pt.tracker.state.tracks = [Track(5, Gaussian(BODY, known().covariance), 320.0, confirmed=True)]
    pt.step(EMPTY, OWN, 0.01, True)
    assert reports.handed[0][0].weight == pytest.approx([0.25, 1.0])


def test_what_is_reported_has_the_deviations_of_its_state():
    """Deviations of the tracks of a passive terminal from their covariances by slopes in long
    double, relative states, and the reference's age. Planted bugs: variances reported; the
    reference's doubt left out; the own velocity left in."""
    own = replace(OWN, velocity=np.array([1.3, -4.1, 0.7]))
    pt, _ = passive([heard()], known(0.3, 0.7))
    body = Gaussian(BODY, 1.7 * known(0.5, 0.9).covariance)
    pt.tracker.state.tracks = [Track(5, body, 20.0, confirmed=True)]
    tracks = pt.tracker.snapshot(own, pt.reference.track)
    H = slopes(lambda s: what_is_measured(s, own, SENDER), BODY).astype(float)
    J = slopes(lambda s: what_is_measured(BODY, own, s), SENDER).astype(float)
    first = slopes(lambda s: what_is_measured(s, own), SENDER).astype(float)
    reference = known(0.3, 0.7).covariance
    variance = np.diag(H @ body.covariance @ H.T + J @ reference @ J.T)
    assert tracks.std[0] == pytest.approx(np.sqrt(np.diag(first @ reference @ first.T)), rel=1e-6)
    assert tracks.std[1] == pytest.approx(np.sqrt(variance), rel=1e-6)
    assert tracks.mean[1] == pytest.approx(BODY[:6] - [*own.position, *own.velocity])
    z = np.column_stack([tracks.range, tracks.velocity, tracks.direction])[1]
    assert z == pytest.approx(np.asarray(what_is_measured(BODY, own, SENDER), float), abs=1e-9)
    pt.step(EMPTY, OWN, 0.01, False)
    assert pt.tracker.snapshot(OWN, pt.reference.track).age.tolist() == [1, 0]


@pytest.mark.parametrize(("cells", "told_range"), [(0.19, True), (0.21, False)])
def test_a_range_that_is_no_longer_known_reads_nothing(cells, told_range):
    """A fifth of a cell, along the line of sight; across it doubt does no harm. A frame without
    data asks for no prediction at all. Planted bugs: the velocity's deviation asked; a cell of a
    range there and back; a prediction in frames without data."""
    e = (SENDER[:3] - OWN.position) / np.linalg.norm(SENDER[:3] - OWN.position)
    P = np.zeros((9, 9))
    P[:3, :3] = (cells * CELL) ** 2 * np.outer(e, e) + 0.01**2 * np.eye(3)
    P[3:, 3:] = np.diag([0.001] * 3 + [0.5] * 3) ** 2
    pt, reports = passive([heard(), heard(), heard()], Gaussian(SENDER.copy(), P))
    pt.step(EMPTY, OWN, 1e-4, True)
    pt.step(EMPTY, OWN, 2e-4, False)
    (first, *_), (second, modulated, _) = reports.handed
    assert (first is not None) is told_range
    assert second is None and not modulated


@pytest.mark.parametrize(("level_db", "believed"), [(-9.8, True), (-10.2, False), (4.0, True)])
@pytest.mark.parametrize("modulated", [False, True])
def test_a_line_of_sight_is_as_strong_as_friis_says(level_db, believed, modulated):
    """10 dB under the power that transmitter, both elements and the length give it is not believed,
    at any length. Planted bugs: amplitude for power; the length's square forgotten; the transmit
    power or an element forgotten."""
    for length in (17.3, 83.1):
        z = np.array([length, 0.3, 0.1, -0.2])
        mean = OWN.position + length * OWN.to_world(np.array([0.1, np.sqrt(1 - 0.05), -0.2]))
        state = Gaussian(np.concatenate([mean, np.zeros(6)]), known(0.02, 0.4).covariance)
        answer = heard(z, power=friis(length) * 10 ** (level_db / 10))
        pt, _ = passive([answer], state)
        reception, _ = pt.step(EMPTY, OWN, 1e-3, modulated)
        assert reception.line_of_sight is believed
        assert pt.status is (TerminalState.TRACKING if believed else TerminalState.LOST)
        assert pt.reference.track is not None and pt.reference.track.missed == (
            0 if believed else 1
        )


def test_acquiring_tracking_lost():
    """Nothing known, a first line of sight, a frame without, and one again. Planted bug: lost is
    said where nothing was ever found."""
    pt, _ = passive([heard(), heard(sight(0.02)), heard(), heard(sight(0.06))])
    said = []
    for k in range(4):
        pt.step(EMPTY, OWN, 0.02 * k, False)
        said.append(pt.status)
    assert said == [
        TerminalState.ACQUIRING,
        TerminalState.TRACKING,
        TerminalState.LOST,
        TerminalState.TRACKING,
    ]
    assert [state.value for state in TerminalState] == [0, 1, 2]  # as results keep them


def test_the_reference_keeps_a_floor_of_its_error():
    """A line of sight of 60 dB states 0.1 mm and 1 mm/s; what other paths leave is 0.02 cells and
    bins: the covariance by information with these. Planted bugs: no floor; a floor in metres."""
    sharp = np.array([1e-4, 1e-3, 1e-4, 1e-4])
    P = known(0.4, 0.9).covariance
    pt, _ = passive([heard(sight(), std=sharp)], Gaussian(SENDER.copy(), P))
    pt.step(EMPTY, OWN, 0.0, False)
    H = slopes(lambda s: what_is_measured(s, OWN), SENDER).astype(float)
    R = np.diag([0.02 * CELL, 0.02 * BIN, 2e-4, 2e-4]) ** 2  # cosines: no detection is better
    truth = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H)
    assert pt.reference.track is not None
    assert H @ pt.reference.track.state.covariance @ H.T == pytest.approx(
        H @ truth @ H.T, rel=1e-3, abs=1e-10
    )
    assert pt.reference.track.snr == 50.0


@pytest.mark.parametrize(
    ("off", "spread", "believed"),
    [
        ((0.14, 0.0), (0.0, 0.0), True),
        ((0.16, 0.0), (0.0, 0.0), False),
        ((0.0, -0.29), (0.0, 0.0), True),
        ((0.0, 0.31), (0.0, 0.0), False),
        ((-0.34, 0.0), (0.05, 0.0), True),
        ((0.36, 0.0), (0.05, 0.0), False),
        ((0.0, 0.69), (0.0, 0.1), True),
        ((0.0, -0.71), (0.0, 0.1), False),
        ((0.39, 0.0), (0.09, 0.0), True),
        ((-0.41, 0.0), (0.09, 0.0), False),
    ],
)
@pytest.mark.parametrize("periods", [0, 1, -2])
def test_how_far_off_a_reference_may_be(off, spread, believed, periods):
    """0.15 cells or 0.3 bins and four deviations of the prediction, 0.4 cells of range at most; a
    whole period of velocity, one cycle a slot, is no difference. Planted bugs: variances; both
    asked for instead of one; no upper limit; the period of an echo."""
    e = (SENDER[:3] - OWN.position) / np.linalg.norm(SENDER[:3] - OWN.position)
    P = 1e-12 * np.eye(9)
    P[:3, :3] += (spread[0] * CELL) ** 2 * np.outer(e, e)
    P[3:6, 3:6] += (spread[1] * BIN) ** 2 * np.outer(e, e)
    z = sight() + np.array([off[0] * CELL, (off[1] + periods * W.num_chirps) * BIN, 0, 0])
    z[0] -= periods * W.num_chirps * BIN * MIDDLE / W.slope  # the same beat
    pt, _ = passive([heard(z)], Gaussian(SENDER.copy(), P))
    pt.step(EMPTY, OWN, 0.0, True)
    assert pt.reference.track is not None and pt.status is TerminalState.TRACKING
    assert (pt.reference.track.missed, pt.reference.track.snr) == (
        (0, 50.0) if believed else (1, 80.0)
    )


@pytest.mark.parametrize(
    ("cells", "modulated", "anew"), [(0.8, False, True), (0.7, False, False), (0.8, True, False)]
)
def test_a_pilot_in_another_cell_starts_anew(cells, modulated, anew):
    """More than three quarters of a cell off, in a frame without data: a new track with a new
    number, and what rested on the old one is gone. Planted bugs: data frames start anew; metres for
    cells; the other tracks kept."""
    pt, _ = passive([heard(sight() + np.array([cells * CELL, 0, 0, 0]))], known())
    pt.tracker.state.tracks = [
        Track(pt.tracker.new_id(), Gaussian(BODY, known().covariance), 20.0, confirmed=True)
    ]
    _, tracks = pt.step(EMPTY, OWN, 0.0, modulated)
    assert pt.reference.track is not None
    assert pt.reference.track.id == (2 if anew else 0)
    assert pt.reference.track.confirmed and pt.reference.track.age == (0 if anew else 1)
    assert tracks.ids.tolist() == ([2] if anew else [0, 1])


def test_patience_has_an_end():
    """25 frames of disbelief, and the next frame without data is believed; not the one before, and
    one that was believed begins the count anew. Planted bugs: no end; one too few."""
    for believed_first, frames, anew in ((False, 25, False), (False, 26, True), (True, 26, False)):
        pt, reports = passive([], known(0.001, 0.001))
        assert pt.reference.track is not None
        # a track at rest about the line of sight, so that time changes nothing
        pt.reference.track.state.mean[3:] = 0
        pt.reference.track.state.covariance[3:] = pt.reference.track.state.covariance[:, 3:] = 0
        z = sight() * [1, 0, 1, 1]
        reports.answers = [heard(z + np.array([0.5 * CELL, 0, 0, 0]))] * (frames + 1)
        if believed_first:
            reports.answers[12] = heard(z)
        for k in range(frames):
            pt.step(EMPTY, OWN, 1e-6 * k, True)
        assert pt.reference.track.missed == (frames if not believed_first else frames - 13)
        pt.step(EMPTY, OWN, 1e-6 * frames, False)
        assert (pt.reference.track.id != 0) is anew


def test_reflectors_are_tracked_by_way_of_the_sender_while_it_is_in_sight():
    """A detection at the reflector's path length starts a track at the reflector; without a line of
    sight nothing is tracked, and nothing is missed. Planted bugs: reflectors one way; tracks that
    age while the sender is out of sight."""
    z = np.asarray(what_is_measured(BODY * ([1] * 3 + [0] * 6), OWN, SENDER), float)
    pt, _ = passive([heard(sight(), [z]), heard(None, [z])], known())
    _, tracks = pt.step(EMPTY, OWN, 0.0, False)
    assert len(tracks) == 2
    assert tracks.mean[1, :3] + OWN.position == pytest.approx(BODY[:3], abs=0.5)
    _, tracks = pt.step(EMPTY, OWN, 0.001, False)
    assert tracks.age.tolist() == [2, 0] and len(pt.tracker.tracks) == 1


def outside(*symbols: int) -> np.ndarray:
    """Raw symbols of a frame in mid-alphabet, but for these."""
    raw = np.full((3, W.num_chirps), 60)
    raw.flat[: len(symbols)] = symbols
    return raw


def read(symbols, z, sure=100.0, **changes) -> Reception:
    """A decoded reception with these symbols at the alphabet's ends, whose check sum fails if there
    are some."""
    raw = outside(*symbols)
    confidence = np.full(raw.shape, sure)
    return heard(
        z,
        decoded=True,
        raw_delay_symbols=raw,
        delay_confidence=confidence,
        confidence_looks=15,
        **{"intact": not symbols, **changes},
    )


def test_a_slip_is_repaired_and_the_frame_read_again():
    """Two sure symbols two below the alphabet: the second prediction is two cells shorter, nothing
    else of it changes, and what is returned is the second reading. One that is not decoded changes
    nothing. Unsure symbols, one alone, and symbols that the move would take
    beyond the other end are no evidence. Planted bugs:
    the sign; the first reading returned; the state left moved."""
    for again, kept in (
        (read([], sight() - np.array([2 * CELL, 0, 0, 0])), False),
        (heard(), True),
    ):
        pt, reports = passive([read([-2, -2], sight()), again], known())
        reception, _ = pt.step(EMPTY, OWN, 0.0, True)
        (first, *_), (second, modulated, _) = reports.handed
        assert modulated and second.range[0] - first.range[0] == pytest.approx(-2 * CELL, abs=1e-9)
        assert second.velocity[0] == pytest.approx(first.velocity[0], abs=1e-9)
        assert second.direction[0] == pytest.approx(first.direction[0], abs=1e-12)
        assert reception.raw_delay_symbols[0, 0] == (-2 if kept else 60)
        length = np.linalg.norm(pt.reference.track.state.mean[:3] - OWN.position)
        assert length == pytest.approx(sight()[0] - (0 if kept else 2 * CELL), abs=1e-3)
    for symbols, sure in (
        ([-2], 100.0),
        ([-2, -2], 1.0),
        ([-2, -2, 129, 129], 100.0),
        ([-2, -2, 126], 100.0),
        ([127, 0], 100.0),
    ):
        pt, reports = passive([read(symbols, sight(), sure)], known())
        pt.step(EMPTY, OWN, 0.0, True)
        assert len(reports.handed) == 1


def test_evidence_of_a_slip_is_gathered_over_twelve_frames():
    """One symbol below the alphabet in a first frame and one 11 or 12 frames later: the first is
    remembered for 12. A move from outside forgets it. Planted bugs: evidence for ever; kept over a
    correction."""
    for gap, told_once in ((11, False), (12, True)):
        pt, reports = passive([], known(1e-4, 1e-4))
        pt.reference.track.state.mean[3:] = 0
        z = sight() * [1, 0, 1, 1]
        symbols = [[-1], *[[]] * (gap - 1), [-1]]
        reports.answers = [read(s, z, intact=False) for s in symbols]
        reports.answers += [read([], z - np.array([CELL, 0, 0, 0]))]
        for k in range(gap + 1):
            pt.step(EMPTY, OWN, 1e-6 * k, True)
        length = np.linalg.norm(pt.reference.track.state.mean[:3] - OWN.position)
        assert length == pytest.approx(z[0] - (0 if told_once else CELL), abs=1e-3)
    pt, reports = passive([], known(1e-4, 1e-4))
    pt.reference.track.state.mean[3:] = 0
    reports.answers = [read([-1], z), read([-1], z - np.array([CELL, 0, 0, 0]))]
    pt.step(EMPTY, OWN, 0.0, True)
    pt.shorten(1, OWN)
    length = np.linalg.norm(pt.reference.track.state.mean[:3] - OWN.position)
    assert length == pytest.approx(z[0] - CELL, abs=1e-3)
    pt.step(EMPTY, OWN, 1e-6, True)
    length = np.linalg.norm(pt.reference.track.state.mean[:3] - OWN.position)
    assert length == pytest.approx(z[0] - CELL, abs=1e-3)


def test_a_slip_is_the_least_move_that_fits_the_alphabet():
    """All sets of three symbols of -4 .. 4 and 124 .. 131: with two symbols beyond one end, the
    least whole move that brings all of them into 0 .. 127; where there is none, none. Planted bugs:
    one symbol is enough; symbols left outside at the other end."""
    ends = [-4, -2, -1, 0, 3, 4, 124, 127, 128, 131]
    for chosen in product(ends, repeat=3):
        raw = np.array(chosen)
        moves = [k for k in range(-9, 10) if ((raw - k >= 0) & (raw - k <= 127)).all()]
        least = min(moves, key=abs, default=0)
        enough = (raw < 0).sum() >= 2 if least < 0 else (raw > 127).sum() >= 2
        assert slip_cells(raw, 128) == (least if enough else 0), chosen


def test_an_active_terminal_hands_its_clutter_on_and_folds_its_echoes():
    """What is expected of the mesh reaches the receiver; the Doppler of an echo tells velocities
    apart modulo half a wavelength a slot, and a PT's modulo a whole one; the range is read with
    the velocity. Planted bugs: clutter dropped; the period of one pass; half a period."""
    period = 299_792_458.0 / MIDDLE / (2 * W.slot_duration)
    clutter = ExpectedClutter(*(np.zeros(0),) * 3, *(np.zeros((0, 3)),) * 2)
    at = ActiveTerminal(W, ANTENNAS, Receivers(), Tracking())
    z = np.asarray(what_is_measured(BODY, OWN), float)
    fold = np.array([-MIDDLE / W.slope, 1, 0, 0]) * period  # the same beat
    reports = Told([heard(None, [z + whole * fold]) for whole in (0, -1, 2)])
    vars(at)["receive"] = reports  # in place of the method
    state = Gaussian(BODY.copy(), known(0.02, 0.2).covariance)
    at.tracker.state.tracks = [Track(at.tracker.new_id(), state, 20.0)]
    at.tracker.state.time = -1e-6
    payload: Any = object()
    for k in range(3):
        _, tracks = at.step(EMPTY, payload, OWN, 1e-6 * k, clutter=clutter, maps=k == 1)
    assert [h[1] is clutter and h[0] is payload for h in reports.handed] == [True] * 3
    assert [h[2] for h in reports.handed] == [False, True, False]
    assert len(tracks) == 1 and tracks.age[0] == 3 and tracks.confirmed[0]
    pt, _ = passive()
    assert pt.tracker.ambiguity.period == pytest.approx(2 * period)
    assert at.tracker.ambiguity.period == pytest.approx(period)


def test_mistakes_that_a_frame_shows_are_corrected_in_the_next():
    """A first frame says 2 dB more and 0.3 m/s to the right, a second 0.5 dB less and 0.2 m/s
    ahead: the third is handed clutter with both, each point's rate by the velocity along both of
    its directions, at a kept terminal as well. A frame that says nothing changes nothing. Planted
    bugs: the last correction alone; the same frame's; velocities with the other sign; forgotten
    over a stop."""
    ahead, right = np.array([[0.0, 1.0, 0.0]]), np.array([[0.6, 0.8, 0.0]])
    clutter = ExpectedClutter(
        np.array([1e-7, 2e-7]),
        np.array([1e-8, -2e-8]),
        np.array([1e-12, 3e-12]),
        np.concatenate([ahead, ahead]),
        np.concatenate([ahead, right]),
    )
    first = Correction(0.2 * np.log(10), np.array([0.3, 0.0, 0.0]))
    second = Correction(-0.05 * np.log(10), np.array([0.0, 0.2, 0.0]))
    reports = Told([heard(correction=c) for c in (first, None, second, None)])
    at: Any = ActiveTerminal(W, ANTENNAS, Receivers(), Tracking())
    for k in range(4):
        if k == 3:
            kept, at = at.memory(), ActiveTerminal(W, ANTENNAS, Receivers(), Tracking())
            at.restore(kept)
        vars(at)["receive"] = reports  # in place of the method
        at.step(EMPTY, None, OWN, 1e-6 * k, clutter=clutter)
    c = 299_792_458.0
    for k, (decibels, x, y) in enumerate([(0, 0, 0), (2, 0.3, 0), (2, 0.3, 0), (1.5, 0.3, 0.2)]):
        handed = reports.handed[k][1]
        assert handed.power == pytest.approx(10 ** (decibels / 10) * clutter.power, abs=0)
        more = -np.array([2 * y, 0.6 * x + 1.8 * y]) / c
        assert handed.delay_rate - clutter.delay_rate == pytest.approx(more, abs=1e-20)
        assert np.array_equal(handed.delay, clutter.delay)


def test_the_word_of_data_counts_from_the_frame_after_they_were_read_to_one_that_was_not():
    """A pilot and a data frame that is read are sensed by the track, a pilot and a data frame that
    is not read by the word, 1 m beside it, and the next one by the track again. Planted bugs: the
    word counts whether data were read or not; a pilot makes it count no more."""
    z, asked = sight(), []

    def clutter(state, own):
        asked.append(state[0] - SENDER[0])
        return ExpectedClutter(*np.zeros((3, 0)), *np.zeros((2, 0, 3)))

    pt, _ = passive([heard(z), read((), z), *[heard(z)] * 3], known(1e-3, 1e-3))
    pt.equipment = replace(pt.equipment, expect_clutter=clutter)
    word = Pose(SENDER[:3] + np.array([1.0, 0, 0]), SENDER[3:6], np.zeros(3), np.eye(3))
    for n, modulated in enumerate([False, True, False, True, True]):
        pt.step(EMPTY, OWN, n * 1e-4, modulated, sender=word)
    assert asked == pytest.approx([0, 0, 1, 1, 0], abs=0.1)  # the track is known to 1 mm, and moves
