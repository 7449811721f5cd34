"""Receivers as chains of values, each built once from the settings by a table.

A new detector or symbol reader is one file and one line in `isac_rt.registry`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import cast

import numpy as np

from isac_rt.frame.cube import IFCube
from isac_rt.receive.clutter_filter import RUN_CELLS, ClutterFilter
from isac_rt.receive.estimate import Estimator
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.joint.neighbours import refine_jointly
from isac_rt.receive.maps import Conventional, LatinUnion
from isac_rt.receive.omp import Omp
from isac_rt.receive.pursuit import BySchedule, Pursuit
from isac_rt.receive.sense import Cfar, Detector
from isac_rt.receive.settings import Receivers
from isac_rt.receive.symbols import ByPowers
from isac_rt.receive.types import Detections
from isac_rt.registry import DETECTORS, PASSIVE_DETECTORS, SYMBOL_READERS, extension

Refiner = Callable[[Moments, Detections], tuple[Detections, np.ndarray]]
"""From the sums of samples and near estimates to better ones and the paths' powers."""

FILTERS: dict[str, Callable[[Receivers], ClutterFilter | None]] = {
    "none": lambda settings: None,
    "zero_doppler": lambda settings: ClutterFilter(None),
    "runs": lambda settings: ClutterFilter(RUN_CELLS),
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


def excised(cube: IFCube, settings: Receivers) -> IFCube:
    """Return samples without foreign chirps, where the settings ask for that."""
    rate = settings.excision_rate
    return cube if rate is None else cast(IFCube, extension("excised")(cube, rate))


def filter_of(settings: Receivers) -> ClutterFilter | None:
    """The clutter filter that the settings name."""
    return FILTERS[settings.clutter_filter](settings)


def cfar_with(settings: Receivers, estimator: Estimator) -> Cfar:
    """The CFAR that the settings name, with an estimator of its peaks."""
    return CFARS[settings.velocity_method](settings, estimator)


def passive_detector_of(settings: Receivers) -> Cfar:
    """The passive terminal's detector."""
    make = PASSIVE_DETECTORS.load(settings.passive_detector)
    detector: Cfar = make(settings, ESTIMATORS[settings.refinement])
    return detector


def detector_of(settings: Receivers) -> Detector:
    """The active terminal's detector."""
    make = DETECTORS.load(settings.clutter_detector)
    detector: Detector = make(settings, ESTIMATORS[settings.refinement])
    return detector


def refiner_of(settings: Receivers) -> Refiner | None:
    """Return the function that refines the estimates with all paths at once."""
    return REFINERS[settings.refinement]


def reader_of(settings: Receivers, dpsk_order: int) -> ByPowers:
    """The symbol reader that the settings name."""
    clutter_filter = filter_of(settings)
    run_cells = None if clutter_filter is None else clutter_filter.least
    reader: ByPowers = SYMBOL_READERS.load(settings.symbol_decision)(dpsk_order, run_cells)
    return reader
