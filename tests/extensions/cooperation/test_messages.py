"""What terminals tell each other: bits, frames, losses and who has it from whom, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.cooperation.fusion import DATUM_STD, ERRORS, Reported
from isac_rt.extensions.cooperation.messages import (
    HEADER_BITS,
    HOLD_S,
    NUMBER_BITS,
    REPORT_BITS,
    TERMINAL_BITS,
    Channel,
    Notes,
)
from isac_rt.plain import plain
from isac_rt.storage import pack, unpack
from isac_rt.track.filter import Gaussian
from isac_rt.track.fused import Key

T = 0.05


def state(x=30.0, variance=0.01):
    return Gaussian(np.array([x, 20, 12, 0.0, 0, 0]), variance * np.eye(6))


def seen(notes, time, *numbers, origin="A->A", variance=0.01):
    lever = np.zeros((6, ERRORS))
    notes.observe(origin, time, {n: Reported(state(30 + 5 * n, variance), lever) for n in numbers})
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
            notes.observe(origin, T * frame, {})
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
