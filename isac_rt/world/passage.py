"""Where flights meet the city: ways through surfaces, places inside buildings or under the ground.

All in float64 and against every face, because Sionna's float32 rays see through what they start on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from isac_rt.world.city.mesh import CityMesh

TOUCH_M = 0.01
"""A flight may begin and end this near to a surface: UAVs stand on roofs."""
RING = 12
LOW_RAD, HIGH_RAD = 0.09, 0.7
"""Elevations of two rings of rays about a place: out through walls, and out through roofs."""


class Passage(NamedTuple):
    """Where a way goes through a face.

    Attributes
    ----------
    segment : of the way, from 0
    share : of the segment that is flown until then
    face : of the city
    """

    segment: int
    share: float
    face: int


def first_passage(city: CityMesh, polyline: np.ndarray) -> Passage | None:
    """The first face that a way goes through; None if it is clear.

    Parameters
    ----------
    city : CityMesh
    polyline : (T, 3) corners of a polyline, local [m]
    """
    return _first(city, np.arange(city.num_faces), polyline, 0)


def beside(city: CityMesh, polyline: np.ndarray, faces: np.ndarray | slice) -> np.ndarray:
    """(N,) which of some faces have boxes that meet that of a way (T, 3)."""
    (low, high), least, most = city.boxes, polyline.min(axis=0), polyline.max(axis=0)
    low, high = low[faces], high[faces]
    inside = (low[:, 0] <= most[0]) & (high[:, 0] >= least[0])
    some = np.flatnonzero(inside)  # few in a large city: one axis first
    inside[some] = ((low[some] <= most) & (high[some] >= least)).all(axis=1)
    return inside


def _first(city: CityMesh, faces: np.ndarray, polyline: np.ndarray, begin: int) -> Passage | None:
    """By halves: only faces whose boxes meet that of a part of the way are looked at again."""
    faces = faces[beside(city, polyline, faces)]
    if not faces.size or len(polyline) < 2:
        return None
    if len(polyline) == 2:
        hit, share = hits(city.corners[faces], polyline[0], polyline[1])
        if not hit.size:
            return None
        return Passage(begin, float(share.min()), int(faces[hit[share.argmin()]]))
    half = len(polyline) // 2
    parts = polyline[: half + 1], polyline[half:]
    return _first(city, faces, parts[0], begin) or _first(city, faces, parts[1], begin + half)


def hits(corners: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces (F, 3, 3) that the straight line between two places (3,) goes through, and the share of
    the line up to each; a line within a face's plane goes through none."""
    box = np.stack([np.minimum(start, end), np.maximum(start, end)])
    inside = (corners.min(axis=1) <= box[1]) & (corners.max(axis=1) >= box[0])
    near = np.flatnonzero(inside.all(axis=1))
    a, line = corners[near, 0], end - start
    first, second = corners[near, 1] - a, corners[near, 2] - a
    cross = np.cross(line, second)
    volume = (first * cross).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((start - a) * cross).sum(axis=1) / volume
        turned = np.cross(start - a, first)
        v = turned @ line / volume
        share = (turned * second).sum(axis=1) / volume
        through = (u >= 0) & (v >= 0) & (u + v <= 1) & (share >= 0) & (share <= 1)
    return near[through], share[through]


def obstacles(city: CityMesh, positions: np.ndarray) -> CityMesh:
    """Return the part of a city that UAVs may not be enclosed by: all of it, but for a room that
    encloses all of their places (N, 3), local.

    A room is a connected surface as large as the whole mesh, so that nothing lies outside it, or
    one whose faces look inward, unlike a building's. Walls with two sides are a room in a room.
    """
    if not city.num_faces:
        return city
    sides = city.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(sides)), sides.T), shape=(len(city.vertices),) * 2)
    _, part = connected_components(graph, directed=False)
    low, high = city.bounds()
    for one in np.unique(part[city.vertices.argmax(axis=0)]):
        own = city.vertices[part == one]
        if (own.min(axis=0) == low).all() and (own.max(axis=0) == high).all():
            shell = part[city.faces[:, 0]] == one
            if all(enclosed(city.of(shell), position) for position in positions):
                return obstacles(city.of(~shell), positions)
    if all(enclosed(city, position) and _looks_inward(city, position) for position in positions):
        return city.of(np.zeros(city.num_faces, bool))
    return city


def _looks_inward(city: CityMesh, position: np.ndarray) -> bool:
    """Return whether most of the faces that a place (3,) sees are seen from their front."""
    reach = float(np.linalg.norm(np.ptp(city.vertices, axis=0)))
    ahead = 0
    for azimuth in 0.123 + np.arange(RING) * 2 * np.pi / RING:
        along = np.array([np.cos(azimuth), np.sin(azimuth), LOW_RAD])
        face, share = hits(city.corners, position, position + reach * along)
        ahead += bool(face.size and city.normals[face[share.argmin()]] @ along < 0)
    return 2 * ahead > RING


def enclosed(city: CityMesh, position: np.ndarray) -> bool:
    """Return whether a place (3,), local, lies inside a building or under the ground.

    Inside a building an odd number of faces lies above, and in most directions about, whether it
    has a floor or not. Under the ground nothing lies below, and something above in every direction.
    A place under a bridge or a canopy is neither.
    """
    if not city.num_faces:
        return False
    low, high = city.bounds()
    reach = float(np.linalg.norm(high - low)) + float(np.linalg.norm(position - (low + high) / 2))

    def count(elevation: float, azimuth: float) -> int:
        level = np.cos(elevation)
        towards = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
        end = position + reach * np.array(towards)
        near = city.corners[beside(city, np.stack([position, end]), slice(None))]
        return len(hits(near, position, end)[0])

    # no direction is along an edge of what people build: an edge would count twice
    above = count(np.pi / 2 - 1e-4, 0.37)
    if not above:
        return False
    azimuths = 0.123 + np.arange(RING) * 2 * np.pi / RING
    odd = sum(count(LOW_RAD, azimuth) % 2 for azimuth in azimuths)
    if above % 2 and 2 * odd > RING:
        return True
    if count(-np.pi / 2 + 1e-4, 0.37):
        return False
    return all(count(HIGH_RAD, azimuth) for azimuth in azimuths)
