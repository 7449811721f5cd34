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
    "gate_false_alarm_rate": ("clutter_detector", ("angle_doppler",)),
}
"""Keys of `receivers` that play a part only with some values of another key."""


class Receivers(Node):
    """Detection of targets and decoding of data at the terminals."""

    REMOVED: ClassVar[dict[str, str]] = {
        "active_input": "leave it out: every receiver starts from samples",
        "cluster_cells": "leave it out: a detection is the strongest of its neighbours",
        "clutter_run_cells": "leave it out: a run counts as clutter from 15 cells on",
        "clutter_channels": "leave it out; clutter_detector: angle_doppler filters all antennas",
        "clutter_detector: map": "clutter_detector: angle_doppler, which uses the same mesh",
        "clutter_detector: sample_matrix": "clutter_detector: angle_doppler in a city, else cfar",
        "symbol_decision: profile": "symbol_decision: beams, which is the most sensitive",
    }
    KEEPS_NULL: ClassVar[bool] = True

    velocity_method: Literal["auto", "omp", "pursuit", "latin_union", "conventional"] = "auto"
    """How velocities are found. `latin_union`: all groups as one uniform sampling, where there are
    as many as transmit antennas. `conventional`: the DFT over each antenna's equally spaced chirps,
    which divides the unambiguous velocity by their number. `pursuit`: path by path, each taken out
    whole off the grid, so that its sidelobes hide no weaker ones. `omp`: orthogonal matching
    pursuit on the grid, the paper's for sparse sampling. `auto`, the default: `latin_union` where
    all groups are received, `conventional` where the schedule is, else `pursuit`, or with
    `refinement: grid` `omp`."""
    refinement: Literal["grid", "local", "joint"] = "local"
    """How finely a detection is placed. `grid`: the middle of its range and Doppler cell, the
    paper's. `local`, the default: maximum likelihood about each peak, at little cost. `joint`: all
    paths at once on the samples, which reaches the Cramer-Rao bound and separates paths in one cell
    by direction, but is slower."""
    symbol_decision: Annotated[str, SYMBOL_READERS] = "powers"
    """How a passive terminal reads symbols. `powers`, the default and the paper's: the powers of
    the receive antennas are added. `beams`: the antennas are added in phase towards the tracked
    paths, with a log-likelihood ratio for every bit; the most sensitive."""
    separate_reference: bool = False
    """Whether a passive terminal tells its line of sight apart from a wall's or the ground's
    reflection in the same cell, by direction, before it believes its range. Costs time only in
    frames where one wave does not explain the cell. Off by default, as in the paper."""
    link_acquisition: Literal["pilots", "blind"] = "pilots"
    """From which frames a passive terminal learns over which path it reads data. `pilots`, the
    default and the paper's: its line of sight in frames without data. `blind`: any path, from data
    frames too; those that wait for it are read some frames late. The terminal senses with its
    line of sight, or over walls that the mesh explains where the transmitter says where it is
    (`cooperation`)."""
    false_alarm_rate: Annotated[float, Field(gt=0, lt=0.1)] = 1e-6
    """Probability that noise alone is taken for a detection in one cell of the range-Doppler map.
    The default gives about one false alarm in ten frames of the default size."""
    update_false_alarm_rate: Annotated[float, Field(gt=0, lt=0.1)] | None = None
    """Probability that noise alone is taken in one cell for a detection that may carry on a track,
    for `clutter_detector: angle_doppler`; those by `false_alarm_rate`, which is at most as high,
    may start one too. null, the default: the same rate."""
    gate_false_alarm_rate: Annotated[float, Field(gt=0, lt=0.1)] | None = None
    """Probability that noise alone is taken for a UAV where one is expected, by its track or, with
    `cooperation`, by what a terminal says of its place: in all cells and directions of its gate
    together, for `clutter_detector: angle_doppler`. Such detections carry tracks on and start none.
    null, the default: no cell has a threshold of its own."""
    guard_cells: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (3, 3)
    """Cells in range and in Doppler on each side of a cell that are left out when its background is
    measured, so that a target does not raise its own threshold. The default covers the main lobe of
    the Hann window."""
    training_cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (8, 6)
    """Cells in range and in Doppler on each side, beyond the guard cells, from which the background
    of a cell is measured. More cells measure it better and follow its changes worse; the default
    takes over a hundred before and behind."""
    max_detections: Annotated[int, Field(ge=1, le=10_000)] = 64
    """Most detections that a terminal keeps of a frame, the strongest ones. The default is far more
    than a swarm has targets."""
    min_range_m: Annotated[float, Field(ge=0)] = 2.0
    """Least range at which a terminal searches [m]; one way at an active terminal, path length at a
    passive one. The default leaves out the transmitter's leakage."""
    clutter_filter: Literal["none", "zero_doppler", "runs"] = "none"
    """What is taken out before detection. `none`: nothing, the default. `zero_doppler`: what stands
    still relative to an active terminal, in all range cells. `runs`, the paper's: the same in
    runs of 15 occupied range cells and more only, which a passive terminal leaves out of its symbol
    decision."""
    clutter_detector: Annotated[str, DETECTORS] = "cfar"
    """What an active terminal compares a cell with. `cfar`, the default: the cells around it.
    `angle_doppler`: all antennas are added in phase towards every direction, and filtered with the
    clutter's covariance where mesh and own velocity predict clutter; own velocity and clutter level
    are corrected by the frame first."""
    passive_detector: Annotated[str, PASSIVE_DETECTORS] = "cfar"
    """How a passive terminal finds what reflects to it. `cfar`, the default: cells that stand out
    of those around. `beams`: strong paths are taken out, then the antennas are added in phase
    towards every direction, and filtered with the clutter's covariance where the city's mesh and
    the transmitter as it is tracked predict clutter. With fewer groups than transmit antennas it
    is as `cfar`."""
    active_every_frames: Annotated[int, Field(ge=1)] = 1
    """An active terminal processes one frame in so many; the others only carry data. By default it
    processes all."""
    self_calibration: Literal["none", "tracks", "positions"] = "none"
    """Whether terminals find gains, phases and delays of their antennas and the response over the
    chirp from strong paths, frame by frame, and take them out of their samples. `none`, the
    default. `tracks`: from tracked paths, whose directions are as they were measured: what turns
    all directions alike stays. `positions`: also from the terminals' positions, which they send
    each other, and, where the active terminal's detector knows the city's mesh, from clutter, so
    that directions and clocks are found too."""

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
        for key, (other, values) in COUNTS_WITH.items():
            value, default = getattr(self, key), type(self).model_fields[key].default
            if value != default and getattr(self, other) not in values:
                yield Problem(
                    ((key,), (other,)),
                    f"has no meaning with {other} {getattr(self, other)}, only with "
                    f"{' or '.join(values)}; leave it out, or change {other}",
                )

    @property
    def false_alarm_rates(self) -> tuple[float, float]:
        """False alarm rates of a detection, and of one that may start a track."""
        return self.update_false_alarm_rate or self.false_alarm_rate, self.false_alarm_rate

    @property
    def gate_rate(self) -> float:
        """False alarm rate of a detection in the gate of an expected UAV; that of any other cell
        where the gate has none of its own."""
        return self.gate_false_alarm_rate or self.false_alarm_rates[0]

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
