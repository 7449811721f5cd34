"""Settings of the accuracy of a run against the full model."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from isac_rt.settings import Node, Positive


class Accuracy(Node):
    """Required accuracy of a run against the full model. `isac-rt plan` shows the approximations
    that each link then uses."""

    REMOVED: ClassVar[dict[str, str]] = {
        "preset: fastest": "budget; with propagation.weakest_path_db: 0 it leaves out most",
        "covered_error_db": "leave it out: it is 20; preset: everything covers none",
        "synthesis_error": "leave it out: samples are within 1e-4; preset: everything is exact",
        "cost_model": "leave it out: the number of paths decides how samples are made",
    }

    preset: Literal["budget", "everything"] = "budget"
    """Approximations: `budget` (default) allows those of the keys below and of
    `propagation.weakest_path_db`; `everything` allows none and traces rays in every frame. Use
    `everything` to check a budget."""
    max_phase_error_rad: Positive = 0.05
    """Largest phase error of plane wavefronts and unaccelerated flight together, at any element and
    chirp [rad], with `budget`. The default, 0.05, costs at most 0.01 dB. Rotation within a frame is
    never modelled."""
    max_untraced_m: Annotated[float, Field(ge=0)] = 2.0
    """Longest flight between two searches for interaction sequences by rays [m], with `budget`; 0:
    a search in every frame. The default, 2, is less than the width of a wall; higher values are
    faster and may miss short-lived paths."""

    def applies(self, name: str) -> bool:
        return name == "preset" or self.preset == "budget"
