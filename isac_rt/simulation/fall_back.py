"""The paper's fall-back from a pseudo-random antenna schedule to a conventional one, frame by
frame, by feedback of the receivers.

A random schedule with fewer groups than transmit antennas needs a sparse scene. Receivers test that
in each frame (`Reception.sparse`). A transmitter sends the conventional schedule from the next
frame on while the last test of one of its receivers failed. The feedback of a passive terminal is
one bit per frame; its transmission is not modelled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from isac_rt.frame.link import Link
from isac_rt.frame.schedule import Schedule, conventional_schedule
from isac_rt.receive.types import Reception


@dataclass
class Schedules:
    """Schedule of each active terminal in the next frame.

    Attributes
    ----------
    usual : schedule of the scenario
    num_tx : transmit antennas
    fall_back : use the feedback; else always send the usual schedule
    advice : result of the last test of each receiver, True: sparse"""

    usual: Schedule
    num_tx: int
    fall_back: bool = True
    advice: dict[Link, bool] = field(default_factory=dict)

    def of(self, active: str) -> Schedule:
        """Return the schedule of an active terminal's next frame."""
        dense = any(tx == active and not sparse for (tx, _), sparse in self.advice.items())
        groups, chirps = self.usual.shape
        return conventional_schedule(groups, chirps, self.num_tx) if dense else self.usual

    def take_advice(self, receptions: Mapping[Link, Reception]) -> None:
        """Store the test results of a frame; a receiver without one keeps its last result."""
        if self.fall_back:
            self.advice |= {
                link: r.sparse for link, r in receptions.items() if r.sparse is not None
            }
