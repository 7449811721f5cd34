"""Parameter sweeps: many scenarios from one file, in many processes, resumable."""

from __future__ import annotations

from isac_rt.sweep.definition import MAX_POINTS, Plan, Sweep, load_sweep
from isac_rt.sweep.drawn import DataPlan, load_dataset
from isac_rt.sweep.execute import PointsLeft, run_sweep
from isac_rt.sweep.make_dataset import run_dataset
from isac_rt.sweep.outcomes import Outcomes, Status, assemble, open_sweep, save_dataset, status
from isac_rt.sweep.samples import Samples, collate
from isac_rt.sweep.workers import SchedulerLost, SweepError

__all__ = [
    "MAX_POINTS",
    "DataPlan",
    "Outcomes",
    "Plan",
    "PointsLeft",
    "Samples",
    "SchedulerLost",
    "Status",
    "Sweep",
    "SweepError",
    "assemble",
    "collate",
    "load_dataset",
    "load_sweep",
    "open_sweep",
    "run_dataset",
    "run_sweep",
    "save_dataset",
    "status",
]
