"""What one end tells the other and makes of it: references, echoes, slips, clocks left, advice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from isac_rt.extensions.access.feedback import (
    correct,
    echo_of,
    exchange,
    frames_to_repair,
    summarise,
)
from isac_rt.extensions.access.protocol import Establishment, LinkState
from isac_rt.extensions.access.synchronise import EXTERNAL, ClockEstimate, round_of
from isac_rt.frame.clock import Clock
from isac_rt.frame.link import Link
from isac_rt.frame.schedule import conventional_schedule, pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.plain import plain, restored
from isac_rt.receive.types import Detections, Reception, no_detections
from isac_rt.simulation.connections import Connections
from isac_rt.simulation.fall_back import Schedules
from isac_rt.track.filter import Gaussian
from isac_rt.track.tracker import Track, TrackSet, track_set
from isac_rt.world.swarm import Pose

C = 299_792_458.0
W = Waveform(num_samples=256, num_chirps=60)
CELL = C / (W.slope * W.sampled_duration)


def found(ranges, snr, reference=None) -> Detections:
    count = len(ranges)
    return Detections(
        range=np.array(ranges, float),
        velocity=10.0 + np.arange(count),
        direction=np.zeros((count, 2)),
        snr=np.array(snr, float),
        std=np.array([[0.01, 0.2, 0.003, 0.004]]) * (1 + np.arange(count))[:, None],
        is_reference=np.arange(count) == (-1 if reference is None else reference),
        starts=np.ones(count, bool),
    )


def test_a_round_is_the_strongest_within_a_cell_of_the_first():
    """The reference is a sidelobe 0.3 m before the path itself; a stronger echo lies a cell and
    more away. Planted bugs: the reference as it is; the strongest of all; a whole cell let in; the
    deviations exchanged; the hold added."""
    d = found([30.0, 30.3, 30.0 + 0.99, 31.01, 25.0], [40, 90, 80, 500, 700], 0)
    r = round_of(d, 1.3, True, cell=1.0, held=2e-8)
    assert r is not None
    assert r.range == pytest.approx(30.3 - 2e-8 * C)
    assert (r.velocity, r.range_std, r.velocity_std) == pytest.approx((11.0, 0.02, 0.4))
    assert (r.time, r.forward) == (1.3, True)
    assert round_of(found([30.0], [40]), 1.3, True, cell=1.0) is None


def state_of(clock: ClockEstimate | None, acknowledged: bool = True) -> LinkState:
    return LinkState(0, None, True, clock, True, acknowledged)


def test_how_well_a_clock_is_still_known():
    """Offset and drift of known covariance, 7 s after their estimate: by the sum of variances; a
    clock that an external source sets is known, one of no estimate has none to state. Planted
    bugs: the deviation at the estimate's own time; the covariance's sign; a link that was refused
    kept."""
    P = np.zeros((4, 4))
    P[:2, :2] = [[4e-20, -3e-21], [-3e-21, 9e-22]]
    estimate = ClockEstimate(-2.0, 1e-8, 3e-9, 20.0, 0.0, P)
    links = {
        Link("A", "P"): state_of(estimate),
        Link("A", "Q"): state_of(None, False),
        Link("A", "R"): state_of(EXTERNAL),
    }
    e = Establishment({"A": 0}, links, {"A": 1}, {"A": 2}, 3, 4, 5, 6, 34, 0.3)
    clocks = {"A": Clock(5e-8, 4e-9), "P": Clock(3e-8, 0.0)}
    c = Connections(clocks, e)
    variance = 4e-20 + 2 * 7 * -3e-21 + 49 * 9e-22
    assert c.offset_std(Link("A", "P"), 5.0) == pytest.approx(np.sqrt(variance), rel=1e-12, abs=0)
    assert c.offset_std(Link("A", "Q"), 5.0) == 0 == c.offset_std(Link("A", "R"), 5.0)
    assert Connections().offset_std(Link("A", "P"), 5.0) == 0
    assert c.refused == {Link("A", "Q")} and Connections().refused == frozenset()
    said = c.summary(5.0)
    assert said is not None and Connections().summary(5.0) is None
    left = (5e-8 + 5 * 4e-9) - 3e-8 - (1e-8 + 7 * 3e-9)
    assert said["links"]["A->P"]["clock_error_s"] == pytest.approx(left, rel=1e-9, abs=0)
    assert said["links"]["A->P"]["drift_error"] == pytest.approx(1e-9, rel=1e-9, abs=0)
    assert said["links"]["A->P"]["clock_error_std_s"] == pytest.approx(np.sqrt(variance))
    assert said["links"]["A->Q"]["clock_error_s"] is None
    names = ("missed_announcements", "wrong_announcements", "missed_acknowledgments")
    assert [said[n] for n in (*names, "false_acknowledgments")] == [3, 4, 5, 6]
    assert (said["missed_blocks"], said["false_blocks"]) == ({"A": 1}, {"A": 2})


def tracks_of(own: Pose, rows, reference=None) -> TrackSet:
    """Tracks (place, confirmed) of a terminal, known to so many metres along all axes."""
    made = [
        Track(i, gaussian(place, spread), 30.0, confirmed=sure)
        for i, (place, spread, sure) in enumerate(rows)
    ]
    first = None if reference is None else Track(9, gaussian(*reference), 30.0, confirmed=True)
    return track_set(made, own, first)


def gaussian(place, spread) -> Gaussian:
    return Gaussian(np.array([*place, 1.0, 2.0, 0.0]), np.diag([spread**2] * 3 + [0.09] * 3))


AT = Pose.at_rest((5.0, -3.0, 40.0), (0, 1, 0))
PT = Pose.at_rest((9.0, 37.0, 41.0), (0, -1, 0))


def test_the_echo_of_a_terminal_is_the_confirmed_one_in_its_direction():
    """The active terminal's tracks: another UAV aside, a tentative one right on the line, the
    terminal itself 3 degrees off by its range's error. 5 degrees off is another's. Planted bugs:
    the direction as the other end sees it; the first track; tentative ones; any direction."""

    def off(degrees: float) -> np.ndarray:
        gap, turn = PT.position - AT.position, np.deg2rad(degrees)
        c, s = np.cos(turn), np.sin(turn)
        return AT.position + np.array([c * gap[0] - s * gap[1], s * gap[0] + c * gap[1], gap[2]])

    reported = tracks_of(PT, [((0, 9, 40), 0.1, True)], (AT.position, 0.1))
    aside = ((-20.0, 20.0, 44.0), 0.1, True)
    own = tracks_of(AT, [aside, (off(0), 0.1, False), (off(3), 0.1, True), (off(-6), 0.1, True)])
    assert echo_of(reported, own) == 2
    assert echo_of(reported, tracks_of(AT, [aside, (off(5), 0.1, True)])) is None
    assert echo_of(reported, tracks_of(AT, [(off(0), 0.1, False)])) is None
    assert echo_of(tracks_of(PT, [((0, 9, 40), 0.1, True)]), own) is None


def read(symbols, confidence=60.0, looks=15, **changes) -> Reception:
    """A decoded frame with these raw symbols in the middle group, all as sure as stated."""
    raw = np.full((3, W.num_chirps), 60)
    raw[1, : len(symbols)] = symbols
    sure = np.full(raw.shape, confidence)
    base = Reception.undecoded(W, no_detections())
    return replace(
        base,
        decoded=True,
        raw_delay_symbols=raw,
        delay_confidence=sure,
        confidence_looks=looks,
        **changes,
    )


@pytest.mark.parametrize("slip", [-2, 0, 1])
def test_what_is_exchanged_is_the_links_own(slip):
    """The passive terminal's range a few cells too long, its echo among others in the active one's
    tracks: the answer by the normal law over all slips that the alphabet leaves, with the
    deviations of range of both and of the clocks, as c times theirs. Planted bugs: the first echo;
    deviations of the rate; the clocks' deviation in seconds."""
    gap = PT.position - AT.position
    length = np.linalg.norm(gap)
    too_long = AT.position - gap / length * slip * CELL
    reported = tracks_of(PT, [((0, 9, 40), 0.5, True)], (too_long, 0.05))
    own = tracks_of(AT, [((-20.0, 20.0, 44.0), 0.9, True), (PT.position, 0.08, True)])
    for clock in (0.0, 0.09 / C):
        symbols = [3 - slip, 3 - slip, 120 - slip, 120 - slip]
        answer = exchange(read(symbols), reported, own, 15, clock, W)
        assert answer is not None
        least, most = -(3 - slip), 127 - (120 - slip)
        slips = np.arange(max(least, -16), min(most, 16) + 1)
        sigma = np.sqrt(0.05**2 + 0.08**2 + (clock * C) ** 2)
        weight = stats.norm.pdf(slip * CELL, slips * CELL, sigma)
        weight /= weight.sum()
        assert answer.probability == pytest.approx(weight.max(), abs=1e-6)
        assert answer.sure is bool(weight.max() >= 0.999)
        assert answer.cells == (slip if answer.sure else 0)
    assert exchange(replace(read([]), decoded=False), reported, own, 15, 0.0, W) is None
    other = tracks_of(AT, [((-20.0, 20.0, 44.0), 0.9, True)])
    assert exchange(read([]), reported, other, 15, 0.0, W) is None


def test_what_is_reported_are_the_second_outermost_of_sure_symbols():
    """A symbol counts when noise makes the largest of 136 cells so sure in less than one of 1000
    chirps, by the law of a mean of exponentials. Planted bugs: the outermost; another number of
    looks; every symbol; groups without data counted."""
    told = summarise(read([-3, 5, 126, 127]), 41.0, 0.02, 3, W)
    assert (told.lowest, told.highest, told.decided) == (5, 126, 3 * W.num_chirps)
    assert (told.range, told.range_std) == (41.0, 0.02)
    for looks, stated, num_rx in ((15, 15, 3), (0, 3, 3)):
        level = stats.gamma(stated, scale=1 / stated).isf(1e-3 / 136)
        for share, sure in ((0.999, 0), (1.001, 3 * W.num_chirps)):
            said = summarise(read([], share * level, looks), 41.0, 0.02, num_rx, W)
            assert said.decided == sure
            assert (said.lowest is None) is (sure == 0)
    # two groups of three carry data for the terminal: the raw symbols are of these alone
    part = read([-3, 5])
    confidence = part.delay_confidence.copy()
    confidence[2] = 0
    symbols = np.where(np.arange(3)[:, None] == 2, -1, np.clip(part.raw_delay_symbols, 0, 127))
    streams = replace(
        part,
        delay_symbols=symbols,
        raw_delay_symbols=part.raw_delay_symbols[:2],
        delay_confidence=confidence,
    )
    said = summarise(streams, 41.0, 0.02, 3, W)
    assert (said.decided, said.lowest, said.highest) == (2 * W.num_chirps, 5, 60)
    assert summarise(replace(streams, decoded=False), 41.0, 0.02, 3, W).decided == 0


def test_slips_are_weighed_as_far_as_they_can_be():
    """16 cells at most, without symbols; at half a cell from two slips neither is likelier than one
    in two; an echo that no slip explains by five deviations (and a whole cell) is another's.
    Planted bugs: 32; the excess over the least distance forgotten."""
    told = summarise(replace(read([]), decoded=False), 40.0, 0.01, 3, W)
    at_most = correct(told, 40.0 - 16 * CELL, 0.01, 0.0, W)
    assert (at_most.cells, at_most.sure) == (16, True)
    assert correct(told, 40.0 - 17 * CELL - 0.1, 0.01, 0.0, W).probability == 0
    half = correct(told, 40.0 - 0.5 * CELL, 0.05, 0.0, W)
    assert half.probability == pytest.approx(0.5, abs=1e-9) and half.cells == 0
    assert frames_to_repair(3, 1, 2) == 3


def test_advice_acts_on_its_transmitter_and_comes_back_from_memory():
    """A's own receiver is content, B's passive one is not: B falls back. After a stop the same.
    Planted bugs: the receiver's name for the transmitter's; the two exchanged in memory; advice
    taken where it is not asked for."""
    usual = pseudo_random_schedule(1, 12, 3, np.random.default_rng(1))
    said = {Link("A", "A"): True, Link("B", "A"): False, Link("B", "B"): True}
    receptions = {k: replace(read([]), sparse=v) for k, v in said.items()}
    one = Schedules(usual, 3)
    one.take_advice(receptions)
    again = Schedules(usual, 3)
    again.advice = restored(dict[Link, bool], plain(one.advice))
    for s in (one, again):
        assert s.of("A") is usual
        assert np.array_equal(s.of("B"), conventional_schedule(1, 12, 3))
    deaf = Schedules(usual, 3, fall_back=False)
    deaf.take_advice(receptions)
    assert deaf.of("B") is usual
