"""The surfaces of a city cut into cells, one scatterer in each: functions of the mesh, the seed and
the flights, and of nothing else.

Faces are halved at their longest edges until a cell's area is small against its distance to all
that flies in the run. A cell is named by its face's corners (in the order of their coordinates) and
by the halvings that lead to it; from the seed and this name its point and its amplitude are hashed.
So neither the order of faces and corners, nor the process, nor what else is in the mesh changes a
scatterer.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.randomness import seed_sequence, splitmix64
from isac_rt.scenario.environment import Clutter
from isac_rt.world.city.mesh import CityMesh

UNIT = 1e-6 * np.sqrt(2)
"""World coordinates are hashed in whole multiples of this [m]. Irrational, so that no coordinate of
a file lies where rounding could go either way after the city has been recentred and shifted
back."""
ALIKE = 1e-9
"""Edges whose lengths differ by less than this share are equally long; then the first is halved."""
BOX = 32
"""Places along a flight that are looked at only if the box about them is near enough."""
FINER = 4.0
"""How many cells near a flight share the surface of one, where a density asks for it."""
MOST_CELLS = 8_000_000


@dataclass(frozen=True)
class Density:
    """How finely surfaces are cut: a cell's area is at most max(smallest, per_metre * distance).

    Near a flight it is `FINER` times smaller.

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
        """As a scenario asks for it."""
        return cls(
            clutter.cell_area_per_metre_m or area_for(clutter.max_error_db),
            clutter.smallest_cell_m2,
        )

    def finest(self, distance: np.ndarray) -> np.ndarray:
        """Largest areas of cells at distances from the nearest point of any flight [m]."""
        area = np.maximum(self.smallest, self.per_metre * distance)
        return np.where(distance < self.near, area / FINER, area)


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
    code : (N,) uint64 halvings of the face that lead to the cell: 1, then a bit for each
    clock : (N,) exponential of rate `area` [1/m^2]: of any set of cells, each has the least with
        the probability that is its share of the set's area
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
        """The cells that a mask or an index array chooses."""
        return Cells(*(part[which] for part in vars(self).values()))


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
    count, *leaves = _leaves(
        corners, city.areas[face], places, _boxes(places), astuple(density), MOST_CELLS
    )
    if count > MOST_CELLS:
        raise ValueError(
            f"a scatterer for every {density.per_metre:g} m2 and metre (clutter.max_error_db, "
            "or cell_area_per_metre_m) cuts "
            f"the city into more than {MOST_CELLS} cells; raise it, or lower city.keep_radius_m"
        )
    rows, codes, areas, triangles = (part[:count] for part in leaves)
    point, amplitude, clock = _draw(splitmix64(state[rows], codes), triangles)
    own = face[rows].astype(np.int32)
    return Cells(point, areas.astype(np.float32), amplitude, own, codes, clock / areas)


def _sorted_corners(corners: np.ndarray) -> np.ndarray:
    """Corners (F, 3, 3) of each face in the order of x, then y, then z."""
    rank = np.lexsort((corners[..., 2], corners[..., 1], corners[..., 0]), axis=1)
    return np.take_along_axis(corners, rank[..., None], axis=1)


def _boxes(places: np.ndarray) -> np.ndarray:
    """(B, 2, 3) lowest and highest coordinates of every `BOX` places (K, 3)."""
    first = np.arange(0, len(places), BOX)
    return np.stack([np.minimum.reduceat(places, first), np.maximum.reduceat(places, first)], 1)


@jit
def _leaves(corners, area, places, boxes, density, most):
    """Cells of faces (F, 3, 3) that are cut no further: how many, then the row of the face, code,
    area and corners, in the order of row and code. Ends early where there are more than `most`."""
    per_metre, smallest, near = density
    room = max(2 * area.size, 1024)
    rows, codes = np.empty(room, np.int64), np.empty(room, np.uint64)
    areas, cells = np.empty(room), np.empty((room, 3, 3))
    line_codes, line_areas = np.empty(64, np.uint64), np.empty(64)
    line = np.empty((64, 3, 3))  # cells of one face that wait, those of few halvings first
    count = 0
    for row in range(area.size):
        line_codes[0], line_areas[0], line[0] = 1, area[row], corners[row]
        first, last = 0, 1
        while first < last:
            if count + last - first > most:
                return most + 1, rows, codes, areas, cells
            size = line_areas[first]
            reach = size / per_metre if size > smallest else 0.0
            if FINER * size > smallest:
                reach = max(reach, min(FINER * size / per_metre, near))
            if reach == 0 or not _near(line[first], reach, places, boxes):
                if count == rows.size:
                    rows, codes = np.append(rows, rows), np.append(codes, codes)
                    areas, cells = np.append(areas, areas), np.concatenate((cells, cells))
                rows[count], codes[count] = row, line_codes[first]
                areas[count], cells[count] = line_areas[first], line[first]
                count, first = count + 1, first + 1
                continue
            if last + 2 > line_areas.size:
                line_codes = np.append(line_codes[first:last], line_codes)
                line_areas = np.append(line_areas[first:last], line_areas)
                line = np.concatenate((line[first:last], line))
                first, last = 0, last - first
            _halve(line[first], line[last], line[last + 1])
            for half in range(2):
                line_codes[last + half] = line_codes[first] * np.uint64(2) + np.uint64(half)
                line_areas[last + half] = line_areas[first] / 2
            first, last = first + 1, last + 2
    return count, rows, codes, areas, cells


@jit
def _near(corners, limit, places, boxes):
    """Whether a place is nearer than `limit` to a triangle (3, 3): to the nearest point of a sphere
    about its centroid that holds it."""
    middle = (corners[0] + corners[1] + corners[2]) / 3
    reach = 0.0
    for corner in corners:
        reach = max(reach, _distance(corner, middle))
    for number, (low, high) in enumerate(boxes):
        within = np.minimum(np.maximum(middle, low), high)
        if _distance(within, middle) > (1 + ALIKE) * (limit + reach):
            continue
        for place in places[number * BOX : (number + 1) * BOX]:
            if max(_distance(place, middle) - reach, 0.0) < limit:
                return True
    return False


@jit(inline=True)
def _distance(a, b):
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return np.sqrt(x * x + y * y + z * z)


@jit
def _halve(corners, one, other):
    """Cut a triangle (3, 3) from the middle of its longest edge into two."""
    edges = np.empty(3)
    for k in range(3):
        edges[k] = _distance(corners[(k + 1) % 3], corners[k])
    first, least = 0, edges.max() * (1 - ALIKE)
    while edges[first] < least:
        first += 1
    for axis in range(3):
        a, b = corners[first, axis], corners[(first + 1) % 3, axis]
        middle = (a + b) / 2
        one[0, axis], one[1, axis], one[2, axis] = a, middle, corners[(first + 2) % 3, axis]
        other[0, axis], other[1, axis], other[2, axis] = middle, b, corners[(first + 2) % 3, axis]


def _face_state(corners: np.ndarray, seed: int) -> np.ndarray:
    """(F,) uint64 hash of the seed and the world coordinates of (F, 3, 3) sorted corners."""
    start = seed_sequence(seed, "scatterers").generate_state(1, np.uint64)[0]
    state = np.full(len(corners), start, np.uint64)
    words = np.rint(corners.reshape(-1, 9) / UNIT).astype(np.int64).view(np.uint64)
    for word in words.T:
        state = splitmix64(state, word)
    return state


def _draw(state: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, ...]:
    """A point, uniform in each triangle (N, 3, 3), a complex Gaussian amplitude of unit power, and
    an exponential of unit mean."""
    words = np.arange(5, dtype=np.uint64)[:, None]
    uniform = ((splitmix64(state, words) >> np.uint64(11)).astype(np.float64) + 0.5) / 2**53
    root, share = np.sqrt(uniform[0])[:, None], uniform[1][:, None]
    a, b, c = np.moveaxis(triangles, 1, 0)
    point = (1 - root) * a + root * ((1 - share) * b + share * c)
    amplitude = np.sqrt(-np.log(uniform[2])) * np.exp(2j * np.pi * uniform[3])
    return point, amplitude.astype(np.complex64), -np.log(uniform[4])
