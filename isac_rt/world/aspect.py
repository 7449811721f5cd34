"""Quantities that depend on the direction in the body frame, interpolated from a table."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from isac_rt.settings import AspectTable


@lru_cache(maxsize=32)
def _interpolator(table: AspectTable) -> RegularGridInterpolator:
    axes = [np.array(table.elevation_deg), np.array(table.azimuth_deg)]
    values = np.array(table.values_db)
    for i, axis in enumerate(axes):
        if axis.size == 1:  # the same everywhere along an axis with one number
            axes[i], values = np.array([axis[0], axis[0] + 1]), np.repeat(values, 2, axis=i)
    azimuth = np.array(table.azimuth_deg)
    open_deg = 360 - (azimuth[-1] - azimuth[0])
    if azimuth.size > 2 and 0 < open_deg < 1.01 * np.diff(azimuth).max():  # all round but one step
        axes[1] = np.append(azimuth, azimuth[0] + 360)
        values = np.concatenate([values, values[:, :1]], axis=1)
    return RegularGridInterpolator(axes, values)


def in_table(table: AspectTable, direction: np.ndarray) -> np.ndarray:
    """Decibels (...) of a table towards unit vectors (..., 3) in the body's frame.

    Examples
    --------
    >>> table = AspectTable(azimuth_deg=(-90, 90), elevation_deg=(0,), values_db=((0, 10),))
    >>> in_table(table, np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])).tolist()
    [5.0, 10.0, 10.0]
    """
    found = _interpolator(table)
    elevation = np.degrees(np.arcsin(np.clip(direction[..., 2], -1, 1)))
    azimuth = np.degrees(np.arctan2(direction[..., 0], direction[..., 1]))
    low, high = found.grid[1][[0, -1]]
    azimuth = low + (azimuth - low) % 360
    azimuth = np.where(azimuth - high > low + 360 - azimuth, low, azimuth)
    points = [
        np.clip(a, g[0], g[-1]) for a, g in zip((elevation, azimuth), found.grid, strict=True)
    ]
    return np.asarray(found(np.stack(points, axis=-1)))
