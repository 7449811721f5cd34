"""Receivers: samples and public parameters in, detections and bits out. Nothing here knows the
truth."""

from isac_rt.receive.active import receive_active
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.types import Detections, Maps, Prediction, Reception, no_detections

__all__ = [
    "Detections",
    "Maps",
    "Prediction",
    "Reception",
    "no_detections",
    "receive_active",
    "receive_passive",
]
