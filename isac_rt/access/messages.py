"""What terminals tell each other of what they see, and how long a link takes to carry it.

An active terminal's messages ride on its data frames, a passive one's go back by its feedback. A
message is made of what its sender knows after a frame and leaves with the next; it takes as many
frames as its bits need and is lost with any of them. Nobody waits for an answer, and nothing is
said twice unless it has changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any

from isac_rt.terminal.filter import Gaussian
from isac_rt.terminal.fusion import Fused, Key, Name, Picture, Report, advance

HEADER_BITS = 64
"""Sender, time, length and checksum of a message."""
TERMINAL_BITS = 16 + 3 * 24 + 3 * 16
"""What is said of a terminal itself: age, position to a centimetre, velocity to a millimetre a
second."""
NUMBER_BITS = 16
"""One of the numbers of the tracks that a terminal keeps."""
REPORT_BITS = 8 + 16 + 16 + 40 + 120 + 6 * 16 + 15 * 8
"""A track: whose, number, age, name, mean (24 bits of each position, 16 of each velocity),
deviations and correlations. What these bits round off is not modelled: a centimetre and less."""
CODE_RATE = 0.5
"""Share of an active terminal's bits that messages get; the rest protects them."""
CORRECTED = 0.05
"""Largest share of a frame's bits wrong that such a code corrects: hard decisions at rate 1/2 reach
some 0.06 with frames of two thousand bits."""
HOLD_S = 0.5
"""How long something that was said counts without being said again [s]."""


@dataclass(frozen=True)
class Kept:
    """The numbers of all tracks that a link's receiver kept at a time [s], and by whom they were
    said: "" by the terminal itself."""

    time: float
    numbers: tuple[int, ...]
    via: str = ""


@dataclass(frozen=True)
class Said:
    """What a terminal said of its own position and velocity (6,) at a time [s]."""

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
    reports : of tracks, its own and others'
    """

    sender: str
    terminals: Mapping[str, Said]
    kept: Mapping[str, Kept]
    reports: Sequence[Report]

    @property
    def bits(self) -> int:
        """Its length."""
        numbers = sum(len(kept.numbers) for kept in self.kept.values())
        return (
            HEADER_BITS
            + TERMINAL_BITS * len(self.terminals)
            + NUMBER_BITS * numbers
            + REPORT_BITS * len(self.reports)
        )

    def memory(self) -> list[Any]:
        """As plain numbers and arrays, for `of_memory`."""
        return [
            self.sender,
            {k: [s.time, list(s.state), s.via] for k, s in self.terminals.items()},
            {k: [s.time, list(s.numbers), s.via] for k, s in self.kept.items()},
            [report.memory() for report in self.reports],
        ]

    @classmethod
    def of_memory(cls, memory: Sequence[Any]) -> Message:
        """The message that gave a `memory`."""
        sender, terminals, kept, reports = memory
        return cls(
            sender,
            {k: Said(time, Gaussian(*state), via) for k, (time, state, via) in terminals.items()},
            {k: Kept(time, tuple(numbers), via) for k, (time, numbers, via) in kept.items()},
            [Report.of_memory(report) for report in reports],
        )


class Channel:
    """The way from one terminal to another: one message at a time.

    Attributes
    ----------
    message : on its way, None: the channel is free
    """

    def __init__(self) -> None:
        self.message: Message | None = None
        self._left, self._whole = 0, True

    def send(self, message: Message) -> None:
        """Put a message on its way; its first frame is the next."""
        self.message, self._left, self._whole = message, message.bits, True

    def carry(self, capacity: int, read: bool) -> tuple[Message, bool] | None:
        """Let a frame pass that holds `capacity` bits for it and was `read` or not: the message if
        this was its last frame, and whether it arrived."""
        if self.message is None or capacity <= 0:
            return None
        self._left -= capacity
        self._whole &= read
        if self._left > 0:
            return None
        message, self.message = self.message, None
        return message, self._whole

    def memory(self) -> list[Any]:
        """What is on its way as plain numbers and arrays, for `restore`."""
        message = None if self.message is None else self.message.memory()
        return [message, self._left, self._whole]

    def restore(self, memory: Sequence[Any]) -> None:
        """Go on from a `memory`."""
        message, self._left, self._whole = memory
        self.message = None if message is None else Message.of_memory(message)


@dataclass
class Notes:
    """What a terminal knows from itself and from others, and what it has told whom.

    Attributes
    ----------
    name : of the terminal
    reports : the latest of every track, and by whom each was said ("": its own)
    kept : by link the tracks that its receiver keeps
    terminals : what they said of themselves
    told : by listener the time of each track's report that went there last [s]
    picture : what it makes of all this
    """

    name: str
    reports: dict[Key, tuple[Report, str]] = field(default_factory=dict)
    kept: dict[str, Kept] = field(default_factory=dict)
    terminals: dict[str, Said] = field(default_factory=dict)
    told: dict[str, dict[Key, float]] = field(default_factory=dict)
    picture: Picture = field(default_factory=Picture)

    def see(self, origin: str, time: float, tracks: Mapping[int, Gaussian]) -> None:
        """Take down the tracks of one of its own links after a frame, by their numbers; tracks that
        were there before have begun before."""
        mine = [key for key in self.reports if key.origin == origin]
        before = {key: self.reports.pop(key)[0] for key in mine}
        for number, state in tracks.items():
            key = Key(origin, number)
            since = before[key].since if key in before else time
            name = before[key].name if key in before else Name(since, *key)
            self.reports[key] = Report(key, since, name, time, state), ""
        self.kept[origin] = Kept(time, tuple(tracks))

    def stand(self, time: float, state: Gaussian) -> None:
        """Take down where it is itself."""
        self.terminals[self.name] = Said(time, state)

    def hear(self, message: Message) -> None:
        """Take down what is newer than what it knows."""
        sender = message.sender
        for name, said in message.terminals.items():
            if name != self.name and self._newer(said.time, self.terminals.get(name)):
                self.terminals[name] = replace(said, via=sender)
        for origin, kept in message.kept.items():
            if self._newer(kept.time, self.kept.get(origin)):
                self.kept[origin] = replace(kept, via=sender)
        for report in message.reports:
            known = self.reports.get(report.key)
            if self._newer(report.time, None if known is None else known[0]):
                self.reports[report.key] = report, sender

    @staticmethod
    def _newer(time: float, known: Said | Kept | Report | None) -> bool:
        return known is None or time > known.time

    def look(self, time: float, acceleration_std: float) -> list[Fused]:
        """Its picture at a time [s], after forgetting what has ended or was not said for
        `HOLD_S`."""
        self.reports = {k: r for k, r in self.reports.items() if self._counts(r[0], time)}
        self.terminals = {k: s for k, s in self.terminals.items() if time - s.time <= HOLD_S}
        fused = self.picture.update(
            [report.at(time, acceleration_std) for report, _ in self.reports.values()],
            {
                name: advance(said.state, time - said.time, acceleration_std)
                for name, said in self.terminals.items()
            },
        )
        for body in fused:
            for key in body.members:
                report, via = self.reports[key]
                self.reports[key] = replace(report, name=body.name), via
        return fused

    def _counts(self, report: Report, time: float) -> bool:
        kept = self.kept.get(report.key.origin)
        ended = (
            kept is not None and kept.time >= report.time and report.key.number not in kept.numbers
        )
        return not ended and time - report.time <= HOLD_S

    def compose(self, listener: str, capacity: int) -> Message:
        """What it tells a listener by a channel of `capacity` bits a frame: not what came from
        there, and of the tracks those first that were not told for longest. One frame's fill, but
        one track at least."""
        told = self.told.setdefault(listener, {})
        bare = Message(
            self.name,
            {k: s for k, s in self.terminals.items() if listener not in (k, s.via)},
            {k: s for k, s in self.kept.items() if s.via != listener},
            [],
        )
        new = [
            report
            for report, via in self.reports.values()
            if via != listener and report.time > told.get(report.key, -1.0)
        ]
        new.sort(key=lambda report: (told.get(report.key, -1.0), report.key))
        room = ceil(bare.bits / capacity) * capacity - bare.bits
        chosen = new[: max(1, room // REPORT_BITS)]
        told |= {report.key: report.time for report in chosen}
        return replace(bare, reports=chosen)

    def memory(self) -> dict[str, Any]:
        """What is known as plain numbers and arrays, for `restore`."""
        message = Message(
            self.name, self.terminals, self.kept, [report for report, _ in self.reports.values()]
        )
        return {
            "known": message.memory(),
            "via": [via for _, via in self.reports.values()],
            "told": {
                listener: [[*key, time] for key, time in times.items()]
                for listener, times in self.told.items()
            },
            "picture": self.picture.memory(),
        }

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on from a `memory`."""
        known = Message.of_memory(memory["known"])
        self.terminals, self.kept = dict(known.terminals), dict(known.kept)
        pairs = zip(known.reports, memory["via"], strict=True)
        self.reports = {report.key: (report, via) for report, via in pairs}
        self.told = {
            listener: {Key(origin, number): time for origin, number, time in times}
            for listener, times in memory["told"].items()
        }
        self.picture.restore(memory["picture"])
