"""Real hardware: front ends and their samples, recordings of boards, and their calibration."""
