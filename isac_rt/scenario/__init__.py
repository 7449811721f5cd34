"""The whole input of a run as a frozen, typed tree; `isac_rt.scenario.file` reads and writes it."""

from isac_rt.frame.access import Access
from isac_rt.frame.front_end import FrontEnd
from isac_rt.frame.settings import Array, Modulation, Noise, RoleChange
from isac_rt.propagation.settings import Clutter, Leakage, Propagation
from isac_rt.receive.settings import Receivers
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.settings import Accuracy
from isac_rt.track.settings import Tracking
from isac_rt.world.settings import City, MaterialOverride, Rcs, Waypoint

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
