"""Run of a scenario: the loop over frames that joins propagation, synthesis, receivers, tracking
and scores."""

from __future__ import annotations

import json
import logging
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.plain import plain, restored
from isac_rt.registry import extension
from isac_rt.results.provenance import provenance
from isac_rt.results.recorder import Figures, Recorder, Results
from isac_rt.results.scoring import LinkResult
from isac_rt.runtime import tracing_in_one_thread
from isac_rt.scenario.tree import OWN, Scenario
from isac_rt.simulation.fall_back import Schedules
from isac_rt.simulation.preflight import receivers_at_work
from isac_rt.simulation.progress import Progress, followed
from isac_rt.simulation.resume import Resume
from isac_rt.simulation.setup import Frame, Setup, link_budgets, prepare
from isac_rt.simulation.stations import (
    PREFETCHED_FRAMES,
    StationSet,
    Terminal,
    standard_terminal,
    terminal_with,
)
from isac_rt.simulation.stopwatch import Stopwatch
from isac_rt.track.parts import ReportedUav
from isac_rt.track.terminal import Receiver
from isac_rt.world.swarm import Swarm

if TYPE_CHECKING:
    import xarray as xr

_LOG = logging.getLogger(__name__)
Observe = Callable[[Frame, Link, IFCube], None]
Jobs = dict[Link, Future[list[LinkResult]]]
Carried = dict[Link, Future[list[dict[str, Any]]]]


def run(
    scenario: Scenario,
    *,
    progress: Progress | bool | None = True,
    setup: Setup | None = None,
    threads: int | None = None,
    snapshots: int = 3,
    terminal: Callable[[Setup, Link], Terminal | Receiver] = standard_terminal,
    resume: Resume | None = None,
    keep: Observe | Collection[Literal["samples"]] = (),
) -> Results:
    """Simulate every frame of a scenario.

    Parameters
    ----------
    scenario : Scenario
    progress : function of the frames done and all frames; True: a bar on a terminal or in a
        notebook; False or None: nothing
    setup : result of `prepare`; None: prepare here
    threads : receivers that work at once; None: one more than the machine has cores
    snapshots : number of frames whose maps and paths are stored, spread over the frames that the
        active terminals process
    terminal : factory of the receiver of a link: an object with `receive`, called like
        `ActiveTerminal.receive` or `PassiveTerminal.receive`, or a terminal with other tracking too
    resume : file in which finished frames are saved, and from which a stopped run resumes
    keep : ["samples"] stores the cubes of samples in `Results.samples`; a function is called with
        every frame, link and cube, in the receivers' threads. Frames from `resume` are left out

    Returns
    -------
    Results; the same for one scenario and set of versions, for any number of threads

    Examples
    --------
    >>> import isac_rt as irt
    >>> results = irt.run(irt.load("scenes/paper_swarm_consistent.yaml", frames=4))
    >>> results.summary["terminals"]["PT1"]["ser_delay"]
    0.0
    """
    if not isinstance(scenario, Scenario):
        raise TypeError("irt.run takes a scenario: irt.run(irt.load(path))")
    run = _Run.begin(scenario, setup, snapshots, terminal)
    samples: dict[tuple[int, Link], IFCube] = {}

    def add(frame: Frame, link: Link, cube: IFCube) -> None:
        samples[frame.number, link] = cube

    if callable(keep):
        run.observe = keep
    elif unknown := {*([keep] if isinstance(keep, str) else keep)} - {"samples"}:
        raise ValueError(f"keep: {', '.join(map(str, unknown))}: there is samples alone")
    elif keep:
        run.observe = add
    with followed(progress, scenario.frames) as report:
        run.fly(report, threads, resume)
    summary = run.summary()
    dataset = run.recorder.dataset().assign_attrs(
        provenance(scenario) | _attributes(run.setup, summary)
    )
    return Results(_with_boxes(dataset, run.setup.swarm), summary, scenario, samples)


def _with_boxes(dataset: xr.Dataset, swarm: Swarm) -> xr.Dataset:
    """Return a run's dataset with the corners of the UAVs' boxes, where there are any."""
    if not swarm.has_boxes:
        return dataset
    corners = extension("box_corners")(swarm, dataset.time.values)
    about = {"units": "m", "long_name": "corners of the UAV's box in world axes"}
    most = max(of_one.shape[1] for of_one in corners.values())
    fill = [((0, 0), (0, most - c.shape[1]), (0, 0)) for c in corners.values()]
    values = np.stack([*map(partial(np.pad, mode="edge"), corners.values(), fill)], axis=1)
    named = dataset.assign_coords(box=("box", np.array([*corners], object)))
    return named.assign(box_corner=(("frame", "box", "corner", "axis"), values, about))


def _attributes(setup: Setup, summary: Mapping[str, Any]) -> dict[str, str]:
    """Return the attributes of a run's dataset, as JSON."""
    out = {
        "fidelity": summary["fidelity"],
        "city": summary["city"],
        "materials": {
            m.name: {key: value for key, value in vars(m).items() if key != "name"}
            for m in setup.city.materials
        },
        "link_budget": [vars(row) for row in link_budgets(setup)],
        "coverage": asdict(setup.coverage),
    }
    return {name: json.dumps(value) for name, value in out.items()}


def summarise(
    scenario: Scenario, *, setup: Setup | None = None, threads: int | None = None
) -> dict[str, Any]:
    """Return the summary of a run (`summary.json`) without its dataset; parameters as for `run`."""
    run = _Run.begin(scenario, setup, 0, standard_terminal)
    run.fly(None, threads, None)
    return run.summary()


class _AtWork(NamedTuple):
    """Frame whose receivers are at work, and, if it is to be saved, the state of each station after
    it. A station that is not in `carried` is read when all have finished."""

    frame: Frame
    jobs: Jobs
    carried: Carried | None


@dataclass
class _Run:
    """Run in progress: receivers and records of the frames so far.

    Attributes
    ----------
    sets : sets of receivers by name: the scenario's first, whose feedback alone affects what is
        sent, then those of `compare`
    schedules : antenna schedules of the active terminals, by the receivers' feedback
    snapshots : numbers of the frames whose maps and paths are stored
    kept : number of frames saved for a later call
    """

    setup: Setup
    sets: dict[str, StationSet]
    schedules: Schedules
    snapshots: set[int]
    stopwatch: Stopwatch
    kept: int = 0
    observe: Observe | None = None

    @classmethod
    def begin(
        cls,
        scenario: Scenario,
        setup: Setup | None,
        snapshots: int,
        terminal: Callable[[Setup, Link], Terminal | Receiver],
    ) -> _Run:
        """Build the run before its first frame."""
        s, stopwatch = setup or prepare(scenario), Stopwatch()
        stopwatch.set_up(s.seconds)

        def make(link: Link) -> Terminal:
            return terminal_with(s.of(link.tx), link, terminal(s.of(link.tx), link))

        sets = {OWN: StationSet.of(s, make, scenario.receivers)}
        for name, receiver_set in scenario.compare.items():
            standard = partial(standard_terminal, s, settings=receiver_set)
            sets[name] = StationSet.of(s, standard, receiver_set.receivers)
        schedules = Schedules(s.schedule, s.antennas.num_tx, scenario.array.fall_back)
        return cls(s, sets, schedules, s.timetable.snapshots(snapshots), stopwatch)

    @property
    def own(self) -> StationSet:
        """Receivers of the scenario."""
        return self.sets[OWN]

    @property
    def recorder(self) -> Recorder:
        """Recorder of the scenario's receivers."""
        return self.own.recorder

    def fly(self, progress: Progress | None, threads: int | None, resume: Resume | None) -> None:
        """Receive, score and record frame after frame."""
        with (
            threadpool_limits(limits=1),
            tracing_in_one_thread(),
            ThreadPoolExecutor(max_workers=threads or receivers_at_work()) as pool,
        ):
            _LOG.info("tracing and receiving the first frame")
            for frame, jobs, carried in self.in_order(pool, resume):
                self.collect(frame, jobs)
                if resume and carried is not None:
                    self.keep(resume, carried)
                if progress:
                    progress(len(self.recorder), self.setup.timetable.frames)

    def in_order(self, pool: ThreadPoolExecutor, resume: Resume | None) -> Iterator[_AtWork]:
        """Yield the frames in order; the next one is traced while the receivers of one work.

        The jobs of a link run one after the other. With feedback or fall-back, where a transmission
        depends on earlier receptions, a frame waits for all receivers of the frame before.
        """
        setup, frames = self.setup, self.setup.timetable.frames
        dependent = setup.scenario.access.feedback or setup.scenario.array.fall_back
        at_once = 1 if dependent else PREFETCHED_FRAMES
        at_work: deque[_AtWork] = deque()
        last: dict[Link, Future[Any]] = {}
        for number in range(self.restore(resume) if resume else 0, frames):
            # trace, and wait for the oldest frame if enough are at work
            with self.stopwatch.stage("trace"):
                frame = setup.frame(number)
            while len(at_work) >= at_once:
                yield at_work.popleft()
            if setup.scenario.array.fall_back:
                frame = frame.sent_by({name: self.schedules.of(name) for name in frame.sent})
            # one job per link, after the previous one of the same link
            jobs = {}
            for link in setup.timetable.links(number):
                reports = [receivers.reports(link, number) for receivers in self.sets.values()]
                jobs[link] = pool.submit(self.receive, frame, link, reports, last.get(link))
            last |= jobs
            # states to be saved, read right after these jobs
            carried: Carried | None = None
            if resume and resume.due() and number + 1 < frames:
                links = [] if dependent else setup.timetable.all_links
                carried = {link: pool.submit(self.carried, link, last.get(link)) for link in links}
                last |= carried
            at_work.append(_AtWork(frame, jobs, carried))
        yield from at_work

    def receive(
        self,
        frame: Frame,
        link: Link,
        reports: Sequence[Sequence[ReportedUav]],
        before: Future[Any] | None,
    ) -> list[LinkResult]:
        """Process a frame with a link's receivers, the scenario's first: all get the same samples,
        each its own reports. `before` is the link's previous job, begun earlier, so waiting for it
        cannot block the pool."""
        with self.stopwatch.stage("synthesis"):
            cube = frame.received(link).shared()
        if self.observe is not None:
            self.observe(frame, link, cube)
        if before is not None:
            before.result()
        with self.stopwatch.stage("receive"):
            maps = frame.number in self.snapshots
            return [
                receivers.stations[link].receive(
                    frame, cube, maps and receivers is self.own, own_reports
                )
                for receivers, own_reports in zip(self.sets.values(), reports, strict=True)
            ]

    def carried(self, link: Link, before: Future[Any] | None) -> list[dict[str, Any]]:
        """Return the states of a link's terminals, the scenario's first, after the job `before`."""
        if before is not None:
            before.result()
        return deepcopy(
            [receivers.stations[link].terminal.memory() for receivers in self.sets.values()]
        )

    def keep(self, resume: Resume, carried: Carried) -> None:
        """Save the frames collected so far for a later call of the same run."""
        by_set = [
            {link: job.result()[i] for link, job in carried.items()} for i in range(len(self.sets))
        ]
        if resume.append(self.memory(by_set)):
            self.kept = len(self.recorder)
            for receivers in self.sets.values():
                receivers.recorder.amended.clear()

    def collect(self, frame: Frame, jobs: Jobs) -> None:
        """Wait for a frame's receivers, score and record it, and take their feedback."""
        results = {link: job.result() for link, job in jobs.items()}
        received = {link: by_set[0] for link, by_set in results.items()}
        with self.stopwatch.stage("track"):
            if self.setup.scenario.access.feedback:
                self._feed_back(frame.number, received)
            snapshot = frame.number in self.snapshots
            for i, receivers in enumerate(self.sets.values()):
                of_set = {link: by_set[i] for link, by_set in results.items()}
                receivers.record(frame, of_set, snapshot and i == 0)
            self.schedules.take_advice({link: h.reception for link, h in received.items()})

    def _feed_back(self, frame: int, received: Mapping[Link, LinkResult]) -> None:
        """Exchange feedback over every link whose active terminal received the frame."""
        for link in received:
            at_active = received.get(Link(link.tx, link.tx))
            if at_active is not None:
                self.own.stations[link].feed_back(frame, received[link], at_active)

    def memory(self, carried: Sequence[Mapping[Link, dict[str, Any]]]) -> dict[str, Any]:
        """Return the state from which a later call resumes: the frames since the last entry, and
        the states of each set of receivers, `carried` where they were read earlier.

        Paths and samples are functions of the frame alone and are not saved.
        """
        sets = zip(self.sets.items(), carried, strict=True)
        return {
            "first": self.kept,
            "sets": {name: r.memory(self.kept, by_link) for (name, r), by_link in sets},
            "advice": plain(self.schedules.advice),
            "seconds": self.stopwatch.so_far(),
        }

    def restore(self, resume: Resume) -> int:
        """Restore the state saved by an earlier call of the same run; return the next frame."""
        last = None
        for entry in resume.entries():
            with resume.reading():
                if entry["first"] == len(self.recorder):  # not another call's at the same time
                    for name, receivers in self.sets.items():
                        part = entry["sets"][name]
                        receivers.recorder.restore(part["rows"], part["amended"])
                    last = entry
        if last is not None:
            with resume.reading():
                for name, receivers in self.sets.items():
                    receivers.restore(last["sets"][name])
                self.schedules.advice = restored(dict[Link, bool], last["advice"])
                self.stopwatch.restore(last["seconds"])
        self.kept = len(self.recorder)
        return self.kept

    def summary(self) -> dict[str, Any]:
        """Return `summary.json` of the frames so far."""
        s = self.setup
        compared = {name: receivers for name, receivers in self.sets.items() if name != OWN}
        figures = Figures(
            timing=self.stopwatch.so_far(),
            plan=s.fidelity(),
            access=self._access(),
            compared={name: receivers.blocks() for name, receivers in compared.items()},
            costs={name: r.costs() for name, r in self.sets.items()} if compared else {},
        )
        named = {"scenario": s.scenario.name, "seed": s.scenario.seed, "city": s.city.record()}
        return named | self.recorder.summary(figures)

    def _access(self) -> dict[str, Any] | None:
        stages = self.setup.connections.summary(self.setup.timetable.epoch(0))
        if not self.setup.scenario.access.feedback:
            return stages
        feedback = {str(link): o.feedback for link, o in self.own.stations.items() if not link.own}
        return (stages or {}) | {"feedback": feedback}
