"""Settings of receivers and trackers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from isac_rt.registry import DETECTORS, PASSIVE_DETECTORS, SYMBOL_READERS
from isac_rt.settings import Node, Problem

COUNTS_WITH = {
    "velocity_method": ("clutter_detector", ("cfar",)),
    "update_false_alarm_rate": ("clutter_detector", ("angle_doppler",)),
}
"""Keys of `receivers` that play a part only with some values of another key."""


class Receivers(Node):
    """Detection of targets and decoding of data at the terminals."""

    REMOVED: ClassVar[dict[str, str]] = {
        "active_input": "leave it out: every receiver starts from samples",
        "cluster_cells": "leave it out: a detection is the strongest of its neighbours",
        "clutter_run_cells": "leave it out: a run counts as clutter from 15 cells on",
        "clutter_channels": "leave it out; clutter_detector: angle_doppler filters all antennas",
        "gate_false_alarm_rate": "leave it out: update_false_alarm_rate carries tracks on",
        "clutter_detector: map": "clutter_detector: angle_doppler, which uses the same mesh",
        "clutter_detector: sample_matrix": "clutter_detector: angle_doppler in a city, else cfar",
        "symbol_decision: profile": "symbol_decision: beams, which is the most sensitive",
    }
    KEEPS_NULL: ClassVar[bool] = True

    velocity_method: Literal["auto", "omp", "pursuit", "latin_union", "conventional"] = "auto"
    """Velocity estimation. `latin_union`: all groups as one uniform sampling. `conventional`: the
    DFT over each antenna's chirps. `pursuit`: path by path, off the grid. `omp`: on the grid, the
    paper's for sparse sampling. `auto`, the default: the best for the schedule."""
    refinement: Literal["grid", "local", "joint"] = "local"
    """How finely a detection is placed. `grid`: the middle of its cell, the paper's. `local`, the
    default: maximum likelihood about each peak. `joint`: all paths at once on the samples, at the
    Cramer-Rao bound, separating paths in one cell; slower."""
    symbol_decision: Annotated[str, SYMBOL_READERS] = "powers"
    """How a passive terminal reads symbols. `powers`, the default and the paper's: sum of the
    antennas' powers. `beams`: coherent sum towards the tracked paths; the most sensitive."""
    separate_reference: bool = False
    """Whether a passive terminal separates its line of sight, by direction, from a reflection in
    the same cell before it uses the range. It costs time where one wave does not fit. Off by
    default, as in the paper."""
    link_acquisition: Literal["pilots", "blind"] = "pilots"
    """Frames in which a passive terminal finds the path that carries the data. `pilots`, the
    default and the paper's: the line of sight in unmodulated frames. `blind`: any path, in data
    frames too; some frames are then read late."""
    false_alarm_rate: Annotated[float, Field(gt=0, lt=0.1)] = 1e-6
    """Probability that noise alone is taken for a detection in one cell of the range-Doppler map.
    The default gives about one false alarm in ten frames of the default size."""
    update_false_alarm_rate: Annotated[float, Field(gt=0, lt=0.1)] | None = None
    """Probability that noise alone is taken in one cell for a detection that may carry on a track,
    for `clutter_detector: angle_doppler`; those by `false_alarm_rate`, which is at most as high,
    may start one too. null, the default: the same rate."""
    guard_cells: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (3, 3)
    """Cells in range and Doppler on each side of a cell that its background excludes, so that a
    target does not raise its own threshold. The default covers the main lobe of the Hann window."""
    training_cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (8, 6)
    """Cells in range and Doppler on each side, beyond the guard cells, from which a cell's
    background is estimated. More cells estimate it better and follow its changes worse; the default
    takes over a hundred."""
    max_detections: Annotated[int, Field(ge=1, le=10_000)] = 64
    """Most detections that a terminal keeps of a frame, the strongest ones. The default is far more
    than a swarm has targets."""
    min_range_m: Annotated[float, Field(ge=0)] = 2.0
    """Least range at which a terminal searches [m]; one way at an active terminal, path length at a
    passive one. The default leaves out the transmitter's leakage."""
    excision_rate: Annotated[float, Field(gt=0, lt=0.1)] | None = None
    """Probability that a sample of noise is excised as a foreign radar's (docs/weather.md); 1e-6
    where there are some. null, the default: samples stay as they are."""
    clutter_filter: Literal["none", "zero_doppler", "runs"] = "none"
    """Clutter removal before detection. `none`, the default. `zero_doppler`: all that is static
    relative to an active terminal. `runs`, the paper's: the same in runs of 15 and more occupied
    range cells, which passive terminals leave out of the symbol decision."""
    clutter_detector: Annotated[str, DETECTORS] = "cfar"
    """Test of an active terminal's cells. `cfar`, the default: against the cells around.
    `comb_cfar`: also against all velocities of their range, which rotors fill. `angle_doppler`: all
    antennas coherently towards every direction, whitened by the predicted clutter."""
    passive_detector: Annotated[str, PASSIVE_DETECTORS] = "cfar"
    """Test of a passive terminal's cells. `cfar`, the default: against the cells around. `beams`:
    all antennas coherently towards every direction after removal of strong paths, whitened by the
    predicted clutter; with fewer groups than transmit antennas as `cfar`."""
    active_every_frames: Annotated[int, Field(ge=1)] = 1
    """An active terminal processes one frame in so many; the others only carry data. By default it
    processes all."""
    self_calibration: Literal["none", "tracks", "positions"] = "none"
    """Whether terminals estimate and remove errors of their antennas, frame by frame. `none`, the
    default. `tracks`: from tracked paths. `positions`: also from the terminals' reported positions,
    so that directions and clocks are found too."""

    def problems(self) -> Iterator[Problem]:
        if self.refinement == "grid" and self.velocity_method == "pursuit":
            yield Problem(
                (("refinement",), ("velocity_method",)),
                "has no meaning with velocity_method pursuit, which finds paths off the grid; set "
                "refinement to local or joint, or change velocity_method",
            )
        if self.false_alarm_rates[0] < self.false_alarm_rate:
            yield Problem(
                (("update_false_alarm_rate",), ("false_alarm_rate",)),
                f"is less than false_alarm_rate = {self.false_alarm_rate:g}, by which detections "
                "start tracks; leave it out, or raise it",
            )
        for key, (needed, values) in COUNTS_WITH.items():
            value, default = getattr(self, key), type(self).model_fields[key].default
            if value != default and getattr(self, needed) not in values:
                yield Problem(
                    ((key,), (needed,)),
                    f"has no meaning with {needed} {getattr(self, needed)}, only with "
                    f"{' or '.join(values)}; leave it out, or change {needed}",
                )

    @property
    def false_alarm_rates(self) -> tuple[float, float]:
        """False alarm rates of a detection, and of one that may start a track."""
        return self.update_false_alarm_rate or self.false_alarm_rate, self.false_alarm_rate

    @property
    def needs_mesh(self) -> bool:
        """True if the detector predicts clutter from a city's mesh."""
        return self.clutter_detector == "angle_doppler"

    def looks_by_beam(self, own: bool) -> bool:
        """Return whether the antennas are added in phase at an active terminal (`own`) or at a
        passive one, so that paths far below the noise of one antenna are seen."""
        if self.refinement == "joint":
            return True
        if own:
            return self.clutter_detector == "angle_doppler"
        return "beams" in (self.symbol_decision, self.passive_detector)
