"""The 3-D scene: city, flights and paths of a frame, or a finished run with a slider through its
frames, its tracks, its boxes and the paths of the frame whose ledger is nearest.

It is made as plain mappings, for plotly's own objects take longer to build than the page.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy.spatial import ConvexHull

from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.registry import extension
from isac_rt.results.dataset import fused_positions, tracked_states
from isac_rt.results.swarm import SWARM
from isac_rt.runtime import needed
from isac_rt.storage import write_whole
from isac_rt.views.style import KIND_COLOURS, colour_of, words
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose, Swarm

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

Trace = dict[str, Any]
MOST_STEPS = 120
"""Positions of the slider; of longer runs frames are left out evenly."""
MOST_LINES = 15
"""Paths of a kind that are drawn at a time of a run, the strongest."""
_MOST_OF_A_FRAME = 400
"""Paths of a kind that are drawn of a single frame, the strongest."""
CREASE = np.deg2rad(20.0)
"""Faces that meet at more than this have an edge drawn between them [rad]."""
ROLE_SYMBOLS = {
    "active": "diamond",
    "passive": "square",
    "target": "circle",
    "object": "diamond-open",
}
_AXES = "xyz"
_SHOWN = frozenset(
    "uav role uav_position observer track_observer track_frame track_confirmed owner fused_frame "
    "fused_owner fused_terminal fused_x fused_y fused_z box box_corner".split()
)
"""What changes from frame to frame, beside paths. A look-up by name takes the longer the more
variables a dataset has."""


def layout(low: np.ndarray, high: np.ndarray) -> dict[str, Any]:
    """Lay out a scene: metres alike on all axes, seen from the south-east; faces are cut to the
    rectangle from `low` to `high` (2,) [m]."""
    axes: dict[str, dict[str, Any]] = {
        f"{a}axis": {"title": {"text": title}}
        for a, title in zip(_AXES, ("east [m]", "north [m]", "up [m]"), strict=True)
    }
    for k in range(2):
        axes[f"{_AXES[k]}axis"]["range"] = [float(low[k]), float(high[k])]
    return {
        "scene": {
            "aspectmode": "data",
            "camera": {"eye": {"x": 0.7, "y": -0.9, "z": 0.6}},
            **axes,
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"x": 0.01, "y": 0.99},
    }


def lines_of(parts: Sequence[np.ndarray]) -> dict[str, list[float | None]]:
    """Polylines (N, 3) as one broken line, in centimetres' precision."""
    gap = np.full((1, 3), np.nan)
    every = np.vstack([a for part in parts for a in (part, gap)] or [np.zeros((0, 3))])
    return points_of(every)


def points_of(points: np.ndarray) -> dict[str, list[float | None]]:
    """Points (N, 3) by axis, in centimetres' precision; None where there is none."""
    rounded = np.round(points, 2)
    return {
        a: [None if v != v else v for v in column.tolist()]
        for a, column in zip(_AXES, rounded.T, strict=True)
    }


def city_traces(city: CityMesh, low: np.ndarray, high: np.ndarray) -> list[Trace]:
    """The faces that reach into a rectangle from `low` to `high` (2,) [m], lighter the higher, and
    the edges at which they meet."""
    import trimesh

    if not city.num_faces:
        return []
    corners = city.corners + city.origin
    flat = corners[..., :2]
    near = ((flat.max(axis=1) > low) & (flat.min(axis=1) < high)).all(axis=1)
    near = near if near.any() else np.ones_like(near)
    mesh = trimesh.Trimesh(corners[near].reshape(-1, 3), np.arange(3 * near.sum()).reshape(-1, 3))
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    creases = mesh.face_adjacency_edges[mesh.face_adjacency_angles > CREASE]
    open_edges = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    edges = mesh.vertices[np.vstack([creases, open_edges])]
    corner = dict(zip("ijk", mesh.faces.T.tolist(), strict=True))
    points = points_of(mesh.vertices)
    shading = {
        "intensity": points["z"],
        "colorscale": [[0, "#E4E2DC"], [1, "#8E9AA6"]],
        "showscale": False,
        "flatshading": True,
        "opacity": 0.3,  # paths and flights stay visible behind walls
        "lighting": {"ambient": 0.6, "diffuse": 0.7, "specular": 0.05},
    }
    return [
        {"type": "mesh3d", "name": "city", "showlegend": True, "hoverinfo": "skip"}
        | points
        | corner
        | shading,
        _line(lines_of(list(edges)), "#5F666D", 1.5, "edges"),
    ]


def _line(where: Mapping[str, Any], colour: str, width: float, name: str, **more: Any) -> Trace:
    line = {"color": colour, "width": width}
    kind = {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip", "name": name}
    return {**kind, "line": line, **where, **more}


def _uavs(names: Sequence[str], roles: Sequence[str], positions: np.ndarray) -> Trace:
    """Named markers of UAVs at places (U, 3) [m]."""
    marker = {
        "size": 6,
        "color": [colour_of(u) for u in range(len(names))],
        "symbol": [ROLE_SYMBOLS[role] for role in roles],
    }
    kind = {"type": "scatter3d", "mode": "markers+text", "name": "UAVs"}
    shown = ["" if role == "object" else n for n, role in zip(names, roles, strict=True)]
    return {**kind, "text": shown, "marker": marker, **points_of(positions)}


def boxes_in(dataset: xr.Dataset) -> dict[int, np.ndarray]:
    """Return the corners of the boxes of a run (F, V, 3) [m], by the UAV's index."""
    if "box" not in dataset.variables:
        return {}
    names, corners = dataset.uav.values.tolist(), dataset.box_corner.values
    return {names.index(name): corners[:, b] for b, name in enumerate(dataset.box.values)}


def boxes_of(swarm: Swarm, time: float) -> dict[int, np.ndarray]:
    """Return the corners of a swarm's boxes (V, 3) [m] at a time [s], by the UAV's index."""
    names, corners = list(swarm.uavs), extension("box_corners")(swarm, [time])
    return {names.index(name): of_one[0] for name, of_one in corners.items()}


def _boxes(corners: Mapping[int, np.ndarray]) -> Trace:
    """Boxes (V, 3) [m] by the UAV's index."""
    faces = [ConvexHull(box).simplices for box in corners.values()]
    first = np.cumsum([0, *map(len, corners.values())])
    every = np.concatenate([f + start for f, start in zip(faces, first, strict=False)])
    return {
        "type": "mesh3d",
        "name": "boxes",
        "hoverinfo": "skip",
        "flatshading": True,
        "showlegend": True,
        "facecolor": [colour_of(u) for u, of in zip(corners, faces, strict=True) for _ in of],
        **points_of(np.concatenate([*corners.values()])),
        **dict(zip("ijk", every.T.tolist(), strict=True)),
    }


def _fixed(
    city: CityMesh, names: Sequence[str], flights: np.ndarray, reach: float
) -> tuple[list[Trace], dict[str, Any]]:
    """The traces of the city and of flights (T, U, 3) [m], and the layout around them."""
    low, high = flights[..., :2].min((0, 1)) - reach, flights[..., :2].max((0, 1)) + reach
    traces = city_traces(city, low, high) + [
        _line(points_of(flights[:, u]), colour_of(u), 4, f"{name}, flight", showlegend=False)
        for u, name in enumerate(names)
    ]
    return traces, layout(low, high)


def polyline(p: PathSet, k: int, poses: Mapping[str, Pose]) -> np.ndarray:
    """Corners of a path from transmitter to receiver, its UAV included."""
    inner = p.points[k][np.isfinite(p.points[k]).all(axis=1)]
    if not inner.size and p.target[k] >= 0:
        inner = poses[p.target_names[p.target[k]]].position[None]
    return np.vstack([poses[p.tx].position, inner, poses[p.rx].position])


def strongest(
    paths: Mapping[Link, PathSet], kind: PathKind, poses: Mapping[str, Pose], most: int
) -> tuple[list[np.ndarray], int]:
    """The strongest paths of a kind over all links as polylines, and how many there are in all."""
    every = [
        (-float(p.power[k]), p, int(k))
        for p in paths.values()
        for k in np.flatnonzero(p.kind == kind)
    ]
    drawn = sorted(every, key=lambda row: row[0])[:most]
    return [polyline(p, k, poses) for _, p, k in drawn], len(every)


def path_lines(dataset: xr.Dataset, rows: np.ndarray, most: int) -> Iterator[np.ndarray]:
    """(N, 3) transmitter, points and receiver [m] of the strongest paths among rows of the
    ledger; leakage has no line."""
    names, kind = list(dataset.uav.values), dataset.path_kind.values
    frames, observers = dataset.path_frame.values, dataset.path_observer.values
    positions, along = dataset.uav_position.values, dataset.path_points.values
    ends = [
        [names.index(end) for end in dataset[side].values] for side in ("transmitter", "receiver")
    ]
    rows = rows[kind[rows] != list(dataset.kind.values).index("leakage")]
    for k in rows[np.argsort(-dataset.path_power_db.values[rows], kind="stable")][:most]:
        tx, rx = (positions[frames[k], end[observers[k]]] for end in ends)
        points = along[k]
        yield np.vstack([tx, points[np.isfinite(points).all(axis=1)], rx])


def scene_3d(
    city: CityMesh,
    swarm: Swarm,
    times: np.ndarray,
    time: float,
    paths: Mapping[Link, PathSet],
    reach: float = 150.0,
) -> Figure:
    """The scene as a Plotly figure; kinds of path can be switched off in its legend.

    Parameters
    ----------
    times : along which flights are drawn [s]
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
    names, poses = list(swarm.uavs), swarm.poses(time)
    flights = np.array([[pose.position for pose in swarm.poses(t).values()] for t in times])
    traces, around = _fixed(city, names, flights, reach)
    for kind in PathKind:
        lines, count = strongest(paths, kind, poses, _MOST_OF_A_FRAME)
        if count and kind != PathKind.LEAKAGE:
            name = kind.name.lower()
            shown = {"visible": "legendonly"} if kind == PathKind.DIFFUSE else {}
            label = f"{words(name)} ({count})"
            traces.append(_line(lines_of(lines), KIND_COLOURS[name], 3, label, **shown))
    roles = [uav.role for uav in swarm.uavs.values()]
    if boxes := boxes_of(swarm, time):
        traces.append(_boxes(boxes))
    traces.append(_uavs(names, roles, np.array([poses[name].position for name in names])))
    return go.Figure(traces, around | {"template": "plotly_white"})


def write_page(figure: Figure, file: str | Path) -> None:
    """Write a Plotly figure as one HTML page that needs no network; it appears whole or not at all.

    Raises
    ------
    isac_rt.storage.StorageError  If the file cannot be written.
    """
    write_whole(file, figure.to_html(include_plotlyjs=True, full_html=True))


def moving_scene(dataset: xr.Dataset, city: CityMesh, reach: float = 120.0) -> dict[str, Any]:
    """The scene as plotly's figure: data, layout and a frame for each position of the slider.

    Parameters
    ----------
    reach : how far beyond the swarm the city is drawn [m]
    """
    names = [str(name) for name in dataset.uav.values]
    fixed, around = _fixed(city, names, dataset.uav_position.values, reach)
    count = dataset.sizes["frame"]
    steps = np.unique(np.linspace(0, max(count - 1, 0), min(count, MOST_STEPS)).round().astype(int))
    moving = _Moving(dataset)
    frames = [moving.at(int(f)) for f in steps]
    traces = list(range(len(fixed), len(fixed) + len(moving.names)))
    numbers = [str(int(dataset.frame.values[f])) for f in steps]
    start = frames[0] if frames else []
    return {
        "data": fixed + start,
        "layout": around | (_controls(dataset, steps, numbers) if len(steps) > 1 else {}),
        "frames": [
            {"name": name, "data": data, "traces": traces}
            for name, data in zip(numbers, frames, strict=True)
        ],
    }


class _Moving:
    """The traces that change from frame to frame: UAVs, tracks of each observer, fused tracks of
    cooperating terminals, paths by kind."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._d = dataset[[str(name) for name in dataset.variables if name in _SHOWN]]
        self._states, self._boxes = tracked_states(dataset)[:, :3], boxes_in(dataset)
        shown = np.unique(dataset.path_kind.values)
        kinds = dataset.kind.values
        self._kinds = [int(k) for k in shown if kinds[k] not in ("diffuse", "leakage")]
        self._kept = np.unique(dataset.path_frame.values)
        together = "owner" in dataset.variables
        self._owners = [str(name) for name in dataset.owner.values] if together else []
        self.names = [
            "UAVs",
            *(["boxes"] if self._boxes else []),
            *(f"tracks of {observer}" for observer in dataset.observer.values),
            *(f"fused tracks of {'the ' * (name == SWARM)}{name}" for name in self._owners),
            *(f"{words(kinds[k])} paths" for k in self._kinds),
        ]
        self._paths = {int(kept): self._paths_of(dataset, int(kept)) for kept in self._kept}

    def at(self, frame: int) -> list[Trace]:
        """The traces in a frame."""
        d = self._d
        mark = {"type": "scatter3d", "mode": "markers"}
        uavs = _uavs(d.uav.values.tolist(), d.role.values.tolist(), d.uav_position.values[frame])
        tracks = [
            {
                **mark,
                "marker": {"size": 4, "symbol": "x", "color": colour_of(o)},
                **points_of(self._states[self._of("track", frame, o) & d.track_confirmed.values]),
            }
            for o in range(d.sizes["observer"])
        ]
        fused = [
            {**mark, "marker": self._mark(name), **points_of(fused_positions(d, frame, name))}
            for name in self._owners
        ]
        nearest = self._kept[np.argmin(np.abs(self._kept - frame))] if self._kept.size else -1
        boxes = [_boxes({u: c[frame] for u, c in self._boxes.items()})] if self._boxes else []
        traces = [uavs, *boxes, *tracks, *fused, *self._paths.get(int(nearest), [])]
        return [trace | {"name": n} for trace, n in zip(traces, self.names, strict=True)]

    def _mark(self, name: str) -> dict[str, Any]:
        """Return the markers of targets."""
        if name == SWARM:
            return {"size": 9, "symbol": "diamond-open", "color": "black"}
        uav = self._d.uav.values.tolist().index(name)
        return {"size": 6, "symbol": "square-open", "color": colour_of(uav)}

    def _of(self, rows: str, frame: int, observer: int) -> np.ndarray:
        mine = self._d[f"{rows}_observer"].values == observer
        return np.asarray(mine & (self._d[f"{rows}_frame"].values == frame))

    def _paths_of(self, dataset: xr.Dataset, kept: int) -> list[Trace]:
        """The paths of a frame whose ledger is kept, by kind."""
        kind, here = dataset.path_kind.values, dataset.path_frame.values == kept
        return [
            _line(
                lines_of(list(path_lines(dataset, np.flatnonzero(here & (kind == k)), MOST_LINES))),
                KIND_COLOURS[dataset.kind.values[k]],
                2,
                "",
            )
            for k in self._kinds
        ]


def _controls(dataset: xr.Dataset, steps: np.ndarray, names: list[str]) -> dict[str, Any]:
    """A slider of time and a button that plays."""
    now = {"mode": "immediate", "transition": {"duration": 0}}
    still = now | {"frame": {"duration": 0, "redraw": True}}
    play = now | {"frame": {"duration": 150, "redraw": True}, "fromcurrent": True}
    times = [f"{dataset.time.values[f]:.2f}" for f in steps]
    return {
        "sliders": [
            {
                "steps": [
                    {"method": "animate", "label": time, "args": [[name], still]}
                    for time, name in zip(times, names, strict=True)
                ],
                "currentvalue": {"prefix": "time [s]: "},
                "x": 0.12,
                "len": 0.86,
                "pad": {"t": 0, "b": 10},
            }
        ],
        "updatemenus": [
            {
                "type": "buttons",
                "direction": "left",
                "x": 0.1,
                "xanchor": "right",
                "y": 0,
                "yanchor": "top",
                "pad": {"t": 20},
                "buttons": [
                    {"method": "animate", "label": "play", "args": [None, play]},
                    {"method": "animate", "label": "stop", "args": [[None], still]},
                ],
            }
        ],
    }


def page_part(figure: Mapping[str, Any], name: str) -> str:
    """Return HTML that shows a figure and fetches nothing: plotly's own script, then the figure.

    Raises
    ------
    isac_rt.runtime.MissingPackage  Without the package `plotly`.
    """
    needed("plotly", "views")
    script = files("plotly").joinpath("package_data/plotly.min.js").read_text(encoding="utf-8")
    drawn = json.dumps(figure, separators=(",", ":")).replace("</", "<\\/")
    return (
        f"<script>{script}</script>\n"
        f'<div id="{name}"></div>\n<script>const {name} = {drawn};\n'
        f"if (innerWidth < 700) {{ const at = {name}.layout; at.showlegend = false;\n"
        "if (at.sliders) { Object.assign(at.updatemenus[0], {x: 0, xanchor: 'left'});\n"
        "Object.assign(at.sliders[0], {x: 0.35, len: 0.63}); }\n"
        "const eye = at.scene.camera.eye; for (const k in eye) eye[k] *= 1.6; }\n"  # for phones
        f'Plotly.newPlot("{name}", {name}.data, {name}.layout, {{responsive: true}})'
        f'.then(() => Plotly.addFrames("{name}", {name}.frames));</script>'
    )
