"""Settings of how terminals find each other, and of what they tell each other."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from isac_rt.settings import Node


class Access(Node):
    """Access of the terminals before the first frame, and the messages between them later."""

    establish: bool = False
    """Whether the stages before the data are simulated: active terminals listen for free resource
    blocks and announce theirs, clocks are measured, links acknowledged, with the wrong decisions
    that noise brings. Off by default: blocks and links are as stated."""
    synchronisation: Literal["external", "two_round", "none"] = "external"
    """Who sets the clocks right: `external`, the default, an outside source that keeps all equal;
    `two_round`, passive terminals by what the stages before the data measured; `none`, nobody."""
    feedback_rate_bps: Annotated[float, Field(ge=1e3, le=1e9)] = 50e3
    """Rate of a passive terminal's feedback of tracks or detections to an active one, for
    `cooperation`, without its error protection [bit/s]. The default is about the protected payload
    of the paper's frames, one frame in 45 ms."""
    feedback: bool = False
    """Whether passive terminals report their range and symbols after every frame that active ones
    process, which answer by how many whole range cells the range is off. Off by default, as in the
    paper."""
