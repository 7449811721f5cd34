"""Results of the access stages that a run's frames use: blocks, links and clocks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from isac_rt.frame.clock import Clock
from isac_rt.frame.link import Link


@dataclass(frozen=True)
class Connections:
    """Links, their resource blocks, and clock differences.

    Attributes
    ----------
    clocks : of each terminal against true time; empty with external synchronisation
    establishment : outcome of the stages before the data
        (`isac_rt.extensions.access.protocol.Establishment`); None when they were left out, and
        everything is as stated
    """

    clocks: Mapping[str, Clock] = field(default_factory=dict)
    establishment: Any = None

    @property
    def refused(self) -> frozenset[Link]:
        """Links that carry no data: those that were not acknowledged."""
        links = {} if self.establishment is None else self.establishment.links
        return frozenset(link for link, state in links.items() if not state.acknowledged)

    def clock_difference(self, sender: str, link: Link, time: float) -> Clock:
        """Return the clock of a sender against that of a link's receiver, corrected by the
        receiver's estimate of the transmitter's clock.

        Returns
        -------
        Clock at `time` [s]: `offset` adds to every delay from the sender, `drift` to every delay
        rate
        """
        tx, rx = link
        if sender == rx:
            return Clock()
        sent, received = self.clocks.get(sender, Clock()), self.clocks.get(rx, Clock())
        offset, drift = sent.late(time) - received.late(time), sent.drift - received.drift
        estimate = (
            None if self.establishment is None or tx == rx else self.establishment.links[link].clock
        )
        if estimate is not None:
            offset, drift = offset - estimate.offset_at(time), drift - estimate.drift
        return Clock(offset, drift)

    def offset_std(self, link: Link, time: float) -> float:
        """Return the standard deviation of a link's residual clock offset at `time` [s]."""
        state = None if self.establishment is None else self.establishment.links[link].clock
        return 0.0 if state is None else state.offset_std_at(time)

    def summary(self, time: float) -> dict[str, Any] | None:
        """Return the entry of `summary.json`: decisions, wrong decisions, and residual clock errors
        at `time`; None without access stages."""
        e = self.establishment
        if e is None:
            return None
        links = {}
        for link, state in e.links.items():
            left = self.clock_difference(link.tx, link, time)
            known = state.clock is not None
            links[str(link)] = {
                "identified": state.identified,
                "acknowledged": state.acknowledged,
                "clock_error_s": left.offset if known else None,
                "clock_error_std_s": self.offset_std(link, time) if known else None,
                "drift_error": left.drift if known else None,
            }
        return {
            "blocks": e.blocks,
            "links": links,
            "missed_blocks": e.missed_blocks,
            "false_blocks": e.false_blocks,
            "missed_announcements": e.missed_announcements,
            "wrong_announcements": e.wrong_announcements,
            "missed_acknowledgments": e.missed_acknowledgments,
            "false_acknowledgments": e.false_acknowledgments,
            "frames": e.num_frames,
            "duration_s": e.duration,
        }
