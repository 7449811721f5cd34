"""Runs the points of a sweep on workers.

Workers get small jobs and send back a few words; outcomes go straight from the worker to the disk.
So the client does not grow with the sweep, and whoever is killed takes nothing with it that was
finished.
"""

from __future__ import annotations

import json
import math
import os
import platform
import shutil
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from isac_rt.document import first_complaint
from isac_rt.runtime import MachineProblem, available_memory, of_machine
from isac_rt.scenario.tree import Scenario
from isac_rt.sweep.definition import Plan, Point, Points, ground_of
from isac_rt.sweep.outcomes import Outcomes, pending
from isac_rt.sweep.workers import (
    LEFT,
    LOST,
    LOST_AFTER,
    Ended,
    Processes,
    SchedulerLost,
    Workers,
    cluster_at,
    lost_often,
)

if TYPE_CHECKING:
    from isac_rt.propagation.store import PathStore
    from isac_rt.scenario.tree import Scenario
    from isac_rt.simulation.setup import Setup

WORKER_BYTES = 1.5e9
"""Memory that a worker is reckoned with when their number is chosen: a ray-traced city, three
receivers at work."""
PATIENCE = 16
"""Points in a row that the machine did not let end, before the sweep stops; on a cluster twice as
many as it is given at once."""
FOLLOWERS = 512
"""Points that may wait for others whose paths they share."""
FREE_BYTES = 1_000_000
"""Free disk without which no point is begun. [bytes]"""
CACHE_BYTES = 4 * 1024**3

PARTS = ("links", "terminals", "swarm", "compared", "paths", "fidelity", "timing_s", "versions")
"""What an outcome holds of a summary."""
BESIDE = ("shard", "by_frame")
"""What some jobs make beside it."""

Progress = Callable[[int, int, int], None]
"""Called with points done, failed, and in all."""


class PointsLeft(MachineProblem):
    """The machine did not let some points end; what was finished is kept. The text says why."""


@dataclass(frozen=True)
class Job:
    """One point as a worker gets it: plain values only.

    Attributes
    ----------
    ground : what the client found that the outcome depends on (see `ground_of`)
    """

    key: str
    tree: dict[str, Any]
    ground: dict[str, str]
    scenario_folder: str
    folder: str
    threads: int
    retry_failed: bool = False

    @property
    def outcomes(self) -> Outcomes:
        """Where its outcome is kept."""
        return Outcomes(Path(self.folder))

    def prepared(self, store: PathStore | None = None) -> tuple[Scenario, Setup]:
        """The scenario and its set-up; the ray tracer is told how many threads it may use."""
        from isac_rt.scenario.tree import Scenario
        from isac_rt.simulation.setup import prepare

        scenario = Scenario.model_validate(self.tree).in_folder(Path(self.scenario_folder))
        if scenario.propagation.model == "ray_traced":
            _limit_tracer(self.threads)
        return scenario, prepare(scenario, store)

    def simulate(self) -> dict[str, Any]:
        """Run the point, and what is kept of it: its summary."""
        from isac_rt.propagation.store import PathStore
        from isac_rt.simulation import simulate

        scenario, setup = self.prepared(PathStore(Path(self.folder) / "paths", CACHE_BYTES))
        return simulate.summarise(scenario, setup=setup, threads=self.threads)


def run_job(job: Job) -> Ended:
    """Simulate a point and write its outcome; in a worker.

    Only an error that the point's own content causes is an outcome. Where the machine is to blame
    (its disk, its memory, a folder that it does not see) nothing is recorded, and the point is left
    to do. A job whose worker dies before it has answered is repeated; a point whose outcome is
    there is not.
    """
    outcomes = job.outcomes
    try:
        outcome = outcomes.read(job.key)
        if outcome is None or (job.retry_failed and outcome["status"] == "failed"):
            _check_machine(job, outcomes)
            outcome = _outcome(job)
            outcomes.write(job.key, outcome)
    except Exception as problem:
        if not of_machine(problem):
            raise
        return Ended(LEFT, f"{platform.node()}: {_words(problem)}", _address())
    return Ended(outcome["status"])


def _check_machine(job: Job, outcomes: Outcomes) -> None:
    """Refuse to begin a point whose outcome could not be written, or would not be the one that its
    key says.

    Raises
    ------
    MachineProblem
    """
    if not outcomes.points.is_dir():
        raise MachineProblem(
            f"does not see {outcomes.points}; every worker must reach it under this path"
        )
    if shutil.disk_usage(outcomes.points).free < FREE_BYTES:
        raise MachineProblem(f"no room is left in {outcomes.folder}; make room")
    found = ground_of(job.tree, Path(job.scenario_folder))
    if other := [name for name, value in job.ground.items() if found[name] != value]:
        raise MachineProblem(
            f"{' and '.join(other)} are not those of the client, so that the outcome would be of "
            f"another point; let every worker see the same files under {job.scenario_folder}, and "
            "start it anew after an upgrade"
        )


def _outcome(job: Job) -> dict[str, Any]:
    begin = time.perf_counter()
    about: dict[str, Any] = {"scenario": job.tree}
    try:
        made = job.simulate()
        about |= {"status": "done", **{name: made[name] for name in PARTS + BESIDE if name in made}}
        json.dumps(about, allow_nan=False)
    except Exception as problem:
        if of_machine(problem):
            raise
        where = "".join(traceback.format_exception(problem)[-3:])
        about = {"scenario": job.tree, "status": "failed", "error": _words(problem), "where": where}
    return about | {"seconds": time.perf_counter() - begin}


def _words(problem: BaseException) -> str:
    if isinstance(problem, ValidationError):
        return first_complaint(Scenario, problem)
    return f"{type(problem).__name__}: {problem}" if str(problem) else type(problem).__name__


def _address() -> str:
    """Address of this worker in a cluster; "" elsewhere."""
    if "distributed" not in sys.modules:
        return ""
    from distributed import get_worker

    try:
        return get_worker().address
    except ValueError:
        return ""


@lru_cache(maxsize=1)
def _limit_tracer(threads: int) -> None:
    """Tell Dr.Jit, once in a process, how many threads it may use: several workers share the
    machine."""
    from isac_rt import runtime

    runtime.activate()
    import drjit

    drjit.set_thread_count(threads)


def default_workers() -> int:
    """One for each core, as long as there is memory for them."""
    free = available_memory() or math.inf
    return int(max(1, min(os.cpu_count() or 1, free // WORKER_BYTES)))


@contextmanager
def connected(workers: int | None, scheduler: str | None) -> Iterator[Workers]:
    """Workers of our own, or those of the scheduler at an address."""
    if scheduler is not None:
        with cluster_at(scheduler, run_job) as cluster:
            yield cluster
        return
    processes = Processes(workers or default_workers(), run_job)
    try:
        yield processes
    finally:
        processes.close()


def run_sweep(
    plan: Plan,
    folder: Path | str,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    retry_failed: bool = False,
    progress: Progress | None = None,
) -> None:
    r"""Run what is missing of a sweep.

    Parameters
    ----------
    plan : from `load_sweep`
    folder : of the outcomes; on a cluster one that every worker reaches under this path
    workers : processes on this machine; None: `default_workers`
    scheduler : address of a Dask scheduler to use instead, such as tls://10.0.0.1:8786
    retry_failed : run points again that failed before
    progress : called after every point

    Raises
    ------
    SweepError  If the scheduler cannot be reached.
    PointsLeft  If the machine did not let points end.
    SchedulerLost  If it is lost on the way.
    isac_rt.storage.StorageError  If the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import isac_rt as irt
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "two.yaml"
    ...     _ = file.write_text(
    ...         f"name: two\nscenario: {Path('scenes/paper_swarm_consistent.yaml').resolve()}\n"
    ...         "set: {frames: 4}\naxes: {snr_db: {key: noise.snr_db, values: [0, 10]}}\n"
    ...     )
    ...     irt.run_sweep(irt.load_sweep(file), Path(folder) / "out", workers=1)
    ...     outcomes = irt.open_sweep(Path(folder) / "out")
    >>> outcomes.state.values.ravel().tolist()
    [1, 1]
    """
    outcomes = Outcomes(Path(folder).resolve())
    outcomes.save_definition(plan)
    todo = sum(1 for _ in pending(plan, outcomes, retry_failed))
    total = plan.num_points
    if progress:
        progress(total - todo, 0, total)
    if not todo:
        return
    with connected(workers, scheduler) as client:
        missing = pending(plan, outcomes, retry_failed)
        run_points(plan, outcomes, client, _job, missing, total - todo, retry_failed, progress)


def _job(point: Point, **fields: Any) -> Job:
    return Job(**fields)


def run_points(
    plan: Points,
    outcomes: Outcomes,
    workers: Workers,
    job: Callable[..., Job],
    missing: Iterator[Point],
    done: int,
    retry_failed: bool = False,
    progress: Progress | None = None,
) -> None:
    """Run what is missing among points.

    Parameters
    ----------
    job : makes what a worker gets of a point; called with the point and the fields of `Job`
    missing : points that are to be run
    done : points that are done already

    Raises
    ------
    PointsLeft, SchedulerLost  As `run_sweep`.
    """
    _Runner(plan, outcomes, workers, job, done, retry_failed, progress).run(missing)


class _Runner:
    """Keeps workers busy and counts what comes back.

    Of the points that share their paths one goes first; the others follow when its paths are on the
    disk. Points that the machine did not let end are tried again when the others are done.
    """

    def __init__(
        self,
        plan: Points,
        outcomes: Outcomes,
        workers: Workers,
        job: Callable[..., Job],
        done: int,
        retry_failed: bool,
        progress: Progress | None,
    ) -> None:
        self._plan, self._outcomes, self._workers, self._job = plan, outcomes, workers, job
        self._retry_failed, self._progress = retry_failed, progress
        self._done, self._failed = done, 0
        self._ready: deque[Point] = deque()
        self._leading: dict[str, deque[Point]] = {}
        self._traced: set[str] = set()
        self._active: dict[str, Point] = {}
        self._deaths: Counter[str] = Counter()
        self._left: dict[str, tuple[Point, str]] = {}
        self._in_a_row = 0

    def run(self, missing: Iterator[Point]) -> None:
        """Run until every missing point is done, failed or left."""
        self._pass(missing)
        if self._left and not self._stuck:
            again, self._left, self._in_a_row = self._left, {}, 0
            self._pass(iter([point for point, _ in again.values()]))
        if self._left:
            (point, why), *_ = self._left.values()
            raise PointsLeft(
                f"the machine did not let {len(self._left)} of {self._plan.num_points} "
                f"points end, {self._done} are done and kept; at {list(point.index)}: {why}; mend "
                "it and start the same command again"
            )

    @property
    def _stuck(self) -> bool:
        return self._in_a_row >= max(PATIENCE, 2 * self._workers.capacity)

    def _pass(self, points: Iterator[Point]) -> None:
        self._fill(points)
        while self._active:
            try:
                key, ended = self._workers.ended()
            except SchedulerLost as problem:
                raise SchedulerLost(
                    f"the scheduler was lost ({problem}); {self._done} of "
                    f"{self._plan.num_points} points are done and kept: start the same command "
                    "again to go on"
                ) from problem
            self._finish(key, ended)
            self._fill(points)

    def _fill(self, points: Iterator[Point]) -> None:
        """Give the workers as many points as they take; followers of a leader at work wait."""
        while len(self._active) < self._workers.capacity and not self._stuck:
            point = self._ready.popleft() if self._ready else self._next(points)
            if point is None:
                return
            self._give(point)

    def _next(self, points: Iterator[Point]) -> Point | None:
        """The next point that need not wait; None where all that are left do."""
        while sum(map(len, self._leading.values())) < FOLLOWERS:
            point = next(points, None)
            if point is None:
                return None
            if point.key in self._active:
                continue  # the same scenario twice in one sweep
            if point.paths_key is None or point.paths_key in self._traced:
                return point
            if point.paths_key not in self._leading:
                self._leading[point.paths_key] = deque()
                return point
            self._leading[point.paths_key].append(point)
        return None

    def _give(self, point: Point) -> None:
        job = self._job(
            point,
            key=point.key,
            tree=point.tree,
            ground=point.ground,
            scenario_folder=str(self._plan.base.folder),
            folder=str(self._outcomes.folder),
            threads=max(1, (os.cpu_count() or 1) // self._workers.number),
            retry_failed=self._retry_failed,
        )
        self._active[point.key] = point
        self._workers.give(point.key, job)

    def _finish(self, key: str, ended: Ended) -> None:
        point = self._active.pop(key)
        if ended.status == LOST:
            self._deaths[key] += 1
            if self._deaths[key] < LOST_AFTER:
                self._give(point)
                return
            ended = Ended(LEFT, lost_often())
        if ended.status == LEFT:
            self._left[key] = point, ended.why
            self._in_a_row += 1
        else:
            self._in_a_row = 0
            self._done += ended.status == "done"
            self._failed += ended.status == "failed"
        if self._progress:
            self._progress(self._done, self._failed, self._plan.num_points)
        if point.paths_key is not None:
            self._traced.add(point.paths_key)
            self._ready.extend(self._leading.pop(point.paths_key, ()))
