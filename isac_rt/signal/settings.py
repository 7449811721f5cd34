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
    """Bound of the phase error of plane wavefronts and straight flight together, at any element and
    chirp [rad], for `budget`. Rotation within a frame is not modelled (`isac-rt plan` states it).
    The default costs at most 0.01 dB."""
    max_untraced_m: Annotated[float, Field(ge=0)] = 2.0
    """Longest flight between two time samples, from which rays search for chains of walls [m], for
    `budget`; 0: from every frame. A higher value is faster and may miss short-lived paths. The
    default is shorter than walls are wide."""

    def applies(self, name: str) -> bool:
        return name == "preset" or self.preset == "budget"
