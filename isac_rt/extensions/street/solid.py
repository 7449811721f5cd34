"""Convex solids with flat facets: boxes, and the hulls of meshes."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from isac_rt.world.city.materials import CityError
from isac_rt.world.city.meshfiles import Y_UP, Y_UP_TO_Z_UP, pieces
from isac_rt.world.settings import MOST_SIZE_M, Box

FLAT = 1e-4
"""Distance from a facet's plane up to which corners lie on it [m], a fortieth of a wavelength."""
MOST_FACETS = 200
"""Facets of a solid: each is tried as a mirror between all terminals and UAVs."""
SMALLEST_M = 0.01
CUBE = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
"""Corners of a cube of 1 m."""
TINY = np.finfo(float).tiny


class Solid(NamedTuple):
    """A convex solid in the axes of a body.

    Attributes
    ----------
    corners : (V, 3) [m]
    edges : (E, 2) corners that a straight line on the surface joins, over all edges of facets
    planes : (F, 4) outward unit normal of each facet, and its height [m]
    """

    corners: np.ndarray
    edges: np.ndarray
    planes: np.ndarray

    @property
    def reach(self) -> float:
        """Distance of the farthest corner [m]."""
        return float(np.linalg.norm(self.corners, axis=1).max())

    def depths(self, points: np.ndarray) -> np.ndarray:
        """Return the depths of points (..., 3) under each facet's plane (..., F) [m]."""
        return np.asarray(self.planes[:, 3] - points @ self.planes[:, :3].T)


def solid_of_box(name: str, box: Box) -> Solid:
    """Return the solid that the settings of a UAV's box state."""
    corners = CUBE if box.corners_m is None else np.array(box.corners_m)
    scale = 1.0 if box.size_m is None else box.size_m / np.maximum(np.ptp(corners, axis=0), TINY)
    try:
        return solid_of(corners * scale)
    except CityError as problem:
        raise CityError(f"swarm.{name}.box.corners_m: {problem}") from None


def solid_of(points: np.ndarray) -> Solid:
    """Return the convex hull of points (N, 3) [m], with triangles in one plane as one facet.

    Raises
    ------
    CityError  If it is no solid of a size that moves, or has more than `MOST_FACETS`.
    """
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if not SMALLEST_M <= size <= MOST_SIZE_M:
        text = f"is {size:.4g} m large, {SMALLEST_M:g} to {MOST_SIZE_M:g} m are taken"
        raise CityError(f"{text}; it is in metres: scale millimetres by 0.001")
    try:
        hull = ConvexHull(points)
    except QhullError:
        raise CityError("is flat: all corners lie in one plane; give it a height") from None
    triangles, planes = points[hull.simplices], list[np.ndarray]()
    first, second = np.diff(triangles, axis=1).swapaxes(0, 1)
    left = np.argsort(-np.linalg.norm(np.cross(first, second), axis=1))
    while left.size:  # the largest triangle that is left, and all in its plane
        if len(planes) == MOST_FACETS:
            raise CityError(f"its convex hull has more than {MOST_FACETS} facets; simplify it")
        planes.append(hull.equations[left[0]] * (1, 1, 1, -1))
        off = triangles[left] @ planes[-1][:3] - planes[-1][3]
        left = left[np.abs(off).max(axis=1) > FLAT]
    used, corners = np.unique(hull.simplices, return_inverse=True)
    edges = np.sort(corners.reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
    return Solid(points[used], np.unique(edges, axis=0), np.array(planes))


def corners_of_mesh(path: Path) -> dict[str, Any]:
    """Return the settings of a box that is the hull of a closed mesh, its middle in the origin.

    Raises
    ------
    ValueError  If the file is no such mesh.
    """
    import trimesh

    try:
        found = [np.zeros((0, 3)), *(p.vertices[p.faces].reshape(-1, 3) for p in pieces(path))]
        soup = np.concatenate(found)
        if path.suffix.lower() in Y_UP:
            soup = soup @ Y_UP_TO_Z_UP.T
        corners = solid_of(soup).corners
    except CityError as problem:
        raise ValueError(str(problem)) from None
    mesh = trimesh.Trimesh(soup, np.arange(len(soup)).reshape(-1, 3))
    holes = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    if holes.size:
        raise ValueError(f"is open: {len(holes)} edges have one triangle; close the mesh")
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return {"corners_m": (corners - middle).tolist()}
