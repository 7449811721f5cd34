"""Clutter over mirrors: a wall before or after the scatterer."""
