"""Visibility of scatterers along a flight.

Shadow rays are tested from time samples, every half metre of the planned flight. Where visibility
changes between two of them, `penumbra` finds the shadow edge, near which visibility is the modulus
of the complex knife-edge factor F. With several crossings, F is the visibility at the nearest time
sample plus the change of each crossing: +-(F_k at the time - F_k at the time sample), with the
limits 0 and 1 of F_k at the time sample. This is the field behind the apertures that the edges
bound. Visibility is a function of time alone: a frame does not depend on frames computed before it.

Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from scipy.interpolate import BSpline

from isac_rt.propagation.clutter.penumbra import REACH as PENUMBRA
from isac_rt.propagation.clutter.penumbra import Crossings, Facets, crossings, penumbra
from isac_rt.propagation.segments.rays import LosTest
from isac_rt.storage import cached, checksum, pack
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose, Trajectory

SAMPLE_SPACING = 0.5
"""Spacing of time samples along a flight [m]."""
OFF_FLIGHT = 1e-3
"""Distance from the planned flight beyond which a pose is tested by shadow rays alone [m]."""
REACH = 3
"""Time samples on each side over which visibility over mirrors is averaged."""
AROUND = 8
"""Time samples on each side whose crossings contribute to visibility."""
SAMPLES_PER_BATCH = 4
"""Time samples tested and cached at a time."""
BORESIGHT_SAMPLES = 81
"""Instants of a run at which boresights are sampled."""
WIDEST = (AROUND - 1) / PENUMBRA
"""Widest penumbra [time samples per Fresnel unit]; it ends within `AROUND` of its crossing."""
BLEND = BSpline.basis_element(np.arange(-REACH, REACH + 1))
"""Weights of that average: a quintic B-spline."""


class Flight:
    """Flight of one terminal in a run, with its time samples.

    Parameters
    ----------
    trajectory : of the terminal
    duration : of the run [s]
    origin : (3,) of the local coordinates [m]
    spacing : largest spacing of time samples [m]
    """

    def __init__(
        self,
        trajectory: Trajectory,
        duration: float,
        origin: np.ndarray,
        spacing: float = SAMPLE_SPACING,
    ) -> None:
        self._trajectory, self._origin = trajectory, origin
        self._times = np.linspace(0.0, duration, 2001)
        track = trajectory.positions(self._times)
        self._distance = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=1))]
        )
        self.spacing = max(
            self._distance[-1] / max(np.ceil(self._distance[-1] / spacing), 1.0), 1e-9
        )
        count = round(self._distance[-1] / self.spacing) + 1
        times = np.interp(self.spacing * np.arange(count), self._distance, self._times)
        self.time_samples = trajectory.positions(times) - origin
        """(K, 3) local [m]"""

    @cached_property
    def fronts(self) -> np.ndarray:
        """Half-spaces (S, 5) in front of the terminal, one for each boresight of the run: unit
        normal, offset along it [m], and largest change of the boresight between two of the
        `BORESIGHT_SAMPLES` [rad]."""
        poses = [
            self._trajectory.pose(time) for time in self._times[:: 2000 // (BORESIGHT_SAMPLES - 1)]
        ]
        positions = np.array([pose.position for pose in poses]) - self._origin
        boresights = np.array([pose.rotation[:, 1] for pose in poses])
        step, tilt = (
            np.linalg.norm(np.diff(a, axis=0), axis=1).max() for a in (positions, boresights)
        )
        normals, row = np.unique(boresights, axis=0, return_inverse=True)
        begins = np.full(len(normals), np.inf)  # at the rearmost position with this boresight
        np.minimum.at(begins, row.ravel(), (positions * boresights).sum(axis=1) - step)
        return np.column_stack([normals, begins, np.full(len(normals), tilt)])

    def holds(self, pose: Pose, time: float) -> bool:
        """Test that a pose, local, lies on the planned flight."""
        return bool(
            np.linalg.norm(self._trajectory.pose(time).position - self._origin - pose.position)
            < OFF_FLIGHT
        )

    def number(self, time: float) -> float:
        """Return the number of time samples until a time [s], with a fraction."""
        return float(np.interp(time, self._times, self._distance) / self.spacing)

    def blend(self, time: float) -> dict[int, float]:
        """Return the time samples around a time [s] with their weights `BLEND`; the weights sum to
        one."""
        q = self.number(time)
        nearby = np.arange(np.ceil(q - REACH), q + REACH)
        out: dict[int, float] = {}
        for time_sample, weight in zip(
            np.clip(nearby, 0, len(self.time_samples) - 1).astype(int).tolist(),
            BLEND(nearby - q).tolist(),
            strict=True,
        ):
            out[time_sample] = out.get(time_sample, 0.0) + weight
        return out


def ever_ahead(fronts: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Mark the points (N, 3), local, in any of the half-spaces `Flight.fronts` (S, 5), each widened
    by its change of the boresight times the distance of the farthest point."""
    normals, begins, tilt = np.split(fronts, [3, 4], axis=1)
    farthest = np.linalg.norm(points, axis=1).max(initial=0.0)
    out = np.zeros(len(points), bool)
    for normal, begin in zip(normals, begins - tilt * farthest, strict=True):
        out |= points @ normal > begin
    return out


class _Stretch(NamedTuple):
    """Batch of `SAMPLES_PER_BATCH` time samples of a flight and the next one: the points visible
    from each, packed to bits (T + 1, N / 8), and the crossings between neighbours."""

    seen: np.ndarray
    crossed: list[Crossings]


class Visibility:
    """Visibility of N points from each terminal at any time of a run: 0, 1, or the modulus of the
    knife-edge factor in a penumbra.

    Parameters
    ----------
    los : test of lines of sight by rays
    flights : by terminal
    facets : the N points
    wavelength : [m]
    city : whose faces cast the shadows
    """

    def __init__(
        self,
        los: LosTest,
        flights: dict[str, Flight],
        facets: Facets,
        wavelength: float,
        city: CityMesh,
    ) -> None:
        self.los, self.flights = los, flights
        self._facets, self._wavelength = facets, wavelength
        self._depends_on = [city.vertices, city.faces, [*facets], wavelength, mi.variant()]
        self._content = ""
        self._stretches: dict[tuple[str, int], _Stretch] = {}
        self._nearby: dict[str, _Nearby] = {}

    @property
    def nbytes(self) -> int:
        """Memory of the stored visibility and crossings [bytes]."""
        stretches = self._stretches.values()
        crossed = [vars(c).values() for c in self._nearby.values()]
        crossed += [vars(c).values() for stretch in stretches for c in stretch.crossed]
        return sum(stretch.seen.nbytes for stretch in stretches) + sum(
            a.nbytes for values in crossed for a in values if isinstance(a, np.ndarray)
        )

    def share(self, name: str, pose: Pose, time: float) -> np.ndarray:
        """Return the visibility (N,) float32 from a terminal at a pose, local coordinates."""
        flight = self.flights[name]
        if not flight.holds(pose, time):
            return self.from_places(pose.position[None])[0].astype(np.float32)
        # visibility from the nearest time sample
        q = flight.number(time)
        time_sample = int(np.clip(np.rint(q), 0, len(flight.time_samples) - 1))
        if name not in self._nearby or self._nearby[name].time_sample != time_sample:
            self._nearby[name] = self._near(name, time_sample)
        near = self._nearby[name]
        bits = self._stretch(name, time_sample // SAMPLES_PER_BATCH).seen[
            time_sample % SAMPLES_PER_BATCH
        ]
        out = np.unpackbits(bits, count=len(self._facets.points)).astype(np.float32)
        # changes of F by the crossings around it, added by scatterer
        if near.row.size:
            step = np.where(near.gained, 1, -1) * (
                penumbra((q - near.where) / near.width) - (near.where < time_sample)
            )
            real, imaginary = np.bincount(near.row, step.real), np.bincount(near.row, step.imag)
            out[near.index] = np.abs(out[near.index] + real + 1j * imaginary)
        return out

    def from_places(self, positions: np.ndarray) -> np.ndarray:
        """Return the visibility (K, N) bool from positions (K, 3), by rays alone."""
        return self.los.all_seen(positions, self._facets.points, self._facets.normals)

    def ever(self, positions: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return the visibility (N,) bool from any of positions (K, 3), by rays alone; points
        `known` (N,) to be visible are not tested."""
        out, left = known.copy(), np.flatnonzero(~known)
        points, normals = self._facets.points[left], self._facets.normals[left]
        out[left] = self.los.ever_sees(positions, points, normals)
        return out

    def _near(self, name: str, time_sample: int) -> _Nearby:
        """Collect the crossings within `AROUND` of a time sample; drop stored batches beyond."""
        flight = self.flights[name]
        spans = range(
            max(time_sample - AROUND, 0), min(time_sample + AROUND, len(flight.time_samples) - 1)
        )
        parts = [
            self._stretch(name, n // SAMPLES_PER_BATCH).crossed[n % SAMPLES_PER_BATCH]
            for n in spans
        ]
        reach = range(
            (time_sample - AROUND) // SAMPLES_PER_BATCH,
            (time_sample + AROUND) // SAMPLES_PER_BATCH + 1,
        )
        for key in [k for k in self._stretches if k[0] == name and k[1] not in reach]:
            del self._stretches[key]
        if not parts:
            types = np.int32, np.int32, float, float, bool
            return _Nearby(time_sample, *(np.zeros(0, dtype) for dtype in types))
        index, row = np.unique(np.concatenate([c.index for c in parts]), return_inverse=True)
        where = np.concatenate(
            [number + c.where.astype(float) for number, c in zip(spans, parts, strict=True)]
        )
        width = np.concatenate([c.width for c in parts]) / flight.spacing
        gained = np.concatenate([c.gained for c in parts])
        return _Nearby(
            time_sample,
            index,
            row.ravel().astype(np.int32),
            where,
            np.minimum(width, WIDEST),
            gained,
        )

    def _stretch(self, name: str, number: int) -> _Stretch:
        """Return visibility and crossings of a batch of time samples."""
        if (name, number) not in self._stretches:
            time_samples = self.flights[name].time_samples[
                SAMPLES_PER_BATCH * number : SAMPLES_PER_BATCH * (number + 1) + 1
            ]

            def found() -> dict[str, Any]:
                seen = self.from_places(time_samples)
                pairs = [slice(k, k + 2) for k in range(len(time_samples) - 1)]
                crossed = [self._crossings(time_samples[pair], seen[pair]) for pair in pairs]
                return {"seen": np.packbits(seen, axis=1), "crossed": [vars(c) for c in crossed]}

            self._content = self._content or checksum(*pack(self._depends_on))
            of = cached("sight", [self._content, time_samples], found)
            crossed = [Crossings(**c) for c in of["crossed"]]
            self._stretches[name, number] = _Stretch(of["seen"], crossed)
        return self._stretches[name, number]

    def _crossings(self, time_samples: np.ndarray, seen: np.ndarray) -> Crossings:
        """Return the crossings between two time samples (2, 3) with visibility `seen` (2, N)."""
        return crossings(self.los.triangles, time_samples, seen, self._facets, self._wavelength)


@dataclass(frozen=True)
class _Nearby:
    """K crossings around one time sample, of R scatterers: indices (R,) of the scatterers, the
    row (K,) in `index` of each crossing, and its position and sigma (K,) in time samples."""

    time_sample: int
    index: np.ndarray
    row: np.ndarray
    where: np.ndarray
    width: np.ndarray
    gained: np.ndarray
