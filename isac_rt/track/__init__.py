"""Tracking: from a receiver's detections to tracks, predictions, the terminal's own view of the
mesh, ghosts."""
