"""Clutter: drawn by a law (`rayleigh`) or pinned to the mesh (`field`)."""
