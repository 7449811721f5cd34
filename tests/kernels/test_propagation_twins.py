"""Kernels of propagation and of the city beside their numpy twins, on generic numbers."""

from __future__ import annotations

import numpy as np
import pytest
from twins import assert_twins_agree

from isac_rt.kernels.jit import TWINS
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
