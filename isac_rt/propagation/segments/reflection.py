"""Reflection of a vertically polarised wave: slab coefficients along wall sequences."""

from __future__ import annotations

import numpy as np

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.segments.geometry import Segments
from isac_rt.world.city.materials import VACUUM_PERMITTIVITY, Material
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import mirror_image


def slab_coefficients(
    material: Material, cosine: np.ndarray, wavelength: float, *, whole: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Complex reflection coefficients of a slab for TE and TM waves over the cosine of incidence
    (ITU-R P.2040-3, eqs. 37, 43, 44), less what the material scatters unless `whole`."""
    omega = 2 * np.pi * SPEED_OF_LIGHT / wavelength
    eta = material.relative_permittivity - 1j * material.conductivity / (
        omega * VACUUM_PERMITTIVITY
    )
    root = np.sqrt(eta - (1 - cosine**2))
    phasor = np.exp(-4j * np.pi * material.thickness / wavelength * root)
    mirrored = 1.0 if whole else np.sqrt(1 - material.scattering_coefficient**2)
    te, tm = (cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)
    first, second = (mirrored * r * (1 - phasor) / (1 - r**2 * phasor) for r in (te, tm))
    return first, second


def vertical(direction: np.ndarray) -> np.ndarray:
    """(K, 3) the spherical unit vector theta of directions (K, 3): the field of a vertically
    polarised isotropic element.

    A vertical direction leaves it open; it is x then.
    """
    flat = np.hypot(direction[:, 0], direction[:, 1])
    safe = np.where(flat > 0, flat, 1.0)
    x, y = np.where(flat > 0, direction[:, 0] / safe, 1.0), direction[:, 1] / safe
    return np.stack([direction[:, 2] * x, direction[:, 2] * y, -flat], axis=1)


def mirrored_field(
    field: np.ndarray,
    along: np.ndarray,
    out: np.ndarray,
    normals: np.ndarray,
    te: np.ndarray,
    tm: np.ndarray,
) -> np.ndarray:
    """Fields (K, 3), complex, along `out` (K, 3) after a mirror of fields along unit vectors
    (K, 3): the part across the plane of incidence by TE, the part in it by TM (K,)."""
    across = np.cross(along, normals)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    # any direction will do, at normal incidence
    level = np.cross(along, np.where(np.abs(along[:, :1]) < 0.9, [1.0, 0, 0], [0, 1.0, 0]))
    across = np.where(
        size > 1e-9,
        across / np.maximum(size, 1e-9),
        level / np.linalg.norm(level, axis=1, keepdims=True),
    )
    first, second = (field * across).sum(1), (field * np.cross(across, along)).sum(1)
    return (te * first)[:, None] * across + (tm * second)[:, None] * np.cross(across, out)


def mirror_amplitude(
    city: CityMesh, normals: np.ndarray, faces: np.ndarray, segments: Segments, wavelength: float
) -> np.ndarray:
    """(K,) complex amplitudes of unfolded chains between isotropic vertical elements, without the
    carrier phase.

    Parameters
    ----------
    normals : (K, B, 3) unit normals of the chains' planes
    faces : (K, B) faces, which say the material
    segments : K segments
    """
    count, depth = faces.shape
    field = vertical(segments.departure).astype(complex)
    along = segments.departure
    for b in range(depth):
        normal = normals[:, b]
        cosine = np.minimum(np.abs((along * normal).sum(1)), 1.0)
        te, tm = np.empty(count, complex), np.empty(count, complex)
        material = city.face_material[faces[:, b]]
        for index in np.unique(material):
            here = material == index
            te[here], tm[here] = slab_coefficients(city.materials[index], cosine[here], wavelength)
        out = mirror_image(along, normal)
        field = mirrored_field(field, along, out, normal, te, tm)
        along = out
    return (field * vertical(segments.arrival)).sum(1) * wavelength / (4 * np.pi * segments.length)
