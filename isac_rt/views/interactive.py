"""The city, the swarm and the paths of a frame as a scene to turn about: in a notebook, or as a
page that needs no network."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.runtime import needed
from isac_rt.storage import write_whole
from isac_rt.views.figures import KIND_COLOURS, colour_of, words
from isac_rt.views.moving_scene import ROLE_SYMBOLS, city_traces, layout
from isac_rt.views.render import polyline
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Swarm

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MOST_LINES = 400
"""Paths of one kind that are drawn, the strongest; thousands of scatterers would hide the rest."""


def scene_3d(
    city: CityMesh,
    swarm: Swarm,
    times: np.ndarray,
    time: float,
    paths: Mapping[Link, PathSet],
    reach: float = 150.0,
) -> Figure:
    """The scene as a Plotly figure; kinds of path and UAVs can be switched off in its legend.

    Parameters
    ----------
    times : along which tracks are drawn [s]
    time : of the swarm and the paths [s]
    reach : how far beyond the swarm the city is drawn [m]

    Raises
    ------
    isac_rt.runtime.MissingPackage  Without the package `plotly`.

    Examples
    --------
    >>> import isac_rt as irt
    >>> setup = irt.prepare(irt.load("scenes/paper_swarm_consistent.yaml"))
    >>> frame, when = setup.frame(0), setup.timetable.epoch(0)
    >>> figure = irt.scene_3d(
    ...     setup.city, setup.swarm, np.linspace(0, 1, 5), when, frame.paths
    ... )
    >>> len(figure.data) > len(setup.swarm.uavs)
    True
    """
    go = needed("plotly.graph_objects", "views")  # takes long to load

    figure = go.Figure()
    tracks = np.array([[pose.position for pose in swarm.poses(t).values()] for t in times])
    flat = tracks[..., :2]
    low, high = flat.min((0, 1)) - reach, flat.max((0, 1)) + reach
    figure.add_traces(city_traces(city, low, high))
    poses = swarm.poses(time)
    for kind in PathKind:
        lines, count = _lines(paths, kind, swarm, time)
        if count:
            colour = KIND_COLOURS[kind.name.lower()]
            figure.add_trace(
                go.Scatter3d(
                    x=lines[:, 0],
                    y=lines[:, 1],
                    z=lines[:, 2],
                    mode="lines",
                    line={"color": colour, "width": 3},
                    name=f"{words(kind.name.lower())} ({count})",
                    hoverinfo="skip",
                    visible="legendonly" if kind == PathKind.DIFFUSE else True,
                )
            )
    for u, (name, uav) in enumerate(swarm.uavs.items()):
        colour = colour_of(u)
        x, y, z = tracks[:, u].T
        figure.add_trace(
            go.Scatter3d(
                x=x,
                y=y,
                z=z,
                mode="lines",
                line={"color": colour, "width": 5},
                legendgroup=name,
                showlegend=False,
                name=name,
                hoverinfo="skip",
            )
        )
        here = poses[name].position
        figure.add_trace(
            go.Scatter3d(
                x=here[:1],
                y=here[1:2],
                z=here[2:],
                mode="markers+text",
                text=[name],
                textposition="top center",
                marker={"color": colour, "size": 6, "symbol": ROLE_SYMBOLS[uav.role]},
                legendgroup=name,
                name=f"{name}, {uav.role}",
            )
        )
    figure.update_layout(layout(low, high), template="plotly_white")
    return figure


def _lines(
    paths: Mapping[Link, PathSet], kind: PathKind, swarm: Swarm, time: float
) -> tuple[np.ndarray, int]:
    """The strongest paths of a kind, over all links, as one broken line (rows of NaN between them),
    and how many there are in all."""
    poses = swarm.poses(time)
    every = [
        (float(p.power[k]), p, int(k))
        for p in paths.values()
        for k in np.flatnonzero(p.kind == kind)
    ]
    drawn = sorted(every, key=lambda row: -row[0])[:MOST_LINES]
    gap = np.full((1, 3), np.nan)
    parts = [part for _, p, k in drawn for part in (polyline(p, k, poses), gap)]
    return (np.vstack(parts) if parts else np.zeros((0, 3))), len(every)


def write_page(figure: Figure, file: str | Path) -> None:
    """Write a Plotly figure as one HTML page that needs no network; it appears whole or not at all.

    Raises
    ------
    isac_rt.storage.StorageError  If the file cannot be written.
    """
    write_whole(file, figure.to_html(include_plotlyjs=True, full_html=True))
