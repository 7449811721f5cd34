"""Kernels of the tracks' rules against their numpy twins, on generic numbers."""

from __future__ import annotations

import numpy as np
from twins import assert_twins_agree

from isac_rt.extensions.city_receivers import images
from isac_rt.kernels.jit import TWINS

MET = f"{images.__name__}.met"


def planes(rng: np.random.Generator, count: int) -> tuple[np.ndarray, ...]:
    """Planes through random places with boxes about these: normals, offsets, low, high."""
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places, half = rng.uniform(-23.7, 23.7, (count, 3)), rng.uniform(2.3, 17.1, (count, 3))
    return normals, (normals * places).sum(axis=1), places - half, places + half


def test_pairs_of_planes():
    """Pairs of 70 planes, some of which lead too far: sums of a few products of numbers about
    30, twice over, so that 1e-12 is rounding. Planted bugs in the kernel: the box of the other
    plane; the distance from the end for that from the image; a pair of a plane with itself."""
    rng = np.random.default_rng(3)
    ends, found = rng.uniform(-9.1, 9.1, (2, 3)), 0
    for reach in (23.9, 61.3):
        first, last = rng.permutation(70)[:61], rng.permutation(70)[:59]
        given = *ends, *planes(rng, 70), first, last, reach
        assert_twins_agree(MET, *given, rtol=1e-12)
        found += len(TWINS[MET][1](*given)[0])
    assert found > 20
    none = np.zeros(0, np.int64)
    assert_twins_agree(MET, *ends, *planes(rng, 70), none, none, 50.3, rtol=0)
