"""Clutter: drawn by a law (`rayleigh`), drawn anew from the mesh in every frame (`resampled`), or
pinned to it (`field`)."""
