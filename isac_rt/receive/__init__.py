"""Receivers: samples and public parameters in, detections and bits out. Nothing here knows the
truth."""
