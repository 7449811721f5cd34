"""The paper's fall-back from a pseudo-random antenna schedule to a conventional one, frame by
frame, on the receivers' advice.

A random schedule of fewer groups than transmit antennas rests on sparsity. Receivers of such frames
say whether they found the scene sparse (`Reception.sparse`); the last word of each counts. A
transmitter sends the conventional schedule as long as one of its receivers advises it, from the
next frame on, and the random one otherwise. How the advice of a passive terminal reaches it is not
modelled: it is one bit a frame.
"""

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
    usual : the scenario's
    num_tx : transmit antennas
    fall_back : whether advice is taken; without, the usual one is always sent
    advice : whether each receiver last found the scene sparse
    """

    usual: Schedule
    num_tx: int
    fall_back: bool = True
    advice: dict[Link, bool] = field(default_factory=dict)

    def of(self, active: str) -> Schedule:
        """The schedule of an active terminal's next frame."""
        dense = any(tx == active and not sparse for (tx, _), sparse in self.advice.items())
        groups, chirps = self.usual.shape
        return conventional_schedule(groups, chirps, self.num_tx) if dense else self.usual

    def take_advice(self, receptions: Mapping[Link, Reception]) -> None:
        """Note what the receivers of a frame advise. One that could not tell keeps its last
        advice."""
        if self.fall_back:
            self.advice |= {
                link: r.sparse for link, r in receptions.items() if r.sparse is not None
            }
