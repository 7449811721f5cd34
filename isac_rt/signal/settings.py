"""Settings of how near to the full model a run has to come."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from isac_rt.settings import Node, Positive


class Accuracy(Node):
    """Required accuracy of a run against the full model. What the scene then needs is decided link
    by link and frame by frame; `isac-rt plan` shows it."""

    REMOVED: ClassVar[dict[str, str]] = {
        "preset: fastest": "budget; with propagation.weakest_path_db: 0 it leaves out most",
        "covered_error_db": "leave it out: it is 20; preset: everything covers none",
        "synthesis_error": "leave it out: samples are within 1e-4; preset: everything is exact",
        "cost_model": "leave it out: the number of paths decides how samples are made",
    }

    preset: Literal["budget", "everything"] = "budget"
    """What may be left out. `budget`, the default: what the keys below and
    `propagation.weakest_path_db` allow. `everything`: nothing is left out, rays search for walls in
    every frame."""
    max_phase_error_rad: Positive = 0.05
    """Most by which plane wavefronts and straight flight together may turn the phase of a path at
    any element and chirp [rad], for `budget`. Directions that turn within a frame are modelled in
    no run and come on top (1.2 rad for an echo at 3.5 m and 28 m/s across); `isac-rt plan` and the
    summary state them. The default costs at most 0.01 dB of the path's power."""
    max_untraced_m: Annotated[float, Field(ge=0)] = 2.0
    """Farthest that a terminal flies between two time samples, places from which rays search for
    chains of walls [m], for `budget`; 0: they search from where it is in each frame. A longer way
    is faster and may miss paths over walls that are seen for a shorter way only. Where the chains
    run, and which of them are free, is found out in every frame. The default is shorter than walls
    are wide."""

    def applies(self, name: str) -> bool:
        return name == "preset" or self.preset == "budget"
