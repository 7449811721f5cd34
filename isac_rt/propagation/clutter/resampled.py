"""Phases of diffuse scatterers: random, but a function of the place, so that all links see one
scatterer alike."""

from __future__ import annotations

import numpy as np

from isac_rt.randomness import seed_sequence


def scatterer_phase(points: np.ndarray, seed: int) -> np.ndarray:
    """(K,) phases in [0, 2 pi), hashed from the float32 bits of (K, 3) points and the seed.

    The mixing is splitmix64's finaliser, applied after each coordinate.
    """
    bits = np.ascontiguousarray(points, np.float32).view(np.uint32).astype(np.uint64)
    state = np.full(
        points.shape[0],
        seed_sequence(seed, "scatterers").generate_state(1, np.uint64)[0],
        np.uint64,
    )
    with np.errstate(over="ignore"):
        for axis in range(3):
            state = state + (bits[:, axis] + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
            state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)).astype(np.float64) * (2 * np.pi / 2**53)
