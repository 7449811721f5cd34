"""Terminals of a run: the receiver of each link with its scores, and sets of receivers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.receive.settings import Receivers
from isac_rt.registry import extension
from isac_rt.results.metrics import SymbolCount
from isac_rt.results.recorder import Recorder
from isac_rt.results.records import FrameRecord, FusedRecord, LateRecord, ObserverRecord
from isac_rt.results.scoring import LinkResult, Scorer
from isac_rt.results.swarm import SwarmScorer, View
from isac_rt.scenario.presets import ReceiverSet
from isac_rt.simulation.setup import Frame, Setup
from isac_rt.track.parts import Late, ReportedUav
from isac_rt.track.reference import TerminalState
from isac_rt.track.terminal import ActiveTerminal, PassiveTerminal, Receiver
from isac_rt.world.swarm import Pose, Swarm

PREFETCHED_FRAMES = 2
"""Frames that are processed at once, so that none waits for the slowest link of the one before;
reports reach a receiver this many frames late."""
Terminal = ActiveTerminal | PassiveTerminal


def standard_terminal(setup: Setup, link: Link, settings: ReceiverSet | None = None) -> Terminal:
    """Return the receiver of a link by the settings of the scenario, or of a compared set.

    Examples
    --------
    >>> import isac_rt as irt
    >>> setup = irt.prepare(irt.load("scenes/paper_swarm_consistent.yaml"))
    >>> [type(standard_terminal(setup, link)).__name__ for link in setup.timetable.links(0)]
    ['ActiveTerminal', 'PassiveTerminal', 'PassiveTerminal']
    """
    setup = setup.of(link.tx)
    s = settings or setup.scenario
    equipment = extension("equipment")(setup, link, s)
    settings_of = setup.waveform, setup.arrays.at(link), s.receivers, s.tracking
    if link.own:
        return ActiveTerminal(*settings_of, equipment)
    order, groups = setup.scenario.modulation.dpsk_order, setup.timetable.groups(link)
    return PassiveTerminal(*settings_of, order, setup.plan.amplitudes[link.tx], groups, equipment)


def terminal_with(setup: Setup, link: Link, made: Terminal | Receiver) -> Terminal:
    """Return `made` if it is a terminal, or the scenario's terminal with `made` as its receiver.

    Raises
    ------
    TypeError  If `made` has no `receive`.
    """
    if isinstance(made, ActiveTerminal | PassiveTerminal):
        return made
    if not isinstance(made, Receiver):
        raise TypeError(
            f"the terminal of {link} is {type(made).__name__}, which has no receive; return a "
            "terminal or an object with receive"
        )
    out = standard_terminal(setup, link)
    vars(out)["receive"] = made.receive  # in place of the method
    return out


class Station:
    """Receiving terminal of one link with its scores."""

    def __init__(self, setup: Setup, link: Link, terminal: Terminal, receivers: Receivers) -> None:
        self.link, self.setup, self.terminal = link, setup, terminal
        self.scorer = Scorer(link, setup.arrays, setup.swarm, setup.timetable, receivers)
        self.receivers = receivers
        self.feedback = {"answers": 0, "corrections": 0}
        self.seconds = 0.0
        """Processor time of reception and tracking so far."""

    def receive(
        self, frame: Frame, cube: IFCube, maps: bool, reports: Sequence[ReportedUav] = ()
    ) -> LinkResult:
        """Receive one frame and track, with targets reported by other terminals. Runs in a worker
        thread and changes the state of this station only."""
        begun = time.thread_time()
        timetable, (tx, rx) = self.setup.timetable, self.link
        when = timetable.epoch(frame.number, tx)
        pose = self.setup.believed(rx, self.setup.swarm.trajectories[rx].pose(when))
        reported_poses = self._reported_poses(frame.number, when)
        state = int(TerminalState.TRACKING)
        late_frames: tuple[Late, ...] = ()
        if isinstance(self.terminal, ActiveTerminal):
            payload, clutter = frame.sent[tx].payload, frame.expected.get(tx)
            reception, tracks = self.terminal.step(
                cube,
                payload,
                pose,
                when,
                clutter=clutter,
                reported_poses=reported_poses,
                reports=reports,
                maps=maps,
            )
        else:
            modulated = timetable.modulated(frame.number)
            reception, tracks = self.terminal.step(
                cube,
                pose,
                when,
                modulated,
                reported_poses=reported_poses,
                sender=self._sender(when),
                reports=reports,
                maps=maps,
            )
            state, late_frames = int(self.terminal.status), self.terminal.late
        self.seconds += time.thread_time() - begun
        return LinkResult(reception, tracks, state, late_frames)

    def _sender(self, when: float) -> Pose | None:
        """Return the reported pose of the link's transmitter; None without a report."""
        s = self.setup
        if s.scenario.cooperation == "none":
            return None
        return s.believed(self.link.tx, s.swarm.trajectories[self.link.tx].pose(when))

    def _reported_poses(self, frame: int, when: float) -> list[Pose]:
        """Return the reported poses that self-calibration uses: that of the transmitter, or at an
        active terminal those of all passive ones."""
        s = self.setup
        if self.receivers.self_calibration != "positions":
            return []
        tx, rx = self.link
        names = s.timetable.with_role("passive", frame) if self.link.own else [tx]
        return [s.believed(n, s.swarm.trajectories[n].pose(when)) for n in names if n != rx]

    def feed_back(self, frame: int, received: LinkResult, at_active: LinkResult) -> None:
        """Exchange a passive terminal's feedback after a frame and the active one's answer."""
        if not isinstance(self.terminal, PassiveTerminal):
            return
        s, when = self.setup, self.setup.timetable.epoch(frame, self.link.tx)
        answer = extension("feedback")(
            received.reception,
            received.tracks,
            at_active.tracks,
            s.arrays.of(self.link.rx).num_rx,
            s.connections.offset_std(self.link, when),
            s.waveform,
        )
        if answer is not None:
            self.feedback["answers"] += 1
            self.feedback["corrections"] += answer.cells != 0
            if answer.cells:
                self.terminal.shorten(answer.cells, s.swarm.trajectories[self.link.rx].pose(when))

    def memory(self, carried: dict[str, Any] | None) -> dict[str, Any]:
        """Return the state after a frame as plain numbers and arrays, for `restore`; `carried` is
        the terminal's part if it already works on a later frame."""
        return {
            "terminal": self.terminal.memory() if carried is None else carried,
            "scorer": self.scorer.memory(),
            "feedback": self.feedback,
            "seconds": self.seconds,
        }

    def restore(self, memory: dict[str, Any]) -> None:
        """Restore a state of `memory`."""
        self.terminal.restore(memory["terminal"])
        self.scorer.restore(memory["scorer"])
        self.feedback, self.seconds = memory["feedback"], memory["seconds"]

    def record(self, frame: Frame, received: LinkResult) -> ObserverRecord:
        """Compare the frame with the truth."""
        paths, sent = frame.paths[self.link], frame.sent[self.link.tx]
        noise, parts = frame.noise_power(self.link), frame.parts(self.link)
        return self.scorer.record(frame.number, paths, sent, received, noise, parts)


class Exchange(Protocol):
    """Exchange of reports between the terminals of one set of receivers."""

    def step(
        self,
        frame: int,
        received: Mapping[Link, LinkResult],
        symbols: Mapping[Link, SymbolCount],
        late: Mapping[Link, Sequence[LateRecord]],
    ) -> dict[str, View]:
        """Return the fused tracks after a frame, by terminal and of all together (`SWARM`)."""
        ...

    def reports(self, link: Link, frame: int, time: float) -> list[ReportedUav]:
        """Return the reported targets of a link's receiver after a frame, at a time [s]."""
        ...

    def memory(self) -> dict[str, Any]:
        """Return the state after a frame, for `restore`."""
        ...

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on from a `memory`."""
        ...


@dataclass
class StationSet:
    """One set of receivers: the station of each link, the exchange of reports, and the records."""

    stations: dict[Link, Station]
    recorder: Recorder
    swarm: Swarm
    exchange: Exchange | None
    fused: SwarmScorer

    @classmethod
    def of(
        cls, setup: Setup, terminal: Callable[[Link], Terminal], receivers: Receivers
    ) -> StationSet:
        """Build the set before the first frame; `receivers` are the settings of the terminals."""
        timetable, cooperation = setup.timetable, setup.scenario.cooperation
        return cls(
            {
                link: Station(setup.of(link.tx), link, terminal(link), receivers)
                for link in timetable.all_links
            },
            Recorder(timetable, [state.name.lower() for state in TerminalState]),
            setup.swarm,
            None if cooperation == "none" else extension("cooperation")(setup),
            SwarmScorer(timetable, setup.arrays),
        )

    def reports(self, link: Link, frame: int) -> list[ReportedUav]:
        """Return the reports for a link's receiver in a frame, of `PREFETCHED_FRAMES` before."""
        when = self.recorder.timetable.epoch(frame, link.tx)
        return self.exchange.reports(link, frame - PREFETCHED_FRAMES, when) if self.exchange else []

    def record(self, frame: Frame, received: Mapping[Link, LinkResult], snapshot: bool) -> None:
        """Compare a frame with the truth, and exchange reports after it."""
        timetable, number = self.recorder.timetable, frame.number
        records = {link: self.stations[link].record(frame, h) for link, h in received.items()}
        late_records = {
            link: self.stations[link].scorer.late(number, h) for link, h in received.items()
        }
        fused_records: dict[str, FusedRecord] = {}
        if self.exchange is not None:
            symbols = {link: o.symbols for link, o in records.items()}
            views = self.exchange.step(number, received, symbols, late_records)
            poses = {name: self.swarm.poses(view.time) for name, view in views.items()}
            fused_records = self.fused.record(number, views, records, poses)
        self.recorder.add(
            FrameRecord(
                frame=number,
                time=timetable.epoch(number),
                modulated=timetable.modulated(number),
                poses=frame.poses,
                observers={timetable.labels[link]: o for link, o in records.items()},
                snapshot=snapshot,
                uses=frame.uses,
                dropped=frame.dropped,
                fused_records=fused_records,
            )
        )
        for link, frames in late_records.items():
            for late_record in frames:
                self.recorder.amend(link, late_record)

    def blocks(self) -> dict[str, Any]:
        """Return `terminals`, `links` and `swarm` of the summary."""
        return self.recorder.blocks()

    def costs(self) -> dict[str, float]:
        """Return the processor seconds of reception and tracking by link."""
        return {str(link): o.seconds for link, o in self.stations.items()}

    def memory(self, first: int, carried: Mapping[Link, dict[str, Any]]) -> dict[str, Any]:
        """Return the rows from a frame on, changed earlier rows, and the state of each terminal."""
        recorder, exchange = self.recorder, self.exchange
        return {
            "rows": [recorder.row(i) for i in range(first, len(recorder))],
            "amended": [[i, recorder.row(i)] for i in sorted(recorder.amended) if i < first],
            "stations": {str(k): o.memory(carried.get(k)) for k, o in self.stations.items()},
            "exchange": None if exchange is None else exchange.memory(),
            "fused": self.fused.memory(),
        }

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Restore the states of the terminals."""
        for link, station in self.stations.items():
            station.restore(memory["stations"][str(link)])
        if self.exchange is not None:
            self.exchange.restore(memory["exchange"])
        self.fused.restore(memory["fused"])
