"""Ray-traced paths: rays in Sionna RT's scene find the chains of walls, float64 images say which of
them are paths, and where.

Segments run from the terminals to every UAV: terminal to terminal, terminal back to itself, and
terminal to target. Rays that leave the terminals from time samples of their flights find which
walls a wave may meet one after the other (`segments.chains`); images place the pooled chains in
each frame (`segments.images`), with length, rate, acceleration, directions and points from the
planes of the mesh, and slab coefficients of the faces that hold the points. Straight segments then
bend round shadow edges, and the swarm's UAVs shadow segments of all kinds (`direct`, `discs`).

`RayTracer.by_sionna` gives the same tracer with the segments of Sionna's own solver, which shares
with the above neither the search nor the images, the visibility nor the amplitudes (its delays are
unfolded in float64 too: in float32 they are off by up to a radian and more at this carrier). It is
the cross-check of the paths that a run misses.

Echoes and ghosts of UAVs are products of segments with the amplitude sqrt(4 pi sigma)/lambda, a
point scatterer. Sionna's own RCS solver gives the same paths, but wants the UAVs in the scene,
where each shadows the terminal that carries it, and one solve per link; a test holds the two
against each other. What is left out: a wave that one segment turns from vertical to horizontal
polarisation and the other turns back (nothing for echoes and for ghosts of one bounce, up to 6 % of
single ghosts of two bounces in a street canyon).

Points are world coordinates outside this module and local (recentred) coordinates inside. Import
only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

import copy
import logging
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

from isac_rt.frame.link import Link
from isac_rt.propagation.clutter.cells import Density
from isac_rt.propagation.clutter.field import ClutterField
from isac_rt.propagation.clutter.merging import NoiseFloor
from isac_rt.propagation.clutter.visibility import Flight
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Census, Traced
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths, merge
from isac_rt.propagation.scatter_paths import LinkState, ScatterPaths
from isac_rt.propagation.segments.chains import Search
from isac_rt.propagation.segments.clearance import Clearance
from isac_rt.propagation.segments.direct import past_edges_and_discs
from isac_rt.propagation.segments.discs import UavDiscs
from isac_rt.propagation.segments.edges import ShadowEdges
from isac_rt.propagation.segments.geometry import (
    edges_in_any_order,
    one_of_each_chain,
    plane_of_each_face,
    unfold,
)
from isac_rt.propagation.segments.images import PROBES_M, SLACK, STRETCH, Images
from isac_rt.propagation.segments.rays import LosTest
from isac_rt.propagation.segments.segment_set import SegmentSet, TracedSegments, segment_set
from isac_rt.propagation.settings import Clutter, Propagation
from isac_rt.registry import extension
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.city.scene import shared_scenes
from isac_rt.world.swarm import Pose, Swarm

if TYPE_CHECKING:
    import sionna.rt as rt

MOST_PATHS = 4_000_000
"""Paths per source that the ray tracer is given room for. It drops what is beyond in silence, so
fewer rays get less room."""
LEAKAGE_S = 1e-9
"""Delay of what a receiver receives of its own transmitter: 30 cm of way."""

_LOG = logging.getLogger(__name__)


class RayTracer:
    """Paths of all links of a frame in one city."""

    def __init__(
        self,
        propagation: Propagation,
        clutter: Clutter,
        swarm: Swarm,
        free: FreeSpace,
        city: CityMesh,
        carrier: float,
        sample_spacing: float = 0.0,
        floor: NoiseFloor | None = None,
    ) -> None:
        self._propagation, self._clutter, self._swarm = propagation, clutter, swarm
        self._free, self._city, self._terminals = free, city, swarm.terminals
        _LOG.info("handing %s faces to the ray tracer", f"{city.num_faces:,}")
        self._scenes = shared_scenes(city, carrier)
        self._normals, self._offsets = plane_of_each_face(city)
        scene, wavelength = self._scenes.faces, free.wavelength
        los = LosTest(scene)
        _LOG.info("finding the edges that cast shadows")
        self._edges = ShadowEdges(city, los, wavelength)
        self.field: ClutterField | None = None
        """The scatterers on the city's surfaces."""
        self.two_bounces: Any = None
        """The same scatterers by way of mirrors
        (`isac_rt.extensions.two_bounces.two_bounces.TwoBounces`)."""
        if clutter.model == "field":
            _LOG.info("placing the scatterers of the clutter")
            self.field = ClutterField.plan(
                Density.of(clutter), swarm, city, scene, wavelength, free.seed, floor
            )
            if clutter.mirrors:
                self.two_bounces = extension("two_bounces").plan(
                    self.field, city, wavelength, free.seed, clutter.mirrors
                )
        depth = propagation.max_bounces if city.num_faces else 0
        flights = {
            name: Flight(swarm.trajectories[name], swarm.duration, city.origin, sample_spacing)
            for name in (self._terminals if sample_spacing and depth else [])
        }
        self._search = Search(self._scenes, city, propagation.rays, depth, flights)
        self._images = Images(city, los, wavelength, depth)
        self._solved_with: int | None = None
        self._clearance = Clearance(city)

    @cached_property
    def _solver(self) -> rt.PathSolver:
        import sionna.rt as rt

        return rt.PathSolver(deterministic=True)

    def census(self) -> Census:
        """Scatterers and mirrors, as they were planned for the whole run."""
        if self.field is None:
            return Census()
        return Census(
            len(self.field.cells),
            self.field.num_candidates,
            {str(link): len(scatterers.cells) for link, scatterers in self.field.merged.items()},
            None if self.two_bounces is None else self.two_bounces.census(),
            round(self.field.overlap, 1),
        )

    def by_half(self, which: int) -> RayTracer:
        """The same tracer with the chains of the even (0) or the odd (1) time samples alone,
        without scatterers."""
        out = copy.copy(self)
        out.field = out.two_bounces = None
        out._search = self._search.half(which)
        return out

    def by_sionna(self, num_rays: int) -> RayTracer:
        """The same tracer with the segments of Sionna's own solver, solved anew at each instant
        with so many rays, without scatterers."""
        out = copy.copy(self)
        out.field = out.two_bounces = None
        out._solved_with = num_rays
        return out

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Paths of every link, in a fixed order.

        Raises
        ------
        ValueError  If a pose is not finite, which Sionna would pass over in silence.
        """
        local, links = self._local(poses), [Link(*link) for link in links]
        if not all(
            np.isfinite(pose.position).all() and np.isfinite(pose.velocity).all()
            for pose in local.values()
        ):
            raise ValueError("a UAV's position or velocity is not finite")
        self._clearance.check({name: pose.position for name, pose in local.items()}, epoch)
        dropped = 0
        if self._solved_with is None:
            chains = {
                name: self._search.chains(name, local[name], epoch) for name in self._terminals
            }
            ends = {name: local[name] for name in self._free.names}
            segments = self._images.segments(chains, ends)
        else:
            segments, dropped, _ = self._solved_segments(local, self._solved_with)
        discs = UavDiscs.of(self._swarm.uavs, local)
        segments = past_edges_and_discs(segments, local, self._edges, discs, self._free.wavelength)
        paths = {}
        for link in links:
            state = LinkState(link, epoch, local[link.tx], local[link.rx], self._free.names)
            paths[link] = self._link(state, local, segments, discs)
        return Traced(paths, dropped)

    def _local(self, poses: dict[str, Pose]) -> dict[str, Pose]:
        """The poses in local coordinates."""
        origin = self._city.origin
        return {
            name: replace(pose, position=pose.position - origin) for name, pose in poses.items()
        }

    def _solve(
        self,
        sources: dict[str, np.ndarray],
        sinks: dict[str, np.ndarray],
        max_depth: int,
        samples_per_src: int,
    ) -> rt.Paths:
        """Mirror reflections between isotropic single elements at places by name.

        Raises
        ------
        ValueError  If there are so many paths that some may be missing.
        """
        import sionna.rt as rt

        scene = self._scenes.solved.scene
        scene.tx_array = scene.rx_array = rt.PlanarArray(
            num_rows=1, num_cols=1, pattern="iso", polarization="V"
        )
        for name in [*scene.transmitters, *scene.receivers]:
            scene.remove(name)
        for name, position in sources.items():
            scene.add(rt.Transmitter(f"tx-{name}", position=mi.Point3f(*position.tolist())))
        for name, position in sinks.items():
            scene.add(rt.Receiver(f"rx-{name}", position=mi.Point3f(*position.tolist())))
        capacity = min((samples_per_src * max_depth + 1) * len(sinks), MOST_PATHS)
        paths = self._solver(
            scene,
            max_depth=max_depth,
            samples_per_src=samples_per_src,
            max_num_paths_per_src=capacity,
            refraction=False,
            synthetic_array=True,
            specular_reflection=max_depth > 0,
        )
        valid = np.asarray(paths.valid)  # (rx, tx, path): the array is synthetic
        most = valid.sum(axis=(0, 2)).max()
        if most >= MOST_PATHS:
            raise ValueError(
                f"the ray tracer found its limit of {MOST_PATHS} paths; lower propagation.rays"
            )
        return paths

    def _solved_segments(self, local: dict[str, Pose], num_rays: int) -> TracedSegments:
        """Mirrored segments of Sionna's solver from every terminal to every UAV."""
        p = self._propagation
        depth = p.max_bounces if self._city.num_faces else 0
        sources = {name: local[name].position for name in self._terminals}
        sinks = {name: local[name].position for name in self._free.names}
        beside = {
            f"{name}-{k}": position + step
            for name, position in sources.items()
            for k, step in enumerate(PROBES_M if depth > 1 else ())
        }
        paths = self._solve(
            sources,
            sinks | beside,
            max_depth=depth,
            samples_per_src=num_rays,
        )
        amplitude, valid, faces, points = self._read(paths, max(depth, 1))
        corner = valid & ((faces >= 0).sum(axis=-1) > 1)
        out, dropped, duplicates = {}, 0, 0
        for j, start in enumerate(sources):
            for i, end in enumerate(sinks):
                which = np.flatnonzero(valid[i, j])
                rows, loose = np.full(which.size, i), np.zeros(which.size)
                if start == end and beside:
                    first = len(sinks) + len(PROBES_M) * j
                    steps, found_beside = np.nonzero(corner[first : first + len(PROBES_M), j])
                    rows, which = np.append(rows, first + steps), np.append(which, found_beside)
                    loose = np.append(loose, np.full(steps.size, SLACK))
                at = rows, j, which
                out[Link(start, end)], astray, again = self._segment_set(
                    local[start], local[end], amplitude[at], faces[at], points[at], loose
                )
                dropped, duplicates = dropped + astray, duplicates + again
        return TracedSegments(out, dropped, duplicates)

    def _read(
        self, paths: rt.Paths, depth: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Amplitudes (rx, tx, path), validity, faces (rx, tx, path, depth) and points (..., depth,
        3) of solved paths."""
        real, imag = (np.asarray(part, np.float64) for part in paths.a)
        shape = real.shape[0], real.shape[2], real.shape[4]
        amplitude = (real + 1j * imag).reshape(shape)
        valid = np.asarray(paths.valid).reshape(shape)
        if not shape[2]:
            empty = np.zeros((*shape, depth), np.int64), np.zeros((*shape, depth, 3))
            return amplitude, valid, *empty
        faces = self._scenes.solved.face_index(
            np.asarray(paths.objects), np.asarray(paths.primitives)
        )
        hit = np.asarray(paths.interactions) != 0
        faces = np.moveaxis(np.where(hit, faces, -1), 0, -1)
        points = np.moveaxis(np.asarray(paths.vertices, np.float64), 0, -2)
        return amplitude, valid, faces, points

    def _segment_set(
        self,
        start: Pose,
        end: Pose,
        amplitude: np.ndarray,
        faces: np.ndarray,
        points: np.ndarray,
        slack: np.ndarray,
    ) -> tuple[SegmentSet, int, int]:
        """Unfold chains depth by depth, drop what contradicts Sionna's points by more than `slack`,
        drop duplicates, sort. Also how many of either were dropped."""
        parts, dropped, duplicates = [], 0, 0
        for count in range(faces.shape[1] + 1):
            which = np.flatnonzero((faces >= 0).sum(axis=1) == count)
            chain = faces[which][:, :count]
            if count == 0 and np.linalg.norm(end.position - start.position) < 1e-9:
                # a terminal's path to itself is its leakage, which is not the ray tracer's
                continue
            segments = unfold(self._normals[chain], self._offsets[chain], start, end)
            distance = np.linalg.norm(segments.points - points[which][:, :count], axis=-1).max(
                axis=1, initial=0.0
            )
            good = distance < STRETCH * segments.length + slack[which]
            # what stands beside may well go astray at grazing angles
            dropped += int((~good & (slack[which] == 0)).sum())
            planes = edges_in_any_order(self._city.plane_of_face[chain], segments.points)
            keep = one_of_each_chain(planes, chain, good)
            duplicates += int(good.sum()) - keep.size
            keep = keep[np.argsort(segments.length[keep], kind="stable")]
            parts.append((amplitude[which][keep], segments.select(keep), chain[keep], planes[keep]))
        return segment_set(parts, faces.shape[1]), dropped, duplicates

    def _link(
        self,
        state: LinkState,
        local: dict[str, Pose],
        segments: dict[Link, SegmentSet],
        discs: UavDiscs,
    ) -> PathSet:
        link, arrays = state.link, self._free.arrays
        parts = [self._by_the_city(state, segments[link])]
        others = [name for name in self._free.names if name not in link]
        if others:
            parts.append(self._over_uavs(state, {name: local[name] for name in others}, segments))
        if self.field is not None:
            parts.append(self.field.paths(state, arrays, discs))
        if self.two_bounces is not None:
            parts.extend(self.two_bounces.paths(state, arrays, discs))
        if link.own and self._propagation.leakage.enabled:
            parts.append(self._leakage(state))
        return merge(parts, shift=self._city.origin)

    def _leakage(self, state: LinkState) -> PathSet:
        """A terminal's transmitter into its own receiver."""
        leakage, ahead = self._propagation.leakage, state.start.rotation[:, 1][None]
        return make_paths(
            gain=[10 ** (-leakage.isolation_db / 20)],
            delay=[LEAKAGE_S],
            departure=ahead,
            arrival=ahead,
            kind=PathKind.LEAKAGE,
            tx=state.link.tx,
            rx=state.link.rx,
            epoch=state.epoch,
            target_names=state.target_names,
        )

    def _by_the_city(self, state: LinkState, traced: SegmentSet) -> PathSet:
        """Line of sight and mirror reflections of the city."""
        scatter_paths = ScatterPaths.along(traced.segments)
        return state.paths(
            scatter_paths,
            traced.amplitude * state.elements(self._free.arrays, scatter_paths),
            np.where(traced.bounces > 0, PathKind.SPECULAR, PathKind.LINE_OF_SIGHT),
            bounces=traced.bounces,
            points=traced.segments.points,
            faces=traced.faces,
        )

    def _over_uavs(
        self, state: LinkState, discs: dict[str, Pose], segments: dict[Link, SegmentSet]
    ) -> PathSet:
        """Echoes and ghosts of UAVs: every segment to one with every segment from it, up to the
        bounces allowed."""
        most = self._propagation.max_bounces if self._propagation.ghosts else 0
        sent, received, sections, numbers = [], [], [], []
        for name, pose in discs.items():
            to, on = segments[Link(state.link.tx, name)], segments[Link(state.link.rx, name)]
            i, j = np.divmod(np.arange(len(to) * len(on)), max(len(on), 1))
            allowed = np.flatnonzero(to.bounces[i] + on.bounces[j] <= most)
            to, on = to.select(i[allowed]), on.select(j[allowed])
            aspects = pose.to_body(to.segments.arrival), pose.to_body(on.segments.arrival)
            sections.append(self._free.sections[name].square_metres(*aspects))
            numbers.append(np.full(len(to), self._free.names.index(name)))
            sent.append(to)
            received.append(on)
        there, back = SegmentSet.joined(sent), SegmentSet.joined(received)
        target = np.concatenate(numbers)
        a, b, bounces = there.segments, back.segments, there.bounces + back.bounces
        scatter = np.sqrt(4 * np.pi * np.concatenate(sections)) / self._free.wavelength
        scatter_paths = ScatterPaths.over(a, b)
        elements = state.elements(self._free.arrays, scatter_paths)
        positions = [pose.position for pose in discs.values()]
        middle = np.repeat(positions, [len(to) for to in sent], axis=0)[:, None]
        chain = [there.faces, np.full((len(there), 1), -1), back.faces[:, ::-1]]
        return state.paths(
            scatter_paths,
            there.amplitude * back.amplitude * scatter * elements,
            np.where(bounces > 0, PathKind.GHOST, PathKind.TARGET),
            target=target,
            bounces=bounces,
            points=np.concatenate([a.points, middle, b.points[:, ::-1]], axis=1),
            faces=np.concatenate(chain, axis=1),
        )
