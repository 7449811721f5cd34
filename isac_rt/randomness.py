"""One generator per purpose, spawned from the scenario's seed by name, so that no draw depends on
the order of work."""

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
