"""The radio with its hardware and its calibration."""

from __future__ import annotations

from isac_rt.frame import settings
from isac_rt.frame.front_end import FrontEnd


class Radio(settings.Radio):
    """The chirp that is sent and the frame that chirps form."""

    front_end: FrontEnd = FrontEnd()
    """How far the terminals' hardware is from ideal; `swarm.NAME.front_end` says it of one. By
    default it is ideal."""
    calibration: str | None = None
    """Calibration file of `isac-rt calibrate --out`, relative to the scenario's folder. Every
    receiver removes these errors from its samples first; all terminals have a board of this kind.
    null, the default: samples are used as they are."""
