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
    """File of a calibration that `isac-rt calibrate --out` wrote, relative to the scenario's
    folder: what every receiver takes out of its samples before anything else. All terminals have a
    board of this kind. null, the default: samples are taken as they are."""
