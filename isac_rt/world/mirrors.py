"""Plane mirrors: images of places and directions behind them."""

from __future__ import annotations

import numpy as np


def mirror_image(
    places: np.ndarray, normals: np.ndarray, offsets: np.ndarray | float = 0.0
) -> np.ndarray:
    """Places (..., 3) behind planes with unit normals (..., 3) and offsets (...): points x of a
    plane obey normal.x = offset. With offsets of 0: directions after a mirror."""
    height = (places * normals).sum(axis=-1) - offsets
    return places - 2 * height[..., None] * normals
