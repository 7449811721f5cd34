"""What a sweep does with files that are not its own and with machines that will not do: it believes
no file, blames no point, and loses nothing."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from collections import deque
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_sweep import BASE, SWEEP, job_of, plan_of, run_here, same, start_client

from isac_rt import storage
from isac_rt.cli.cli import main
from isac_rt.document import ScenarioError
from isac_rt.propagation.store import PathStore
from isac_rt.results.files import ResultsError
from isac_rt.sweep import Outcomes, PointsLeft, execute, open_sweep, run_sweep, save_dataset, status
from isac_rt.sweep.definition import Point
from isac_rt.sweep.execute import FREE_BYTES, run_job
from isac_rt.sweep.outcomes import _checksum
from isac_rt.sweep.workers import Ended


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "base.yaml").write_text(BASE)
    return tmp_path


@pytest.fixture(scope="module")
def done_sweep(tmp_path_factory):
    """Run a sweep of four points; return its plan and its outcomes."""
    folder = tmp_path_factory.mktemp("done")
    (folder / "base.yaml").write_text(BASE)
    plan = plan_of(folder, SWEEP.replace("values: [-31, -9.5, 12]", "values: [-31]"))
    outcomes = Outcomes(folder / "out")
    outcomes.save_definition(plan)
    run_here(plan, outcomes.folder)
    return plan, outcomes


@pytest.fixture
def sweep(done_sweep, tmp_path):
    """A sweep of four points with all outcomes there, in a copy; plan, outcomes, points."""
    plan, outcomes = done_sweep
    shutil.copytree(outcomes.folder, tmp_path / "out")
    return plan, Outcomes(tmp_path / "out"), list(plan.points())


# ---- files


def edited(text: str, **values) -> str:
    return json.dumps(json.loads(text) | values)


def sealed(outcome: dict) -> str:
    """As this package would seal it."""
    outcome.pop("checksum")
    return json.dumps(outcome | {"checksum": _checksum(outcome["key"], outcome)})


SPOILT = {
    "empty": lambda mine, other: "",
    "half": lambda mine, other: mine[: len(mine) // 2],
    "without its end": lambda mine, other: mine.rstrip()[:-1],
    "another point's": lambda mine, other: other,
    "another's under this key": lambda mine, other: edited(other, key=json.loads(mine)["key"]),
    "a number": lambda mine, other: mine.replace('"matched": ', '"matched": 1', 1),
    "a status": lambda mine, other: edited(mine, status="failed"),
    "no key": lambda mine, other: "{}",
    "a list": lambda mine, other: "[1]",
    "a word": lambda mine, other: '"done"',
    "deep": lambda mine, other: "[" * 100_000,
    "long": lambda mine, other: f"[{'9' * 10_000}]",
    "not text": lambda mine, other: "\udcff\udcfe",
    "no status": lambda mine, other: sealed(json.loads(mine) | {"status": "soon"}),
    "links of words": lambda mine, other: sealed(json.loads(mine) | {"links": {"A->A": "x"}}),
    "counts of words": lambda mine, other: sealed(
        json.loads(mine) | {"links": {"A->A": {"counts": {"ber": ["x", 1]}}}}
    ),
    "paths of words": lambda mine, other: sealed(json.loads(mine) | {"paths": {"ghost": "x"}}),
    "errors of numbers": lambda mine, other: sealed(json.loads(mine) | {"error": 3}),
}


@pytest.mark.parametrize("how", SPOILT)
def test_a_spoilt_point_file_counts_for_nothing_and_is_made_anew(sweep, how):
    """The status, the dataset and the next call take the point for not done, and then it is the
    same as before. Planted bugs: `is_file` for done; the key not compared; the checksum not
    compared."""
    plan, outcomes, points = sweep
    whole = open_sweep(outcomes.folder)
    file, other = (outcomes.file(points[i].key) for i in (1, 2))
    spoilt = SPOILT[how](file.read_text(), other.read_text())
    assert spoilt != file.read_text()
    file.write_bytes(spoilt.encode("utf-8", "surrogateescape"))
    found = status(outcomes.folder)
    assert (found.done, found.failed) == (3, 0)
    assert open_sweep(outcomes.folder).state.values.ravel().tolist() == [1, 0, 1, 1]
    stamps = {p.key: outcomes.file(p.key).stat().st_mtime_ns for p in points}
    run_here(plan, outcomes.folder)
    same(open_sweep(outcomes.folder), whole)
    new = {p.key: outcomes.file(p.key).stat().st_mtime_ns for p in points}
    assert {key for key in new if new[key] != stamps[key]} == {points[1].key}


def test_a_pipe_or_a_giant_in_a_point_s_place_is_not_waited_for(sweep):
    plan, outcomes, points = sweep
    file = outcomes.file(points[0].key)
    file.unlink()
    os.mkfifo(file)
    assert status(outcomes.folder).done == 3
    run_here(plan, outcomes.folder)
    assert status(outcomes.folder).done == 4
    with file.open("r+b") as opened:
        opened.truncate(10 * 1024**3)  # a hole: nothing on the disk
    assert outcomes.read(points[0].key) is None


@pytest.mark.parametrize("spoilt", ["", "[]", "{}", "[" * 100_000, '{"sweep": 3, "base": 4}', None])
def test_a_spoilt_definition_is_one_message(sweep, spoilt, capsys):
    _, outcomes, _ = sweep
    file = outcomes.folder / "sweep.json"
    if spoilt is None:
        spoilt = edited(file.read_text(), folder=7)
    file.write_text(spoilt)
    assert main(["sweep", "--status", str(outcomes.folder)]) == 2
    assert "holds no sweep" in capsys.readouterr().err


def test_a_bent_dataset_is_refused_or_its_numbers_are_the_same(sweep):
    """One of an earlier version, which is read as it is. Planted bug: no checksums asked for."""
    _, outcomes, _ = sweep
    whole = open_sweep(outcomes.folder).assign_attrs(program="earlier")
    content = save_dataset(whole, outcomes.folder).read_bytes()
    file = outcomes.folder / "sweep.nc"
    refused = 0
    for i in range(0, len(content), len(content) // 6):
        file.write_bytes(content[:i] + bytes([content[i] ^ 0x55]) + content[i + 1 :])
        try:
            found = open_sweep(outcomes.folder)
        except ResultsError:
            refused += 1
        else:
            for name, values in whole.data_vars.items():
                if values.dtype != object and name in found:
                    assert np.array_equal(found[name], values, equal_nan=True), (i, name)
    assert refused


# ---- machines


def not_there(monkeypatch, outcomes, folder):
    outcomes.points.rename(outcomes.folder / "elsewhere")
    return "does not see"


def full(monkeypatch, outcomes, folder):
    def fsync(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(storage.os, "fsync", fsync)
    return "No space left"


def nearly_full(monkeypatch, outcomes, folder):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=FREE_BYTES - 1))
    return "no room is left"


def raising(problem):
    def broken(monkeypatch, outcomes, folder):
        def simulate(_):
            raise problem

        monkeypatch.setattr(execute.Job, "simulate", simulate)
        return str(problem) or type(problem).__name__

    return broken


def another_program(monkeypatch, outcomes, folder):
    monkeypatch.setattr("isac_rt.sweep.definition.program_fingerprint", lambda: "another")
    return "program are not those of the client"


def another_numpy(monkeypatch, outcomes, folder):
    monkeypatch.setattr("isac_rt.sweep.definition.versions", lambda: {"numpy": "1"})
    return "versions are not those of the client"


TROUBLE = {
    "folder": not_there,
    "full": full,
    "nearly full": nearly_full,
    "memory": raising(MemoryError()),
    "disk": raising(OSError(errno.EIO, "Input/output error")),
    "quota": raising(OSError(errno.EDQUOT, "Disk quota exceeded")),
    "tracer": raising(RuntimeError("jit_malloc(): out of memory!")),
    "program": another_program,
    "versions": another_numpy,
}


@pytest.mark.parametrize("what", TROUBLE)
def test_trouble_of_the_machine_is_no_failure_of_the_point(folder, what, monkeypatch):
    """Nothing is recorded, what to do is said, and the same job is done where the machine is
    well. Planted bugs: recorded as failed; a worker that makes its own folder."""
    plan = plan_of(folder)
    outcomes, point = Outcomes(folder / "out"), next(plan.points())
    outcomes.save_definition(plan)
    with monkeypatch.context() as broken:
        said = TROUBLE[what](broken, outcomes, folder)
        ended = run_job(job_of(plan, outcomes.folder, point))
    assert ended.status == "left" and said in ended.why
    assert not list(outcomes.folder.rglob(f"{point.key}*"))
    outcomes.points.mkdir(exist_ok=True)
    assert run_job(job_of(plan, outcomes.folder, point)).status == "done"
    assert outcomes.read(point.key)["status"] == "done"


def test_points_look_for_their_paths_in_the_sweep_s_folder(folder, monkeypatch):
    """Planted bug: a set-up without the store."""
    plan, outcomes, seen = plan_of(folder), Outcomes(folder / "out"), []
    outcomes.save_definition(plan)
    monkeypatch.setattr(
        "isac_rt.simulation.setup.prepare", lambda _, store=None: seen.append(store) or 1 / 0
    )
    assert run_job(job_of(plan, outcomes.folder, next(plan.points()))).status == "failed"
    assert seen == [PathStore(outcomes.folder / "paths", execute.CACHE_BYTES)]


@pytest.mark.parametrize(
    "problem",
    [
        ScenarioError("two bodies meet"),
        ValueError("x"),
        ZeroDivisionError(),
        FileNotFoundError(2, "f"),
    ],
)
def test_an_error_of_the_content_is_a_failure_of_the_point(folder, problem, monkeypatch):
    plan = plan_of(folder)
    outcomes, point = Outcomes(folder / "out"), next(plan.points())
    outcomes.save_definition(plan)
    raising(problem)(monkeypatch, outcomes, folder)
    assert run_job(job_of(plan, outcomes.folder, point)).status == "failed"
    kept = outcomes.read(point.key)
    assert type(problem).__name__ in kept["error"] and "simulate" in kept["where"]


def test_a_worker_that_sees_other_files_of_the_city_does_nothing(folder):
    """Its outcome would stand under the key of another. A city that is missing everywhere is the
    point's own failure. Planted bug: the worker's files not looked at."""
    (folder / "base.yaml").write_text(BASE + "city: {source: mesh, file: h.obj}\n")
    house = folder / "h.obj"
    house.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl itu_concrete\nf 1 2 3\n")
    plan = plan_of(folder)
    outcomes, point = Outcomes(folder / "out"), next(plan.points())
    outcomes.save_definition(plan)
    house.write_text(house.read_text().replace("v 1 0", "v 2 0"))
    ended = run_job(job_of(plan, outcomes.folder, point))
    assert ended.status == "left" and "city are not those of the client" in ended.why
    house.unlink()
    assert run_job(job_of(plan, outcomes.folder, point)).status == "left"
    missing = next(plan.points())
    assert missing.key != point.key
    assert run_job(job_of(plan, outcomes.folder, missing)).status == "failed"


# ---- the client


class Here:
    """Workers in this process, so that their trouble can be made; `given` are the keys in order."""

    def __init__(self, capacity=8, number=1):
        self.capacity, self.number, self.given, self._jobs = capacity, number, [], deque()

    def give(self, key, job):
        self.given.append(key)
        self._jobs.append((key, job))

    def ended(self):
        key, job = self._jobs.popleft()
        return key, run_job(job)


@pytest.fixture
def here(monkeypatch):
    @contextmanager
    def workers(*_):
        yield Here()

    monkeypatch.setattr(execute, "connected", workers)


def test_points_that_the_machine_left_are_tried_again_and_then_left(folder, here, monkeypatch):
    """One that is well at its second try is done; one that never is is left, and said. Planted
    bugs: one pass; the left counted as failed; nothing raised."""
    plan, out = plan_of(folder), folder / "out"
    never, once = (list(plan.points())[i].tree for i in (3, 7))
    calls = []
    simulate = execute.Job.simulate

    def flaky(job):
        calls.append(job.tree)
        if job.tree == never or (job.tree == once and calls.count(once) == 1):
            raise MemoryError
        return simulate(job)

    monkeypatch.setattr(execute.Job, "simulate", flaky)
    moved = []
    with pytest.raises(PointsLeft) as caught:
        run_sweep(plan, out, progress=lambda *counts: moved.append(counts))
    said = str(caught.value)
    assert "did not let 1 of 12 points end, 11 are done" in said and "MemoryError" in said
    assert str([0, 1, 1]) in said and "\n" not in said and moved[-1] == (11, 0, 12)
    assert len(calls) == 14 and (status(out).done, status(out).failed) == (11, 0)
    monkeypatch.setattr(execute.Job, "simulate", simulate)
    run_sweep(plan, out)
    assert status(out).done == 12


def test_of_points_that_share_paths_one_goes_first(folder):
    """Three of paths p, two of q, one of none: the followers of p wait until its first is back,
    with whatever outcome; later points of p do not wait. No more than the workers' capacity is at
    work, the same scenario is not given twice, and one whose worker died is given again. Planted
    bugs: the followers not held back, or never let go; every point of traced paths held back."""
    names = [("a", "p"), ("b", "p"), ("c", None), ("d", "q"), ("c", None), ("e", "p"), ("f", "q")]
    points = iter([Point((i,), {}, {}, key, paths) for i, (key, paths) in enumerate(names)])
    workers = Here(capacity=3)
    runner = execute._Runner(
        plan_of(folder), Outcomes(folder / "o"), workers, execute._job, 0, False, None
    )
    runner._fill(points)
    assert workers.given == ["a", "c", "d"]
    runner._finish("a", Ended("left", "no room"))
    runner._fill(points)
    assert workers.given == ["a", "c", "d", "b"]
    runner._finish("c", Ended("lost"))
    assert workers.given[4:] == ["c"]
    runner._finish("d", Ended("done"))
    runner._fill(points)
    assert workers.given[5:] == ["e"]
    runner._finish("b", Ended("done"))
    runner._fill(points)
    assert workers.given[6:] == ["f"]
    runner._finish("e", Ended("done"))
    runner._fill(iter([Point((i,), {}, {}, f"h{i}", "p") for i in range(20)]))
    assert workers.given[7:] == ["h0"]
    assert [why for _, why in runner._left.values()] == ["no room"]


def test_a_sweep_on_which_nothing_ends_stops_early(folder, here, monkeypatch):
    """After two windows of points. Planted bug: every point tried."""
    plan = plan_of(folder, SWEEP.replace("repetitions: 2", "repetitions: 50"))
    calls = []

    def broken(job):
        calls.append(job)
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(execute.Job, "simulate", broken)
    with pytest.raises(PointsLeft, match="Input/output error"):
        run_sweep(plan, folder / "out")
    assert 16 <= len(calls) <= 16 + 8 < plan.sweep.num_points
    assert status(folder / "out").failed == 0


@pytest.mark.slow
def test_a_sweep_on_a_full_disk_goes_on_once_there_is_room(folder, small_disk):
    """The whole command on a real one: exit 2 and one message, no point is failed, what is done
    stays, and in the end all is as on a disk with room. The disk fills up while the sweep runs."""
    disk = small_disk(60_000)
    plan, out = plan_of(folder), disk / "out"
    run_here(plan, folder / "calm")
    Outcomes(folder / "calm").save_definition(plan)
    client = start_client(folder, out, "--workers", "1")
    while client.poll() is None and not any((out / "points").rglob("*.json")):
        time.sleep(0.01)
    with open(disk / "filler", "wb") as filler:
        os.posix_fallocate(filler.fileno(), 0, shutil.disk_usage(disk).free - FREE_BYTES // 2)
    _, said = client.communicate(timeout=300)
    assert client.returncode == 2, said
    assert "did not let" in said and "room" in said and "Traceback" not in said
    before = status(out)
    assert before.failed == 0 and 0 < before.done < 12
    (disk / "filler").unlink()
    stamps = {f: f.stat().st_mtime_ns for f in (out / "points").rglob("*.json")}
    again = start_client(folder, out, "--workers", "1")
    _, said = again.communicate(timeout=300)
    assert again.returncode == 0, said
    assert {f: f.stat().st_mtime_ns for f in stamps} == stamps and status(out).done == 12
    same(open_sweep(out), open_sweep(folder / "calm"))


@pytest.mark.slow
def test_a_point_that_takes_its_workers_with_it_is_left(folder):
    """It is left and said, and the points that ran beside it are done. Planted bugs: recorded as
    failed; a dead process that is not replaced."""
    plan, out = plan_of(folder), folder / "out"
    deadly = list(plan.points())[2].key
    program = f"""
import os
from isac_rt.sweep import execute, load_sweep, run_sweep
simulate = execute.Job.simulate
execute.Job.simulate = lambda job: os._exit(9) if job.key == {deadly!r} else simulate(job)
if __name__ == "__main__":
    try:
        run_sweep(load_sweep({str(folder / "sweep.yaml")!r}), {str(out)!r}, workers=2)
    except execute.PointsLeft as left:
        print(left)
"""
    (folder / "program.py").write_text(program)
    done = subprocess.run(
        [sys.executable, str(folder / "program.py")],
        capture_output=True,
        text=True,
        timeout=400,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert "5 workers in turn died" in done.stdout, done.stderr
    found = status(out)
    assert (found.done, found.failed) == (11, 0) and Outcomes(out).read(deadly) is None


MORTAL = """
import asyncio, os, signal
from distributed import Scheduler
from distributed.security import Security

async def serve():
    async with Scheduler(
        host="127.0.0.1", port=0, protocol="tls", security=Security(), dashboard_address=":0"
    ) as made:
        print(made.address, flush=True)
        while not made.tasks:
            await asyncio.sleep(0.02)
        os.kill(os.getpid(), signal.SIGKILL)

asyncio.run(serve())
"""


@pytest.fixture
def certificate(folder, monkeypatch):
    """A certificate in Dask's configuration."""
    key, certificate = folder / "key.pem", folder / "certificate.pem"
    made = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=isac_rt".split()
    command = ["openssl", *made, "-keyout", str(key), "-out", str(certificate)]
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make a certificate with")
    subprocess.run(command, check=True, capture_output=True)
    tls = "DASK_DISTRIBUTED__COMM__TLS__"
    monkeypatch.setenv(f"{tls}CA_FILE", str(certificate))
    for role in ("SCHEDULER", "WORKER", "CLIENT"):
        monkeypatch.setenv(f"{tls}{role}__KEY", str(key))
        monkeypatch.setenv(f"{tls}{role}__CERT", str(certificate))


@pytest.mark.slow
def test_a_scheduler_that_is_killed_is_one_message(folder, certificate):
    """It dies as soon as it has points: exit 1, and after the progress nothing but what to do.
    Planted bug: Dask's own log left as it is, which shows how its reconnection failed."""
    plan_of(folder, SWEEP)
    mortal = subprocess.Popen([sys.executable, "-c", MORTAL], stdout=subprocess.PIPE, text=True)
    address = mortal.stdout.readline().strip()
    client = start_client(folder, folder / "out", "--scheduler", address)
    assert client.wait(timeout=300) == 1
    assert mortal.wait() == -9
    *progress, said = client.stderr.read().strip().splitlines()
    assert all(line.startswith("points") for line in progress) and said.startswith(
        "the scheduler was lost"
    )
    assert said.endswith("0 of 12 points are done and kept: start the same command again to go on")
