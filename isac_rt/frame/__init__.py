"""Waveform, payload, timetable, antennas and the samples of a frame."""
