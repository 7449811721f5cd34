"""Flights from logs of autopilots, robots and traffic simulations."""
