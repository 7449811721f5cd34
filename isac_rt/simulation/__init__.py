"""Simulation of a scenario: set-up, plan, the loop over frames, and resuming."""
