"""run(scenario) -> Results: the one place where the stages meet. No physics here."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from threadpoolctl import threadpool_limits

from isac_rt.access import exchange
from isac_rt.access.fall_back import Schedules
from isac_rt.frame.cube import IFCube, Transmission
from isac_rt.frame.level import transmit_amplitude
from isac_rt.frame.link import Link
from isac_rt.frame.timetable import snapshot_frames
from isac_rt.propagation import PathSet
from isac_rt.receive import Reception
from isac_rt.receive.types import ExpectedClutter
from isac_rt.results.recorder import TIMINGS, Recorder, Results
from isac_rt.results.records import FrameRecord, ObserverRecord
from isac_rt.results.scoring import Heard, Scorer
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.plan import decisions, extent, mechanisms, used
from isac_rt.simulation.resume import Unfinished
from isac_rt.simulation.setup import Setup, link_budgets, prepare
from isac_rt.terminal.terminal import ActiveTerminal, PassiveTerminal, TerminalState
from isac_rt.world.swarm import Pose

Progress = Callable[[int, int], None]
Terminal = ActiveTerminal | PassiveTerminal


@dataclass
class _Clock:
    """Seconds per stage, summed over the threads that work in it."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TIMINGS, 0.0))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - start


def standard_terminal(setup: Setup, link: Link) -> Terminal:
    """The receiver of a link as the scenario has it."""
    s = setup.scenario
    if link[0] == link[1]:
        return ActiveTerminal(setup.waveform, setup.antennas, s.receivers, s.tracking)
    order, amplitude = s.modulation.dpsk_order, transmit_amplitude(s.noise)
    return PassiveTerminal(
        setup.waveform,
        setup.antennas,
        s.receivers,
        s.tracking,
        order,
        amplitude,
        groups=setup.timetable.groups(link),
    )


class _Observer:
    """One link's receiving terminal with its score."""

    def __init__(self, setup: Setup, link: Link, terminal: Terminal) -> None:
        self.link, self.setup, self.terminal = link, setup, terminal
        self.scorer = Scorer(link, setup.antennas, setup.swarm, setup.timetable)
        self.feedback = {"answers": 0, "corrections": 0}

    def feed_back(self, frame: _Frame, heard: Heard, at_active: Heard) -> None:
        """The passive terminal's feedback after a frame, and the active one's answer to it."""
        if not isinstance(self.terminal, PassiveTerminal):
            return
        s, when = self.setup, self.setup.timetable.epoch(frame.number, self.link[0])
        clock_std = s.connections.offset_std(self.link, when)
        answer = exchange(
            heard.reception,
            heard.tracks,
            at_active.tracks,
            s.antennas.num_rx,
            clock_std,
            s.waveform,
        )
        if answer is not None:
            self.feedback["answers"] += 1
            self.feedback["corrections"] += answer.cells != 0
            if answer.cells:
                self.terminal.shorten(answer.cells, s.swarm.trajectories[self.link[1]].pose(when))

    def hear(self, frame: _Frame, clock: _Clock) -> Heard:
        """Samples, reception and tracking of one frame. Runs in a thread of its own; only this
        observer's state changes."""
        number, when = frame.number, self.setup.timetable.epoch(frame.number, self.link[0])
        with clock.stage("synthesis"):
            cube = self.setup.receive_input(number, self.link, frame.sent, frame.paths, frame.poses)
        with clock.stage("receive"):
            tx, rx = self.link
            own = self.setup.swarm.trajectories[rx].pose(when)
            if isinstance(self.terminal, ActiveTerminal):
                clutter = frame.expected.get(tx)
                reception, tracks = self.terminal.step(
                    cube, frame.sent[tx].payload, own, when, clutter=clutter, maps=frame.snapshot
                )
                return Heard(reception, tracks, int(TerminalState.TRACKING))
            modulated = self.setup.timetable.modulated(number)
            assert isinstance(cube, IFCube)  # profiles are for active terminals only
            reception, tracks = self.terminal.step(cube, own, when, modulated, maps=frame.snapshot)
            return Heard(reception, tracks, int(self.terminal.state))

    def record(self, frame: _Frame, heard: Heard) -> ObserverRecord:
        """The frame held against the truth."""
        level = self.setup.noise_power(frame.poses, self.link)
        return self.scorer.record(
            frame.number, frame.paths[self.link], frame.sent[self.link[0]], heard, level
        )


def run(
    scenario: Scenario,
    *,
    progress: Progress | None = None,
    setup: Setup | None = None,
    threads: int | None = None,
    snapshots: int = 3,
    terminal: Callable[[Setup, Link], Terminal] = standard_terminal,
    unfinished: Unfinished | None = None,
) -> Results:
    """Simulate every frame of a scenario.

    Parameters
    ----------
    scenario : Scenario
    progress : called with the frames done and the frames in all
    setup : from `prepare`, if it is there already
    threads : receivers at work at once; None: as many as the machine has cores
    snapshots : frames, spread over those that the active terminals process, of which maps and path
        ledger are kept
    terminal : makes the receiver of a link; one of one's own is a subclass of `ActiveTerminal` or
        `PassiveTerminal` with another `receive`
    unfinished : where the frames are kept meanwhile and from where a run that was stopped goes on;
        with the terminals of this package

    Returns
    -------
    Results; the same for one scenario and set of versions whatever the number of threads
    """
    flight = _fly(
        scenario,
        progress,
        setup,
        threads,
        snapshot_frames(scenario, snapshots),
        terminal,
        unfinished,
    )
    return flight.recorder.finish(
        **flight.figures(),
        materials={
            m.name: {k: v for k, v in vars(m).items() if k != "name"}
            for m in flight.setup.city.materials
        },
        link_budget=[vars(row) for row in link_budgets(flight.setup)],
    )


def summarise(
    scenario: Scenario, *, setup: Setup | None = None, threads: int | None = None
) -> dict[str, Any]:
    """The summary of a run (`summary.json`) without its dataset; parameters as for `run`."""
    flight = _fly(scenario, None, setup, threads, set(), standard_terminal)
    return flight.recorder.summary(**flight.figures())


def stage_seconds(
    setup: Setup, number: int, poses: dict[str, Pose], paths: dict[Link, PathSet], receive: bool
) -> dict[Link, dict[str, float]]:
    """Seconds of synthesis and, if asked for, reception of one frame on each link, by terminals
    that hear it as their first."""
    out = {}
    sent = {
        name: setup.transmission(name, number, poses[name])
        for name in setup.timetable.with_role("active", number)
    }
    frame = _Frame(number, poses, paths, sent, setup.expected_clutter(number), False)
    links = setup.timetable.links(number)
    for link in (
        links[:1] + links
    ):  # the first once more: what is compiled on first use is not a frame's cost
        clock = _Clock()
        if receive:
            _Observer(setup, link, standard_terminal(setup, link)).hear(frame, clock)
        else:
            with clock.stage("synthesis"):
                setup.receive_input(number, link, sent, paths, poses)
        out[link] = {
            name: value
            for name, value in clock.seconds.items()
            if name == "synthesis" or (receive and name == "receive")
        }
    return out


@dataclass(frozen=True)
class _Frame:
    """One frame as it was sent and travelled."""

    number: int
    poses: dict[str, Pose]
    paths: dict[Link, PathSet]
    sent: dict[str, Transmission]
    expected: dict[str, ExpectedClutter]
    snapshot: bool


@dataclass
class _Flight:
    """The frames of a run so far, recorded and scored."""

    setup: Setup
    recorder: Recorder
    observers: dict[Link, _Observer]
    schedules: Schedules
    seconds: dict[str, float]
    contradicted: dict[int, int] = field(default_factory=dict)
    """Traced paths of each frame that the float64 geometry contradicted."""
    _safe: int = 0
    """Frames already in the file of the unfinished run."""

    def trace(self, frame: int) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        """`Setup.trace`, the contradicted paths counted."""
        before = self.setup.propagation.dropped
        found = self.setup.trace(frame)
        self.contradicted[frame] = self.setup.propagation.dropped - before
        return found

    def kept(self) -> dict[str, Any]:
        """What an unfinished run needs to go on after the frames so far: those since the last call,
        and all that receivers carry over.

        Only while no receiver is at work. Paths and samples are functions of the frame alone and
        are made anew.
        """
        first, self._safe = self._safe, self.recorder.count
        return {
            "first": first,
            "frames": self.recorder.since(first),
            "observers": {
                link: (o.terminal, o.scorer.score, o.feedback) for link, o in self.observers.items()
            },
            "advice": self.schedules.advice,
            "uses": {
                key: use for key, use in self.setup.uses.items() if first <= key[0] < self._safe
            },
            "contradicted": {frame: self.contradicted[frame] for frame in range(first, self._safe)},
            "seconds": self.seconds,
        }

    def go_on(self, unfinished: Unfinished) -> int:
        """Take up what an earlier call of the same run kept; the number of the next frame."""
        for entry in unfinished.entries():
            if entry["first"] != self.recorder.count:
                break  # two calls wrote into one folder
            self.recorder.restore(entry["frames"])
            self.setup.uses.update(entry["uses"])
            self.contradicted.update(entry["contradicted"])
            last = entry
        if self.recorder.count:
            for link, (terminal, score, feedback) in last["observers"].items():
                o = self.observers[link]
                o.terminal, o.scorer.score, o.feedback = terminal, score, feedback
            self.schedules.advice.update(last["advice"])
            self.seconds.update(
                {stage: self.seconds[stage] + seconds for stage, seconds in last["seconds"].items()}
            )
        self._safe = self.recorder.count
        return self._safe

    def figures(self) -> dict[str, Any]:
        """What a summary needs beside the frames."""
        return {
            "scores": {link: o.scorer.score for link, o in self.observers.items()},
            "timing": self.seconds,
            "fidelity": _fidelity(self.setup, sum(self.contradicted.values())),
            "access": self._access(),
        }

    def _access(self) -> dict[str, Any] | None:
        stages = self.setup.connections.summary(self.setup.timetable.epoch(0))
        if not self.setup.scenario.access.feedback:
            return stages
        told = {f"{tx}->{rx}": o.feedback for (tx, rx), o in self.observers.items() if tx != rx}
        return (stages or {}) | {"feedback": told}


def _fly(
    scenario: Scenario,
    progress: Progress | None,
    setup: Setup | None,
    threads: int | None,
    snapshots: set[int],
    terminal: Callable[[Setup, Link], Terminal],
    unfinished: Unfinished | None = None,
) -> _Flight:
    """Frame after frame; while the receivers work on one the next is traced."""
    clock, begin = _Clock(), time.perf_counter()
    with (
        threadpool_limits(limits=1),
        ThreadPoolExecutor(max_workers=threads or os.cpu_count() or 1) as pool,
    ):
        with clock.stage("setup"):
            setup = setup or prepare(scenario)
            timetable = setup.timetable
            observers = {
                link: _Observer(setup, link, terminal(setup, link)) for link in timetable.all_links
            }
            schedules = Schedules(scenario, setup.schedule)
            recorder = Recorder(
                scenario, setup.waveform, timetable, [state.name.lower() for state in TerminalState]
            )
        flight = _Flight(setup, recorder, observers, schedules, clock.seconds)
        first = flight.go_on(unfinished) if unfinished else 0
        begin -= clock.seconds["total"]
        waiting: tuple[_Frame, dict[Link, Future[Heard]]] | None = None
        for number in range(first, scenario.frames):
            with clock.stage("trace"):
                poses, paths = flight.trace(number)
            if waiting is not None:
                schedules.heed(_collect(recorder, observers, *waiting, clock))
                clock.seconds["total"] = time.perf_counter() - begin
                if unfinished and unfinished.due():
                    unfinished.append(flight.kept())
            if progress and number:
                progress(number, scenario.frames)
            active = timetable.with_role("active", number)
            sent = {
                name: setup.transmission(name, number, poses[name], schedules.of(name))
                for name in active
            }
            frame = _Frame(
                number, poses, paths, sent, setup.expected_clutter(number), number in snapshots
            )
            waiting = (
                frame,
                {
                    link: pool.submit(observers[link].hear, frame, clock)
                    for link in timetable.links(number)
                },
            )
        if waiting is not None:
            _collect(recorder, observers, *waiting, clock)
        if progress:
            progress(scenario.frames, scenario.frames)
    clock.seconds["total"] = time.perf_counter() - begin
    return flight


def _collect(
    recorder: Recorder,
    observers: dict[Link, _Observer],
    frame: _Frame,
    jobs: dict[Link, Future],
    clock: _Clock,
) -> dict[Link, Reception]:
    """Wait for a frame's receivers, score and record it; what they received."""
    heard = {link: job.result() for link, job in jobs.items()}
    with clock.stage("track"):
        timetable = recorder.timetable
        if recorder.scenario.access.feedback:
            for tx, rx in heard:
                if (tx, tx) in heard:
                    observers[tx, rx].feed_back(frame, heard[tx, rx], heard[tx, tx])
        recorder.add(
            FrameRecord(
                frame=frame.number,
                time=timetable.epoch(frame.number),
                modulated=timetable.modulated(frame.number),
                poses=frame.poses,
                observers={
                    timetable.labels[link]: observers[link].record(frame, h)
                    for link, h in heard.items()
                },
                snapshot=frame.snapshot,
            )
        )
    return {link: h.reception for link, h in heard.items()}


def _fidelity(setup: Setup, contradicted: int) -> dict[str, object]:
    """What was modelled, for the summary."""
    return {
        **mechanisms(setup.scenario),
        **decisions(setup.plan),
        "links": used(setup.uses, {link: "->".join(link) for link in setup.timetable.all_links}),
        "paths_contradicted": contradicted,
        **extent(setup.city, setup.propagation, setup.scenario.clutter),
    }
