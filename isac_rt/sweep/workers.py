"""Who runs the points of a sweep: processes of our own, which open no port, or a Dask cluster that
the user named."""

from __future__ import annotations

import logging
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection, get_context, parent_process
from typing import Any, NamedTuple, Protocol

from isac_rt.runtime import MissingPackage, UserError

JOBS_PER_THREAD = 4
"""Jobs that a cluster is given ahead, for each thread of a worker."""
LOST_AFTER = 5
"""Workers that a job may take with it before it is left to do."""
CONNECT_S = 5
"""Time in which a scheduler has to answer. [s]"""
LEFT, LOST = "left", "lost"


class SweepError(UserError):
    """The sweep cannot start. The text says what to do."""


class SchedulerLost(Exception):
    """The cluster's scheduler is gone; what was finished is kept."""


class Ended(NamedTuple):
    """End of a job: its outcome's status; `LEFT` with the reason, where the machine did not let it
    end; or `LOST`, where its worker died."""

    status: str
    why: str = ""
    worker: str = ""


class Workers(Protocol):
    """Runs jobs in any order."""

    number: int
    """Worker processes."""
    capacity: int
    """Jobs that may be given at once."""

    def give(self, key: str, job: Any) -> None:
        """Hand a job to a worker."""
        ...

    def ended(self) -> tuple[str, Ended]:
        """Wait for a job to end; its key and what came of it.

        Raises
        ------
        SchedulerLost  If it is not known what becomes of the jobs.
        """
        ...


class Processes:
    """Processes of this program, each connected by a pair of sockets without a name.

    They end with the process that began them, however it ends, and are not stopped by Ctrl-C
    themselves. Their Python imports nothing from the working folder.
    """

    def __init__(self, number: int, run: Callable[[Any], Ended]) -> None:
        self.number = self.capacity = number
        self._context, self._run = get_context("spawn"), run
        self._idle = [self._begun() for _ in range(number)]
        self._at_work: dict[connection.Connection, tuple[Any, str]] = {}

    def give(self, key: str, job: Any) -> None:
        """Hand a job to an idle process."""
        process, pipe = self._idle.pop()
        with suppress(OSError):  # it died: `ended` says so
            pipe.send(job)
        self._at_work[pipe] = process, key

    def ended(self) -> tuple[str, Ended]:
        """Wait for a job to end, or for its process to die, which is replaced."""
        pipe = connection.wait(self._at_work)[0]
        assert isinstance(pipe, connection.Connection)
        process, key = self._at_work.pop(pipe)
        try:
            found: Ended = pipe.recv()
        except (EOFError, OSError):
            pipe.close()
            process.join()
            self._idle.append(self._begun())
            return key, Ended(LOST)
        self._idle.append((process, pipe))
        return key, found

    def close(self) -> None:
        """End all processes at once."""
        for process, pipe in [*self._idle, *((p, c) for c, (p, _) in self._at_work.items())]:
            process.kill()
            process.join()
            pipe.close()

    def _begun(self) -> tuple[Any, connection.Connection]:
        """A new process and our end of its pipe."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(theirs, self._run), daemon=True)
        with _safe_path():
            process.start()
        theirs.close()
        return process, ours


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let processes that begin meanwhile import nothing from the working folder."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def _serve(pipe: connection.Connection, run: Callable[[Any], Ended]) -> None:
    """Run jobs until the other end closes; in a worker. A warning is said once for all of them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    show, said = warnings.showwarning, set[str]()

    def once(message: Warning | str, *about: Any, **more: Any) -> None:
        if str(message) not in said:
            said.add(str(message))
            show(message, *about, **more)

    vars(warnings)["showwarning"] = once
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            job = pipe.recv()
            try:
                found = run(job)
            except Exception as problem:
                found = Ended(LEFT, f"{type(problem).__name__}: {problem}")
            pipe.send(found)


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGKILL)


class Cluster:
    """A Dask cluster. Jobs whose workers die are given out again by its scheduler."""

    def __init__(self, client: Any, run: Callable[[Any], Ended]) -> None:
        from distributed import as_completed

        threads = client.nthreads()
        self.number = max(len(threads), 1)
        self.capacity = JOBS_PER_THREAD * max(sum(threads.values()), 2)
        self._client, self._run, self._queue = client, run, as_completed([])
        self._given, self._keys = 0, dict[str, str]()
        self._troubled = set[str]()

    def give(self, key: str, job: Any) -> None:
        """Submit a job, rather to workers that had no trouble with an earlier one."""
        self._given += 1
        task = f"point-{key}-{self._given}"  # a new name, or an old result would be taken
        self._keys[task] = key
        well = self._troubled and [w for w in self._client.nthreads() if w not in self._troubled]
        rather = {"workers": well, "allow_other_workers": True} if well else {}
        self._queue.add(self._client.submit(self._run, job, key=task, pure=False, **rather))

    def ended(self) -> tuple[str, Ended]:
        """Wait for a job to end."""
        from distributed import CancelledError

        try:
            future = next(self._queue)
            if future.cancelled():
                raise CancelledError("its tasks are gone")
            key = self._keys.pop(future.key)
            found = self._found(future)
            future.release()
        except (CancelledError, OSError, StopIteration) as problem:
            raise SchedulerLost(str(problem)) from problem
        self._troubled |= {found.worker} - {""} if found.status == LEFT else set()
        return key, found

    def _found(self, future: Any) -> Ended:
        if future.status == LOST:
            return Ended(LOST)
        if future.status != "error":
            answer: Ended = future.result()
            return answer
        problem = future.exception()
        if type(problem).__name__ == "KilledWorker":
            return Ended(LEFT, lost_often())
        return Ended(LEFT, f"{type(problem).__name__}: {problem}")


def lost_often() -> str:
    """Say why a job is left that took its workers with it."""
    return f"{LOST_AFTER} workers in turn died while they ran it (out of memory?)"


@contextmanager
def cluster_at(address: str, run: Callable[[Any], Ended]) -> Iterator[Cluster]:
    """Connect to the scheduler at an address, by the certificates of Dask's own configuration.

    Raises
    ------
    SweepError  If the address is not of TLS, or nobody answers there.
    MissingPackage  If Dask is not installed.
    """
    if not address.startswith("tls://"):
        raise SweepError(
            f"--scheduler {address}: a scheduler without TLS lets everybody who reaches it run "
            "code as you; start it with certificates (dask scheduler --protocol tls --tls-ca-file "
            "... --tls-cert ... --tls-key ...), name them in Dask's configuration "
            "(distributed.comm.tls), and write tls://HOST:PORT"
        )
    try:
        import dask
        from distributed import Client
    except ModuleNotFoundError as problem:
        raise MissingPackage(
            "--scheduler needs Dask: pip install 'isac_rt[cluster]', or leave it out"
        ) from problem
    settings = {
        "distributed.scheduler.allowed-failures": LOST_AFTER,
        "distributed.comm.timeouts.connect": f"{CONNECT_S}s",
    }
    with dask.config.set(settings), _silent("distributed", "distributed.client"):
        try:
            client = Client(address, timeout=CONNECT_S)
        except (OSError, TimeoutError, TypeError, ValueError) as problem:
            raise SweepError(
                f"no scheduler answers at {address}: {problem}; start one with `dask scheduler "
                "--protocol tls`, name its certificates in Dask's configuration, or leave "
                "--scheduler out"
            ) from problem
        try:
            yield Cluster(client, run)
        finally:
            with suppress(Exception):
                client.close(timeout=2)


@contextmanager
def _silent(*names: str) -> Iterator[None]:
    """Silence loggers short of a crash: a lost scheduler is one message of ours, and none of theirs
    with a traceback. Dask sets their levels when it is loaded."""
    loggers = [logging.getLogger(name) for name in names]
    before = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
