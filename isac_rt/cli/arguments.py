"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isac_rt.runtime import UserError

if TYPE_CHECKING:
    from isac_rt.scenario.tree import Scenario

ScenarioFile = Annotated[
    Path, typer.Argument(metavar="SCENARIO", help="The scenario, a YAML file.")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Replace a key, as in radio.groups=2."),
]
FrameNumber = Annotated[int, typer.Option("--frame", min=0, help="Number of the frame.")]
Quick = Annotated[bool, typer.Option("--quick", help="Smaller samples: minutes on 2 cores.")]


class InputProblem(UserError):
    """A command's arguments do not fit each other or the scenario."""


def check_frame(scenario: Scenario, frame: int) -> None:
    """Refuse a frame that the scenario does not have."""
    if frame >= scenario.frames:
        raise InputProblem(
            f"--frame {frame}: {scenario.name} has frames 0 to {scenario.frames - 1}; choose one "
            "of these or set frames higher"
        )


def check_names(names: list[str], known: Sequence[str], what: str) -> None:
    """Refuse names that are not among the known."""
    if unknown := [name for name in names if name not in known]:
        raise InputProblem(f"{', '.join(unknown)}: no such {what}; choose from {', '.join(known)}")
