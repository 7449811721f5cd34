"""Receivers as chains of values, each built once from the settings by a table.

A new detector, estimator or symbol reader is one file and one line here.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from isac_rt.receive.clutter.angle_doppler import AngleDoppler
from isac_rt.receive.clutter.bistatic import BeamSearch
from isac_rt.receive.clutter.filter import ClutterFilter
from isac_rt.receive.estimate import Estimator
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.joint.neighbours import refine_jointly
from isac_rt.receive.maps import Conventional, LatinUnion
from isac_rt.receive.omp import Omp
from isac_rt.receive.pursuit import BySchedule, Pursuit
from isac_rt.receive.sense import Cfar, Detector
from isac_rt.receive.settings import Receivers
from isac_rt.receive.symbols.beams import ByBeams
from isac_rt.receive.symbols.powers import ByPowers
from isac_rt.receive.types import Detections

Refiner = Callable[[Moments, Detections], tuple[Detections, np.ndarray]]
"""From the sums of samples and near estimates to better ones and the paths' powers."""

FILTERS: dict[str, Callable[[Receivers], ClutterFilter | None]] = {
    "none": lambda settings: None,
    "zero_doppler": lambda settings: ClutterFilter(None),
    "runs": lambda settings: ClutterFilter(settings.clutter_run_cells),
}
CFARS: dict[str, Callable[[Receivers, Estimator], Cfar]] = {
    "auto": BySchedule,
    "latin_union": partial(Cfar, doppler=LatinUnion()),
    "conventional": partial(Cfar, doppler=Conventional()),
    "omp": partial(Cfar, doppler=Omp()),
    "pursuit": Pursuit,
}
ESTIMATORS = {"grid": Estimator(on_grid=True), "local": Estimator(), "joint": Estimator()}
REFINERS: dict[str, Refiner | None] = {"grid": None, "local": None, "joint": refine_jointly}
READERS = {"powers": ByPowers, "beams": ByBeams}


DETECTORS: dict[str, Callable[[Receivers, Estimator], Detector]] = {"angle_doppler": AngleDoppler}
PASSIVE_DETECTORS: dict[str, Callable[[Receivers, Estimator], Cfar]] = {"beams": BeamSearch}
"""Detectors by `clutter_detector` and by `passive_detector`, beside the CFAR."""


def filter_of(settings: Receivers) -> ClutterFilter | None:
    """The clutter filter that the settings name."""
    return FILTERS[settings.clutter_filter](settings)


def cfar_of(settings: Receivers) -> Cfar:
    """The CFAR that the settings name."""
    return CFARS[settings.velocity_method](settings, ESTIMATORS[settings.refinement])


def passive_detector_of(settings: Receivers) -> Cfar:
    """The passive terminal's detector."""
    if settings.passive_detector == "cfar":
        return cfar_of(settings)
    return PASSIVE_DETECTORS[settings.passive_detector](settings, ESTIMATORS[settings.refinement])


def detector_of(settings: Receivers) -> Detector:
    """The active terminal's detector."""
    if settings.clutter_detector == "cfar":
        return cfar_of(settings)
    return DETECTORS[settings.clutter_detector](settings, ESTIMATORS[settings.refinement])


def refiner_of(settings: Receivers) -> Refiner | None:
    """What makes the estimates better with all paths at once."""
    return REFINERS[settings.refinement]


def reader_of(settings: Receivers, dpsk_order: int) -> ByPowers:
    """The symbol reader that the settings name."""
    hidden = filter_of(settings)
    run_cells = None if hidden is None else hidden.least
    return READERS[settings.symbol_decision](dpsk_order, run_cells)
