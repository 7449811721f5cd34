"""What a terminal makes of its receiver's detections: tracks, predictions, its own view of the
mesh, ghosts."""
