"""Clocks of the benchmarks: medians of CPU seconds, and the floor that they are counted in."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import numpy as np
import scipy.fft


def cpu_seconds(work: Callable[[], object], repeats: int = 5, warm_up: int = 1) -> float:
    """Median CPU time of all threads of this process [s] over `repeats` calls, after `warm_up`
    calls that compile."""
    for _ in range(warm_up):
        work()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return median(times)


def floor_seconds(shape: tuple[int, ...], repeats: int = 5) -> float:
    """The floor of a job on cubes of this shape [CPU s]: fill one with complex64 once, and
    transform it once along its last axis."""
    cube = np.empty(shape, np.complex64)

    def work() -> None:
        cube.fill(1.0 + 0.5j)
        scipy.fft.fft(cube, axis=-1)

    return cpu_seconds(work, repeats)
