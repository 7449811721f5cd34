"""Fused tracks of the swarm, with their names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from isac_rt.track.filter import Gaussian


class Key(NamedTuple):
    """A track: the link whose receiver follows it, as "TX->RX", and its number there."""

    origin: str
    number: int


class Name(NamedTuple):
    """A UAV's name in the swarm: the earliest track known of it, by the time of its confirmation
    [s]. All who know of that track give the UAV the same name."""

    since: float
    origin: str
    number: int


@dataclass(frozen=True)
class Fused:
    """One UAV of a set of fused tracks.

    Attributes
    ----------
    name : in the swarm
    state : position and velocity (6,), (6, 6)
    members : the tracks that are taken for it
    terminal : of the swarm that it is, by what that one says of itself; None: none
    """

    name: Name
    state: Gaussian
    members: tuple[Key, ...]
    terminal: str | None = None
