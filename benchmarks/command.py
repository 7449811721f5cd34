"""The whole job of `isac-rt run`, part by part, each scene in a process of its own.

A part's processor time is that of all threads of the process, its wall time that of its beginning
to its end; both begin with the interpreter. The first frame ends when its receivers are done. The
frames' time by stage is that of `summary.json`. Machine code and what set-ups keep are those of
earlier calls: every scene is run twice, but with `quick` once, and the last call counts.
"""

from __future__ import annotations

import json
import logging
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from isac_rt.runtime import settle_process
from reproduce import SCENES as SCENE_FILES

_LOG = logging.getLogger(f"isac_rt.{__name__}")  # shown with the program's own
PARTS = ("import", "set-up", "first frame", "other frames", "saving", "figures", "report")
LONGEST_S = 3000
SAN_FRANCISCO = (
    "city={source: builtin, name: san_francisco}",
    "swarm.AT={role: active, position_m: [-41, 23, 44.3], velocity_mps: [8.3, 3.1, 0.7]}",
    "swarm.PT1={role: passive, position_m: [27, -38, 48.1], velocity_mps: [-2.9, 7.7, 0.9]}",
    "swarm.U1={role: target, position_m: [-22, 27, 46.7], velocity_mps: [3.1, -2.3, 0.4]}",
)
"""The canyon's swarm and chirps over the largest of the built-in cities."""
SCENES: dict[str, tuple[str, int, int, tuple[str, ...]]] = {
    "canyon": ("street_canyon.yaml", 8, 8, ()),
    "paper's swarm": ("paper_swarm_consistent.yaml", 100, 20, ()),
    "Munich": ("munich_swarm.yaml", 78, 6, ()),
    "San Francisco": ("street_canyon.yaml", 8, 4, SAN_FRANCISCO),
}
"""By name: the file, its frames, those of a quick measurement, changes."""


def tables(quick: bool) -> list[dict[str, Any]]:
    """One dict for each scene: `scene`, `frames`, `peak_memory_mib`, `paths_per_frame`, `processor`
    and `wall` [s] by part and ``total``, `stages`, the processor seconds of the frames."""
    return [measured(name, quick) for name in SCENES]


def measured(name: str, quick: bool) -> dict[str, Any]:
    """One scene's parts.

    Raises
    ------
    RuntimeError  If the run ends with an error: the last line of what it said.
    """
    file, frames, few, changes = SCENES[name]
    number = few if quick else frames
    told = [*changes, f"frames={number}"]
    calls = 1 if quick else 2
    for call in range(calls):
        _LOG.info("%s, %s frames, call %s of %s", name, number, call + 1, calls)
        job = json.dumps([file, told, time.time()])
        found = _answer(file, "benchmarks.command", job)
    return {"scene": name, "frames": number, **found}


def _answer(file: str, module: str, *arguments: str) -> dict[str, Any]:
    """What a module of this package says as JSON of a scene, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", module, *arguments],
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["nothing"]
        raise RuntimeError(f"{file} ended with {done.returncode} and said: {said[-1]}")
    answer: dict[str, Any] = json.loads(done.stdout[done.stdout.index("{") :])
    return answer


class _Parts:
    """Processor and wall seconds between marks, from the interpreter's beginning on."""

    def __init__(self, begun: float) -> None:
        self.processor: dict[str, float] = {}
        self.wall: dict[str, float] = {}
        self._begun = self._last_wall = begun
        self._last = 0.0

    def mark(self, part: str) -> None:
        """A part ends here."""
        processor, wall = time.process_time(), time.time()
        self.processor[part] = processor - self._last
        self.wall[part] = wall - self._last_wall
        self._last, self._last_wall = processor, wall
        self.processor["total"], self.wall["total"] = processor, wall - self._begun


def run(file: str, changes: list[str], begun: float) -> dict[str, Any]:
    """Do what the command does and say where its time went."""
    parts = _Parts(begun)
    settle_process()
    import isac_rt as irt

    scenario = irt.load(SCENE_FILES / file, changes)
    from isac_rt.simulation import simulate

    parts.mark("import")
    setup = irt.prepare(scenario)
    parts.mark("set-up")

    def progress(done: int, _: int) -> None:
        if "first frame" not in parts.wall:
            parts.mark("first frame")

    results = simulate.run(scenario, setup=setup, progress=progress)
    parts.mark("other frames")
    with _folder() as folder:
        irt.save(results, folder)
        parts.mark("saving")
        from isac_rt.views.figures import make_figures
        from isac_rt.views.report import write_report

        pictures = make_figures(results, folder, setup.city)
        parts.mark("figures")
        write_report(results, folder, pictures, setup.city)
    parts.mark("report")
    stages = ("setup", "trace", "synthesis", "receive", "track", "other")
    return {
        "processor": parts.processor,
        "wall": parts.wall,
        "stages": {stage: results.summary["timing_s"][stage] for stage in stages},
        "peak_memory_mib": peak_memory_mib(),
        "paths_per_frame": sum(results.summary["paths"].values()) / scenario.frames,
    }


def peak_memory_mib() -> float:
    """The most memory that this process has had [MiB].

    ``ru_maxrss`` begins with that of the process that started this one. Linux's count for the
    address space does not, and is taken where there is one.
    """
    status = Path("/proc/self/status")
    found = re.search(r"^VmHWM:\s+(\d+) kB", status.read_text() if status.exists() else "", re.M)
    used = int(found[1]) if found else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used / 1024


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def markdown(found: list[dict[str, Any]]) -> list[str]:
    """The table's lines: processor seconds with wall seconds in brackets."""
    names = [f"{one['scene']}, {one['frames']} frames" for one in found]
    lines = [f"| part | {' | '.join(names)} |", "|---" * (len(found) + 1) + "|"]
    for part in (*PARTS, "total"):
        cells = [f"{one['processor'][part]:.2f} ({one['wall'][part]:.2f})" for one in found]
        lines.append(f"| {part} [s] | {' | '.join(cells)} |")
    for stage in found[0]["stages"]:
        cells = [f"{one['stages'][stage]:.2f}" for one in found]
        lines.append(f"| {stage}, all frames [s] | {' | '.join(cells)} |")
    for key, title in (
        ("peak_memory_mib", "peak memory [MiB]"),
        ("paths_per_frame", "paths a frame"),
    ):
        cells = [f"{one[key]:,.0f}" for one in found]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    print(json.dumps(run(*json.loads(sys.argv[1]))))
