"""Pictures of measured frames."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from isac_rt.views.maps import draw_map

SHOWN_DB = 50.0
"""Below the strongest cell."""


def picture(
    ax: Axes,
    values: xr.DataArray,
    detections: xr.Dataset | None = None,
    lowest: float | None = None,
) -> Axes:
    """Levels of a map of powers, in decibels over the median cell, with detections as circles.

    Parameters
    ----------
    values : over range and a second axis, whose coordinates have units or are in degrees
    detections : `det_range` and, by that axis's name, what goes with it
    lowest : level that is black [dB]; None: `SHOWN_DB` below the strongest
    """
    rows, columns = values.dims
    level = 10 * np.log10(np.maximum(values.values, 1e-30))
    level -= np.median(level)
    y, x = values[rows].values, values[columns].values
    low = level.max() - SHOWN_DB if lowest is None else lowest
    draw_map(ax, x, y, level, (low, level.max()), "power over median [dB]")
    if detections is not None:
        across = detections[f"det_{str(columns).removeprefix('map_')}"]
        ax.plot(across, detections.det_range, "o", mfc="none", mec="white", ms=7)
    unit = {"velocity": "m/s", "azimuth": "deg"}
    name = str(columns).removeprefix("map_")
    ax.set(xlabel=f"{name} [{unit.get(name, '')}]", ylabel="range [m]")
    return ax


def drawn(values: xr.DataArray, detections: xr.Dataset | None = None) -> Figure:
    """A figure of one `picture`."""
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    picture(figure.subplots(), values, detections)
    return figure
