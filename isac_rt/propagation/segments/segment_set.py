"""The segments between a terminal and a UAV at one instant."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import widened
from isac_rt.propagation.segments.geometry import Segments


@dataclass(frozen=True)
class SegmentSet:
    """All segments between a terminal and a UAV, local coordinates.

    Attributes
    ----------
    amplitude : (K,) complex, isotropic ends, without the carrier phase
    segments : Segments
    faces : (K, B) of the chains, -1 where a chain is shorter
    planes : (K, B) of the chains in a fixed order where two walls meet in an edge, -1 where a chain
        is shorter
    """

    amplitude: np.ndarray
    segments: Segments
    faces: np.ndarray
    planes: np.ndarray

    @property
    def bounces(self) -> np.ndarray:
        """(K,) of each chain."""
        return (self.faces >= 0).sum(axis=1)

    def __len__(self) -> int:
        return self.amplitude.size

    @classmethod
    def joined(cls, sets: list[SegmentSet]) -> SegmentSet:
        """All segments of some sets."""
        amplitude, segments, faces, planes = zip(*(vars(s).values() for s in sets), strict=True)
        columns = map(np.concatenate, zip(*(vars(s).values() for s in segments), strict=True))
        every = Segments(*columns)
        return cls(np.concatenate(amplitude), every, np.concatenate(faces), np.concatenate(planes))

    def select(self, which: np.ndarray) -> SegmentSet:
        """The segments that an index array chooses."""
        segments = self.segments.select(which)
        return SegmentSet(self.amplitude[which], segments, self.faces[which], self.planes[which])


class TracedSegments(NamedTuple):
    """Segments of all pairs at one instant as Sionna's solver has them; chains that contradict its
    own points, and chains that it found more than once, are left out and counted."""

    segments: dict[Link, SegmentSet]
    dropped: int = 0
    duplicates: int = 0


def segment_set(
    parts: list[tuple[np.ndarray, Segments, np.ndarray, np.ndarray]], depth: int
) -> SegmentSet:
    """Join (amplitude, segments, faces, planes) of one bounce count each, padded to `depth`."""
    shapes = (0,), (0,), (0,), (0, 3), (0, 3), (0, depth, 3)
    nothing = Segments(*map(np.zeros, shapes))
    chain = np.zeros((0, depth), np.int64)
    parts = [(np.zeros(0, complex), nothing, chain, chain), *parts]

    def joined(arrays: Iterable[np.ndarray], fill: float) -> np.ndarray:
        """Padded along the second axis to `depth`."""
        return np.concatenate([widened(a, depth, fill) for a in arrays])

    amplitudes, segments, faces, planes = zip(*parts, strict=True)
    *columns, points = zip(*(vars(part).values() for part in segments), strict=True)
    arrays = [*map(np.concatenate, columns), joined(points, np.nan)]
    amplitude, chains = np.concatenate(amplitudes), (joined(faces, -1), joined(planes, -1))
    return SegmentSet(amplitude, Segments(*arrays), *chains)
