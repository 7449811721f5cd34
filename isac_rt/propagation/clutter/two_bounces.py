r"""Clutter of two bounces: the scatterers of the field, lit or heard by way of a mirror.

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
way of a mirror is tested at the knots of the flight, both legs and the mirror's rim, and blended in
between.

Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.kernels.jit import jit
from isac_rt.propagation.clutter.field import ClutterField, Rows, Seen, leg_to, scattered_power
from isac_rt.propagation.clutter.mirrors import Mirror, shown, strongest
from isac_rt.propagation.legs.bodies import Bodies
from isac_rt.propagation.legs.reflection import slab_coefficients
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.ways import LinkState
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose

KNOTS_KEPT = 16
"""Knots per terminal whose tests are remembered; a frame needs six."""


_Sight = tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]
"""How far (N,) scatterers are in sight of an end, and of each of its mirrors which show in it and
how far."""


@dataclass(frozen=True)
class SeenByMirror:
    """What K scatterers do between two terminals by way of one mirror.

    Attributes
    ----------
    seen : Seen; its lengths, radii and directions are those of the ways by the mirror
    turn : (K,) complex64 of modulus 1, what the mirror does to the phase
    mirror : Mirror
    before : whether the mirror comes before the scatterer
    """

    seen: Seen
    turn: np.ndarray
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
            name: strongest(city, field.sight.shadows, flight, wavelength, seed, most)
            for name, flight in field.sight.flights.items()
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

    def seen(self, state: LinkState, bodies: Bodies | None = None) -> list[SeenByMirror]:
        """What is in sight of both ends, once for each mirror and order; poses in local
        coordinates."""
        sight, time = self._field.sight, state.epoch
        ends = zip(state.link, (state.start, state.end), strict=True)
        tx, rx = (
            (sight.share(name, pose, time), self._share(name, pose, time)) for name, pose in ends
        )
        out = self._between(state, tx, rx)
        if bodies is not None:
            for found in out:
                self._shade(found, state, bodies)
        return out

    def from_places(self, state: LinkState) -> list[SeenByMirror]:
        """The same by rays alone, wherever the ends are."""
        places = np.array([state.start.position, state.end.position])
        tx, rx = (
            (straight.astype(np.float32), [(i, np.ones(i.size)) for i in self._test(name, place)])
            for straight, name, place in zip(
                self._field.sight.from_places(places), state.link, places, strict=True
            )
        )
        return self._between(state, tx, rx)

    def _between(self, state: LinkState, tx: _Sight, rx: _Sight) -> list[SeenByMirror]:
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
                    out.append(self._by_way_of(mirror, index[lit], share[lit], state, before))
        return out

    def paths(
        self, state: LinkState, antennas: Antennas, bodies: Bodies | None = None
    ) -> list[PathSet]:
        """The link's paths, one set for each mirror and order; poses, points and bodies in local
        coordinates."""
        cells, out = self._field.cells, []
        for part in self.seen(state, bodies):
            s = part.seen
            points, faces = self._chain(part, state)
            gain = cells.amplitude[s.index] * part.turn
            gain = gain * (s.magnitude * state.elements(antennas, s))
            out.append(
                state.paths(s, gain, PathKind.DIFFUSE, bounces=2, points=points, faces=faces)
            )
        return out

    def _chain(self, part: SeenByMirror, state: LinkState) -> tuple[np.ndarray, np.ndarray]:
        """Points (K, 2, 3) and faces (K, 2) in the order in which the wave meets them; all faces of
        a mirror go by its largest."""
        place = self._field.cells.points[part.seen.index]
        own = self._field.cells.face[part.seen.index]
        m, body = part.mirror, (state.start if part.before else state.end).position
        above, up = m.normal @ body - m.offset, place @ m.normal - m.offset
        image = place - 2 * up[:, None] * m.normal
        at = body + (above / (above + up))[:, None] * (image - body)
        wall = np.full(own.size, m.faces[0], own.dtype)
        order = slice(None) if part.before else slice(None, None, -1)
        return np.stack([at, place], axis=1)[:, order], np.stack([wall, own], axis=1)[:, order]

    def _share(self, name: str, pose: Pose, time: float) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each mirror of a terminal: scatterers that show in it, and how far, from 0 to 1."""
        flight, mirrors = self._field.sight.flights[name], self.mirrors[name]
        if not flight.holds(pose, time):
            return [
                (index, np.ones(index.size, np.float32))
                for index in self._test(name, pose.position)
            ]
        knots = {knot: weight for knot, weight in flight.blend(time).items() if weight > 0}
        tests = {knot: self._knot(name, knot) for knot in knots}
        out = []
        for number in range(len(mirrors)):
            share = np.zeros(len(self._field.cells), np.float32)
            for knot, weight in knots.items():
                share[tests[knot][number]] += np.float32(weight)
            index = np.flatnonzero(share).astype(np.int32)
            out.append((index, share[index]))
        return out

    def _knot(self, name: str, knot: int) -> list[np.ndarray]:
        if (name, knot) not in self._shown:
            mine = [key for key in self._shown if key[0] == name]
            for key in mine[: len(mine) - KNOTS_KEPT + 1]:
                del self._shown[key]
            self._shown[name, knot] = self._test(name, self._field.sight.flights[name].knots[knot])
        return self._shown[name, knot]

    def _test(self, name: str, place: np.ndarray) -> list[np.ndarray]:
        cells, mirrors = self._field.cells, self.mirrors[name]
        if not mirrors:
            return []
        return shown(
            self._field.sight.shadows,
            place,
            mirrors,
            cells.points,
            self._city.normals[cells.face],
        )

    def _by_way_of(
        self, mirror: Mirror, index: np.ndarray, share: np.ndarray, state: LinkState, before: bool
    ) -> SeenByMirror:
        start, end = state.start.motion(), state.end.motion()
        if before:
            start = mirror.image(state.start)
        else:
            end = mirror.image(state.end)
        count, c = index.size, self._field.cells
        numbers = (np.empty(count, dtype) for dtype in (float, float, np.float32, float, float))
        ends = np.empty((count, 3)), np.empty((count, 3))
        rows = Rows._make([*numbers, *ends, index, np.empty(count, np.float32)])
        _lay_out(c.points, mirror.normal, start, end, before, rows)
        met = rows.departure if before else rows.arrival
        slab = slab_coefficients(
            mirror.material, np.minimum(np.abs(met @ mirror.normal), 1.0), self._wavelength
        )
        gain, scale = np.empty(count, complex), self._wavelength / (4 * np.pi)
        surfaces = self._field.surfaces
        _weigh(surfaces, c.face, c.area, share, scale, mirror.normal, slab, before, rows, gain)
        rows.magnitude[:] = size = np.abs(gain)
        some = np.flatnonzero(size > 0)
        turn = (gain[some] / size[some]).astype(np.complex64)
        return SeenByMirror(Seen(*(a[some] for a in rows)), turn, mirror, before)

    def _shade(self, part: SeenByMirror, state: LinkState, bodies: Bodies) -> None:
        """Put it into the shadows of the swarm's bodies, on both ways."""
        points, _ = self._chain(part, state)
        split = 2 if part.before else 1
        ends = [np.broadcast_to(p.position, (len(points), 1, 3)) for p in (state.start, state.end)]
        there = np.concatenate([ends[0], points[:, :split]], axis=1)
        back = np.concatenate([points[:, split - 1 :], ends[1]], axis=1)
        part.seen.magnitude[:] *= np.abs(
            bodies.factor(there, self._wavelength, bodies.spared([(state.link.tx,)]))
            * bodies.factor(back, self._wavelength, bodies.spared([(state.link.rx,)]))
        )


@jit
def _lay_out(points, normal, start, end, before, rows):
    """Geometry of ways over scatterers from `start` to `end` (position, velocity, acceleration),
    one of them an image behind the mirror; directions are those at the terminals themselves."""
    departure, arrival = rows.departure, rows.arrival
    for row in range(rows.cell.size):
        i = rows.cell[row]
        r1, v1, a1, x1, y1, z1 = leg_to(points[i, 0], points[i, 1], points[i, 2], start)
        r2, v2, a2, x2, y2, z2 = leg_to(points[i, 0], points[i, 1], points[i, 2], end)
        if before:
            k = 2 * (x1 * normal[0] + y1 * normal[1] + z1 * normal[2])
            x1, y1, z1 = x1 - k * normal[0], y1 - k * normal[1], z1 - k * normal[2]
        else:
            k = 2 * (x2 * normal[0] + y2 * normal[1] + z2 * normal[2])
            x2, y2, z2 = x2 - k * normal[0], y2 - k * normal[1], z2 - k * normal[2]
        rows.length[row], rows.rate[row], rows.accel[row] = r1 + r2, v1 + v2, a1 + a2
        rows.tx_radius[row], rows.rx_radius[row] = r1, r2
        departure[row, 0], departure[row, 1], departure[row, 2] = x1, y1, z1
        arrival[row, 0], arrival[row, 1], arrival[row, 2] = x2, y2, z2


@jit(inline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit(inline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit(inline=True)
def _turned(u, n):
    """A direction after a mirror of normal n."""
    k = 2 * _dot(u, n)
    return u[0] - k * n[0], u[1] - k * n[1], u[2] - k * n[2]


@jit(inline=True)
def _upright(u):
    """The spherical unit vector theta of a direction: the field of a vertically polarised isotropic
    element."""
    flat = np.sqrt(u[0] * u[0] + u[1] * u[1])
    x, y = (u[0] / flat, u[1] / flat) if flat > 0 else (1.0, 0.0)
    return u[2] * x, u[2] * y, -flat


@jit(inline=True)
def _mirrored(u, out, n, te, tm):
    """Field (three complex parts) along `out` after a mirror of normal n, of a wave along u with
    the upright field."""
    field, across = _upright(u), _cross(u, n)
    size = np.sqrt(_dot(across, across))
    if size < 1e-9:  # any direction will do, at normal incidence
        across = _cross(u, (1.0, 0.0, 0.0)) if abs(u[0]) < 0.9 else _cross(u, (0.0, 1.0, 0.0))
        size = np.sqrt(_dot(across, across))
    across = across[0] / size, across[1] / size, across[2] / size
    first, second = te * _dot(field, across), tm * _dot(field, _cross(across, u))
    beyond = _cross(across, out)
    return (
        first * across[0] + second * beyond[0],
        first * across[1] + second * beyond[1],
        first * across[2] + second * beyond[2],
    )


@jit
def _weigh(surfaces, face, area, share, scale, normal, slab, before, rows, gain):
    """Complex gains of ways over scatterers; the scatterers' own amplitudes left out."""
    normals, departure, arrival = surfaces.normals, rows.departure, rows.arrival
    mirror = normal[0], normal[1], normal[2]
    for row in range(rows.cell.size):
        i = rows.cell[row]
        f, te, tm = face[i], slab[0][row], slab[1][row]
        n = normals[f, 0], normals[f, 1], normals[f, 2]
        away = departure[row, 0], departure[row, 1], departure[row, 2]
        home = -arrival[row, 0], -arrival[row, 1], -arrival[row, 2]
        if before:  # the field that reaches the scatterer has been through the mirror
            u, w = _turned(away, mirror), home
            x, y, z = _mirrored(away, u, mirror, te, tm)
            passed = _dot((x, y, z), _upright(u))
        else:
            u, w = away, _turned(home, mirror)
            up = _upright(u)
            x, y, z = complex(up[0]), complex(up[1]), complex(up[2])
            passed = _dot(_mirrored(w, home, mirror, te, tm), _upright(home))
        into, back = _dot(u, n), -_dot(w, n)
        if into * back <= 0:
            gain[row] = 0.0
            continue
        across = _cross(u, n)
        whole = (abs(x) ** 2 + abs(y) ** 2 + abs(z) ** 2) * _dot(across, across)
        part = min(abs(_dot((x, y, z), across)) ** 2 / whole, 1.0) if whole > 1e-24 else 0.5
        power = scattered_power(surfaces, f, area[i], into, back, -_dot(u, w), part)
        radii = rows.tx_radius[row] * rows.rx_radius[row]
        gain[row] = scale * share[row] * passed * np.sqrt(power) / radii
