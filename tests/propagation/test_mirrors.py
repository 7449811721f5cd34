"""Mirror reflections in float64: slabs against the sum of their inner echoes, chains of walls
against vectors written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from truths.truths import slab_reflection

from isac_rt.propagation.segments.geometry import unfold
from isac_rt.propagation.segments.reflection import mirror_amplitude, vertical
from isac_rt.world.city import CityMesh, Material
from isac_rt.world.swarm import Pose

C, F_C = 299_792_458.0, 77e9
LAMBDA = C / F_C
PANE = Material("pane", 6.31, 1.21, 0.43, "lambertian", 1, 0.012, "test")
METAL = replace(PANE, conductivity=1e12, scattering_coefficient=0.0)
ROUNDING = 1e-10


def echoes(material: Material, cosine: float) -> np.ndarray:
    """TE and TM coefficients less what is scattered."""
    of = material.relative_permittivity, material.conductivity, material.thickness
    kept = np.sqrt(1 - material.scattering_coefficient**2)
    return kept * np.array(slab_reflection(*of, cosine))


def facets(normals, offsets, materials) -> CityMesh:
    """One large triangle in each plane."""
    corners = []
    for n, d in zip(np.asarray(normals, float), offsets, strict=True):
        a = np.cross(n, [0.3, -0.5, 0.8])
        a /= np.linalg.norm(a)
        corners.append(d * n + 100 * np.array([a, np.cross(n, a), -a - np.cross(n, a)]))
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return CityMesh(
        "facets",
        np.concatenate(corners),
        faces,
        np.arange(len(corners), dtype=np.int16),
        tuple(materials),
        np.zeros(3),
    )


def still(*position: float) -> Pose:
    return Pose.at_rest(position)


def amplitude(
    normals, offsets, materials, start: Pose, end: Pose
) -> tuple[complex, np.ndarray, float]:
    """Amplitude of the chain over the planes in turn, its corners, and its length."""
    n, d = np.array(normals, float)[None], np.array(offsets, float)[None]
    segments = unfold(n, d, start, end)
    city = facets(normals, offsets, materials)
    value = mirror_amplitude(city, n, np.arange(len(materials))[None], segments, LAMBDA)[0]
    return (
        complex(value),
        np.vstack([start.position, segments.points[0], end.position]),
        float(segments.length[0]),
    )


def theta(direction: np.ndarray) -> np.ndarray:
    """Derivative of the unit vector by the angle from the zenith."""
    zenith, azimuth = np.arccos(direction[2]), np.arctan2(direction[1], direction[0])
    return np.array(
        [np.cos(zenith) * np.cos(azimuth), np.cos(zenith) * np.sin(azimuth), -np.sin(zenith)]
    )


def test_the_vertical_field():
    """Against the derivative by the angle from the zenith. Planted bugs: up for down; azimuth
    mirrored."""
    rng = np.random.default_rng(4)
    directions = rng.standard_normal((20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.abs(vertical(directions) - [theta(u) for u in directions]).max() < 1e-12
    straight_up = vertical(np.array([[0.0, 0.0, 1.0]]))[0]
    assert straight_up @ straight_up == pytest.approx(1, abs=1e-15) and straight_up[2] == 0


def test_conductors_turn_the_field_about_their_normals():
    """Over a conductor the reflected field is 2 (n.E) n - E whatever the polarisation: chains of
    one to three walls in any attitude, and back along the normal. Planted bugs: the incident
    field's frame for the reflected wave; TM with the other sign; length left out."""
    rng, walls = np.random.default_rng(7), []
    for _ in range(3):
        n = rng.standard_normal(3)
        walls.append(n / np.linalg.norm(n))
    a, b = still(1.3, -7.1, 4.7), still(-2.9, 5.3, 8.1)
    cases = [(walls[:k], [-21.3, 34.1, -57.7][:k], a, b) for k in (1, 2, 3)]
    cases.append(
        (
            [np.array([0.6, 0.64, 0.48])],
            [31.7],
            a,
            still(*(a.position + 1.9 * np.array([0.6, 0.64, 0.48]))),
        )
    )
    for normals, offsets, start, end in cases:
        value, corners, length = amplitude(normals, offsets, [METAL] * len(normals), start, end)
        segments = np.diff(corners, axis=0)
        scatter_paths = segments / np.linalg.norm(segments, axis=1, keepdims=True)
        field = theta(scatter_paths[0])
        for n in normals:
            field = 2 * (n @ field) * n - field
        truth = field @ theta(-scatter_paths[-1]) * LAMBDA / (4 * np.pi * length)
        assert abs(truth) * 4 * np.pi * length / LAMBDA > 0.05
        assert abs(value - truth) < 1e-4 * LAMBDA / (
            4 * np.pi * length
        )  # surface impedance of the conductor: 2e-6 over the cosine


def test_panes_reflect_each_polarisation_with_its_own_coefficient():
    """TM off the ground, TE off a wall at the terminals' height, and at a slant the projections on
    both, s = k x n / |k x n|. Planted bugs: TE and TM exchanged; the angle to the surface for that
    to the normal."""
    a, b = still(0.7, -6.1, 5.3), still(2.9, 8.7, 5.3)
    other = still(2.9, 8.7, 9.9)
    for normal, offset, end in (
        ((0, 0, 1.0), -1.7, b),
        ((1.0, 0, 0), -4.1, b),
        ((0.8, 0, 0.6), -3.3, other),
    ):
        n = np.array(normal)
        value, corners, length = amplitude([n], [offset], [PANE], a, end)
        scatter_paths = np.diff(corners, axis=0)
        into, out = scatter_paths / np.linalg.norm(scatter_paths, axis=1, keepdims=True)
        te, tm = echoes(PANE, abs(into @ n))
        s = np.cross(into, n) / np.linalg.norm(np.cross(into, n))
        field = theta(into)
        # the magnetic field k x E of the TM part lies along s and is multiplied by the coefficient;
        # then E = -(k x H)
        reflected = te * (field @ s) * s - tm * (np.cross(into, field) @ s) * np.cross(out, s)
        truth = reflected @ theta(-out) * LAMBDA / (4 * np.pi * length)
        assert abs(value - truth) < ROUNDING * LAMBDA / (4 * np.pi * length)
        assert abs(truth) > 1e-2 * LAMBDA / (4 * np.pi * length)
