"""The receivers of `city` in several cities, beside `plain` and `paper` on the same samples: what
is found, what is false, what it costs, with intervals over seeds and bounds.

Target-frames of one flight are not independent: the intervals of rates are Clopper-Pearson with the
sample size that seeds of unequal rates amount to (`montecarlo.interval`), those of means Student's
over seeds. One seed gives rates an interval that is too narrow, and means none.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy import stats

from isac_rt.results.losses import LOSSES
from reproduce.city_flights import (
    MISSING,
    MUNICH,
    PAPER,
    PLACES,
    SETS,
    WRONG,
    Flights,
    fly,
    of_set,
    outcomes_of,
    seconds_of,
    seeds_wanted,
)
from reproduce.montecarlo import INTERVAL, interval, kept_folder
from reproduce.outcome import Outcome, Progress, Verdict, blank, judged, style

Outcomes = Sequence[dict[str, Any]]
FALSE = 0.3
"""False confirmed tracks a frame that a terminal may have."""
GOSPA_M = {"active": 3.0, "passive": 4.0}
SWARM_M, MUNICH_M = 2.5, 1.5
SHADOW_END = 36
"""First frame over Munich that a pilot made PT1 read before there were other ways: the data frames
before it are those that were lost."""
SEES_AGAIN = 31
"""Frame from which on PT1 has a way that is good for data."""
MISREAD = 0.5
"""Share of wrong delay symbols of a frame that is misread."""
ALIKE = 1.05
"""Errors on the same samples that differ by less are no worse."""


class Estimate(NamedTuple):
    """A number and its 95 % interval, NaN where there is none."""

    value: float
    low: float = np.nan
    high: float = np.nan

    @property
    def text(self) -> str:
        """As people read it."""
        if np.isnan(self.low):
            return f"{self.value:.3g}, no interval"
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


def rate(events: Sequence[int], trials: Sequence[int]) -> Estimate:
    """A rate over seeds; of nothing NaN."""
    total = int(np.sum(trials))
    if not total:
        return Estimate(np.nan)
    scaled = np.array(events) * (np.mean(trials) / np.maximum(trials, 1))
    return Estimate(sum(events) / total, *interval(scaled, total / len(trials)))


def mean(values: Sequence[float]) -> Estimate:
    """A mean over seeds with Student's interval."""
    x = np.array([v for v in values if v is not None], float)
    if not x.size:
        return Estimate(np.nan)
    if x.size == 1:
        return Estimate(float(x[0]))
    half = float(stats.t.ppf(0.975, x.size - 1) * x.std(ddof=1) / np.sqrt(x.size))
    return Estimate(float(x.mean()), float(x.mean()) - half, float(x.mean()) + half)


def root(values: Sequence[float]) -> Estimate:
    """The root of the mean square over seeds."""
    squares = mean([v**2 for v in values if v is not None])
    return Estimate(*(float(np.sqrt(max(v, 0.0))) for v in squares))


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """All flights, or what is missing of them, and what they say."""
    flights = Flights(PLACES, seeds_wanted(quick), seed, quick)
    kept = kept_folder()
    with tempfile.TemporaryDirectory() if kept is None else nullcontext(str(kept)) as folder:
        fly(flights, Path(folder), progress)
        found = outcomes_of(flights, Path(folder))
    tables = {
        "terminals": pd.DataFrame(list(_terminals(found))),
        "targets": pd.DataFrame(list(_targets(found))),
        "losses": pd.DataFrame(list(_losses(found))),
        "data": pd.DataFrame(list(_data(found))),
        "swarm": pd.DataFrame(list(_pictures(found))),
    }
    settings = {
        "quick": quick,
        "seed": seed,
        "seeds": flights.seeds,
        "frames": {name: s.frames for name, s in flights.scenarios.items()},
        "unseen": [name for name in found if PLACES[name].unseen],
        "intervals": f"rates: {INTERVAL}, over seeds; means: 95 %, Student over seeds",
    }
    verdicts = tuple(goal.verdict(flights.seeds) for goal in goals(found, quick))
    title = "The receivers of `city` in several cities"
    return Outcome("city", title, tables, _figure(tables["terminals"]), verdicts, settings)


def _blocks(found: Mapping[str, Outcomes], level: str) -> Iterator[tuple[str, str, str, list[Any]]]:
    """(place, set, terminal or link, its blocks, one a seed)."""
    for place, outcomes in found.items():
        for name in SETS:
            if not outcomes or of_set(outcomes[0], name) is None:
                continue
            for of in outcomes[0][level]:
                blocks = [(of_set(o, name) or {})[level][of] for o in outcomes]
                yield place, name, of, blocks


def _spread(name: str, e: Estimate) -> dict[str, float]:
    return {name: e.value, f"{name}_low": e.low, f"{name}_high": e.high}


def _counted(blocks: Outcomes, key: str) -> Estimate:
    """A rate of `counts`."""
    pairs = [b["counts"][key] for b in blocks]
    return rate([e for e, _ in pairs], [n for _, n in pairs])


def _role(block: dict[str, Any]) -> str:
    return block["role"] if isinstance(block["role"], str) else block["role"][0]


def _gospa(blocks: Outcomes) -> Estimate:
    return root([b["gospa"]["total_m"] for b in blocks])


def _false(blocks: Outcomes) -> Estimate:
    return mean([b["false_tracks_per_frame"] for b in blocks])


def _terminals(found: Mapping[str, Outcomes]) -> Iterator[dict[str, Any]]:
    """What each terminal achieved by place and set."""
    for place, name, terminal, blocks in _blocks(found, "terminals"):
        bounds = [b["bounds"] for b in blocks]
        yield {
            "place": place,
            "receivers": name,
            "terminal": terminal,
            "role": _role(blocks[0]),
            "seeds": len(blocks),
            **_spread("hit_rate", _counted(blocks, "hit_rate")),
            **_spread("tracked_rate", _counted(blocks, "tracked_rate")),
            **{key: mean([b[key] for b in bounds]).value for key in bounds[0]},
            **_spread("false_tracks_per_frame", _false(blocks)),
            **_spread("gospa_m", _gospa(blocks)),
            "no_tracks_m": root([b["gospa"]["no_tracks_m"] for b in blocks]).value,
            **_spread("ser_delay", _counted(blocks, "ser_delay")),
            **_spread("ser_dpsk", _counted(blocks, "ser_dpsk")),
            **_spread("erased", mean([b["erased"] for b in blocks])),
        }


def _targets(found: Mapping[str, Outcomes]) -> Iterator[dict[str, Any]]:
    """Who found whom."""
    for place, name, terminal, blocks in _blocks(found, "terminals"):
        for uav in blocks[0]["targets"]:
            rows = [b["targets"][uav] for b in blocks]
            in_view = [r["in_view"] for r in rows]
            if sum(in_view):
                yield {
                    "place": place,
                    "receivers": name,
                    "terminal": terminal,
                    "uav": uav,
                    "in_view": sum(in_view),
                    **_spread("found", rate([r["found"] for r in rows], in_view)),
                    **_spread("tracked", rate([r["tracked"] for r in rows], in_view)),
                }


def _losses(found: Mapping[str, Outcomes]) -> Iterator[dict[str, Any]]:
    """What became of every target-frame in view, over all seeds."""
    for place, name, terminal, blocks in _blocks(found, "terminals"):
        causes = {cause: sum(b["losses"][cause] for b in blocks) for cause in LOSSES}
        yield {
            "place": place,
            "receivers": name,
            "terminal": terminal,
            "in_view": sum(b["counts"]["hit_rate"][1] for b in blocks),
            **causes,
        }


def _data(found: Mapping[str, Outcomes]) -> Iterator[dict[str, Any]]:
    """What became of the data frames of every link with the receivers of `city`, and what a frame
    of its receiver costs."""
    for place, outcomes in found.items():
        for link in outcomes[0]["by_frame"] if outcomes else ():
            tables = [np.array(o["by_frame"][link]).reshape(-1, 7) for o in outcomes]
            data = np.concatenate([t[t[:, 3] > 0] for t in tables])
            lost = data[:, 2] > MISREAD * data[:, 3]
            yield {
                "place": place,
                "link": link,
                "data_frames": len(data),
                "lost_in_sight": int((lost & (data[:, 1] > 0)).sum()),
                "lost_out_of_sight": int((lost & (data[:, 1] == 0)).sum()),
                **_spread("seconds_per_frame", mean([seconds_of(o, link) for o in outcomes])),
            }


def _pictures(found: Mapping[str, Outcomes]) -> Iterator[dict[str, Any]]:
    """What terminals know by what they tell each other."""
    for place, outcomes in found.items():
        for name in SETS:
            if not outcomes or of_set(outcomes[0], name) is None:
                continue
            swarms = [(of_set(o, name) or {})["swarm"] for o in outcomes]
            for picture in ("", *swarms[0]["terminals"]):
                yield {
                    "place": place,
                    "receivers": name,
                    "picture": picture or "all together",
                    **_picture([s["terminals"][picture] if picture else s for s in swarms]),
                }


def _picture(blocks: Outcomes) -> dict[str, float]:
    parts = [list(b["targets"].values()) for b in blocks]
    in_view = [b["in_view"] for b in blocks]

    def share(what: str) -> Estimate:
        return rate([sum(t[what] for t in one) for one in parts], in_view)

    return {
        **_spread("hit_rate", share("found")),
        **_spread("tracked_rate", share("tracked")),
        **_spread("false_tracks_per_frame", _false(blocks)),
        **_spread("gospa_m", root([b["gospa"]["total_m"] for b in blocks])),
        "no_tracks_m": root([b["gospa"]["no_tracks_m"] for b in blocks]).value,
        "position_m": root([b["rmse"]["position_m"] for b in blocks]).value,
        "nees": mean([b["nees"] for b in blocks]).value,
        "switches": sum(t["switches"] for one in parts for t in one),
    }


@dataclass(frozen=True)
class Goal:
    """What is asked for, and what came out.

    Attributes
    ----------
    claim : in words
    found : the number
    limit : it must reach, or not exceed
    least : whether it must reach it
    """

    claim: str
    found: Estimate
    limit: float
    least: bool = False

    def verdict(self, seeds: int) -> Verdict:
        """Holds, if the whole interval does; under a condition, if the number alone does."""
        sign = 1 if self.least else -1
        bound = self.found.low if self.least else self.found.high
        met, sure = (sign * (x - self.limit) >= 0 for x in (self.found.value, bound))
        asked = f"at {'least' if self.least else 'most'} {self.limit:g} asked"
        count = f"{seeds} seed{'s' if seeds > 1 else ''}"
        return Verdict(self.claim, judged(sure, met), f"{self.found.text}, {count}; {asked}")


def goals(found: Mapping[str, Outcomes], quick: bool) -> Iterator[Goal]:
    """All that a full evaluation is held to; of a quick one what stretches of flights allow."""
    for place, outcomes in found.items():
        if PLACES[place].compared and place != PAPER:
            yield from _goals_anywhere(place, outcomes)
    if MUNICH in found:
        yield from _goals_of_munich(found[MUNICH])
    if quick:
        return
    yield from _goals_of_data(found[MUNICH])
    yield from _goals_of_paper(found[PAPER])
    for place in (WRONG, MISSING):
        loss = _worst_loss(found[MUNICH], found[place])
        yield Goal(f"{place}: at most 0.05 of any rate is lost", loss, 0.05)
    yield Goal(f"{MISSING}: hardly a false track", _worst(found[MISSING], _false), FALSE)


def _of(outcomes: Outcomes, terminal: str) -> list[Any]:
    return [o["terminals"][terminal] for o in outcomes]


def _worst(
    outcomes: Outcomes, measure: Callable[[Outcomes], Estimate], role: str | None = None
) -> Estimate:
    """The largest of a measure over the terminals of a role, or of all."""
    blocks = [_of(outcomes, name) for name in outcomes[0]["terminals"]]
    values = [measure(b) for b in blocks if role in (None, _role(b[0]))]
    return max(values, key=lambda e: e.value)


def _goals_anywhere(place: str, outcomes: Outcomes) -> Iterator[Goal]:
    """False tracks and GOSPA."""
    claim = f"{place}: false confirmed tracks a frame at each terminal"
    yield Goal(claim, _worst(outcomes, _false), FALSE)
    for role, limit in GOSPA_M.items():
        claim = f"{place}: GOSPA of the targets at {role} terminals [m]"
        yield Goal(claim, _worst(outcomes, _gospa, role), limit)
    swarm = root([o["swarm"]["gospa"]["total_m"] for o in outcomes])
    limit = MUNICH_M if place == MUNICH else SWARM_M
    yield Goal(f"{place}: GOSPA of the swarm's picture [m]", swarm, limit)


def _goals_of_munich(outcomes: Outcomes) -> Iterator[Goal]:
    """Rates and costs."""
    at, pt2 = _of(outcomes, "AT"), _of(outcomes, "PT2")
    for uav in ("U1", "U3"):
        rows = [b["targets"][uav] for b in pt2]
        share = rate([r["found"] for r in rows], [r["in_view"] for r in rows])
        yield Goal(f"{MUNICH}: {uav} found by PT2", share, 0.9, True)
    for name, blocks, limit in (("AT", at, 0.95), ("PT2", pt2, 0.8)):
        hits = _counted(blocks, "hit_rate")
        yield Goal(f"{MUNICH}: targets found by {name}", hits, limit, True)
    for link, limit in (("AT->AT", 0.35), ("AT->PT1", 0.6), ("AT->PT2", 0.6)):
        spent = mean([seconds_of(o, link) for o in outcomes])
        claim = f"{MUNICH}: processor seconds a frame on {link}, as loaded as this machine is"
        yield Goal(claim, spent, limit)


def _goals_of_data(outcomes: Outcomes) -> Iterator[Goal]:
    """PT1's data in the shadow and after it."""
    read, shadow, late, counts = [], [], [], np.zeros(4)
    for outcome in outcomes:
        table = np.array(outcome["by_frame"]["AT->PT1"])
        data = table[table[:, 3] > 0]
        good = data[:, 2] <= MISREAD * data[:, 3]
        before = data[:, 0] < SHADOW_END
        read.append(int((good & (data[:, 6] > 0)).sum()))
        shadow.append(int((good & before).sum()))
        late.append(int((~good & (data[:, 0] >= SEES_AGAIN)).sum()))
        counts += data[good & before][:, 2:6].sum(axis=0)
    yield Goal(f"{MUNICH}: data frames that PT1 reads", mean(read), 51, True)
    yield Goal(f"{MUNICH}: data frames that PT1 reads in the shadow", mean(shadow), 13, True)
    for key, (wrong, sent), limit in (
        ("delay", counts[:2], 0.002),
        ("DPSK", counts[2:], 0.02),
    ):
        share = rate([int(wrong)], [int(sent)])
        yield Goal(f"{MUNICH}: {key} symbols wrong in them", share, limit)
    claim = f"{MUNICH}: data frames from {SEES_AGAIN} on that PT1 loses or misreads"
    yield Goal(claim, mean(late), 0)


def _goals_of_paper(outcomes: Outcomes) -> Iterator[Goal]:
    """Nothing is lost where there is no city."""
    lost = []
    for outcome in outcomes:
        table = np.array(outcome["by_frame"]["AT->PT2"])
        wrong = table[:, 2] > MISREAD * table[:, 3]
        lost.append(int(((table[:, 3] > 0) & wrong & (table[:, 1] > 0)).sum()))
    yield Goal(f"{PAPER}: data frames in sight that PT2 loses", mean(lost), 0)
    plain = [o["compared"]["plain"] for o in outcomes]
    yield Goal(f"{PAPER}: rates lost against plain", _worst_loss(plain, outcomes), 0)
    ratios = [
        mean([b["rmse"][axis] for b in _of(outcomes, name)]).value
        / mean([b["rmse"][axis] for b in _of(plain, name)]).value
        for name in outcomes[0]["terminals"]
        for axis in outcomes[0]["terminals"][name]["rmse"]
    ]
    worst = Estimate(float(np.nanmax(ratios)))
    yield Goal(f"{PAPER}: largest ratio of RMS errors to those of plain", worst, ALIKE)


def _worst_loss(before: Outcomes, after: Outcomes) -> Estimate:
    """By how much the rate of any terminal that suffers most is worse, on the same seeds."""
    losses = []
    for name in before[0]["terminals"]:
        for key, sign in (("hit_rate", 1), ("ser_delay", -1), ("ser_dpsk", -1)):
            pairs = zip(_of(before, name), _of(after, name), strict=False)
            changes = [sign * (a[key] - b[key]) for a, b in pairs if a[key] is not None]
            losses.append(mean(changes))
    return max((e for e in losses if not np.isnan(e.value)), key=lambda e: e.value)


def _figure(terminals: pd.DataFrame) -> Figure:
    """Hit rates, false tracks and GOSPA of the targets at every terminal."""
    rows = [
        ("hit_rate", "targets found"),
        ("false_tracks_per_frame", "false tracks a frame"),
        ("gospa_m", "GOSPA [m]"),
    ]
    seats = list(dict.fromkeys(zip(terminals.place, terminals.terminal, strict=True)))
    with style():
        figure, axes = blank(len(rows), 1, (max(6.4, 0.42 * len(seats)), 8.0), sharex=True)
        for ax, (key, title) in zip(axes[:, 0], rows, strict=True):
            for k, name in enumerate(SETS):
                one = terminals[terminals.receivers == name]
                at = [
                    seats.index(seat) + 0.2 * (k - 1)
                    for seat in zip(one.place, one.terminal, strict=True)
                ]
                low = np.nan_to_num(np.maximum(one[key] - one[f"{key}_low"], 0))
                high = np.nan_to_num(np.maximum(one[f"{key}_high"] - one[key], 0))
                ax.errorbar(at, one[key], [low, high], fmt="o", label=name)
            ax.set_ylabel(title)
        own = terminals[terminals.receivers == SETS[0]]
        places = [seats.index(s) for s in zip(own.place, own.terminal, strict=True)]
        axes[0, 0].plot(places, own.genie, "k_", label="matched filter")
        axes[2, 0].plot(places, own.no_tracks_m, "k_", label="no tracks")
        axes[1, 0].set_yscale("symlog", linthresh=0.1)
        for ax in axes[:, 0]:
            ax.legend(loc="best")
        axes[-1, 0].set_xticks(range(len(seats)))
        axes[-1, 0].set_xticklabels([f"{p}: {t}" for p, t in seats], rotation=60, ha="right")
    return figure
