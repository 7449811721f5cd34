"""Kernels of propagation and of the city beside their numpy twins, on generic numbers."""

from __future__ import annotations

import numpy as np
import pytest
from twins import assert_twins_agree

from isac_rt.propagation.clutter.field import Rows, Surfaces


@pytest.mark.parametrize("own", [True, False])
def test_scatterers_in_flight(own):
    """Three materials, two of them with lobes, seen from both sides. Planted bugs: TE and TM
    exchanged; the speed along the path not taken off the acceleration."""
    rng = np.random.default_rng(7)
    count, faces = 400, 23
    normals = rng.normal(size=(faces, 3))
    surfaces = Surfaces(
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        rng.integers(0, 3, faces),
        rng.uniform(0.1, 0.9, (3, 33, 3)),
        rng.uniform(0.1, 0.4, 3),
        np.array([-1.0, 0.7, 1.0]),
        np.array([1.0, 4.0, 9.0]),
    )
    points = rng.uniform(-40, 40, (count, 3))
    cell = rng.permutation(count)[:301].astype(np.int32)
    arrays = [np.full(301, np.nan) for _ in range(5)]
    arrays[2] = arrays[2].astype(np.float32)
    departure = np.full((301, 3), np.nan)
    arrival = departure if own else np.full((301, 3), np.nan)
    if own:
        arrays[4] = arrays[3]
    rows = Rows(*arrays, departure, arrival, cell, np.zeros(301, np.float32))
    ends = [rng.normal(size=(3, 3)) * [[30], [12], [3]] for _ in range(2)]
    each = rng.integers(0, faces, count), rng.uniform(0.1, 2, count), rng.uniform(0, 1, count)
    # accelerations and magnitudes are float32
    name = "isac_rt.propagation.clutter.field.advance"
    start, end = (ends[0], ends[0]) if own else ends
    assert_twins_agree(name, surfaces, points, *each, 0.37, start, end, own, rows, rtol=2e-7)


@pytest.mark.sionna
def test_points_that_a_mirror_shows():
    """Two triangles of a wall on a slant, points on both sides. Planted bug: the share of the way
    counted from the other end."""
    import isac_rt.propagation.clutter.mirrors  # noqa: F401  # has the twin

    rng = np.random.default_rng(8)
    normal = np.array([0.8, 0.36, 0.48])
    across = np.linalg.svd(normal[None])[2][1:]
    square = np.array([[-9.3, -4.1], [8.2, -4.4], [8.7, 5.9], [-9.1, 5.2]]) @ across + 3.1 * normal
    corners = square[np.array([[0, 1, 2], [0, 2, 3]])]
    points = rng.uniform(-30, 30, (2000, 3))
    place = np.array([14.3, 9.7, 6.1])
    name = "isac_rt.propagation.clutter.mirrors.on_the_wall"
    assert_twins_agree(name, points, place, normal, 3.1, corners, rtol=1e-12)  # rounding


def test_planes_of_faces():
    """Boxes that share some planes and not others. Planted bug: a plane taken for all that touch
    it with one corner."""
    rng = np.random.default_rng(9)
    faces = []
    for x, height in zip(rng.uniform(-50, 50, 12), rng.choice([5.25, 8.5], 12), strict=True):
        a, b = np.array([x, 0.0, 0.0]), np.array([x + 3.3, 7.7, height])
        for axis in range(3):
            for end in (a, b):
                square = np.array([a, a, b, b])
                square[[1, 2], (axis + 1) % 3] = b[(axis + 1) % 3]
                square[[0, 3], (axis + 1) % 3] = a[(axis + 1) % 3]
                square[:, axis] = end[axis]
                faces += [square[[0, 1, 2]], square[[0, 2, 3]]]
    corners = np.array(faces)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(areas, axis=1)
    order = np.argsort(-size, kind="stable")
    corners, normals = corners[order], (areas / size[:, None])[order]
    offsets = (normals * corners[:, 0]).sum(axis=1)
    name = "isac_rt.world.city.mesh.group_planes"
    assert_twins_agree(name, corners, normals, offsets, 1e-6, rtol=0)


def test_segments_that_pass_a_disc():
    """Segments near and far, one of length zero, some spared. Planted bug: the distance before the
    segment left out of the Fresnel zone."""
    import isac_rt.propagation.legs.bodies  # noqa: F401  # has the twin

    rng = np.random.default_rng(9)
    count, discs = 300, 7
    starts, ends = rng.uniform(-40, 40, (2, count, 3))
    ends[17] = starts[17]
    before = rng.uniform(0, 60, count)
    total = before + np.linalg.norm(ends - starts, axis=1) + rng.uniform(0, 60, count)
    places, radii = rng.uniform(-25, 25, (discs, 3)), rng.uniform(0.1, 4, discs)
    name = "isac_rt.propagation.legs.bodies.near"
    for spared in (rng.random((count, discs)) < 0.2, rng.random((1, discs)) < 0.3):
        paths = starts, ends, before, total
        assert_twins_agree(name, *paths, places, radii, spared, 0.0039, 3.7, rtol=1e-12)
