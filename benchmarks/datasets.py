"""Data sets: what a frame costs from the scene to the shard and back to a learner, and its bytes.

One scene of `scenes/street_canyon.yaml` by its number of samples, which are frames on links.
Nothing of it has an error. Cost is CPU time per sample: of the run that makes it, of its place in a
shard, and of reading it.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from statistics import median

from benchmarks.measure import cpu_seconds, floor_seconds
from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.results.recorder import Results
from isac_rt.scenario.file import load
from isac_rt.simulation import simulate
from isac_rt.simulation.setup import Frame, prepare
from isac_rt.sweep.drawn import DataSet
from isac_rt.sweep.parts import FrameParts
from isac_rt.sweep.samples import CARD, Samples
from isac_rt.sweep.shards import samples_of, tar_of
from reproduce import SCENES

FRAMES = (4, 16)
KEEPS: dict[str, tuple[str, ...]] = {
    "maps alone": ("map",),
    "all but the IF samples": DataSet.model_fields["keep"].default,
    "all with the IF samples": (*DataSet.model_fields["keep"].default, "samples"),
}
JOB = "street_canyon.yaml, run with set-up, written to a shard, read back"


def rows(quick: bool) -> list[dict[str, object]]:
    """Cost and bytes of a sample, by what is kept of it."""
    floor = floor_seconds((3, 15, 120, 1024))
    return [row for frames in (FRAMES[:1] if quick else FRAMES) for row in _of(frames, floor)]


def _of(frames: int, floor: float) -> Iterator[dict[str, object]]:
    """Rows of one scene."""
    results, parts, seconds = _simulated(frames)
    count = int(results.dataset.processed.values.sum())

    def row(method: str, seconds: float, also: str = "") -> dict[str, object]:
        each = seconds / count
        return {
            "kind": "datasets",
            "method": method,
            "size": count,
            "unit": "samples",
            "error": None,
            "cost": each / floor,
            "seconds": each,
            "floor_s": floor,
            "job": JOB,
            "also": f"{float(f'{1 / each:.2g}'):,g} samples/s{also}",
        }

    def shard(keep: tuple[str, ...]) -> bytes:
        return tar_of(samples_of(results, parts[keep], keep, "000000"))

    yield row("simulated", seconds)
    for name, keep in KEEPS.items():
        content = shard(keep)
        size = f", {len(content) / count / 1e3:,.0f} kB a sample"
        yield row(f"written: {name}", cpu_seconds(partial(shard, keep), 3, 0), size)
        yield row(f"read: {name}", _read(content, count), size)


def _simulated(frames: int) -> tuple[Results, dict[tuple[str, ...], FrameParts], float]:
    """A run whose every frame is kept, its parts by what is kept of them, and its CPU seconds
    without these."""
    scenario = load(SCENES / "street_canyon.yaml", [f"frames={frames}"])
    simulate.run(scenario, progress=None, snapshots=frames)  # compiles
    begin = time.process_time()
    setup = prepare(scenario)
    parts = {keep: FrameParts(setup, keep) for keep in KEEPS.values()}

    def observe(frame: Frame, link: Link, cube: IFCube) -> None:
        for one in parts.values():
            one(frame, link, cube)

    results = simulate.run(scenario, progress=None, setup=setup, snapshots=frames, keep=observe)
    spent = sum(sum(one.seconds) for one in parts.values())
    return results, parts, time.process_time() - begin - spent


def _read(content: bytes, count: int) -> float:
    """CPU seconds to read all samples of a shard, its headers included."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "0.tar").write_bytes(content)
        (Path(folder) / CARD).write_text(json.dumps({"splits": {"all": {"0.tar": count}}}))
        times = []
        for _ in range(3):
            begin = time.process_time()
            samples = Samples(folder, "all")
            for k in range(count):
                _ = samples[k]
            times.append(time.process_time() - begin)
    return median(times)
