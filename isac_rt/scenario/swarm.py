"""What a scenario says about UAVs: flights, roles, cross-sections, and how they share the band."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from isac_rt.scenario.node import Finite, Node, Problem, Vector


class Rcs(Node):
    """Radar cross-section of a UAV.

    constant: `value_dbsm`. tr38901: mean of TR 38.901's UAV of small or large size; with
    `fluctuation_db` it varies smoothly with aspect, alike on all links and frames. relative: the
    reflected path stands `level_db` above the reference path of its link (line of sight at a PT,
    strongest other target at the AT), whatever the geometry.
    """

    model: Literal["constant", "tr38901", "relative"] = "tr38901"
    value_dbsm: Finite = -12.81
    size: Literal["small", "large"] = "small"
    fluctuation_db: Annotated[float, Field(ge=0, le=20)] = 0.0
    level_db: Finite = -20.0


class Waypoint(Node):
    """Where a UAV is at a time after the start of the run."""

    time_s: Finite
    position_m: Vector


class Uav(Node):
    """One UAV: position and velocity, or waypoints with times (flown as a smooth curve through
    them)."""

    role: Literal["active", "passive", "target"]
    position_m: Vector | None = None
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    waypoints: tuple[Waypoint, ...] | None = None
    boresight: Literal["velocity"] | Vector = "velocity"
    rcs: Rcs = Rcs()
    clock_offset_s: Finite = 0.0
    """By how much the clock is late at time 0: what the UAV sends arrives later by it, what it
    receives seems earlier."""
    clock_drift_ppm: Finite = 0.0
    """How much later it gets [us/s]; 0.01 ppm against another clock is 3 m/s of apparent
    velocity."""
    body_radius_m: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.2
    """ray_traced: of the opaque disc that shadows what passes behind it; 0: transparent. No body
    shadows its own paths and echoes."""
    resource_block: Annotated[int, Field(ge=0)] | None = None
    """First of the consecutive resource blocks, one per group, in which the UAV sends while it is
    active; null: the lowest that the active UAVs before it leave free."""

    @field_validator("boresight", mode="before")
    @classmethod
    def _velocity_or_direction(cls, value: Any) -> Any:
        if value != "velocity" and not (isinstance(value, list | tuple) and len(value) == 3):
            raise ValueError("must be velocity or a direction [x, y, z]")
        if isinstance(value, list | tuple) and not any(value):
            raise ValueError(
                "a direction of length zero points nowhere; give a direction such as [0, 1, 0], or "
                "velocity"
            )
        return value

    def applies(self, name: str) -> bool:
        if name == "resource_block":
            return self.role == "active"
        return name != "velocity_mps" or self.waypoints is None

    def problems(self) -> Iterator[Problem]:
        if self.resource_block is not None and self.role != "active":
            said = (
                f"has no meaning for a UAV that is {self.role} at the start (who takes over the "
                "role takes over its blocks); remove it"
            )
            yield Problem((("resource_block",), ("role",)), said)
        if self.waypoints is None and self.position_m is None:
            yield Problem((("position_m",),), "missing: a UAV needs either position_m or waypoints")
        if self.waypoints is None:
            return
        if self.position_m is not None:
            yield Problem(
                (("position_m",), ("waypoints",)),
                "a UAV has either position_m or waypoints, not both; remove one of them",
            )
        if "velocity_mps" in self.model_fields_set:
            yield Problem(
                (("velocity_mps",), ("waypoints",)),
                "waypoints say how a UAV flies; remove velocity_mps or the waypoints",
            )
        if len(self.waypoints) < 2:
            yield Problem(
                (("waypoints",),),
                "needs two waypoints or more; for a UAV at rest or in straight flight use "
                "position_m",
            )
        for i, (before, after) in enumerate(itertools.pairwise(self.waypoints), start=1):
            if after.time_s <= before.time_s:
                yield Problem(
                    (("waypoints", i, "time_s"), ("waypoints", i - 1, "time_s")),
                    f"must be later than the waypoint before, at {before.time_s:g} s; put the "
                    "waypoints in the order of their times",
                )

    def place(self, time: float) -> tuple[float, ...]:
        """Position [m] with straight lines between waypoints: near enough to judge an input, not to
        fly by."""
        if self.waypoints is None:
            assert self.position_m is not None
            return tuple(
                p + time * v for p, v in zip(self.position_m, self.velocity_mps, strict=True)
            )
        for a, b in itertools.pairwise(self.waypoints):
            if time < b.time_s or b is self.waypoints[-1]:
                share = (time - a.time_s) / (b.time_s - a.time_s)
                return tuple(
                    p + share * (q - p) for p, q in zip(a.position_m, b.position_m, strict=True)
                )
        raise AssertionError("two waypoints at least")


class Access(Node):
    """How terminals find each other before the first frame."""

    establish: bool = False
    """Go through the stages before the data (`isac_rt.access.establish`): active terminals listen
    for free blocks and announce theirs, clocks are measured, links acknowledged, with every wrong
    decision that the noise brings. Else blocks and links are as stated."""
    synchronisation: Literal["external", "two_round", "none"] = "external"
    """external: an outside source keeps all clocks equal. two_round: passive terminals correct
    theirs by what the stages measured. none: nobody corrects anything."""
    feedback: bool = False
    """After every frame that the active terminals process, the passive ones report their range and
    their symbols, and the active ones, which have the same distance from their echoes, answer by
    how many whole range cells it is off."""


class RoleChange(Node):
    """An active terminal and a passive one change places."""

    frame: Annotated[int, Field(ge=1)]
    """First frame in the new roles; acquisition frames follow, as at the start."""
    from_uav: str
    """Active until then, passive from then on."""
    to_uav: str
    """Passive until then; takes over the role and the resource blocks."""
