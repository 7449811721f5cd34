"""Clock of a terminal."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Clock:
    """A terminal's clock against true time: it shows t + offset + drift t, and what it sends is
    late by that [s, 1]."""

    offset: float = 0.0
    drift: float = 0.0

    def late(self, time: float) -> float:
        return self.offset + self.drift * time
