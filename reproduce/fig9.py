"""Fig. 9: the active terminal estimates and tracks PT1 and PT2, every 20th of 500 frames at 10
dB."""

from __future__ import annotations

from functools import partial

import numpy as np
import xarray as xr

from reproduce import tracks
from reproduce.flight import fly
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, proportion

FRAMES, EVERY = 25, 20
"""The paper's interval of the AT: frames 0, 20, ... 480."""
RUNS, QUICK_RUNS = 12, 2
PRINTED_FRAMES, PRINTED_EVERY = 5, 100
"""The run as printed: PT2 is never in view."""
WARM_UP = 3
"""Processed frames until a new track must be confirmed."""


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Runs of the consistent variant that differ in noise and data, and one as printed."""
    count = QUICK_RUNS if quick else RUNS
    total = count * FRAMES + PRINTED_FRAMES

    def flown(before: int, variant: str, frames: int, every: int, seed: int) -> xr.Dataset:
        report = partial(_report, progress, before, total)
        return fly(variant, "AT", frames, every, seed, report)

    runs = [flown(i * FRAMES, "consistent", FRAMES, EVERY, seed + i) for i in range(count)]
    printed = flown(count * FRAMES, "printed", PRINTED_FRAMES, PRINTED_EVERY, seed)
    grid = tracks.on_grid(runs, ("PT1", "PT2"), EVERY, "AT")
    settings = {
        "quick": quick,
        "seed": seed,
        "runs": count,
        "frames_per_run": FRAMES,
        "every_frames": EVERY,
        "snr_db": 10,
        "printed_frames": PRINTED_FRAMES,
        "scene": "paper_swarm_consistent.yaml; as printed: paper_swarm.yaml",
    }
    tables = {
        "consistent": tracks.table(runs, EVERY, ("PT1", "PT2")),
        "printed": tracks.table([printed], PRINTED_EVERY, ("PT1", "PT2")),
    }
    figure = tracks.figure(runs, EVERY, ("PT1", "PT2"), ("PT1", "PT2"), (160,), grid)
    verdicts = _verdicts(runs, printed, grid)
    return Outcome("fig9", "Tracking at the AT", tables, figure, verdicts, settings)


def _report(progress: Progress, before: int, total: int, done: int, _: int) -> None:
    progress(before + done, total)


def _range(values: list[int]) -> str:
    return str(values[0]) if min(values) == max(values) else f"{min(values)} to {max(values)}"


say = Sentences("""
tracks: The AT tracks PT1 and PT2 at once
  consistent variant: PT1 in {one}, PT2 in {two} of its processed frames in view, after {warm_up} to
  confirm a track; as printed PT2 is detected in {there} of {printed}

enters: PT2 enters the AT's field of view at about frame 160
  consistent variant: in view from 132, first processed and detected in frame {first}, with a
  confirmed track from {confirmed} ({runs} runs); as printed never
""")


def _verdicts(runs, printed, grid) -> tuple[Verdict, ...]:
    one, two = (tracks.followed(runs, uav, WARM_UP) for uav in ("PT1", "PT2"))

    def first(values: str) -> str:
        seen = [np.isfinite(r.sel(uav="PT2")[values].values) for r in runs]
        return _range([int(np.flatnonzero(s)[0]) * EVERY for s in seen])

    there = int(np.isfinite(printed.sel(uav="PT2").detected_range.values).sum())
    shares = {"one": proportion(*one), "two": proportion(*two), "warm_up": WARM_UP}
    both = one[0] == one[1] and two[0] == two[1]
    begin = {"first": first("detected_range"), "confirmed": first("tracked_range")}
    return (
        say("tracks", False, both, **shares, there=there, printed=PRINTED_FRAMES),
        say("enters", False, **begin, runs=len(runs)),
        tracks.filter_verdict(runs, ("PT1", "PT2"), "AT", grid),
    )
