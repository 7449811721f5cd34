"""Patterns of antennas from the files of other programs."""
