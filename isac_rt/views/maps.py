"""Range-Doppler maps, and maps of the equivalent range."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from isac_rt.results.records import KINDS
from isac_rt.views.style import (
    KIND_COLOURS,
    KIND_MARKERS,
    UNEXPLAINED,
    labelled,
    link_name,
    moment,
    range_words,
    words,
)

_SHOWN_DB = 35.0
"""Depth of a range-Doppler map's colours above the median cell [dB]: a target of 15 dB is seen next
to a line of sight of 60 dB, which saturates."""
_PEAK_DB = 60.0
"""Depth of an equivalent-range map's colours below its peak [dB]."""
_OCCUPIED_DB = 15.0
"""Cells this far above the median [dB] are more than noise, whose largest of 10,000 has 11 dB."""
_TINY = np.finfo(np.float32).tiny  # maps are kept in single precision


def range_doppler(ax: Axes, dataset: xr.Dataset, snapshot: int, observer: int) -> Axes:
    """Range-Doppler map of one link's receiver, cut to where more than noise is; detections marked
    by the kind of path that explains them, truth as circles."""
    r, v = dataset.map_range.values[observer], dataset.map_velocity.values[observer]
    level = _level(dataset, snapshot, observer)
    r, v = r[np.isfinite(r)], v[np.isfinite(v)]
    draw_map(ax, v, r, level, (0.0, _SHOWN_DB), "power over median [dB]")
    if not level.any():
        message = "no map: the delays of the data\nwere not known"
        ax.text(0.5, 0.5, message, color="white", ha="center", transform=ax.transAxes)
    frame, number = moment(dataset, snapshot)
    mine = (dataset.det_frame.values == frame) & (dataset.det_observer.values == observer)
    kind = dataset.det_kind.values
    for k, name in [*enumerate(KINDS), (-1, "unexplained")]:
        at = mine & (kind == k)
        if at.any():
            ax.plot(
                dataset.det_velocity.values[at],
                dataset.det_range.values[at],
                KIND_MARKERS.get(name, "x"),
                ms=6,
                mew=1.1,
                ls="none",
                mfc="none" if k >= 0 else None,
                color="white" if name == "line_of_sight" else KIND_COLOURS.get(name, UNEXPLAINED),
                label=f"{words(name)} ({at.sum()})",
            )
    x, y = _expected(dataset, frame, observer)
    ax.plot(x, y, "o", ms=11, mfc="none", mec="white", mew=1.2, ls="none", label="UAV (truth)")
    xlim, ylim = map_limits(dataset, snapshot, observer)
    ax.set(xlim=xlim, ylim=ylim)
    return labelled(
        ax,
        "range rate [m/s]",
        range_words(dataset, observer),
        f"{link_name(dataset, observer)}, frame {number}",
        frameon=True,
        facecolor="black",
        edgecolor="none",
        labelcolor="white",
    )


def _level(dataset: xr.Dataset, snapshot: int, observer: int) -> np.ndarray:
    """A range-Doppler map over its median cell, as most cells hold noise alone [dB]."""
    rows = np.isfinite(dataset.map_range.values[observer])
    columns = np.isfinite(dataset.map_velocity.values[observer])
    power = dataset.map_power.values[snapshot, observer][np.ix_(rows, columns)]
    level = 10 * np.log10(np.maximum(power, _TINY))
    return np.asarray(level - np.median(level))


def map_limits(
    dataset: xr.Dataset, snapshot: int, observer: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """The range rates [m/s] and ranges [m] between which a map holds more than noise, detections
    that a path explains, or UAVs."""
    level, frame = _level(dataset, snapshot, observer), moment(dataset, snapshot)[0]
    r, v = dataset.map_range.values[observer], dataset.map_velocity.values[observer]
    x, y = _expected(dataset, frame, observer)
    cells, bins = np.nonzero(level > _OCCUPIED_DB)
    mine = (dataset.det_frame.values == frame) & (dataset.det_observer.values == observer)
    mine &= dataset.det_kind.values >= 0
    occupied = (
        np.concatenate([v[bins], x, dataset.det_velocity.values[mine]]),
        np.concatenate([r[cells], y, dataset.det_range.values[mine]]),
    )
    empty = np.zeros(0)
    limits = [_cut(a, o if level.any() else empty) for a, o in zip((v, r), occupied, strict=True)]
    return limits[0], limits[1]


def _cut(axis: np.ndarray, occupied: np.ndarray) -> tuple[float, float]:
    """The occupied part of an axis with a fifth of it on both sides, at least a quarter of it."""
    low, high = float(np.nanmin(axis)), float(np.nanmax(axis))
    occupied = occupied[np.isfinite(occupied)]
    if not occupied.size:
        return low, high
    middle = (occupied.min() + occupied.max()) / 2
    half = max(0.7 * float(np.ptp(occupied)), (high - low) / 8)
    return max(low, middle - half), min(high, middle + half)


def _expected(dataset: xr.Dataset, frame: int, observer: int) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and range at which the map shows the UAVs in view and unoccluded, velocity folded
    into the map's span."""
    here = frame, observer
    seen = dataset.in_view.values[here] & ~dataset.occluded.values[here]
    r, v = dataset.truth_range.values[here][seen], dataset.truth_velocity.values[here][seen]
    axis = dataset.map_velocity.values[observer]
    axis = axis[np.isfinite(axis)]
    span = (axis[1] - axis[0]) * len(axis)
    return v - span * np.floor((v - axis[0]) / span + 0.5 / len(axis)), r


def draw_map(
    ax: Axes,
    x: np.ndarray,
    y: np.ndarray,
    level_db: np.ndarray,
    shown: tuple[float, float],
    label: str,
) -> None:
    """A picture of levels whose cells have their middles at `x` and `y`."""
    dx, dy = ((a[-1] - a[0]) / max(len(a) - 1, 1) / 2 for a in (x, y))
    image = ax.imshow(
        level_db,
        origin="lower",
        aspect="auto",
        cmap="magma",
        vmin=shown[0],
        vmax=shown[1],
        interpolation="nearest",
        extent=(x[0] - dx, x[-1] + dx, y[0] - dy, y[-1] + dy),
    )
    extend = "max" if level_db.max() > shown[1] else "neither"
    ax.figure.colorbar(image, ax=ax, label=label, pad=0.01, fraction=0.12, aspect=30, extend=extend)
    ax.grid(False)


def equivalent_range(ax: Axes, dataset: xr.Dataset, snapshot: int, observer: int) -> Axes:
    """Range cell over chirp of the first group before the data are removed: what the delay symbols
    do to every echo."""
    magnitude = dataset.map_equivalent_range.values[snapshot, observer]
    inside = np.isfinite(magnitude)
    magnitude = magnitude[np.ix_(inside.any(axis=1), inside.any(axis=0))]
    level = 20 * np.log10(np.maximum(magnitude, _TINY))
    level = level - level.max()
    draw_map(
        ax,
        np.arange(level.shape[1]),
        np.arange(level.shape[0]),
        level,
        (-_PEAK_DB, 0.0),
        "magnitude [dB]",
    )
    cells, chirps = np.nonzero(dataset.map_equivalent_detections.values[snapshot, observer])
    label = "one-dimensional CFAR"
    ax.plot(chirps, cells, "o", ms=2.5, mfc="none", mec="#20A060", mew=0.4, ls="none", label=label)
    title = f"{link_name(dataset, observer)}, frame {moment(dataset, snapshot)[1]}"
    return labelled(ax, "chirp", "range cell", title)
