"""What a scenario says about UAVs: flights, roles, cross-sections, and how they share the band."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import suppress
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from isac_rt.scenario.aspect import AspectTable
from isac_rt.scenario.front_end import FrontEnd
from isac_rt.scenario.node import Decibels, Finite, Node, Problem, Vector

MAX_SPEED_MPS = 1e4
"""Nothing in the air is faster. Doppler shifts are modelled to the first order in v/c, which is
3e-5 here."""


class Rcs(Node):
    """Radar cross-section of a UAV: how strong its echo is."""

    model: Literal["constant", "tr38901", "relative", "table"] = "tr38901"
    """Where the cross-section comes from: `constant` is `value_dbsm`; `tr38901`, the default, is
    the UAV of 3GPP TR 38.901 of the given `size`; `relative` sets the echo's level by `level_db`
    whatever the geometry, as the paper does; `table` is that of `table` or `file` towards the
    bisector of both directions."""
    table: AspectTable | None = None
    """Cross-section by azimuth and elevation in the UAV's frame [dBsm], for `table`."""
    file: str | None = None
    """CSV file with the columns azimuth_deg, elevation_deg and dbsm, a row for each direction of a
    grid, in place of `table`; the path is relative to the scenario's folder."""
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

    def applies(self, name: str) -> bool:
        return name not in ("table", "file") or self.model == "table"

    def problems(self) -> Iterator[Problem]:
        if self.file is not None:
            yield Problem((("file",),), "is read by isac_rt.load, which was not used; state table")
        elif (self.table is None) == (self.model == "table"):
            said = "goes with model table, and model table with it or with file"
            yield Problem((("table",), ("model",)), said)


class Waypoint(Node):
    """Where a UAV is at one time."""

    time_s: Finite
    """Time after the start of the run [s]; later than that of the waypoint before."""
    position_m: Vector
    """Position at that time: x east, y north, z up [m]."""
    attitude_deg: Vector | None = None
    """How the UAV is turned at that time: yaw (of its nose, clockwise from north), pitch (nose up)
    and roll (right side down) [degrees]; at all waypoints or at none. It turns smoothly in between.
    null, the default: `boresight` says it."""


class Formation(Node):
    """Several UAVs from one: all fly the same way, apart from each other."""

    shape: Literal["line", "column", "wedge", "grid"]
    """How they stand about the direction in which they set out: `line` to the right and left in
    turn, `column` behind each other, `wedge` behind to the right and left in turn, `grid` in rows
    to the right, each behind the one before."""
    spacing_m: Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
    """Distance of neighbours along the line, the column and the rows, and sideways and behind in
    the wedge [m]."""
    count: Annotated[int, Field(ge=2, le=200)]
    """How many there are, the one that is stated included; they get its name with _1, _2 and so
    on."""

    def places(self) -> list[tuple[float, float]]:
        """(right, ahead) of each [m], the first at (0, 0)."""
        out = []
        width = math.ceil(math.sqrt(self.count))
        for i in range(self.count):
            step = (i + 1) // 2
            side = step if i % 2 else -step
            right, ahead = {
                "line": (side, 0),
                "column": (0, -i),
                "wedge": (side, -step),
                "grid": (i % width, -(i // width)),
            }[self.shape]
            out.append((right * self.spacing_m, ahead * self.spacing_m))
        return out


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
    flight: str | None = None
    """CSV file with the columns time_s, x, y, z [m] and, if known, yaw_deg, pitch_deg, roll_deg, in
    place of `waypoints`, at most 5000 rows; the path is relative to the scenario's folder."""
    mount_deg: Vector = (0.0, 0.0, 0.0)
    """How the arrays are turned against the UAV's own frame: yaw to the right, pitch up, roll
    [degrees], as of a radar that looks sideways from a car. By default they look ahead."""
    formation: Formation | None = None
    """Further UAVs of the same kind that fly beside this one. null, the default: none."""
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
        if self.flight is not None:
            said = "is read by isac_rt.load, which was not used; state waypoints"
            yield Problem((("flight",),), said)
        if self.formation is not None:
            said = "is unfolded in the swarm of a scenario; state UAVs one by one here"
            yield Problem((("formation",),), said)
        turned = [w.attitude_deg is not None for w in self.waypoints or ()]
        if any(turned) and not all(turned):
            said = "some have attitude_deg and some have not; state it at all or at none"
            yield Problem((("waypoints",),), said)
        if any(turned) and self.boresight != "velocity":
            said = "the waypoints' attitude_deg says where the UAV looks; leave one of the two out"
            yield Problem((("boresight",), ("waypoints",)), said)
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


def unfolded(swarm: dict[Any, Any]) -> dict[Any, Any]:
    """A swarm with the UAVs of every `formation` one by one, as plain values. What is malformed
    stays as it is, for whoever checks it."""
    out: dict[Any, Any] = {}
    for name, uav in swarm.items():
        found = _members(name, uav) if isinstance(uav, dict) and uav.get("formation") else None
        for key, one in ({name: uav} if found is None else found).items():
            if key in out or (key != name and key in swarm):
                raise ValueError(f"swarm.{name}.formation: there is a {key} already; rename one")
            out[key] = one
    return out


def formations(swarm: Any) -> dict[str, Formation]:
    """The formations that a swarm states, by name; what is malformed is none."""
    out: dict[str, Formation] = {}
    for name, uav in swarm.items() if isinstance(swarm, dict) else ():
        stated = uav.get("formation") if isinstance(uav, dict) else None
        if isinstance(stated, Formation):
            out[str(name)] = stated
        elif stated:
            with suppress(ValueError):
                out[str(name)] = Formation.model_validate(stated)
    return out


def _members(name: Any, uav: dict[str, Any]) -> dict[str, Any] | None:
    """The UAVs of one formation; None where what is stated is no formation or no flight."""
    try:
        stated = uav["formation"]
        formation = stated if isinstance(stated, Formation) else Formation.model_validate(stated)
        alone = {key: value for key, value in uav.items() if key != "formation"}
        ahead = _heading(Uav.model_validate(alone))
    except ValueError:
        return None
    out = {}
    for i, (right, front) in enumerate(formation.places(), start=1):
        east = right * ahead[1] + front * ahead[0]
        north = -right * ahead[0] + front * ahead[1]
        out[f"{name}_{i}"] = _moved(alone, east, north)
    return out


def _heading(uav: Uav) -> tuple[float, float]:
    """Horizontal unit vector (east, north) in which a UAV sets out; north where it hovers."""
    way = uav.velocity_mps
    if uav.waypoints is not None:
        first, second = uav.waypoints[0], uav.waypoints[1]
        pairs = zip(first.position_m, second.position_m, strict=True)
        east, north, up = (b - a for a, b in pairs)
        way = (east, north, up)
    size = math.hypot(way[0], way[1])
    return (way[0] / size, way[1] / size) if size > 1e-9 else (0.0, 1.0)


def _moved(uav: dict[str, Any], east: float, north: float) -> dict[str, Any]:
    """A UAV as plain values, somewhere else."""

    def beside(place: Any) -> list[float]:
        return [place[0] + east, place[1] + north, place[2]]

    out = dict(uav)
    if out.get("position_m") is not None:
        out["position_m"] = beside(out["position_m"])
    if out.get("waypoints") is not None:
        plain = [w.model_dump() if isinstance(w, Waypoint) else w for w in out["waypoints"]]
        out["waypoints"] = [{**w, "position_m": beside(w["position_m"])} for w in plain]
    return out


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
    """Rate at which a passive terminal tells an active one of its tracks or detections, for
    `cooperation`; bits that protect it are not counted [bit/s]. The default is about what the
    paper's data frames carry so protected, at one frame in 45 ms."""
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
