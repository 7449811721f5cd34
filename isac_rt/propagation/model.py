"""Protocol of a propagation model: poses in, path sets out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathSet
from isac_rt.world.swarm import Pose


class Traced(NamedTuple):
    """The paths of all links at one instant, and how many more were left out because float64
    geometry contradicts the ray tracer."""

    paths: dict[Link, PathSet]
    dropped: int = 0


@dataclass(frozen=True)
class Census:
    """Amount of the city's clutter in a propagation model; None for what it does not model.

    Attributes
    ----------
    scatterers : in sight of a transmitter at some time of the run
    scatterer_cells : of the whole mesh, among which those were
    merged : by link the scatterers that are left where noise covers others; those of a link that is
        not named are all
    mirrors : by terminal the number of its mirrors, the share of its power that they send on and
        the share that all others would
    overlap_m2 : area in sight that lies in two surfaces or more, and scatters once
    """

    scatterers: int | None = None
    scatterer_cells: int | None = None
    merged: dict[str, int] | None = None
    mirrors: dict[str, dict[str, float]] | None = None
    overlap_m2: float | None = None


class Propagation(Protocol):
    """Methods of a propagation model that a run calls."""

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Paths of every link at an instant [s]."""
        ...

    def census(self) -> Census:
        """Return the size of the model, the same at all instants."""
        ...
