"""Figures of a run: functions that take Axes and return them, and `make_figures`, which writes them
all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import AutoLocator, LogLocator
from matplotlib.transforms import Bbox
from scipy.spatial import ConvexHull

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.results.columns import MEASURES
from isac_rt.results.dataset import errors_of
from isac_rt.results.files import write_figure
from isac_rt.results.recorder import Results
from isac_rt.results.records import KINDS
from isac_rt.views.maps import equivalent_range, range_doppler
from isac_rt.views.scene import boxes_in
from isac_rt.views.style import (
    KIND_COLOURS,
    KIND_MARKERS,
    ROLE_MARKERS,
    STYLE,
    colour_of,
    labelled,
    link_name,
    moment,
    range_words,
    words,
)
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.settings import TERMINAL_ROLES

_STEPS = 5
"""Steps of an axis at most: every tick takes as long to draw as a curve."""
_UNITS = {
    "range": (1.0, "m"),
    "velocity": (1.0, "m/s"),
    "azimuth": (180 / np.pi, "deg"),
    "elevation": (180 / np.pi, "deg"),
}


def scene_map(ax: Axes, dataset: xr.Dataset, city: CityMesh | None = None) -> Axes:
    """The swarm from above: tracks, final positions by role, boxes there, over the city's upward
    faces shaded by height."""
    position, scored = dataset.uav_position.values, dataset.role.values != "object"
    shown = position[:, scored, :2]
    low, high = shown.min((0, 1)), shown.max((0, 1))
    margin = 0.35 * max(*(high - low), 40.0)
    if city is not None and city.num_faces:
        _footprints(ax, city, low - margin, high + margin)
    boxes = boxes_in(dataset)
    for u in range(dataset.sizes["uav"]):
        x, y = position[:, u, 0], position[:, u, 1]
        role, colour = str(dataset.role.values[u]), colour_of(u)
        ax.plot(x, y, color=colour)
        size = {"active": 11, "object": 3}.get(role, 6)
        ax.plot(x[-1], y[-1], ROLE_MARKERS[role], color=colour, ms=size, mec="white", mew=0.8)
        if u in boxes:
            ax.add_patch(footprint(boxes[u][-1], colour))
        facing = dataset.uav_attitude.values[-1, u, :2, 1]
        if role in TERMINAL_ROLES:
            ax.annotate(
                "",
                (x[-1] + 0.25 * margin * facing[0], y[-1] + 0.25 * margin * facing[1]),
                (x[-1], y[-1]),
                arrowprops={"arrowstyle": "->", "color": colour, "lw": 1},
            )
    for role, marker in ROLE_MARKERS.items():
        if role in dataset.role.values:
            label = f"{role} terminal, boresight" if role in TERMINAL_ROLES else role
            ax.plot([], [], marker, color="#606060", label=label)
    ax.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    ax.set_aspect("equal")
    ax.grid(False)
    labelled(ax, "east [m]", "north [m]")
    names = {u: str(dataset.uav.values[u]) for u in np.flatnonzero(scored).tolist()}
    _name(ax, position[-1, scored, :2], names)
    return ax


def footprint(corners: np.ndarray, colour: str) -> Polygon:
    """Return the outline from above of a box with some corners (8, 3)."""
    return Polygon(outline(corners), closed=True, fc=(colour, 0.4), ec=colour, lw=1.4)


def outline(corners: np.ndarray) -> np.ndarray:
    """Return the corners (K, 2) of the smallest convex figure about a box from above."""
    flat = corners[:, :2]
    return flat[ConvexHull(flat, qhull_options="QJ").vertices]


_BESIDE = np.array(
    [(x, y) for r in (1.0, 1.8, 2.6) for x in (r, -r, 0) for y in (r, -r, 0) if x or y]
)
"""Places of a name around its marker, the best first [letters]."""


def _name(ax: Axes, points: np.ndarray, names: Mapping[int, str]) -> None:
    """Write names, by the UAV's index, next to points (N, 2), each where it covers no other name
    and no marker."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()  # the layout decides where the points lie
    markers = ax.transData.transform(points)
    letter, placed = matplotlib.rcParams["font.size"] * figure.dpi / 72, list[Bbox]()
    style = {"fc": "white", "ec": "none", "alpha": 0.7, "boxstyle": "round,pad=0.1"}
    for u, name, point, here in zip(names, names.values(), points, markers, strict=True):
        size = np.array([0.8 * len(name), 1.2]) * letter
        corners = here + 0.8 * letter * _BESIDE - size * (1 - np.sign(_BESIDE)) / 2
        boxes = [Bbox([corner, corner + size]) for corner in corners]
        free = [
            box
            for box in boxes
            if box.count_overlaps(placed) == 0
            and not any(box.contains(*marker) for marker in markers)
            and ax.bbox.x0 <= box.x0 <= box.x1 <= ax.bbox.x1
        ]
        placed.append((free or boxes)[0])
        ax.annotate(
            name,
            point,
            xytext=(placed[-1].p0 - here) * 72 / figure.dpi,
            textcoords="offset points",
            fontweight="bold",
            color=colour_of(u),
            bbox=style,
        )


def _footprints(ax: Axes, city: CityMesh, low: np.ndarray, high: np.ndarray) -> None:
    """The faces between two places, shaded by their height among those of the whole city."""
    corners = city.corners + city.origin
    up = np.abs(city.normals[:, 2]) > 0.2
    triangles = corners[up]
    if not len(triangles):  # walls alone
        return
    height = triangles[:, :, 2].mean(axis=1)
    first, last = triangles[:, :, :2].min(axis=1), triangles[:, :, :2].max(axis=1)
    seen = np.flatnonzero(((last >= low) & (first <= high)).all(axis=1))
    order = seen[np.argsort(height[seen], kind="stable")]
    top = max(float(np.quantile(height, 0.98) - height.min()), 1.0)
    shade = 0.96 - 0.42 * np.clip((height - height.min()) / top, 0, 1)
    colours = np.repeat(shade[:, None], 3, axis=1)
    patches = PolyCollection(
        list(triangles[order][:, :, :2]),
        facecolors=colours[order],
        edgecolors="face",
        linewidths=0.6,
        zorder=0,
    )
    patches.set_rasterized(True)
    ax.add_collection(patches)


def over_time(ax: Axes, dataset: xr.Dataset, observer: int, name: str) -> Axes:
    """Truth (line), raw detections (dots) and tracks (thick) of every UAV over time; occluded
    intervals shaded in its colour."""
    scale, unit = _UNITS[name]
    here = _processed(dataset, observer)
    t = here("time")
    for u, uav in enumerate(dataset.uav.values):
        if uav == dataset.receiver.values[observer] or not here("in_view")[:, u].any():
            continue
        colour, seen = colour_of(u), here("in_view")[:, u]
        truth = np.where(seen, here(f"truth_{name}")[:, u] * scale, np.nan)
        ax.plot(t, truth, color=colour, lw=0.9, label=str(uav))
        ax.plot(t, here(f"detected_{name}")[:, u] * scale, ".", color=colour, ms=4, alpha=0.7)
        ax.plot(t, here(f"tracked_{name}")[:, u] * scale, color=colour, lw=3, alpha=0.45)
        _shade(ax, t, here("occluded")[:, u] & seen, colour)
    forms: dict[str, dict[str, Any]] = {
        "truth": {"lw": 0.9},
        "detection": {"marker": ".", "ls": "none"},
        "track": {"lw": 3, "alpha": 0.45},
    }
    if (here("occluded") & here("in_view")).any():
        forms["occluded"] = {"marker": "s", "ms": 7, "mew": 0, "ls": "none", "alpha": 0.2}
    for label, style in forms.items():
        ax.plot([], [], color="#606060", label=label, **style)
    first = name == "range"
    y = range_words(dataset, observer) if first else f"{name} [{unit}]"
    return labelled(ax, "time [s]", y, link_name(dataset, observer) if first else "")


def _processed(dataset: xr.Dataset, observer: int) -> Callable[[str], np.ndarray]:
    """Return the function that gives variables of one observer by name, in the frames that it
    processed: an active terminal may skip most. As arrays, since the dataset's own indexing loads
    dask."""
    frames = np.flatnonzero(dataset.processed.values[:, observer])

    @cache
    def values(name: str) -> np.ndarray:
        of_all = dataset[name].values
        return of_all[frames] if name == "time" else of_all[frames, observer]

    return values


def _shade(ax: Axes, t: np.ndarray, active: np.ndarray, colour: str) -> None:
    """Shade the intervals in which `active` holds, each frame with its half intervals."""
    half = float(np.median(np.diff(t))) / 2 if len(t) > 1 else 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        ax.axvspan(t[first] - half, t[last - 1] + half, color=colour, alpha=0.10, lw=0)


def error_cdf(ax: Axes, dataset: xr.Dataset, name: str, terminals: bool = False) -> Axes:
    """Distribution of the absolute errors of each link's estimates of targets, or of terminals,
    which report their position: detections dashed, tracks solid."""
    scale, unit = _UNITS[name]
    group = dataset.cooperative.values == terminals
    for o, link in enumerate(dataset.observer.values):
        for estimates, dash in (("detected", "--"), ("tracked", "-")):
            e = np.abs(errors_of(dataset, estimates, name)[:, o][group[:, o]]) * scale
            e = np.sort(e[np.isfinite(e) & (dataset.truth_range.values[:, o][group[:, o]] > 0)])
            if e.size:
                ax.plot(
                    np.maximum(e, 1e-9),
                    np.arange(1, e.size + 1) / e.size,
                    dash,
                    color=colour_of(o),
                    label=f"{link} {estimates} (n = {e.size})",
                )
    ax.set(xscale="log", ylim=(0, None), yticks=np.linspace(0, 1, 6))
    ax.xaxis.set_major_locator(LogLocator(numticks=_STEPS))
    ax.minorticks_off()  # they take longer to draw than the curves
    ax.xaxis.set_major_formatter("{x:g}")  # powers of ten are set as formulas
    return labelled(ax, f"|{name} error| [{unit}]", "share of errors below")


def carrier_of(dataset: xr.Dataset, observer: int) -> float:
    """Return the carrier of an observer's chirp [Hz]."""
    own = dataset.get("carrier_hz")
    return float(dataset.attrs["carrier_hz"] if own is None else own[observer])


def path_power(ax: Axes, dataset: xr.Dataset, observer: int, against: str) -> Axes:
    """Power of every path in the ledger of the snapshot frames against its path length ("delay") or
    rate ("doppler")."""
    mine = dataset.path_observer.values == observer
    x = (
        dataset.path_delay.values * SPEED_OF_LIGHT
        if against == "delay"
        else -carrier_of(dataset, observer) * dataset.path_delay_rate.values / 1e3
    )
    for k in (4, 3, 2, 5, 1, 0):
        at = mine & (dataset.path_kind.values == k)
        if at.any():
            name, many = KINDS[k], KINDS[k] == "diffuse"
            ax.plot(
                x[at],
                dataset.path_power_db.values[at],
                KIND_MARKERS[name],
                ms=2.5 if many else 5,
                ls="none",
                color=KIND_COLOURS[name],
                alpha=0.5 if many else 0.9,
                mew=0,
                label=f"{words(name)} ({at.sum()})",
            )
    delay, doppler = "path length [m]", "Doppler shift [kHz]"
    axis = delay if against == "delay" else doppler
    labelled(ax, axis, "path gain [dB]", link_name(dataset, observer))
    legend = ax.get_legend()
    for handle in legend.legend_handles if legend else ():
        assert handle is not None
        handle.set(markersize=5, alpha=1)
    return ax


def decoding(ax: Axes, dataset: xr.Dataset, observer: int) -> Axes:
    """Symbol error rates of every data frame; frames without a decision and occluded ones stand
    out."""
    t, total = dataset.time.values, dataset.symbol_total.values[:, observer]
    for s, colour, mark in ((0, "#0072B2", "o"), (1, "#D55E00", "s")):
        rate = np.divide(
            dataset.symbol_errors.values[:, observer, s],
            total[:, s],
            out=np.full(len(t), np.nan),
            where=total[:, s] > 0,
        )
        label = f"{'delay' if s == 0 else 'DPSK'} symbols"
        ax.plot(t, rate, f"{mark}-", ms=3, lw=0.8, color=colour, label=label)
    data = total[:, 0] > 0
    lost = data & ~dataset.decoded.values[:, observer]
    if lost.any():
        label = f"erased ({lost.sum()} of {data.sum()} frames)"
        ax.plot(t[lost], np.full(lost.sum(), 1.06), "x", color="#303030", ms=4, label=label)
    sender = list(dataset.uav.values).index(dataset.transmitter.values[observer])
    occluded = dataset.occluded.values[:, observer, sender]
    _shade(ax, t, occluded, "#303030")
    if occluded.any():
        label = f"{dataset.transmitter.values[observer]} occluded"
        ax.plot([], [], "s", color="#303030", alpha=0.2, ms=7, mew=0, label=label)
    ax.set(ylim=(-0.04, 1.14), yticks=(0, 0.5, 1))
    return labelled(ax, "time [s]", "symbol error rate", link_name(dataset, observer))


def reference_snr(ax: Axes, dataset: xr.Dataset) -> Axes:
    """SNR of the reference path of every terminal, per sample and antenna before processing."""
    for o, name in enumerate(dataset.observer.values):
        here = _processed(dataset, o)
        with np.errstate(divide="ignore", invalid="ignore"):
            snr = 10 * np.log10(here("reference_snr"))
        ax.plot(
            here("time"),
            np.where(np.isfinite(snr), snr, np.nan),
            ".-",
            ms=3,
            lw=1,
            color=colour_of(o),
            label=name,
        )
    return labelled(ax, "time [s]", "SNR [dB]", "Reference path")


def path_counts(ax: Axes, dataset: xr.Dataset, observer: int) -> Axes:
    """Power received by kind of path over time (all paths of a kind added)."""
    here = _processed(dataset, observer)
    power, count = here("path_power"), here("path_count")
    for k, name in enumerate(KINDS):
        shown = count[:, k] > 0
        if shown.any():
            level = np.where(shown, 10 * np.log10(np.maximum(power[:, k], 1e-300)), np.nan)
            ax.plot(
                here("time"),
                level,
                ".-",
                ms=3,
                lw=1,
                color=KIND_COLOURS[name],
                label=f"{words(name)} ({count[:, k].sum()})",
            )
    return labelled(ax, "time [s]", "path gain [dB]", f"{link_name(dataset, observer)}, by kind")


@dataclass(frozen=True)
class Style:
    """Style of figures for a medium.

    Attributes
    ----------
    width : of a figure [inch]
    columns : axes beside each other, at most
    height : of a row over that on a screen
    settings : of matplotlib, over `STYLE`
    """

    width: float
    columns: int
    height: float
    settings: Mapping[str, Any]


_PRINT = {
    "font.family": "serif",
    "axes.titlesize": 8,
    "lines.linewidth": 1.0,
    "pdf.fonttype": 42,
    "savefig.dpi": 300,
}
STYLES = {
    "screen": Style(8.4, 2, 1.0, {}),
    "wide": Style(7.16, 2, 0.8, _PRINT | {"font.size": 8, "legend.fontsize": 7}),
    "column": Style(3.5, 1, 0.7, _PRINT | {"font.size": 7, "legend.fontsize": 6}),
}
"""For a screen, for both columns of a page of a journal, and for one."""
FORMS = ("png", "svg", "pdf")


class Drawing(NamedTuple):
    """A figure to be: its name, what draws each axis, the height of a row [inch], how many axes
    stand beside each other, and whether all have one x axis, written below the last."""

    name: str
    axes: Sequence[Callable[[Axes], Any]]
    height: float
    columns: int = 1
    one_x: bool = False


def _figure(drawing: Drawing, style: Style) -> Figure:
    """The figure, row by row; outside pyplot, so that none stays open."""
    columns = min(drawing.columns, style.columns)
    rows = len(drawing.axes) // columns
    size = style.width, drawing.height * style.height * rows
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=drawing.one_x, sharey="row")
    for ax, drawn in zip(axes.flat, drawing.axes, strict=True):
        drawn(ax)
        for axis in (ax.xaxis, ax.yaxis):
            locator = axis.get_major_locator()
            if isinstance(locator, AutoLocator):
                locator.set_params(nbins=_STEPS)
    for (row, column), ax in np.ndenumerate(axes):
        if row < rows - 1 and drawing.one_x:
            ax.set_xlabel("")
        if column:
            ax.set_ylabel("")
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine(None)  # with one, saving draws everything twice
    return figure


def _maps(
    d: xr.Dataset, snapshot: int, name: str, function: Callable, height: float
) -> Iterator[Drawing]:
    """Maps of the terminals that have one; where profiles were made directly the data were never
    in."""
    values = d["map_power" if function is range_doppler else "map_equivalent_range"].values
    shown = np.flatnonzero(np.isfinite(values[snapshot]).any(axis=(1, 2)))
    draw = [partial(function, dataset=d, snapshot=snapshot, observer=o) for o in shown]
    if draw:
        yield Drawing(f"{name}_{moment(d, snapshot)[1]:04d}", draw, height)


def _all(d: xr.Dataset, city: CityMesh | None, every: bool) -> Iterator[Drawing]:
    """The figures of a run; the maps of `every` snapshot or of the middle one."""
    observers, snapshots = range(d.sizes["observer"]), d.sizes["snapshot"]
    yield Drawing("scene", [partial(scene_map, dataset=d, city=city)], 6.4)
    for s in range(snapshots) if every else [snapshots // 2][:snapshots]:
        yield from _maps(d, s, "range_doppler", range_doppler, 4.1)
    if snapshots and d.modulated.values.any():  # every frame shows the same
        yield from _maps(d, snapshots // 2, "equivalent_range", equivalent_range, 3.2)
    for o in observers:
        of = ("range", "velocity", "azimuth")
        label = str(d.observer.values[o]).replace("->", "_to_")
        yield Drawing(
            f"tracks_{label}",
            [partial(over_time, dataset=d, observer=o, name=m) for m in of],
            2.53,
            one_x=True,
        )
    for name, terminals in (("errors", False), ("errors_terminals", True)):
        draw = [partial(error_cdf, dataset=d, name=m, terminals=terminals) for m in MEASURES]
        if np.isfinite(d.detected_range.values[d.cooperative.values == terminals]).any():
            yield Drawing(name, draw, 3.5, 2)
    if d.sizes["path"]:
        draw = [
            partial(path_power, dataset=d, observer=o, against=against)
            for o in observers
            for against in ("delay", "doppler")
        ]
        yield Drawing("paths", draw, 3.3, 2)
    decoders = [o for o in observers if (d.symbol_total.values[:, o] > 0).any()]
    if decoders:
        draw = [partial(decoding, dataset=d, observer=o) for o in decoders]
        yield Drawing("decoding", draw, 2.8, one_x=True)
    counts = [partial(path_counts, dataset=d, observer=o) for o in observers]
    yield Drawing("link", [partial(reference_snr, dataset=d), *counts], 2.7, one_x=True)


def _written(
    drawings: Iterable[Drawing], folder: Path, form: str = "png", style: str = "screen"
) -> list[Path]:
    """The figures as files; each is made when the one before is written."""
    written = []
    with matplotlib.rc_context(STYLE | {**STYLES[style].settings, "svg.hashsalt": "isac_rt"}):
        for drawing in drawings:
            file = folder / f"{drawing.name}.{form}"
            write_figure(file, _figure(drawing, STYLES[style]))
            written.append(file)
    return written


def make_figures(results: Results, folder: str | Path, city: CityMesh | None = None) -> list[Path]:
    """Write all figures of a run as ``figures/*.png`` under `folder`; the scene shows the `city` if
    it is given, and of the range-Doppler maps there are those of the middle snapshot.

    Raises
    ------
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    return _written(_all(results.dataset, city, False), Path(folder) / "figures")


def redraw(results: Results, folder: Path, city: CityMesh, form: str, style: str) -> list[Path]:
    """Write all figures of a run, maps of every snapshot among them, into a folder in one of
    `FORMS` and one of `STYLES`.

    Raises
    ------
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    return _written(_all(results.dataset, city, True), folder, form, style)


def sweep_curves(
    ax: Axes, dataset: xr.Dataset, quantity: str, against: str, by: str | None = None
) -> Axes:
    """A quantity of a sweep against one of its axes, a curve for each link and each entry of the
    axis `by`.

    A rate (a quantity with bounds beside it) is pooled over the repetitions and drawn with its
    bounds, logarithmically if of errors; anything else is the mean over them. Of the axes that are
    neither of the two the first entry is taken.
    """
    rate = f"{quantity}_low" in dataset
    values = dataset[f"{quantity}_pooled"] if rate else dataset[quantity].mean("repetition")
    rest = {d: 0 for d in values.dims if d not in (against, by, "link")}
    values = values.isel(rest)
    x = values[against].values
    if x.dtype == object:
        x = np.arange(x.size)
    curve = 0
    for link in values.link.values:
        for entry in values[by].values if by else [None]:
            where = {"link": link} | ({by: entry} if by else {})
            y = values.sel(where).values
            if not np.isfinite(y).any():
                continue
            colour, label = colour_of(curve), f"{link}" + (f", {by} {entry}" if by else "")
            ax.plot(x, np.maximum(y, 1e-9) if rate else y, "o-", ms=3.5, color=colour, label=label)
            if rate:
                low, high = (
                    dataset[f"{quantity}_{end}"].isel(rest).sel(where).values
                    for end in ("low", "high")
                )
                ax.fill_between(x, np.maximum(low, 1e-9), high, color=colour, alpha=0.15, lw=0)
            curve += 1
    if rate and quantity.endswith("_rate"):
        ax.set(ylim=(0, 1.05))
    elif rate:
        positive = values.values[values.values > 0]
        ax.set(yscale="log", ylim=(0.5 * positive.min() if positive.size else 1e-4, 1.5))
    if values[against].dtype == object:
        ax.set_xticks(x, [str(v) for v in values[against].values])
    fixed = ", ".join(f"{d} {values[d].values}" for d in rest)
    return labelled(ax, f"{against} ({dataset.attrs[f'axis_{against}']})", words(quantity), fixed)


def make_sweep_figures(
    dataset: xr.Dataset, figures: Iterable[tuple[str, str, str | None]], folder: str | Path
) -> list[Path]:
    """Write (quantity, against, by) figures of a sweep as ``figures/*.png`` under `folder`."""
    drawings = (
        Drawing(
            "_".join(filter(None, (quantity, against, by))),
            [partial(sweep_curves, dataset=dataset, quantity=quantity, against=against, by=by)],
            4.4,
        )
        for quantity, against, by in figures
    )
    return _written(drawings, Path(folder) / "figures")
