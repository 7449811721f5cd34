r"""Diffuse clutter of scatterers that are fixed to the mesh, coherent while the radar flies.

Each scatterer represents one cell of a surface (`cells`). Between two isotropic antennas its mean
power gain is

.. math::

    |a|^2 = (\lambda/4\pi)^2\, S^2\, \Gamma^2(\theta_i)\, f_s(k_i, k_o)\, \cos\theta_i\, A / (r_1
    r_2)^2,

and its amplitude has a fixed complex-Gaussian factor of unit power. The mean power of a surface is
then the effective-roughness integral [1]_, which Sionna RT evaluates by ray launching, and the
speckle of a range-Doppler cell is Rayleigh for any number of scatterers. S is the material's
scattering coefficient, Gamma the reflection of the slab (ITU-R P.2040) for the TE and TM parts of
the vertically polarised wave, f_s the pattern: Lambert's cos(theta_o)/pi, or lobes. Polarisation is
kept (vertical in, vertical out), as by Sionna's default. Gamma is that of the incident direction,
so that the gains of both directions of a link differ slightly.

One bounce; `isac_rt.extensions.two_bounces` adds a mirror reflection before or after it. Delay,
rate, acceleration and directions are float64 closed forms of the point and the poses.

Import only after `isac_rt.runtime.activate()`.

References
----------
.. [1] V. Degli-Esposti et al., "Measurement and modelling of scattering from buildings", IEEE
Trans. Antennas Propag. 55(1),
   2007, doi:10.1109/TAP.2006.888422.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import comb
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.kernels import propagation_field
from isac_rt.kernels.jit import twin_of
from isac_rt.plain import plain
from isac_rt.propagation.clutter.cells import MOST_CELLS, Cells, Density, cut, error_for
from isac_rt.propagation.clutter.merging import (
    NoiseFloor,
    VisibleCells,
    merged_below_noise,
    resolution_cell,
)
from isac_rt.propagation.clutter.overlaps import lies_twice
from isac_rt.propagation.clutter.penumbra import Facets
from isac_rt.propagation.clutter.visibility import SAMPLE_SPACING, Flight, Visibility, ever_ahead
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.scatter_paths import LinkState, ScatterPaths
from isac_rt.propagation.segments.discs import UavDiscs
from isac_rt.propagation.segments.rays import LosTest
from isac_rt.propagation.segments.reflection import slab_coefficients
from isac_rt.storage import cached
from isac_rt.world.city.materials import Material
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose, Swarm

TABLE = 4097
"""Angles of a material's reflectivity table, uniform in the cosine; interpolated linearly."""
TEST_SPACING_M = 1.0
"""Spacing along transmitters' flights of the positions from which all cells are tested [m]; a cell
visible from none is left out."""


class Surfaces(NamedTuple):
    """Faces and materials of a city as arrays for the kernel.

    Attributes
    ----------
    normals : (F, 3) unit normals
    material : (F,) int64
    table : (M, T, 3) TE and TM power reflectivity, and the norm 1/F of the lobe, over the cosine of
        incidence from 0 to 1
    coefficient : (M,) S^2
    lobe : (M,) share of the lobe about the mirror direction; -1: Lambert's pattern
    exponent : (M,) alpha of the lobes
    """

    normals: np.ndarray
    material: np.ndarray
    table: np.ndarray
    coefficient: np.ndarray
    lobe: np.ndarray
    exponent: np.ndarray


@dataclass(frozen=True)
class Visible(ScatterPaths):
    """Paths over K scatterers of the field between two terminals at one instant, for isotropic
    antennas.

    Magnitude and acceleration are float32. On a monostatic link both ends share arrays.

    Attributes
    ----------
    index : (K,) int32 into the field's cells
    magnitude : (K,) square root of the mean power gain, visibility included, without the
        scatterer's complex-Gaussian factor
    """

    index: np.ndarray
    magnitude: np.ndarray

    @property
    def nbytes(self) -> int:
        """Memory of the arrays, each counted once."""
        return sum({id(a): a.nbytes for a in vars(self).values()}.values())


class Rows(NamedTuple):
    """Arrays of `Visible`, in its order, for the kernels."""

    length: np.ndarray
    rate: np.ndarray
    accel: np.ndarray
    tx_radius: np.ndarray
    rx_radius: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray
    cell: np.ndarray
    magnitude: np.ndarray


@twin_of(propagation_field.advance)
def advance(
    surfaces: Surfaces,
    points: np.ndarray,
    face: np.ndarray,
    area: np.ndarray,
    share: np.ndarray,
    scale: float,
    start: np.ndarray,
    end: np.ndarray,
    own: bool,
    rows: Rows,
) -> None:
    """Fill in all `rows` (K,) but `cell`: path length with rate and acceleration, directions
    towards the cells, and the square root of the mean power gain.

    `start`, `end` (3, 3): position, velocity, acceleration of the ends; `own`: a monostatic link.
    """
    # length, rate, acceleration and directions: sums over both path segments
    i = rows.cell
    n, first = surfaces.normals[face[i]], motion_to(points[i], start)
    last = first if own else motion_to(points[i], end)
    for out, there, back in zip(rows[:3], first, last, strict=False):
        out[:] = there + back
    rows.tx_radius[:], rows.rx_radius[:] = first[0], last[0]
    rows.departure[:], rows.arrival[:] = first[3], last[3]
    u, v = first[3], last[3]
    into, back = (u * n).sum(axis=1), (v * n).sum(axis=1)
    # share of TE, along u x n, in the power of a vertical field: |z . u x n|^2 over the squared
    # lengths of u x n and of u's horizontal part
    whole = (u[:, 0] ** 2 + u[:, 1] ** 2) * (1 - np.minimum(np.abs(into), 1.0) ** 2)
    across = (n[:, 1] * u[:, 0] - n[:, 0] * u[:, 1]) ** 2
    part = np.where(whole > 1e-12, np.minimum(across / np.maximum(whole, 1e-12), 1.0), 0.5)
    # root of the gain of the module's docstring, times visibility; 0 with the surface in between
    power = scattered_power(surfaces, face[i], area[i], into, back, (u * v).sum(axis=1), part)
    gain = scale * share[i] * np.sqrt(np.maximum(power, 0.0)) / (first[0] * last[0])
    rows.magnitude[:] = np.where(into * back > 0, gain, 0.0)


def motion_to(points: np.ndarray, terminal: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the distance r (K,) from a terminal (3, 3) in motion to points (K, 3), its rate
    -u.v and acceleration (v^2 - rate^2)/r - u.a, and the unit vectors u towards the points."""
    position, velocity, acceleration = terminal
    r = np.linalg.norm(points - position, axis=1)
    u = (points - position) / r[:, None]
    rate = -u @ velocity
    return r, rate, (velocity @ velocity - rate**2) / r - u @ acceleration, u


def scattered_power(
    surfaces: Surfaces,
    face: np.ndarray,
    area: np.ndarray,
    into: np.ndarray,
    back: np.ndarray,
    between: np.ndarray,
    part: np.ndarray,
) -> np.ndarray:
    """Return S^2 Gamma^2 f_s cos(theta_i) A (K,) of cells, the bistatic cross-section over 4 pi.

    `into` and `back` are the signed cosines of incidence and departure, `between` the cosine of the
    angle between both directions, `part` the share of TE in the power.
    """
    # reflectivity and norm of the lobe from the material's table
    m, grid = surfaces.material[face], np.linspace(0, 1, surfaces.table.shape[1])
    cosine = np.minimum(np.abs(into), 1.0)
    te, tm, norm = np.empty((3, cosine.size))
    for material in np.unique(m):
        for out, column in zip((te, tm, norm), surfaces.table[material].T, strict=True):
            out[m == material] = np.interp(cosine[m == material], grid, column)
    # lobes ((1 + cos psi)/2)^alpha about the mirror direction and towards the source
    lobe, exponent = surfaces.lobe[m], surfaces.exponent[m]
    mirror = np.maximum(0.5 * (1 + 2 * into * back - between), 0.0) ** exponent
    source = np.maximum(0.5 * (1 + between), 0.0) ** exponent
    directive = (lobe * mirror + (1 - lobe) * source) * norm
    power = surfaces.coefficient[m] * (part * te + (1 - part) * tm) * cosine * area
    return power * np.where(lobe < 0, np.abs(back) / np.pi, directive)


class Scatterers(NamedTuple):
    """Scatterers of a link, and their visibility."""

    cells: Cells
    visibility: Visibility


class ClutterField:
    """Scatterers of one run, the same in all frames; built by `plan`.

    All links have the same scatterers, except those `merged` below the noise of a link.
    """

    def __init__(
        self,
        city: CityMesh,
        cells: Cells,
        visibility: Visibility,
        wavelength: float,
        num_candidates: int,
        overlap: float,
        merged: Mapping[Link, Scatterers] | None = None,
    ) -> None:
        self._city, self.visibility = city, visibility
        self.cells = cells
        self.merged = merged or {}
        self.num_candidates = num_candidates
        """Number of cells of the whole city, visible or not."""
        self.overlap = overlap
        """Visible area that lies in two surfaces or more and scatters once [m^2]."""
        self.surfaces = surfaces(city, wavelength)
        self._wavelength, self._scale = wavelength, wavelength / (4 * np.pi)

    @classmethod
    def plan(
        cls,
        density: Density,
        swarm: Swarm,
        city: CityMesh,
        scene: mi.Scene,
        wavelength: float,
        seed: int,
        floor: NoiseFloor | None = None,
    ) -> ClutterField:
        """Cut the surfaces for all flights of a run, and keep the cells that are visible from some
        transmitter's flight. With a `floor`, also leave out cells outside every antenna's field of
        view, and merge those below the noise of each link."""
        flights = {
            name: Flight(swarm.trajectories[name], swarm.duration, city.origin)
            for name in swarm.terminals
        }
        positions = np.concatenate([flight.time_samples for flight in flights.values()])
        scatters = np.array([m.scattering_coefficient > 0 for m in city.materials], bool)[
            city.face_material
        ]
        los = LosTest(scene)
        senders = [flights[name] for name in swarm.transmitters]
        lookouts, behind = _test_positions(senders), floor is None or floor.look_back
        fronts = [] if behind else [flight.fronts for flight in senders]

        def found() -> dict[str, Any]:
            of = 0

            def in_sight(points: np.ndarray, face: np.ndarray) -> np.ndarray:
                nonlocal of
                of = len(face)
                out = ever_ahead(np.concatenate(fronts), points) if fronts else np.full(of, True)
                out[out] = los.ever_sees(lookouts, points[out], city.normals[face[out]])
                return out

            cells = cut(city, scatters, positions, density, seed, in_sight)
            twice = lies_twice(cells, city)
            again = float(cells.area[twice].sum())
            return {"cells": vars(cells.select(~twice)), "of": of, "overlap": again}

        depends_on = [plain(city), positions, lookouts, fronts, asdict(density), seed, MOST_CELLS]
        had = cached("cells", [*depends_on, mi.variant()], found)
        cells = Cells(**had["cells"])
        visibility = Visibility(los, flights, facets_of(cells, city), wavelength, city)
        field = cls(city, cells, visibility, wavelength, had["of"], had["overlap"])
        if floor is None:
            return field
        poses = {
            name: [in_local(swarm.trajectories[name].pose(t), city.origin) for t in floor.times]
            for name in dict.fromkeys(name for link in floor.over_noise for name in link)
        }
        states = [[(*p.motion(), *p.rotation) for p in some] for some in poses.values()]
        depends_on += [vars(cells), wavelength, floor.record(), list(poses), np.array(states)]
        merged = cached(
            "merged",
            [*depends_on, mi.variant()],
            lambda: field._below_noise(floor, poses, density, positions),
        )
        return field._with(
            {link: field._own(link, Cells(**merged[str(link)])) for link in floor.over_noise}
        )

    def of(self, link: Link) -> Scatterers:
        """Return the scatterers of a link."""
        return self.merged.get(link, Scatterers(self.cells, self.visibility))

    def whole(self) -> ClutterField:
        """Return the field without merging."""
        return self._with({})

    def _with(self, merged: Mapping[Link, Scatterers]) -> ClutterField:
        whole = self._city, self.cells, self.visibility, self._wavelength
        return ClutterField(*whole, self.num_candidates, self.overlap, merged)

    def _own(self, link: Link, cells: Cells) -> Scatterers:
        """Build the scatterers of one link from its cells."""
        flights = {name: self.visibility.flights[name] for name in link}
        facets = facets_of(cells, self._city)
        visibility = Visibility(self.visibility.los, flights, facets, self._wavelength, self._city)
        return Scatterers(cells, visibility)

    def _below_noise(
        self,
        floor: NoiseFloor,
        poses: dict[str, list[Pose]],
        density: Density,
        positions: np.ndarray,
    ) -> dict[str, dict[str, np.ndarray]]:
        """Return the cells of each link, merged below its noise (`merging`); `poses` are those at
        the instants of `floor`, in local coordinates."""
        # visibility by rays, at the instants and ever, from each terminal
        cells, visibility, flights = self.cells, self.visibility, self.visibility.flights
        finest = density.finest(cKDTree(positions).query(cells.points)[0])
        error = error_for(density.per_metre)
        seen = {
            name: visibility.from_places(np.array([pose.position for pose in of]))
            for name, of in poses.items()
        }
        ever = {
            name: visibility.ever(_test_positions([flights[name]]), known=np.any(at, axis=0))
            for name, at in seen.items()
        }
        merged = {}
        for link, over_noise in floor.over_noise.items():
            # cells that both ends see at some time, with their power over the noise at each instant
            shared = ever[link.tx] & ever[link.rx]
            if not floor.look_back:
                shared &= ever_ahead(flights[link.rx].fronts, cells.points)
            both = np.flatnonzero(shared)
            of_link, visible = cells.select(both), []
            for k in np.flatnonzero(over_noise):
                state = LinkState(link, floor.times[k], poses[link.tx][k], poses[link.rx][k])
                share = (seen[link.tx][k] & seen[link.rx][k])[both].astype(np.float32)
                visible.append(self._visible(floor, of_link, share, state, over_noise[k]))
            merged[str(link)] = vars(merged_below_noise(of_link, visible, finest[both], error))
        return merged

    def _visible(
        self, floor: NoiseFloor, cells: Cells, share: np.ndarray, state: LinkState, level: float
    ) -> VisibleCells:
        """Return the scatterers that a link receives, of N with the visibility `share` (N,);
        `level` is the power over the noise of a path of unit gain."""
        scatter_paths = self._paths_over(cells, share, state)
        power = level * (scatter_paths.magnitude * state.elements(floor.arrays, scatter_paths)) ** 2
        delay = scatter_paths.length / SPEED_OF_LIGHT
        received = (power > 0) & (delay < floor.longest_delay)
        rate = scatter_paths.rate[received] / SPEED_OF_LIGHT
        cell = resolution_cell(floor.waveform, delay[received], rate)
        return VisibleCells(scatter_paths.index[received], power[received], cell)

    @property
    def nbytes(self) -> int:
        """Memory of the scatterers and of the stored visibility [bytes]."""
        every = [(self.cells, self.visibility), *self.merged.values()]
        return sum(a.nbytes for cells, _ in every for a in vars(cells).values()) + sum(
            visibility.nbytes for _, visibility in every
        )

    def seen(self, state: LinkState, discs: UavDiscs | None = None) -> Visible:
        """Return the paths over the scatterers visible from both ends of a link, with the shadows
        of the UAVs `discs`; poses in local coordinates."""
        (tx, rx), own, start, end = state.link, state.link.own, state.start, state.end
        cells, visibility = self.of(state.link)
        share = visibility.share(tx, start, state.epoch)
        if not own:
            share = share * visibility.share(rx, end, state.epoch)
        found = self._paths_over(cells, share, state)
        if discs is not None:
            points = cells.points.take(found.index, axis=0)
            sent, visible = (discs.spared([(name,)]) for name in (tx, rx))
            there = discs.gain(start.position, points, found.tx_radius, self._wavelength, sent)
            back = (
                there
                if own
                else discs.gain(end.position, points, found.rx_radius, self._wavelength, visible)
            )
            found.magnitude[:] *= there * back
        lit = np.flatnonzero(found.magnitude)
        if lit.size == found.magnitude.size:
            return found
        parts = {id(a): a.take(lit, axis=0) for a in vars(found).values()}
        return Visible(*(parts[id(a)] for a in vars(found).values()))

    def from_places(self, state: LinkState) -> Visible:
        """Return the paths over the scatterers visible from both ends by rays alone, on or off the
        planned flights; poses in local coordinates."""
        ends = np.array([state.start.position, state.end.position])
        share = np.all(self.visibility.from_places(ends), axis=0).astype(np.float32)
        return self._paths_over(self.cells, share, state)

    def _paths_over(self, cells: Cells, share: np.ndarray, state: LinkState) -> Visible:
        """Return the paths over the cells whose visibility `share` (N,) is not 0."""
        own, start, end = state.link.own, state.start, state.end
        index = np.flatnonzero(share).astype(np.int32)
        count = index.size
        radius, departure = np.empty(count), np.empty((count, 3))
        found = Visible(
            length=np.empty(count),
            rate=np.empty(count),
            accel=np.empty(count, np.float32),
            tx_radius=radius,
            rx_radius=radius if own else np.empty(count),
            departure=departure,
            arrival=departure if own else np.empty((count, 3)),
            index=index,
            magnitude=np.empty(count, np.float32),
        )
        rows, motion = Rows(*vars(found).values()), (start.motion(), end.motion())
        c = cells
        advance(self.surfaces, c.points, c.face, c.area, share, self._scale, *motion, own, rows)
        return found

    def paths(self, state: LinkState, arrays: Arrays, discs: UavDiscs | None = None) -> PathSet:
        """Return the link's paths; poses, points and UAVs in local coordinates."""
        seen, cells = self.seen(state, discs), self.of(state.link).cells
        return state.paths(
            seen,
            cells.amplitude[seen.index] * (seen.magnitude * state.elements(arrays, seen)),
            PathKind.DIFFUSE,
            bounces=1,
            points=cells.points.take(seen.index, axis=0)[:, None],
            faces=cells.face[seen.index][:, None],
        )


def facets_of(cells: Cells, city: CityMesh) -> Facets:
    """Return points, normals and areas of cells."""
    return Facets(cells.points, city.normals[cells.face], cells.area)


def in_local(pose: Pose, origin: np.ndarray) -> Pose:
    """Shift a pose to local coordinates."""
    return replace(pose, position=pose.position - origin)


def _test_positions(flights: Sequence[Flight]) -> np.ndarray:
    """Return the positions (K, 3) along flights from which cells are tested."""
    step = round(TEST_SPACING_M / SAMPLE_SPACING)
    return np.concatenate(
        [part for f in flights for part in (f.time_samples[::step], f.time_samples[-1:])]
    )


def surfaces(city: CityMesh, wavelength: float) -> Surfaces:
    """Build the material tables of a city."""
    cosine = np.linspace(0.0, 1.0, TABLE)
    table = []
    for m in city.materials:
        te, tm = (np.abs(r) ** 2 for r in slab_coefficients(m, cosine, wavelength, whole=True))
        table.append(np.stack([te, tm, 1 / lobe_norm(m, cosine)], axis=1))
    lobes = {"lambertian": -1.0, "directive": 1.0, "backscattering": 0.5}
    return Surfaces(
        city.normals,
        city.face_material.astype(np.int64),
        np.array(table).reshape(-1, TABLE, 3),
        np.array([m.scattering_coefficient**2 for m in city.materials]),
        np.array([lobes[m.scattering_pattern] for m in city.materials]),
        np.array([m.pattern_exponent for m in city.materials], np.int64),
    )


def lobe_norm(material: Material, cosine: np.ndarray) -> np.ndarray:
    """Integrate the lobe ((1 + cos psi)/2)^alpha over the half-space, at cosines of incidence
    (Degli-Esposti [1]_, eqs. 13 and 15). The lobe about the incident direction has the same norm.

    The norm is 2^-alpha times the sum over j of (alpha over j) I_j, with I_j = 2 pi/(j + 1) for
    even j, and for odd j = 2 n + 1 that times cos(theta) times the sum over i <= n of
    (2 i over i) sin(theta)^(2 i) / 4^i.
    """
    alpha = material.pattern_exponent
    if material.scattering_pattern == "lambertian":
        return np.ones_like(cosine)
    total, odd = np.zeros_like(cosine), np.zeros_like(cosine)
    for j in range(alpha + 1):
        if j % 2:
            n = (j - 1) // 2
            odd = odd + (1 - cosine**2) ** n * comb(2 * n, n) / 4.0**n
        total = total + comb(alpha, j) * 2 * np.pi / (j + 1) * (cosine * odd if j % 2 else 1.0)
    return total / 2.0**alpha
