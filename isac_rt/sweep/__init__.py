"""Parameter sweeps: many scenarios from one file, on Dask, resumable."""

from __future__ import annotations

from isac_rt.sweep.definition import MAX_POINTS, Plan, Sweep, load_sweep
from isac_rt.sweep.execute import PointsLeft, SchedulerLost, SweepError, run_sweep
from isac_rt.sweep.outcomes import Outcomes, Status, assemble, open_sweep, save_dataset, status

__all__ = [
    "MAX_POINTS",
    "Outcomes",
    "Plan",
    "PointsLeft",
    "SchedulerLost",
    "Status",
    "Sweep",
    "SweepError",
    "assemble",
    "load_sweep",
    "open_sweep",
    "run_sweep",
    "save_dataset",
    "status",
]
