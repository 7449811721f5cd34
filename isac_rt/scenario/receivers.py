"""What a scenario says about receivers and trackers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from isac_rt.scenario.node import Node, Positive, Problem


class Receivers(Node):
    """How terminals detect and demodulate."""

    velocity_method: Literal["auto", "omp", "pursuit", "latin_union", "conventional"] = "auto"
    """omp: the paper's, for sparse sampling. pursuit: OMP off the grid, path by path. latin_union:
    all groups as one uniform sampling, for M = L_tx. conventional: the DFT over each antenna's
    equally spaced chirps, up to the unambiguous velocity divided by L_tx. auto: by the schedule and
    the groups received."""
    refinement: Literal["grid", "local", "joint"] = "local"
    """grid: the centres of range and Doppler cells, the paper's. local: maximum likelihood on the
    windowed spectra about each peak. joint: all paths at once on the samples, at the Cramer-Rao
    bound; paths in one cell are told apart by direction (slower)."""
    symbol_decision: Literal["powers", "profile", "beams"] = "powers"
    """How a PT reads symbols. powers: the receivers' powers added, the paper's. profile: the same,
    delay symbols by correlation with the range profile of the last unmodulated frame, in which
    clutter votes with the line of sight. beams: receivers added in phase towards the tracked paths,
    the error of the predicted velocity taken out, and a log-likelihood ratio for every bit."""
    false_alarm_rate: Annotated[float, Field(gt=0, lt=0.1)] = 1e-6
    """Of one cell of the range-Doppler map."""
    guard_cells: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (3, 3)
    training_cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (8, 6)
    """Range, Doppler; on each side."""
    cluster_cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (1, 1)
    max_detections: Annotated[int, Field(ge=1, le=10_000)] = 64
    min_range_m: Annotated[float, Field(ge=0)] = 2.0
    clutter_filter: Literal["none", "zero_doppler", "runs"] = "none"
    """runs: the paper's. Range cells that lie in a run of occupied ones are cleared of what stands
    still (AT), or left out of the symbol decision (PT). zero_doppler: all range cells are cleared
    of what stands still at the AT; a PT's line of sight may, so that it filters nothing."""
    clutter_run_cells: Annotated[int, Field(ge=2)] = 15
    """Consecutive occupied range cells from which on a run counts as clutter."""
    clutter_detector: Literal["cfar", "map", "angle_doppler", "sample_matrix"] = "cfar"
    """What the AT holds a cell against, after the filter if there is one. cfar: its surroundings.
    map: the clutter power that the city's mesh predicts. angle_doppler: filtered over the antennas
    with the covariance that the mesh and the terminal's own velocity predict. sample_matrix:
    filtered with the covariance of the cells around. map and angle_doppler first correct the own
    velocity and the clutter's level by the frame."""
    clutter_channels: Literal["arms", "joint"] = "arms"
    """angle_doppler, sample_matrix: filter each arm of the virtual L by itself, or both jointly
    (several times slower)."""
    active_every_frames: Annotated[int, Field(ge=1)] = 1
    """The AT processes one frame in so many."""
    active_input: Literal["samples", "profiles"] = "samples"
    """samples: the AT transforms IF samples. profiles: range profiles made directly
    (`isac_rt.signal.if_signal.range_profiles`), faster."""

    def problems(self) -> Iterator[Problem]:
        if self.active_input == "profiles" and self.refinement == "joint":
            yield Problem(
                (("active_input",), ("refinement",)),
                "joint refinement needs samples; set active_input: samples or another one",
            )


class Tracking(Node):
    """The Kalman filters and the life of a track."""

    acceleration_std_mps2: Positive = 1.0
    gate_probability: Annotated[float, Field(gt=0.5, lt=1)] = 0.999
    confirm_hits: Annotated[int, Field(ge=1)] = 3
    confirm_window: Annotated[int, Field(ge=1)] = 5
    drop_misses: Annotated[int, Field(ge=1)] = 8

    def problems(self) -> Iterator[Problem]:
        if self.confirm_hits > self.confirm_window:
            yield Problem(
                (("confirm_hits",), ("confirm_window",)),
                f"{self.confirm_hits} hits cannot be reached within confirm_window = "
                f"{self.confirm_window}; lower it or widen the window",
            )
