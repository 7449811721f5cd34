"""Pictures of measured frames."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
    half_x, half_y = (float(a[-1] - a[0]) / max(len(a) - 1, 1) / 2 for a in (x, y))
    image = ax.imshow(
        level,
        origin="lower",
        aspect="auto",
        cmap="magma",
        interpolation="nearest",
        vmin=level.max() - SHOWN_DB if lowest is None else lowest,
        extent=(x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y),
    )
    ax.figure.colorbar(image, ax=ax, label="power over the median cell [dB]")
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
