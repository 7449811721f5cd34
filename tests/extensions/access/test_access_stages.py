"""The stages before the data with a scripted air: who sends what where and when, by the timetable
on paper, and every outcome of a link enumerated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
import pytest

from isac_rt.extensions.access import protocol
from isac_rt.extensions.access.ook import Message, Reading, keyed
from isac_rt.extensions.access.protocol import Network, establish
from isac_rt.extensions.access.synchronise import EXTERNAL
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.clock import Clock
from isac_rt.frame.cube import IFCube
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections, Reception, no_detections
from isac_rt.world.swarm import Pose

C = 299_792_458.0
W = Waveform(num_samples=64, num_chirps=60)
BLOCK = 2 * W.max_delay
"""By which the chirps of neighbouring blocks are apart [s]."""
NAMES = ("A", "B", "P", "Q", "R", "S", "T")
STRETCHES = [0, 3, 6, 9, 12, 15, 16]
"""First blocks in which 19 blocks are heard three at a time."""


class Heard(NamedTuple):
    """One reception: by whom, in which frame and from which block on, of what, and its noise."""

    name: str
    frame: int
    block: int
    sent: list[Any]
    power: float
    words: tuple[int, ...]


@dataclass
class Air:
    """What receivers are told that they make of their samples, and what was on the air.

    Attributes
    ----------
    hot : blocks in which chirps stand out
    message : of (listener, frame, block), None: nobody is on there
    sight : range [m] that (listener, frame, group) sees, None: nothing
    """

    hot: Callable[[str, int], bool] = lambda name, block: False
    message: Callable[[str, int, int], Message | None] = lambda name, frame, block: None
    sight: Callable[[str, int, int], float | None] = lambda name, frame, group: None
    received_words: list[Heard] = field(default_factory=list)

    def establish(self, monkeypatch: pytest.MonkeyPatch, n: Network):
        """The stages on samples that hold nothing but (listener, frame, first block, group)."""

        def synthesis(waveform, links, receiver, reference, method, noise):
            name = NAMES[int(receiver.pose.position[0])]
            start = reference.start_time - reference.first_block * BLOCK
            number = (start - n.start) / W.frame_duration
            assert number == pytest.approx(round(number), abs=1e-6)
            samples = np.empty((W.num_groups, 1, W.num_chirps, 4), np.complex64)
            samples[..., 0], samples[..., 1] = NAMES.index(name), round(number)
            samples[..., 2] = reference.first_block
            samples[..., 3] = np.arange(W.num_groups)[:, None, None]
            sent = [transmission for transmission, _ in links]
            words = tuple(noise.seed_words.tolist())
            self.received_words.append(
                Heard(name, round(number), reference.first_block, sent, noise.power, words)
            )
            return IFCube(samples=samples, waveform=W, schedule=n.schedule, start_time=0.0)

        def labels(samples):
            name, frame, first, group = samples[0, 0, 0].real.astype(int).tolist()
            return NAMES[name], frame, first, group

        def hot_chirps(samples):
            name, _, first, _ = labels(samples)
            return np.array([W.num_chirps * self.hot(name, first + m) for m in range(3)])

        def read(samples, num_bits):
            assert len(samples) == 1
            name, frame, first, group = labels(samples)
            said = self.message(name, frame, first + group)
            bits = np.zeros(num_bits, np.uint8) if said is None else n.codebook.encode(said)
            return Reading(said is not None, 0.0, bits, np.ones(num_bits))

        def receive_passive(cube, *rest):
            name, frame, _, group = labels(cube.samples)
            r, one = self.sight(name, frame, group), np.ones(1)
            if r is None:
                return Reception.undecoded(W, no_detections())
            found = Detections(
                range=r * one,
                velocity=0.5 * one,
                direction=np.zeros((1, 2)),
                snr=99 * one,
                std=np.array([[0.01, 0.1, 1e-3, 1e-3]]),
                is_reference=one > 0,
                starts=np.ones(1, bool),
            )
            return Reception.undecoded(W, found)

        stand_ins = {
            "noisy_if_signal": synthesis,
            "hot_chirps": hot_chirps,
            "read": read,
            "receive_passive": receive_passive,
            "measured_alone": lambda found, cube, antennas: found,
        }
        for name, stand_in in stand_ins.items():
            monkeypatch.setattr(protocol, name, stand_in)
        return establish(n)

    def by(self, frame: int) -> list[Heard]:
        return [h for h in self.received_words if h.frame == frame]


def network(**change) -> Network:
    """Terminals at rest, each at its number's place; nothing travels but by the script."""
    poses = {name: Pose.at_rest((i, 0, 0)) for i, name in enumerate(NAMES)}
    rng = np.random.default_rng(7)
    fields: dict[str, Any] = {
        "waveform": W,
        "arrays": Arrays(Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.002)),
        "schedule": pseudo_random_schedule(W.num_groups, W.num_chirps, W.num_tx, rng),
        "receivers": Receivers(),
        "scene": lambda time, links: (poses, dict.fromkeys(links)),
        "wishes": {"A": 4},
        "listeners": {"A": ("P", "Q")},
        "noise_power": {name: 1.5 + i for i, name in enumerate(NAMES)},
        "seed": 5,
        "start": -0.7,
    }
    return Network(**(fields | change))


SHIFT = {"P": 2, "Q": 0, "R": -1, "S": 0, "T": 5}
"""By how many blocks a passive terminal's grid is late: where it hears block b as b + shift."""


def everything_is_heard(n: Network) -> Air:
    """Everybody understands everybody, each on its own grid."""
    runs = {"A": 4, "B": 9}
    of = {pt: at for at, pts in n.listeners.items() for pt in pts}

    def message(name, frame, block):
        if name in runs:  # acknowledgments: group g of the run, of the g-th of this turn
            turn = [h for h in air.received_words if h.frame == frame][-1].sent
            group = block - runs[name]
            here = [t.name for t in turn if t.active is not None and t.active[group].any()]
            return Message(n.names.index(here[0]), runs[name]) if here else None
        own = runs[of[name]] + SHIFT[name]
        sent = air.received_words[-1].sent
        announced = any(t.name == of[name] and t.active is not None for t in sent)
        found = announced and own <= block < own + 3
        return Message(n.names.index(of[name]), runs[of[name]]) if found else None

    air = Air(message=message, sight=lambda name, frame, group: 20.0)
    return air


def test_the_timetable_on_paper(monkeypatch):
    """A with four listeners and B with one: who hears from which block, who sends in which block
    with which chirps on, how late, and whether data. 7 frames to listen, 7 to announce, one of
    round 1, one of round 2 and one to acknowledge for each three listeners. Planted bugs: the hold
    on data; all groups of an answer on; all listeners in one turn; joined terminals silent; answers
    in the sender's block."""
    listeners = {"A": ("P", "Q", "R", "S"), "B": ("T",)}
    clocks = {"A": Clock(3e-8, 4e-9), "P": Clock(-5e-8, -7e-9), "T": Clock(1e-8, 2e-9)}
    n = network(wishes={"A": 4, "B": 9}, listeners=listeners, clocks=clocks)
    air = everything_is_heard(n)
    got = air.establish(monkeypatch, n)
    assert got.blocks == {"A": 4, "B": 9}
    assert got.num_frames == 19 + 17
    assert got.duration == pytest.approx(36 * W.frame_duration)
    assert n.longest == pytest.approx(got.duration)
    assert all(link.acknowledged and link.identified for link in got.links.values())

    words = {
        pt: keyed(W, n.codebook.encode(Message(n.names.index(pt), 4 if pt in "PQRS" else 9)))
        for pt in "PQRST"
    }
    said = {
        at: keyed(W, n.codebook.encode(Message(n.names.index(at), b)))
        for at, b in (("A", 4), ("B", 9))
    }

    def alone(group: int, mask: np.ndarray | bool = True) -> np.ndarray:
        out = np.zeros((3, W.num_chirps), bool)
        out[group] = mask[group] if isinstance(mask, np.ndarray) else mask
        return out

    plan: list[list[tuple]] = []  # per frame: (listener, first block, [(sender, block, mask)])
    for at, run in (("A", 4), ("B", 9)):
        pts = listeners[at]
        data = [] if at == "A" else [("A", 4, "data")]
        plan += [[(at, first, data)] for first in STRETCHES]
        plan += [[(pt, first, [(at, run, said[at]), *data]) for pt in pts] for first in STRETCHES]
        plan += [[(pt, run + SHIFT[pt], [(at, run, None), *data]) for pt in pts]]
        for mask in (True, words):
            for turn in [pts[:3], pts[3:]] if len(pts) > 3 else [pts]:
                answers = [
                    (pt, run + SHIFT[pt], alone(g, mask if mask is True else words[pt]))
                    for g, pt in enumerate(turn)
                ]
                plan.append([(at, run, [*answers, *data])])
    assert len(plan) == 36
    for frame, receptions in enumerate(plan):
        received_words = air.by(frame)
        assert [(h.name, h.block) for h in received_words] == [r[:2] for r in receptions], frame
        for h, (_, _, sent) in zip(received_words, receptions, strict=True):
            assert [(t.name, t.first_block) for t in h.sent] == [s[:2] for s in sent], frame
            for t, (name, _, mask) in zip(h.sent, sent, strict=True):
                modulated = bool(t.payload.delay_symbols.any())
                assert modulated is (isinstance(mask, str))
                if isinstance(mask, np.ndarray):
                    assert np.array_equal(t.active, mask), frame
                else:
                    assert t.active is None
                middle = n.start + (frame + 0.5) * W.frame_duration
                one, other = clocks.get(name, Clock()), clocks.get(h.name, Clock())
                late = one.offset - other.offset + (one.drift - other.drift) * middle
                hold = 0.0 if modulated else W.max_delay / 8
                assert t.clock_offset == pytest.approx(late + hold, abs=1e-18)
                assert t.clock_drift == pytest.approx(one.drift - other.drift, abs=1e-20)


def test_noise_and_data_of_the_stages_are_all_different(monkeypatch):
    """Every reception has the noise power of its receiver and a stream of its own; a terminal that
    has joined says the same to all who hear a frame, something else in every frame, and something
    else than another one. Planted bugs: one noise for all receivers, or for all frames; the noise
    of the sender; one payload for all."""
    listeners: dict[str, tuple[str, ...]] = {"A": (), "B": (), "P": ("Q", "R")}
    n = network(wishes={"A": 0, "B": 5, "P": 12}, listeners=listeners)
    air = Air()
    air.establish(monkeypatch, n)
    assert len({h.words for h in air.received_words}) == len(air.received_words)
    assert all(h.power == n.noise_power[h.name] for h in air.received_words)
    said: dict[tuple[str, int], bytes] = {}
    for h in air.received_words:
        for t in h.sent:
            if t.active is None:
                bits = t.payload.bits.tobytes()
                assert said.setdefault((t.name, h.frame), bits) == bits
    assert {name for name, _ in said} == {"A", "B"}
    assert len(set(said.values())) == len(said)


@pytest.mark.parametrize("count", range(8))
def test_the_longest_that_it_can_last(count):
    """Frames of one active terminal with 0 to 7 listeners, all of which answer three a frame.
    Planted bugs: listening or announcing forgotten; a turn begun not counted."""
    names = NAMES + tuple("UVW")
    pts = tuple(names[2 : 2 + count])
    n = network(listeners={"A": pts})
    turns = {0: 0, 1: 1, 2: 1, 3: 1, 4: 2, 5: 2, 6: 2, 7: 3}[count]
    assert n.longest == pytest.approx((7 + 7 + 1 + 2 * turns) * W.frame_duration)


@pytest.mark.parametrize("external", [False, True])
def test_every_outcome_of_a_link(monkeypatch, external):
    """What P understands (nothing, another message, the message), whether each round is seen, and
    what A reads in P's group (nothing, another's name, P's): 36 cases, by the rules as they are
    written. Planted bugs: the message taken for understood by the sender's word; acknowledged
    without a clock; any acknowledgment taken for P's; counts exchanged."""
    right, other = "right", "other"
    for said, one, two, back in product(
        (None, other, right), (False, True), (False, True), (None, other, right)
    ):
        n = network(external_clock=external)
        messages = {right: Message(0, 4), other: Message(0, 5)}

        def message(name, frame, block, said=said, back=back, messages=messages):
            if name == "P":
                return messages.get(said) if 4 <= block < 7 else None
            if name == "A":
                return (
                    {right: Message(1, 4), other: Message(2, 4)}.get(back) if block == 4 else None
                )
            return None

        def sight(name, frame, group, one=one, two=two):
            return 20.0 if {"P": one, "A": two}[name] else None

        got = Air(message=message, sight=sight).establish(monkeypatch, n)
        p, q = got.links["A", "P"], got.links["A", "Q"]
        understood, seen = said is not None, external or (said is not None and one)
        assert p.received_block == (4 if understood else None)
        assert p.message == messages.get(said)
        assert p.identified is (said == right)
        assert p.sent_acknowledgment is (understood and seen)
        if external:
            assert p.clock is EXTERNAL
        else:
            assert (p.clock is not None) is (understood and one and two)
        assert p.acknowledged is (back == right and p.clock is not None)
        assert (q.received_block, q.message, q.identified) == (None, None, False)
        assert not q.sent_acknowledgment and not q.acknowledged
        assert got.missed_announcements == 1 + (said is None)
        assert got.wrong_announcements == (said == other)
        assert got.missed_acknowledgments == (p.sent_acknowledgment and not p.acknowledged)
        assert got.false_acknowledgments == (p.acknowledged and not p.sent_acknowledgment)


def test_clocks_of_whole_blocks_and_less(monkeypatch):
    """P's clock is two blocks and 31 ns behind A's, Q's 20 ns ahead of it, and all move apart by
    0.5 m/s: the ranges that each end sees by the geometry, the clocks that come out. The first
    round is frame 14, the second frame 15. Planted bugs: the hold's sign; whole blocks left out or
    with the other sign in either round."""
    n = network()
    late = {"P": 2 * BLOCK + 31e-9, "Q": -20e-9}
    away = {"P": 20.0, "Q": 33.0}
    air = everything_is_heard(n)
    hold, dt = W.max_delay / 8, W.frame_duration

    def sight(name, frame, group):
        if frame == 14:
            return away[name] + C * (hold + late[name] - SHIFT[name] * BLOCK)
        pt = ("P", "Q")[group]
        return away[pt] + 0.5 * dt + C * (hold - late[pt] + SHIFT[pt] * BLOCK)

    air.sight = sight
    got = air.establish(monkeypatch, n)
    for pt in ("P", "Q"):
        clock = got.links["A", pt].clock
        assert clock is not None
        assert clock.offset == pytest.approx(late[pt], abs=1e-14)  # 3 um
        assert clock.drift == pytest.approx(0, abs=1e-14)
        assert clock.range == pytest.approx(away[pt], abs=1e-5)
        assert clock.time == pytest.approx(n.start + 14.5 * dt)


def test_what_most_of_a_run_says_is_believed(monkeypatch):
    """Each of three neighbouring blocks carries nothing, one message or another: the one that more
    blocks carry, if it is in two of three at least, and the first of these. Planted bugs: one block
    is enough; all are needed; the last block; a tie decided."""
    for carried in product((None, 7, 11), repeat=3):

        def message(name, frame, block, carried=carried):
            says = carried[block - 8] if name == "P" and 8 <= block < 11 else None
            return None if says is None else Message(0, says)

        got = Air(message=message).establish(monkeypatch, network(listeners={"A": ("P",)}))
        counts = {m: carried.count(m) for m in (7, 11)}
        most = [m for m in (7, 11) if counts[m] >= 2]
        link = got.links["A", "P"]
        assert link.message == (Message(0, most[0]) if most else None)
        assert link.received_block == (8 + carried.index(most[0]) if most else None)


def test_blocks_missed_and_suspected(monkeypatch):
    """A sits in 4 to 6 and B hears 4, 6 and 11: one missed, one false, and the free run nearest to
    its wish; a third that hears all is left without, has no links, and is heard by nobody. Planted
    bugs: missed and false exchanged; only the first block of a run taken; its links forgotten."""
    received_words = {"A": (), "B": (4, 6, 11), "S": range(19)}
    n = network(
        wishes={"A": 4, "B": 10, "S": None},
        listeners={"A": (), "B": (), "S": ("P", "Q")},
    )
    air = Air(hot=lambda name, block: block in received_words[name])
    got = air.establish(monkeypatch, n)
    assert got.blocks == {"A": 4, "B": 8, "S": None}
    assert got.missed_blocks == {"A": 0, "B": 1, "S": 0}
    assert got.false_blocks == {"A": 0, "B": 1, "S": 19 - 6}
    assert got.num_frames == 7 + 8 + 7 + 8 + 7
    assert set(got.links) == {("S", "P"), ("S", "Q")}
    assert got.missed_announcements == 2
    assert all(a.frame <= b.frame for a, b in pairwise(air.received_words))
