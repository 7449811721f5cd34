"""Making a data set on Dask, with the guarantees of sweeps: what is finished is whole, is kept, and
is not made twice."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from isac_rt.results.provenance import commit
from isac_rt.settings import plain_tree
from isac_rt.storage import program_fingerprint, versions, write_whole
from isac_rt.sweep.definition import Point
from isac_rt.sweep.drawn import DataPlan
from isac_rt.sweep.execute import Job, Progress, connected, run_points
from isac_rt.sweep.outcomes import Outcomes, pending
from isac_rt.sweep.shards import CARD, COLUMNS, samples_of, tar_of


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

        scenario, setup = self.prepared()
        results = simulate.run(
            scenario, setup=setup, threads=self.threads, snapshots=scenario.frames
        )
        content = tar_of(samples_of(results, setup, self.keep, f"{self.number:06d}"))
        file = Path(self.split) / f"{self.number:06d}.tar"
        write_whole(Path(self.folder) / file, content)
        shard = {
            "file": str(file),
            "sha256": hashlib.sha256(content).hexdigest(),
            "bytes": len(content),
            "samples": int(results.dataset.processed.values.sum()),
        }
        return {**results.summary, "shard": shard}


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


def _write_card(plan: DataPlan, shards: Shards) -> dict[str, Any]:
    """Say what a data set is, from the outcomes of its scenes, whose shards were looked at before
    or were written just now."""
    splits: dict[str, dict[str, int]] = {name: {} for name in plan.data.splits}
    failed, size = 0, 0
    for point, scene in zip(plan.points(), plan.scenes, strict=True):
        outcome = shards.stated(point.key)
        if outcome is None or outcome["status"] != "done":
            failed += 1
            continue
        splits[scene.split][outcome["shard"]["file"]] = outcome["shard"]["samples"]
        size += outcome["shard"]["bytes"]
    card = {
        "name": plan.data.name,
        "splits": splits,
        "scenes_failed": failed,
        "bytes": size,
        "columns": {name: COLUMNS[name] for name in COLUMNS if name in plan.data.keep},
        "streets_apart": plan.data.place is not None,
        "data_set": plan.data.model_dump(mode="json", exclude_none=True),
        "scenario": plain_tree(plan.base),
        "program": program_fingerprint(),
        "commit": commit(),
        "versions": versions(),
    }
    write_whole(shards.folder / CARD, json.dumps(card, indent=1) + "\n")
    return card
