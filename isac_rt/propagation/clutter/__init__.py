"""Clutter: drawn from a distribution (`rayleigh`) or fixed to the mesh (`field`)."""
