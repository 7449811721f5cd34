"""Running the points of a sweep on Dask: an embedded cluster, or a scheduler that is already there.

The scheduler sees a window of small tasks and gets back a few words for each; outcomes go straight
from the worker to the disk. So neither client nor scheduler grows with the sweep, and whoever is
killed takes nothing with it that was finished.
"""

from __future__ import annotations

import math
import os
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from isac_rt.runtime import UserError, available_memory
from isac_rt.sweep.definition import Plan, Point
from isac_rt.sweep.outcomes import Outcomes, pending

WINDOW = 4
"""Tasks that the scheduler is given ahead, for each thread of a worker."""
WORKER_BYTES = 1.5e9
"""Memory that a worker is reckoned with when their number is chosen: a ray-traced city, three
receivers at work."""
LOST_AFTER = 5
"""Workers that a point may take with it before it counts as failed: one that is killed from outside
must not condemn its points."""
CONNECT_S = 5
CACHE_BYTES = 4 * 1024**3

Progress = Callable[[int, int, int], None]
"""Called with points done, failed, and in all."""


class SweepError(UserError):
    """The sweep cannot start. The text says what to do."""


class SchedulerLost(Exception):
    """The sweep cannot go on; what was finished is kept."""


@dataclass(frozen=True)
class Job:
    """One point as a worker gets it: plain values only."""

    key: str
    tree: dict[str, Any]
    scenario_folder: str
    folder: str
    threads: int
    retry_failed: bool = False


def run_job(job: Job) -> tuple[str, bool]:
    """Simulate a point and write its outcome; in a worker. Returns its key and whether it
    succeeded.

    An outcome that cannot be written (a full disk) raises: then nothing is recorded, and the point
    is run again next time. Dask repeats a task whose worker dies before its word reached the
    client; a point whose outcome is there is not repeated.
    """
    outcomes = Outcomes(Path(job.folder))
    if outcomes.done(job.key, job.retry_failed):
        return job.key, (outcomes.read(job.key) or {}).get("status") == "done"
    begin = time.perf_counter()
    try:
        summary = _simulate(job)
    except Exception as problem:
        where = traceback.format_exception(problem)[-3:]
        text = f"{type(problem).__name__}: {problem}" if str(problem) else type(problem).__name__
        outcome = {"status": "failed", "error": text, "where": "".join(where)}
    else:
        outcome = {
            "status": "done",
            **{
                key: summary[key]
                for key in ("links", "terminals", "paths", "fidelity", "timing_s", "versions")
            },
        }
    outcomes.write(
        job.key,
        {"key": job.key, "scenario": job.tree, "seconds": time.perf_counter() - begin, **outcome},
    )
    return job.key, outcome["status"] == "done"


def _simulate(job: Job) -> dict[str, Any]:
    from isac_rt.propagation.store import PathStore
    from isac_rt.scenario.tree import Scenario
    from isac_rt.simulation import simulate
    from isac_rt.simulation.setup import prepare

    scenario = Scenario.model_validate(job.tree).in_folder(Path(job.scenario_folder))
    store = PathStore(Path(job.folder) / "paths", CACHE_BYTES)
    if scenario.propagation.model == "ray_traced":
        _limit_tracer(job.threads)
    setup = prepare(scenario, store)
    return simulate.summarise(scenario, setup=setup, threads=job.threads)


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
def _client(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a cluster of our own with one thread a
    worker."""
    import dask
    from distributed import Client, LocalCluster

    quiet = {
        "distributed.scheduler.allowed-failures": LOST_AFTER,
        "distributed.worker.daemon": True,
        "distributed.comm.timeouts.connect": f"{CONNECT_S}s",
        "distributed.logging.distributed": "critical",
    }
    with dask.config.set(quiet):
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
    SchedulerLost  If it is lost on the way.
    isac_rt.results.files.ResultsError  If the folder cannot be written.

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
    total = plan.sweep.num_points
    if progress:
        progress(total - todo, 0, total)
    if not todo:
        return
    with _client(workers, scheduler) as client:
        _Runner(plan, outcomes, client, total - todo, retry_failed, progress).run(
            pending(plan, outcomes, retry_failed)
        )


class _Runner:
    """Feeds the scheduler from a window and counts what comes back.

    Of the points that share their paths one goes first; the others follow when its paths are on the
    disk.
    """

    def __init__(
        self,
        plan: Plan,
        outcomes: Outcomes,
        client: Any,
        done: int,
        retry_failed: bool,
        progress: Progress | None,
    ) -> None:
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

    def run(self, points: Iterator[Point]) -> None:
        """Until every point is done or failed."""
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
            f"the scheduler was lost{why}; {self._done} of {self._plan.sweep.num_points} points "
            "are done and kept: "
            "start the same command again to go on"
        )

    def _fill(self, points: Iterator[Point], queue: Any) -> None:
        """Give the scheduler points up to the window; followers of a running leader wait, at most a
        window of them."""
        while len(self._active) < self._window and self._waiting < 64 * self._window:
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
        job = Job(
            point.key,
            point.tree,
            str(self._plan.base.folder),
            str(self._outcomes.folder),
            self._threads,
            self._retry_failed,
        )
        self._active[point.key] = point
        queue.add(self._client.submit(run_job, job, key=f"point-{point.key}", pure=False))

    def _finish(self, future: Any, queue: Any) -> None:
        from distributed import CancelledError

        key = future.key.removeprefix("point-")
        point = self._active.pop(key)
        if future.cancelled() or future.status == "lost":
            self._active[key] = point
            raise CancelledError("its tasks are gone")
        if future.status == "error":
            self._outcomes.write(
                key,
                {
                    "key": key,
                    "scenario": point.tree,
                    "status": "failed",
                    "error": _of_worker(future),
                    "where": "",
                },
            )
            good = False
        else:
            good = future.result()[1]
        future.release()
        self._done, self._failed = self._done + good, self._failed + (not good)
        if self._progress:
            self._progress(self._done, self._failed, self._plan.sweep.num_points)
        if point.paths_key is not None:
            self._traced.add(point.paths_key)
            for follower in self._leading.pop(point.paths_key, ()):
                self._waiting -= 1
                self._submit(follower, queue)


def _of_worker(future: Any) -> str:
    """What took a worker's task down."""
    problem = future.exception()
    name = type(problem).__name__
    if name == "KilledWorker":
        return (
            f"KilledWorker: {LOST_AFTER} workers in turn died while they ran this point (out of "
            "memory?)"
        )
    return f"{name}: {problem}"
