"""Phases of diffuse scatterers: random, but a function of the place, so that all links see one
scatterer alike."""

from __future__ import annotations

import numpy as np

from isac_rt.randomness import seed_sequence, splitmix64


def scatterer_phase(points: np.ndarray, seed: int) -> np.ndarray:
    """(K,) phases in [0, 2 pi), hashed from the float32 bits of (K, 3) points and the seed."""
    bits = np.ascontiguousarray(points, np.float32).view(np.uint32).astype(np.uint64)
    state = np.full(
        points.shape[0],
        seed_sequence(seed, "scatterers").generate_state(1, np.uint64)[0],
        np.uint64,
    )
    for word in bits.T:
        state = splitmix64(state, word)
    return (state >> np.uint64(11)).astype(np.float64) * (2 * np.pi / 2**53)
