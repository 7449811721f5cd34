"""Measured samples: files of radar boards in, IF cubes and what a board does to them out."""

from isac_rt.capture.types import Capture, CaptureError

__all__ = ["Capture", "CaptureError"]
