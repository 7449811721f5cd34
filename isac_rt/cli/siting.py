"""Where a first swarm flies over a city: among its densest buildings, in a street that is wide
enough, its UAVs in sight of each other and with a wall in view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from isac_rt.views.render import View, depth_buffer
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.passage import hits

CELL_M, MOST_CELLS = 2.0, 2000
"""Side of a cell of the map of heights [m], and most cells along a side of it."""
AROUND_M = 120.0
"""Buildings are counted over squares of this side."""
OPEN_M, HIGH_M = 1.0, 3.0
"""What rises less over the ground is open, what rises more a building."""
ROOM_M = 3.0
"""Free space on all sides of a flight."""
LOW_M, HIGHEST_M, OVER_ROOFS_M = 4.0, 20.0, 6.0
"""Flights in a street stay so high over it, at half of the buildings' height between, others so
high over roofs."""
VIEW_M = 60.0
"""A wall is looked for so far ahead."""
_HEADINGS, _CANDIDATES, _TRIED = 16, 400, 60


@dataclass(frozen=True)
class Formation:
    """Flights about a place, heading to +y.

    Parameters
    ----------
    starts, ends : (U, 3) float64
        Of straight flights, the first that of a terminal that looks ahead. [m]
    """

    starts: NDArray[np.float64]
    ends: NDArray[np.float64]

    def at(self, site: Site) -> Formation:
        """The flights at a site."""
        return Formation(site.place(self.starts), site.place(self.ends))


@dataclass(frozen=True)
class Site:
    """A place (3,) [m] in the world, and the heading from north to east [rad]."""

    middle: NDArray[np.float64]
    heading: float

    def rotate(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vectors (N, 3), ahead along +y, as of the world."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return vectors @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def place(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) about the site as of the world."""
        return self.rotate(points) + self.middle


@dataclass(frozen=True)
class _Map:
    """Heights of the highest and of the lowest surface in cells (rows to the north, columns to the
    east), NaN where there is none, as in the cells of the rim. [m]"""

    corner: NDArray[np.float64]
    cell: float
    top: NDArray[np.float64]
    low: NDArray[np.float64]

    def index(self, points: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Row and column of world points (..., 2), at the rim those of the nearest cell."""
        cells = np.floor((points - self.corner) / self.cell).astype(int)
        rows, columns = self.top.shape
        return np.clip(cells[..., 1], 0, rows - 1), np.clip(cells[..., 0], 0, columns - 1)


def _heights(city: CityMesh) -> _Map:
    corners = city.corners + city.origin
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    cell = max(CELL_M, float((high - low)[:2].max()) / MOST_CELLS)
    width, height = (int(np.ceil(side / cell)) + 3 for side in (high - low)[:2])
    half = (width * cell / 2, height * cell / 2)
    corner = low[:2] - cell  # what lies outside the city is of the rim
    centre = np.append(corner + half, 0.0)
    maps = []
    for away in (-1.0, 1.0):
        view = View(np.diag([1.0, 1.0, away]), centre, half)
        depth, _ = depth_buffer(corners, view, width, height)
        maps.append(np.where(np.isfinite(depth), away * depth, np.nan))
    return _Map(corner, cell, maps[0], maps[1])


def site_of(city: CityMesh, formation: Formation) -> Site:
    """The best site of a formation in a city; high over its densest part where no other is free."""
    heights = _heights(city)
    corners = city.corners + city.origin
    for site in _ranked(heights, formation):
        if _is_good(corners, formation.at(site)):
            return site
    density, _ = _density(heights)
    row, column = np.unravel_index(int(np.argmax(density)), density.shape)
    middle = heights.corner + (np.array([column, row]) + 0.5) * heights.cell
    return Site(np.append(middle, np.nanmax(heights.top) + OVER_ROOFS_M), 0.0)


def _density(heights: _Map) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Share of the ground around each cell under buildings, and their mean height [m]."""
    rise = np.nan_to_num(heights.top - heights.low)
    built = (rise > HIGH_M).astype(float)
    size = max(3, round(AROUND_M / heights.cell))
    share = uniform_filter(built, size, mode="constant")
    mean = uniform_filter(rise * built, size, mode="constant") / np.maximum(share, 1e-9)
    return share, mean


def _ranked(heights: _Map, formation: Formation) -> Iterator[Site]:
    """Sites from the best to the worst, by the map of heights."""
    share, mean = _density(heights)
    rise = heights.top - heights.low
    open_cells = np.flatnonzero((rise < OPEN_M) & (share > 0.5 * share.max()))
    if not open_cells.size:
        open_cells = np.flatnonzero(np.isfinite(rise))
    # the densest first, and not all from one corner
    step = max(1, len(open_cells) // _CANDIDATES)
    chosen = open_cells[np.argsort(-share.ravel()[open_cells], kind="stable")][::step]
    rows, columns = np.unravel_index(chosen, rise.shape)
    middles = heights.corner + (np.column_stack([columns, rows]) + 0.5) * heights.cell
    corridor, (ahead, near) = _corridor(formation), _ahead(formation)
    sites = []
    for number in range(_HEADINGS):
        heading = 2 * np.pi * number / _HEADINGS
        rotate = Site(np.zeros(3), heading).rotate
        inside = heights.index(middles[:, None] + rotate(corridor)[:, :2])
        under = np.nan_to_num(heights.top[inside], nan=np.inf).max(axis=1)
        street = (rise[inside] < OPEN_M).all(axis=1)
        over = np.clip(mean[rows, columns] / 2, LOW_M, HIGHEST_M)
        z = under + np.where(street, over, OVER_ROOFS_M)
        seen = heights.top[heights.index(middles[:, None] + rotate(ahead)[:, :2])]
        walls = seen > z[:, None] + 1.0
        nearest = (walls * near).max(axis=1)  # few buildings fill little of the view from anywhere
        score = (0.05 + np.minimum(walls.mean(axis=1), 0.3)) * (0.1 + nearest)
        score *= (1.0 + 2.0 * street) * share[rows, columns]
        sites += [
            (-score[k], Site(np.append(middles[k], z[k]), heading))
            for k in np.flatnonzero(np.isfinite(z))
        ]
    sites.sort(key=lambda item: item[0])
    yield from (site for _, site in sites[:_TRIED])


def _corridor(formation: Formation) -> NDArray[np.float64]:
    """Points (N, 3) all over the flights and `ROOM_M` about them."""
    ends = np.concatenate([formation.starts, formation.ends])[:, :2]
    low, high = ends.min(axis=0) - ROOM_M, ends.max(axis=0) + ROOM_M
    x, y = (np.linspace(a, b, int((b - a) / 1.5) + 2) for a, b in zip(low, high, strict=True))
    plan = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.column_stack([plan, np.zeros(len(plan))])


def _ahead(formation: Formation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) over what the first terminal looks at, and how near they are, 1 to 0."""
    r, angle = np.meshgrid(np.linspace(8, VIEW_M, 27), np.linspace(-0.9, 0.9, 19))
    points = np.stack([r * np.sin(angle), r * np.cos(angle), 0 * r], axis=-1).reshape(-1, 3)
    return points + formation.starts[0], 1 - r.ravel() / VIEW_M


def _is_good(corners: NDArray[np.float64], flights: Formation) -> bool:
    """Return whether flights meet no face, the first two UAVs see all others first and last, and a
    wall stands in front of the first."""
    ends = np.concatenate([flights.starts, flights.ends])
    reach = [ends.min(axis=0) - VIEW_M, ends.max(axis=0) + VIEW_M]
    near = corners[
        ((corners.min(axis=1) <= reach[1]) & (corners.max(axis=1) >= reach[0])).all(axis=1)
    ]
    lines = list(zip(flights.starts, flights.ends, strict=True))
    for positions in (flights.starts, flights.ends):
        lines += [(a, b) for i, a in enumerate(positions[:2]) for b in positions[i + 1 :]]
    if any(hits(near, a, b)[0].size for a, b in lines):
        return False
    start, on = flights.starts[0], flights.ends[0] - flights.starts[0]
    on = on / np.linalg.norm(on)
    across = np.cross(on, [0.0, 0.0, 1.0])
    for angle in np.linspace(-0.9, 0.9, 13):
        ray = start + VIEW_M * (np.cos(angle) * on + np.sin(angle) * across)
        faces, share = hits(near, start, ray)
        if faces.size:
            a, b, c = near[faces[share.argmin()]]
            normal = np.cross(b - a, c - a)
            if abs(normal[2]) < 0.5 * np.linalg.norm(normal):
                return True
    return False
