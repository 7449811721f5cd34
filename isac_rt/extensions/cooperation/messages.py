"""Messages between terminals about tracks, and the time that a link takes to carry
them.

An active terminal's messages ride on its data frames, a passive one's go back by its feedback. A
message is made of what its sender knows after a frame and leaves with the next; it takes as many
frames as its bits need and is lost with any of them, until the frame is read late. Nobody waits for
an answer, and nothing is said twice unless it has changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil

from isac_rt.extensions.city_receivers.out_of_sequence import BATCH
from isac_rt.extensions.cooperation.fusion import (
    FusedTracks,
    Report,
    Reported,
    at_once,
    report_of,
)
from isac_rt.plain import Stateful
from isac_rt.track.filter import Gaussian
from isac_rt.track.fused import Fused, Key, Name

HEADER_BITS = 64
"""Sender, time, length and checksum of a message."""
TERMINAL_BITS = 16 + 3 * 24 + 3 * 16
"""What is said of a terminal itself: age, position to a centimetre, velocity to a millimetre a
second."""
NUMBER_BITS = 16
"""One of the numbers of the tracks that a terminal keeps."""
REPORT_BITS = 8 + 16 + 16 + 40 + 120 + 6 * 16 + 15 * 8 + 8
"""A track: whose, number, age, name, mean (24 bits of each position, 16 of each velocity),
deviations and correlations, and how far the clock moves it; what the errors of the pose do follows
from the terminal's own place. What these bits round off is not modelled: a centimetre and less."""
CODE_RATE = 0.5
"""Share of an active terminal's bits that messages get; the rest protects them."""
CORRECTED = 0.05
"""Largest share of a frame's bits wrong that such a code corrects: hard decisions at rate 1/2 reach
some 0.06 with frames of two thousand bits."""
HOLD_S = 0.5
"""How long something that was said counts without being said again [s]."""


@dataclass(frozen=True)
class TrackNumbers:
    """The numbers of all tracks that a link's receiver kept at a time [s], and by whom they were
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
    reports : of tracks, its own and others'
    left_out : tracks that were new and that it had no room for
    """

    sender: str
    terminals: Mapping[str, SelfReport]
    kept: Mapping[str, TrackNumbers]
    reports: Sequence[Report]
    left_out: int = 0

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
    """Tracks that a terminal knows from itself and from others, and what it has reported to whom.

    Attributes
    ----------
    name : of the terminal
    reports : the latest of every track, and by whom each was said ("": its own)
    kept : by link the tracks that its receiver keeps
    terminals : what they said of themselves
    reported_to : by listener the time of each track's report that went there last [s]
    fused_tracks : what it makes of all this
    """

    name: str
    reports: dict[Key, tuple[Report, str]] = field(default_factory=dict)
    kept: dict[str, TrackNumbers] = field(default_factory=dict)
    terminals: dict[str, SelfReport] = field(default_factory=dict)
    reported_to: dict[str, dict[Key, float]] = field(default_factory=dict)
    fused_tracks: FusedTracks = field(default_factory=FusedTracks)

    def observe(self, origin: str, time: float, tracks: Mapping[int, Reported]) -> None:
        """Take down the tracks of one of its own links after a frame, by their numbers; tracks that
        were there before have begun before."""
        mine = [key for key in self.reports if key.origin == origin]
        before = {key: self.reports.pop(key)[0] for key in mine}
        for number, (state, lever) in tracks.items():
            key = Key(origin, number)
            since = before[key].since if key in before else time
            name = before[key].name if key in before else Name(since, *key)
            self.reports[key] = Report(key, since, name, time, state, lever), ""
        self.kept[origin] = TrackNumbers(time, tuple(tracks))

    def locate(self, time: float, state: Gaussian) -> None:
        """Take down where it is itself."""
        self.terminals[self.name] = SelfReport(time, state)

    def receive(self, message: Message) -> None:
        """Take down what is newer than what it knows."""
        sender = message.sender
        for name, own_report in message.terminals.items():
            if name != self.name and self._newer(own_report.time, self.terminals.get(name)):
                self.terminals[name] = replace(own_report, via=sender)
        for origin, kept in message.kept.items():
            if self._newer(kept.time, self.kept.get(origin)):
                self.kept[origin] = replace(kept, via=sender)
        for report in message.reports:
            known = self.reports.get(report.key)
            if self._newer(report.time, None if known is None else known[0]):
                self.reports[report.key] = report, sender

    @staticmethod
    def _newer(time: float, known: SelfReport | TrackNumbers | Report | None) -> bool:
        return known is None or time > known.time

    def fuse(self, time: float, acceleration_std: float) -> list[Fused]:
        """Return the fused tracks at a time [s], after forgetting what has ended or was not said
        for `HOLD_S`."""
        self.reports = {k: r for k, r in self.reports.items() if self._counts(r[0], time)}
        self.terminals = {k: s for k, s in self.terminals.items() if time - s.time <= HOLD_S}
        fused = self.fused_tracks.update(
            at_once((report for report, _ in self.reports.values()), time, acceleration_std),
            {
                name: report_of(own_report.state).after(time - own_report.time, acceleration_std)
                for name, own_report in self.terminals.items()
            },
        )
        for uav in fused:
            for key in uav.members:
                report, via = self.reports[key]
                if report.name != uav.name:
                    self.reports[key] = replace(report, name=uav.name), via
        return fused

    def _counts(self, report: Report, time: float) -> bool:
        kept = self.kept.get(report.key.origin)
        ended = (
            kept is not None and kept.time >= report.time and report.key.number not in kept.numbers
        )
        return not ended and time - report.time <= HOLD_S

    def compose(self, listener: str, capacity: int) -> Message:
        """Compose the message to a listener over a channel of `capacity` bits a frame: nothing that
        came from there, and first the tracks that were not reported for longest. One frame's fill,
        but one track at least."""
        reported_to = self.reported_to.setdefault(listener, {})
        bare = Message(
            self.name,
            {k: s for k, s in self.terminals.items() if listener not in (k, s.via)},
            {k: s for k, s in self.kept.items() if s.via != listener},
            [],
        )
        new = [
            report
            for report, via in self.reports.values()
            if via != listener and report.time > reported_to.get(report.key, -1.0)
        ]
        new.sort(key=lambda report: (reported_to.get(report.key, -1.0), report.key))
        capacity_left = ceil(bare.bits / capacity) * capacity - bare.bits
        chosen = new[: max(1, capacity_left // REPORT_BITS)]
        reported_to |= {report.key: report.time for report in chosen}
        return replace(bare, reports=chosen, left_out=len(new) - len(chosen))

    def ages(self, time: float) -> tuple[float, ...]:
        """Return the ages of what others reported and is still valid [s]."""
        return tuple(time - report.time for report, via in self.reports.values() if via)
