"""The surfaces of a city cut into cells, one scatterer in each: functions of the mesh, the seed and
the flights, and of nothing else.

Faces are halved at their longest edges until a cell's area is small against its distance to all
that flies in the run. A cell is named by its face's corners (in the order of their coordinates) and
by the halvings that lead to it; from the seed and this name its point and its amplitude are hashed.
So neither the order of faces and corners, nor the process, nor what else is in the mesh changes a
scatterer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from isac_rt.randomness import seed_sequence, splitmix64
from isac_rt.scenario.environment import Clutter
from isac_rt.world.city.mesh import CityMesh

UNIT = 1e-6 * np.sqrt(2)
"""World coordinates are hashed in whole multiples of this [m]. Irrational, so that no coordinate of
a file lies where rounding could go either way after the city has been recentred and shifted
back."""
ALIKE = 1e-9
"""Edges whose lengths differ by less than this share are equally long; then the first is halved."""
MOST_CELLS = 8_000_000


@dataclass(frozen=True)
class Density:
    """How finely surfaces are cut: a cell's area is at most max(smallest, per_metre * distance).

    Attributes
    ----------
    per_metre : area over distance to the nearest point of any flight [m]
    smallest : [m^2]
    """

    per_metre: float
    smallest: float

    @classmethod
    def of(cls, clutter: Clutter) -> Density:
        """As a scenario asks for it."""
        return cls(
            clutter.cell_area_per_metre_m or area_for(clutter.max_error_db),
            clutter.smallest_cell_m2,
        )


KNOWN_ERROR_DB, KNOWN_AREA = 0.2, 0.024
"""Of the mean power in range cells of 4 m, that nine of ten keep to, at this area over distance
[m]: what Munich and San Francisco show (0.17 and 0.18 dB, `docs/clutter.md`) and a tenth more."""


def area_for(error_db: float) -> float:
    """Area over distance [m] at which nine of ten range cells keep to an error of their mean power.

    Of the surface within a range cell, cells of area A that its two edges cut count on one side or
    the other, their whole power. There are n ~ 1/A inside and m ~ 1/sqrt(A) on the edges, so the
    error sqrt(m)/n grows with A^(3/4). It is the same for all presets of the budget, because
    another density is another draw of the clutter.
    """
    return float(f"{KNOWN_AREA * (error_db / KNOWN_ERROR_DB) ** (4 / 3):.6g}")


def error_for(per_metre: float) -> float:
    """The error [dB] at an area over distance: `area_for` the other way."""
    return KNOWN_ERROR_DB * (per_metre / KNOWN_AREA) ** 0.75


@dataclass(frozen=True)
class Cells:
    """N scatterers, one per cell, in an order that depends on coordinates only.

    Attributes
    ----------
    points : (N, 3) float64, local coordinates [m]
    area : (N,) float32 of the cell [m^2]
    amplitude : (N,) complex64, circular Gaussian of unit power
    face : (N,) int32 face of the city's mesh
    """

    points: np.ndarray
    area: np.ndarray
    amplitude: np.ndarray
    face: np.ndarray

    def __len__(self) -> int:
        return self.area.size

    def select(self, which: np.ndarray) -> Cells:
        """The cells that a mask or an index array chooses."""
        return Cells(self.points[which], self.area[which], self.amplitude[which], self.face[which])


def cut(
    city: CityMesh, scattering: np.ndarray, places: np.ndarray, density: Density, seed: int
) -> Cells:
    """All scatterers of a city.

    Parameters
    ----------
    city : CityMesh
    scattering : (F,) bool, faces that scatter at all
    places : (K, 3) points along the flights of the whole run, local coordinates [m]
    density : Density
    seed : of the scenario

    Returns
    -------
    Cells

    Raises
    ------
    ValueError  If there would be more than `MOST_CELLS`.
    """
    face = np.flatnonzero(scattering)
    corners = _sorted_corners(city.corners[face])
    order = np.lexsort(corners.reshape(-1, 9).T[::-1])
    face, corners = face[order], corners[order]
    state = _face_state(corners + city.origin, seed)
    tree = cKDTree(places)
    area = city.areas[face]
    row, code = np.arange(face.size), np.ones(face.size, np.uint64)
    leaves: list[tuple[np.ndarray, ...]] = []
    count = 0
    while row.size:
        large = _too_large(corners, area, tree, density)
        leaves.append((row[~large], code[~large], area[~large], corners[~large]))
        count += int((~large).sum()) + 2 * int(large.sum())
        if count > MOST_CELLS:
            raise ValueError(
                f"a scatterer for every {density.per_metre:g} m2 and metre (clutter.max_error_db, "
                "or cell_area_per_metre_m) cuts "
                f"the city into more than {MOST_CELLS} cells; raise it, or lower city.keep_radius_m"
            )
        corners = _halves(corners[large])
        row, area = np.repeat(row[large], 2), np.repeat(area[large] / 2, 2)
        code = np.repeat(code[large], 2) * np.uint64(2)
        code[1::2] += np.uint64(1)
        count -= row.size
    rows, codes, areas, triangles = (np.concatenate(part) for part in zip(*leaves, strict=True))
    order = np.lexsort([codes, rows])
    rows, codes, areas, triangles = rows[order], codes[order], areas[order], triangles[order]
    point, amplitude = _draw(splitmix64(state[rows], codes), triangles)
    return Cells(point, areas.astype(np.float32), amplitude, face[rows].astype(np.int32))


def _too_large(
    corners: np.ndarray, area: np.ndarray, tree: cKDTree, density: Density
) -> np.ndarray:
    """Whether cells are larger than their distance allows; that of the nearest point that a circle
    about the centroid can hold."""
    large = area > density.smallest
    middle = corners[large].mean(axis=1)
    reach = np.linalg.norm(corners[large] - middle[:, None], axis=2).max(axis=1)
    distance = np.maximum(tree.query(middle)[0] - reach, 0.0)
    large[large] = area[large] > density.per_metre * distance
    return large


def _sorted_corners(corners: np.ndarray) -> np.ndarray:
    """Corners (F, 3, 3) of each face in the order of x, then y, then z."""
    rank = np.lexsort((corners[..., 2], corners[..., 1], corners[..., 0]), axis=1)
    return np.take_along_axis(corners, rank[..., None], axis=1)


def _halves(corners: np.ndarray) -> np.ndarray:
    """(2n, 3, 3) the two halves of each triangle (n, 3, 3), cut from the middle of its longest
    edge."""
    edge = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2)
    first = (edge >= edge.max(axis=1, keepdims=True) * (1 - ALIKE)).argmax(axis=1)
    turn = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, turn[..., None], axis=1), 1, 0)
    middle = (a + b) / 2
    return np.stack(
        [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)], axis=1
    ).reshape(-1, 3, 3)


def _face_state(corners: np.ndarray, seed: int) -> np.ndarray:
    """(F,) uint64 hash of the seed and the world coordinates of (F, 3, 3) sorted corners."""
    start = seed_sequence(seed, "scatterers").generate_state(1, np.uint64)[0]
    state = np.full(len(corners), start, np.uint64)
    words = np.rint(corners.reshape(-1, 9) / UNIT).astype(np.int64).view(np.uint64)
    for word in words.T:
        state = splitmix64(state, word)
    return state


def _draw(state: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point, uniform in each triangle (N, 3, 3), and a complex Gaussian amplitude of unit
    power."""
    words = np.arange(4, dtype=np.uint64)[:, None]
    uniform = ((splitmix64(state, words) >> np.uint64(11)).astype(np.float64) + 0.5) / 2**53
    root, share = np.sqrt(uniform[0])[:, None], uniform[1][:, None]
    a, b, c = np.moveaxis(triangles, 1, 0)
    point = (1 - root) * a + root * ((1 - share) * b + share * c)
    amplitude = np.sqrt(-np.log(uniform[2])) * np.exp(2j * np.pi * uniform[3])
    return point, amplitude.astype(np.complex64)
