"""The whole input of a run as a frozen, typed tree; `isac_rt.scenario.file` reads and writes it."""

from isac_rt.scenario.environment import (
    Accuracy,
    City,
    Clutter,
    Leakage,
    MaterialOverride,
    Propagation,
)
from isac_rt.scenario.front_end import FrontEnd
from isac_rt.scenario.radio import Array, Modulation, Noise, Radio
from isac_rt.scenario.receivers import Receivers, Tracking
from isac_rt.scenario.swarm import Access, Rcs, RoleChange, Uav, Waypoint
from isac_rt.scenario.tree import Scenario

__all__ = [
    "Access",
    "Accuracy",
    "Array",
    "City",
    "Clutter",
    "FrontEnd",
    "Leakage",
    "MaterialOverride",
    "Modulation",
    "Noise",
    "Propagation",
    "Radio",
    "Rcs",
    "Receivers",
    "RoleChange",
    "Scenario",
    "Tracking",
    "Uav",
    "Waypoint",
]
