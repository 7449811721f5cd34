"""A picture of a scene: the city in an oblique parallel projection with depth, sun and shadows, and
over it the swarm and the paths.

The mesh is drawn with a depth buffer of its own, so that what buildings hide of the tracks and
paths can be drawn faintly, and so that no ray tracer is needed for a look at a city.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from isac_rt.extensions.street.solid import FLAT, solid_of
from isac_rt.frame.link import Link
from isac_rt.kernels import views_raster
from isac_rt.kernels.jit import twin_of
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.results.files import write_figure
from isac_rt.views.figures import outline
from isac_rt.views.scene import boxes_of, strongest
from isac_rt.views.style import KIND_COLOURS, ROLE_MARKERS, colour_of, words
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.passage import hits
from isac_rt.world.swarm import Pose, Swarm

ELEVATION = np.deg2rad(38.0)
"""Angle of the view above the horizon [rad]."""
SUN = np.array([-0.45, -0.35, 0.82]) / np.linalg.norm([-0.45, -0.35, 0.82])
_SKY, _GROUND, _ROOF, _WALL = (
    np.array(c) / 255 for c in ((236, 241, 246), (222, 220, 212), (214, 190, 170), (226, 224, 220))
)
FAR_DOWN_M = 1e4
"""The ground is looked for so far below."""
Below = Callable[[np.ndarray], float]
_SUPERSAMPLING = 2
_LINES_PER_KIND = 80
_OCCLUDED_ALPHA = 0.18
_PIECES = 48


@dataclass(frozen=True)
class View:
    """An oblique parallel projection.

    Attributes
    ----------
    axes : (3, 3) rows right, up and away of the picture in world axes
    centre : (3,) world point at the middle of the picture [m]
    half : half width and half height of the picture [m]
    """

    axes: np.ndarray
    centre: np.ndarray
    half: tuple[float, float]

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) as (right, up, depth) [m]; depth grows away from the viewer."""
        return (points - self.centre) @ self.axes.T

    def pixels(self, points: np.ndarray, width: int, height: int) -> np.ndarray:
        """World points (..., 3) as (column, row, depth) of a picture, row 0 at the bottom."""
        p = self.project(points)
        p[..., 0] = (p[..., 0] / self.half[0] + 1) * width / 2
        p[..., 1] = (p[..., 1] / self.half[1] + 1) * height / 2
        return p


def view_from(
    azimuth: float, elevation: float, centre: np.ndarray, half: tuple[float, float]
) -> View:
    """The view of somebody who stands towards `azimuth` (from north to east) at `elevation` [rad]
    and looks at `centre`."""
    away = -np.array(
        [
            np.cos(elevation) * np.sin(azimuth),
            np.cos(elevation) * np.cos(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.cross(away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return View(np.stack([right, np.cross(right, away), away]), centre, half)


@twin_of(views_raster.rasterise)
def rasterise(corners: np.ndarray, depth: np.ndarray, face: np.ndarray) -> None:
    """Draw triangles into a depth buffer; a pixel belongs to a triangle if its middle does.

    Parameters
    ----------
    corners : (F, 3, 3) column and row [pixels] and depth [m] of the corners
    depth : (height, width) [m], lowered where a triangle is nearer
    face : (height, width) number of the nearest triangle, set there
    """
    rows, columns = (np.arange(size) + 0.5 for size in depth.shape)
    for f, ((ax, ay, az), (bx, by, bz), (cx, cy, cz)) in enumerate(corners):
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0:
            continue
        x = columns[(columns >= min(ax, bx, cx)) & (columns <= max(ax, bx, cx))]
        y = rows[(rows >= min(ay, by, cy)) & (rows <= max(ay, by, cy))][:, None]
        box = np.ix_((y[:, 0] - 0.5).astype(int), (x - 0.5).astype(int))
        b = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area  # barycentric coordinates
        c = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
        z = az + b * (bz - az) + c * (cz - az)
        nearer = (b >= 0) & (c >= 0) & (b + c <= 1) & (z < depth[box])
        depth[box] = np.where(nearer, z, depth[box])
        face[box] = np.where(nearer, f, face[box])


def depth_buffer(
    corners: np.ndarray, view: View, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [m] (height, width), inf where there is nothing, and the face seen, -1 there; row 0 is
    the bottom.

    Parameters
    ----------
    corners : (F, 3, 3) triangles in world coordinates [m]
    """
    pixels = view.pixels(corners, width, height)
    depth, face = np.full((height, width), np.inf), np.full((height, width), -1, np.int32)
    rasterise(pixels, depth, face)
    return depth, face


def is_masked(points: np.ndarray, view: View, depth: np.ndarray, slack: float = 0.6) -> np.ndarray:
    """Return whether world points (..., 3) lie more than `slack` [m] behind the surface in the
    depth buffer."""
    height, width = depth.shape
    p = view.pixels(points, width, height)
    column = np.clip(p[..., 0].astype(int), 0, width - 1)
    row = np.clip(p[..., 1].astype(int), 0, height - 1)
    return p[..., 2] > depth[row, column] + slack


def shade(city: CityMesh, view: View, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Picture (height, width, 3) of the city in [0, 1] and its depth buffer; row 0 is the
    bottom."""
    corners = city.corners + city.origin
    depth, face = depth_buffer(corners, view, width, height)
    image = np.tile(_SKY, (height, width, 1))
    if not city.num_faces:
        return image, depth
    seen = face >= 0
    normal = city.normals[face]
    normal = normal * np.where(np.sum(normal * view.axes[2], axis=-1, keepdims=True) > 0, -1.0, 1.0)
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = (np.arange(height) + 0.5) / height * 2 - 1
    flat = np.stack(
        [*np.meshgrid(x * view.half[0], y * view.half[1]), np.where(seen, depth, 0.0)], axis=-1
    )
    points = flat @ view.axes + view.centre
    reach = float(np.hypot(*view.half)) * 2
    sun = view_from(np.arctan2(SUN[0], SUN[1]), np.arcsin(SUN[2]), view.centre, (reach, reach))
    cast, _ = depth_buffer(corners, sun, 2048, 2048)
    lit = ~is_masked(points, sun, cast, slack=4 * reach / 2048 + 0.1)
    floor = float(np.quantile(corners[..., 2], 0.02)) + 1.0
    level = normal[..., 2:] > 0.9
    base = np.where(
        level & (points[..., 2:] < floor), _GROUND, np.where(normal[..., 2:] > 0.25, _ROOF, _WALL)
    )
    light = (
        0.66
        + 0.06 * normal[..., 2]
        + 0.07 * (normal @ view.axes[0])
        + 0.28 * np.clip(normal @ SUN, 0, 1) * lit
    )
    step = np.abs(np.diff(np.where(seen, depth, 1e4), axis=1, prepend=1e4)) + np.abs(
        np.diff(np.where(seen, depth, 1e4), axis=0, prepend=1e4)
    )
    curvature = np.linalg.norm(np.diff(normal, axis=1, prepend=0), axis=-1) + np.linalg.norm(
        np.diff(normal, axis=0, prepend=0), axis=-1
    )
    edge = np.where((step > 3.0 + 8 * view.half[0] / width) | (curvature > 0.5), 0.72, 1.0)
    image[seen] = (base * (light * edge)[..., None])[seen]
    return image, depth


def best_view(city: CityMesh, tracks: np.ndarray, aspect: float) -> View:
    """The one of sixteen views from which the city hides least of the `tracks` (..., 3)
    [m]."""
    low, high = tracks.reshape(-1, 3).min(axis=0), tracks.reshape(-1, 3).max(axis=0)
    centre = (low + high) / 2
    half = 0.78 * max(float(np.linalg.norm(high - low)), 65.0)
    corners = city.corners + city.origin
    views = [
        view_from(a, ELEVATION, centre, (half, half / aspect))
        for a in np.arange(16) * np.pi / 8 + 0.2
    ]
    return min(
        views,
        key=lambda v: is_masked(
            tracks, v, depth_buffer(corners, v, 320, int(320 / aspect))[0]
        ).mean(),
    )


@dataclass(frozen=True)
class _Picture:
    """Axes over a shaded city, whose depth buffer says what is hidden."""

    ax: Axes
    view: View
    depth: np.ndarray

    def line(self, corners: np.ndarray, colour: str, width: float, alpha: float = 1.0) -> None:
        """A polyline (n, 3), faint where it is hidden."""
        s = np.linspace(0, len(corners) - 1, _PIECES * (len(corners) - 1) + 1)
        columns = [np.interp(s, np.arange(len(corners)), c) for c in corners.T]
        points = np.stack(columns, axis=1)
        flat = self.view.project(points)[:, :2]
        occluded = is_masked((points[1:] + points[:-1]) / 2, self.view, self.depth)
        pieces = list(np.stack([flat[:-1], flat[1:]], axis=1))
        shown = np.where(occluded, _OCCLUDED_ALPHA, 1.0) * alpha
        self.ax.add_collection(LineCollection(pieces, colors=colour, linewidths=width, alpha=shown))

    def paths(self, paths: Mapping[Link, PathSet], poses: Mapping[str, Pose]) -> list[Line2D]:
        """Every kind in its colour: the scattering points of diffuse paths, the strongest of the
        others as lines. Returns the legend."""
        count = dict.fromkeys(PathKind, 0)
        for kind in sorted(PathKind, reverse=True):  # straight paths last, over the many others
            colour = KIND_COLOURS[kind.name.lower()]
            lines, count[kind] = strongest(paths, kind, poses, _LINES_PER_KIND)
            if kind == PathKind.DIFFUSE and lines:
                points = np.concatenate(
                    [p.points[p.kind == kind].reshape(-1, 3) for p in paths.values()]
                )
                points = points[np.isfinite(points).all(axis=1)]
                points = points[~is_masked(points, self.view, self.depth)]
                x, y = self.view.project(points)[:, :2].T
                self.ax.plot(x, y, ".", color=colour, ms=2.6, alpha=0.8, mew=0)
            elif kind != PathKind.LEAKAGE:
                width = 1.8 if kind in (PathKind.LINE_OF_SIGHT, PathKind.TARGET) else 1.0
                for line in lines:
                    self.line(line, colour, width, 0.85)
        return [
            Line2D([], [], color=KIND_COLOURS[name], label=f"{words(name)} ({count[kind]})")
            for kind in PathKind
            if count[kind] and kind != PathKind.LEAKAGE
            for name in [kind.name.lower()]
        ]

    def boxes(self, corners: Mapping[int, np.ndarray]) -> None:
        """The sides of boxes (V, 3), by the UAV's index, that look here, the farthest first."""
        for u, box in sorted(corners.items(), key=lambda one: -self.view.project(one[1])[0, 2]):
            alpha = _OCCLUDED_ALPHA if is_masked(box.mean(axis=0), self.view, self.depth) else 0.9
            colour, solid = colour_of(u), solid_of(box)
            for k in np.flatnonzero(solid.planes[:, :3] @ self.view.axes[2] < 0):
                rim = self.view.project(box[np.abs(solid.depths(box)[:, k]) <= FLAT])
                side = Polygon(outline(rim), fc=colour, ec="white", lw=0.7, alpha=alpha, zorder=7)
                self.ax.add_patch(side)

    def swarm(self, swarm: Swarm, times: np.ndarray, time: float, below: Below) -> list[Line2D]:
        """Tracks, plumb lines to the ground, and a named marker where each UAV is at `time`.
        Returns the legend."""
        poses, legend = swarm.poses(time), []
        for u, (name, uav) in enumerate(swarm.uavs.items()):
            colour, marker, here = colour_of(u), ROLE_MARKERS[uav.role], poses[name].position
            track = swarm.trajectories[name]
            self.line(np.array([track.pose(t).position for t in times]), colour, 2.2)
            foot = self.view.project(np.stack([here, [here[0], here[1], below(here)]]))
            self.ax.plot(foot[:, 0], foot[:, 1], ":", color="#404040", lw=0.8, alpha=0.7)
            big, edge = {"active": 15, "object": 4}.get(uav.role, 8), "white"
            x, y = foot[0, :2]
            self.ax.plot(x, y, marker, color=colour, ms=big, mec=edge, mew=1.1, zorder=8)
            if uav.role == "object":
                continue
            self.ax.annotate(
                name,
                (x, y),
                xytext=(8, 7),
                textcoords="offset points",
                color=colour,
                fontweight="bold",
                fontsize=10,
                zorder=9,
                bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
            )
            label = f"{name}, {uav.role}"
            legend.append(Line2D([], [], color=colour, marker=marker, ls="none", label=label))
        return legend


def view_scene(
    city: CityMesh,
    swarm: Swarm,
    times: np.ndarray,
    time: float,
    paths: Mapping[Link, PathSet],
    width: int = 1500,
    height: int = 940,
) -> Figure:
    """The city, the swarm at `time` with its tracks over `times` [s], and the `paths` of that
    moment."""
    scored = [name for name, uav in swarm.uavs.items() if uav.role != "object"]
    poses = [swarm.poses(t) for t in times]
    tracks = np.array([[of[name].position for name in scored] for of in poses])
    view = best_view(city, tracks, width / height)
    image, depth = shade(city, view, width * _SUPERSAMPLING, height * _SUPERSAMPLING)
    image = image.reshape(height, _SUPERSAMPLING, width, _SUPERSAMPLING, 3).mean(axis=(1, 3))
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    ax = figure.add_axes((0, 0, 1, 1))
    extent = (-view.half[0], view.half[0], -view.half[1], view.half[1])
    ax.imshow(np.clip(image, 0, 1), origin="lower", extent=extent, interpolation="antialiased")
    drawn = _Picture(ax, view, depth)
    legend = drawn.paths(paths, swarm.poses(time))
    drawn.boxes(boxes_of(swarm, time))
    level = float(tracks[..., 2].min() - 10)

    def below(point: np.ndarray) -> float:
        far = np.array([0.0, 0.0, FAR_DOWN_M])
        _, share = hits(city.corners, point - city.origin, point - city.origin - far)
        return float(point[2] - share.min() * FAR_DOWN_M) if share.size else level

    legend = drawn.swarm(swarm, times, time, below) + legend
    ax.legend(
        handles=legend,
        loc="upper left",
        fontsize=9,
        framealpha=0.85,
        edgecolor="none",
        facecolor="white",
    )
    bar = 10.0 ** np.floor(np.log10(view.half[0] * 0.6))
    left, low = -0.95 * view.half[0], -0.93 * view.half[1]
    ax.plot([left, left + bar], [low, low], color="#202020", lw=3)
    ax.text(left, low + 0.02 * view.half[1], f"{bar:g} m", fontsize=9)
    ax.set(xlim=extent[:2], ylim=extent[2:])
    ax.set_axis_off()
    return figure


def write_view(figure: Figure, file: str | Path) -> None:
    """Save a picture as PNG, whole or not at all.

    Raises
    ------
    isac_rt.storage.StorageError  If the file cannot be written.
    """
    write_figure(Path(file), figure)
