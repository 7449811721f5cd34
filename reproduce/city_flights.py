"""Whole flights over several cities, each with several seeds, by three sets of receivers on the
same samples: the points of a sweep, so that a stopped evaluation goes on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from isac_rt.randomness import seed_sequence
from isac_rt.results.recorder import Results
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import OWN, Scenario
from isac_rt.settings import plain_tree
from isac_rt.sweep.definition import Point, files_under, ground_by, paths_key, point_key
from isac_rt.sweep.execute import Job, connected, run_points
from isac_rt.sweep.outcomes import Outcomes, pending
from isac_rt.sweep.workers import SweepError
from reproduce import SCENES
from reproduce.outcome import Progress

SETS = ("city", "plain", "paper")
"""The scenario's own receivers first."""
SEEDS = 10
"""Of a full evaluation, unless told otherwise (`repeated`)."""
_asked: ContextVar[tuple[int | None, Path | None]] = ContextVar("asked", default=(None, None))


@contextmanager
def repeated(seeds: int | None, scenes: Path | None = None) -> Iterator[None]:
    """Set, inside, the seeds of full evaluations and the scenes of `reproduce.flights`; None: its
    own."""
    token = _asked.set((seeds, scenes))
    try:
        yield
    finally:
        _asked.reset(token)


def seeds_wanted(quick: bool) -> int:
    """Seeds of an evaluation."""
    return _asked.get()[0] or (1 if quick else SEEDS)


def scenes_wanted() -> Path | None:
    """Folder or pattern of the scenes to fly."""
    return _asked.get()[1]


@dataclass(frozen=True)
class Place:
    """One scene of the evaluation.

    Attributes
    ----------
    file : of the scene
    frames : of a flight
    few : frames of a quick evaluation, 0: it is left out there
    changes : of the scene
    compared : other sets that receive it too, of `SETS`
    unseen : not used while receivers were built
    """

    file: str
    frames: int
    few: int = 0
    changes: tuple[str, ...] = ()
    compared: tuple[str, ...] = ("plain",)
    unseen: bool = False

    def scenario(self, quick: bool) -> Scenario:
        """With all sets of receivers."""
        frames = self.few if quick else self.frames
        sets = [f"compare.{name}.preset={name}" for name in self.compared]
        changes = ["receiver_preset=city", "cooperation=tracks", *self.changes, *sets]
        return load(SCENES / self.file, changes, frames)


_IN_THE_MESH = ("clutter={model: field}",)
_NO_CITY = (
    "receivers.clutter_detector=cfar",
    "receivers.update_false_alarm_rate=null",
    "tracking.initiation=all",
)
_WIDE = (
    "city.street_width_m=34",
    "city.block_size_m=38",
    "city.building_height_m=14",
    "city.height_spread_m=5",
)
"""Lower houses and wider streets: the swarm flies across where two of them meet."""
MUNICH, PAPER = "Munich", "the paper's swarm"
WRONG, MISSING = "Munich, wrong beliefs", "Munich, a block missing"
PLACES = {
    MUNICH: Place("munich_swarm.yaml", 78, 8, compared=SETS[1:]),
    "canyon": Place("street_canyon.yaml", 24, changes=_IN_THE_MESH),
    "Florence": Place("florence_square.yaml", 24, changes=_IN_THE_MESH),
    "San Francisco": Place("san_francisco_swarm.yaml", 30),
    "Etoile": Place("etoile_swarm.yaml", 30, unseen=True),
    "blocks": Place("blocks_swarm.yaml", 30, unseen=True),
    "crossing": Place("blocks_swarm.yaml", 30, changes=_WIDE, unseen=True),
    PAPER: Place("paper_swarm_consistent.yaml", 180, changes=_NO_CITY, compared=SETS[1:]),
    WRONG: Place(
        "munich_swarm.yaml",
        78,
        changes=(
            "belief={velocity_std_mps: 0.06, level_db: 3, mesh_m: 0.2, position_std_m: 0.06, "
            "attitude_std_deg: 0.3, materials: {marble: {scattering_coefficient: 0.4}, "
            "concrete: {scattering_coefficient: 0.15}}}",
        ),
        compared=(),
    ),
    MISSING: Place(
        "munich_swarm.yaml",
        78,
        changes=("belief={missing_m: [[71, -156, 298, 135]]}",),
        compared=(),
    ),
}
"""By name. Wrong beliefs: 0.1 m/s, 3 dB, 0.1 m of place, 0.2 m of each plane, 0.5 degrees (rms),
and walls of twice and of half the amplitude that they scatter."""


@dataclass(frozen=True)
class Flights:
    """The points of an evaluation: places within seeds, so that a stopped one has whole seeds."""

    places: Mapping[str, Place]
    seeds: int
    seed: int
    quick: bool

    @cached_property
    def scenarios(self) -> dict[str, Scenario]:
        """By place."""
        of = {name: p for name, p in self.places.items() if p.few or not self.quick}
        return {name: place.scenario(self.quick) for name, place in of.items()}

    @property
    def base(self) -> Scenario:
        """Whose folder is that of all scenes."""
        return next(iter(self.scenarios.values()))

    @property
    def num_points(self) -> int:
        return self.seeds * len(self.scenarios)

    def points(self) -> Iterator[Point]:
        """All points with (seed, place) as their index."""
        files = files_under(self.base.folder)
        for repetition in range(self.seeds):
            words = seed_sequence(self.seed, "city", repetition).generate_state(1)
            for number, scenario in enumerate(self.scenarios.values()):
                tree = {**plain_tree(scenario), "seed": int(words[0])}
                tree.pop("name")
                ground = ground_by(tree, files)
                key, paths = point_key(tree, ground), paths_key(tree, ground)
                yield Point((repetition, number), tree, ground, key, paths)


@dataclass(frozen=True)
class FlightJob(Job):
    """A flight as a worker gets it."""

    def simulate(self) -> dict[str, Any]:
        """Run it; beside its summary what became of the data, frame by frame."""
        from isac_rt.simulation import simulate

        scenario, setup = self.prepared()
        results = simulate.run(
            scenario, progress=None, setup=setup, threads=self.threads, snapshots=0
        )
        return {**results.summary, "by_frame": by_frame(results)}


def by_frame(results: Results) -> dict[str, list[list[int]]]:
    """Of every link the frames that its receiver received: number, whether its transmitter is in
    sight of it, wrong and all delay symbols, wrong and all DPSK symbols, whether it was read."""
    d, out = results.dataset, {}
    uavs = list(d.uav.values)
    for i, (tx, rx) in enumerate(zip(d.transmitter.values, d.receiver.values, strict=True)):
        one = d.isel(observer=i)
        u = uavs.index(str(tx))
        sight = one.in_view.values[:, u] & ~one.occluded.values[:, u]
        wrong, sent = one.symbol_errors.values, one.symbol_total.values
        counts = [wrong[:, 0], sent[:, 0], wrong[:, 1], sent[:, 1]]
        table = [d.frame.values, sight, *counts, one.latency_frames.values >= 0]
        rows = zip(*(a.astype(int).tolist() for a in table), strict=True)
        heard = one.processed.values
        kept = [list(row) for row, there in zip(rows, heard, strict=True) if there]
        out[f"{tx}->{rx}"] = kept
    return out


def fly(flights: Flights, folder: Path, progress: Progress) -> None:
    """Run what is missing among the flights' outcomes in a folder.

    Raises
    ------
    SweepError  If a flight fails.
    isac_rt.sweep.PointsLeft, isac_rt.sweep.SchedulerLost  As for `isac_rt.sweep.run_sweep`.
    """
    outcomes = Outcomes(folder.resolve())
    outcomes.begin({"places": list(flights.scenarios), "seed": flights.seed})
    missing, total = [*pending(flights, outcomes, True)], flights.num_points
    done = total - len(missing)
    progress(done, total)
    if not missing:
        return

    def moved(done: int, failed: int, total: int) -> None:
        progress(done + failed, total)

    def job(point: Point, **fields: Any) -> Job:
        return FlightJob(**fields)

    with connected(None, None) as client:
        run_points(flights, outcomes, client, job, iter(missing), done, True, moved)


def outcomes_of(flights: Flights, folder: Path) -> dict[str, list[dict[str, Any]]]:
    """What became of the flights by place, one entry a seed.

    Raises
    ------
    SweepError  If a flight failed.
    """
    outcomes, names = Outcomes(folder.resolve()), list(flights.scenarios)
    out: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for point in flights.points():
        outcome = outcomes.read(point.key)
        if outcome is None:
            continue
        name = names[point.index[1]]
        if outcome["status"] == "failed":
            raise SweepError(f"the flight over {name} failed: {outcome['error']}")
        out[name].append(outcome)
    return out


def of_set(outcome: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    """`terminals`, `links` and `swarm` of a set of receivers; None where it did not listen."""
    return outcome if name == SETS[0] else outcome["compared"].get(name)


def seconds_of(outcome: Mapping[str, Any], link: str) -> float:
    """Processor seconds that the own receiver of a link took a frame that it received."""
    spent = outcome["timing_s"].get("by_set", {}).get(OWN, {}).get(link, float("nan"))
    return float(spent) / max(len(outcome["by_frame"][link]), 1)
