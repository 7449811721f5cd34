"""Colours, markers and type of all figures, and the labels of an axis."""

from __future__ import annotations

from typing import Any

import matplotlib
import xarray as xr
from matplotlib.axes import Axes

KIND_COLOURS = {
    "line_of_sight": "#000000",
    "target": "#D55E00",
    "ghost": "#CC79A7",
    "specular": "#0072B2",
    "diffuse": "#56B4E9",
    "leakage": "#E69F00",
}
"""One colour per path kind in every figure (Okabe and Ito, Color Universal Design, 2008)."""
KIND_MARKERS = {
    "line_of_sight": "s",
    "target": "o",
    "ghost": "D",
    "specular": "^",
    "diffuse": ".",
    "leakage": "P",
}
UNEXPLAINED = "#8C8C8C"
UAV_COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#8C6D31",
)
ROLE_MARKERS = {"active": "*", "passive": "s", "target": "o", "object": "D"}
STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # where they are anyway; else all tick labels are measured once more
    "text.hinting": "none",  # a twelfth of the time of a figure, and letters stand more evenly
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.4,
}


def words(name: str) -> str:
    """A name as people read it."""
    return name.replace("_", " ")


def colour_of(index: int) -> str:
    """The colour of a UAV, an observer or a curve by its number."""
    return UAV_COLOURS[index % len(UAV_COLOURS)]


def link_name(dataset: xr.Dataset, observer: int) -> str:
    """The link of an observer in words."""
    return f"{dataset.transmitter.values[observer]} to {dataset.receiver.values[observer]}"


def range_words(dataset: xr.Dataset, observer: int) -> str:
    """Return the axis label of an observer's ranges: those of echoes are one-way."""
    monostatic = dataset.transmitter.values[observer] == dataset.receiver.values[observer]
    return "range [m]" if monostatic else "path length [m]"


def moment(dataset: xr.Dataset, snapshot: int) -> tuple[int, int]:
    """Index of a snapshot's frame, and the frame's number."""
    frame = int(dataset.snapshot_frame.values[snapshot])
    return frame, int(dataset.frame.values[frame])


def labelled(ax: Axes, x: str, y: str, title: str = "", **legend: Any) -> Axes:
    """Label the axes, and write a title and the legend above them.

    The legend has as many columns as fit; it is left out where an axis before has the same names.
    """
    ax.set(xlabel=x, ylabel=y)
    figure = ax.get_figure(root=True)
    assert figure is not None
    names = ax.get_legend_handles_labels()[1]
    legends = [axes.get_legend() for axes in figure.axes]
    if not names or names in [[t.get_text() for t in old.get_texts()] for old in legends if old]:
        ax.set_title(title)
        return ax
    spec, settings = ax.get_subplotspec(), matplotlib.rcParams
    if figure.get_layout_engine() is None or spec is None:
        width = ax.get_window_extent().width
    else:  # the layout comes later: leave room for labels and colour bar, of the letters' size
        used = (1.7 if ax.images else 1.0) * settings["font.size"] / STYLE["font.size"]
        width = figure.bbox.width / spec.get_gridspec().ncols - used * figure.dpi
    for columns in range(len(names), 0, -1):
        made = ax.legend(
            **{"loc": "lower left", "bbox_to_anchor": (0, 1), "ncols": columns, "title": title}
            | {"alignment": "left", "borderaxespad": 0.3, "borderpad": 0.2, "columnspacing": 1.2}
            | {"title_fontsize": settings["axes.titlesize"]}
            | legend
        )
        made.get_title().set_color(legend.get("labelcolor", "black"))
        if made.get_window_extent().width <= width:
            break
    return ax
