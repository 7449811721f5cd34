"""UAVs with their hardware, and the formations that stand for several of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from isac_rt.frame.front_end import FrontEnd
from isac_rt.frame.settings import Array, Noise
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.sensors import BoardFile, Sensor
from isac_rt.settings import Problem
from isac_rt.world import settings
from isac_rt.world.settings import Formation, Waypoint

HARDWARE = ("front_end", "sensor", "radio", "array", "noise")
"""Keys of a terminal's hardware, which a target has none of."""


class Uav(settings.Uav):
    """One UAV: its role, its flight, its body and its hardware. It flies straight from
    `position_m`, or a smooth curve through `waypoints`."""

    front_end: FrontEnd | None = None
    """This terminal's hardware in place of `radio.front_end`. null, the default: that of all."""
    sensor: Sensor | BoardFile | None = None
    """This terminal's board in `mode: fmcw`, one of those of `sensor`: it fills in the three keys
    below. null, the default: that of all."""
    radio: Radio | None = None
    """This terminal's chirp in `mode: fmcw`: what is stated overrides `radio`. Radars of different
    chirps disturb each other (docs/weather.md). null, the default: that of all."""
    array: Array | None = None
    """This terminal's antennas: what is stated overrides `array`. As many transmit elements as
    there, but beside a `radio`. null, the default: those of all."""
    noise: Noise | None = None
    """This terminal's transmit power, noise figure or SNR: what is stated overrides `noise`. null,
    the default: those of all."""

    def applies(self, name: str) -> bool:
        if name in HARDWARE:
            return self.is_terminal
        return super().applies(name)

    def problems(self) -> Iterator[Problem]:
        yield from super().problems()
        for key in HARDWARE:
            if getattr(self, key) is not None and not self.is_terminal:
                message = "has no meaning for what neither sends nor receives; remove it"
                yield Problem(((key,), ("role",)), message)


def unfolded(swarm: dict[Any, Any]) -> dict[Any, Any]:
    """A swarm with the UAVs of every `formation` one by one, as plain values. What is malformed
    stays as it is, for whoever checks it."""
    out: dict[Any, Any] = {}
    for name, uav in swarm.items():
        members = _members(name, uav) if isinstance(uav, dict) and uav.get("formation") else None
        for key, one in ({name: uav} if members is None else members).items():
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
    for i, (right, front) in enumerate(formation.positions(), start=1):
        east = right * ahead[1] + front * ahead[0]
        north = -right * ahead[0] + front * ahead[1]
        out[f"{name}_{i}"] = _moved(alone, east, north)
    return out


def _heading(uav: Uav) -> tuple[float, float]:
    """Horizontal unit vector (east, north) in which a UAV sets out; north where it hovers."""
    heading = uav.velocity_mps
    if uav.waypoints is not None:
        first, second = uav.waypoints[0], uav.waypoints[1]
        pairs = zip(first.position_m, second.position_m, strict=True)
        east, north, up = (b - a for a, b in pairs)
        heading = (east, north, up)
    size = math.hypot(heading[0], heading[1])
    return (heading[0] / size, heading[1] / size) if size > 1e-9 else (0.0, 1.0)


def _moved(uav: dict[str, Any], east: float, north: float) -> dict[str, Any]:
    """A UAV as plain values, somewhere else."""

    def beside(point: Any) -> list[float]:
        return [point[0] + east, point[1] + north, point[2]]

    out = dict(uav)
    if out.get("position_m") is not None:
        out["position_m"] = beside(out["position_m"])
    if out.get("waypoints") is not None:
        plain = [w.model_dump() if isinstance(w, Waypoint) else w for w in out["waypoints"]]
        out["waypoints"] = [{**w, "position_m": beside(w["position_m"])} for w in plain]
    return out
