"""The cost model of `auto`, fitted on this machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np

from isac_rt.signal.choice import CANDIDATES, DIRECT, FAINT, FORMAT, NAMES
from isac_rt.signal.methods import Direct, Gridded
from isac_rt.studies.bench.measure import cpu_seconds
from isac_rt.studies.bench.synthesis import Job

SIZES = (10, 300, 3000)
"""Paths of the gridded method: its transforms alone, about as much again, and mostly paths."""
DIRECT_SIZES = (1, 4, 12)


def fit(
    num_chirps: int = 60, repeats: int = 5, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Measure each method at three sizes and fit its two coefficients by least squares of relative
    deviations.

    The jobs are those of the bench with fewer chirps. Methods are measured in turn, so that what
    else the machine does weighs on all alike.

    Returns
    -------
    model : what `isac_rt.signal.choice.read` reads, with the machine, the day, and the largest
        deviation of each fit
    """
    from isac_rt.studies.bench.report import machine

    job = Job(num_chirps)
    w = job.waveform
    chirps, elements = w.num_groups * w.num_chirps, job.antennas.num_rx
    jobs: dict[tuple[str, int], Callable[[], object]] = {}
    for size in SIZES:
        links = job.paths(size)
        for c in CANDIDATES:
            jobs[c.name, size] = partial(job.samples, links, Gridded(c.setting))
            if c.setting.faint:
                covered = Gridded(c.setting, faint=True)
                jobs[c.name + FAINT, size] = partial(job.samples, links, covered)
    jobs |= {
        (DIRECT, size): partial(job.samples, job.paths(size), Direct()) for size in DIRECT_SIZES
    }
    found: dict[tuple[str, int], list[float]] = {key: [] for key in jobs}
    for turn in range(repeats):
        for key, work in jobs.items():
            found[key].append(cpu_seconds(work, 1, 1 if turn == 0 else 0))
        if progress:
            progress(turn + 1, repeats)
    methods = {}
    for name in NAMES:
        sizes = np.array([size for of, size in found if of == name], float)
        seconds = np.array([np.median(times) for (of, _), times in found.items() if of == name])
        methods[name] = _line(sizes, seconds / (chirps * (elements if name == DIRECT else 1)) * 1e9)
    day = datetime.fromtimestamp(time.time(), UTC).date().isoformat()
    return {"format": FORMAT, "measured": day, "machine": machine(), "methods": methods}


def _line(sizes: np.ndarray, nanoseconds: np.ndarray) -> dict[str, float]:
    """Both coefficients, above 0, and the largest relative deviation."""
    from scipy.optimize import nnls

    matrix = np.stack([np.ones_like(sizes), sizes], axis=1) / nanoseconds[:, None]
    (fixed, each), _ = nnls(matrix, np.ones_like(sizes))
    fixed, each = max(fixed, 1e-3), max(each, 1e-3)
    worst = float(np.abs((fixed + each * sizes) / nanoseconds - 1).max())
    return {
        "chirp_ns": round(float(fixed), 3),
        "path_ns": round(float(each), 3),
        "deviation": round(worst, 3),
    }
