"""Running the points of a sweep on Dask: an embedded cluster, or a scheduler that is already there.

The scheduler sees a window of small tasks and gets back a few words for each; outcomes go straight
from the worker to the disk. So neither client nor scheduler grows with the sweep, and whoever is
killed takes nothing with it that was finished.
"""

from __future__ import annotations

import json
import logging
import math
import os
import platform
import shutil
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from isac_rt.runtime import MachineProblem, UserError, available_memory, of_machine
from isac_rt.sweep.definition import Plan, Point, Points, ground_of
from isac_rt.sweep.outcomes import Outcomes, pending

if TYPE_CHECKING:
    from isac_rt.propagation.store import PathStore
    from isac_rt.scenario.tree import Scenario
    from isac_rt.simulation.setup import Setup

WINDOW = 4
"""Tasks that the scheduler is given ahead, for each thread of a worker."""
WORKER_BYTES = 1.5e9
"""Memory that a worker is reckoned with when their number is chosen: a ray-traced city, three
receivers at work."""
LOST_AFTER = 5
"""Workers that a point may take with it before it is left to do."""
PATIENCE = 2
"""Windows of points in a row that the machine did not let end: then the sweep stops."""
ROOM = 1_000_000
"""Free disk without which no point is begun. [bytes]"""
CONNECT_S = 5
CACHE_BYTES = 4 * 1024**3

KEPT = ("links", "terminals", "swarm", "compared", "paths", "fidelity", "timing_s", "versions")
"""What an outcome holds of a summary."""
BESIDE = ("shard", "by_frame")
"""What some jobs make beside it."""

Progress = Callable[[int, int, int], None]
"""Called with points done, failed, and in all."""


class SweepError(UserError):
    """The sweep cannot start. The text says what to do."""


class PointsLeft(MachineProblem):
    """The machine did not let some points end; what was finished is kept. The text says why."""


class SchedulerLost(Exception):
    """The sweep cannot go on; what was finished is kept."""


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


class Ended(NamedTuple):
    """What came of a point at a worker: its outcome's status, or "left" and why."""

    status: str
    why: str = ""
    worker: str = ""


def run_job(job: Job) -> Ended:
    """Simulate a point and write its outcome; in a worker.

    Only an error that the point's own content causes is an outcome. Where the machine is to blame
    (its disk, its memory, a folder that it does not see) nothing is recorded, and the point is left
    to do. Dask repeats a task whose worker dies before its word reached the client; a point whose
    outcome is there is not repeated.
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
        return Ended("left", f"{platform.node()}: {_words(problem)}", _address())
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
    if shutil.disk_usage(outcomes.points).free < ROOM:
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
        about |= {"status": "done", **{name: made[name] for name in KEPT + BESIDE if name in made}}
        json.dumps(about, allow_nan=False)
    except Exception as problem:
        if of_machine(problem):
            raise
        where = "".join(traceback.format_exception(problem)[-3:])
        about = {"scenario": job.tree, "status": "failed", "error": _words(problem), "where": where}
    return about | {"seconds": time.perf_counter() - begin}


def _words(problem: BaseException) -> str:
    return f"{type(problem).__name__}: {problem}" if str(problem) else type(problem).__name__


def _address() -> str:
    """Of this worker; "" outside of a cluster."""
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
def _silent(*names: str) -> Iterator[None]:
    """Without what some loggers say short of a crash: a lost scheduler is one message of ours, and
    none of theirs with a traceback. Dask sets their levels when it is loaded."""
    loggers = [logging.getLogger(name) for name in names]
    before = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


@contextmanager
def connected(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a cluster of our own with one thread a
    worker."""
    import dask
    from distributed import Client, LocalCluster

    quiet = {
        "distributed.scheduler.allowed-failures": LOST_AFTER,
        "distributed.worker.daemon": True,
        "distributed.comm.timeouts.connect": f"{CONNECT_S}s",
    }
    with dask.config.set(quiet), _silent("distributed", "distributed.client"):
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout=CONNECT_S)
            except (OSError, TimeoutError, ValueError) as problem:
                said = (
                    f"no scheduler answers at {scheduler}: {problem}; start one with `dask "
                    "scheduler`, or leave --scheduler out"
                )
                raise SweepError(said) from problem
            try:
                yield client
            finally:
                with suppress(Exception):
                    client.close(timeout=2)
            return
        cluster = LocalCluster(
            n_workers=workers or default_workers(),
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            silence_logs=50,
        )
        number = len(cluster.workers)
        cluster.adapt(minimum=number, maximum=number)  # one that could not start again is replaced
        client = Client(cluster)
        try:
            yield client
        finally:
            with suppress(Exception):
                client.close(timeout=2)
                cluster.close(timeout=5)


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
    workers : processes of the embedded cluster; None: `default_workers`
    scheduler : address of a Dask scheduler to use instead, such as tcp://10.0.0.1:8786
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
    client: Any,
    job: Callable[..., Job],
    missing: Iterator[Point],
    done: int,
    retry_failed: bool = False,
    progress: Progress | None = None,
) -> None:
    """Run what is missing among points at a client's workers.

    Parameters
    ----------
    job : makes what a worker gets of a point; called with the point and the fields of `Job`
    missing : points that are to be run
    done : points that are done already

    Raises
    ------
    PointsLeft, SchedulerLost  As `run_sweep`.
    """
    _Runner(plan, outcomes, client, job, done, retry_failed, progress).run(missing)


class _Runner:
    """Feeds the scheduler from a window and counts what comes back.

    Of the points that share their paths one goes first; the others follow when its paths are on the
    disk. Points that the machine did not let end are tried again when the others are done, rather
    at workers that had no such trouble.
    """

    def __init__(
        self,
        plan: Points,
        outcomes: Outcomes,
        client: Any,
        job: Callable[..., Job],
        done: int,
        retry_failed: bool,
        progress: Progress | None,
    ) -> None:
        self._job = job
        self._retry_failed = retry_failed
        self._plan, self._outcomes, self._client, self._progress = plan, outcomes, client, progress
        self._done, self._failed = done, 0
        threads = sum(client.nthreads().values()) or 1
        here = os.cpu_count() or 1
        self._threads = max(1, here // max(len(client.nthreads()), 1))
        self._window = WINDOW * max(threads, 2)
        self._leading: dict[str, deque[Point]] = {}
        self._traced: set[str] = set()
        self._waiting = 0
        self._active: dict[str, Point] = {}
        self._left: dict[str, tuple[Point, str]] = {}
        self._in_a_row = 0
        self._troubled: set[str] = set()
        self._numbers = count()

    def run(self, missing: Iterator[Point]) -> None:
        """Until every missing point is done, failed or left."""
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
        return self._in_a_row >= PATIENCE * self._window

    def _pass(self, points: Iterator[Point]) -> None:
        from distributed import CancelledError, as_completed

        queue = as_completed([])
        self._fill(points, queue)
        try:
            for future in queue:
                self._finish(future, queue)
                self._fill(points, queue)
        except (CancelledError, OSError) as problem:
            raise self._lost(problem) from problem
        if self._active:
            raise self._lost(None)

    def _lost(self, problem: BaseException | None) -> SchedulerLost:
        why = f" ({problem})" if problem is not None and str(problem) else ""
        return SchedulerLost(
            f"the scheduler was lost{why}; {self._done} of {self._plan.num_points} points "
            "are done and kept: "
            "start the same command again to go on"
        )

    def _fill(self, points: Iterator[Point], queue: Any) -> None:
        """Give the scheduler points up to the window; followers of a running leader wait, at most a
        window of them."""
        while (
            len(self._active) < self._window
            and self._waiting < 64 * self._window
            and not self._stuck
        ):
            point = next(points, None)
            if point is None:
                return
            if point.key in self._active:
                continue  # the same scenario twice in one sweep
            if point.paths_key is not None and point.paths_key not in self._traced:
                if point.paths_key in self._leading:
                    self._leading[point.paths_key].append(point)
                    self._waiting += 1
                    continue
                self._leading[point.paths_key] = deque()
            self._submit(point, queue)

    def _submit(self, point: Point, queue: Any) -> None:
        job = self._job(
            point,
            key=point.key,
            tree=point.tree,
            ground=point.ground,
            scenario_folder=str(self._plan.base.folder),
            folder=str(self._outcomes.folder),
            threads=self._threads,
            retry_failed=self._retry_failed,
        )
        self._active[point.key] = point
        good = self._troubled and [w for w in self._client.nthreads() if w not in self._troubled]
        rather = {"workers": good, "allow_other_workers": True} if good else {}
        task = f"point-{point.key}-{next(self._numbers)}"  # never one that may be forgotten
        queue.add(self._client.submit(run_job, job, key=task, pure=False, **rather))

    def _finish(self, future: Any, queue: Any) -> None:
        from distributed import CancelledError

        if future.cancelled():
            raise CancelledError("its tasks are gone")
        key = future.key.split("-")[1]
        point = self._active.pop(key)
        if future.status == "lost":  # its worker died before its word was heard
            future.release()
            self._submit(point, queue)
            return
        ended = Ended("left", _of_worker(future)) if future.status == "error" else future.result()
        future.release()
        if ended.status == "left":
            self._left[key] = point, ended.why
            self._in_a_row += 1
            self._troubled |= {ended.worker} - {""}
        else:
            self._in_a_row = 0
            self._done += ended.status == "done"
            self._failed += ended.status == "failed"
        if self._progress:
            self._progress(self._done, self._failed, self._plan.num_points)
        if point.paths_key is not None:
            self._traced.add(point.paths_key)
            for follower in self._leading.pop(point.paths_key, ()):
                self._waiting -= 1
                self._submit(follower, queue)


def _of_worker(future: Any) -> str:
    """What took a worker's task down."""
    problem = future.exception()
    if type(problem).__name__ == "KilledWorker":
        return f"{LOST_AFTER} workers in turn died while they ran it (out of memory?)"
    return _words(problem)
