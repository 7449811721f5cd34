"""The city as one triangle mesh in float64, with what is derived from it: normals, planes,
areas."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isac_rt.storage import cached
from isac_rt.world.city.georeference import GeoReference
from isac_rt.world.city.heights import HIGHEST_M
from isac_rt.world.city.materials import CityError, Material, MaterialUse

_LOG = logging.getLogger(__name__)
PLANES_PER_SWEEP = 256
"""Planes after which the faces that have one are no longer asked."""
PLANE_TOLERANCE = 1e-6
"""Two faces share a plane if all corners of one lie this close to the plane of the other. [m]"""
MIN_CACHED_FACES = 3000
"""The planes of fewer faces are found in less time than it takes to read them."""
MAX_FACES = 10_000_000
SMALLEST_M = 2.0
"""Size below which a city raises a doubt [m]."""
MAX_COORDINATE = 1e8
"""Farther out float64 places no corner to a wavelength's phase, and no map has it. [m]"""


@dataclass(frozen=True)
class Surface:
    """A piece of a city as its source delivers it, in world coordinates, not yet cleaned.

    Parameters
    ----------
    vertices : (V, 3) float64
        [m]
    faces : (F, 3) int
    material : MaterialUse
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    material: MaterialUse


@dataclass(frozen=True)
class CityMesh:
    """A city as one float64 triangle mesh.

    Parameters
    ----------
    name : str
    vertices : (V, 3) float64
        Local coordinates: world - origin. [m]
    faces : (F, 3) int32
        Corners of each triangle.
    face_material : (F,) int16
        Index into `materials`.
    materials : tuple of Material
        At the carrier; only those in use.
    origin : (3,) float64
        [m]
    notes : tuple of str
        What was assumed, removed or left out on the way here, in words, for the user.
    plane_tolerance : float
        Coplanar within this. [m]
    num_beyond : int
        Faces that `within` cut away.
    reach : float
        Distance from the origin beyond which faces matter to nothing [m].
    georeference : Place or None
        Where it lies on Earth, of cities from maps.
    doubts : tuple of str
        Questions to the user: what looks as if it were meant otherwise.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    face_material: NDArray[np.int16]
    materials: tuple[Material, ...]
    origin: NDArray[np.float64]
    notes: tuple[str, ...] = ()
    plane_tolerance: float = PLANE_TOLERANCE
    num_beyond: int = 0
    reach: float = np.inf
    georeference: GeoReference | None = None
    doubts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for array in (self.vertices, self.faces, self.face_material, self.origin):
            array.setflags(write=False)

    def __repr__(self) -> str:
        size = np.ptp(self.vertices, axis=0) if self.num_faces else np.zeros(3)
        return (
            f"<CityMesh {self.name}: {self.num_faces} faces, {size[0]:.0f} x {size[1]:.0f} x "
            f"{size[2]:.0f} m, {len(self.materials)} materials>"
        )

    @property
    def num_faces(self) -> int:
        """F."""
        return len(self.faces)

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """(F, 3, 3) corners of the faces, local. [m]"""
        return _read_only(self.vertices[self.faces])

    @cached_property
    def boxes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(F, 3) lowest and (F, 3) highest coordinates of the faces, local. [m]"""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        return _read_only(low), _read_only(high)

    @cached_property
    def _cross(self) -> NDArray[np.float64]:
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> NDArray[np.float64]:
        """(F,) [m^2]"""
        return _read_only(np.linalg.norm(self._cross, axis=1) / 2)

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """(F, 3) unit normals, by the right-hand rule over the corners; outward where the source is
        oriented."""
        return _read_only(self._cross / np.linalg.norm(self._cross, axis=1, keepdims=True))

    @cached_property
    def plane_offsets(self) -> NDArray[np.float64]:
        """(F,) d of the plane normal . x = d, local coordinates. [m]"""
        return _read_only(np.einsum("fi,fi->f", self.normals, self.corners.mean(axis=1)))

    @cached_property
    def plane_of_face(self) -> NDArray[np.int64]:
        """(F,) id of the face's plane; faces in one plane share it, whichever way they face.

        Faces are taken from the largest down; each one not yet in a plane founds one and takes in
        all faces whose three corners lie within `plane_tolerance` of it. So a face's plane is never
        worse known than the face itself.
        """
        if not self.num_faces:
            return _read_only(np.zeros(0, dtype=np.int64))
        if self.num_faces < MIN_CACHED_FACES:
            return _read_only(self._planes())
        depends_on = [self.vertices, self.faces, self.plane_tolerance]
        return _read_only(cached("planes", depends_on, self._planes))

    def _planes(self) -> NDArray[np.int64]:
        _LOG.info("finding the planes of %s faces", f"{self.num_faces:,}")
        order = np.argsort(-self.areas, kind="stable")
        planes = np.empty(self.num_faces, dtype=np.int64)
        planes[order] = group_planes(
            self.corners[order],
            self.normals[order],
            self.plane_offsets[order],
            self.plane_tolerance,
        )
        return planes

    def within(self, radius: float) -> CityMesh:
        """The faces that come as near to the origin as `radius` [m], whole; their part beyond it
        scatters nothing (`reach`)."""
        if radius >= self.reach or not self.num_faces:
            return self
        corner = np.linalg.norm(self.corners, axis=2)
        if self.reach <= radius or (corner <= radius).all():
            return self
        near = corner.min(axis=1) <= radius
        if not near.all():  # few have an edge or a middle nearer than their corners
            near[~near] = distance_to_triangles(self.corners[~near], np.zeros(3)) <= radius
        kept = self if near.all() else self.of(near)
        beyond = self.num_beyond + int((~near).sum())
        return replace(kept, num_beyond=beyond, reach=min(radius, self.reach))

    def without(self, areas: Sequence[tuple[float, float, float, float]]) -> CityMesh:
        """The city but for the faces that lie wholly within one of some rectangles (x_min, y_min,
        x_max, y_max) in world coordinates [m]; this very city if there are none."""
        if not len(areas):
            return self
        positions = self.corners[..., :2] + self.origin[:2]
        out = [
            ((positions > a[:2]) & (positions < a[2:])).all(axis=(1, 2))
            for a in map(np.array, areas)
        ]
        return self.of(~np.any(out, axis=0))

    def displaced(self, std: float, rng: np.random.Generator) -> CityMesh:
        """The city with each of its planes moved along its normal by a Gaussian error of `std` [m];
        this very city if that is 0. Planes come apart at their edges."""
        if not std:
            return self
        plane = self.plane_of_face
        error = std * rng.standard_normal(int(plane.max(initial=-1)) + 1)
        corners = self.corners + (error[plane, None] * self.normals)[:, None]
        own = np.arange(3 * self.num_faces, dtype=np.int32).reshape(-1, 3)
        return replace(self, vertices=corners.reshape(-1, 3), faces=own)

    def of(self, some: NDArray[np.bool_]) -> CityMesh:
        """Some of the faces, with what they need."""
        faces, face_material = self.faces[some], self.face_material[some]
        corners, numbers = np.unique(faces, return_inverse=True)
        materials, owner = np.unique(face_material, return_inverse=True)
        return replace(
            self,
            vertices=self.vertices[corners],
            faces=numbers.reshape(-1, 3).astype(np.int32),
            face_material=owner.astype(np.int16),
            materials=tuple(self.materials[i] for i in materials),
        )

    def record(self) -> dict[str, Any]:
        """Return the record of a city for people and other programs: its name, where it lies, what
        was assumed."""
        geo = self.georeference
        return {
            "name": self.name,
            "crs": (geo and geo.crs) or None,
            "origin": None if geo is None else list(geo.origin),
            "plane": (geo and geo.plane) or None,
            "notes": list(self.notes),
        }

    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest local coordinates; zeros for an empty city. [m]"""
        if not len(self.vertices):
            return np.zeros((2, 3))
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def _read_only(array: NDArray) -> NDArray:
    array.setflags(write=False)
    return array


def empty_city(name: str, origin: NDArray[np.float64]) -> CityMesh:
    """Free space: a city without faces."""
    return CityMesh(
        name,
        np.zeros((0, 3)),
        np.zeros((0, 3), np.int32),
        np.zeros(0, np.int16),
        (),
        np.array(origin, dtype=np.float64),
    )


def distance_to_triangles(
    corners: NDArray[np.float64], point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance from a point to the nearest point of each triangle.

    Parameters
    ----------
    corners : (F, 3, 3) float64
        [m]
    point : (3,) float64
        [m]

    Returns
    -------
    distance : (F,) float64
        [m]
    """
    from trimesh.triangles import closest_point

    nearest = closest_point(corners, np.broadcast_to(point, (len(corners), 3)))
    return np.linalg.norm(nearest - point, axis=1)


def gathered(surfaces: Iterable[Surface], name: str) -> list[Surface]:
    """The surfaces of a source, held to `MAX_FACES` as they come: a small file may show one mesh a
    million times."""
    found, count = list[Surface](), 0
    for surface in surfaces:
        count += max(len(surface.faces), len(surface.vertices) // 3)
        if count > MAX_FACES:
            raise CityError(
                f"{name}: more than {MAX_FACES:,} faces; simplify it, or cut out what is near "
                "the swarm"
            )
        found.append(surface)
    return found


def check_coordinates(coordinates: NDArray[np.float64], what: str) -> None:
    """Refuse coordinates (..., D) that are no place on Earth. [m]"""
    if not np.isfinite(coordinates).all():
        bad = int((~np.isfinite(coordinates)).any(axis=-1).sum())
        raise CityError(
            f"{what}: {bad} of {len(coordinates)} vertices are NaN or infinite; repair the file"
        )
    farthest = np.abs(coordinates).max(initial=0.0)
    if farthest > MAX_COORDINATE:
        raise CityError(
            f"{what}: a coordinate is {farthest:.3g} m from the origin, and no place is beyond "
            f"{MAX_COORDINATE:g} m; correct it, or its scale"
        )


def check_size(corners: NDArray[np.float64], name: str, may_lie: bool) -> list[str]:
    """Return doubts about the size of a city, by the corners (F, 3, 3) of its faces [m], and, where
    it `may_lie` on its side, about its upright; refuse walls that nobody builds."""
    remedy = "city.scale: 0.001 where its unit is the millimetre, 0.01 the centimetre, 1000 the km"
    doubts, size = [], np.ptp(corners.reshape(-1, 3), axis=0)
    normals = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    lengths = np.linalg.norm(normals, axis=1)
    walls = np.ptp(corners[..., 2], axis=1)[normals[:, 2] < 0.5 * lengths]
    if (highest := walls.max(initial=0.0)) > HIGHEST_M:
        raise CityError(f"{name}: a wall is {highest:.0f} m high, which no building is; {remedy}")
    if size[2] > HIGHEST_M or size.max() < SMALLEST_M:
        written = " x ".join(f"{value:.3g}" for value in size)
        doubts.append(f"{name} is {written} m large; is it in metres? {remedy}")
    # a city is flat, and most of what is level and lowest is its ground and floors
    level = normals > 0.99 * lengths[:, None]
    lowest = corners.max(axis=1) - corners.min(axis=(0, 1)) < 0.01 * size
    base = np.where(level & lowest, normals, 0.0).sum(axis=0)
    flat = not base[1:].any() and 2 * size[1] < min(size[0], size[2])
    if may_lie and size[1] < size[2] and (base[1] > 2 * base[2] or flat):
        doubts.append(f"{name} seems to lie on its side; is city.up_axis: y meant, or z?")
    return doubts


def _merged(surfaces: Sequence[Surface], name: str) -> tuple[NDArray, NDArray, NDArray]:
    vertices = np.concatenate([s.vertices for s in surfaces])
    check_coordinates(vertices, name)
    starts = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
    for s in surfaces:
        if len(s.faces) and (s.faces.min() < 0 or s.faces.max() >= len(s.vertices)):
            raise CityError(
                f"{name}: a face names vertex {s.faces.max()} of {len(s.vertices)}; repair the file"
            )
    faces = np.concatenate([s.faces + start for s, start in zip(surfaces, starts, strict=True)])
    owner = np.repeat(np.arange(len(surfaces)), [len(s.faces) for s in surfaces])
    return vertices, faces, owner


def clean(
    surfaces: Sequence[Surface], name: str, centre: NDArray[np.float64], keep_radius: float | None
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64], list[str], float]:
    """One recentred mesh from a source's surfaces.

    Equal vertices are merged, zero-area and repeated faces removed (of repeated ones the first
    stays), and faces beyond `keep_radius` of the centre cut away whole.

    Parameters
    ----------
    surfaces : sequence of Surface
    name : str
        For messages.
    centre : (3,) float64
        World point that becomes the local origin. [m]
    keep_radius : float or None
        [m]

    Returns
    -------
    vertices : (V, 3) float64
        Local. [m]
    faces : (F, 3) int32
    owner : (F,) int64
        Index of each face's surface.
    notes : list of str
    plane_tolerance : float
        `PLANE_TOLERANCE`, or the rounding of float32 coordinates where the source holds no finer
        ones. [m]

    Raises
    ------
    CityError  If there is no face, a vertex is not finite, or nothing is left within the radius.
    """
    if not any(len(s.faces) for s in surfaces):
        raise CityError(
            f"{name}: there is no face in it; give a file with a triangle mesh or with polygons"
        )
    world, faces, owner = _merged(surfaces, name)
    notes = []
    tolerance = PLANE_TOLERANCE
    if np.array_equal(world, world.astype(np.float32)):
        tolerance = max(tolerance, float(np.spacing(np.float32(np.abs(world).max()))))
    world, index = np.unique(
        world + 0.0, axis=0, return_inverse=True
    )  # + 0.0 makes -0 and 0 the same point
    faces, local = index.reshape(-1)[faces], world - centre
    a, b, c = (local[faces[:, k]] for k in range(3))
    twice_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    flat = (
        twice_area <= 1e-9 * longest**2
    )  # thinner than a billionth of its length: its normal is rounding
    if flat.any():
        notes.append(f"{int(flat.sum())} faces without area removed")
    faces, owner = faces[~flat], owner[~flat]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) < len(faces):
        notes.append(f"{len(faces) - len(first)} repeated faces removed")
    first.sort()
    faces, owner = faces[first], owner[first]
    if keep_radius is not None and len(faces):
        near = distance_to_triangles(local[faces], np.zeros(3)) <= keep_radius
        if not near.all():
            notes.append(
                f"{int((~near).sum())} of {len(near)} faces beyond {keep_radius:g} m left out"
            )
        faces, owner = faces[near], owner[near]
    if not len(faces):
        within = (
            ""
            if keep_radius is None
            else f" within keep_radius_m {keep_radius:g} of {np.array2string(centre, precision=1)}"
        )
        raise CityError(
            f"{name}: no face with an area is left{within}; move the swarm, or widen the radius"
        )
    used, index = np.unique(faces, return_inverse=True)
    return local[used], index.reshape(-1, 3).astype(np.int32), owner, notes, tolerance


def group_planes(
    corners: NDArray[np.float64],
    normals: NDArray[np.float64],
    offsets: NDArray[np.float64],
    tolerance: float,
) -> NDArray[np.int64]:
    """Group faces (F, 3, 3), sorted by falling area, by plane: the largest that is left takes all
    whose corners lie this close to its plane. Numbers (F,) of the planes."""
    plane, number = np.full(len(corners), -1, np.int64), 0
    left, first = np.arange(len(corners)), np.ascontiguousarray(corners[:, 0])
    for seed in range(len(corners)):
        if plane[seed] >= 0:
            continue
        # one corner decides most
        some = left[np.abs(first @ normals[seed] - offsets[seed]) <= tolerance]
        near = np.abs(corners[some] @ normals[seed] - offsets[seed]) <= tolerance
        some = some[near.all(axis=1) & (plane[some] < 0)]
        plane[some] = plane[seed] = number
        number += 1
        if number % PLANES_PER_SWEEP == 0:
            still = plane[left] < 0
            left, first = left[still], first[still]
    return plane
