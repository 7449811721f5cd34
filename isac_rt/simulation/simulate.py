"""run(scenario) -> Results: the one place where the stages meet. No physics here."""

from __future__ import annotations

import json
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

from threadpoolctl import threadpool_limits

from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.plain import plain, restored
from isac_rt.receive.settings import Receivers
from isac_rt.registry import ACCESS, COOPERATIONS, EQUIPMENT
from isac_rt.results.metrics import SymbolCount
from isac_rt.results.provenance import provenance
from isac_rt.results.recorder import Figures, Recorder, Results
from isac_rt.results.records import FrameRecord, LateRecord, ObserverRecord, PictureRecord
from isac_rt.results.scoring import Heard, Scorer
from isac_rt.results.swarm import SwarmScorer, View
from isac_rt.runtime import tracing_in_one_thread
from isac_rt.scenario.presets import ReceiverSet
from isac_rt.scenario.tree import OWN, Scenario
from isac_rt.simulation.fall_back import Schedules
from isac_rt.simulation.plan import decisions, extent, mechanisms
from isac_rt.simulation.preflight import receivers_at_work
from isac_rt.simulation.resume import Resume
from isac_rt.simulation.setup import Frame, Setup, link_budgets, prepare
from isac_rt.simulation.stopwatch import Stopwatch
from isac_rt.track.parts import Equipment, KnownBody, Late
from isac_rt.track.reference import TerminalState
from isac_rt.track.terminal import ActiveTerminal, PassiveTerminal, Receiver
from isac_rt.world.swarm import Pose

_LOG = logging.getLogger(__name__)
PREFETCHED_FRAMES = 2
"""Frames at work at once: a frame does not wait for the slowest link of the one before, and its
receivers know what was reported to them until this many frames before it."""
Progress = Callable[[int, int], None]
Terminal = ActiveTerminal | PassiveTerminal
Jobs = dict[Link, Future[list[Heard]]]
Carried = dict[Link, Future[list[dict[str, Any]]]]


def standard_terminal(setup: Setup, link: Link, settings: ReceiverSet | None = None) -> Terminal:
    """The receiver of a link as the scenario has it, or as a set of receivers to compare with.

    Examples
    --------
    >>> import isac_rt as irt
    >>> setup = irt.prepare(irt.load("scenes/paper_swarm_consistent.yaml"))
    >>> [type(standard_terminal(setup, link)).__name__ for link in setup.timetable.links(0)]
    ['ActiveTerminal', 'PassiveTerminal', 'PassiveTerminal']
    """
    s = settings or setup.scenario
    equipment = EQUIPMENT.load("city")(setup, link, s) if _knows_city(s) else Equipment()
    known = setup.waveform, setup.antennas, s.receivers, s.tracking
    if link.own:
        return ActiveTerminal(*known, equipment)
    order, groups = setup.scenario.modulation.dpsk_order, setup.timetable.groups(link)
    return PassiveTerminal(*known, order, setup.plan.amplitude, groups, equipment)


def _knows_city(s: ReceiverSet | Scenario) -> bool:
    """Return whether terminals have more than a receiver and a tracker."""
    r = s.receivers
    return (
        s.tracking.births == "unexplained"
        or r.link_acquisition == "blind"
        or r.self_calibration != "none"
        or r.passive_detector == "beams"
        or r.gate_false_alarm_rate is not None
    )


def terminal_with(setup: Setup, link: Link, made: Terminal | Receiver) -> Terminal:
    """A terminal as it is, or the scenario's own with `made` as its receiver.

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
    out.other = made
    return out


class _Observer:
    """One link's receiving terminal with its score."""

    def __init__(self, setup: Setup, link: Link, terminal: Terminal, receivers: Receivers) -> None:
        self.link, self.setup, self.terminal = link, setup, terminal
        self.scorer = Scorer(link, setup.antennas, setup.swarm, setup.timetable, receivers)
        self.receivers = receivers
        self.feedback = {"answers": 0, "corrections": 0}
        self.seconds = 0.0
        """Processor time of reception and tracking so far."""

    def hear(
        self,
        frame: Frame,
        cube: IFCube,
        maps: bool,
        told: Sequence[KnownBody] = (),
    ) -> Heard:
        """Reception and tracking of one frame; `told` are the bodies that the receiver knows of
        from others. Runs in a thread of its own; only this observer's state changes."""
        begun = time.thread_time()
        timetable, (tx, rx) = self.setup.timetable, self.link
        when = timetable.epoch(frame.number, tx)
        own = self.setup.believed(self.setup.swarm.trajectories[rx].pose(when))
        mates = self._mates(frame.number, when)
        state = int(TerminalState.TRACKING)
        late: tuple[Late, ...] = ()
        if isinstance(self.terminal, ActiveTerminal):
            payload, clutter = frame.sent[tx].payload, frame.expected.get(tx)
            reception, tracks = self.terminal.step(
                cube, payload, own, when, clutter=clutter, mates=mates, told=told, maps=maps
            )
        else:
            modulated = timetable.modulated(frame.number)
            reception, tracks = self.terminal.step(
                cube,
                own,
                when,
                modulated,
                mates=mates,
                sender=self._sender(when),
                told=told,
                maps=maps,
            )
            state, late = int(self.terminal.status), self.terminal.late
        self.seconds += time.thread_time() - begun
        return Heard(reception, tracks, state, late)

    def _sender(self, when: float) -> Pose | None:
        """Where the link's transmitter says with its data that it is; None: it says nothing."""
        s = self.setup
        if s.scenario.cooperation == "none":
            return None
        return s.believed(s.swarm.trajectories[self.link.tx].pose(when))

    def _mates(self, frame: int, when: float) -> list[Pose]:
        """Where the other end of the link, or at an active terminal those of all links, say that
        they are, as far as the receiver asks."""
        s = self.setup
        if self.receivers.self_calibration != "positions":
            return []
        tx, rx = self.link
        names = s.timetable.with_role("passive", frame) if self.link.own else [tx]
        return [s.believed(s.swarm.trajectories[name].pose(when)) for name in names if name != rx]

    def feed_back(self, frame: int, heard: Heard, at_active: Heard) -> None:
        """The passive terminal's feedback after a frame, and the active one's answer to it."""
        if not isinstance(self.terminal, PassiveTerminal):
            return
        s, when = self.setup, self.setup.timetable.epoch(frame, self.link.tx)
        answer = ACCESS.load("feedback")(
            heard.reception,
            heard.tracks,
            at_active.tracks,
            s.antennas.num_rx,
            s.connections.offset_std(self.link, when),
            s.waveform,
        )
        if answer is not None:
            self.feedback["answers"] += 1
            self.feedback["corrections"] += answer.cells != 0
            if answer.cells:
                self.terminal.shorten(answer.cells, s.swarm.trajectories[self.link.rx].pose(when))

    def memory(self, carried: dict[str, Any] | None) -> dict[str, Any]:
        """Return the state carried over to the next frame as plain numbers and arrays, for
        `restore`; `carried` is the terminal's part of it where that is at work on a later frame."""
        return {
            "terminal": self.terminal.memory() if carried is None else carried,
            "scorer": self.scorer.memory(),
            "feedback": self.feedback,
            "seconds": self.seconds,
        }

    def restore(self, memory: dict[str, Any]) -> None:
        """Go on from a `memory`."""
        self.terminal.restore(memory["terminal"])
        self.scorer.restore(memory["scorer"])
        self.feedback, self.seconds = memory["feedback"], memory["seconds"]

    def record(self, frame: Frame, heard: Heard) -> ObserverRecord:
        """The frame held against the truth."""
        paths, sent = frame.paths[self.link], frame.sent[self.link.tx]
        return self.scorer.record(frame.number, paths, sent, heard, frame.noise_power(self.link))


class Exchange(Protocol):
    """Exchange of reports between the terminals of one set of receivers."""

    def step(
        self,
        frame: int,
        heard: Mapping[Link, Heard],
        symbols: Mapping[Link, SymbolCount],
        late: Mapping[Link, Sequence[LateRecord]],
    ) -> dict[str, View]:
        """Return the fused tracks after a frame, by terminal and of all together (`SWARM`)."""
        ...

    def told(self, link: Link, frame: int, time: float) -> list[KnownBody]:
        """Return the targets that a link's receiver knew of after a frame, at a time [s]."""
        ...

    def memory(self) -> dict[str, Any]:
        """Return the state carried over to the next frame, for `restore`."""
        ...

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on from a `memory`."""
        ...


class _Swarm:
    """Exchange between the terminals of a set of receivers, with its score."""

    def __init__(self, setup: Setup) -> None:
        self._swarm = setup.swarm
        make = COOPERATIONS.load(setup.scenario.cooperation)
        self._cooperation: Exchange = make(setup)
        self._scorer = SwarmScorer(setup.timetable)

    def step(
        self,
        frame: Frame,
        heard: Mapping[Link, Heard],
        records: Mapping[Link, ObserverRecord],
        late: Mapping[Link, Sequence[LateRecord]],
    ) -> dict[str, PictureRecord]:
        """The pictures after a frame, held against the truth."""
        views = self._cooperation.step(
            frame.number, heard, {link: o.symbols for link, o in records.items()}, late
        )
        poses = {name: self._swarm.poses(view.time) for name, view in views.items()}
        return self._scorer.record(frame.number, views, records, poses)

    def told(self, link: Link, frame: int, time: float) -> list[KnownBody]:
        """As `Cooperation.told`."""
        return self._cooperation.told(link, frame, time)

    def memory(self) -> dict[str, Any]:
        """Return the state carried over to the next frame as plain numbers and arrays, for
        `restore`."""
        return {"talk": self._cooperation.memory(), "scorer": self._scorer.memory()}

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on from a `memory`."""
        self._cooperation.restore(memory["talk"])
        self._scorer.restore(memory["scorer"])


@dataclass
class _Listeners:
    """One set of receivers: every link's terminal with its score, what they tell each other, and
    what is recorded of them."""

    observers: dict[Link, _Observer]
    recorder: Recorder
    swarm: _Swarm | None

    @classmethod
    def of(
        cls,
        setup: Setup,
        terminal: Callable[[Link], Terminal],
        receivers: Receivers,
    ) -> _Listeners:
        """Before the first frame; `receivers` are the settings that the terminals have."""
        links = setup.timetable.all_links
        return cls(
            {link: _Observer(setup, link, terminal(link), receivers) for link in links},
            Recorder(setup.timetable, [state.name.lower() for state in TerminalState]),
            None if setup.scenario.cooperation == "none" else _Swarm(setup),
        )

    def told(self, link: Link, frame: int) -> list[KnownBody]:
        """Return what the link's receiver knows from others in a frame: what it knew
        `PREFETCHED_FRAMES` frames before, so that no frame waits for the one before."""
        when = self.recorder.timetable.epoch(frame, link.tx)
        return self.swarm.told(link, frame - PREFETCHED_FRAMES, when) if self.swarm else []

    def record(self, frame: Frame, heard: Mapping[Link, Heard], snapshot: bool) -> None:
        """Hold a frame against the truth."""
        timetable = self.recorder.timetable
        records = {link: self.observers[link].record(frame, h) for link, h in heard.items()}
        late = {
            link: self.observers[link].scorer.late(frame.number, h) for link, h in heard.items()
        }
        pictures = self.swarm.step(frame, heard, records, late) if self.swarm else {}
        self.recorder.add(
            FrameRecord(
                frame=frame.number,
                time=timetable.epoch(frame.number),
                modulated=timetable.modulated(frame.number),
                poses=frame.poses,
                observers={timetable.labels[link]: o for link, o in records.items()},
                snapshot=snapshot,
                uses=frame.uses,
                dropped=frame.dropped,
                pictures=pictures,
            )
        )
        for link, frames in late.items():
            for one in frames:
                self.recorder.amend(link, one)

    def blocks(self) -> dict[str, Any]:
        """`terminals`, `links` and `swarm` of the summary."""
        return self.recorder.blocks()

    def costs(self) -> dict[str, float]:
        """Processor seconds of reception and tracking by link."""
        return {str(link): o.seconds for link, o in self.observers.items()}

    def memory(self, first: int, carried: Mapping[Link, dict[str, Any]]) -> dict[str, Any]:
        """The rows from a frame on, earlier ones that have changed, and what every terminal carries
        over."""
        recorder, observers = self.recorder, self.observers.items()
        return {
            "rows": [recorder.row(i) for i in range(first, len(recorder))],
            "amended": [[i, recorder.row(i)] for i in sorted(recorder.amended) if i < first],
            "observers": {str(link): o.memory(carried.get(link)) for link, o in observers},
            "swarm": None if self.swarm is None else self.swarm.memory(),
        }

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Take up what the terminals carried over."""
        for link, observer in self.observers.items():
            observer.restore(memory["observers"][str(link)])
        if self.swarm is not None:
            self.swarm.restore(memory["swarm"])


def run(
    scenario: Scenario,
    *,
    progress: Progress | None = None,
    setup: Setup | None = None,
    threads: int | None = None,
    snapshots: int = 3,
    terminal: Callable[[Setup, Link], Terminal | Receiver] = standard_terminal,
    resume: Resume | None = None,
) -> Results:
    """Simulate every frame of a scenario.

    Parameters
    ----------
    scenario : Scenario
    progress : called with the frames done and the frames in all
    setup : from `prepare`, if it is there already
    threads : receivers at work at once; None: one more than the machine has cores
    snapshots : frames, spread over those that the active terminals process, of which maps and path
        ledger are kept
    terminal : makes the receiver of a link: any object with `receive`, which is given what
        `ActiveTerminal.receive` or `PassiveTerminal.receive` is, or a terminal, whose tracking may
        be another too
    resume : where the frames are kept meanwhile and from where a run that was stopped goes on

    Returns
    -------
    Results; the same for one scenario and set of versions whatever the number of threads

    Examples
    --------
    >>> import isac_rt as irt
    >>> results = irt.run(irt.load("scenes/paper_swarm_consistent.yaml", frames=4))
    >>> results.summary["terminals"]["PT1"]["ser_delay"]
    0.0
    """
    run = _Run.begin(scenario, setup, snapshots, terminal)
    run.fly(progress, threads, resume)
    summary = run.summary()
    materials = {m.name: vars(m) for m in run.setup.city.materials}
    attributes = {
        "fidelity": summary["fidelity"],
        "city": summary["city"],
        "materials": {
            name: {key: value for key, value in entry.items() if key != "name"}
            for name, entry in materials.items()
        },
        "link_budget": [vars(row) for row in link_budgets(run.setup)],
        "coverage": asdict(run.setup.coverage),
    }
    dataset = run.recorder.dataset().assign_attrs(
        provenance(scenario) | {name: json.dumps(value) for name, value in attributes.items()}
    )
    return Results(dataset, summary, scenario)


def summarise(
    scenario: Scenario, *, setup: Setup | None = None, threads: int | None = None
) -> dict[str, Any]:
    """The summary of a run (`summary.json`) without its dataset; parameters as for `run`."""
    run = _Run.begin(scenario, setup, 0, standard_terminal)
    run.fly(None, threads, None)
    return run.summary()


class _AtWork(NamedTuple):
    """A frame whose receivers are at work, and if it is to be kept what each carries over right
    after it; what is not there is what it carries once all are done."""

    frame: Frame
    jobs: Jobs
    carried: Carried | None


@dataclass
class _Run:
    """The frames of a run so far, recorded and scored."""

    setup: Setup
    own: _Listeners
    """The scenario's own receivers, the only ones on which anything that is sent depends."""
    compared: dict[str, _Listeners]
    schedules: Schedules
    snapshots: set[int]
    stopwatch: Stopwatch
    kept: int = 0
    """Frames that a later call could go on after."""

    @classmethod
    def begin(
        cls,
        scenario: Scenario,
        setup: Setup | None,
        snapshots: int,
        terminal: Callable[[Setup, Link], Terminal | Receiver],
    ) -> _Run:
        """Before the first frame."""
        s, stopwatch = setup or prepare(scenario), Stopwatch()
        stopwatch.set_up(s.seconds)

        def own(link: Link) -> Terminal:
            return terminal_with(s, link, terminal(s, link))

        compared = {
            name: _Listeners.of(s, partial(standard_terminal, s, settings=one), one.receivers)
            for name, one in scenario.compare.items()
        }
        return cls(
            s,
            _Listeners.of(s, own, scenario.receivers),
            compared,
            Schedules(s.schedule, s.antennas.num_tx, scenario.array.fall_back),
            s.timetable.snapshots(snapshots),
            stopwatch,
        )

    @property
    def recorder(self) -> Recorder:
        """Recorder of the scenario's own receivers."""
        return self.own.recorder

    @property
    def sets(self) -> list[_Listeners]:
        """The scenario's own receivers, then those compared."""
        return [self.own, *self.compared.values()]

    def fly(self, progress: Progress | None, threads: int | None, resume: Resume | None) -> None:
        """Frame after frame; while the receivers work the next ones are traced.

        A link's jobs are done one after the other. Where what is sent depends on what was
        received, a frame waits for all receivers of the one before.
        """
        setup, frames = self.setup, self.setup.timetable.frames
        dependent = setup.scenario.access.feedback or setup.scenario.array.fall_back
        at_work: deque[_AtWork] = deque()
        last: dict[Link, Future[Any]] = {}

        def settle(left: int) -> None:
            """Collect all but so many frames at work, and say so."""
            while len(at_work) > left:
                one = at_work.popleft()
                self.collect(one.frame, one.jobs)
                if resume and one.carried is not None:
                    self.keep(resume, one.carried)
                if progress:
                    progress(len(self.recorder), frames)

        with (
            threadpool_limits(limits=1),
            tracing_in_one_thread(),
            ThreadPoolExecutor(max_workers=threads or receivers_at_work()) as pool,
        ):
            _LOG.info("tracing and receiving the first frame")
            for number in range(self.restore(resume) if resume else 0, frames):
                with self.stopwatch.stage("trace"):
                    frame = setup.frame(number)
                settle(0 if dependent else PREFETCHED_FRAMES - 1)
                frame = frame.sent_by({name: self.schedules.of(name) for name in frame.sent})
                jobs = {}
                for link in setup.timetable.links(number):
                    told = [one.told(link, number) for one in self.sets]
                    jobs[link] = pool.submit(self.hear, frame, link, told, last.get(link))
                last |= jobs
                carried: Carried | None = None
                if resume and resume.due() and number + 1 < frames:
                    links = [] if dependent else setup.timetable.all_links
                    carried = {
                        link: pool.submit(self.carried, link, last.get(link)) for link in links
                    }
                    last |= carried
                at_work.append(_AtWork(frame, jobs, carried))
            settle(0)

    def hear(
        self,
        frame: Frame,
        link: Link,
        told: Sequence[Sequence[KnownBody]],
        before: Future[Any] | None,
    ) -> list[Heard]:
        """Process a frame with a link's receivers, those of the scenario first; all get the same
        samples, and each its own reports.

        What was `before` at this link is a job that the pool began earlier, so that waiting for it
        ends.
        """
        with self.stopwatch.stage("synthesis"):
            cube = frame.heard(link).shared()
        if before is not None:
            before.result()
        with self.stopwatch.stage("receive"):
            maps = frame.number in self.snapshots
            heard = self.own.observers[link].hear(frame, cube, maps, told[0])
            others = zip(self.compared.values(), told[1:], strict=True)
            return [heard, *(s.observers[link].hear(frame, cube, False, k) for s, k in others)]

    def carried(self, link: Link, before: Future[Any] | None) -> list[dict[str, Any]]:
        """Return what the terminals of a link, those of the scenario first, carry over from their
        jobs `before` this one, which the pool began earlier."""
        if before is not None:
            before.result()
        return deepcopy([one.observers[link].terminal.memory() for one in self.sets])

    def keep(self, resume: Resume, carried: Carried) -> None:
        """Keep the frames collected so far, for a later call of the same run."""
        by_set = [
            {link: job.result()[i] for link, job in carried.items()} for i in range(len(self.sets))
        ]
        if resume.append(self.memory(by_set)):
            self.kept = len(self.recorder)
            for one in self.sets:
                one.recorder.amended.clear()

    def collect(self, frame: Frame, jobs: Jobs) -> None:
        """Wait for a frame's receivers, score and record it, take the own receivers' advice."""
        results = {link: job.result() for link, job in jobs.items()}
        heard = {link: by_set[0] for link, by_set in results.items()}
        with self.stopwatch.stage("track"):
            if self.setup.scenario.access.feedback:
                for tx, rx in heard:
                    if (tx, tx) in heard:
                        at_active = heard[Link(tx, tx)]
                        self.own.observers[Link(tx, rx)].feed_back(
                            frame.number, heard[Link(tx, rx)], at_active
                        )
            self.own.record(frame, heard, frame.number in self.snapshots)
            for i, one in enumerate(self.compared.values(), start=1):
                one.record(frame, {link: by_set[i] for link, by_set in results.items()}, False)
            self.schedules.take_advice({link: h.reception for link, h in heard.items()})

    def memory(self, carried: Sequence[Mapping[Link, dict[str, Any]]]) -> dict[str, Any]:
        """Return what a later call needs to go on after the frames so far: those since the last
        entry, and all that receivers carry over, of each set of them that which is `carried`
        already.

        Paths and samples are functions of the frame alone and are made anew.
        """
        own, *others = (
            one.memory(self.kept, by_link) for one, by_link in zip(self.sets, carried, strict=True)
        )
        return {
            "first": self.kept,
            **own,
            "compared": dict(zip(self.compared, others, strict=True)),
            "advice": plain(self.schedules.advice),
            "seconds": self.stopwatch.so_far(),
        }

    def restore(self, resume: Resume) -> int:
        """Take up what an earlier call of the same run kept; the number of the next frame."""
        last = None
        for entry in resume.entries():
            with resume.reading():
                if entry["first"] == len(self.recorder):  # not another call's at the same time
                    self.recorder.restore(entry["rows"], entry["amended"])
                    for name, one in self.compared.items():
                        part = entry["compared"][name]
                        one.recorder.restore(part["rows"], part["amended"])
                    last = entry
        if last is not None:
            with resume.reading():
                self.own.restore(last)
                for name, one in self.compared.items():
                    one.restore(last["compared"][name])
                self.schedules.advice = restored(dict[Link, bool], last["advice"])
                self.stopwatch.restore(last["seconds"])
        self.kept = len(self.recorder)
        return self.kept

    def summary(self) -> dict[str, Any]:
        """`summary.json` of the frames so far."""
        s = self.setup
        sets = {OWN: self.own, **self.compared} if self.compared else {}
        figures = Figures(
            timing=self.stopwatch.so_far(),
            plan={
                **mechanisms(s.scenario.propagation, s.scenario.clutter),
                **decisions(s.plan),
                **extent(s.city, s.propagation.census(), s.scenario.clutter),
            },
            access=self._access(),
            compared={name: one.blocks() for name, one in self.compared.items()},
            costs={name: one.costs() for name, one in sets.items()},
        )
        named = {"scenario": s.scenario.name, "seed": s.scenario.seed, "city": s.city.record()}
        return named | self.recorder.summary(figures)

    def _access(self) -> dict[str, Any] | None:
        stages = self.setup.connections.summary(self.setup.timetable.epoch(0))
        if not self.setup.scenario.access.feedback:
            return stages
        told = {str(link): o.feedback for link, o in self.own.observers.items() if not link.own}
        return (stages or {}) | {"feedback": told}
