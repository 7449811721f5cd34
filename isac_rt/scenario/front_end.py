"""What a scenario says about the front end of a terminal: how far its hardware is from ideal."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from isac_rt.scenario.node import Decibels, Node, Problem

Offset = Annotated[float, Field(ge=1e-3, le=1e12, allow_inf_nan=False)]


class Oscillator(Node):
    """Phase noise of a terminal's oscillator, as a mask of its single-sideband spectrum."""

    mask_dbc_hz: tuple[tuple[Offset, Decibels], ...] = ()
    """Points [offset from the carrier in Hz, single-sideband noise in dBc/Hz] in the order of their
    offsets; the level may not rise. It is interpolated on logarithmic axes and held beyond the last
    point: the floor. Empty, the default: no phase noise."""
    locked: bool = True
    """Whether the oscillator is locked to one without noise: below the first point the level is
    held. If not, it goes on rising towards the carrier with the slope of the first two points.
    Locked by default."""
    spurs_dbc: tuple[tuple[Offset, Decibels], ...] = ()
    """Discrete lines, such as those of a synthesiser's reference: [offset in Hz, level of each of
    the two sidebands in dBc]. None by default."""

    @property
    def ideal(self) -> bool:
        """Whether it has neither noise nor lines."""
        return not self.mask_dbc_hz and not self.spurs_dbc

    def problems(self) -> Iterator[Problem]:
        for i, (before, after) in enumerate(itertools.pairwise(self.mask_dbc_hz), start=1):
            if after[0] <= before[0]:
                said = (
                    f"an offset of {after[0]:g} Hz does not follow {before[0]:g} Hz; put the "
                    "points in the order of their offsets"
                )
                yield Problem((("mask_dbc_hz", i),), said)
            elif after[1] > before[1]:
                said = (
                    f"the mask rises from {before[1]:g} dBc/Hz to {after[1]:g} dBc/Hz; phase noise "
                    "falls or stays with the offset from the carrier"
                )
                yield Problem((("mask_dbc_hz", i),), said)
        if self.mask_dbc_hz and not self.locked and len(self.mask_dbc_hz) < 2:
            said = "a free oscillator needs two points or more, whose slope goes on to the carrier"
            yield Problem((("mask_dbc_hz",), ("locked",)), said)
        for i, (_, level) in enumerate(self.spurs_dbc):
            if level > -10:
                said = f"{level:g} dBc is no spur but a second carrier; at most -10 dBc"
                yield Problem((("spurs_dbc", i),), said)


class FrontEnd(Node):
    """How far a terminal's hardware is from ideal. Each part is off by default and acts by
    itself."""

    oscillator: Oscillator = Oscillator()
    """Phase noise and spurs. At an active terminal one oscillator serves both ways, so that near
    echoes hardly show its noise; at a passive one its own and the transmitter's add up."""

    @property
    def ideal(self) -> bool:
        """Whether nothing departs from the ideal."""
        return self.oscillator.ideal
