"""The paper's tables, figures and claims, each run again and judged: `isac-rt reproduce NAME`."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from pathlib import Path

from reproduce.outcome import Outcome, Progress

SCENES = Path(__file__).parents[1] / "scenes"

Experiment = Callable[[bool, int, Progress], Outcome]
"""(quick, seed, progress) -> Outcome; quick ends within 2 minutes on 2 cores."""

TITLES = {
    "table1": "Resolution and range of every parameter (Table I)",
    "table2": "Who sees whom when in the flight of Table II",
    "fig1": "The chirp with delay and phase symbols (Fig. 1)",
    "fig5": "The four antenna schedules and what each does to velocity (Fig. 5)",
    "fig8": "Velocity by OMP and by FFT against noise (Fig. 8)",
    "fig9": "Tracking at the active terminal over 500 frames (Fig. 9)",
    "fig10": "Tracking at PT1 over 500 frames (Fig. 10)",
    "fig11": "Symbol error rate of the DPSK symbols (Fig. 11)",
    "fig12": "Symbol error rate of the delay symbols (Fig. 12)",
    "fig13": "Bit rate against transmit antennas (Fig. 13)",
    "fig14": "Hit rate against the baselines (Fig. 14)",
    "clutter": "Gaussian, Rayleigh and geometric clutter side by side",
    "detectors": "Detectors in the clutter of a city's mesh",
    "ghosts": "Ghost tracks in a street and a geometric test of them",
    "city": "Receivers that know the city in several cities, with several seeds",
    "flights": "Goals of tracking over any folder of scenes (--scenes), or over drawn ones",
    "hardware": "What real front ends do to data, floors, ranges and flights",
    "self_calibration": "Errors of the elements found in flight: bounds, and a flight over Munich",
    "claims": "Claims of the text that have no figure",
}


def names() -> tuple[str, ...]:
    """The experiments there are, in the paper's order."""
    return tuple(
        name for name in TITLES if importlib.util.find_spec(f"reproduce.{name}") is not None
    )


def experiment(name: str) -> Experiment:
    """The function `run` of the module of that name, imported now.

    Raises
    ------
    KeyError  If there is no such experiment.
    """
    if name not in names():
        raise KeyError(name)
    return importlib.import_module(f"reproduce.{name}").run
