"""Paths of a frame: by Sionna's own solver, and by images over the chains that rays found.

Error: ||g - g_full|| / ||g_full|| over the complex gains of all paths, those that only one of the
two found included, the largest of the frames. The search itself is once a time sample and not in
the time."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.measure import cpu_seconds, floor_seconds
from benchmarks.scenes import town
from isac_rt.propagation.pathset import PathSet
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.audit import present, tracer_of
from isac_rt.simulation.setup import Setup, prepare

UAVS = (3, 6, 12, 24)
BLOCKS = (2, 6, 18, 54)


def rows(quick: bool) -> list[dict[str, object]]:
    """Cost against the number of UAVs and of triangles."""
    out: list[dict[str, object]] = []
    floor = floor_seconds((3, 15, 120, 1024))
    for uavs in UAVS[:2] if quick else UAVS:
        out += _of(town(uavs), uavs, "UAVs", floor, quick)
    for blocks in BLOCKS[:2] if quick else BLOCKS:
        out += _of(town(3, blocks), None, "triangles", floor, quick)
    return out


def gain_error(found: PathSet, full: PathSet) -> float:
    """||g - g_full||/||g_full|| with the paths matched by kind, UAV and delay."""
    lost, extra = full.select(~present(full, found)), found.select(~present(found, full))
    a, b = full.select(present(full, found)), found.select(present(found, full))
    wrong = lost.power.sum() + extra.power.sum()
    if len(a) == len(b):
        order = [np.lexsort([p.delay, p.target, p.kind]) for p in (a, b)]
        wrong += (np.abs(a.gain[order[0]] - b.gain[order[1]]) ** 2).sum()
    return float(np.sqrt(wrong / full.power.sum()))


def _of(
    scenario: Scenario, size: int | None, unit: str, floor: float, quick: bool
) -> list[dict[str, object]]:
    setup = prepare(scenario)
    size = setup.city.num_faces if size is None else size
    images = tracer_of(setup)
    assert images is not None
    full = images.by_sionna(scenario.propagation.rays)
    errors = []
    for frame in range(1, scenario.frames - 1, 3):
        poses, found = setup.find(frame)
        when = setup.timetable.epoch(frame)
        truth = full.trace(poses, when, list(found)).paths
        errors += [
            gain_error(found[link], truth[link]) for link in found if truth[link].power.any()
        ]
    repeats = 3 if quick else 7
    row: dict[str, Any] = {
        "kind": "tracing",
        "size": size,
        "unit": unit,
        "floor_s": floor,
        "error_of": "gains of all paths",
    }
    out = []
    for method, tracer, error in (
        ("Sionna's solver", full, 0.0),
        ("images", images, max(errors)),
    ):
        seconds = _seconds(setup, tracer, repeats)
        out.append(
            {
                **row,
                "method": method,
                "error": error,
                "cost": seconds / floor,
                "seconds": seconds,
                "oracle": tracer is full,
            }
        )
    return out


def _seconds(setup: Setup, tracer: Any, repeats: int) -> float:
    poses, found = setup.find(1)
    when = setup.timetable.epoch(1)
    return cpu_seconds(lambda: tracer.trace(poses, when, list(found)).paths, repeats)
