"""Kernels of propagation and of the city beside their numpy twins, on generic numbers."""

from __future__ import annotations

import numpy as np
import pytest
from twins import assert_twins_agree

from isac_rt.kernels.jit import TWINS
from isac_rt.propagation.clutter import cells
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
    import isac_rt.propagation.segments.discs  # noqa: F401  # has the twin

    rng = np.random.default_rng(9)
    count, discs = 300, 7
    starts, ends = rng.uniform(-40, 40, (2, count, 3))
    ends[17] = starts[17]
    before = rng.uniform(0, 60, count)
    total = before + np.linalg.norm(ends - starts, axis=1) + rng.uniform(0, 60, count)
    places, radii = rng.uniform(-25, 25, (discs, 3)), rng.uniform(0.1, 4, discs)
    name = "isac_rt.propagation.segments.discs.near"
    for spared in (rng.random((count, discs)) < 0.2, rng.random((1, discs)) < 0.3):
        paths = starts, ends, before, total
        assert_twins_agree(name, *paths, places, radii, spared, 0.0039, 3.7, rtol=1e-12)


@pytest.mark.sionna
def test_edges_near_a_path():
    """Edges strewn over 100 m and paths past them, of many with one near. Planted bug: the foot of
    the near end weighed by its own distance from the edge."""
    from isac_rt.propagation.segments.edges import Edges

    rng = np.random.default_rng(10)
    count = 700
    start, span = rng.uniform(-50, 50, (count, 3)), rng.uniform(-9, 9, (count, 3))
    wings = start[:, None] + rng.uniform(-9, 9, (count, 2, 3))
    middle, half = start + span / 2, np.linalg.norm(span, axis=1) / 2
    block = np.append(rng.permutation(count), np.full(4, -1)).reshape(-1, 32)
    centre = middle[block[:, 0]]
    apart = np.linalg.norm(middle[block] - centre[:, None], axis=2) + half[block]
    radius = np.where(block < 0, 0.0, apart).max(axis=1)
    edges = Edges(start, span, wings, middle, half, block, centre, radius)
    name, found = "isac_rt.propagation.segments.edges.near", []
    for source, sink in rng.uniform(-40, 40, (20, 2, 3)):
        for reach in (0.07, 1.3, 30.0):
            # a detour is a difference of lengths of 100 m
            assert_twins_agree(name, edges, source, sink, reach, rtol=1e-12, atol=1e-12)
            found.append(len(TWINS[name][1](edges, source, sink, reach)[0]))
    assert 0 in found and max(found) == 24 and len(set(found)) > 5


@pytest.mark.sionna
@pytest.mark.parametrize("depth", [1, 3])
def test_chains_that_reach_a_place(depth):
    """All chains of up to three of the planes of a city of blocks, to places before and behind its
    walls. Planted bugs: the mirror crossed from either side; the parent's image left out."""
    from isac_rt.propagation.segments.chains import Chains
    from isac_rt.propagation.segments.images import Mirrors
    from isac_rt.scenario import City
    from isac_rt.world.city import load_city

    blocks = City(source="blocks", blocks_x=2, blocks_y=2, block_size_m=17.3)
    city = load_city(blocks, ".", 77e9, np.zeros(3))
    planes = np.unique(city.plane_of_face)
    parent, plane, first = [np.full(len(planes), -1)], [planes], [0, len(planes)]
    for _ in range(depth - 1):
        each = np.arange(first[-2], first[-1])
        each = each if len(each) < 100 else each[::7]
        other = np.tile(planes, len(each)) != np.repeat(np.concatenate(plane)[each], len(planes))
        parent.append(np.repeat(each, len(planes))[other])
        plane.append(np.tile(planes, len(each))[other])
        first.append(first[-1] + parent[-1].size)
    chains = Chains(np.concatenate(parent), np.concatenate(plane), np.array(first))
    ends = np.random.default_rng(11).uniform([-20, -20, 2], [20, 20, 25], (12, 3))
    name = "isac_rt.propagation.segments.images.reflected"
    arguments = chains, Mirrors.of(city), depth, np.array([1.3, -2.1, 9.7]), ends
    assert_twins_agree(name, *arguments, rtol=0)
    lengths = (TWINS[name][1](*arguments)[:, 1:] >= 0).sum(axis=1)
    assert {*lengths} == set(range(1, depth + 1)) and len(lengths) > 10


def test_cells_of_a_surface():
    """Faces large and small, near a flight and beyond the reach; and the end where there are too
    many. Planted bugs: the second of equally long edges halved; a cell's radius left out of its
    distance."""
    rng = np.random.default_rng(12)
    middle = rng.uniform(-60, 60, (40, 1, 3))
    corners = middle + rng.uniform(-1, 1, (40, 3, 3)) * rng.uniform(1, 30, (40, 1, 1))
    corners[0] = 8.7 * np.sqrt([[0, 0, 0], [1, 0, 0], [0.25, 0.75, 0]])  # sides alike
    span = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(span[:, 0], span[:, 1]), axis=1) / 2
    state = rng.integers(0, 2**63, 40).astype(np.uint64)
    places = np.linspace([-30.3, 5.1, 12.2], [44.1, -3.7, 15.9], 83)
    arguments = (corners, area, state), places, cells._boxes(places), (0.13, 0.21, 7.3, 55.7)
    name = "isac_rt.propagation.clutter.cells.leaves"
    # an area halved is exact, a point is as good as its corners
    assert_twins_agree(name, *arguments, 100_000, rtol=1e-14)
    assert TWINS[name][1](*arguments, 100_000)[0] > 1_000
    assert [f(*arguments, 900)[0] for f in TWINS[name]] == [901, 901]
