"""Random kills and full disks: what is lost, done twice, left behind, or not as undisturbed?

    python tests/kills.py --runs 140 --sweeps 60 --full 20 --seed 1

Runs (figures included), clients and workers of sweeps are killed (SIGKILL, SIGTERM,
SIGINT, SIGHUP) at random moments, or write on a file system that is full at a random size, as root.
What is left goes on by the same command. In the end the bits are those of an undisturbed run, no
finished point was touched, and no temporary file is left. All processes are forks of this one, so
that a trial takes seconds.
"""

from __future__ import annotations

import argparse
import collections
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1]), *map(str, Path(__file__).parent.glob("*/"))]

TINY = import_module("test_sweep")
SCENE = TINY.BASE.replace("frames: 3", "frames: 6")
SWEEP = TINY.SWEEP.replace("repetitions: 2", "repetitions: 4")
HOW = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


def forked(work: Callable[[], int | None], log: Path) -> int:
    """Process number of a fork that does some work and ends with its status."""
    pid = os.fork()
    if pid:
        return pid
    os.setsid()
    out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(out, 1)
    os.dup2(out, 2)
    status = 99
    try:
        status = int(work() or 0)
    finally:
        sys.stderr.flush()
        os._exit(status)


def ended(pid: int, limit: float = 300.0) -> int:
    """Exit status of a fork, negative for a signal."""
    end = time.monotonic() + limit
    while True:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            os.killpg(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            raise AssertionError("hangs")
        time.sleep(0.01)


def command(*arguments: str) -> int:
    from isac_rt.cli.cli import main
    from isac_rt.simulation.resume import Resume

    Resume.__init__.__defaults__ = (0.0,)
    return main(list(arguments))


def children(pid: int) -> list[int]:
    """Workers of a client."""
    found = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in found.read_text().split()] if found.exists() else []


def warm_up(folder: Path) -> None:
    """Load and compile here what all forks need, and have them draw two figures instead of all."""
    import_module("isac_rt.sweep")
    from isac_rt.results.files import save
    from isac_rt.scenario.file import load
    from isac_rt.simulation import simulate
    from isac_rt.views import figures
    from isac_rt.views.report import write_report

    def two(dataset, *_):
        for name in ("one", "two"):
            yield figures.Drawing(name, [partial(figures.reference_snr, dataset=dataset)], 2.7)

    figures._all = two
    results = simulate.run(load(folder / "base.yaml"), threads=1)
    save(results, folder / "warm")
    write_report(results, folder / "warm", figures.make_figures(results, folder / "warm"))


def run_digest(out: Path) -> str:
    from test_killed import digest

    from isac_rt.results.files import open_results

    return digest(open_results(out))


def sweep_digest(out: Path) -> str:
    import hashlib

    from isac_rt.sweep import open_sweep

    found = hashlib.sha256()
    for name, variable in sorted(open_sweep(out).variables.items()):
        found.update(f"{name}{variable.values.tolist()}".encode())
    return found.hexdigest()


def left_over(out: Path) -> list[str]:
    """Temporary files, and frames that are kept."""
    names = [str(p.relative_to(out)) for p in out.rglob(".*")]
    return names + [p.name for p in out.glob("resume.sqlite*")]


def stamps(out: Path) -> dict[Path, int]:
    return {f: f.stat().st_mtime_ns for f in (out / "points").rglob("*.json")}


class Trials:
    """The undisturbed results, and one trial after the other."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.rng = folder, random.Random(seed)
        self.log = folder / "log"
        (folder / "base.yaml").write_text(SCENE)
        (folder / "sweep.yaml").write_text(SWEEP)
        warm_up(folder)
        begin = time.monotonic()
        assert self.single(folder / "calm") == 0, self.log.read_text()
        self.run_s, self.run = time.monotonic() - begin, run_digest(folder / "calm")
        begin = time.monotonic()
        assert self.swept(folder / "calm_sweep") == 0, self.log.read_text()
        self.sweep_s, self.sweep = time.monotonic() - begin, sweep_digest(folder / "calm_sweep")

    def start_single(self, out: Path) -> int:
        scene = str(self.folder / "base.yaml")
        return forked(lambda: command("run", scene, "--out", str(out)), self.log)

    def single(self, out: Path) -> int:
        return ended(self.start_single(out))

    def start_client(self, out: Path) -> int:
        file = str(self.folder / "sweep.yaml")
        return forked(lambda: command("sweep", file, "--out", str(out), "--workers", "2"), self.log)

    def swept(self, out: Path) -> int:
        return ended(self.start_client(out))

    def killed_run(self, out: Path) -> str:
        for _ in range(self.rng.choice([1, 1, 2, 3])):
            pid = self.start_single(out)
            how = self.rng.choice(HOW)
            time.sleep(self.rng.uniform(0.0, 1.05 * self.run_s))
            try:
                os.kill(pid, how)
            except ProcessLookupError:
                pass
            status = ended(pid)
            assert status in (0, -how, 128 + how), status
        assert self.single(out) == 0
        assert run_digest(out) == self.run and not left_over(out), left_over(out)
        return f"run {signal.Signals(how).name}"

    def killed_sweep(self, out: Path) -> str:
        victim, client = self.rng.choice(["client", "worker"]), self.start_client(out)
        time.sleep(self.rng.uniform(0.0, 1.05 * self.sweep_s))
        workers = children(client)
        try:
            one = self.rng.choice(workers) if victim == "worker" and workers else client
            os.kill(one, signal.SIGKILL)
        except ProcessLookupError:
            pass
        before = stamps(out)
        status = ended(client)
        assert status in (0, -9), status
        assert self.swept(out) == 0
        assert stamps(out).items() >= before.items(), "done twice"
        assert sweep_digest(out) == self.sweep and not left_over(out / "points"), left_over(out)
        return f"sweep, {victim}"

    def full_disk(self, out: Path) -> str:
        disk, single = out.with_name(f"{out.name}_disk"), self.rng.random() < 0.5
        size = self.rng.uniform(24, 700) if single else self.rng.uniform(988, 1150)
        disk.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size:.0f}k", "tmpfs", str(disk)]
        subprocess.run(mount, check=True)
        try:
            work = self.single if single else self.swept
            status = work(disk / "out")
            before = stamps(disk / "out") if not single else {}
            subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
            assert status in (0, 2), status
            assert work(disk / "out") == 0
            assert stamps(disk / "out").items() >= before.items(), "done twice"
            found = (run_digest if single else sweep_digest)(disk / "out")
            assert found == (self.run if single else self.sweep)
        finally:
            subprocess.run(["umount", "-l", str(disk)], check=True)
        return f"full disk, {'run' if single else 'sweep'}, exit {status}"


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    for name, number in (("runs", 140), ("sweeps", 60), ("full", 20), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=number)
    asked = parser.parse_args()
    wrong, counts = 0, collections.Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        trials = Trials(Path(folder), asked.seed)
        kinds = [
            *[trials.killed_run] * asked.runs,
            *[trials.killed_sweep] * asked.sweeps,
            *[trials.full_disk] * asked.full,
        ]
        trials.rng.shuffle(kinds)
        print(f"undisturbed: run {trials.run_s:.1f} s, sweep {trials.sweep_s:.1f} s", flush=True)
        for i, trial in enumerate(kinds):
            trials.log.write_text("")
            try:
                counts[trial(Path(folder) / f"trial{i}")] += 1
            except AssertionError as problem:
                wrong += 1
                print(f"{i} {trial.__name__}: {problem}\n{trials.log.read_text()[-3000:]}")
            if "Traceback" in trials.log.read_text():
                counts["traceback"] += 1
                print(f"{i} {trial.__name__}: {trials.log.read_text()[-3000:]}", flush=True)
            if i % 10 == 9:
                print(i + 1, dict(sorted(counts.items())), "wrong:", wrong, flush=True)
    print(dict(sorted(counts.items())), "wrong:", wrong)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
