"""Tables by azimuth and elevation: antenna patterns and cross-sections as they were measured."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from isac_rt.scenario.node import Decibels, Finite, Node, Problem

Rising = Annotated[tuple[Finite, ...], Field(min_length=1, max_length=721)]


class AspectTable(Node):
    """Values over a grid of directions in the body's frame."""

    azimuth_deg: Rising
    """Azimuths of the columns, rising, from the boresight to the right [degrees]. Beyond the first
    and last the nearest counts; a table that leaves out no more than a step of the circle, such as
    one from 0 to 350, goes round."""
    elevation_deg: Rising
    """Elevations of the rows, rising, from the horizontal upwards [degrees]."""
    values_db: tuple[tuple[Decibels, ...], ...]
    """A row for each elevation and in it a number for each azimuth: gain [dBi] or cross-section
    [dBsm]; between them it is interpolated in decibels."""

    def problems(self) -> Iterator[Problem]:
        for key, limit in (("azimuth_deg", 360.0), ("elevation_deg", 90.0)):
            line = getattr(self, key)
            if any(b <= a for a, b in itertools.pairwise(line)):
                yield Problem(((key,),), "must rise from each number to the next")
            if max(map(abs, line)) > limit:
                yield Problem(((key,),), f"must be within {limit:g} degrees on either side")
        shape = len(self.elevation_deg), len(self.azimuth_deg)
        found = len(self.values_db), {len(row) for row in self.values_db}
        if found != (shape[0], {shape[1]}):
            yield Problem(
                (("values_db",),),
                f"needs {shape[0]} rows (elevations) of {shape[1]} numbers (azimuths)",
            )
