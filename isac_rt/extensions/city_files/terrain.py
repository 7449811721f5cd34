"""The ground that a city stands on: the relief of its file, a raster of heights, or what is made
through the feet of its buildings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isac_rt.extensions.city_files.cityjson import BUILDING_TYPES, Solid
from isac_rt.world.city.files import needs_extra, read_bytes
from isac_rt.world.city.georeference import GeoReference
from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface
from isac_rt.world.city.prism import ground

FLAT_M = 5.0
"""Feet of nine of ten buildings within this are on flat ground: one plane reflects as a plane."""
_NODES = 128
"""Of a raster of heights along the longer side: 32,000 triangles."""
MAX_CELLS, MAX_BLOCK_BYTES = 250_000_000, 2**28
"""Of a raster's part about the city, and of one of its blocks: each is unpacked as a whole."""
_RIM = 16
"""Points on each side of a ground that is made through feet."""
_NEAREST = 6
"""So many points of a relief are asked for the height under a corner; the lowest counts."""
STANDS_ON_M = 0.5
"""A part whose foot is so far above that of another under it stands on that, not on the ground."""


@dataclass(frozen=True)
class Ground:
    """A ground: its surface, None where the file brings it, and its height [m] at points (N, 2)."""

    surface: Surface | None
    height: Callable[[NDArray[np.float64]], NDArray[np.float64]]

    def under(self, points: NDArray[np.float64]) -> float:
        """Lowest height under points (N, 2). [m]"""
        return float(self.height(points).min())


@dataclass(frozen=True)
class Plan:
    """Where a ground is wanted: corners (2,) of what stands on it and the margin about it [m], and
    its material."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    margin: float
    material: MaterialUse

    def rim(self, count: int) -> NDArray[np.float64]:
        """(4 count, 2) points around it."""
        (x_0, y_0), (x_1, y_1) = self.low - self.margin, self.high + self.margin
        share = np.arange(count) / count
        x, y = x_0 + share * (x_1 - x_0), y_0 + share * (y_1 - y_0)
        sides = [(x, np.full(count, y_0)), (np.full(count, x_1), y)]
        sides += [(x_1 + x_0 - x, np.full(count, y_1)), (np.full(count, x_0), y_1 + y_0 - y)]
        return np.concatenate([np.column_stack(side) for side in sides])


def flat(plan: Plan, level: float) -> Ground:
    """A plane at a height [m]."""
    surface = ground(plan.low, plan.high, plan.margin, level, plan.material)
    return Ground(surface, lambda points: np.full(len(points), level))


def through_feet(plan: Plan, feet: NDArray[np.float64], notes: list[str]) -> Ground:
    """A ground through points (N, 3) on which buildings stand: a plane at their height where they
    are nearly level, else triangles between them."""
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import Delaunay, cKDTree

    low, high = np.quantile(feet[:, 2], [0.05, 0.95], method="nearest")
    if high - low <= FLAT_M or len(feet) < 3:
        return flat(plan, float(low))
    rim = plan.rim(_RIM)
    _, nearest = cKDTree(feet[:, :2]).query(rim)
    points = np.concatenate([feet, np.column_stack([rim, feet[nearest, 2]])])
    _, first = np.unique(np.round(points[:, :2], 2), axis=0, return_index=True)
    points = points[np.sort(first)]
    net = Delaunay(points[:, :2])
    between = LinearNDInterpolator(net, points[:, 2])
    lowest = float(points[:, 2].min())
    notes.append(
        f"ground made through the feet of {len(feet)} buildings, {lowest:.0f} to "
        f"{points[:, 2].max():.0f} m high; city.terrain takes a GeoTIFF of heights"
    )
    return Ground(
        Surface(points, _upward(points, net.simplices), plan.material),
        lambda at: np.nan_to_num(between(at), nan=lowest),
    )


def _upward(points: NDArray[np.float64], triangles: NDArray) -> NDArray[np.int64]:
    """Triangles turned so that they face up."""
    out = np.array(triangles, dtype=np.int64)
    a, b, c = np.moveaxis(points[out][:, :, :2], 1, 0)
    down = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    out[down] = out[down][:, ::-1]
    return out


def of_relief(solids: Sequence[Solid]) -> Ground:
    """The relief that the file brings."""
    from scipy.spatial import cKDTree

    points = np.concatenate([solid.vertices for solid in solids])
    tree = cKDTree(points[:, :2])

    def height(at: NDArray[np.float64]) -> NDArray[np.float64]:
        _, nearest = tree.query(at, k=min(_NEAREST, len(points)))
        return np.asarray(points[nearest.reshape(len(at), -1), 2].min(axis=1))

    return Ground(None, height)


def of_raster(plan: Plan, path: Path, geo: GeoReference, notes: list[str]) -> Ground:
    """Heights from a GeoTIFF, in the coordinates of the world.

    Raises
    ------
    CityError  If it is none, says not where it lies, or lies elsewhere.
    """
    from scipy.ndimage import map_coordinates

    (x_0, y_0), (x_1, y_1) = plan.low - plan.margin, plan.high + plan.margin
    step = max(x_1 - x_0, y_1 - y_0, 1.0) / (_NODES - 1)
    x = np.linspace(x_0, x_1, max(2, round((x_1 - x_0) / step) + 1))
    y = np.linspace(y_0, y_1, max(2, round((y_1 - y_0) / step) + 1))
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    z = _sampled(path, nodes, geo, notes) - geo.origin[2]
    grid = z.reshape(len(x), len(y))

    def height(at: NDArray[np.float64]) -> NDArray[np.float64]:
        cells = (at - [x_0, y_0]) / [x[1] - x[0], y[1] - y[0]]
        return np.asarray(map_coordinates(grid, cells.T, order=1, mode="nearest"))

    i, j = np.meshgrid(np.arange(len(x) - 1), np.arange(len(y) - 1), indexing="ij")
    corner = (i * len(y) + j).ravel()
    triangles = np.concatenate(
        [
            np.column_stack([corner, corner + len(y), corner + len(y) + 1]),
            np.column_stack([corner, corner + len(y) + 1, corner + 1]),
        ]
    )
    return Ground(Surface(np.column_stack([nodes, z]), triangles, plan.material), height)


def _sampled(
    path: Path, nodes: NDArray[np.float64], geo: GeoReference, notes: list[str]
) -> NDArray[np.float64]:
    """Heights (N,) of a GeoTIFF at world points (N, 2). [m]"""
    rasterio = needs_extra("rasterio", path.name, "GeoTIFF")
    from scipy.ndimage import distance_transform_edt, map_coordinates

    data = read_bytes(path)
    if data[:4] not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        raise CityError(f"{path.name}: is no GeoTIFF; give one with heights in its first band")
    try:
        with rasterio.MemoryFile(data) as file, file.open(driver="GTiff") as raster:
            cells = _cells(raster, nodes, geo, path.name, notes)
            window, shape, cells = _window(rasterio, raster, cells, path.name)
            band = raster.read(1, window=window, out_shape=shape, masked=True)
    except CityError:
        raise
    except (rasterio.errors.RasterioError, RuntimeError, ValueError, MemoryError) as error:
        raise CityError(f"{path.name}: not readable as a GeoTIFF ({error})") from None
    heights = np.ma.filled(band.astype(np.float64), np.nan)
    missing = ~np.isfinite(heights)
    if missing.all():
        raise CityError(f"{path.name}: it holds no height where the buildings are")
    if missing.any():
        near = distance_transform_edt(missing, return_distances=False, return_indices=True)
        heights = heights[tuple(near)]
    return np.asarray(map_coordinates(heights, cells.T, order=1, mode="nearest"))


def _cells(
    raster: Any, nodes: NDArray[np.float64], geo: GeoReference, name: str, notes: list[str]
) -> NDArray[np.float64]:
    """Rows and columns (N, 2) of a raster at world points."""
    from pyproj import Transformer

    if raster.transform.is_identity or raster.transform.is_degenerate:
        raise CityError(f"{name}: says not where it lies; give a GeoTIFF with a geotransform")
    points = geo.to_file(nodes)
    if geo.crs and raster.crs is not None:
        turned = Transformer.from_crs(geo.crs, raster.crs.to_wkt(), always_xy=True)
        points = np.column_stack(turned.transform(points[:, 0], points[:, 1]))
        if not np.isfinite(points).all():
            raise CityError(f"{name}: lies elsewhere than the buildings; check city.crs")
    elif geo.crs or raster.crs is not None:
        notes.append(f"{name}: taken to lie in the coordinates of the buildings")
    to_pixel = ~raster.transform
    column, row = np.reshape(to_pixel, (3, 3))[:2] @ np.vstack([points.T, np.ones(len(points))])
    return np.column_stack([row, column]) - 0.5


def _window(
    rasterio: Any, raster: Any, cells: NDArray[np.float64], name: str
) -> tuple[Any, tuple[int, int], NDArray[np.float64]]:
    """The part of a raster that is read, the shape that it is read in, and the places of the points
    in it."""
    size = np.array([raster.height, raster.width])
    inside = ((cells > -1) & (cells < size)).all(axis=1)
    if not inside.any():
        raise CityError(
            f"{name}: lies elsewhere than the buildings; check city.crs and city.origin"
        )
    block = math.prod(raster.block_shapes[0]) * np.dtype(raster.dtypes[0]).itemsize
    if block > MAX_BLOCK_BYTES:
        raise CityError(f"{name}: its cells lie in blocks of {block} bytes; write smaller tiles")
    low = np.floor(np.clip(cells[inside].min(axis=0), 0, size - 1)).astype(int)
    high = np.ceil(np.clip(cells[inside].max(axis=0), 0, size - 1)).astype(int) + 1
    if math.prod((high - low).tolist()) > MAX_CELLS:
        extent = " x ".join(map(str, (high - low).tolist()))
        raise CityError(
            f"{name}: {extent} cells about the city, {MAX_CELLS} can be read; write coarser ones"
        )
    shape = np.minimum(high - low, 2048)
    window = rasterio.windows.Window(low[1], low[0], *(high - low)[::-1])
    pixels = (cells - low + 0.5) * shape / (high - low) - 0.5
    return window, (int(shape[0]), int(shape[1])), pixels


def feet_of(solids: Sequence[Solid]) -> tuple[list[Solid], NDArray[np.float64]]:
    """Return the solids on the ground, and the middle of the feet of each (N, 3)."""
    roots: dict[str, list[Solid]] = {}
    for solid in solids:
        if solid.kind in BUILDING_TYPES and solid.foot.size:
            roots.setdefault(solid.root, []).append(solid)
    grounded = [solid for parts in roots.values() for solid in parts if not _rests_on(solid, parts)]
    points = [
        np.append(b.vertices[b.foot, :2].mean(axis=0), np.median(b.vertices[b.foot, 2]))
        for b in grounded
    ]
    return grounded, np.array(points).reshape(-1, 3)


def _rests_on(solid: Solid, parts: Sequence[Solid]) -> bool:
    """Return whether a part of a building has another one under it."""
    middle = solid.vertices[solid.foot, :2].mean(axis=0)
    level = solid.vertices[solid.foot, 2].min()
    for other in parts:
        plan = other.vertices[:, :2]
        if (
            other is not solid
            and other.vertices[other.foot, 2].min() < level - STANDS_ON_M
            and (plan.min(axis=0) <= middle).all()
            and (middle <= plan.max(axis=0)).all()
        ):
            return True
    return False


def lowered(solids: Sequence[Solid], base: Ground) -> list[tuple[Solid, float]]:
    """Bodies whose feet reach down to the ground, and by how much the farthest of each went [m].
    The ground is asked once for all of them."""
    if not solids:
        return []
    feet = [solid.vertices[solid.foot] for solid in solids]
    ends = np.cumsum([len(foot) for foot in feet])[:-1]
    under = np.split(base.height(np.concatenate(feet)[:, :2]), ends)
    return [
        _lowered(solid, foot[:, 2] - float(below.min()))
        for solid, foot, below in zip(solids, feet, under, strict=True)
    ]


def _lowered(solid: Solid, down: NDArray[np.float64]) -> tuple[Solid, float]:
    """Return a solid lowered by a height [m], if positive."""
    if not (down > 0).any():
        return solid, 0.0
    vertices = solid.vertices.copy()
    vertices[solid.foot, 2] -= np.maximum(down, 0.0)
    return replace(solid, vertices=vertices), float(down.max())
