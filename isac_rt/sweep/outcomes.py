"""Outcomes of a sweep's points on disk, and the labelled dataset that is made of them.

A point's file holds the summary of its run, or its error, under the digest of the point's content,
which stands in the file with a checksum; so the files are the only state of a sweep: what is there
and whole is done, whoever did it, and anything else in its place is made anew.
"""

from __future__ import annotations

import fnmatch
import json
from collections.abc import Iterator, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import xarray as xr
from pydantic import BaseModel, Field

from isac_rt.results.files import ResultsError, read_dataset, write_dataset
from isac_rt.results.metrics import binomial_interval
from isac_rt.results.provenance import commit
from isac_rt.runtime import shortly
from isac_rt.scenario.tree import Scenario
from isac_rt.settings import plain_tree
from isac_rt.storage import (
    BAD_DATA,
    MOST_JSON_BYTES,
    checksum,
    program_fingerprint,
    read_whole,
    versions,
    write_whole,
)
from isac_rt.sweep.definition import Plan, Point, Points, Sweep, flat_numbers

FILE, DEFINITION = "sweep.nc", "sweep.json"
CONFIDENCE = 0.95
MOST_BYTES = 64 * 1024**2
"""No outcome is larger: that of a point with ten links has some 30 kB."""


Count = Annotated[int, Field(ge=0, lt=2**53, strict=True)]


class _Link(BaseModel):
    """Columns that the dataset takes of a link's outcome, besides the numbers in it."""

    counts: dict[str, tuple[Count, Count]]


class _Outcome(BaseModel):
    """Columns that the dataset and the status take of an outcome."""

    key: str
    status: Literal["done", "failed"]
    error: str = ""
    links: dict[str, _Link] = {}
    paths: dict[str, Count] = {}


@dataclass(frozen=True)
class Outcomes:
    """The folder of a sweep."""

    folder: Path

    @property
    def points(self) -> Path:
        """Where the points' files are; made by whoever starts the sweep, so that a worker sees
        whether it looks at the same disk."""
        return self.folder / "points"

    def file(self, key: str) -> Path:
        """A point's file; 256 folders keep each of them short."""
        return self.points / key[:2] / f"{key}.json"

    def read(self, key: str) -> dict[str, Any] | None:
        """A point's outcome; None where there is none yet, or what is there is not whole, or of
        another point."""
        try:
            outcome = json.loads(read_whole(self.file(key), MOST_BYTES))
            claimed = outcome.pop("checksum")
            if _Outcome.model_validate(outcome).key != key or claimed != _checksum(key, outcome):
                return None
            for block in outcome.get("links", {}).values():
                _ = [*flat_numbers(block)]  # all of them are numbers of float64
        except (OSError, *BAD_DATA):
            return None
        return outcome

    def write(self, key: str, outcome: dict[str, Any]) -> None:
        """Keep a point's outcome, of plain values.

        Raises
        ------
        isac_rt.storage.StorageError  If it cannot be written.
        """
        content = {"key": key, **outcome, "made_by": _made_by()}
        kept = content | {"checksum": _checksum(key, content)}
        write_whole(self.file(key), json.dumps(kept) + "\n")

    def others(self, keys: Set[str]) -> tuple[int, int]:
        """Count the points in the folder that are none of `keys`: those of another version of the
        program or of its packages, and those of other values of the scenario."""
        strangers = [f.stem for f in self.points.glob("*/*.json") if f.stem not in keys]
        found = [outcome for key in strangers if (outcome := self.read(key)) is not None]
        mine = _made_by()
        same = sum(outcome.get("made_by") == mine for outcome in found)
        return len(found) - same, same

    def done(self, key: str, retry_failed: bool) -> bool:
        """Return whether a point needs no run: it succeeded, or it failed and is not to be tried
        again."""
        outcome = self.read(key)
        return outcome is not None and (not retry_failed or outcome["status"] == "done")

    def save_definition(self, plan: Plan) -> None:
        """Keep the sweep and its base scenario beside the outcomes, so that the folder can be read
        alone."""
        tree = {
            "sweep": plan.sweep.model_dump(mode="json"),
            "base": plan.tree(),
            "folder": str(plan.base.folder),
        }
        self.begin(tree)

    def begin(self, definition: dict[str, Any]) -> None:
        """Keep what the points are points of, and make their folder."""
        write_whole(self.folder / DEFINITION, json.dumps(definition, indent=1) + "\n")
        self.points.mkdir(exist_ok=True)

    def definition(self) -> Plan:
        """The sweep that this folder belongs to.

        Raises
        ------
        ResultsError  If it is the folder of no sweep.
        """
        try:
            tree = json.loads(read_whole(self.folder / DEFINITION, MOST_JSON_BYTES))
            return Plan(
                Sweep.model_validate(tree["sweep"]),
                Scenario.model_validate(tree["base"]).in_folder(Path(tree["folder"])),
            )
        except (OSError, *BAD_DATA) as problem:
            raise ResultsError(
                f"{self.folder} holds no sweep ({shortly(problem)}); give the folder that "
                "`isac-rt sweep` wrote"
            ) from problem


@dataclass(frozen=True)
class Status:
    """Progress of a sweep.

    Attributes
    ----------
    total, done, failed : points
    errors : of those that failed (entries of the axes in words, message)
    other_version, other_scenario : points in the folder that another version of the program or of
        its packages made, and those of other values of the scenario; neither is used
    """

    total: int
    done: int
    failed: int
    errors: list[tuple[str, str]]
    other_version: int
    other_scenario: int


def status(folder: Path | str) -> Status:
    """Count the outcomes in a sweep's folder; at most 20 errors are kept."""
    outcomes = Outcomes(Path(folder))
    plan = outcomes.definition()
    done, failed = 0, 0
    errors: list[tuple[str, str]] = []
    keys = set()
    for point in plan.points():
        keys.add(point.key)
        outcome = outcomes.read(point.key)
        if outcome is None:
            continue
        if outcome["status"] == "done":
            done += 1
        else:
            failed += 1
            if len(errors) < 20:
                entries = zip(plan.sweep.axes.items(), point.index, strict=False)
                at = [f"{name} {axis.labels()[i]}" for (name, axis), i in entries]
                at += [f"repetition {point.index[-1]}"] if plan.sweep.repetitions > 1 else []
                errors.append((", ".join(at), outcome["error"]))
    return Status(plan.sweep.num_points, done, failed, errors, *outcomes.others(keys))


def _checksum(key: str, outcome: dict[str, Any]) -> str:
    return checksum(key, json.dumps(outcome, sort_keys=True, allow_nan=False).encode())


Columns = dict[str, np.ndarray]
"""Arrays over the points of a sweep, by link or kind."""


def assemble(plan: Plan, outcomes: Outcomes) -> xr.Dataset:
    """All outcomes so far as one dataset.

    Returns
    -------
    dataset : over the axes, ``repetition`` and ``link``: the kept quantities of each link, NaN
        where a point is not done or does not apply; without ``repetition`` the rates pooled over
        the repetitions (``NAME_pooled``) with the 95 % Clopper-Pearson bounds ``NAME_low`` and
        ``NAME_high``, which take symbols for independent; ``state``: 1 done, 0 not yet, -1 failed;
        ``paths`` by ``kind``. Coordinates are the axes' values. Nothing in it depends on who
        computed what when.
    """
    shape = plan.sweep.shape
    state = np.zeros(shape, np.int8)
    values: dict[str, Columns] = {}
    counts: dict[str, Columns] = {}
    paths: Columns = {}

    def column(columns: Columns, name: str, shape: tuple[int, ...], missing: float) -> np.ndarray:
        if name not in columns:
            columns[name] = np.full(shape, missing)
        return columns[name]

    for point in plan.points():
        outcome, at = outcomes.read(point.key), point.index
        if outcome is None:
            continue
        state[at] = 1 if outcome["status"] == "done" else -1
        for link, block in outcome.get("links", {}).items():
            of_link = {key: value for key, value in block.items() if key != "targets"}
            for name, value in flat_numbers(of_link):
                column(values.setdefault(name, {}), link, shape, np.nan)[at] = value
            for name, pair in block["counts"].items():
                column(counts.setdefault(name, {}), link, (*shape[:-1], 2), 0)[at[:-1]] += pair
        for kind, number in outcome.get("paths", {}).items():
            column(paths, kind, shape, np.nan)[at] = number

    dims, links = [*plan.sweep.axes, "repetition"], list(dict.fromkeys(_names(values)))
    out = {"state": xr.Variable(dims, state, {"long_name": "1 done, 0 not yet, -1 failed"})}
    for name, columns in values.items():
        missing = np.full(shape, np.nan)
        stacked = np.stack([columns.get(link, missing) for link in links], axis=-1)
        out[name] = xr.Variable([*dims, "link"], stacked)
    for name, columns in counts.items():
        out |= _rates(name, columns, links, dims[:-1])
    if paths:
        kinds = sorted(paths)
        stacked = np.stack([paths[kind] for kind in kinds], axis=-1)
        out["paths"] = xr.Variable([*dims, "kind"], stacked)
        out["kind"] = xr.Variable(["kind"], np.array(kinds, object))
    return _dataset(plan, out, links)


def _names(values: dict[str, Columns]) -> Iterator[str]:
    return (link for columns in values.values() for link in columns)


def _rates(
    name: str, columns: Columns, links: list[str], dims: list[str]
) -> dict[str, xr.Variable]:
    """One rate pooled over all repetitions, and its bounds, from errors and trials (..., 2)."""
    missing = np.zeros_like(next(iter(columns.values())))
    pairs = np.stack([columns.get(link, missing) for link in links], axis=-1)
    errors, trials = pairs[..., 0, :], pairs[..., 1, :]
    bounds = np.array(
        [
            binomial_interval(int(e), int(n), CONFIDENCE) if n else (np.nan, np.nan)
            for e, n in zip(errors.ravel(), trials.ravel(), strict=True)
        ]
    ).reshape(*errors.shape, 2)
    with np.errstate(invalid="ignore"):
        pooled = errors / np.where(trials, trials, np.nan)
    meanings = {
        f"{name}_pooled": (pooled, f"{name} over all repetitions"),
        f"{name}_low": (bounds[..., 0], f"low bound of {name}_pooled"),
        f"{name}_high": (bounds[..., 1], f"high bound of {name}_pooled"),
    }
    return {
        key: xr.Variable([*dims, "link"], values, {"long_name": meaning, "confidence": CONFIDENCE})
        for key, (values, meaning) in meanings.items()
    }


def _dataset(plan: Plan, variables: dict[str, xr.Variable], links: list[str]) -> xr.Dataset:
    """Return the kept variables as a dataset, with the coordinates along the axes."""
    sweep = plan.sweep
    kept = {
        name: v
        for name, v in variables.items()
        if name in ("state", "kind") or any(fnmatch.fnmatch(name, p) for p in sweep.keep)
    }
    coordinates: dict[str, Any] = {
        name: np.array(axis.labels()) for name, axis in sweep.axes.items()
    }
    for name, values in coordinates.items():
        coordinates[name] = values.astype(object) if values.dtype.kind in "US" else values
    coordinates |= {"repetition": np.arange(sweep.repetitions), "link": np.array(links, object)}
    keys = {f"axis_{name}": ", ".join(sorted(axis.keys)) for name, axis in sweep.axes.items()}
    about = {
        "title": f"isac_rt sweep: {sweep.name}",
        **_made_by(),
        "commit": commit(),
        "base": json.dumps(plain_tree(plan.base)),
        "seed": sweep.seed,
    }
    return xr.Dataset(kept, coordinates, {**about, **keys})


def _made_by() -> dict[str, str]:
    """The program and the versions under it, to which the points in a folder belong."""
    return {"program": program_fingerprint(), "versions": json.dumps(versions())}


def save_dataset(dataset: xr.Dataset, folder: Path) -> Path:
    """Write ``sweep.nc`` into a sweep's folder, whole or not at all."""
    file = folder / FILE
    write_dataset(dataset, file)
    return file


def open_sweep(folder: Path | str) -> xr.Dataset:
    """The outcomes of a sweep so far, finished or not, as one labelled dataset (see `assemble`).

    Points belong to the program that ran them and the versions under it. Where others finished the
    sweep, the dataset is the one that they wrote; its attributes ``program`` and ``versions`` say
    which.

    Raises
    ------
    ResultsError  If the folder is no sweep's, or its dataset cannot be read.
    """
    outcomes = Outcomes(Path(folder))
    file = outcomes.folder / FILE
    if file.is_file():
        try:
            written = read_dataset(file)
        except (OSError, MemoryError, *BAD_DATA) as problem:
            raise ResultsError(
                f"{file} cannot be read ({shortly(problem)}); delete it"
            ) from problem
        if any(written.attrs.get(name) != value for name, value in _made_by().items()):
            return written
    return assemble(outcomes.definition(), outcomes)


def pending(plan: Points, outcomes: Outcomes, retry_failed: bool) -> Iterator[Point]:
    """Points that need a run, in order."""
    return (point for point in plan.points() if not outcomes.done(point.key, retry_failed))
