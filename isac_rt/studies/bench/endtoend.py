"""Whole runs of `scenes/street_canyon.yaml` under the three presets of the budget, with 300 rays of
clutter: 100 scatterers a link.

Error: of the noise-free samples of the frame in the middle against those under the preset
everything, ||Y - Y_full||/||Y_full||, the largest of the links. Cost: CPU time of a run per frame,
receivers and trackers included, set-up left out. In a short run more of the frames are traced than
in a long one.
"""

from __future__ import annotations

import time
from statistics import median
from typing import Any

import numpy as np

from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.link import Link
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.if_signal import if_signal
from isac_rt.simulation.setup import Setup, prepare
from isac_rt.simulation.simulate import summarise
from isac_rt.studies import scene_file
from isac_rt.studies.bench import command
from isac_rt.studies.bench.measure import floor_seconds

PRESETS = ("fastest", "budget", "everything")
FRAMES = (4, 8, 16)
JOB = "street_canyon.yaml, clutter.rays 300, run without set-up"


def rows(quick: bool) -> list[dict[str, object]]:
    """Cost of runs against their number of frames, and their error."""
    floor, out = floor_seconds((3, 15, 120, 1024)), []
    for frames in FRAMES[:1] if quick else FRAMES:
        scenarios = {preset: scenario(preset, frames) for preset in PRESETS}
        cubes = {preset: samples(prepare(s)) for preset, s in scenarios.items()}
        full = cubes["everything"]
        seconds_per_frame(scenario("fastest", FRAMES[0]), 1)  # compiles what the runs share
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
    return out


def commands(quick: bool) -> list[dict[str, Any]]:
    """Whole commands, part by part."""
    return command.tables(quick)


def scenario(preset: str, frames: int) -> Scenario:
    """The scene under a preset."""
    return load(
        scene_file("street_canyon.yaml"),
        [f"accuracy.preset={preset}", f"frames={frames}", "clutter.rays=300"],
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
