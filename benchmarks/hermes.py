"""Against HermesPy on its own job: K static paths of a frame of 120 x 1024 samples at 15 receive
antennas.

HermesPy needs its own interpreter (its dependencies are not isac_rt's) and is run in a process of
its own: the one that the variable `INTERPRETER` of the environment names, or this one where
HermesPy is installed beside isac_rt. Its radar channel works on samples at the sampling rate that
equals the bandwidth and delays by whole samples; ours makes IF samples, with data on. Costs compare
as CPU time per path and sample of a receive antenna. Either error is that of the samples of 40 such
paths in three chirps: HermesPy's against chirps delayed in continuous time at the same elements'
phases (`benchmarks.hermespy_job`), ours against the exact model.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.measure import cpu_seconds, floor_seconds
from benchmarks.synthesis import GRIDS, Job, relative
from isac_rt.signal.methods import Exact

INTERPRETER = "ISAC_RT_HERMESPY"
"""Variable of the environment: a Python with HermesPy."""
SIZES = (100, 1000)
QUICK_SIZES = (20, 60)
OURS = ("gridded",)
_LONGEST_S = 900
_SCRIPT = Path(__file__).with_name("hermespy_job.py")


def interpreter() -> str | None:
    """The Python to run HermesPy with; None where there is none."""
    named = os.environ.get(INTERPRETER)
    if named:
        return shutil.which(named)
    return sys.executable if importlib.util.find_spec("hermespy") is not None else None


def missing() -> str | None:
    """Why the stage is left out, in words; None where it can be measured."""
    named = os.environ.get(INTERPRETER)
    if interpreter() is not None:
        return None
    found = f"{INTERPRETER}={named} is no program" if named else "HermesPy is not installed"
    return (
        f"{found}; set {INTERPRETER} to a Python 3.11 or later that has it (uv pip install "
        "hermespy==1.6.0)"
    )


def job_of(num_chirps: int) -> Job:
    """Our side of the job: one group, nothing moves."""
    return Job(num_chirps, num_groups=1, speed=0.0)


def measured(job: dict[str, Any]) -> dict[str, Any]:
    """HermesPy's answer (see `hermespy_job`).

    Raises
    ------
    RuntimeError  If it ends with an error: the last line of what it said.
    """
    command = [interpreter() or "", "-P", str(_SCRIPT), json.dumps(job)]
    one = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_S, env=one)
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["nothing"]
        raise RuntimeError(
            f"HermesPy's job with {command[0]} ended with {done.returncode} and said: {said[-1]}"
        )
    answer: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return answer


def errors() -> dict[str, float]:
    """Relative RMS error of our settings on 40 static paths."""
    job = job_of(3)
    links = job.paths(40)
    truth = job.samples(links, Exact())
    return {
        name: relative(job.samples(links, method), truth) for name, method in GRIDS if name in OURS
    }


def rows(quick: bool) -> list[dict[str, object]]:
    """Rows of HermesPy and of ours, by the number of paths; the floor is that of one cube of the
    job."""
    ours, sizes = job_of(120), QUICK_SIZES if quick else SIZES
    w = ours.waveform
    shape = (1, ours.antennas.num_rx, w.num_chirps, w.num_samples)
    count = shape[1] * shape[2] * shape[3]
    theirs = measured(
        {
            "bandwidth_hz": w.bandwidth,
            "carrier_hz": w.carrier_frequency,
            "num_samples": w.num_samples,
            "seed": 1,
            "num_chirps": w.num_chirps,
            "num_rx": shape[1],
            "sizes": list(sizes),
            "error_paths": 40,
        }
    )
    floor, error = floor_seconds(shape), errors()
    out: list[dict[str, object]] = []

    def add(method: str, size: int, seconds: float, deviation: float, also: str = "") -> None:
        out.append(
            {
                "kind": "hermes",
                "method": method,
                "size": size,
                "unit": "paths",
                "error": deviation,
                "seconds": seconds,
                "cost": seconds / floor,
                "floor_s": floor,
                "error_of": "relative RMS against the exact model",
                "per_path_and_sample_s": seconds / (size * count),
                "job": "120 x 1024 x 15, static paths",
                "also": f"{seconds / (size * count):.2g} CPU s per path and sample{also}",
            }
        )

    said = theirs["versions"]
    name = (
        f"HermesPy {said['hermespy']} radar channel (Python {said['python']}, numpy "
        f"{said['numpy']})"
    )
    for size in sizes:
        slow = theirs["seconds"][str(size)]
        add(name, size, slow, theirs["error"])
        links = ours.paths(size)
        for own, method in GRIDS:
            if own in OURS:
                fast = cpu_seconds(partial(ours.samples, links, method))
                add(
                    own,
                    size,
                    fast,
                    error[own],
                    f"; {slow / fast:.0f} times less than HermesPy",
                )
    return out
