"""What a scenario says about accuracy: how near to the full model a run has to come."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from isac_rt.scenario_base import Node, Positive


class Accuracy(Node):
    """How near to the full model a run has to come; what the scene then needs is decided link by link and frame by frame
    (`isac_rt.fidelity`, `isac-rt plan`).

    budget: what the keys below and propagation.weakest_path_db allow is left out. everything: nothing is left out, every frame is
    traced. fastest: plane wavefronts, straight flight within a frame, weak paths up to the noise of a cell left out, few traces.
    """

    preset: Literal["budget", "everything", "fastest"] = "budget"
    max_phase_error_rad: Positive = 0.05
    """budget: most by which approximations together may turn the phase of a path, at any element and chirp."""
    max_untraced_m: Annotated[float, Field(ge=0)] = 1.0
    """budget: farthest that a UAV flies between two traced instants; 0: every frame is traced."""
    synthesis_error: Annotated[float, Field(ge=1e-6, le=0.1)] = 1e-4
    """budget, everything: relative RMS error that fast synthesis of IF samples may have; the cheapest method that keeps it is taken."""
    cost_model: str | None = None
    """budget, everything: what the methods cost, a file of `isac-rt bench --fit`, relative to the scenario's folder; without one,
    the costs that ship with the program. It decides between methods that all keep synthesis_error."""

    def applies(self, name: str) -> bool:
        if name in ("synthesis_error", "cost_model"):
            return self.preset != "fastest"
        return name == "preset" or self.preset == "budget"
