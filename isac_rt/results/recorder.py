"""Frames to results: the dataset and the summary."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from isac_rt.frame.link import Link
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import Waveform
from isac_rt.results.dataset import _Builder
from isac_rt.results.metrics import SensingScore, SymbolCount, pool, summary_block
from isac_rt.results.provenance import provenance, versions
from isac_rt.results.records import KINDS, FrameRecord, _slim, _SlimFrame, _sparse
from isac_rt.scenario.tree import Scenario

TIMINGS = ("setup", "trace", "synthesis", "receive", "track", "total")


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


@dataclass
class Recorder:
    """Collects the frames of a run. An observer is a link's receiver; `states` are the names of the
    terminals' state codes."""

    scenario: Scenario
    waveform: Waveform
    timetable: Timetable
    states: Sequence[str]
    _frames: list[_SlimFrame] = field(default_factory=list)

    def add(self, record: FrameRecord) -> None:
        """Append the next frame. Of frames that are no snapshots the paths are counted and let
        go."""
        rows = {name: _slim(o, record.snapshot) for name, o in record.observers.items()}
        self._frames.append(_SlimFrame(**{**vars(record), "observers": rows}))

    @property
    def count(self) -> int:
        """Frames so far."""
        return len(self._frames)

    def since(self, first: int) -> list[Any]:
        """The frames from number `first` on, for `restore`."""
        return self._frames[first:]

    def restore(self, frames: list[Any]) -> None:
        """Append frames that `since` gave."""
        self._frames += frames

    def finish(
        self,
        *,
        scores: Mapping[Link, SensingScore],
        timing: Mapping[str, float],
        fidelity: Mapping[str, Any],
        access: Mapping[str, Any] | None = None,
        materials: Mapping[str, Any] | None = None,
        link_budget: Sequence[Mapping[str, Any]] = (),
    ) -> Results:
        """The results of the frames so far. `scores` holds every link's sensing; `timing` [s] goes
        into the summary only, as does what became of the stages before the data (`access`);
        `materials` and `link_budget` (rows of a table) are kept as JSON attributes of the
        dataset."""
        dataset = _Builder(
            self.scenario, self.waveform, self.timetable, tuple(self.states), self._frames
        ).dataset()
        dataset.attrs |= {
            **provenance(self.scenario),
            "fidelity": json.dumps(dict(fidelity)),
            "materials": json.dumps(dict(materials or {})),
            "link_budget": json.dumps([dict(row) for row in link_budget]),
        }
        summary = self.summary(scores=scores, timing=timing, fidelity=fidelity, access=access)
        return Results(dataset, summary, self.scenario)

    def summary(
        self,
        *,
        scores: Mapping[Link, SensingScore],
        timing: Mapping[str, float],
        fidelity: Mapping[str, Any],
        access: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """The fixed keys of `summary.json` alone; null stands for what does not apply."""
        frames = self._frames
        interval = self.scenario.frame_interval_s or self.waveform.frame_duration
        duration = (
            (frames[-1].frame - frames[0].frame) * interval + self.waveform.frame_duration
            if frames
            else 0.0
        )
        symbols = {link: self._symbols(link) for link in self.timetable.all_links}
        links = {}
        for (tx, rx), counted in symbols.items():
            role = "active" if tx == rx else "passive"
            links[f"{tx}->{rx}"] = summary_block(role, scores[tx, rx], counted, duration)
        terminals = {}
        for name in dict.fromkeys(rx for _, rx in self.timetable.all_links):
            mine = [link for link in self.timetable.all_links if link[1] == name]
            received = [c for link in mine if (c := symbols[link]) is not None]
            roles = self.timetable.roles_taken(name)
            pooled = sum(received, SymbolCount()) if received else None
            terminals[name] = summary_block(
                roles[0] if len(roles) == 1 else roles,
                pool([scores[link] for link in mine]),
                pooled,
                duration,
            )
        of_kind = sum(
            (o.counts for f in frames for o in f.observers.values()), np.zeros(len(KINDS), int)
        )
        return {
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "frames": len(frames),
            "terminals": terminals,
            "links": links,
            "paths": {kind: int(n) for kind, n in zip(KINDS, of_kind, strict=True)},
            "timing_s": {key: float(timing[key]) if key in timing else None for key in TIMINGS},
            "fidelity": dict(fidelity),
            "access": None if access is None else dict(access),
            "sparsity": {
                f"{tx}->{rx}": row for tx, rx in symbols if (row := self._sparsity((tx, rx)))
            }
            or None,
            "versions": versions(),
        }

    def _sparsity(self, link: Link) -> dict[str, int] | None:
        """Frames whose receiver judged how sparse the scene is, those found dense, and those sent
        by the conventional schedule for that reason; None where no frame was judged."""
        label = self.timetable.labels[link]
        seen = [f.observers[label] for f in self._frames if label in f.observers]
        judged = [found for s in seen if (found := _sparse(s)) >= 0]
        fell_back = sum(s.record.fell_back for s in seen)
        return (
            {"judged": len(judged), "dense": judged.count(0), "fell_back": fell_back}
            if judged
            else None
        )

    def _symbols(self, link: Link) -> SymbolCount | None:
        """What was sent over a link and became of it; None for a terminal's own echoes."""
        if link[0] == link[1]:
            return None
        label = self.timetable.labels[link]
        return sum(
            (f.observers[label].record.symbols for f in self._frames if label in f.observers),
            SymbolCount(),
        )
