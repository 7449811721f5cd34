"""Frames to results: the dataset and the summary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.frame.timetable import Timetable
from isac_rt.results.dataset import Row, amended, dataset_of, row_of
from isac_rt.results.metrics import SymbolCount, decibels
from isac_rt.results.provenance import versions_in_use
from isac_rt.results.records import KINDS, FrameRecord, LateRecord
from isac_rt.results.sensing import Sensing, latencies, summary_block
from isac_rt.results.swarm import summary_of
from isac_rt.scenario.tree import Scenario

if TYPE_CHECKING:
    import xarray as xr

STAGES = ("setup", "trace", "synthesis", "receive", "track")
TIMINGS = (*STAGES, "other", "total", "wall")


@dataclass(frozen=True)
class Results:
    """A run: labelled arrays, the summary of `summary.json`, and the scenario that made them."""

    dataset: xr.Dataset
    summary: dict[str, Any]
    scenario: Scenario

    def __repr__(self) -> str:
        def say(value: float | None, form: str) -> str:
            return "-" if value is None else format(value, form)

        kinds = {
            "hit_rate": ("hit rate", ".2f"),
            "ser_delay": ("delay SER", ".2e"),
            "ser_dpsk": ("DPSK SER", ".2e"),
        }
        blocks = self.summary["terminals"].items()
        lines = [
            f"  {name}: "
            + ", ".join(f"{words} {say(b[key], form)}" for key, (words, form) in kinds.items())
            for name, b in blocks
        ]
        return (
            "\n".join(
                [
                    f"<Results of {self.scenario.name}: {self.summary['frames']} frames, seed "
                    f"{self.summary['seed']}",
                    *lines,
                ]
            )
            + ">"
        )


@dataclass(frozen=True)
class Figures:
    """What a summary needs beside the frames.

    Attributes
    ----------
    timing : processor seconds by stage, what no stage counts, and their total; under ``wall`` the
        wall seconds of stages and total (`TIMINGS`)
    plan : what was modelled: the summary's `fidelity`, but for what was kept of the paths
    access : what became of the stages before the data, None without them
    compared : `Recorder.blocks` of the sets of receivers that heard the same samples, by name
    costs : of each set, `OWN` included, the processor seconds of reception and tracking by link;
        empty without sets to compare
    """

    timing: Mapping[str, Any]
    plan: Mapping[str, Any]
    access: Mapping[str, Any] | None = None
    compared: Mapping[str, Any] = field(default_factory=dict)
    costs: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


@dataclass
class Recorder:
    """Collects the frames of a run as rows of plain arrays and numbers. An observer is a link's
    receiver; `states` are the names of the terminals' state codes."""

    timetable: Timetable
    states: Sequence[str]
    rows: list[Row] = field(default_factory=list)
    amended: set[int] = field(default_factory=set)
    """Rows that have changed since they were last kept for a later call."""

    def add(self, record: FrameRecord) -> None:
        """Append the next frame."""
        self.rows.append(row_of(record))

    def amend(self, link: Link, late: LateRecord) -> None:
        """Say of an earlier frame what became of its data."""
        observers = self.rows[late.frame]["observers"]
        label = self.timetable.labels[link]
        observers[label] = amended(observers[label], late)
        self.amended.add(late.frame)

    def restore(self, rows: Sequence[Row], again: Sequence[tuple[int, Row]] = ()) -> None:
        """Append rows of an earlier call, and take rows `again` that have changed since, by their
        places.

        Raises
        ------
        IndexError, KeyError, ValueError, TypeError  If they are no rows of this run.
        """
        for place, row in again:
            if place < 0 or self.rows[place]["frame"] != row["frame"]:
                raise ValueError(f"row {place} is not of frame {row['frame']}")
        self._check([*rows, *(row for _, row in again)])
        for place, row in again:
            self.rows[place] = row
        self.rows += rows

    def _check(self, rows: Sequence[Row]) -> None:
        """Refuse what is no row of this run."""
        dataset_of(rows, self.timetable, self.states)
        kept_of_paths([row["uses"] for row in rows])
        _ = [SymbolCount(*o["symbols"]) for row in rows for o in row["observers"].values()]
        _ = [
            Sensing.of([o], len(self.timetable.first_roles))
            for row in rows
            for o in row["observers"].values()
        ]

    def dataset(self) -> xr.Dataset:
        """The labelled arrays of the frames so far."""
        return dataset_of(self.rows, self.timetable, self.states)

    def summary(self, figures: Figures) -> dict[str, Any]:
        """The keys of `summary.json` but for the scenario's name and seed; null stands for what
        does not apply."""
        rows = self.rows
        of_kind = sum(
            (o["path_count"] for row in rows for o in row["observers"].values()),
            np.zeros(len(KINDS), int),
        )
        return {
            "frames": len(rows),
            **self.blocks(),
            "compared": dict(figures.compared),
            "paths": {kind: int(n) for kind, n in zip(KINDS, of_kind, strict=True)},
            "timing_s": {key: figures.timing.get(key) for key in TIMINGS}
            | ({"by_set": dict(figures.costs)} if figures.costs else {}),
            "fidelity": {
                **figures.plan,
                "links": kept_of_paths([row["uses"] for row in rows]),
                "paths_contradicted": sum(row["dropped"] for row in rows),
            },
            "access": figures.access,
            "sparsity": {
                str(link): judged
                for link in self.timetable.all_links
                if (judged := self._sparsity(link))
            }
            or None,
            "versions": versions_in_use(),
        }

    def blocks(self) -> dict[str, Any]:
        """The keys `terminals`, `links` and `swarm` of the summary."""
        rows, timetable = self.rows, self.timetable
        duration = (
            (rows[-1]["frame"] - rows[0]["frame"]) * timetable.interval
            + timetable.waveform.frame_duration
            if rows
            else 0.0
        )
        symbols = {link: self._symbols(link) for link in timetable.all_links}
        seen = {link: self._sensing(link) for link in timetable.all_links}

        def block(
            role: str | list[str], links: list[Link], symbols: SymbolCount | None
        ) -> dict[str, Any]:
            sensing, names = Sensing.pooled([seen[link] for link in links]), timetable.first_roles
            others = {u: t for u, t in sensing.targets(list(names)).items() if u != links[0].rx}
            found = summary_block(role, sensing, symbols, duration)
            waits = [o["latency_frames"] for link in links for o in self._of(link)]
            return found | {"latency_frames": latencies(symbols, waits), "targets": others}

        terminals = {}
        for name in dict.fromkeys(link.rx for link in timetable.all_links):
            mine = [link for link in timetable.all_links if link.rx == name]
            received = [c for link in mine if (c := symbols[link]) is not None]
            roles = timetable.roles_taken(name)
            terminals[name] = block(
                roles[0] if len(roles) == 1 else roles,
                mine,
                sum(received, SymbolCount()) if received else None,
            )
        links = {
            str(link): block("active" if link.own else "passive", [link], counted)
            for link, counted in symbols.items()
        }
        swarm = summary_of(rows, list(timetable.first_roles))
        return {"terminals": terminals, "links": links, "swarm": swarm}

    def _of(self, link: Link) -> list[Row]:
        """The rows of a link's receiver."""
        label = self.timetable.labels[link]
        return [row["observers"][label] for row in self.rows if label in row["observers"]]

    def _sensing(self, link: Link) -> Sensing:
        """What a link's receiver saw."""
        return Sensing.of(self._of(link), len(self.timetable.first_roles))

    def _sparsity(self, link: Link) -> dict[str, int] | None:
        """Frames whose receiver judged how sparse the scene is, those found dense, and those sent
        by the conventional schedule for that reason; None where no frame was judged."""
        rows = self._of(link)
        judged = [row["sparse"] for row in rows if row["sparse"] >= 0]
        if not judged:
            return None
        fell_back = sum(row["fell_back"] for row in rows)
        return {"judged": len(judged), "dense": judged.count(0), "fell_back": fell_back}

    def _symbols(self, link: Link) -> SymbolCount | None:
        """What was sent over a link and became of it; None for a terminal's own echoes."""
        if link.own:
            return None
        return sum((SymbolCount(*row["symbols"]) for row in self._of(link)), SymbolCount())


def kept_of_paths(frames: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
    """What was kept and left out over a run, link by link: paths per frame, and the largest bounds
    of all frames.

    Parameters
    ----------
    frames : the values of `Use` by link, frame by frame
    """
    out = {}
    for link in dict.fromkeys(link for frame in frames for link in frame):
        rows = [frame[link] for frame in frames if link in frame]

        def mean(values: Iterable[float]) -> float:
            return round(float(np.mean(list(values))), 2)

        counts = ("found", "unheard", "weak", "plane", "straight")
        kinds = dict.fromkeys(kind for row in rows for kind in row["kept"])
        out[link] = {
            "frames": len(rows),
            **{f"{name}_per_frame": mean(row[name] for row in rows) for name in counts},
            "kept_per_frame": {
                kind: mean(row["kept"].get(kind, 0) for row in rows) for kind in kinds
            },
            "bounces": max(row["bounces"] for row in rows),
            "left_out_db": decibels(max(row["left_out"] for row in rows)),
            "plane_error_rad": max(row["plane_error"] for row in rows),
            "straight_error_rad": max(row["straight_error"] for row in rows),
            "turning_error_rad": max(row["turning_error"] for row in rows),
        }
    return out
