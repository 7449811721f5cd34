"""run(scenario) -> Results: the one place where the stages meet. No physics here."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from isac_rt.access import Connections, connect, exchange
from isac_rt.arrays import Antennas, Schedule, antennas_of, schedule_of
from isac_rt.city import City
from isac_rt.fall_back import Schedules
from isac_rt.fidelity import Plan, Use, decisions, extent, mechanisms, used
from isac_rt.ifsignal import IFCube, RangeProfiles, Transmission, add_noise, if_signal, range_profiles
from isac_rt.linkbudget import LinkBudget, link_budget, noise_power, noise_rise, thermal_noise_power, transmit_amplitude
from isac_rt.metrics import (
    SensingScore,
    SymbolCount,
    Truth,
    associate,
    count_symbols,
    direct_targets,
    explain,
    resolutions,
    truth_of,
    within_view,
)
from isac_rt.preflight import check_flights, check_memory, check_reference
from isac_rt.propagation import FreeSpace, PathKind, PathSet, Propagation, make_propagation
from isac_rt.propagation.cache import CachedPropagation, PathStore
from isac_rt.propagation.expected import ClutterExpectation, ExpectedClutter, make_expectation
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive import Reception
from isac_rt.results import TIMINGS, FrameRecord, ObserverRecord, Recorder, Results, TrackTable, UavValues
from isac_rt.scenario import Scenario
from isac_rt.surroundings import city_of, flight_centre, path_content
from isac_rt.swarm import Pose, Swarm
from isac_rt.terminal import ActiveTerminal, PassiveTerminal, TerminalState
from isac_rt.timetable import Link, Timetable, snapshot_frames
from isac_rt.tracking import TrackSet
from isac_rt.unfinished import Unfinished
from isac_rt.waveform import Waveform, waveform_of

Progress = Callable[[int, int], None]
Terminal = ActiveTerminal | PassiveTerminal


@dataclass(frozen=True)
class Setup:
    """What stays the same over a run."""

    scenario: Scenario
    waveform: Waveform
    antennas: Antennas
    schedule: Schedule
    swarm: Swarm
    city: City
    propagation: Propagation
    reference: FreeSpace
    """Closed forms of the reference paths, as they would be unshadowed and in view."""
    timetable: Timetable
    connections: Connections
    plan: Plan
    uses: dict[tuple[int, Link], Use] = field(default_factory=dict)
    """What the plan kept of the paths of each frame and link traced so far."""
    expectation: ClutterExpectation | None = None
    """What an active terminal's receiver predicts of its clutter from the mesh; None where its detector needs none."""

    def expected_clutter(self, frame: int) -> dict[str, ExpectedClutter]:
        """What each active terminal expects of its own link. Traces rays: from the thread that traces only."""
        if self.expectation is None:
            return {}
        amplitude, out = transmit_amplitude(self.scenario.noise), {}
        for name in self.timetable.with_role("active", frame):
            when = self.timetable.epoch(frame, name)
            out[name] = self.expectation.clutter(name, self.swarm.trajectories[name].pose(when), when, amplitude)
        return out

    def noise_power(self, poses: dict[str, Pose], link: Link) -> float:
        """E|n|^2 of a sample at the link's receiver [W], Gaussian clutter included."""
        rise = noise_rise(self.scenario.clutter)
        if self.scenario.noise.model == "link_budget":
            return rise * thermal_noise_power(self.scenario.noise, self.waveform)
        return rise * noise_power(self.scenario.noise, self.waveform, self.reference.reference_amplitude(poses, *link))

    def trace(self, frame: int) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        """Poses and paths of a frame, interference between active terminals included; what the plan leaves out is not there."""
        poses, found = self.find(frame)
        thinned = {link: self.plan.apply(p, self.noise_power(poses, link)) for link, p in found.items()}
        self.uses.update({(frame, link): use for link, (_, use) in thinned.items()})
        return poses, {link: paths for link, (paths, _) in thinned.items()}

    def find(self, frame: int) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        """Poses and all paths of a frame, however weak."""
        epoch = self.timetable.epoch(frame)
        poses = self.swarm.poses(epoch)
        heard = self.timetable.links(frame)
        active, receivers = self.timetable.with_role("active", frame), dict.fromkeys(rx for _, rx in heard)
        return poses, self.propagation.paths(poses, epoch, [(tx, rx) for tx in active for rx in receivers])

    def transmission(self, active: str, frame: int, pose: Pose, schedule: Schedule | None = None) -> Transmission:
        """What an active terminal sends in a frame, by another `schedule` than the usual one if there is one."""
        return Transmission(
            name=active,
            pose=pose,
            antennas=self.antennas,
            schedule=self.schedule if schedule is None else schedule,
            payload=self.timetable.payload(active, frame, schedule),
            amplitude=transmit_amplitude(self.scenario.noise),
            first_block=self.timetable.first_block(active, frame),
        )

    def receive_samples(
        self, frame: int, link: Link, sent: dict[str, Transmission], paths: dict[Link, PathSet], poses: dict[str, Pose]
    ) -> IFCube:
        """IF samples of a link's receiver, dechirped in the resource blocks of the link's transmitter, with noise.

        `sent` holds every active terminal; what the others' chirps leave in these blocks is in the samples. They depend on
        nothing but the frame and the link.
        """
        arriving, level, words, frame_of = self._arriving(frame, link, sent, paths, poses)
        method = self.plan.synthesis(sum(len(p) for _, p in arriving))
        cube = if_signal(self.waveform, arriving, poses[link[1]], self.antennas, noise_power=level, method=method,
                         max_error=self.plan.synthesis_error, costs=self.plan.costs, **frame_of)  # fmt: skip
        return add_noise(cube, level, words)

    def receive_input(
        self, frame: int, link: Link, sent: dict[str, Transmission], paths: dict[Link, PathSet], poses: dict[str, Pose]
    ) -> IFCube | RangeProfiles:
        """What a link's receiver is given: samples, or with ``receivers.active_input: profiles`` at the active terminal range profiles."""
        if link[0] != link[1] or self.scenario.receivers.active_input == "samples":
            return self.receive_samples(frame, link, sent, paths, poses)
        arriving, level, words, frame_of = self._arriving(frame, link, sent, paths, poses)
        own = sent[link[0]].payload
        return range_profiles(self.waveform, arriving, poses[link[1]], self.antennas, own, noise_power=level, seed_words=words, **frame_of)

    def _arriving(
        self, frame: int, link: Link, sent: dict[str, Transmission], paths: dict[Link, PathSet], poses: dict[str, Pose]
    ) -> tuple[list[tuple[Transmission, PathSet]], float, np.ndarray, dict[str, Any]]:
        """What reaches a link's receiver, its noise power and the noise's stream, and when and through what it listens."""
        tx, rx = link
        when = self.timetable.epoch(frame, tx)
        arriving = []
        for name in [tx, *(name for name in sent if name != tx)]:
            clock = self.connections.apart(name, link, when)
            arriving.append((replace(sent[name], clock_offset=clock.offset, clock_drift=clock.drift), paths[name, rx]))
        words = seed_sequence(self.scenario.seed, "noise", tx, rx, frame).generate_state(2)
        frame_of = {"start_time": self.timetable.start_time(frame, tx), "filter_transition": self.scenario.radio.filter_transition_hz}
        return arriving, self.noise_power(poses, link), words, frame_of


def link_budgets(setup: Setup) -> list[LinkBudget]:
    """The link budget of every link at the first frame."""
    poses = setup.swarm.poses(setup.timetable.epoch(0))
    rows = []
    for tx, rx in setup.timetable.links(0):
        if tx == rx and not setup.reference.has_target(tx):
            continue
        amplitude = setup.reference.reference_amplitude(poses, tx, rx)
        name = rx if tx != rx else setup.reference.strongest_target(poses, tx)
        distance = float(np.linalg.norm(poses[name].position - poses[tx].position))
        what = "line of sight" if tx != rx else f"echo of {name}"
        rows.append(link_budget((tx, rx), what, distance, amplitude, setup.scenario.noise, setup.waveform, setup.antennas))
    return rows


def prepare(scenario: Scenario, store: PathStore | None = None) -> Setup:
    """Load and build everything that frames share. With a `store` traced paths are looked up there first and kept there."""
    waveform = waveform_of(scenario)
    antennas = antennas_of(scenario, waveform)
    swarm = Swarm.from_scenario(scenario)
    schedule = schedule_of(scenario, waveform, generator(scenario.seed, "schedule"))
    timetable = Timetable(scenario, waveform, schedule)
    check_memory(waveform, antennas, scenario, timetable)
    check_flights(scenario, swarm, timetable)
    check_reference(scenario, timetable)
    plan = Plan(scenario, waveform, antennas, timetable, swarm)
    city = city_of(scenario, plan.mesh_radius(flight_centre(scenario)))
    setup = Setup(
        scenario,
        waveform,
        antennas,
        schedule,
        swarm,
        city,
        _propagation(scenario, waveform, antennas, city, plan.instants, store),
        FreeSpace(scenario.swarm, antennas, waveform.wavelength, scenario.seed),
        timetable,
        Connections(),
        plan,
        expectation=make_expectation(scenario, waveform, antennas, city),
    )
    return _connected(setup)


def _connected(setup: Setup) -> Setup:
    """The same after the stages before the data, where the scenario has them."""

    def scene(when: float, links: list[Link]) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        poses = setup.swarm.poses(when)
        return poses, setup.propagation.paths(poses, when, links) if links else {}

    first = setup.swarm.poses(setup.timetable.epoch(0))
    found = connect(
        setup.scenario, setup.waveform, setup.antennas, setup.schedule, scene, lambda link: setup.noise_power(first, link)
    )
    timetable = replace(setup.timetable, blocks=found.blocks(), refused=found.refused())
    return replace(setup, timetable=timetable, connections=found, plan=replace(setup.plan, timetable=timetable))


def _propagation(
    scenario: Scenario, waveform: Waveform, antennas: Antennas, city: City, instants: tuple[float, ...], store: PathStore | None
) -> Propagation:
    def make() -> Propagation:
        return make_propagation(scenario, waveform, antennas, city, instants)

    if store is None or scenario.propagation.model == "free_space":
        return make()
    return CachedPropagation(make, store, json.dumps([path_content(scenario), city.num_faces]))


def trace(scenario: Scenario, frame: int, *, setup: Setup | None = None) -> dict[Link, PathSet]:
    """The paths of all links of one frame."""
    return (setup or prepare(scenario)).trace(frame)[1]


@dataclass
class _Clock:
    """Seconds per stage, summed over the threads that work in it."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TIMINGS, 0.0))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - start


@dataclass(frozen=True)
class _Heard:
    """What one observer got and made of one frame."""

    reception: Reception
    tracks: TrackSet
    state: int


def standard_terminal(setup: Setup, link: Link) -> Terminal:
    """The receiver of a link as the scenario has it."""
    s = setup.scenario
    if link[0] == link[1]:
        return ActiveTerminal(setup.waveform, setup.antennas, s.receivers, s.tracking)
    order, amplitude = s.modulation.dpsk_order, transmit_amplitude(s.noise)
    return PassiveTerminal(setup.waveform, setup.antennas, s.receivers, s.tracking, order, amplitude, groups=setup.timetable.groups(link))


class _Observer:
    """One link's receiving terminal with its score."""

    def __init__(self, setup: Setup, link: Link, terminal: Terminal) -> None:
        self.link, self.setup, self.terminal = link, setup, terminal
        self.passes = 2 if link[0] == link[1] else 1
        self.groups = setup.timetable.groups(link)
        self.score = SensingScore(resolutions(setup.waveform, setup.antennas, self.passes))
        self.feedback = {"answers": 0, "corrections": 0}

    def feed_back(self, frame: _Frame, heard: _Heard, at_active: _Heard) -> None:
        """The passive terminal's feedback after a frame, and the active one's answer to it."""
        if not isinstance(self.terminal, PassiveTerminal):
            return
        s, when = self.setup, self.setup.timetable.epoch(frame.number, self.link[0])
        clock_std = s.connections.offset_std(self.link, when)
        answer = exchange(heard.reception, heard.tracks, at_active.tracks, s.antennas.num_rx, clock_std, s.waveform)
        if answer is not None:
            self.feedback["answers"] += 1
            self.feedback["corrections"] += answer.cells != 0
            if answer.cells:
                self.terminal.shorten(answer.cells, s.swarm.trajectories[self.link[1]].pose(when))

    def hear(self, frame: _Frame, clock: _Clock) -> _Heard:
        """Samples, reception and tracking of one frame. Runs in a thread of its own; only this observer's state changes."""
        number, when = frame.number, self.setup.timetable.epoch(frame.number, self.link[0])
        with clock.stage("synthesis"):
            cube = self.setup.receive_input(number, self.link, frame.sent, frame.paths, frame.poses)
        with clock.stage("receive"):
            tx, rx = self.link
            own = self.setup.swarm.trajectories[rx].pose(when)
            if isinstance(self.terminal, ActiveTerminal):
                clutter = frame.expected.get(tx)
                reception, tracks = self.terminal.step(cube, frame.sent[tx].payload, own, when, clutter=clutter, maps=frame.snapshot)
                return _Heard(reception, tracks, int(TerminalState.TRACKING))
            modulated = self.setup.timetable.modulated(number)
            assert isinstance(cube, IFCube)  # profiles are for active terminals only
            reception, tracks = self.terminal.step(cube, own, when, modulated, maps=frame.snapshot)
            return _Heard(reception, tracks, int(self.terminal.state))


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
    snapshots : frames, spread over those that the active terminals process, of which maps and path ledger are kept
    terminal : makes the receiver of a link; one of one's own is a subclass of `ActiveTerminal` or `PassiveTerminal` with another `receive`
    unfinished : where the frames are kept meanwhile and from where a run that was stopped goes on; with the terminals of this package

    Returns
    -------
    Results; the same for one scenario and set of versions whatever the number of threads
    """
    flight = _fly(scenario, progress, setup, threads, snapshot_frames(scenario, snapshots), terminal, unfinished)
    return flight.recorder.finish(
        **flight.figures(),
        materials={m.name: {k: v for k, v in vars(m).items() if k != "name"} for m in flight.setup.city.materials},
        link_budget=[vars(row) for row in link_budgets(flight.setup)],
    )


def summarise(scenario: Scenario, *, setup: Setup | None = None, threads: int | None = None) -> dict[str, Any]:
    """The summary of a run (`summary.json`) without its dataset; parameters as for `run`."""
    flight = _fly(scenario, None, setup, threads, set(), standard_terminal)
    return flight.recorder.summary(**flight.figures())


def stage_seconds(
    setup: Setup, number: int, poses: dict[str, Pose], paths: dict[Link, PathSet], receive: bool
) -> dict[Link, dict[str, float]]:
    """Seconds of synthesis and, if asked for, reception of one frame on each link, by terminals that hear it as their first."""
    out = {}
    sent = {name: setup.transmission(name, number, poses[name]) for name in setup.timetable.with_role("active", number)}
    frame = _Frame(number, poses, paths, sent, setup.expected_clutter(number), False)
    links = setup.timetable.links(number)
    for link in links[:1] + links:  # the first once more: what is compiled on first use is not a frame's cost
        clock = _Clock()
        if receive:
            _Observer(setup, link, standard_terminal(setup, link)).hear(frame, clock)
        else:
            with clock.stage("synthesis"):
                setup.receive_input(number, link, sent, paths, poses)
        out[link] = {name: value for name, value in clock.seconds.items() if name == "synthesis" or (receive and name == "receive")}
    return out


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
        """What an unfinished run needs to go on after the frames so far: those since the last call, and all that receivers carry over.

        Only while no receiver is at work. Paths and samples are functions of the frame alone and are made anew.
        """
        first, self._safe = self._safe, self.recorder.count
        return {
            "first": first,
            "frames": self.recorder.since(first),
            "observers": {link: (o.terminal, o.score, o.feedback) for link, o in self.observers.items()},
            "advice": self.schedules.advice,
            "uses": {key: use for key, use in self.setup.uses.items() if first <= key[0] < self._safe},
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
                o.terminal, o.score, o.feedback = terminal, score, feedback
            self.schedules.advice.update(last["advice"])
            self.seconds.update({stage: self.seconds[stage] + seconds for stage, seconds in last["seconds"].items()})
        self._safe = self.recorder.count
        return self._safe

    def figures(self) -> dict[str, Any]:
        """What a summary needs beside the frames."""
        return {
            "scores": {link: o.score for link, o in self.observers.items()},
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
    with threadpool_limits(limits=1), ThreadPoolExecutor(max_workers=threads or os.cpu_count() or 1) as pool:
        with clock.stage("setup"):
            setup = setup or prepare(scenario)
            timetable = setup.timetable
            observers = {link: _Observer(setup, link, terminal(setup, link)) for link in timetable.all_links}
            schedules = Schedules(scenario, setup.schedule)
            recorder = Recorder(scenario, setup.waveform, timetable, [state.name.lower() for state in TerminalState])
        flight = _Flight(setup, recorder, observers, schedules, clock.seconds)
        first = flight.go_on(unfinished) if unfinished else 0
        begin -= clock.seconds["total"]
        waiting: tuple[_Frame, dict[Link, Future[_Heard]]] | None = None
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
            sent = {name: setup.transmission(name, number, poses[name], schedules.of(name)) for name in active}
            frame = _Frame(number, poses, paths, sent, setup.expected_clutter(number), number in snapshots)
            waiting = frame, {link: pool.submit(observers[link].hear, frame, clock) for link in timetable.links(number)}
        if waiting is not None:
            _collect(recorder, observers, *waiting, clock)
        if progress:
            progress(scenario.frames, scenario.frames)
    clock.seconds["total"] = time.perf_counter() - begin
    return flight


@dataclass(frozen=True)
class _Frame:
    """One frame as it was sent and travelled."""

    number: int
    poses: dict[str, Pose]
    paths: dict[Link, PathSet]
    sent: dict[str, Transmission]
    expected: dict[str, ExpectedClutter]
    snapshot: bool


def _collect(
    recorder: Recorder, observers: dict[Link, _Observer], frame: _Frame, jobs: dict[Link, Future], clock: _Clock
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
                observers={timetable.labels[link]: _record(observers[link], frame, h) for link, h in heard.items()},
                snapshot=frame.snapshot,
            )
        )
    return {link: h.reception for link, h in heard.items()}


def _record(observer: _Observer, frame: _Frame, heard: _Heard) -> ObserverRecord:
    """Hold one observer's reception against the truth."""
    setup, (tx, rx), reception = observer.setup, observer.link, heard.reception
    poses = setup.swarm.poses(setup.timetable.epoch(frame.number, tx))  # of this link's own chirps
    paths, names, own, active = frame.paths[observer.link], list(setup.swarm.uavs), poses[rx], poses[tx]
    truth: list[Truth | None] = []
    for name in names:
        by_way = active if observer.passes == 1 and name != tx else None
        truth.append(None if name == rx else truth_of(own, poses[name], by_way))
    in_view = np.array([name != rx and within_view(setup.antennas, own, active, poses[name]) for name in names])
    direct = direct_targets(paths, names)
    seen = [i for i in range(len(names)) if in_view[i] and direct[i]]
    targets = [t for i in seen if (t := truth[i]) is not None]
    explained = explain(reception.detections, paths, setup.waveform, observer.passes)
    observer.score.add(targets, reception.detections, heard.tracks, explained.kind)
    d, tracks = reception.detections, heard.tracks
    detected = np.column_stack([d.range, d.velocity, d.direction])
    tracked = np.column_stack([tracks.range, tracks.velocity, tracks.direction])
    sure = np.flatnonzero(tracks.confirmed | tracks.is_reference)
    to_detection = associate(targets, detected, observer.score.resolution)
    to_track = [(i, int(sure[j])) for i, j in associate(targets, tracked[sure], observer.score.resolution)]
    followed = np.full(len(tracks), -1)
    followed[[j for _, j in to_track]] = [seen[i] for i, _ in to_track]
    stray = np.ones(len(d), bool)
    stray[[j for _, j in to_detection]] = False
    raw = reception.raw_delay_symbols
    return ObserverRecord(
        transmitter=tx,
        reception=reception,
        paths=paths,
        truth=_values([None if t is None else np.array(t)[[0, 1, 4, 5]] for t in truth]),
        detected=_estimates(len(names), detected, to_detection, seen),
        tracked=_estimates(len(names), tracked, to_track, seen),
        in_view=in_view,
        shadowed=in_view & ~direct,
        tracks=TrackTable(
            id=tracks.ids, range=tracks.range, velocity=tracks.velocity, u_x=tracks.direction[:, 0], u_z=tracks.direction[:, 1],
            confirmed=tracks.confirmed, uav=followed,
        ),
        state=heard.state,
        **{f"detection_{name}": value for name, value in explained._asdict().items()},
        symbols=count_symbols(frame.sent[tx].payload, reception, observer.groups) if observer.passes == 1 else SymbolCount(),
        fell_back=frame.sent[tx].schedule is not setup.schedule,
        num_false=int((stray & (explained.kind < 0)).sum()),
        slips=int(((raw < 0) | (raw >= setup.waveform.num_delay_symbols)).sum()),
        reference_snr=_reference_snr(setup, frame, paths),
    )


def _reference_snr(setup: Setup, frame: _Frame, paths: PathSet) -> float:
    """Per-sample SNR of the line of sight, or of the strongest echo on the terminal's own link; NaN where there is none."""
    kind = PathKind.TARGET if paths.tx == paths.rx else PathKind.LINE_OF_SIGHT
    power = paths.power[paths.kind == kind]
    level = setup.noise_power(frame.poses, (paths.tx, paths.rx))
    return float(frame.sent[paths.tx].amplitude**2 * power.max() / level) if power.size else float("nan")


def _values(rows: list[np.ndarray | None]) -> UavValues:
    table = np.array([np.full(4, np.nan) if r is None else r for r in rows])
    return UavValues(range=table[:, 0], velocity=table[:, 1], azimuth=table[:, 2], elevation=table[:, 3])


def _estimates(count: int, found: np.ndarray, pairs: list[tuple[int, int]], seen: list[int]) -> UavValues:
    """Estimates by UAV; direction cosines become azimuth and elevation of the front half-space."""
    rows: list[np.ndarray | None] = [None] * count
    for i, j in pairs:
        r, v, u_x, u_z = found[j]
        forward = 1 - u_x**2 - u_z**2
        angles = (np.arctan2(u_x, np.sqrt(forward)), np.arcsin(u_z)) if forward >= 0 else (np.nan, np.nan)
        rows[seen[i]] = np.array([r, v, *angles])
    return _values(rows)


def _fidelity(setup: Setup, contradicted: int) -> dict[str, object]:
    """What was modelled, for the summary."""
    return {
        **mechanisms(setup.scenario),
        **decisions(setup.plan),
        "links": used(setup.uses, {link: "->".join(link) for link in setup.timetable.all_links}),
        "paths_contradicted": contradicted,
        **extent(setup.city, setup.propagation, setup.scenario.clutter),
    }
