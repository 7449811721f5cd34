"""How terminals share the band and find each other: Chirp-DMA, on-off keyed messages, the stages
before the data, and feedback."""

from isac_rt.access.connect import Connections
from isac_rt.access.dma import Isolation, isolation
from isac_rt.access.feedback import Correction, Feedback, correct, exchange, summarise
from isac_rt.access.protocol import Clock, Establishment, LinkState, Network, establish
from isac_rt.access.synchronise import ClockEstimate, Round, estimate_clock

__all__ = [
    "Clock",
    "ClockEstimate",
    "Connections",
    "Correction",
    "Establishment",
    "Feedback",
    "Isolation",
    "LinkState",
    "Network",
    "Round",
    "correct",
    "establish",
    "estimate_clock",
    "exchange",
    "isolation",
    "summarise",
]
