"""Partition of a city's surfaces into cells with one scatterer each, from mesh, seed and flights
alone.

Faces are halved at their longest edges until a cell's area is small for its distance to the nearest
flight (`Density`). A hash of the seed, the face's sorted corners and the sequence of halvings gives
the point and the amplitude of a cell. A scatterer therefore depends neither on the order of faces
and corners, nor on the process, nor on the rest of the mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
from scipy.spatial import cKDTree

from isac_rt.propagation.settings import Clutter
from isac_rt.randomness import seed_sequence, splitmix64
from isac_rt.world.city.materials import CityError
from isac_rt.world.city.mesh import CityMesh

UNIT = 1e-6 * np.sqrt(2)
"""Step of world coordinates before hashing [m]. Irrational: no coordinate of a file lies half-way
between two steps, where recentring of the city could change its rounding."""
MOST_CELLS = 8_000_000
"""Largest number of cells of a run, about 0.5 GB."""
ALIKE = 1e-9
"""Relative difference up to which edges are equally long; the first of these is halved."""
FINER = 4.0
"""Factor by which cells within `Density.near` of a flight are smaller."""


@dataclass(frozen=True)
class Density:
    """Largest area of a cell: max(smallest, per_metre * distance), `FINER` times less near a
    flight.

    Attributes
    ----------
    per_metre : area over distance to the nearest point of any flight [m]
    smallest : [m^2]
    near : distance to any flight within which cells are `FINER` times smaller [m]
    """

    per_metre: float
    smallest: float
    near: float = 0.0

    @classmethod
    def of(cls, clutter: Clutter) -> Density:
        """Return the density of a scenario's settings."""
        return cls(
            clutter.cell_area_per_metre_m or area_for(clutter.max_error_db),
            clutter.smallest_cell_m2,
        )

    def finest(self, distance: np.ndarray) -> np.ndarray:
        """Return the largest cell areas [m^2] at distances [m] from the nearest flight."""
        area = np.maximum(self.smallest, self.per_metre * distance)
        return np.where(distance < self.near, area / FINER, area)


KNOWN_ERROR_DB, KNOWN_AREA = 0.2, 0.024
"""Error of the mean power in 4 m range cells, 90th percentile, at this area over distance [m]: the
0.17 and 0.18 dB of Munich and San Francisco (`docs/clutter.md`) with a tenth of margin."""


def area_for(error_db: float) -> float:
    """Return the area over distance [m] at which the mean power of nine of ten range cells has an
    error of `error_db` at most.

    A range cell holds n ~ 1/A surface cells of area A; m ~ 1/sqrt(A) of them lie across its two
    edges and count as a whole on one side. The relative error sqrt(m)/n grows as A^(3/4).
    """
    return float(f"{KNOWN_AREA * (error_db / KNOWN_ERROR_DB) ** (4 / 3):.6g}")


def error_for(per_metre: float) -> float:
    """Return the error [dB] at an area over distance [m], the inverse of `area_for`."""
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
    code : (N,) uint64 halvings of the face that lead to the cell: 1, then one bit per halving
    clock : (N,) exponential variable of rate `area` [1/m^2]: in any set of cells the probability to
        have the least is proportional to area
    """

    points: np.ndarray
    area: np.ndarray
    amplitude: np.ndarray
    face: np.ndarray
    code: np.ndarray
    clock: np.ndarray

    def __len__(self) -> int:
        return self.area.size

    def select(self, which: np.ndarray) -> Cells:
        """Select cells by a mask or an index array."""
        return Cells(*(part[which] for part in vars(self).values()))


def cut(
    city: CityMesh,
    scattering: np.ndarray,
    positions: np.ndarray,
    density: Density,
    seed: int,
    wanted: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Cells:
    """Cut a city into cells, one scatterer in each.

    Parameters
    ----------
    city : CityMesh
    scattering : (F,) bool, faces that scatter
    positions : (K, 3) points along the flights of the whole run, local coordinates [m]
    density : Density
    seed : of the scenario
    wanted : function that marks the scatterers to keep, (N,) bool, from their points (N, 3) and
        faces (N,); None: all

    Returns
    -------
    Cells

    Raises
    ------
    CityError  If there would be more than `MOST_CELLS`.
    """
    face = np.flatnonzero(scattering)
    corners = _sorted_corners(city.corners[face])
    order = np.lexsort(corners.reshape(-1, 9).T[::-1])
    face, corners = face[order], corners[order]
    count, rows, *parts = leaves(
        (corners, city.areas[face], _face_state(corners + city.origin, seed)),
        positions,
        (*astuple(density), city.reach),
        MOST_CELLS,
    )
    if count > MOST_CELLS:
        raise CityError(
            f"a scatterer for every {density.per_metre:g} m2 and metre (clutter.max_error_db, "
            "or cell_area_per_metre_m) cuts "
            f"the city into more than {MOST_CELLS} cells; raise it, or lower city.keep_radius_m"
        )
    own = face[rows].astype(np.int32)
    if wanted is not None:
        some = np.flatnonzero(wanted(parts[-1], own))
        own, *parts = (part[some] for part in (own, *parts))
    codes, areas, states, points = parts
    amplitude, clock = _draw(states)
    return Cells(points, areas.astype(np.float32), amplitude, own, codes, clock / areas)


def leaves(
    faces: tuple[np.ndarray, np.ndarray, np.ndarray],
    positions: np.ndarray,
    density: tuple[float, float, float, float],
    most: int,
) -> tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cut faces with corners (F, 3, 3), areas (F,) and states (F,) until no cell is larger than
    `density` allows at its distance from the nearest of `positions` (K, 3).

    Returns
    -------
    number of cells, more than `most` if there would be more; face, code, area, state and point of
    each, in the order of face and code
    """
    per_metre, smallest, near, farthest = density
    corners, area, state = faces
    tree, count, done = cKDTree(positions), 0, list[tuple[np.ndarray, ...]]()
    corners = np.ascontiguousarray(np.moveaxis(corners, 0, 2))  # (corner, axis, cell)
    cells: tuple[np.ndarray, ...]
    cells = np.arange(len(area)), np.ones(len(area), np.uint64), area, corners
    while cells[0].size or not done:
        if farthest < np.inf:  # leave out cells beyond the reach of all flights
            low, high = cells[3].min(axis=0).max(axis=0), cells[3].max(axis=0).min(axis=0)
            cells = _some(cells, (low <= farthest) & (high >= -farthest))
        row, code, area, corners = cells
        if count + len(row) > most:
            return most + 1, row[:0], code[:0], area[:0], state[:0], corners[0, :, :0].T
        # least distance of a cell's bounding ball to any flight, against what its area needs
        middle = corners.sum(axis=0) / 3
        radius = np.sqrt(((corners - middle) ** 2).sum(axis=1).max(axis=0))
        finer = np.where(FINER * area > smallest, np.minimum(FINER * area / per_metre, near), 0)
        needed = np.maximum(np.where(area > smallest, area / per_metre, 0), finer)
        reach = (needed + radius).max(initial=0)
        large = np.maximum(tree.query(middle.T, distance_upper_bound=reach)[0] - radius, 0) < needed
        done.append(_some(cells, ~large))
        count += len(done[-1][0])
        row, code, area, corners = _some(cells, large)
        code = np.stack([2 * code, 2 * code + 1], axis=1).ravel()
        cells = np.repeat(row, 2), code, np.repeat(area / 2, 2), _halves(corners)
    cells = tuple(np.concatenate(part, axis=-1) for part in zip(*done, strict=True))
    row, code, area, corners = _some(cells, np.lexsort([cells[1], cells[0]]))
    own = splitmix64(state[row], code)
    return len(row), row, code, area, own, _points_in(corners, own)


def _some(arrays: tuple[np.ndarray, ...], which: np.ndarray) -> tuple[np.ndarray, ...]:
    """Select along the last axis by a mask or an index array."""
    index = np.flatnonzero(which) if which.dtype == bool else which
    return tuple(part.take(index, axis=-1) for part in arrays)


def _halves(corners: np.ndarray) -> np.ndarray:
    """Halve triangles (corner, axis, K) at the middle of the longest edge, the first of equal ones:
    (corner, axis, 2 K)."""
    length = np.sqrt(((np.roll(corners, -1, axis=0) - corners) ** 2).sum(axis=1))
    first = (length >= length.max(axis=0) * (1 - ALIKE)).argmax(axis=0)
    turned = (first + np.arange(3)[:, None]) % 3
    a, b, c = np.take_along_axis(corners, turned[:, None], axis=0)
    middle, both = (a + b) / 2, np.empty((*corners.shape, 2))
    both[..., 0], both[..., 1] = (a, middle, c), (middle, b, c)
    return both.reshape(3, 3, -1)


def _points_in(corners: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Draw a point (K, 3) in each triangle (corner, axis, K), uniform by area, hashed from states
    (K,)."""
    words = np.arange(2, dtype=np.uint64)[:, None]
    hashed = (splitmix64(state, words) >> np.uint64(11)).astype(np.float64)
    root, share = np.sqrt((hashed[0] + 0.5) / 2**53), (hashed[1] + 0.5) / 2**53
    a, b, c = corners
    return np.ascontiguousarray(((1 - root) * a + root * ((1 - share) * b + share * c)).T)


def _sorted_corners(corners: np.ndarray) -> np.ndarray:
    """Sort the corners (F, 3, 3) of each face by x, then y, then z."""
    rank = np.lexsort((corners[..., 2], corners[..., 1], corners[..., 0]), axis=1)
    return np.take_along_axis(corners, rank[..., None], axis=1)


def _face_state(corners: np.ndarray, seed: int) -> np.ndarray:
    """Hash the seed and the world coordinates of sorted corners (F, 3, 3): (F,) uint64."""
    start = seed_sequence(seed, "scatterers").generate_state(1, np.uint64)[0]
    state = np.full(len(corners), start, np.uint64)
    words = np.rint(corners.reshape(-1, 9) / UNIT).astype(np.int64).view(np.uint64)
    for word in words.T:
        state = splitmix64(state, word)
    return state


def _draw(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw a complex Gaussian amplitude of unit power, and an exponential variable of unit mean."""
    words = np.arange(2, 5, dtype=np.uint64)[:, None]
    uniform = ((splitmix64(state, words) >> np.uint64(11)).astype(np.float64) + 0.5) / 2**53
    amplitude = np.sqrt(-np.log(uniform[0])) * np.exp(2j * np.pi * uniform[1])
    return amplitude.astype(np.complex64), -np.log(uniform[2])
