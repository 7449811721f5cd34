"""What a scenario says about UAVs: flights, roles, cross-sections, and how they share the band."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from isac_rt.scenario.front_end import FrontEnd
from isac_rt.scenario.node import Decibels, Finite, Node, Problem, Vector

MAX_SPEED_MPS = 1e4
"""Nothing in the air is faster. Doppler shifts are modelled to the first order in v/c, which is
3e-5 here."""


class Rcs(Node):
    """Radar cross-section of a UAV: how strong its echo is."""

    model: Literal["constant", "tr38901", "relative"] = "tr38901"
    """Where the cross-section comes from: `constant` is `value_dbsm`; `tr38901`, the default, is
    the UAV of 3GPP TR 38.901 of the given `size`; `relative` sets the echo's level by `level_db`
    whatever the geometry, as the paper does."""
    value_dbsm: Decibels = -12.81
    """Cross-section over one square metre [dBsm], for `constant`. The default is the mean of TR
    38.901's small UAV."""
    size: Literal["small", "large"] = "small"
    """Which UAV of TR 38.901 is meant, for `tr38901`: `small`, the default, reflects alike to all
    sides; `large` has lobes to front, back, sides, top and bottom."""
    fluctuation_db: Annotated[float, Field(ge=0, le=20)] | None = None
    """Standard deviation by which the cross-section varies smoothly with the aspect [dB], for
    `tr38901` and `constant`; the same on all links and frames, and without effect on the mean
    power. The default is the report's for `tr38901` (3.74 for a small UAV, 2.50 for a large one),
    and none for `constant`."""
    level_db: Decibels = -20.0
    """Level of the reflected path over the reference path of its link [dB], for `relative`: the
    line of sight at a passive terminal, the strongest other target at an active one. The default
    leaves the reference path far stronger."""


class Waypoint(Node):
    """Where a UAV is at one time."""

    time_s: Finite
    """Time after the start of the run [s]; later than that of the waypoint before."""
    position_m: Vector
    """Position at that time: x east, y north, z up [m]."""


class Uav(Node):
    """One UAV: its role, its flight and its body. It flies straight from `position_m`, or a smooth
    curve through `waypoints`."""

    role: Literal["active", "passive", "target"]
    """What the UAV does: `active` sends the chirps and senses with their echoes, `passive` decodes
    the data and senses with the chirps it hears, `target` only reflects."""
    position_m: Vector | None = None
    """Position at the start of the run: x east, y north, z up [m]. A UAV has either this or
    `waypoints`."""
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    """Velocity of a straight flight: east, north, up [m/s]; beside `position_m` only. By default
    the UAV hovers."""
    waypoints: tuple[Waypoint, ...] | None = None
    """Two places or more with their times, which the UAV flies through on a smooth curve; in place
    of `position_m` and `velocity_mps`."""
    boresight: Literal["velocity"] | Vector = "velocity"
    """Direction [x, y, z] that the arrays look in, of any length, or `velocity`, the default: where
    the UAV flies to. Targets outside the field of view about it are not seen."""
    rcs: Rcs = Rcs()
    """Radar cross-section of the UAV: how strong its echo is. By default that of a small UAV."""
    clock_offset_s: Finite = 0.0
    """How late the UAV's clock is at time 0 [s]: what it sends arrives later by this, what it
    receives seems to arrive earlier. By default all clocks agree."""
    clock_drift_ppm: Finite = 0.0
    """How much later the clock gets [microseconds per second]; 0.01 ppm against another clock looks
    like 3 m/s of velocity. By default none."""
    body_radius_m: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.2
    """Radius of the opaque disc that shadows what passes behind the UAV [m], with
    `propagation.model: ray_traced`; 0: transparent. A body does not shadow its own paths and
    echoes. The default is that of a small quadcopter."""
    resource_block: Annotated[int, Field(ge=0)] | None = None
    """First of the consecutive resource blocks, one per group, that an active UAV sends in, counted
    from 0. null, the default: the lowest blocks that the active UAVs before it leave free."""
    front_end: FrontEnd | None = None
    """This terminal's hardware in place of `radio.front_end`. null, the default: that of all."""

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
        if name == "front_end":
            return self.role != "target"
        return name != "velocity_mps" or self.waypoints is None

    def problems(self) -> Iterator[Problem]:
        if self.resource_block is not None and self.role != "active":
            said = (
                f"has no meaning for a UAV that is {self.role} at the start (who takes over the "
                "role takes over its blocks); remove it"
            )
            yield Problem((("resource_block",), ("role",)), said)
        if self.front_end is not None and self.role == "target":
            said = "has no meaning for a target, which neither sends nor receives; remove it"
            yield Problem((("front_end",), ("role",)), said)
        if (speed := math.hypot(*self.velocity_mps)) > MAX_SPEED_MPS:
            yield Problem((("velocity_mps",),), _too_fast(speed))
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
                continue
            way = math.dist(before.position_m, after.position_m)
            if (speed := way / (after.time_s - before.time_s)) > MAX_SPEED_MPS:
                yield Problem(
                    (("waypoints", i, "time_s"), ("waypoints", i, "position_m")), _too_fast(speed)
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


def _too_fast(speed: float) -> str:
    """What is wrong with a speed [m/s]."""
    return (
        f"a flight at {speed:.4g} m/s is faster than the {MAX_SPEED_MPS:g} m/s that are modelled; "
        "fly slower"
    )


class Access(Node):
    """How the terminals find each other before the first frame, and what they tell each other
    later."""

    establish: bool = False
    """Whether the stages before the data are simulated: active terminals listen for free resource
    blocks and announce theirs, clocks are measured, links acknowledged, with the wrong decisions
    that noise brings. Off by default: blocks and links are as stated."""
    synchronisation: Literal["external", "two_round", "none"] = "external"
    """Who sets the clocks right: `external`, the default, an outside source that keeps all equal;
    `two_round`, passive terminals by what the stages before the data measured; `none`, nobody."""
    feedback_rate_bps: Annotated[float, Field(ge=1e3, le=1e9)] = 50e3
    """Rate at which a passive terminal tells an active one of its tracks, for `cooperation:
    tracks`; bits that protect it are not counted [bit/s]. The default is about what the paper's
    data frames carry so protected, at one frame in 45 ms."""
    feedback: bool = False
    """Whether passive terminals report their range and symbols after every frame that active ones
    process, which answer by how many whole range cells the range is off. Off by default, as in the
    paper."""


class RoleChange(Node):
    """An active terminal and a passive one change places."""

    frame: Annotated[int, Field(ge=1)]
    """First frame in the new roles, counted from 0; frames without data follow, as at the start
    (`modulation.acquisition_frames`)."""
    from_uav: str
    """Name of the UAV that is active until then and passive from then on."""
    to_uav: str
    """Name of the UAV that is passive until then; it takes over the role and the resource
    blocks."""
