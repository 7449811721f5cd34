"""Whole runs of `scenes/street_canyon.yaml` under both presets of the budget, with the clutter of
`clutter.max_error_db` 5.

Error: of the noise-free samples of the frame in the middle against those under the preset
everything, ||Y - Y_full||/||Y_full||, the largest of the links. Cost: CPU time of a run per frame,
receivers and trackers included, set-up left out. In a short run more of the frames are traced than
in a long one.

And runs of the same scene with clutter of `model: field` at several `clutter.max_error_db`. Their
error is that of the mean clutter power, over the noise of a cell, which nine of ten range cells of
4 m keep to in the frame in the middle, against `TRUTH_DB`, on the link where it is largest: other
densities are other draws of the clutter, so that samples cannot be compared. Nothing is merged for
it, for merging keeps range-Doppler cells, which `run --check-budget` measures.
"""

from __future__ import annotations

import time
from statistics import median
from typing import Any

import numpy as np

from benchmarks import command
from benchmarks.measure import floor_seconds
from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.link import Link
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.if_signal import if_signal
from isac_rt.simulation.audit import cells_apart, clutter_by_cell, tracer_of
from isac_rt.simulation.setup import Setup, prepare
from isac_rt.simulation.simulate import summarise
from reproduce import SCENES

PRESETS = ("budget", "everything")
FRAMES = (4, 8, 16)
ERRORS_DB = (1.0, 0.5, 0.2, 0.1)
TRUTH_DB = 0.05
QUICK = "clutter.max_error_db=5", "receiver_preset=plain"
"""What is measured is synthesis; receivers that hold echoes against the mesh would cover it."""
ROWS = 16
"""Range rows to a cell of 4 m at the active terminal."""
JOB = "street_canyon.yaml, clutter.max_error_db 5, run without set-up"


def rows(quick: bool) -> list[dict[str, object]]:
    """Cost of runs against their number of frames, and their error."""
    floor, out = floor_seconds((3, 15, 120, 1024)), []
    for frames in FRAMES[:1] if quick else FRAMES:
        scenarios = {preset: scenario(preset, frames) for preset in PRESETS}
        cubes = {preset: samples(prepare(s)) for preset, s in scenarios.items()}
        full = cubes["everything"]
        seconds_per_frame(scenario("budget", FRAMES[0]), 1)  # compiles what the runs share
        for preset, s in scenarios.items():
            error = max(
                float(np.linalg.norm(cubes[preset][link] - full[link]) / np.linalg.norm(full[link]))
                for link in full
            )
            seconds = seconds_per_frame(s, 1 if quick else 3)
            out.append(
                {
                    "kind": "endtoend",
                    "method": preset,
                    "size": frames,
                    "unit": "frames",
                    "error": error,
                    "cost": seconds / floor,
                    "seconds": seconds,
                    "floor_s": floor,
                    "oracle": preset == "everything",
                    "job": JOB,
                    "error_of": "samples of a frame",
                }
            )
    return out + densities(quick, floor)


def densities(quick: bool, floor: float) -> list[dict[str, object]]:
    """Cost and error of runs by the density of their clutter, the truth last."""
    out: list[dict[str, object]] = []
    found = [_of_density(db, quick) for db in (*ERRORS_DB, TRUTH_DB)]
    truth = found[-1][0]
    for db, (cells, seconds, kept) in zip((*ERRORS_DB, TRUTH_DB), found, strict=True):
        error = max(cells_apart(truth[link], some) for link, some in cells.items())
        out.append(
            {
                "kind": "endtoend",
                "method": f"clutter.max_error_db {db:g}",
                "size": kept,
                "unit": "scatterers of the links",
                "error": error,
                "cost": seconds / floor,
                "seconds": seconds,
                "floor_s": floor,
                "oracle": db == TRUTH_DB,
                "job": JOB,
                "error_of": "mean clutter in nine of ten range cells [dB]",
            }
        )
    return out


def _of_density(max_error_db: float, quick: bool) -> tuple[dict[Link, Any], float, int]:
    """By link what all scatterers give in each range cell; seconds per frame of a run; the links'
    scatterers, those under noise merged."""
    changes = [
        "receiver_preset=plain",
        f"clutter.max_error_db={max_error_db:g}",
    ]
    s = load(SCENES / "street_canyon.yaml", [f"frames={FRAMES[0]}", *changes])
    setup = prepare(s)
    tracer, frame = tracer_of(setup), setup.frame(FRAMES[0] // 2)
    assert tracer is not None and tracer.field is not None
    cells = {}
    for link in setup.timetable.links(frame.number):
        number, power = clutter_by_cell(setup, frame, link, tracer.field.whole())
        cells[link] = number // (ROWS * setup.waveform.num_chirps), power
    kept = sum(len(some.cells) for some in tracer.field.merged.values())
    return cells, seconds_per_frame(s, 1 if quick else 3), kept


def commands(quick: bool) -> list[dict[str, Any]]:
    """Whole commands, part by part."""
    return command.tables(quick)


def scenario(preset: str, frames: int) -> Scenario:
    """The scene under a preset."""
    return load(
        SCENES / "street_canyon.yaml",
        [f"accuracy.preset={preset}", f"frames={frames}", *QUICK],
    )


def seconds_per_frame(of: Scenario, repeats: int) -> float:
    """Median CPU time of a run per frame; every run has a set-up of its own, since set-ups remember
    what was traced."""
    times = []
    for _ in range(repeats):
        setup = prepare(of)
        begin = time.process_time()
        summarise(of, setup=setup)
        times.append((time.process_time() - begin) / of.frames)
    return median(times)


def samples(setup: Setup) -> dict[Link, np.ndarray]:
    """Noise-free samples of the frame in the middle of a run, by link, by the method that the run
    would take."""
    number = setup.scenario.frames // 2
    frame = setup.frame(number)
    out = {}
    for link in setup.timetable.links(number):
        out[link] = if_signal(
            setup.waveform,
            [(frame.sent[link.tx], frame.paths[link])],
            ReceiveArray(frame.poses[link.rx], setup.antennas),
            Reference(setup.timetable.start_time(number, link.tx)),
            setup.plan.synthesis(len(frame.paths[link]), frame.noise_power(link)),
        ).samples
    return out
