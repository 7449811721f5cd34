"""Definition of a data set: many scenes drawn from one scenario, each in one of several splits that
share no flight and no street."""

from __future__ import annotations

import copy
import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationError

from isac_rt.document import Document, ScenarioError, first_complaint
from isac_rt.frame.schedule import decoded_schedule
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import waveform_of
from isac_rt.randomness import generator, seed_sequence
from isac_rt.scenario.file import folded_tree, load
from isac_rt.scenario.swarm import unfolded
from isac_rt.scenario.tree import Scenario
from isac_rt.settings import Key, Name, Problem, Seed
from isac_rt.simulation.preflight import check_passage
from isac_rt.simulation.setup import city_of, swarm_of, timetable_of
from isac_rt.sweep.definition import (
    Free,
    Point,
    files_under,
    ground_by,
    options,
    put,
)

MOST_SCENES = 1_000_000
MOST_TRIES = 400
"""Draws of one scene before the places are taken for too narrow."""
MOST_CELLS = 100_000
"""Of the ground that is used."""
Metres = Annotated[float, Field(ge=-1e8, le=1e8)]
Range = tuple[Metres, Metres]
FromFrame = Literal["boxes", "mask", "range_azimuth", "range_doppler", "cube"]
SampleField = Literal["map", "paths", "detections", "tracks", "bits", FromFrame, "samples"]


class Draw(Free):
    """A distribution of one key, a number or numbers by component: exactly one of these."""

    uniform: tuple[Any, Any] | None = None
    """Lowest and highest value."""
    log_uniform: tuple[Any, Any] | None = None
    """The same, uniform in the logarithm; both over 0."""
    normal: tuple[Any, Any] | None = None
    """Mean and standard deviation."""
    choice: tuple[Any, ...] | None = None
    """Values, each as likely."""

    def problems(self) -> Iterator[Problem]:
        given = [name for name, value in self if value is not None]
        if len(given) != 1:
            kinds = ", ".join(type(self).model_fields)
            yield Problem(
                ((*given, "uniform")[:1],), f"a draw is one of {kinds}; keep one of these"
            )
        elif self.choice is not None:
            if not self.choice:
                yield Problem((("choice",),), "has no value; give it one or more")
        else:
            yield from self._numbers(given[0])

    def _numbers(self, name: str) -> Iterator[Problem]:
        try:
            a, b = (np.asarray(v, float) for v in getattr(self, name))
            np.broadcast_shapes(a.shape, b.shape)
        except (TypeError, ValueError):
            yield Problem(((name,),), "must be two numbers, or two lists as long of numbers")
            return
        low = a if name != "normal" else np.zeros_like(b)
        with np.errstate(over="ignore"):
            finite = np.isfinite(b - a).all()
        if not (finite and (low <= b).all()):
            yield Problem(((name,),), "must be finite, the second no lower than the first (or 0)")
        elif name == "log_uniform" and not (a > 0).all():
            yield Problem(((name,),), "must be over 0; use uniform")

    def draw(self, rng: np.random.Generator) -> Any:
        """One value."""
        if self.choice is not None:
            return self.choice[int(rng.integers(len(self.choice)))]
        for name in ("uniform", "log_uniform", "normal"):
            if (ends := getattr(self, name)) is not None:
                a, b = (np.asarray(v, float) for v in ends)
                if name == "log_uniform":
                    return np.asarray(np.exp(rng.uniform(np.log(a), np.log(b)))).tolist()
                return np.asarray(getattr(rng, name)(a, b)).tolist()
        raise AssertionError("checked before")


class Place(Free):
    """Displacement of the whole swarm into one of the cells of a square grid."""

    REMOVED: ClassVar[dict[str, str]] = {"turn": "rotate"}

    east_m: Range
    """Lowest and highest x of the ground that is used [m]."""
    north_m: Range
    """Lowest and highest y of the ground that is used [m]."""
    cell_m: Annotated[float, Field(gt=0)] = 100.0
    """Side of a cell [m]. A flight stays in its cell, and a cell belongs to one split, so that
    splits share no street."""
    up_m: Range = (0.0, 0.0)
    """Lowest and highest lift of the swarm [m]."""
    rotate: bool = True
    """Rotate the swarm with its boresights about its middle by a random angle."""

    def problems(self) -> Iterator[Problem]:
        for name in ("east_m", "north_m", "up_m"):
            low, high = getattr(self, name)
            if low > high:
                yield Problem(((name,),), "the second is lower than the first; exchange them")
        if not self.num_cells:
            yield Problem((("cell_m",),), "no whole cell fits into the ground; make it smaller")
        elif self.num_cells > MOST_CELLS:
            message = f"the ground has more than {MOST_CELLS} cells; make them larger"
            yield Problem((("cell_m",),), message)

    @property
    def sides(self) -> tuple[int, int]:
        """Cells to the east and to the north; no more than one too many."""
        east, north = (
            int(min((high - low) / self.cell_m + 1e-9, MOST_CELLS + 1))
            for low, high in (self.east_m, self.north_m)
        )
        return max(east, 0), max(north, 0)

    @property
    def num_cells(self) -> int:
        """Count the cells."""
        return math.prod(self.sides)

    @property
    def cells(self) -> list[tuple[float, float]]:
        """South-west corners of the cells [m]."""
        east, north = self.sides
        x, y = (
            [low + k * self.cell_m for k in range(count)]
            for (low, _), count in ((self.east_m, east), (self.north_m, north))
        )
        return [(x_k, y_k) for x_k in x for y_k in y]


class DataSet(Free):
    """A data set's file."""

    name: Name = "dataset"
    scenario: str
    """The base scenario, a path relative to this file."""
    set: dict[str, Any] = Field({})
    """Keys of the base scenario to replace in all scenes."""
    scenes: Annotated[int, Field(ge=1, le=MOST_SCENES)]
    """How many scenes are drawn; each is one run of the base scenario's frames."""
    seed: Seed = 1
    place: Place | None = None
    """Where the swarm is moved to; left out: it stays where the scenario has it, and splits share
    the street."""
    draw: dict[str, Draw] = Field({})
    """A distribution for each key of the scenario that is drawn."""
    splits: dict[Name, Annotated[float, Field(ge=1e-6, le=1e6)]] = Field(
        {"train": 0.7, "val": 0.15, "test": 0.15}
    )
    """Shares of the scenes, by the name of the split."""
    keep: tuple[SampleField, ...] = ("map", "paths", "detections", "tracks", "bits")
    """Parts kept of every frame and link beside the truth. Receivers run only for `map`,
    `detections` and `tracks`; `samples`, `range_doppler` and `cube` are large."""
    about: dict[Literal["license", "creator", "url"], str] = Field({})
    """Licence (SPDX), publisher and address, for the card in Croissant's form."""

    def problems(self) -> Iterator[Problem]:
        for key in self.draw:
            if key == "seed" or key in self.set:
                other = "every scene has its own" if key == "seed" else "set has it too"
                yield Problem((("draw", key),), f"{other}; remove it here")
        if not self.splits:
            yield Problem((("splits",),), "has no split; give it one")
        elif self.place and self.place.num_cells < len(self.splits):
            message = (
                f"the ground has {self.place.num_cells} cells for {len(self.splits)} splits, "
                "which share none; make cell_m smaller or the ground larger"
            )
            yield Problem((("place", "cell_m"), ("splits",)), message)


@dataclass(frozen=True)
class Scene:
    """One scene of a data set: its split and its scenario as plain values."""

    split: str
    tree: dict[str, Any]


@dataclass(frozen=True)
class DataPlan:
    """A data set with its base scenario, ready to be made: what `load_dataset` gives."""

    data: DataSet
    base: Scenario

    @property
    def num_points(self) -> int:
        return self.data.scenes

    @cached_property
    def scenes(self) -> list[Scene]:
        """All scenes; drawn once, for where a swarm flies through a wall it is drawn again.

        Raises
        ------
        ScenarioError  If a scene finds no place.
        """
        tree = folded_tree(self.base, self.data.draw)
        tree.pop("name")
        splits = _quota(self.data.splits, self.data.scenes, self.data.seed)
        cells = _cells_of(self.data)
        return [self._scene(tree, k, split, cells) for k, split in enumerate(splits)]

    def _scene(
        self, base: dict[str, Any], number: int, split: str, cells: dict[str, list]
    ) -> Scene:
        why: Exception | None = None
        for attempt in range(MOST_TRIES):
            rng = generator(self.data.seed, "scene", number, attempt)
            tree = copy.deepcopy(base)
            for key, draw in self.data.draw.items():
                put(tree, key, draw.draw(rng))
            tree["seed"] = int(seed_sequence(self.data.seed, "seed", number).generate_state(1)[0])
            try:
                tree["swarm"] = unfolded(tree["swarm"])
                if self.data.place:
                    corner = cells[split][int(rng.integers(len(cells[split])))]
                    _move(tree, self.data.place, corner, rng)
                self._check(tree)
            except (ScenarioError, ValueError) as problem:
                why = problem
                continue
            return Scene(split, tree)
        raise ScenarioError(
            f"{self.data.name}: scene {number} found no place in {MOST_TRIES} draws; widen place "
            f"or draw (the last: {_words(why)})"
        )

    def _check(self, tree: dict[str, Any]) -> None:
        """Refuse scenes that cannot be, or whose swarm flies through a wall."""
        scenario = Scenario.model_validate(tree).in_folder(self.base.folder)
        if scenario.city is not None:
            whole = self.base.model_copy(update={"city": scenario.city})
            check_passage(swarm_of(scenario), _timetable(scenario), city_of(whole))

    def points(self) -> Iterator[Point]:
        """The scenes as points of a sweep; their number, by which their shard and its samples are
        named, and what is kept of them are part of their key."""
        files = files_under(self.base.folder)
        for number, scene in enumerate(self.scenes):
            ground = ground_by(scene.tree, files)
            content = json.dumps(
                [number, scene.tree, ground, self.data.keep, scene.split], sort_keys=True
            )
            key = hashlib.sha256(content.encode()).hexdigest()[:32]
            yield Point((number,), scene.tree, ground, key, None)


def _words(problem: Exception | None) -> str:
    """A problem in one line, with the key where a value does not fit."""
    if isinstance(problem, ValidationError):
        return first_complaint(Scenario, problem)
    return str(problem).splitlines()[0]


def _quota(shares: dict[str, float], count: int, seed: int) -> list[str]:
    """A split for each scene, as near to the shares as whole scenes can be, in random order."""
    ends = np.round(np.cumsum([*shares.values()]) / math.fsum(shares.values()) * count).astype(int)
    split = np.repeat([*shares], np.diff(ends, prepend=0)).tolist()
    order = generator(seed, "splits").permutation(count)
    return [split[k] for k in order]


def _cells_of(data: DataSet) -> dict[str, list[tuple[float, float]]]:
    """Each split's own cells of the ground, at least one, else by its share."""
    if data.place is None:
        return {name: [] for name in data.splits}
    cells = data.place.cells
    order = generator(data.seed, "cells").permutation(len(cells)).tolist()
    out = {name: [cells[order.pop()]] for name in data.splits}
    rest = _quota(data.splits, len(order), data.seed)
    for k, name in zip(order, rest, strict=True):
        out[name].append(cells[k])
    return out


def _move(
    tree: dict[str, Any], place: Place, corner: tuple[float, float], rng: np.random.Generator
) -> None:
    """Rotate the swarm about its middle and move it into a cell.

    Raises
    ------
    ValueError  If the flights do not fit into the cell.
    """
    points = _flown(tree)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    angle = rng.uniform(0, 2 * np.pi) if place.rotate else 0.0
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    inside = (points[:, :2] - middle[:2]) @ rotation.T
    low, high = np.array(corner) - inside.min(axis=0), np.array(corner) + place.cell_m
    high = high - inside.max(axis=0)
    if (low > high).any():
        need = float(np.ptp(inside, axis=0).max())
        raise ValueError(f"the flights need {need:.0f} m and place.cell_m is {place.cell_m:g} m")
    to = np.append(rng.uniform(low, high), middle[2] + rng.uniform(*place.up_m))

    def rotated(v: Any) -> list[float]:
        return [*(rotation @ np.asarray(v[:2], float)).tolist(), float(v[2])]

    def moved(v: Any) -> list[float]:
        return (np.array(rotated(np.asarray(v, float) - middle)) + to).tolist()

    for uav in tree["swarm"].values():
        for key, change in (("position_m", moved), ("velocity_mps", rotated)):
            if uav.get(key) is not None:
                uav[key] = change(uav[key])
        if isinstance(uav.get("boresight"), list):
            uav["boresight"] = rotated(uav["boresight"])
        for waypoint in uav.get("waypoints") or ():
            waypoint["position_m"] = moved(waypoint["position_m"])
            if waypoint.get("attitude_deg") is not None:  # yaw counts clockwise
                yaw, *others = waypoint["attitude_deg"]
                waypoint["attitude_deg"] = [yaw - math.degrees(angle), *others]


def _flown(tree: dict[str, Any]) -> np.ndarray:
    """(N, 3) places along all flights [m]."""
    scenario = Scenario.model_validate(tree)
    timetable = _timetable(scenario)
    span = timetable.epoch(0), timetable.epoch(timetable.frames - 1)
    polylines = (flight.polyline(*span)[1] for flight in swarm_of(scenario).trajectories.values())
    return np.vstack([*polylines])


def _timetable(scenario: Scenario) -> Timetable:
    waveform = waveform_of(scenario.radio, scenario.array, scenario.modulation)
    return timetable_of(scenario, waveform, decoded_schedule(waveform))


def load_dataset(path: Path | str) -> DataPlan:
    """Read and check a data set's file, and draw its scenes.

    Raises
    ------
    ScenarioError  One line per problem, with the place in the file.

    Examples
    --------
    >>> import isac_rt as irt
    >>> plan = irt.load_dataset("scenes/sweeps/canyon_dataset.yaml")
    >>> len(plan.scenes), sorted({scene.split for scene in plan.scenes})
    (12, ['test', 'train', 'val'])
    """
    path = Path(path)
    document = Document(path, "a data set needs a scenario and a number of scenes")
    data = document.check(DataSet)

    def refuse(key: Key, text: str) -> ScenarioError:
        return ScenarioError(document.complaint(Problem((key,), text)))

    file = path.parent / data.scenario
    try:
        base = load(file, options(data.set)).in_folder(file.parent.resolve())
    except ScenarioError as error:
        raise refuse(("scenario",), f"the base scenario cannot be used: {error}") from None
    plan = DataPlan(data, base)
    try:
        _ = plan.scenes
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as problem:
        message = f"the scenario has no such key ({problem}); check the keys"
        raise refuse(("draw",), message) from None
    except ScenarioError as problem:
        raise refuse(("place",) if data.place else ("draw",), str(problem)) from None
    return plan
