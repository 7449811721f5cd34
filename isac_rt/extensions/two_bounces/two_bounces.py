r"""Clutter of two bounces: the scatterers of the field, lit or received by way of a mirror.

Mirror then scatter, and scatter then mirror. The scatterers are those of one bounce, with the same
amplitudes; the terminal at the mirror's side is its image, so that delay, rate, acceleration and
directions are closed forms in float64. From one isotropic antenna to another

.. math::

    |a|^2 = (\lambda/4\pi)^2\, M^2\, S^2\, \Gamma^2 f_s(k_i, k_o) \cos\theta_i\, A / (r_1 r_2)^2

with the unfolded r_1 or r_2, and M^2 the mirror's (1 - S^2) times its slab's reflection at the
angle there. The electric field is followed as a vector through the mirror, whose phase is in the
gain; at the scatterer Gamma is that of the field which arrives, and what comes in vertical goes out
vertical, as for one bounce.

On a terminal's link to itself the two orders are one way and its reverse: equal in length, and in
phase where transmitter and receiver share one place, as backscatter is enhanced in nature. Sight by
way of a mirror is tested at the time samples of the flight, both segments and the mirror's rim, and
blended in between.

Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from isac_rt.extensions.two_bounces.mirrors import Mirror, shown, strongest
from isac_rt.frame.antennas import Arrays
from isac_rt.propagation.clutter.field import (
    ClutterField,
    Visible,
    motion_to,
    scattered_power,
)
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.segments.discs import UavDiscs
from isac_rt.propagation.segments.reflection import mirrored_field, slab_coefficients, vertical
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.mirrors import mirror_image, plane_crossing
from isac_rt.world.swarm import Pose

CACHED_SAMPLES = 16
"""Time samples per terminal whose tests are remembered; a frame needs six."""


_Share = tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]
"""How far (N,) scatterers are in sight of an end, and of each of its mirrors which show in it and
how far."""


@dataclass(frozen=True)
class Mirrored:
    """K scatterers between two terminals by way of one mirror.

    Attributes
    ----------
    seen : Visible; its lengths, radii and directions are those of the ways by the mirror
    phasor : (K,) complex64 of modulus 1, what the mirror does to the phase
    mirror : Mirror
    before : whether the mirror comes before the scatterer
    """

    seen: Visible
    phasor: np.ndarray
    mirror: Mirror
    before: bool


class TwoBounces:
    """Mirror images of one field for all terminals of a run; `plan` makes it."""

    def __init__(
        self,
        field: ClutterField,
        city: CityMesh,
        mirrors: dict[str, tuple[list[Mirror], float]],
        wavelength: float,
    ) -> None:
        self._field, self._city, self._wavelength = field, city, wavelength
        self.mirrors = {name: kept for name, (kept, _) in mirrors.items()}
        """Of each terminal, the strongest first."""
        self.left_out = {name: rest for name, (_, rest) in mirrors.items()}
        """Share of what each terminal radiates that all other mirrors send on."""
        self._shown: dict[tuple[str, int], list[np.ndarray]] = {}

    @classmethod
    def plan(
        cls, field: ClutterField, city: CityMesh, wavelength: float, seed: int, most: int
    ) -> TwoBounces:
        """Choose each terminal's mirrors, at most `most`, for the whole of its flight."""
        mirrors = {
            name: strongest(city, field.visibility.los, flight, wavelength, seed, most)
            for name, flight in field.visibility.flights.items()
        }
        return cls(field, city, mirrors, wavelength)

    def census(self) -> dict[str, dict[str, float]]:
        """By terminal how many mirrors it has, and what these and all others send on."""
        return {
            name: {
                "count": len(kept),
                "share": round(sum(m.share for m in kept), 6),
                "share_left_out": round(self.left_out[name], 6),
            }
            for name, kept in self.mirrors.items()
        }

    def seen(self, state: LinkState, discs: UavDiscs | None = None) -> list[Mirrored]:
        """Return the scatterers in sight of both ends, once for each mirror and order; poses in
        local coordinates."""
        direct, time = self._field.visibility, state.epoch
        ends = zip(state.link, (state.start, state.end), strict=True)
        tx, rx = (
            (direct.share(name, pose, time), self._share(name, pose, time)) for name, pose in ends
        )
        out = self._between(state, tx, rx)
        if discs is not None:
            for found in out:
                self._shade(found, state, discs)
        return out

    def from_places(self, state: LinkState) -> list[Mirrored]:
        """The same by rays alone, wherever the ends are."""
        positions = np.array([state.start.position, state.end.position])
        tx, rx = (
            (straight.astype(np.float32), [(i, np.ones(i.size)) for i in self._test(name, at)])
            for straight, name, at in zip(
                self._field.visibility.from_places(positions), state.link, positions, strict=True
            )
        )
        return self._between(state, tx, rx)

    def _between(self, state: LinkState, tx: _Share, rx: _Share) -> list[Mirrored]:
        """Ways by the mirrors of the one end, then by those of the other."""
        out = []
        for before, name, shown_in, straight in (
            (True, state.link.tx, tx[1], rx[0]),
            (False, state.link.rx, rx[1], tx[0]),
        ):
            for mirror, (index, share) in zip(self.mirrors[name], shown_in, strict=True):
                share = share * straight[index]
                lit = share > 0
                if lit.any():
                    out.append(self._over_mirror(mirror, index[lit], share[lit], state, before))
        return out

    def paths(
        self, state: LinkState, arrays: Arrays, discs: UavDiscs | None = None
    ) -> list[PathSet]:
        """The link's paths, one set for each mirror and order; poses, points and UAVs in local
        coordinates."""
        cells, out = self._field.cells, []
        for part in self.seen(state, discs):
            s = part.seen
            points, faces = self._chain(part, state)
            gain = cells.amplitude[s.index] * part.phasor
            gain = gain * (s.magnitude * state.elements(arrays, s))
            out.append(
                state.paths(s, gain, PathKind.DIFFUSE, bounces=2, points=points, faces=faces)
            )
        return out

    def _chain(self, part: Mirrored, state: LinkState) -> tuple[np.ndarray, np.ndarray]:
        """Points (K, 2, 3) and faces (K, 2) in the order in which the wave meets them; all faces of
        a mirror go by its largest."""
        points = self._field.cells.points[part.seen.index]
        own = self._field.cells.face[part.seen.index]
        m, viewer = part.mirror, (state.start if part.before else state.end).position
        image = mirror_image(viewer, m.normal, m.offset)
        at = plane_crossing(image, points, m.normal, m.offset)
        wall = np.full(own.size, m.faces[0], own.dtype)
        order = slice(None) if part.before else slice(None, None, -1)
        return np.stack([at, points], axis=1)[:, order], np.stack([wall, own], axis=1)[:, order]

    def _share(self, name: str, pose: Pose, time: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each mirror of a terminal: scatterers that show in it, and how far, from 0 to 1."""
        flight, mirrors = self._field.visibility.flights[name], self.mirrors[name]
        if not flight.holds(pose, time):
            return [
                (index, np.ones(index.size, np.float32))
                for index in self._test(name, pose.position)
            ]
        time_samples = {
            time_sample: weight for time_sample, weight in flight.blend(time).items() if weight > 0
        }
        tests = {time_sample: self._time_sample(name, time_sample) for time_sample in time_samples}
        out = []
        for number in range(len(mirrors)):
            share = np.zeros(len(self._field.cells), np.float32)
            for time_sample, weight in time_samples.items():
                share[tests[time_sample][number]] += np.float32(weight)
            index = np.flatnonzero(share).astype(np.int32)
            out.append((index, share[index]))
        return out

    def _time_sample(self, name: str, time_sample: int) -> list[np.ndarray]:
        if (name, time_sample) not in self._shown:
            mine = [key for key in self._shown if key[0] == name]
            for key in mine[: len(mine) - CACHED_SAMPLES + 1]:
                del self._shown[key]
            self._shown[name, time_sample] = self._test(
                name, self._field.visibility.flights[name].time_samples[time_sample]
            )
        return self._shown[name, time_sample]

    def _test(self, name: str, position: np.ndarray) -> list[np.ndarray]:
        cells, mirrors = self._field.cells, self.mirrors[name]
        if not mirrors:
            return []
        return shown(
            self._field.visibility.los,
            position,
            mirrors,
            cells.points,
            self._city.normals[cells.face],
        )

    def _over_mirror(
        self, mirror: Mirror, index: np.ndarray, share: np.ndarray, state: LinkState, before: bool
    ) -> Mirrored:
        start, end = state.start.motion(), state.end.motion()
        if before:
            start = mirror.image(state.start)
        else:
            end = mirror.image(state.end)
        there, back = (motion_to(self._field.cells.points[index], pose) for pose in (start, end))
        length, rate, accel = (one + other for one, other in zip(there[:3], back[:3], strict=True))
        # the terminal at the mirror's side sends to, or receives from, where its image does
        departure, arrival = there[3], back[3]
        if before:
            departure = mirror_image(departure, mirror.normal)
        else:
            arrival = mirror_image(arrival, mirror.normal)
        ends = there[0], back[0], departure, arrival
        seen = Visible(length, rate, accel.astype(np.float32), *ends, index, share)
        gain = share * self._gain(mirror, seen, before)
        size = np.abs(gain)
        some = np.flatnonzero(size > 0)
        phasor = (gain[some] / size[some]).astype(np.complex64)
        seen = replace(seen, magnitude=size.astype(np.float32))
        return Mirrored(Visible(*(a[some] for a in vars(seen).values())), phasor, mirror, before)

    def _gain(self, mirror: Mirror, seen: Visible, before: bool) -> np.ndarray:
        """Complex gains (K,) of ways over scatterers that nothing hides; their own amplitudes are
        left out.

        The mirror passes the part of the vertical field that the receiving end takes as vertical;
        the field that arrives at a scatterer says which share of its power is TE there.
        """
        normal, cells, surfaces = mirror.normal, self._field.cells, self._field.surfaces
        away, home = seen.departure, -seen.arrival
        face, area = cells.face[seen.index], cells.area[seen.index]
        cosine = np.minimum(np.abs((away if before else home) @ normal), 1.0)
        slab = slab_coefficients(mirror.material, cosine, self._wavelength)
        u, w = (mirror_image(away, normal), home) if before else (away, mirror_image(home, normal))
        if before:
            field = mirrored_field(vertical(away), away, u, normal, *slab)
            passed = (field * vertical(u)).sum(axis=1)
        else:
            field, mirrored = vertical(u), mirrored_field(vertical(w), w, home, normal, *slab)
            passed = (mirrored * vertical(home)).sum(axis=1)
        n = surfaces.normals[face]
        into, back = (u * n).sum(axis=1), -(w * n).sum(axis=1)
        across = np.cross(u, n)
        whole = (np.abs(field) ** 2).sum(axis=1) * (across**2).sum(axis=1)
        along = np.abs((field * across).sum(axis=1)) ** 2
        part = np.where(whole > 1e-24, np.minimum(along / np.maximum(whole, 1e-24), 1.0), 0.5)
        power = scattered_power(surfaces, face, area, into, back, -(u * w).sum(axis=1), part)
        power = np.where(into * back > 0, np.maximum(power, 0.0), 0.0)
        scale = self._wavelength / (4 * np.pi)
        return scale * passed * np.sqrt(power) / (seen.tx_radius * seen.rx_radius)

    def _shade(self, part: Mirrored, state: LinkState, discs: UavDiscs) -> None:
        """Put it into the shadows of the swarm's UAVs, on both ways."""
        points, _ = self._chain(part, state)
        split = 2 if part.before else 1
        ends = [np.broadcast_to(p.position, (len(points), 1, 3)) for p in (state.start, state.end)]
        there = np.concatenate([ends[0], points[:, :split]], axis=1)
        back = np.concatenate([points[:, split - 1 :], ends[1]], axis=1)
        part.seen.magnitude[:] *= np.abs(
            discs.factor(there, self._wavelength, discs.spared([(state.link.tx,)]))
            * discs.factor(back, self._wavelength, discs.spared([(state.link.rx,)]))
        )
