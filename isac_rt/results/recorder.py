"""Frames to results: the dataset and the summary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.frame.timetable import Timetable
from isac_rt.results.columns import TABLES
from isac_rt.results.dataset import LATE_VARIABLES, Columns, Row, dataset_of, row_of, row_type
from isac_rt.results.metrics import SymbolCount, decibels
from isac_rt.results.provenance import versions_in_use
from isac_rt.results.records import KINDS, FrameRecord, LateRecord
from isac_rt.results.rows import Table
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
    samples: Mapping[tuple[int, Link], IFCube] = field(default_factory=dict)
    """IF samples by frame and link, of runs that were told to keep them."""

    def __repr__(self) -> str:
        def text(value: float | None, form: str) -> str:
            return "-" if value is None else format(value, form)

        lines = [f"<Results of {self.scenario.name}: {self.summary['frames']} frames, seed "]
        lines[0] += str(self.summary["seed"])
        for name, block in self.summary["terminals"].items():
            found, tracked = (text(block[key], ".2f") for key in ("hit_rate", "tracked_rate"))
            delay, dpsk = (text(block[key], ".2e") for key in ("ser_delay", "ser_dpsk"))
            lines.append(
                f"  {name}: targets found {found}, tracked {tracked} (n = {block['in_view']}), "
                f"SER delay {delay}, DPSK {dpsk}"
            )
        return "\n".join(lines) + ">"


@dataclass(frozen=True)
class Figures:
    """Inputs of a summary besides the frames.

    Attributes
    ----------
    timing : processor seconds by stage, what no stage counts, and their total; under ``wall`` the
        wall seconds of stages and total (`TIMINGS`)
    plan : what was modelled: the summary's `fidelity`, but for what was kept of the paths
    access : what became of the stages before the data, None without them
    compared : `Recorder.blocks` of the sets of receivers that received the same samples, by name
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
    """Collects the frames of a run as rows of numbers. An observer is a link's receiver; `states`
    are the names of the terminals' state codes."""

    timetable: Timetable
    states: Sequence[str]
    tables: dict[str, dict[str, Table]] = field(init=False)
    shots: dict[int, Row] = field(default_factory=dict)
    """Path ledgers and maps of the snapshots by frame."""
    amended: set[int] = field(default_factory=set)
    """Frames whose rows have changed since they were last kept for a later call."""

    def __post_init__(self) -> None:
        self._num_uavs = len(self.timetable.first_roles)
        self.tables = {kind: {} for kind in TABLES}
        self._count = 0
        self._begin("frame", [""])
        for kind in ("observer", "det", "track"):
            self._begin(kind, self.timetable.labels.values())

    def __len__(self) -> int:
        """Frames so far."""
        return self._count

    def _begin(self, kind: str, labels: Iterable[str]) -> None:
        dtype = row_type(kind, self._num_uavs)
        for label in labels:
            self.tables[kind][label] = Table(dtype, self._count)

    def add(self, record: FrameRecord) -> None:
        """Append the next frame."""
        self._append(row_of(record))

    def _append(self, row: Row) -> None:
        for kind, tables in self.tables.items():
            self._begin(kind, [label for label in row[kind] if label not in tables])
            for label, table in tables.items():
                table.append(row[kind].get(label, np.zeros(0, table.dtype)))
        shot = {part: of for part, of in row.items() if part not in TABLES}
        if shot:
            self.shots[self._count] = shot
        self._count += 1

    def amend(self, link: Link, late: LateRecord) -> None:
        """Say of an earlier frame what became of its data."""
        table = self.tables["observer"][self.timetable.labels[link]]
        rows = table[late.frame]
        for name in LATE_VARIABLES:
            rows[name] = TABLES["observer"][name].read(late)
        table[late.frame] = rows
        self.amended.add(late.frame)

    def row(self, frame: int) -> Row:
        """A frame, for `restore`."""
        return self.shots.get(frame, {}) | {
            kind: {label: table[frame] for label, table in tables.items()}
            for kind, tables in self.tables.items()
        }

    def restore(self, rows: Sequence[Row], again: Sequence[tuple[int, Row]] = ()) -> None:
        """Append rows of an earlier call, and take rows `again` that have changed since, by their
        frames.

        Raises
        ------
        IndexError, KeyError, ValueError, TypeError  If they are no rows of this run.
        """
        alone = Recorder(self.timetable, self.states)
        for row in (*rows, *(row for _, row in again)):
            alone._append(row)
        alone.dataset()
        alone.blocks()
        stored = self.tables["frame"][""]
        for frame, row in again:
            if frame < 0 or stored[frame]["frame"] != row["frame"][""]["frame"]:
                raise ValueError(f"row {frame} is not of frame {row['frame']}")
        for frame, row in again:
            for label, changed in row["observer"].items():
                self.tables["observer"][label][frame] = changed
        for row in rows:
            self._append(row)

    def dataset(self) -> xr.Dataset:
        """The labelled arrays of the frames so far."""
        return dataset_of(self.tables, self.shots, self.timetable, self.states)

    def summary(self, figures: Figures) -> dict[str, Any]:
        """The keys of `summary.json` but for the scenario's name and seed; null stands for what
        does not apply."""
        of_kind = sum(
            (t.whole()["path_count"].sum(axis=0) for t in self.tables["observer"].values()),
            np.zeros(len(KINDS), int),
        )
        return {
            "frames": len(self),
            **self.blocks(),
            "compared": dict(figures.compared),
            "paths": {kind: int(n) for kind, n in zip(KINDS, of_kind, strict=True)},
            "timing_s": {key: figures.timing.get(key) for key in TIMINGS}
            | ({"by_set": dict(figures.costs)} if figures.costs else {}),
            "fidelity": {
                **figures.plan,
                "links": {link: kept_of_paths(t.whole()) for link, t in self.tables["use"].items()},
                "paths_contradicted": int(self.tables["frame"][""].whole()["dropped"].sum()),
            },
            "access": figures.access,
            "sparsity": {
                str(link): tested
                for link in self.timetable.all_links
                if (tested := self._sparsity(link))
            }
            or None,
            "versions": versions_in_use(),
        }

    def blocks(self) -> dict[str, Any]:
        """The keys `terminals`, `links` and `swarm` of the summary."""
        timetable, number = self.timetable, self.tables["frame"][""].whole()["frame"]
        duration = (
            int(number[-1] - number[0]) * timetable.interval + timetable.waveform.frame_duration
            if len(self)
            else 0.0
        )
        by_link = {link: self._of(link) for link in timetable.all_links}
        symbols = {link: _symbols(link, rows) for link, rows in by_link.items()}
        seen = {link: self._sensing(link, rows) for link, rows in by_link.items()}

        def block(
            role: str | list[str], links: list[Link], symbols: SymbolCount | None
        ) -> dict[str, Any]:
            sensing, names = Sensing.pooled([seen[link] for link in links]), timetable.first_roles
            others = {u: t for u, t in sensing.targets(list(names)).items() if u != links[0].rx}
            found = summary_block(role, sensing, symbols, duration)
            waits = latencies(symbols, [by_link[link] for link in links])
            return found | {"latency_frames": waits, "targets": others}

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
        fused_records = {
            name: (table.whole(), self.tables["fused"][name].whole())
            for name, table in self.tables["fused_set"].items()
        }
        swarm = summary_of(fused_records, list(timetable.first_roles))
        return {"terminals": terminals, "links": links, "swarm": swarm}

    def _of(self, link: Link) -> np.ndarray:
        """The rows of a link's receiver."""
        return self.tables["observer"][self.timetable.labels[link]].whole()

    def _sensing(self, link: Link, by_link: np.ndarray) -> Sensing:
        """Summarise the sensing of a link's receiver from its rows."""
        label = self.timetable.labels[link]
        frames, tracks = self.tables["observer"][label].frames(), self.tables["track"][label]
        return Sensing.of(by_link, tracks.whole(), np.searchsorted(frames, tracks.frames()))

    def _sparsity(self, link: Link) -> dict[str, int] | None:
        """Frames whose receiver judged how sparse the scene is, those found dense, and those sent
        by the conventional schedule for that reason; None where no frame was judged."""
        rows = self._of(link)
        tested = rows["sparse"][rows["sparse"] >= 0]
        if not len(tested):
            return None
        dense, fell_back = int((tested == 0).sum()), int(rows["fell_back"].sum())
        return {"tested": len(tested), "dense": dense, "fell_back": fell_back}


def _symbols(link: Link, by_link: np.ndarray) -> SymbolCount | None:
    """Summarise the symbols of a link by its receiver's rows; None for own echoes."""
    return None if link.own else SymbolCount(*by_link["symbols"].sum(axis=0).tolist())


def kept_of_paths(use: Columns) -> dict[str, Any]:
    """Return how much of a link's paths was kept and left out over a run: paths per frame, and the
    largest bounds of all frames.

    Parameters
    ----------
    use : the values of `Use`, frame by frame
    """
    counts = np.asarray(use["kept"])
    order = np.argsort((counts > 0).argmax(axis=0), kind="stable")  # of the kinds as they come up

    def mean(values: np.ndarray) -> float:
        return round(float(np.mean(values)), 2)

    return {
        "frames": len(counts),
        **{
            f"{name}_per_frame": mean(use[name])
            for name in ("found", "filtered", "weak", "plane", "straight")
        },
        "kept_per_frame": {KINDS[k]: mean(counts[:, k]) for k in order if counts[:, k].any()},
        "bounces": int(use["bounces"].max()),
        "left_out_db": decibels(float(use["left_out"].max())),
        **{
            f"{name}_rad": float(use[name].max())
            for name in ("plane_error", "straight_error", "turning_error")
        },
    }
