"""Goals of detection, tracking and data over any folder of scenes, each flown with several seeds.

The points are those of a sweep: flights run in processes of their own, and a stopped evaluation
goes on with the same command. A goal holds if every single flight meets it and the interval of the
number over all scenes does, and holds under a condition if the means over seeds do.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from isac_rt.runtime import UserError
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from reproduce.city import MISREAD, mean
from reproduce.city_flights import Flights, Place, fly, outcomes_of, seeds_wanted
from reproduce.flights_drawn import write_drawn
from reproduce.montecarlo import kept_folder
from reproduce.outcome import Outcome, Progress, Verdict, judged

QUICK_FRAMES, DRAWN = 10, 12
_scenes: ContextVar[Path | None] = ContextVar("scenes", default=None)
Values = dict[str, float]
"""By terminal; "" is the fused picture or the whole run."""


@contextmanager
def over(scenes: Path | None) -> Iterator[None]:
    """Set the scenes of `run` inside: a folder or a pattern of files; None: `DRAWN` drawn ones."""
    token = _scenes.set(scenes)
    try:
        yield
    finally:
        _scenes.reset(token)


@dataclass(frozen=True)
class SceneFile(Place):
    """A scene of the folder as its file states it."""

    def scenario(self, quick: bool) -> Scenario:
        """Read the file."""
        return load(Path(self.file), (), self.few if quick else None)


def _files(kept: Path, seed: int) -> dict[str, Place]:
    """Return the scenes to fly by name; drawn ones are written to `kept` first."""
    chosen = _scenes.get()
    if chosen is None:
        chosen = kept / "scenes"
        write_drawn(chosen, DRAWN, seed)
    folder, pattern = (chosen, "*.yaml") if chosen.is_dir() else (chosen.parent, chosen.name)
    files = sorted(file.resolve() for file in folder.glob(pattern))
    if not files:
        raise UserError(f"--scenes {chosen}: no scene is there; give a folder of YAML files")
    return {file.stem: SceneFile(str(file), 0, QUICK_FRAMES) for file in files}


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else np.nan


def _terminals(role: str, value: Callable[[Mapping[str, Any]], float]) -> Callable[[Any], Values]:
    """Return the measure that takes a value of each terminal of a role."""
    return lambda outcome: {
        name: value(block)
        for name, block in outcome["terminals"].items()
        if role in np.atleast_1d(block["role"])
    }


def _of_found(block: Mapping[str, Any]) -> float:
    targets = block["apart"]["targets"]
    return _ratio(targets["tracked"], (targets["hit_rate"] or 0) * targets["in_view"])


def _of_bound(block: Mapping[str, Any]) -> float:
    targets = block["apart"]["targets"]
    return _ratio(targets["tracked"], (targets["bounds"][BOUND] or 0) * targets["in_view"])


BOUND = "clutter_free"
"""Key of a terminal's `bounds` that tracks of passive terminals are held against."""


def _of_empty(gospa: Mapping[str, Any]) -> float:
    return _ratio(gospa["total_m"] or np.nan, gospa["empty_m"] or 0)


def _targets_of_empty(block: Mapping[str, Any]) -> float:
    return _of_empty(block["apart"]["targets"]["gospa"])


def _false(block: Mapping[str, Any]) -> float:
    return float(block["false_tracks_per_frame"])


def _fused(outcome: Mapping[str, Any]) -> Values:
    return {"": _of_empty(outcome["swarm"]["gospa"])} if outcome["swarm"] else {}


def _misread(outcome: Mapping[str, Any]) -> Values:
    """Count the data frames of each link that count as read, most of their symbols wrong."""
    return {link: float(misread(rows)) for link, rows in outcome["by_frame"].items()}


def misread(rows: list[list[int]]) -> int:
    """Count the frames that were read and have more than half of their delay or DPSK symbols wrong.

    Parameters
    ----------
    rows : of a link, as `by_frame` has them
    """
    _, _, *counts, read = np.array(rows, int).reshape(-1, 7).T
    wrong, sent = np.array(counts[::2]), np.array(counts[1::2])
    return int(((wrong > MISREAD * sent).any(axis=0) & (read > 0)).sum())


def _switches(outcome: Mapping[str, Any]) -> Values:
    targets = (outcome["swarm"] or {"targets": {}})["targets"]
    return {"": float(sum(t["switches"] for t in targets.values()))}


def _seconds(outcome: Mapping[str, Any]) -> Values:
    spent = outcome["timing_s"]
    return {"": (spent["receive"] + spent["track"]) / outcome["scenario"]["frames"]}


@dataclass(frozen=True)
class Goal:
    """One row of the table.

    Attributes
    ----------
    claim : in words
    measure : takes it from the outcome of a flight
    each : limit of every scene, None: no limit
    all : limit of what `pool` makes of all scenes, None: no limit
    least : whether limits are to be reached, else not exceeded
    """

    claim: str
    measure: Callable[[Any], Values]
    each: float | None = None
    all: float | None = None
    least: bool = False
    pool: Callable[[Any], Any] = np.nanmean

    def table(self, found: Mapping[str, Any]) -> pd.DataFrame:
        """Return the values of scenes and terminals (rows) by seed (columns)."""
        rows = {
            f"{scene} {name}".strip(): pd.Series([v[name] for v in values])
            for scene, outcomes in found.items()
            for values in [[self.measure(o) for o in outcomes]]
            for name in values[0]
        }
        return pd.DataFrame(rows).T

    def meets(self, value: Any, limit: float | None) -> Any:
        """Return whether values meet a limit; what is not a number asks for nothing."""
        if limit is None:
            return np.full(np.shape(value), True)
        return np.isnan(value) | ((value >= limit) if self.least else (value <= limit))

    def row(self, table: pd.DataFrame) -> dict[str, Any]:
        """Judge the table."""
        scenes = table.mean(axis=1)
        known = scenes.dropna()
        overall = mean([float(self.pool(table[seed].dropna())) for seed in table])
        worst = (known.idxmin() if self.least else known.idxmax()) if len(known) else ""
        fails = known.index[~self.meets(known, self.each)]
        ends = [overall.low if self.least else overall.high]
        sure = self.meets(table.to_numpy(), self.each).all() and not np.isnan(ends).any()
        met = bool(self.meets(overall.value, self.all)) and not len(fails) and bool(len(known))
        return {
            "goal": self.claim,
            "value": overall.value,
            "low": overall.low,
            "high": overall.high,
            "worst": known[worst] if worst else np.nan,
            "worst_in": worst,
            "fails_in": "; ".join(fails),
            "verdict": judged(met and sure and bool(self.meets(ends[0], self.all)), met),
        }

    def verdict(self, row: Mapping[str, Any], scenes: int) -> Verdict:
        """Say it."""
        sign = ">=" if self.least else "<="
        asked = [f"{self.pool.__name__[3:]} {sign} {self.all:g}"] if self.all is not None else []
        asked += [f"each {sign} {self.each:g}"] if self.each is not None else []
        said = f"{row['value']:.3g} [{row['low']:.3g}, {row['high']:.3g}], worst "
        said += f"{row['worst']:.3g} ({row['worst_in']}); asked: {', '.join(asked) or 'nothing'}"
        failed = row["fails_in"].split("; ") if row["fails_in"] else []
        said += f"; fails in {len(failed)} of {scenes}: {', '.join(failed)}" if failed else ""
        return Verdict(self.claim, row["verdict"], said)


GOALS = {
    "at_tracked": Goal(
        "AT: targets tracked over found", _terminals("active", _of_found), 0.9, least=True
    ),
    "at_false": Goal("AT: false tracks a frame", _terminals("active", _false), 0.2),
    "pt_tracked": Goal(
        f"PT: targets tracked over the bound {BOUND}",
        _terminals("passive", _of_bound),
        0.5,
        0.75,
        True,
        np.nanmedian,
    ),
    "pt_false": Goal("PT: false tracks a frame", _terminals("passive", _false)),
    "at_gospa": Goal(
        "AT: GOSPA of targets over that of no tracks",
        _terminals("active", _targets_of_empty),
        1.0,
        0.45,
    ),
    "pt_gospa": Goal(
        "PT: GOSPA of targets over that of no tracks",
        _terminals("passive", _targets_of_empty),
        1.0,
    ),
    "fused_gospa": Goal("fused tracks: GOSPA over that of no tracks", _fused, 0.6, 0.3),
    "misread": Goal("data frames read with SER over 0.5", _misread, 0, 0, pool=np.nansum),
    "switches": Goal("names of UAVs switched in the fused tracks", _switches, all=0.5),
    "seconds": Goal("processor seconds a frame of reception and tracking", _seconds),
}


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Fly what is missing and judge all of it."""
    kept = kept_folder()
    with tempfile.TemporaryDirectory() if kept is None else nullcontext(str(kept)) as folder:
        flights = Flights(_files(Path(folder), seed), seeds_wanted(quick), seed, quick)
        fly(flights, Path(folder), progress)
        found = outcomes_of(flights, Path(folder))
    tables = {name: goal.table(found) for name, goal in GOALS.items()}
    rows = [goal.row(tables[name]) for name, goal in GOALS.items()]
    scenes = pd.DataFrame({name: table.mean(axis=1) for name, table in tables.items()})
    verdicts = [g.verdict(r, len(tables[n])) for (n, g), r in zip(GOALS.items(), rows, strict=True)]
    return Outcome(
        "flights",
        "Goals over a folder of scenes",
        {"goals": pd.DataFrame(rows), "scenes": scenes.rename_axis("scene").reset_index()},
        None,
        tuple(verdicts),
        {"quick": quick, "seed": seed, "seeds": flights.seeds, "scenes": list(found)},
    )
