"""What terminals tell each other: bits, frames, losses and who has it from whom, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.cooperation.fusion import HOLD_S, Detection, FusedTracks
from isac_rt.extensions.cooperation.messages import (
    DETECTION_BITS,
    FRAME_BITS,
    HEADER_BITS,
    NUMBER_BITS,
    TERMINAL_BITS,
    Channel,
    Notes,
    SelfReport,
)
from isac_rt.plain import plain
from isac_rt.storage import pack, unpack
from isac_rt.track.filter import Gaussian
from isac_rt.track.fused import Key, Name
from isac_rt.world.swarm import Pose

T = 0.05
OWN = Pose.at_rest()
STD = np.array([0.05, 0.05, 0.01, 0.01])


def seen(notes, time, *numbers, origin="A->A", found=None):
    """Confirmed tracks, of which some are `found`, at rest at ranges of 30 m and more."""
    notes.observe(
        origin,
        time,
        [
            Detection(
                Key(origin, n),
                time,
                Name(time, origin, n),
                time,
                OWN,
                np.zeros(0),
                0.0,
                np.array([30.0 + 5 * n, 0, 0.1, 0.1]),
                STD,
            )
            for n in (numbers if found is None else found)
        ],
        numbers,
    )
    notes.terminals[notes.name] = SelfReport(time, Gaussian(np.zeros(6), np.eye(6)))
    return notes


def fuse(notes, fused, time):
    notes.forget(time)
    keys, detections = notes.of_tracks()
    return fused.update(time, detections, keys, {})


def tracks():
    return FusedTracks(["A", "B", "C"], ["A->A", "A->B", "A->C"], 1.5)


def message(tracks):
    return seen(Notes("A"), 0.0, *range(tracks)).compose("B", 10**6)


def test_the_length_of_a_message_is_the_sum_of_its_parts():
    """64 + 136 and 320 for the frame, 16 + 160 a track: 64 + 136 + 320 + 3 (16 + 160) = 1048."""
    parts = HEADER_BITS + TERMINAL_BITS + FRAME_BITS + 3 * (NUMBER_BITS + DETECTION_BITS)
    assert message(3).bits == parts == 1048


@pytest.mark.parametrize(("capacity", "frames"), [(1048, 1), (1047, 2), (350, 3), (349, 4)])
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
        outcome = [channel.carry(frame, 350, frame != lost) for frame in range(3)]
        assert outcome[:2] == [None, None]
        assert outcome[2] is not None and not outcome[2][1]


def test_a_message_comes_late_with_the_last_of_its_frames_that_is_read():
    """Two of three frames pass unread and are read afterwards, the one while the message is still
    on its way; nothing comes twice, and after eight frames nothing waits any more. Planted bugs:
    whole with the first frame that is read; forgotten while on its way; kept for good."""
    channel = Channel()
    channel.send(message(3))
    assert channel.carry(4, 350, False) is None
    assert channel.carry(5, 350, False) is None
    assert channel.late(4) == []
    done = channel.carry(6, 350, True)
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
    """Seven tracks, room for two in a frame of 960 bits: 64 + 136 + 7 x 16 + 320 = 632 and 2 x 160.
    The newest of a track goes first. Planted bug: the oldest first."""
    notes, told = Notes("A"), []
    for frame in range(8):
        seen(notes, T * frame, *range(7))
        words = notes.compose("B", 960)
        assert words.bits <= 960
        assert {d.time for d in words.detections} == {T * frame}
        assert words.left_out == 5
        told.append([d.key.number for d in words.detections])
    assert told[:3] == [[0, 1], [2, 3], [4, 5]]
    counts = np.bincount(np.concatenate(told), minlength=7)
    assert counts.min() == 2 and counts.max() == 3
    assert notes.compose("C", 960).detections[0].key.number == 0  # another listener's turn


def test_what_was_said_is_said_again_only_where_there_is_room():
    """A frame of 960 bits holds a track's new detection and one of before, as a frame of its own
    has 320 bits; what is said twice is taken up once. Planted bug: said before what is new."""
    notes, b = seen(Notes("A"), 0.0, 1), Notes("B")
    b.receive(notes.compose("B", 960))
    seen(notes, T, 1)
    words = notes.compose("B", 960)
    assert [d.time for d in words.detections] == [T] and words.left_out == 0
    wide = notes.compose("B", 1200)
    assert [d.time for d in wide.detections] == [T, 0.0]
    for one in (words, wide):
        b.receive(one)
    assert len(b.detections) == 2


def test_a_track_is_told_of_from_its_first_detection_once_it_is_confirmed():
    """Planted bug: what a tentative track found is forgotten."""
    notes = seen(Notes("A"), 0.0, found=[1])
    assert notes.compose("B", 10**4).detections == []
    seen(notes, T, 1)
    assert sorted(d.time for d in notes.compose("B", 10**4).detections) == [0.0, T]
    assert notes.names[Key("A->A", 1)] == Name(T, "A->A", 1)


def test_what_is_heard_is_as_old_as_it_is_and_ends_when_it_is_too_old():
    """Told after frame 0 and heard with frame 1; nothing more comes, and after half a second it is
    gone."""
    a, b, fused = seen(Notes("A"), 0.0, 1), Notes("B"), tracks()
    b.receive(a.compose("B", 10**4))
    (uav,) = fuse(b, fused, T)
    assert np.linalg.norm(uav.state.mean[:3]) == pytest.approx(35.0)
    assert b.ages(T) == (T,)
    assert len(fuse(b, fused, HOLD_S)) == 1
    assert len(fuse(b, fused, HOLD_S + 1e-3)) == 0


def test_a_track_that_its_terminal_has_dropped_ends_when_that_is_heard():
    a, b, fused = seen(Notes("A"), 0.0, 1, 2), Notes("B"), tracks()
    b.receive(a.compose("B", 10**4))
    seen(a, T, 2)
    assert len(fuse(b, fused, T)) == 2
    b.receive(a.compose("B", 10**4))
    assert [f.members for f in fuse(b, fused, 2 * T)] == [(Key("A->A", 2),)]


def test_words_that_come_back_make_nothing_surer():
    """A tells B, B tells C what A said, and neither tells A its own words: for nine frames C's UAV
    is A's, no surer. Planted bug: what was heard is said to whom it came from."""
    all_notes, fused = {n: Notes(n) for n in "ABC"}, {n: tracks() for n in "ABC"}
    a, b, c = all_notes.values()
    for frame in range(9):
        seen(a, T * frame, 1)
        for notes in (b, c):
            seen(notes, T * frame, origin=f"A->{notes.name}")
        pairs = ((a, b), (b, a), (b, c), (c, b))
        words = [(y, x.compose(y.name, 10**4)) for x, y in pairs]
        assert not words[1][1].detections and not words[3][1].detections
        for listener, message in words:
            listener.receive(message)
        found = {n: fuse(all_notes[n], fused[n], T * frame) for n in "ABC"}
    (own,), (second_hand,) = found["A"], found["C"]
    assert own.members == second_hand.members == (Key("A->A", 1),)
    P, Q = own.state.covariance, second_hand.state.covariance
    assert np.linalg.eigvalsh(Q - P).min() > -1e-9


def test_a_terminal_that_stops_in_mid_sentence_goes_on_with_it():
    """Memory by way of the file's own form: notes and channel. Planted bugs: `reported_to` left
    out; the bits that are left of a message."""
    a, b = seen(Notes("A"), 0.0, *range(7)), Notes("B")
    b.receive(a.compose("B", 960))
    channel = Channel()
    channel.send(a.compose("B", 960))
    channel.carry(0, 400, False)
    kept = unpack(*pack([a.memory(), b.memory(), channel.memory()]))
    again, other, direction = Notes("A"), Notes("B"), Channel()
    for one, memory in zip((again, other, direction), kept, strict=True):
        one.restore(memory)
    for one, two in ((a, again), (b, other)):
        told = [n.compose("X", 2000) for n in (one, two)] + [
            n.compose("B", 900) for n in (one, two)
        ]
        packed = [pack(plain(m)) for m in told]
        assert packed[0] == packed[1] and packed[2] == packed[3]
        assert told[0].detections
    outcomes = [[ch.carry(1 + i, 300, True) for i in range(2)] for ch in (channel, direction)]
    assert [o is None for o in outcomes[0]] == [o is None for o in outcomes[1]] == [True, False]
    assert outcomes[1][1][1] is False
    waiting = Channel()
    waiting.restore(unpack(*pack([direction.memory()]))[0])
    assert [m.bits for m in waiting.late(0)] == [outcomes[1][1][0].bits]
