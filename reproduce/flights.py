"""Goals of detection, tracking and data over any folder of scenes, each flown with several seeds.

Flights are the points of a sweep: they run in processes of their own, and a stopped evaluation
continues with the same command. A goal holds if every flight meets it and the interval over seeds
does, and holds under a condition if the means over seeds do.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from isac_rt.runtime import UserError
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from isac_rt.settings import plain_tree
from reproduce.city import MISREAD, mean
from reproduce.city_flights import Flights, Place, fly, outcomes_of, scenes_wanted, seeds_wanted
from reproduce.flights_drawn import write_drawn
from reproduce.montecarlo import kept_folder
from reproduce.outcome import Outcome, Progress, Verdict, judged

QUICK_FRAMES, DRAWN = 10, 12
BOUND = "whitened"
"""Key of a terminal's `bounds` that tracks of passive terminals are held against: in clutter."""
Block = Mapping[str, Any]
Values = dict[str, float]
"""By terminal or link; "" for all of them together."""


@dataclass(frozen=True)
class SceneFile(Place):
    """A scene as its file states it."""

    def scenario(self, quick: bool) -> Scenario:
        """Read the file."""
        return load(Path(self.file), (), self.few if quick else None)


def _places(kept: Path, seed: int) -> dict[str, Place]:
    """Return the scenes to fly by name, equal ones once; drawn ones are written to `kept` first."""
    chosen = scenes_wanted()
    if chosen is None:
        chosen = kept / "scenes"
        write_drawn(chosen, DRAWN, seed)
    folder, pattern = (chosen, "*.yaml") if chosen.is_dir() else (chosen.parent, chosen.name)
    files = sorted(folder.resolve().glob(pattern), reverse=True)
    if not files:
        raise UserError(f"--scenes {chosen}: there is no scene; give a folder of YAML files")
    places = [SceneFile(str(file), 0, QUICK_FRAMES) for file in files]
    different = {str({**plain_tree(p.scenario(False)), "name": ""}): p for p in places}
    return {Path(p.file).stem: p for p in reversed(different.values())}


def _ratio(part: float | None, whole: float | None) -> float:
    return part / whole if whole and part is not None else np.nan


def _of_found(block: Block) -> float:
    """Return the share of the targets found that are tracked; at most 1, for tracks bridge gaps."""
    return min(_ratio(block["counts"]["tracked_rate"][0], block["counts"]["hit_rate"][0]), 1.0)


def _of_bound(block: Block) -> float:
    """Return the share of the targets that are detectable and tracked, at most 1."""
    return min(_ratio(block["tracked_rate"], block["bounds"][BOUND]), 1.0)


def _of_empty(block: Block) -> float:
    return _ratio(block["gospa"]["total_m"], block["gospa"]["no_tracks_m"])


def _at(role: str, value: Callable[[Block], float]) -> Callable[[Block], Values]:
    """Return the measure that takes a value of each terminal of a role."""
    return lambda outcome: {
        name: value(block)
        for name, block in outcome["terminals"].items()
        if role in np.atleast_1d(block["role"])
    }


def misread(outcome: Block) -> Values:
    """Count the frames that were read and have most of their delay or DPSK symbols wrong."""
    out = {}
    for link, rows in outcome["by_frame"].items():
        _, _, delay, delays, dpsk, dpsks, read = np.array(rows, int).reshape(-1, 7).T
        wrong = (delay > MISREAD * delays) | (dpsk > MISREAD * dpsks)
        out[link] = float((wrong & (read > 0)).sum())
    return out


def _fused(value: Callable[[Block], float]) -> Callable[[Block], Values]:
    """Return the measure that takes a value of the fused tracks, where there are any."""
    return lambda outcome: {"": value(outcome["swarm"])} if outcome["swarm"] else {}


def _switches(fused: Block) -> float:
    return float(sum(target["switches"] for target in fused["targets"].values()))


def _seconds(outcome: Block) -> Values:
    spent = outcome["timing_s"]
    return {"": (spent["receive"] + spent["track"]) / outcome["scenario"]["frames"]}


@dataclass(frozen=True)
class Goal:
    """A row of the table.

    Attributes
    ----------
    claim : in words
    measure : takes its values from the outcome of a flight
    each : limit in every scene, NaN: none
    limit : of what `pool` makes of all scenes, NaN: none
    least : whether limits are to be reached, else not to be exceeded
    """

    claim: str
    measure: Callable[[Block], Values]
    each: float = np.nan
    limit: float = np.nan
    least: bool = False
    pool: Callable[[Any], Any] = np.mean

    def values(self, found: Mapping[str, Any]) -> pd.DataFrame:
        """Return the values by scene and terminal (rows) and seed (columns)."""
        flown = {scene: [self.measure(o) for o in outcomes] for scene, outcomes in found.items()}
        rows = {(s, n): [v[n] for v in vs] for s, vs in flown.items() for n in vs[0]}
        index = pd.MultiIndex.from_tuples(rows, names=["scene", "of"])
        return pd.DataFrame([*rows.values()], index)

    def worst(self, values: pd.DataFrame) -> pd.Series:
        """Return the worst of `values` in each scene, means over seeds."""
        by_scene = values.mean(axis=1).groupby(level=0, sort=False)
        return by_scene.min() if self.least else by_scene.max()

    def verdict(self, values: pd.DataFrame) -> Verdict:
        """Judge `values`: say what came out, what was asked and which scenes fail."""
        sign, word = (1, ">=") if self.least else (-1, "<=")
        scenes = values.mean(axis=1).dropna().sort_values(ascending=self.least)
        pooled = mean([float(self.pool(values[seed].dropna())) for seed in values])
        failed = scenes[sign * scenes < sign * self.each]
        met = len(scenes) > 0 and not len(failed) and not sign * pooled.value < sign * self.limit
        end = pooled.low if self.least else pooled.high
        sure = met and not (sign * values < sign * self.each).any(axis=None)
        sure = sure and (np.isnan(self.limit) or sign * end >= sign * self.limit)
        said = f"{self.pool.__name__} of {len(scenes)}: {pooled.text}"
        said += "".join(
            f", worst {v:.3g} in {' '.join(at).strip()}" for at, v in scenes[:1].items()
        )
        limits = {self.pool.__name__: self.limit, "each": self.each}
        said += "".join(f"; {k} {word} {v:g} asked" for k, v in limits.items() if not np.isnan(v))
        if len(failed):
            said += "; fails in " + ", ".join(
                f"{' '.join(k).strip()} {v:.3g}" for k, v in failed.items()
            )
        return Verdict(self.claim, judged(sure, met), said)


_AT, _PT, _OF_EMPTY = "active", "passive", "GOSPA of targets over that of no tracks"
GOALS = {
    "at_tracked": Goal("AT: targets tracked over found", _at(_AT, _of_found), 0.9, least=True),
    "at_false": Goal(
        "AT: false tracks a frame", _at(_AT, lambda b: float(b["false_tracks_per_frame"])), 0.2
    ),
    "at_gospa": Goal(f"AT: {_OF_EMPTY}", _at(_AT, _of_empty), 1.0, 0.45),
    "pt_tracked": Goal(
        "PT: targets tracked over those detectable in clutter",
        _at(_PT, _of_bound),
        0.5,
        0.75,
        True,
        np.median,
    ),
    "pt_gospa": Goal(f"PT: {_OF_EMPTY}", _at(_PT, _of_empty), 1.0),
    "fused_gospa": Goal(f"fused: {_OF_EMPTY}", _fused(_of_empty), 0.6, 0.3),
    "misread": Goal("data frames of SER over 0.5 that count as read", misread, 0, 0, pool=np.sum),
    "switches": Goal("switched names of UAVs in the fused tracks", _fused(_switches), limit=0.5),
    "seconds": Goal("processor seconds a frame for reception and tracking", _seconds),
}


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Fly what is missing and judge all of it."""
    kept = kept_folder()
    with tempfile.TemporaryDirectory() if kept is None else nullcontext(str(kept)) as folder:
        flights = Flights(_places(Path(folder), seed), seeds_wanted(quick), seed, quick)
        fly(flights, Path(folder), progress)
        found = outcomes_of(flights, Path(folder))
    values = {name: goal.values(found) for name, goal in GOALS.items()}
    values = {name: v for name, v in values.items() if len(v)}  # what the scenes can show
    scenes = pd.DataFrame({name: GOALS[name].worst(v) for name, v in values.items()})
    return Outcome(
        "flights",
        "Goals of tracking over a folder of scenes",
        {"scenes": scenes.reset_index()},
        None,
        tuple(GOALS[name].verdict(v) for name, v in values.items()),
        {"quick": quick, "seed": seed, "seeds": flights.seeds, "scenes": list(found)},
    )
