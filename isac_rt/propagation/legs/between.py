"""Legs between two traced instants: the same chains of walls unfolded in float64 where the swarm is
now.

A chain that was found at both instants around is taken to live in between. One that was found at
one of them only is born or dies on the way: rays say whether it is there now. Delays, rates,
accelerations, directions and amplitudes are exact for the chains that are there; what can be missed
is a chain that lives for less than the way between two traced instants, or a shadow as short.

Local coordinates. Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.propagation.legs.geometry import EDGE, Legs, unfold
from isac_rt.propagation.legs.rays import LIFT, Shadows
from isac_rt.propagation.legs.reflection import mirror_amplitude
from isac_rt.propagation.pathset import widened
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose

PROPER = 1e-9
"""Share of its length by which a path may differ from the sum of its segments; one that differs by
more runs through a mirror."""


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

    def select(self, which: np.ndarray) -> LegSet:
        """The legs that an index array chooses."""
        legs = self.legs.select(which)
        return LegSet(self.amplitude[which], legs, self.faces[which], self.planes[which])


class TracedLegs(NamedTuple):
    """Legs of all pairs at one instant; chains that contradict the ray tracer's points, and chains
    that it found more than once, are left out and counted."""

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


class Between:
    """Legs at any instant of a run from those of the traced instants around it.

    Parameters
    ----------
    instants : (I,) traced instants in rising order [s]
    trace : traces an instant
    city : CityMesh
    mirrors : normals (F, 3) and offsets (F,) of the plane that each face lies in
    shadows : for rays
    wavelength : [m]
    """

    def __init__(
        self,
        instants: np.ndarray,
        trace: Callable[[float], TracedLegs],
        city: CityMesh,
        mirrors: tuple[np.ndarray, np.ndarray],
        shadows: Shadows,
        wavelength: float,
    ) -> None:
        self._instants, self._trace, self._city, self._mirrors = instants, trace, city, mirrors
        self._shadows, self._wavelength = shadows, wavelength
        self._kept: dict[int, TracedLegs] = {}
        self._interval: tuple[int, list[_Chains]] = (0, [])
        self.num_traced = 0
        """Instants traced so far."""
        self.changes: dict[int, tuple[int, int]] = {}
        """Legs that were born and that died between a traced instant, by its number, and the
        next."""
        self.num_chains: dict[int, float] = {}
        """Legs there were on average at these two instants."""

    def legs(self, local: Mapping[str, Pose], time: float) -> TracedLegs:
        """Legs of every pair at an instant of the run, for the poses at that instant. Chains count
        as left out at the instants that are traced only."""
        if not self._instants[0] - 1e-9 <= time <= self._instants[-1] + 1e-9:
            return self._trace(time)  # before or after all frames: there is nothing to be between
        number = int(np.argmin(np.abs(self._instants - time)))
        if abs(self._instants[number] - time) < 1e-9:
            return self._traced(number)
        after = int(np.clip(np.searchsorted(self._instants, time), 1, len(self._instants) - 1))
        first, second = self._traced(after - 1).legs, self._traced(after).legs
        if self._interval[0] != after:
            self._interval = after, _chains(first, second)
            self.changes[after - 1] = _changes(self._interval[1])
            found_at_both = (c.in_first.sum() + c.in_second.sum() for c in self._interval[1])
            self.num_chains[after - 1] = sum(found_at_both) / 2
        nearest_first = time - self._instants[after - 1] <= self._instants[after] - time
        found = [
            self._unfolded(chains, local, list(first), nearest_first)
            for chains in self._interval[1]
        ]
        self._test(found)
        depth = next(iter(first.values())).faces.shape[1]
        return TracedLegs(self._settled(found, list(first), depth))

    def _traced(self, number: int) -> TracedLegs:
        if number not in self._kept:
            while len(self._kept) > 2:
                del self._kept[next(iter(self._kept))]
            self._kept[number] = self._trace(float(self._instants[number]))
            self.num_traced += 1
        return self._kept[number]

    def _unfolded(
        self, chains: _Chains, local: Mapping[str, Pose], pairs: list[Link], nearest_first: bool
    ) -> _Unfolded:
        """Where the chains run for these poses, and which of them may be there."""
        start, end = (
            _stacked([local[pair[side]] for pair in pairs], chains.pair) for side in (0, 1)
        )
        normals = self._mirrors[0][chains.faces]
        legs = unfold(normals, self._mirrors[1][chains.faces], start, end)
        stops = np.concatenate(
            [start.position[:, None], legs.points, end.position[:, None]], axis=1
        )
        proper = np.linalg.norm(np.diff(stops, axis=1), axis=2).sum(axis=1) <= legs.length * (
            1 + PROPER
        )
        in_edge = (np.linalg.norm(np.diff(legs.points, axis=1), axis=2) < EDGE).any(axis=1)
        both = chains.in_first & chains.in_second
        alive = proper & (both | ~in_edge | (chains.in_first == nearest_first))
        return _Unfolded(
            chains, normals, legs, stops, alive, doubtful=np.flatnonzero(alive & ~both & ~in_edge)
        )

    def _test(self, found: list[_Unfolded]) -> None:
        """Clear `alive` of doubtful chains that a wall blocks or whose wall ends before the point
        of reflection."""
        lifted = [_lifted(part.stops[part.doubtful], part.normals[part.doubtful]) for part in found]
        walls = [
            (end[:, :-1], 2 * part.stops[part.doubtful, 1:-1] - end[:, :-1])
            for part, (_, end) in zip(found, lifted, strict=True)
        ]
        clear = self._shadows.clear(
            *(np.concatenate([rays[side].reshape(-1, 3) for rays in lifted]) for side in (0, 1))
        )
        on_wall = ~self._shadows.clear(
            *(np.concatenate([rays[side].reshape(-1, 3) for rays in walls]) for side in (0, 1))
        )
        a = b = 0
        for part in found:
            count, depth = part.doubtful.size, part.chains.faces.shape[1]
            seen = clear[a : a + count * (depth + 1)].reshape(count, depth + 1).all(axis=1)
            part.alive[part.doubtful] = seen & on_wall[b : b + count * depth].reshape(
                count, depth
            ).all(axis=1)
            a, b = a + count * (depth + 1), b + count * depth

    def _settled(self, found: list[_Unfolded], pairs: list[Link], depth: int) -> dict[Link, LegSet]:
        """What lives, sorted by pair, bounces and length, with its amplitudes."""
        parts, owners = [], []
        for part in found:
            keep = np.flatnonzero(part.alive)
            legs, faces = part.legs.select(keep), part.chains.faces[keep]
            amplitude = mirror_amplitude(
                self._city, part.normals[keep], faces, legs, self._wavelength
            )
            parts.append((amplitude, legs, faces, part.chains.planes[keep]))
            owners.append(part.chains.pair[keep])
        every, owner = leg_set(parts, depth), np.concatenate(owners)
        order = np.lexsort([every.legs.length, every.bounces, owner])
        edges = np.searchsorted(owner[order], np.arange(len(pairs) + 1))
        rows = [order[a:b] for a, b in itertools.pairwise(edges)]
        return {pair: every.select(which) for pair, which in zip(pairs, rows, strict=True)}


@dataclass(frozen=True)
class _Chains:
    """Chains of B bounces that were found at one of two instants, or at both.

    Attributes
    ----------
    pair : (K,) number of the pair
    faces, planes : (K, B)
    in_first, in_second : (K,) bool
    """

    pair: np.ndarray
    faces: np.ndarray
    planes: np.ndarray
    in_first: np.ndarray
    in_second: np.ndarray


@dataclass(frozen=True)
class _Unfolded:
    """Chains at one instant; `stops` (K, B + 2, 3) are the places that each path visits in turn."""

    chains: _Chains
    normals: np.ndarray
    legs: Legs
    stops: np.ndarray
    alive: np.ndarray
    doubtful: np.ndarray


def _chains(first: Mapping[Link, LegSet], second: Mapping[Link, LegSet]) -> list[_Chains]:
    """The chains of two instants, by number of bounces."""
    out = []
    for count in range(next(iter(first.values())).faces.shape[1] + 1):
        faces, keys = [], []
        for when, found in enumerate((first, second)):
            for number, part in enumerate(found.values()):
                which = np.flatnonzero(part.bounces == count)
                faces.append(part.faces[which, :count])
                head = np.broadcast_to([number, when], (which.size, 2))
                keys.append(np.concatenate([head, part.planes[which, :count]], axis=1))
        every, key = np.concatenate(faces), np.concatenate(keys)
        late = key[:, 1] == 1
        alike, index, back = np.unique(
            np.delete(key, 1, axis=1), axis=0, return_index=True, return_inverse=True
        )
        seen = [np.zeros(len(alike), bool) for _ in range(2)]
        seen[0][back.ravel()[~late]] = True
        seen[1][back.ravel()[late]] = True
        out.append(_Chains(alike[:, 0], every[index], alike[:, 1:], *seen))
    return out


def _changes(chains: list[_Chains]) -> tuple[int, int]:
    """How many chains were found at the second instant only, and at the first only."""
    return sum(int((~c.in_first).sum()) for c in chains), sum(
        int((~c.in_second).sum()) for c in chains
    )


def _stacked(poses: list[Pose], which: np.ndarray) -> Pose:
    """One row of position, velocity and acceleration per chain."""
    motion = np.array([pose.motion() for pose in poses])[which]
    return Pose(motion[:, 0], motion[:, 1], motion[:, 2], np.eye(3))


def _lifted(stops: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Begins and ends (K, B + 1, 3) of the paths' segments, `LIFT` off the walls on the side where
    the path is."""
    lift = np.zeros_like(stops)
    side = np.sign(((stops[:, :-2] - stops[:, 1:-1]) * normals).sum(2))
    lift[:, 1:-1] = LIFT * side[..., None] * normals
    return (stops + lift)[:, :-1], (stops + lift)[:, 1:]
