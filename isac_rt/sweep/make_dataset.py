"""Making a data set on Dask, with the guarantees of sweeps: what is finished is whole, is kept, and
is not made twice."""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import isac_rt
from isac_rt.frame.cube import IFCube
from isac_rt.receive.types import Reception, no_detections
from isac_rt.results.provenance import commit
from isac_rt.settings import plain_tree
from isac_rt.storage import program_fingerprint, versions, write_whole
from isac_rt.sweep.croissant import croissant
from isac_rt.sweep.definition import Point
from isac_rt.sweep.drawn import DataPlan
from isac_rt.sweep.execute import Job, Progress, connected, run_points
from isac_rt.sweep.outcomes import Outcomes, pending
from isac_rt.sweep.parts import FrameParts
from isac_rt.sweep.samples import CARD
from isac_rt.sweep.shards import COLUMNS, samples_of, tar_of

CROISSANT = "croissant.json"
FROM_RECEIVERS = {"map", "detections", "tracks"}
"""Parts for which the receivers run."""


@dataclass(frozen=True)
class Shards(Outcomes):
    """The folder of a data set: outcomes that hold where the scene's shard is."""

    def stated(self, key: str) -> dict[str, Any] | None:
        """A scene's outcome, without a look at its shard."""
        return super().read(key)

    def read(self, key: str) -> dict[str, Any] | None:
        """A scene's outcome; None also where its shard is not there as it was written."""
        outcome = super().read(key)
        if outcome is None or outcome["status"] != "done":
            return outcome
        shard = outcome.get("shard", {})
        try:
            with (self.folder / shard["file"]).open("rb") as opened:
                whole = hashlib.file_digest(opened, "sha256").hexdigest() == shard["sha256"]
        except (OSError, KeyError, TypeError, ValueError):
            return None
        return outcome if whole else None


@dataclass(frozen=True)
class SceneJob(Job):
    """A scene as a worker gets it.

    Attributes
    ----------
    number, split : of the scene, and where its shard goes
    keep : what is kept of every frame and link
    """

    number: int = 0
    split: str = ""
    keep: tuple[str, ...] = ()

    @property
    def outcomes(self) -> Outcomes:
        return Shards(Path(self.folder))

    def simulate(self) -> dict[str, Any]:
        """Run the scene, write its shard, and say what was written beside the summary."""
        from isac_rt.simulation import simulate
        from isac_rt.simulation.stations import standard_terminal

        scenario, setup = self.prepared()
        parts = FrameParts(setup, self.keep)
        results = simulate.run(
            scenario,
            progress=None,
            setup=setup,
            threads=self.threads,
            snapshots=scenario.frames,
            terminal=standard_terminal if FROM_RECEIVERS & {*self.keep} else lambda *_: _Deaf(),
            keep=parts,
        )
        begun = time.process_time()
        content = tar_of(samples_of(results, parts, self.keep, f"{self.number:06d}"))
        file = Path(self.split) / f"{self.number:06d}.tar"
        write_whole(Path(self.folder) / file, content)
        spent, made = results.summary["timing_s"], sum(parts.seconds)
        written = time.process_time() - begun
        spent |= {"parts": made, "other": max(spent["other"] - made, 0.0), "shard": written}
        spent["total"] += written
        shard = {
            "file": str(file),
            "sha256": hashlib.sha256(content).hexdigest(),
            "bytes": len(content),
            "samples": int(results.dataset.processed.values.sum()),
        }
        return {**results.summary, "shard": shard}


class _Deaf:
    """Receiver that finds nothing, for sets that keep nothing of receivers."""

    def receive(self, cube: IFCube, *_: Any, **__: Any) -> Reception:
        return Reception.undecoded(cube.waveform, no_detections())


def run_dataset(
    plan: DataPlan,
    folder: Path | str,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Make what is missing of a data set, and its card.

    Parameters
    ----------
    plan : from `load_dataset`
    folder : of the data set; on a cluster one that every worker reaches under this path
    workers, scheduler, progress : as for `isac_rt.sweep.run_sweep`

    Returns
    -------
    the card: what was drawn by which program, and the shards of each split with their samples

    Raises
    ------
    SweepError, PointsLeft, SchedulerLost, isac_rt.storage.StorageError  As for `run_sweep`.
    """
    shards = Shards(Path(folder).resolve())
    shards.begin(
        {
            "data": plan.data.model_dump(mode="json"),
            "base": plain_tree(plan.base),
            "folder": str(plan.base.folder),
        }
    )
    missing = [*pending(plan, shards, False)]
    done = plan.num_points - len(missing)
    if progress:
        progress(done, 0, plan.num_points)

    def job(point: Point, **fields: Any) -> Job:
        (number,) = point.index
        split = plan.scenes[number].split
        return SceneJob(**fields, number=number, split=split, keep=plan.data.keep)

    if missing:
        with connected(workers, scheduler) as client:
            run_points(plan, shards, client, job, iter(missing), done, progress=progress)
    return _write_card(plan, shards)


def _write_card(plan: DataPlan, folder: Shards) -> dict[str, Any]:
    """Say what a data set is, from the outcomes of its scenes, whose shards were looked at before
    or were written just now."""
    shards: dict[str, list[dict[str, Any]]] = {name: [] for name in plan.data.splits}
    failed, spent = 0, Counter[str]()
    for point, scene in zip(plan.points(), plan.scenes, strict=True):
        outcome = folder.stated(point.key)
        if outcome is None or outcome["status"] != "done":
            failed += 1
            continue
        shards[scene.split].append(outcome["shard"])
        spent.update({k: v for k, v in outcome["timing_s"].items() if isinstance(v, float)})
    data = plan.data
    card = {
        "name": data.name,
        "splits": {
            name: {shard["file"]: shard["samples"] for shard in one} for name, one in shards.items()
        },
        "scenes_failed": failed,
        "bytes": sum(shard["bytes"] for one in shards.values() for shard in one),
        "processor_s": dict(spent),
        "columns": {name: COLUMNS[name] for name in COLUMNS if name in data.keep},
        "streets_apart": data.place is not None,
        "data_set": data.model_dump(mode="json", exclude_none=True),
        "scenario": plain_tree(plan.base),
        "program": program_fingerprint(),
        "commit": commit(),
        "versions": versions(),
    }
    creator = data.about.get("creator", "not stated")
    about = {
        "name": data.name,
        "description": f"Frames of {data.scenes} simulated scenes of {plan.base.name}: IF radar "
        "with data of a UAV swarm over a city. card.json has the scenario and all versions.",
        "version": "1.0.0",
        "datePublished": time.strftime("%Y-%m-%d"),
        "license": data.about.get("license", "not stated"),
        "url": data.about.get("url", "."),
        "citeAs": f"{creator}: {data.name}, made with isac_rt {isac_rt.__version__}",
        "creator": {"@type": "sc:Organization", "name": creator},
    }
    write_whole(
        folder.folder / CROISSANT,
        json.dumps(croissant(about, shards, data.keep), indent=1) + "\n",
    )
    write_whole(folder.folder / CARD, json.dumps(card, indent=1) + "\n")
    return card
