"""Receivers and track rules that know the city's mesh: whitened detection, beams, blind
acquisition, expected clutter, ghosts, images, static clutter."""
