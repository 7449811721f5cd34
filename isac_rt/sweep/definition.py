"""Definition of a sweep: a base scenario, axes, repetitions; its points and the key under which
each is kept."""

from __future__ import annotations

import copy
import fnmatch
import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
from pydantic import Field, ValidationError, field_validator

from isac_rt.document import Document, ScenarioError, first_complaint
from isac_rt.randomness import seed_sequence
from isac_rt.results.metrics import SymbolCount
from isac_rt.results.provenance import path_content
from isac_rt.results.sensing import RATES, Sensing, summary_block
from isac_rt.scenario.file import folded_tree, load
from isac_rt.scenario.swarm import unfolded
from isac_rt.scenario.tables import with_tables
from isac_rt.scenario.tree import Scenario
from isac_rt.settings import Key, Name, Node, Problem, Seed, dotted
from isac_rt.storage import program_fingerprint, versions
from isac_rt.world.area import city_digest, file_digest
from isac_rt.world.city import CityError
from isac_rt.world.settings import City

MAX_POINTS = 100_000
"""More points than this are taken for a slip unless asked for."""
OWN_DIMENSIONS = ("link", "repetition", "kind")
"""Dimensions of the results that an axis cannot be named after."""


class Free(Node):
    """A node whose values are any that a scenario may have."""

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_for_a_number(cls, value: Any, info: Any) -> Any:
        return value


class Axis(Free):
    """One axis: `key` and its `values`; or `zip`, several keys that change together; or `list`,
    named sets of keys."""

    key: str | None = None
    values: tuple[Any, ...] | None = None
    zip: dict[str, tuple[Any, ...]] | None = None
    list: dict[str, dict[str, Any]] | None = None

    def problems(self) -> Iterator[Problem]:
        given = [
            n
            for n, v in (("key", self.key), ("zip", self.zip), ("list", self.list))
            if v is not None
        ]
        if len(given) != 1 or (self.values is not None) != (given == ["key"]):
            yield Problem(
                ((given[0] if given else "key",),),
                "an axis has either key and values, or zip, or list; keep one of these",
            )
        elif not self.size:
            yield Problem(((given[0],),), "has no entry; give it one value or more")
        elif self.zip is not None and len({len(v) for v in self.zip.values()}) > 1:
            lengths = ", ".join(f"{k}: {len(v)}" for k, v in self.zip.items())
            yield Problem(
                (("zip",),),
                f"the keys that change together have different numbers of values ({lengths}); make "
                "them alike",
            )

    @property
    def size(self) -> int:
        """Number of entries."""
        if self.zip is not None:
            return len(next(iter(self.zip.values()), ()))
        return len(self.list or self.values or ())

    @property
    def keys(self) -> set[str]:
        """Keys of the scenario that the axis sets."""
        if self.list is not None:
            return {key for entry in self.list.values() for key in entry}
        return set(self.zip) if self.zip is not None else {str(self.key)}

    def entry(self, index: int) -> dict[str, Any]:
        """Return the settings of the axis at one of its entries."""
        if self.list is not None:
            return next(itertools.islice(self.list.values(), index, None))
        if self.zip is not None:
            return {key: values[index] for key, values in self.zip.items()}
        assert self.values is not None
        return {str(self.key): self.values[index]}

    def labels(self) -> Sequence[float] | Sequence[str]:
        """The coordinate along the axis: the numbers of its key (the first of a zip), else
        words."""
        if self.list is not None:
            return [*self.list]
        values = self.values if self.values is not None else next(iter((self.zip or {}).values()))
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            return [*values]
        return [v if isinstance(v, str) else json.dumps(v) for v in values]


class Figure(Free):
    """A picture of one quantity against an axis, a curve for each entry of another."""

    quantity: str
    against: str
    by: str | None = None


class Sweep(Free):
    """A sweep file."""

    name: Name = "sweep"
    scenario: str
    """The base scenario, a path relative to the sweep's file."""
    set: dict[str, Any] = Field({})
    """Keys of the base scenario to replace in all points."""
    axes: dict[str, Axis]
    """By name; every combination of their entries is a point."""
    repetitions: Annotated[int, Field(ge=1)] = 1
    """Runs of each point, with seeds spawned from `seed`; all points of one repetition have the
    same seed."""
    seed: Seed = 1
    keep: tuple[str, ...] = ("*",)
    """Names of the quantities in the dataset, with wildcards, such as ser_* or rmse_range_m."""
    figures: tuple[Figure, ...] = ()

    def problems(self) -> Iterator[Problem]:
        if not self.axes:
            yield Problem((("axes",),), "has no axis; for a single scenario use isac-rt run")
        for name in self.axes:
            if name in OWN_DIMENSIONS or not name.isidentifier():
                message = (
                    f"an axis's name must be a word other than {', '.join(OWN_DIMENSIONS)}; "
                    "rename it"
                )
                yield Problem((("axes", name),), message)
        every: list[tuple[Key, str]] = [(("set", key), key) for key in self.set]
        every += [
            (("axes", name), key) for name, axis in self.axes.items() for key in sorted(axis.keys)
        ]
        every += [(("seed",), "seed")]
        for (here, a), (there, b) in itertools.combinations(every, 2):
            if here != there and (a == b or a.startswith(f"{b}.") or b.startswith(f"{a}.")):
                first = (
                    "repetitions set it" if there == ("seed",) else f"{dotted(there)} sets {b} too"
                )
                yield Problem((here, there), f"sets {a}, but {first}; set each key in one place")
        for i, pattern in enumerate(self.keep):
            if not fnmatch.filter(quantities(), pattern):
                yield Problem(
                    (("keep", i),), f"fits no quantity; there are {', '.join(quantities())}"
                )
        for i, figure in enumerate(self.figures):
            if figure.quantity not in quantities() or figure.quantity == "paths":
                yield Problem(
                    (("figures", i, "quantity"),),
                    f"is no quantity of a link; there are {', '.join(quantities()[:-1])}",
                )
            for end in ("against", "by"):
                axis = getattr(figure, end)
                if axis is not None and axis not in self.axes:
                    yield Problem(
                        (("figures", i, end), ("axes",)),
                        f"is no axis of this sweep; the axes are {', '.join(self.axes)}",
                    )

    @property
    def keys(self) -> frozenset[str]:
        """Keys of the scenario that the axes set."""
        return frozenset(key for axis in self.axes.values() for key in axis.keys)

    @property
    def shape(self) -> tuple[int, ...]:
        """Entries of every axis, repetitions last."""
        return (*(axis.size for axis in self.axes.values()), self.repetitions)

    @property
    def num_points(self) -> int:
        return math.prod(self.shape)


@dataclass(frozen=True)
class Point:
    """One run of a sweep.

    Attributes
    ----------
    index : along every axis and the repetitions
    tree : its scenario as plain values, without the name
    ground : what its outcome depends on beside its scenario, by name (see `ground_of`)
    key : digest of the tree and the ground; under it the outcome is kept
    paths_key : digest of what its paths depend on, None where they are not traced: points with the
        same one share them
    """

    index: tuple[int, ...]
    tree: dict[str, Any]
    ground: dict[str, str]
    key: str
    paths_key: str | None


class Points(Protocol):
    """A number of points over one base scenario: a sweep, or a data set."""

    @property
    def base(self) -> Scenario: ...

    @property
    def num_points(self) -> int: ...

    def points(self) -> Iterator[Point]: ...


@dataclass(frozen=True)
class Plan:
    """A sweep with its base scenario, ready to be run: what `load_sweep` gives."""

    sweep: Sweep
    base: Scenario

    @property
    def num_points(self) -> int:
        return self.sweep.num_points

    def tree(self) -> dict[str, Any]:
        """The base scenario as plain values, with the formations that the axes change."""
        return folded_tree(self.base, self.sweep.keys)

    def points(self) -> Iterator[Point]:
        """All points in order, made one by one: a million of them need no memory."""
        tree = self.tree()
        tree.pop("name")
        files = files_under(self.base.folder)
        for index in itertools.product(*(range(n) for n in self.sweep.shape)):
            here = copy.deepcopy(tree)
            for axis, i in zip(self.sweep.axes.values(), index[:-1], strict=True):
                for key, value in axis.entry(i).items():
                    put(here, key, value)
            here = with_tables(here, self.base.folder, replace=True)
            here["swarm"] = unfolded(here["swarm"])
            here["seed"] = self.seed(index[-1])
            ground = ground_by(here, files)
            yield Point(index, here, ground, point_key(here, ground), paths_key(here, ground))

    def seed(self, repetition: int) -> int:
        """The scenario's seed in a repetition."""
        return int(seed_sequence(self.sweep.seed, "repetition", repetition).generate_state(1)[0])


def ground_of(tree: dict[str, Any], folder: Path) -> dict[str, str]:
    """Return what a point's outcome depends on besides its scenario: the program, the versions
    under it, and digests of the files that the scenario names.

    Parameters
    ----------
    tree : the scenario as plain values
    folder : to which its files are relative
    """
    return ground_by(tree, partial(files_digest, folder))


def ground_by(tree: dict[str, Any], files: Callable[[str, str | None], str]) -> dict[str, str]:
    """The same, with what makes the digests of files."""
    of_files = ("source", "name", "file", "terrain")
    city = {k: v for k, v in (tree.get("city") or {}).items() if k in of_files}
    radios = [tree.get("radio"), *(uav.get("radio") for uav in tree.get("swarm", {}).values())]
    boards = [(radio or {}).get("calibration") for radio in radios]
    return {
        "program": program_fingerprint(),
        "versions": json.dumps(versions()),
        "city": files(json.dumps(city), None) if city else "",
        "calibration": "".join(files("", board) for board in boards),
    }


def point_key(tree: dict[str, Any], ground: dict[str, str]) -> str:
    """Under which a point's outcome is kept."""
    return _digest([tree, ground])


def paths_key(tree: dict[str, Any], ground: dict[str, str]) -> str | None:
    """Under which a point's paths are kept; None where they are not traced."""
    if (tree.get("propagation") or {}).get("model") != "ray_traced":
        return None
    return _digest(path_content(tree, ground["city"]))


def flat_numbers(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Numbers of a nested mapping by their names joined with _; null is NaN; words and lists are
    left out."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flat_numbers(value, f"{prefix}{key}_")
        elif value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
            yield f"{prefix}{key}", np.nan if value is None else float(value)


@lru_cache(maxsize=1)
def quantities() -> tuple[str, ...]:
    """Names of what a link's outcome holds (see `isac_rt.results.sensing.summary_block`), the
    pooled rates included."""
    block = summary_block("passive", Sensing.of_nothing(0), SymbolCount(), 1.0)
    names = [name for name, _ in flat_numbers(block)]
    return (
        *names,
        *(f"{name}_{end}" for name in RATES for end in ("pooled", "low", "high")),
        "paths",
    )


def put(tree: dict[str, Any], key: str, value: Any) -> None:
    """Set a dotted key, making the mappings on its way; numbers index lists."""
    *parents, last = key.split(".")
    here: Any = tree
    for name in parents:
        if isinstance(here, list):
            here = here[int(name)]
        else:
            if here.get(name) is None:
                here[name] = {}
            here = here[name]
    if isinstance(here, list):
        here[int(last)] = value
    else:
        here[last] = value


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:32]


def files_under(folder: Path) -> Callable[[str, str | None], str]:
    """`files_digest` of one folder for many points, which share their cities: no file is read for
    each of them."""
    return lru_cache(maxsize=64)(partial(files_digest, folder))


def files_digest(folder: Path, city: str, board: str | None) -> str:
    """Digest of the files of a city, as JSON, or of another file; "" where one is missing: the
    point's own check says so."""
    try:
        if city:
            return city_digest(City.model_construct(**json.loads(city)), folder)
        return "" if board is None else file_digest(folder / board)
    except (CityError, OSError):
        return ""


def load_sweep(path: Path | str, max_points: int = MAX_POINTS) -> Plan:
    """Read and check a sweep: every entry of every axis is tried on the base scenario before
    anything runs.

    Parameters
    ----------
    path : of the sweep's YAML file
    max_points : refuse more points than these

    Raises
    ------
    ScenarioError
        One line per problem, with the place in the file.

    Examples
    --------
    >>> import isac_rt as irt
    >>> plan = irt.load_sweep("scenes/sweeps/paper_ser.yaml")
    >>> plan.sweep.num_points, list(plan.sweep.axes)
    (108, ['snr_db', 'order'])
    """
    path = Path(path)
    document = Document(path, "a sweep needs a scenario and axes")
    sweep = document.check(Sweep)

    def refuse(key: Key, text: str) -> ScenarioError:
        return ScenarioError(document.complaint(Problem((key,), text)))

    if sweep.num_points > max_points:
        factors = " x ".join(
            f"{n} {name}" for name, n in zip([*sweep.axes, "repetitions"], sweep.shape, strict=True)
        )
        message = (
            f"{factors} are {sweep.num_points:,} points, more than {max_points:,}; shorten the "
            "axes or raise --max-points"
        )
        raise refuse(("axes",), message)
    file = path.parent / sweep.scenario
    try:
        base = load(file, options(sweep.set))
    except ScenarioError as error:
        raise refuse(
            ("set",) if sweep.set and file.is_file() else ("scenario",),
            f"the base scenario cannot be used: {error}",
        ) from None
    plan = Plan(sweep, base.in_folder(file.parent.resolve()))
    tree = plan.tree()
    for name, axis in sweep.axes.items():
        for i in range(axis.size):
            _try(
                tree,
                file.parent,
                axis.entry(i),
                lambda text, n=name, j=i: refuse(("axes", n), f"entry {j} of {n} {text}"),
            )
    return plan


def options(values: dict[str, Any]) -> list[str]:
    """Values by dotted key as the options that replace them."""
    return [f"{key}={json.dumps(value)}" for key, value in values.items()]


def _try(tree: dict[str, Any], folder: Path, entry: dict[str, Any], refuse: Any) -> None:
    """Check one entry of an axis alone on the base scenario.

    What depends on the other axes too is left to the points: a combination that cannot be is
    recorded as a failed point.
    """
    here = copy.deepcopy(tree)
    shown = ", ".join(f"{key} = {json.dumps(value)}" for key, value in entry.items())
    try:
        for key, value in entry.items():
            put(here, key, value)
        Scenario.model_validate(with_tables(here, folder, replace=True))
    except (TypeError, ValueError, KeyError, IndexError, AttributeError) as error:
        if not isinstance(error, ValidationError):
            raise refuse(f"({shown}): the scenario has no such key; check it") from None
        if error.errors()[0]["type"] == "inconsistent":
            return
        raise refuse(f"({shown}): {first_complaint(Scenario, error)}") from None
