r"""Mirrors of two-bounce clutter: the walls over which a terminal sees the city, chosen once for a
run.

A mirror is all faces of one plane and one material. Of all mirrors a terminal keeps those that send
on the most of what it radiates,

.. math:: \overline{\sum R\,(1 - S^2)\,\Omega / 4\pi},

the share of an isotropic antenna's power that meets the mirror's faces in sight (solid angle Omega)
and leaves them as from a mirror (R is the mean of the slab's TE and TM power reflectivity),
averaged over places along its flight. By reciprocity it is also the mirror's share of what can
reach the terminal. Being shares of one whole, they say what the mirrors left out could have held.

Local coordinates. Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.propagation.clutter.cells import Density, cut
from isac_rt.propagation.clutter.visibility import Flight
from isac_rt.propagation.segments.geometry import RAY_OFFSET_M, plane_of_each_face
from isac_rt.propagation.segments.rays import LosTest
from isac_rt.propagation.segments.reflection import slab_coefficients
from isac_rt.world.city.materials import Material
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import mirror_image, over_triangle, plane_crossing
from isac_rt.world.swarm import Pose

PLACES = 16
"""Places along a flight from which mirrors are weighed."""
MIN_HEIGHT_M = 0.01
"""A point this near to the plane of a mirror [m] does not show in it: it lies on the wall, or in
its corner."""
COARSE = Density(0.3, 2.0)
"""Cells by which solid angles are taken [m, m^2]: some 500 of them over a plane that fills half of
the view."""


@dataclass(frozen=True)
class Mirror:
    """One plane of one material.

    Attributes
    ----------
    normal, offset : points x of the plane obey normal.x = offset
    faces : (T,) of the city, the largest first
    corners : (T, 3, 3)
    material : Material
    share : of the power that the terminal radiates, which this mirror sends on
    """

    normal: np.ndarray
    offset: float
    faces: np.ndarray
    corners: np.ndarray
    material: Material
    share: float

    def image(self, pose: Pose) -> np.ndarray:
        """(3, 3) position, velocity and acceleration of a pose's image."""
        return mirror_image(pose.motion(), self.normal, np.array([self.offset, 0.0, 0.0]))


def strongest(
    city: CityMesh, los: LosTest, flight: Flight, wavelength: float, seed: int, most: int
) -> tuple[list[Mirror], float]:
    """The mirrors that send on the most of what a terminal radiates on its flight, strongest first,
    at most `most`; and the share that all others send on."""
    if not most or not city.num_faces:
        return [], 0.0
    positions = flight.time_samples[
        np.unique(np.linspace(0, len(flight.time_samples) - 1, PLACES).round().astype(int))
    ]
    cells = cut(city, np.ones(city.num_faces, bool), positions, COARSE, seed)
    _, group = np.unique(
        np.stack([city.plane_of_face, city.face_material.astype(np.int64)], axis=1),
        axis=0,
        return_inverse=True,
    )
    group = group.ravel()
    normals, offsets = plane_of_each_face(city)
    share = np.zeros(group.max() + 1)
    sent = [_reflected(m, wavelength) for m in city.materials]
    for position in positions:
        seen = np.flatnonzero(los.sees(position, cells.points, city.normals[cells.face]))
        span = cells.points[seen] - position
        r = np.linalg.norm(span, axis=1)
        face = cells.face[seen]
        cosine = np.minimum(np.abs((span * city.normals[face]).sum(1)) / r, 1.0)
        back = np.zeros(seen.size)
        for number, table in enumerate(sent):
            here = city.face_material[face] == number
            back[here] = np.interp(cosine[here], np.linspace(0, 1, table.size), table)
        # a cell near by is no point: its solid angle is at most a half-space
        angle = np.minimum(cells.area[seen] * cosine / r**2, 2 * np.pi)
        share += np.bincount(group[face], back * angle / (4 * np.pi), share.size) / len(positions)
    out = []
    order = np.argsort(-share, kind="stable")
    for number in order[:most]:
        if share[number] > 0:
            faces = np.flatnonzero(group == number)
            faces = faces[np.argsort(-city.areas[faces], kind="stable")]
            first = faces[0]
            material = city.materials[city.face_material[first]]
            out.append(
                Mirror(
                    normals[first],
                    float(offsets[first]),
                    faces,
                    city.corners[faces],
                    material,
                    float(share[number]),
                )
            )
    return out, float(share[order[most:]].sum())


def _reflected(material: Material, wavelength: float) -> np.ndarray:
    """Mean of the TE and TM power that a slab mirrors, over the cosine of incidence from 0 to 1,
    evenly."""
    te, tm = slab_coefficients(material, np.linspace(0.0, 1.0, 257), wavelength)
    return (np.abs(te) ** 2 + np.abs(tm) ** 2) / 2


def shown(
    los: LosTest,
    position: np.ndarray,
    mirrors: list[Mirror],
    points: np.ndarray,
    normals: np.ndarray,
) -> list[np.ndarray]:
    """Indices of those points (N, 3) on surfaces with normals (N, 3) that each mirror shows.

    The wave must meet the mirror on one of its faces, and both segments must be free.
    """
    found = [on_the_wall(points, position, m.normal, m.offset, m.corners) for m in mirrors]
    which = np.concatenate([f[0] for f in found])
    if not which.size:
        return [f[0] for f in found]
    at = np.concatenate([f[1] for f in found])
    side = [np.sign(m.normal @ position - m.offset) * m.normal for m in mirrors]
    wall = np.repeat(side, [f[0].size for f in found], axis=0)
    free = los.sees(position, at, wall)
    left = np.flatnonzero(free)
    here, there, own = points[which[left]], at[left], normals[which[left]]
    own = np.sign(((there - here) * own).sum(1))[:, None] * own
    free[left] = los.clear(here + RAY_OFFSET_M * own, there + RAY_OFFSET_M * wall[left])
    ends = np.cumsum([f[0].size for f in found])
    return [f[0][part] for f, part in zip(found, np.split(free, ends[:-1]), strict=True)]


def on_the_wall(
    points: np.ndarray, position: np.ndarray, normal: np.ndarray, offset: float, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find the points (N, 3) on the viewer's side of a mirror whose way to it from a place (3,)
    meets one of its triangles (T, 3, 3): their numbers, and where.

    A wave from the place comes from its image behind the wall.
    """
    above, up = normal @ position - offset, points @ normal - offset
    same = (up * above > 0) & (np.abs(up) >= MIN_HEIGHT_M) & (np.abs(above) >= MIN_HEIGHT_M)
    which = np.flatnonzero(same).astype(np.int32)
    image = mirror_image(position, normal, offset)
    met = plane_crossing(image, points[which], normal, offset)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = areas / np.linalg.norm(areas, axis=1, keepdims=True)
    inside = np.zeros(len(met), bool)
    for triangle, own in zip(corners, normals, strict=True):
        low, high = triangle.min(axis=0) - 1e-6, triangle.max(axis=0) + 1e-6
        near = np.flatnonzero(((met >= low) & (met <= high)).all(axis=1))
        inside[near] |= over_triangle(met[near], triangle, own, 1e-9)
    return which[inside], met[inside]
