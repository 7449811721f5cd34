"""Messages between terminals about what their tracks detect, and the time that a link takes to
carry them.

An active terminal's messages ride on its data frames, a passive one's go back by its feedback. A
message is made of what its sender knows after a frame and leaves with the next; it takes as many
frames as its bits need and is lost with any of them, until the frame is read late. Nobody waits for
an answer; where there is room, earlier detections are said again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil

from isac_rt.extensions.city_receivers.out_of_sequence import BATCH
from isac_rt.extensions.cooperation.fusion import HOLD_S, Detection
from isac_rt.plain import Stateful
from isac_rt.track.filter import Gaussian
from isac_rt.track.fused import Key, Name

HEADER_BITS = 64
"""Sender, time, length and checksum of a message."""
TERMINAL_BITS = 16 + 3 * 24 + 3 * 16
"""What is said of a terminal itself: age, position to a centimetre, velocity to a millimetre a
second."""
NUMBER_BITS = 16
"""One of the numbers of the tracks that a terminal keeps."""
FRAME_BITS = 8 + 16 + 2 * (3 * 24 + 3 * 16) + 3 * 16 + 8
"""A frame of a link whose detections follow: which link, age, position and velocity of receiver and
transmitter, attitude, and what its ranges share."""
DETECTION_BITS = 16 + 40 + 24 + 3 * 16 + 4 * 8
"""A detection: number and name of its track, range, rate, two cosines, and their deviations. What
these bits round off is not modelled: a centimetre and less."""
CODE_RATE = 0.5
"""Share of an active terminal's bits that messages get; the rest protects them."""
CORRECTED = 0.05
"""Largest share of a frame's bits wrong that such a code corrects: hard decisions at rate 1/2 reach
some 0.06 with frames of two thousand bits."""


@dataclass(frozen=True)
class TrackNumbers:
    """The numbers of all confirmed tracks of a link's receiver at a time [s], and by whom they were
    said: "" by the terminal itself."""

    time: float
    numbers: tuple[int, ...]
    via: str = ""


@dataclass(frozen=True)
class SelfReport:
    """Position and velocity (6,) that a terminal reported of itself at a time [s]."""

    time: float
    state: Gaussian
    via: str = ""


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes
    ----------
    sender : its name
    terminals : what it knows that terminals said of themselves, itself included
    kept : by link
    detections : of its own tracks, and of others'
    left_out : tracks that had new detections for which it had no room
    """

    sender: str
    terminals: Mapping[str, SelfReport]
    kept: Mapping[str, TrackNumbers]
    detections: Sequence[Detection]
    left_out: int = 0

    @property
    def bits(self) -> int:
        """Its length."""
        return (
            HEADER_BITS
            + TERMINAL_BITS * len(self.terminals)
            + NUMBER_BITS * sum(len(kept.numbers) for kept in self.kept.values())
            + FRAME_BITS * len({(d.key.origin, d.time) for d in self.detections})
            + DETECTION_BITS * len(self.detections)
        )


@dataclass
class Channel(Stateful):
    """The way from one terminal to another: one message at a time.

    Attributes
    ----------
    message : on its way, None: the channel is free
    left : bits of it that have still to come
    missed : frames of it that were not read
    waiting : messages whose last frame is over, with the frames of each that may be read late
    """

    message: Message | None = None
    left: int = 0
    missed: set[int] = field(default_factory=set)
    waiting: list[tuple[Message, set[int]]] = field(default_factory=list)

    def send(self, message: Message) -> None:
        """Put a message on its way; its first frame is the next."""
        self.message, self.left, self.missed = message, message.bits, set()

    def carry(self, frame: int, capacity: int, read: bool) -> tuple[Message, bool] | None:
        """Let a frame pass that holds `capacity` bits for it and was `read` or not: the message if
        this was its last frame, and whether it arrived."""
        if self.message is None or capacity <= 0:
            return None
        self.left -= capacity
        if not read:
            self.missed.add(frame)
        if self.left > 0:
            return None
        message, self.message = self.message, None
        self.waiting = [(m, f) for m, f in self.waiting if min(f) > frame - BATCH]
        if self.missed:
            self.waiting.append((message, self.missed))
        return message, not self.missed

    def late(self, frame: int) -> list[Message]:
        """Messages, whole only now that a frame was read which had passed unread."""
        self.missed.discard(frame)
        for _, missed in self.waiting:
            missed.discard(frame)
        whole = [message for message, missed in self.waiting if not missed]
        self.waiting = [(message, missed) for message, missed in self.waiting if missed]
        return whole


@dataclass
class Notes(Stateful):
    """Knowledge of a terminal, its own and of others, and what it has reported to whom.

    Attributes
    ----------
    name : of the terminal
    detections : those of the last `HOLD_S` by track and time, and by whom each was said ("": its
        own)
    kept : by link the confirmed tracks of its receiver
    since : times when its own tracks were confirmed [s]
    terminals : what they said of themselves
    reported_to : by listener the time of each track's detection that went there last [s]
    names : by which it knows the UAV of each track
    """

    name: str
    detections: dict[tuple[Key, float], tuple[Detection, str]] = field(default_factory=dict)
    kept: dict[str, TrackNumbers] = field(default_factory=dict)
    since: dict[Key, float] = field(default_factory=dict)
    terminals: dict[str, SelfReport] = field(default_factory=dict)
    reported_to: dict[str, dict[Key, float]] = field(default_factory=dict)
    names: dict[Key, Name] = field(default_factory=dict)

    def observe(
        self, origin: str, time: float, found: Iterable[Detection], confirmed: Iterable[int]
    ) -> None:
        """Take down what the tracks of one of its own links detected in a frame, tentative ones
        too, and which of them are confirmed."""
        self.kept[origin] = TrackNumbers(time, tuple(confirmed))
        for number in self.kept[origin].numbers:
            key = Key(origin, number)
            self.names.setdefault(key, Name(self.since.setdefault(key, time), *key))
        self.detections |= {(d.key, d.time): (d, "") for d in found}

    def receive(self, message: Message) -> None:
        """Take down what is newer than what it knows."""
        sender = message.sender
        for name, own_report in message.terminals.items():
            if name != self.name and _newer(own_report, self.terminals.get(name)):
                self.terminals[name] = replace(own_report, via=sender)
        for origin, kept in message.kept.items():
            if _newer(kept, self.kept.get(origin)):
                self.kept[origin] = replace(kept, via=sender)
        for d in message.detections:
            self.detections.setdefault((d.key, d.time), (d, sender))

    def forget(self, time: float) -> None:
        """Forget what was not said again for `HOLD_S`."""
        self.detections = {k: d for k, d in self.detections.items() if time - k[1] <= HOLD_S}
        self.kept = {k: t for k, t in self.kept.items() if time - t.time <= HOLD_S}
        self.terminals = {k: s for k, s in self.terminals.items() if time - s.time <= HOLD_S}

    def of_tracks(self) -> tuple[set[Key], list[Detection]]:
        """Return the confirmed tracks, and their detections by the names that it knows."""
        keys = {Key(origin, n) for origin, kept in self.kept.items() for n in kept.numbers}
        return keys, [
            d._replace(since=self.since.get(d.key, d.since), name=self.names.get(d.key, d.name))
            for d, _ in self.detections.values()
            if d.key in keys
        ]

    def compose(self, listener: str, capacity: int) -> Message:
        """Compose the message to a listener over a channel of `capacity` bits a frame: nothing that
        came from there, of each track the newest detection first, and first the tracks that were
        not reported for longest. One frame's fill, but one detection at least."""
        reported_to = self.reported_to.setdefault(listener, {})
        message = Message(
            self.name,
            {k: s for k, s in self.terminals.items() if listener not in (k, s.via)},
            {k: s for k, s in self.kept.items() if s.via != listener},
            [],
        )
        found: dict[Key, list[Detection]] = {}
        for d in sorted(self.of_tracks()[1], key=lambda d: -d.time):
            if self.detections[d.key, d.time][1] != listener:
                found.setdefault(d.key, []).append(d)
        ranked = [
            (d.time <= reported_to.get(key, -1.0), rank, reported_to.get(key, -1.0), key, d)
            for key, all_of in found.items()
            for rank, d in enumerate(all_of)
        ]
        room = ceil(message.bits / capacity) * capacity
        for again, *_, key, d in sorted(ranked, key=lambda r: r[:4]):
            longer = replace(message, detections=[*message.detections, d])
            if longer.bits <= room or not (message.detections or again):
                message = longer
                reported_to[key] = max(reported_to.get(key, -1.0), d.time)
        new = {key for again, *_, key, _ in ranked if not again}
        told = {d.key for d in message.detections}
        return replace(message, left_out=len(new - told))

    def ages(self, time: float) -> tuple[float, ...]:
        """Return the ages of the newest detection of each track that others reported [s]."""
        newest: dict[Key, float] = {}
        for (key, at), (_, via) in self.detections.items():
            if via:
                newest[key] = max(at, newest.get(key, at))
        return tuple(time - at for at in newest.values())


def _newer(report: SelfReport | TrackNumbers, known: SelfReport | TrackNumbers | None) -> bool:
    """Return whether a report is newer than what is known."""
    return known is None or report.time > known.time
