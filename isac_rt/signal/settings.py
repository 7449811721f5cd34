"""Settings of how near to the full model a run has to come."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from isac_rt.settings import Node, Positive


class Accuracy(Node):
    """How near to the full model a run has to come. What the scene then needs is decided link by
    link and frame by frame; `isac-rt plan` shows it."""

    preset: Literal["budget", "everything", "fastest"] = "budget"
    """What may be left out. `budget`, the default: what the keys below and
    `propagation.weakest_path_db` allow. `everything`: nothing is left out, rays search for walls in
    every frame. `fastest`: plane wavefronts, straight flight within a frame, no path below the
    noise of a cell, few searches."""
    max_phase_error_rad: Positive = 0.05
    """Most by which plane wavefronts and straight flight together may turn the phase of a path at
    any element and chirp [rad], for `budget`. Directions that turn within a frame are modelled in
    no run and come on top (1.2 rad for an echo at 3.5 m and 28 m/s across); `isac-rt plan` and the
    summary state them. The default costs at most 0.01 dB of the path's power."""
    max_untraced_m: Annotated[float, Field(ge=0)] = 2.0
    """Farthest that a terminal flies between two knots, places from which rays search for chains of
    walls [m], for `budget`; 0: they search from where it is in each frame. A longer way is faster
    and may miss paths over walls that are seen for a shorter way only. Where the chains run, and
    which of them are free, is found out in every frame. The default is shorter than walls are
    wide."""
    synthesis_error: Annotated[float, Field(ge=1e-6, le=0.1)] = 1e-4
    """Relative RMS error that fast synthesis of IF samples may have, for `budget` and `everything`;
    the cheapest method that keeps it is taken. The default is 80 dB below the signal."""
    covered_error_db: Annotated[float, Field(ge=0, le=400)] | None = 20.0
    """How far under the noise of a range-Doppler cell of all channels the error stays that
    noise covers in the synthesis [dB], for `budget`: most scatterers of a `field` take half of
    the time then, at a larger error than `synthesis_error`. The default is a hundredth of the
    noise's power. null: none is covered."""
    cost_model: str | None = None
    """File of what the methods of synthesis cost on a machine, made by `isac-rt bench --fit` and
    relative to the scenario's folder, for `budget` and `everything`. It decides between methods
    that all keep `synthesis_error`. By default the costs that come with the program hold."""

    def applies(self, name: str) -> bool:
        if name in ("synthesis_error", "cost_model"):
            return self.preset != "fastest"
        return name == "preset" or self.preset == "budget"
