"""Rules that put off tracks of a passive terminal until enough is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from isac_rt.receive.types import Detections
from isac_rt.track.parts import Own, TrackRule, is_placed
from isac_rt.track.tracker import Tracker

REPORT_FRAMES = 5
"""A passive terminal to which others report confirms none of its own tracks before so many frames
after the first detection. It cannot see what flies near its line of sight, but receives its echoes
over walls. The active terminal sees such a target a frame later at worst, confirms it in the third
frame, and its report takes two more."""


class PlacedTransmitter(TrackRule):
    """No track starts while the transmitter's motion is not known to a Doppler `cell` [m/s]: the
    expected clutter explains nothing before."""

    def __init__(self, cell: float) -> None:
        self._cell = cell

    def births(self, detections: Detections, own: Own) -> Detections:
        if own.transmitter is None or is_placed(own.transmitter, self._cell):
            return detections
        return replace(detections, starts=np.zeros(len(detections), bool))


class AwaitedReports(TrackRule):
    """No track is confirmed before others could have reported the target (`REPORT_FRAMES`)."""

    def prune(self, tracker: Tracker, own: Own) -> None:
        if own.cooperates:
            for track in tracker.tracks:
                track.confirmed &= track.age >= REPORT_FRAMES
