"""One generator per purpose, spawned from the scenario's seed by name, and one hash, so that no
draw depends on the order of work."""

from __future__ import annotations

import hashlib

import numpy as np


def seed_sequence(seed: int, *purpose: str | int) -> np.random.SeedSequence:
    """The seed of one purpose, for example ``seed_sequence(7, "noise", "PT1", frame)``."""
    text = "/".join(str(p) for p in purpose)
    words = np.frombuffer(hashlib.sha256(text.encode()).digest(), dtype="<u4")
    return np.random.SeedSequence([seed, *words.tolist()])


def generator(seed: int, *purpose: str | int) -> np.random.Generator:
    """A fresh generator for one purpose."""
    return np.random.Generator(np.random.SFC64(seed_sequence(seed, *purpose)))


def splitmix64(state: np.ndarray, word: np.ndarray) -> np.ndarray:
    """Hash (N,) uint64 with one more word (N,) uint64: splitmix64's step and finaliser."""
    with np.errstate(over="ignore"):
        state = state + (word + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))
