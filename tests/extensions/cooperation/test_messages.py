"""What terminals tell each other: bits, frames, losses and who has it from whom, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from isac_rt.extensions.cooperation.centralised import CentralisedTracker, Scan, TrackManagement
from isac_rt.extensions.cooperation.fusion import DATUM_STD, ERRORS, Reported
from isac_rt.extensions.cooperation.messages import (
    DETECTION_BITS,
    HEADER_BITS,
    HOLD_S,
    NUMBER_BITS,
    REPORT_BITS,
    SCAN_BITS,
    TERMINAL_BITS,
    Channel,
    Notes,
    Sightings,
)
from isac_rt.plain import plain
from isac_rt.storage import pack, unpack
from isac_rt.track.filter import Ambiguity, Gaussian
from isac_rt.track.fused import Key
from isac_rt.track.settings import Tracking
from isac_rt.world.swarm import Pose

T = 0.05


def state(x=30.0, variance=0.01):
    return Gaussian(np.array([x, 20, 12, 0.0, 0, 0]), variance * np.eye(6))


def seen(notes, time, *numbers, origin="A->A", variance=0.01):
    lever = np.zeros((6, ERRORS))
    notes.see(origin, time, {n: Reported(state(30 + 5 * n, variance), lever) for n in numbers})
    notes.locate(time, state(0.0))
    return notes


def message(tracks):
    return seen(Notes("A"), 0.0, *range(tracks)).compose("B", 10**6)


def test_the_length_of_a_message_is_the_sum_of_its_parts():
    """64 + 136 + 16 and 424 a track: 64 + 136 + 3 (16 + 424) = 1520."""
    assert message(3).bits == HEADER_BITS + TERMINAL_BITS + 3 * (NUMBER_BITS + REPORT_BITS) == 1520


@pytest.mark.parametrize(
    ("capacity", "frames"), [(1520, 1), (1519, 2), (508, 3), (507, 3), (506, 4)]
)
def test_a_message_takes_as_many_frames_as_its_bits_need(capacity, frames):
    """Pilots between carry nothing and cost a frame. Planted bug: a frame too few."""
    channel = Channel()
    channel.send(message(3))
    for _ in range(frames - 1):
        assert channel.carry(0, capacity, True) is None
        assert channel.carry(1, 0, False) is None
    done = channel.carry(2, capacity, True)
    assert done is not None and done[1]
    assert channel.message is None


def test_a_message_is_lost_with_any_of_its_frames():
    for lost in range(3):
        channel = Channel()
        channel.send(message(3))
        outcome = [channel.carry(frame, 508, frame != lost) for frame in range(3)]
        assert outcome[:2] == [None, None]
        assert outcome[2] is not None and not outcome[2][1]


def test_a_message_comes_late_with_the_last_of_its_frames_that_is_read():
    """Two of three frames pass unread and are read afterwards, the one while the message is still
    on its way; nothing comes twice, and after eight frames nothing waits any more. Planted bugs:
    whole with the first frame that is read; forgotten while on its way; kept for good."""
    channel = Channel()
    channel.send(message(3))
    assert channel.carry(4, 508, False) is None
    assert channel.carry(5, 508, False) is None
    assert channel.late(4) == []
    done = channel.carry(6, 508, True)
    assert done is not None and not done[1]
    assert channel.late(7) == [] and channel.late(5) == [done[0]] and channel.late(5) == []
    channel.send(message(1))
    assert channel.carry(8, 700, False) is not None
    for frame in (15, 16):
        channel.send(message(2))
        assert channel.carry(frame, 2000, True)[1]
        missed = [frames for _, frames in channel.waiting]
        assert missed == ([{8}] if frame == 15 else [])


def test_tracks_take_turns_where_a_frame_cannot_hold_all():
    """Seven tracks, room for two in a frame of 1300 bits: 64 + 136 + 7 x 16 = 312 and 2 x 424."""
    notes, report_ = Notes("A"), []
    for frame in range(8):
        seen(notes, T * frame, *range(7))
        words = notes.compose("B", 1300)
        assert words.bits <= 1300
        report_.append([r.key.number for r in words.reports])
    assert report_[:3] == [[0, 1], [2, 3], [4, 5]]
    counts = np.bincount(np.concatenate(report_), minlength=7)
    assert counts.min() == 2 and counts.max() == 3
    assert notes.compose("C", 1300).reports[0].key.number == 0  # another listener's turn


def test_what_is_not_new_is_not_said_again():
    notes = seen(Notes("A"), 0.0, 1, 2)
    assert len(notes.compose("B", 10**4).reports) == 2
    assert len(notes.compose("B", 10**4).reports) == 0


def test_what_is_heard_is_as_old_as_it_is_and_ends_when_it_is_too_old():
    """Told after frame 0 and heard with frame 1, it stands still where it was, 0.05 s old; nothing
    more comes, and after half a second it is gone."""
    a, b = seen(Notes("A"), 0.0, 1), Notes("B")
    b.receive(a.compose("B", 10**4))
    (uav,) = b.fuse(T, 1.5)
    assert uav.state.mean[0] == pytest.approx(35.0)
    # 0.01 (1 + 0.05^2) and the acceleration: 1.5^2 0.05^4 / 4, but for the drift of Singer's model;
    # and what all terminals are wrong alike
    assert uav.state.covariance[0, 0] == pytest.approx(
        0.01 * (1 + T**2) + 1.5**2 * T**4 / 4 + DATUM_STD[0] ** 2, rel=1e-5
    )
    assert len(b.fuse(HOLD_S, 1.5)) == 1
    assert len(b.fuse(HOLD_S + 1e-3, 1.5)) == 0


def test_a_track_that_its_terminal_has_dropped_ends_when_that_is_heard():
    a, b = seen(Notes("A"), 0.0, 1, 2), Notes("B")
    b.receive(a.compose("B", 10**4))
    seen(a, T, 2)
    assert len(b.fuse(T, 1.5)) == 2
    b.receive(a.compose("B", 10**4))
    assert [f.members for f in b.fuse(2 * T, 1.5)] == [(Key("A->A", 2),)]


def test_words_that_come_back_make_nothing_surer():
    """A tells B, B tells C what A said, and neither tells A its own words; C's picture is A's, and
    where B and C exchange for twenty frames nobody becomes surer than A. Planted bugs: what was
    heard is said to whom it came from; a report of one's own link under another's name."""
    a, b, c = Notes("A"), Notes("B"), Notes("C")
    for frame in range(20):
        seen(a, T * frame, 1, variance=0.04)
        for notes, origin in ((b, "A->B"), (c, "A->C")):
            notes.see(origin, T * frame, {})
            notes.locate(T * frame, state(-50.0))
        words = {
            (x.name, y.name): x.compose(y.name, 10**4) for x, y in ((a, b), (b, a), (b, c), (c, b))
        }
        assert not words["B", "A"].reports
        assert not words["C", "B"].reports
        for (_, listener), message in words.items():
            {"A": a, "B": b, "C": c}[listener].receive(message)
        for notes in (a, b, c):
            for uav in notes.fuse(T * frame, 1.5):
                assert uav.members == (Key("A->A", 1),)
                assert np.diag(uav.state.covariance).min() >= 0.04 - 1e-12
    assert len(c.fuse(T * 19, 1.5)) == 1


def test_a_message_brings_its_name_and_the_listener_its_older_one():
    """B has followed the body for longer: both call it by B's track, A after it has heard of it."""
    a, b = Notes("A"), Notes("B")
    seen(b, 0.0, 4, origin="A->B")
    seen(a, T, 4)
    seen(b, T, 4, origin="A->B")
    a.fuse(T, 1.5)
    a.receive(b.compose("A", 10**4))
    (uav,) = a.fuse(T, 1.5)
    assert uav.name[1:] == ("A->B", 4)
    assert a.compose("C", 10**4).reports[0].name == uav.name


def test_a_terminal_that_stops_in_mid_sentence_goes_on_with_it():
    """Memory by way of the file's own form: notes, channel and fused tracks. Planted bugs:
    `reported_to` left out; the bits that are left of a message."""
    a, b = seen(Notes("A"), 0.0, *range(7)), Notes("B")
    b.receive(a.compose("B", 1300))
    a.fuse(0.0, 1.5)
    b.fuse(T, 1.5)
    channel = Channel()
    channel.send(a.compose("B", 1300))
    channel.carry(0, 400, False)
    kept = unpack(*pack([a.memory(), b.memory(), channel.memory()]))
    again, other, direction = Notes("A"), Notes("B"), Channel()
    for one, memory in zip((again, other, direction), kept, strict=True):
        one.restore(memory)
    for one, two in ((a, again), (b, other)):
        report_ = [n.compose("X", 2000) for n in (one, two)] + [
            n.compose("B", 900) for n in (one, two)
        ]
        packed = [pack(plain(m)) for m in report_]
        assert packed[0] == packed[1] and packed[2] == packed[3]
        assert report_[0].reports and report_[2].reports
        pictures = [
            [(f.name, f.members, f.state.mean.tolist()) for f in n.fuse(2 * T, 1.5)]
            for n in (one, two)
        ]
        assert pictures[0] == pictures[1]
    outcomes = [[ch.carry(1 + i, 500, True) for i in range(2)] for ch in (channel, direction)]
    assert [o is None for o in outcomes[0]] == [o is None for o in outcomes[1]] == [True, False]
    assert outcomes[1][1][1] is False
    waiting = Channel()
    waiting.restore(unpack(*pack([direction.memory()]))[0])
    assert [m.bits for m in waiting.late(0)] == [outcomes[1][1][0].bits]


def scan(frame=0, origin="A->A", count=2, sure=None, snr=None):
    z = np.array([[30.0, 1, 0.1, 0.0], [40.0, 2, 0.2, 0.0], [50.0, 3, 0.3, 0.0]])[:count]
    return Scan(
        origin,
        frame,
        T * frame,
        Pose.at_rest((0, 0, 20)),
        0.0,
        np.arange(count),
        z,
        np.tile([0.01, 0.05, 2e-3, 2e-3], (count, 1)),
        np.array(snr or [9.0, 3.0, 5.0][:count]),
        np.array([True] * count if sure is None else sure),
        (None,) * count,
        tuple(range(count)),
    )


def sightings(name):
    folds = Ambiguity(30.0), Ambiguity(60.0)
    tracker = CentralisedTracker(("A", "B"), Tracking(), TrackManagement(3, 5 * T, 0.36), folds)
    out = Sightings(name, tracker)
    out.locate(0.0, state(0.0))
    return out


def test_the_strongest_of_the_newest_go_first_and_what_does_not_fit_is_not_told_later():
    """64 + 136 for itself, 208 a frame of a link, 16 a track that it keeps, 165 a detection: 1400
    bits hold four of five in two frames, the newest three first; of the older the confirmed one,
    though it is weaker. After that nothing is new. Planted bugs: the oldest first; SNR before what
    is sure."""
    a = sightings("A")
    a.see(scan(0, count=2, sure=[False, True]))
    a.see(scan(1, count=3))
    words = a.compose("B", 1400)
    assert SCAN_BITS == 208 and DETECTION_BITS == 165
    assert words.bits == 64 + 136 + 2 * 208 + 5 * 16 + 4 * 165 <= 1400
    assert [(x.frame, x.numbers.tolist()) for x in words.scans] == [(1, [0, 1, 2]), (0, [1])]
    assert words.left_out == 1
    assert not a.compose("B", 1300).scans
    assert len(a.compose("C", 10**5).scans) == 2


def test_a_channel_that_is_too_small_gets_one_detection_in_several_frames():
    """64 + 136 + 208 + 3 x 16 + 165 = 621 bits by 100 a frame: room for 700."""
    a = sightings("A")
    a.see(scan(0, count=3))
    words = a.compose("B", 100)
    assert words.bits == 621 and words.left_out == 2
    assert words.scans[0].numbers.tolist() == [0]


def test_detections_are_passed_on_but_not_back():
    """What A says goes by B to C, never to A again; C has A's body and calls it as A does."""
    a, b, c = (sightings(name) for name in "ABC")
    a.see(scan(0))
    b.receive(a.compose("B", 10**5))
    c.receive(b.compose("C", 10**5))
    assert not b.compose("A", 10**5).scans and not c.compose("B", 10**5).scans
    pictures = [[uav.name for uav in x.fuse(T, 3.0)] for x in (a, b, c)]
    assert pictures[0] == pictures[1] == pictures[2] and len(pictures[0]) == 2
    assert c.ages(T) == pytest.approx((T, T)) and a.ages(T) == ()
    assert len(c.fuse(1.0, 3.0)) == 0


def test_paths_over_a_transmitter_that_says_nothing_place_nobody():
    """B's paths are of A's chirps: with A's word for where it is they are bodies."""
    silent, receiving = sightings("B"), sightings("B")
    receiving.receive(sightings("A").compose("B", 10**5))
    for one in (silent, receiving):
        one.see(replace(scan(0, "A->B"), own=Pose.at_rest((0, 20, 20), (0, -1, 0))))
    assert len(silent.fuse(T, 3.0)) == 0 and len(receiving.fuse(T, 3.0)) == 2


def test_sightings_go_on_from_memory():
    """Planted bugs: `reported_to`, or who said it, left out."""
    a, b = sightings("A"), sightings("B")
    a.see(scan(0))
    b.receive(a.compose("B", 10**5))
    b.compose("C", 10**5)
    again = sightings("B")
    again.restore(unpack(*pack(b.memory())))
    a.see(scan(1))
    for one in (b, again):
        one.receive(sightings("A").compose("B", 10**5))
    assert pack(b.memory()) == pack(again.memory())
    assert not again.compose("C", 10**5).scans and not again.compose("A", 10**5).scans
