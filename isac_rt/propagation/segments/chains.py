"""Interaction sequences: rays find which walls a wave may meet one after the other, once for a
stretch of flight.

Rays leave a terminal from time samples, places at even distances along its planned flight, in
directions that differ from time sample to time sample, and are mirrored at each wall that they hit.
What they find are chains of planes, whatever the UAV that they lead to. The chains of the time
samples about an instant are pooled; images then say which of them are paths (`segments.images`).
Time samples, directions and pools are functions of the plan of the flight: a frame is the same
whether others were computed before it or not. From a place off the plan as many rays are sent as
from the time samples of a pool together.

Local coordinates. Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from isac_rt.propagation.clutter.visibility import Flight
from isac_rt.propagation.segments.geometry import RAY_OFFSET_M
from isac_rt.propagation.segments.rays import rays
from isac_rt.storage import cached, checksum, pack
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.city.scene import CityScenes
from isac_rt.world.mirrors import mirror_image
from isac_rt.world.swarm import Pose

AROUND = 2
"""Time samples on each side of the nearest one whose chains are pooled."""
SAMPLES_PER_BATCH = AROUND + 1
"""Time samples whose chains are sought, and kept for later runs, at once: no more than the first
frame needs."""
FAR = 1e6
"""Reach of the rays [m]."""
_AZIMUTH_STEP, _HEIGHT_STEP = 0.5698402909980532, 0.7548776662466927
"""Steps of the plane's most even sequence: turn of the directions from time sample to time sample,
and their shift along the axis."""


class Chains(NamedTuple):
    """Chains of planes as a tree: a chain is another one and one more plane.

    Attributes
    ----------
    parent : (N,) row of the chain without its last plane; -1 where there is but one
    plane : (N,) its last plane
    first : (B + 1,) chains of b planes have the rows from first[b - 1] to first[b]
    """

    parent: np.ndarray
    plane: np.ndarray
    first: np.ndarray


class Search:
    """Finds the chains about any instant of a run.

    Parameters
    ----------
    scenes : of the city; rays are sent in Sionna's
    city : CityMesh
    num_rays : per time sample
    depth : most planes of a chain
    flights : of the terminals, with their time samples; what flies without one is searched from
        where it is
    """

    def __init__(
        self,
        scenes: CityScenes,
        city: CityMesh,
        num_rays: int,
        depth: int,
        flights: Mapping[str, Flight],
    ) -> None:
        self._scenes, self._city = scenes, city
        self._num_rays, self._depth, self._flights = num_rays, depth, flights
        self._normals = city.normals
        self._mesh = ""
        self._kept: dict[tuple[str, int], Chains] = {}
        self._pools: dict[str, tuple[int, Chains]] = {}
        self._share: int | None = None

    def half(self, which: int) -> Search:
        """The same search by the even (0) or the odd (1) time samples alone: two searches that know
        nothing of each other."""
        out = copy.copy(self)
        out._share, out._pools = which, {}
        return out

    def chains(self, name: str, pose: Pose, time: float) -> Chains:
        """Chains of a terminal at a pose, local coordinates."""
        flight = self._flights.get(name)
        if flight is None or not flight.holds(pose, time):
            return self._pool([self._sent(pose.position, n) for n in self._window(0)])
        time_sample = int(np.clip(np.rint(flight.number(time)), 0, len(flight.time_samples) - 1))
        if name not in self._pools or self._pools[name][0] != time_sample:
            sequences = [self._time_sample(name, flight, n) for n in self._window(time_sample)]
            self._pools[name] = time_sample, self._pool(sequences)
            far = SAMPLES_PER_BATCH + AROUND
            for key in [k for k in self._kept if k[0] == name and abs(k[1] - time_sample) > far]:
                del self._kept[key]
        return self._pools[name][1]

    def _window(self, time_sample: int) -> list[int]:
        """Numbers of the time samples that are pooled; before the first and after the last time
        sample others are sent from these, in directions of their own."""
        every = range(time_sample - AROUND, time_sample + AROUND + 1)
        return [n for n in every if self._share is None or n % 2 == self._share]

    def _time_sample(self, name: str, flight: Flight, number: int) -> Chains:
        if (name, number) not in self._kept:
            first, count = number // SAMPLES_PER_BATCH * SAMPLES_PER_BATCH, len(flight.time_samples)
            near = range(max(first, -AROUND), min(first + SAMPLES_PER_BATCH, count + AROUND))
            positions = flight.time_samples[np.clip(near, 0, count - 1)]

            def found() -> list[list[np.ndarray]]:
                return [
                    [*self._sent(*time_sample)] for time_sample in zip(positions, near, strict=True)
                ]

            city = self._city
            mesh = [city.vertices, city.faces, city.plane_of_face]
            self._mesh = self._mesh or checksum(*pack(mesh))
            search = [positions, [*near], self._num_rays, self._depth, mi.variant()]
            for n, tree in zip(near, cached("chains", [self._mesh, *search], found), strict=True):
                self._kept[name, n] = Chains(*tree)
        return self._kept[name, number]

    def _pool(self, parts: Sequence[Chains]) -> Chains:
        """The chains of several searches, each once."""
        levels, new = _Levels(self._city.num_faces), [np.full(1, -1) for _ in parts]
        for b in range(self._depth):
            rows = [slice(part.first[b], part.first[b + 1]) for part in parts]
            # row -1 is the last of `new`, which stands for no chain
            parents = [n[part.parent[r]] for n, part, r in zip(new, parts, rows, strict=True)]
            planes = [part.plane[r] for part, r in zip(parts, rows, strict=True)]
            numbers = levels.grown(np.concatenate(parents), np.concatenate(planes))
            split = np.split(numbers, np.cumsum([len(p) for p in planes])[:-1])
            new = [np.concatenate([n[:-1], s, n[-1:]]) for n, s in zip(new, split, strict=True)]
        return levels.chains()

    def _sent(self, position: np.ndarray, number: int) -> Chains:
        """Chains that the rays of a time sample meet."""
        levels = _Levels(self._city.num_faces)
        along = directions(self._num_rays, number)
        at, chain = np.broadcast_to(position, along.shape), np.full(len(along), -1)
        last = chain
        for _ in range(self._depth):
            distance, face = self._hit(at, along)
            plane = np.where(face < 0, -1, self._city.plane_of_face[face])
            on = (face >= 0) & (plane != last)
            at, along, distance, face, last = at[on], along[on], distance[on], face[on], plane[on]
            chain = levels.grown(chain[on], last)
            normal = self._city.normals[face]
            side = np.sign((along * normal).sum(1))[:, None]
            at = at + distance[:, None] * along - RAY_OFFSET_M * side * normal
            along = mirror_image(along, normal)
        return levels.chains()

    def _hit(self, at: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ways (K,) [m] and faces (K,) that rays meet first, -1 where none."""
        if not len(at):
            return np.zeros(0), np.zeros(0, np.int64)
        ray = rays(at, along, np.full(len(at), FAR))
        handle = self._scenes.solved
        hit = handle.scene.mi_scene.ray_intersect_preliminary(ray)
        dr.eval(hit)  # once, not for each of its parts
        shape = np.asarray(dr.reinterpret_array(mi.UInt32, hit.shape))
        face = handle.face_index(shape, np.asarray(hit.prim_index, np.int64))
        return np.asarray(hit.t, np.float64), face


class _Levels:
    """A tree of chains that grows by one plane at a time."""

    def __init__(self, num_planes: int) -> None:
        self._num_planes = num_planes
        self._parents, self._planes = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        self._first = [0]

    def grown(self, parent: np.ndarray, plane: np.ndarray) -> np.ndarray:
        """(K,) rows of chains (K,) with a plane more each."""
        names = (parent + 1) * self._num_planes + plane
        keys, numbers = np.unique(names, return_inverse=True)
        before, after = np.divmod(keys, max(self._num_planes, 1))
        self._parents.append(before - 1)
        self._planes.append(after)
        start = self._first[-1]
        self._first.append(start + len(keys))
        return start + numbers

    def chains(self) -> Chains:
        """All so far."""
        parent, plane = np.concatenate(self._parents), np.concatenate(self._planes)
        return Chains(parent, plane, np.array(self._first))


def directions(count: int, number: int) -> np.ndarray:
    """(N, 3) unit vectors spread evenly over the sphere on a Fibonacci spiral; other ones for each
    number."""
    i, golden = np.arange(count), (np.sqrt(5) - 1) / 2
    z = 1 - 2 * (i + (0.5 + _HEIGHT_STEP * number) % 1) / count
    azimuth = 2 * np.pi * ((golden * i + _AZIMUTH_STEP * number) % 1)
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=1)
