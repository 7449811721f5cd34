"""The legs between a terminal and a UAV at one instant."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.propagation.legs.geometry import Legs
from isac_rt.propagation.pathset import widened


@dataclass(frozen=True)
class LegSet:
    """All legs between a terminal and a UAV, local coordinates.

    Attributes
    ----------
    amplitude : (K,) complex, isotropic ends, without the carrier phase
    legs : Legs
    faces : (K, B) of the chains, -1 where a chain is shorter
    planes : (K, B) of the chains in a fixed order where two walls meet in an edge, -1 where a chain
        is shorter
    """

    amplitude: np.ndarray
    legs: Legs
    faces: np.ndarray
    planes: np.ndarray

    @property
    def bounces(self) -> np.ndarray:
        """(K,) of each chain."""
        return (self.faces >= 0).sum(axis=1)

    def __len__(self) -> int:
        return self.amplitude.size

    @classmethod
    def joined(cls, sets: list[LegSet]) -> LegSet:
        """All legs of some sets."""
        amplitude, legs, faces, planes = zip(*(vars(one).values() for one in sets), strict=True)
        columns = map(np.concatenate, zip(*(vars(one).values() for one in legs), strict=True))
        every = Legs(*columns)
        return cls(np.concatenate(amplitude), every, np.concatenate(faces), np.concatenate(planes))

    def select(self, which: np.ndarray) -> LegSet:
        """The legs that an index array chooses."""
        legs = self.legs.select(which)
        return LegSet(self.amplitude[which], legs, self.faces[which], self.planes[which])


class TracedLegs(NamedTuple):
    """Legs of all pairs at one instant as Sionna's solver has them; chains that contradict its own
    points, and chains that it found more than once, are left out and counted."""

    legs: dict[Link, LegSet]
    dropped: int = 0
    duplicates: int = 0


def leg_set(parts: list[tuple[np.ndarray, Legs, np.ndarray, np.ndarray]], depth: int) -> LegSet:
    """One set of (amplitude, legs, faces, planes) of chains of one length each, padded to
    `depth`."""
    shapes = (0,), (0,), (0,), (0, 3), (0, 3), (0, depth, 3)
    nothing = Legs(*map(np.zeros, shapes))
    chain = np.zeros((0, depth), np.int64)
    parts = [(np.zeros(0, complex), nothing, chain, chain), *parts]

    def joined(arrays: Iterable[np.ndarray], fill: float) -> np.ndarray:
        """Padded along the second axis to `depth`."""
        return np.concatenate([widened(a, depth, fill) for a in arrays])

    amplitudes, legs, faces, planes = zip(*parts, strict=True)
    *columns, points = zip(*(vars(part).values() for part in legs), strict=True)
    arrays = [*map(np.concatenate, columns), joined(points, np.nan)]
    amplitude, chains = np.concatenate(amplitudes), (joined(faces, -1), joined(planes, -1))
    return LegSet(amplitude, Legs(*arrays), *chains)
