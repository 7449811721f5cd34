r"""Moving scattering centres of a UAV, from its echoes: exact delays within chirps.

A UAV's echoes and ghosts are copied to each centre. With :math:`T'` and :math:`R'` the images of
the ends of a link as the UAV sees them, over all walls of the path, U the UAV and
:math:`C = U + \rho`, a centre's delay is that of the UAV's path plus

.. math:: \delta(t) = \big(|T'-C| - |T'-U| + |R'-C| - |R'-U|\big)/c

which is exact for mirrors. It is cut into pieces of whole slots, each a polynomial of the second
order about its middle, as long as `PHASE_ERROR` allows (`remainder`), a slot at least. Directions
and radii at both ends follow the centre from piece to piece; so do spherical spreading, the
centre's aspect and the elements' pattern. Reflection and occlusion are those of the UAV's path.
Copies are made after the plan's choice of paths and before synthesis: what scores and draws paths
sees the UAV's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from isac_rt.extensions.street.extent import fixed_of
from isac_rt.extensions.street.motion import PHASE_ERROR, CentreModel, Motion, pieces
from isac_rt.extensions.street.rotors import Blades, Plates, blades_of
from isac_rt.extensions.street.screening import FAR, squares_of
from isac_rt.extensions.street.walker import walker_of_flight
from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.free_space import radar_amplitude
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths, merge
from isac_rt.propagation.rcs import CrossSection
from isac_rt.world.swarm import Pose, Swarm, turned

GRAVITY = np.array([0.0, 0.0, 9.81])  # what a hovering UAV's thrust bears [m/s^2]
LEAST_THRUST = 0.1
"""Acceleration of thrust [m/s^2] below which the body's Z axis is left upright: it falls freely."""
PROBES = 4
"""Instants of a frame at which a path is asked whether blades matter to it."""
Poses = Mapping[str, Pose]
Of = tuple[str, CentreModel, "Attitude"]
"""A UAV's name, a model of its centres, and its attitude."""
Pieces = tuple[Motion, np.ndarray, np.ndarray]
"""Motion about the UAV in pieces of a frame, their begin (T + 1,) and middles (T,) [s]."""


def moving_centres(
    swarm: Swarm,
    sections: Mapping[str, CrossSection],
    waveform: Waveform,
    arrays: Arrays,
    seed: int,
) -> MovingCentres:
    """Return the moving centres of all UAVs that have any."""
    models: list[tuple[str, CentreModel]] = []
    own: dict[str, Blades] = {}
    for name, uav in swarm.uavs.items():
        if uav.extent is not None and uav.extent.kind == "pedestrian":
            models.append((name, walker_of_flight(uav.extent, swarm, seed, name)))
        elif uav.extent is not None:
            models.append((name, fixed_of(uav.extent, seed, name)))
        if uav.rotors is not None:
            models.append((name, blades_of(uav.rotors, waveform, seed, name)))
            # a stated level of plates is that along their normal, and none of their edges
            edges = {"chord_m": None, "blade_dbsm": None} if uav.rotors.chord_m else {}
            wires = uav.rotors.model_copy(update=edges)
            own[name] = blades_of(wires, waveform, seed, name)
    return MovingCentres(swarm, sections, waveform, arrays, models, own)


@dataclass(frozen=True)
class MovingCentres:
    """Scattering centres of the UAVs of a swarm.

    Attributes
    ----------
    swarm, waveform, arrays : of the run
    sections : cross-section of each UAV's own echo
    models : of centres, with the name of the UAV each
    own : blades of each UAV as its own radar receives them, wires
    """

    swarm: Swarm
    sections: Mapping[str, CrossSection]
    waveform: Waveform
    arrays: Arrays
    models: Sequence[tuple[str, CentreModel]]
    own: Mapping[str, Blades] = field(default_factory=dict)

    def with_centres(
        self,
        paths: PathSet,
        poses: Poses,
        middle: float,
        least_power: float = 0.0,
        shadow: Callable[[PathSet, np.ndarray], np.ndarray] | None = None,
    ) -> PathSet:
        """Return a link's paths with those over centres, piece by piece of the frame.

        Parameters
        ----------
        poses : at the paths' epoch
        middle : of the receiver's frame [s]
        least_power : |gain|^2 of all centres together that a path over them must exceed
        shadow : factor of the amplitude of paths (K,), each at its time (K,) [s since the epoch]
        """
        target = _echoing(paths)
        gives_way = [name for name, model in self.models if model.replaces_echo]
        kept, later = paths.select(~np.isin(target, gives_way)), middle - paths.epoch
        parts = [kept, *self._over_blades(kept, poses, later, least_power)]
        half = self.waveform.frame_duration / 2
        for name, model in self.models:
            of = name, model, attitude_about(self.swarm, name, paths.epoch, half)
            least = 0.0 if model.replaces_echo else least_power
            bases = [b for b in self._bases(paths, target == name, poses, of) if b.power > least]
            if bases:
                slots = 1 if self._screens(paths.link) else self._slots_of_piece(paths, poses, of)
                begin, time = pieces(self.waveform, slots, later)
                at = of[2].turned(model.motion(paths.epoch + time), time), begin, time
                faded = np.ones((len(bases), time.size))
                if shadow is not None:
                    each = paths.select(np.repeat([base.row for base in bases], time.size))
                    faded = shadow(each, np.tile(time, len(bases))).reshape(faded.shape)
                faded = faded * [self.passed(base.path, time) for base in bases]
                for base, fade in zip(bases, faded, strict=True):
                    parts.append(self._copies(base, of, poses, fade, at))
        own = self.own_echoes(paths, poses, later)
        if own is not None and (own.power.sum() > least_power * self.waveform.num_chirps):
            parts.append(own)
        return merge(parts) if len(parts) > 1 else kept

    def _screens(self, link: Link) -> dict[str, Plates]:
        """Return the blades of a link's terminals that hide what is behind them from its arrays."""
        return {n: blades for n, blades in self.models if n in link and isinstance(blades, Plates)}

    def _taken(
        self, path: PathSet, time: np.ndarray
    ) -> Iterator[tuple[str, np.ndarray, np.ndarray, Motion]]:
        """Yield each end of one path, tx or rx, whose own blades pass before its arrays: the place
        (3,) to or from which it runs there, the parts (T, K) of it that squares of these take, and
        their motion, in world axes from the arrays. The leakage stays on its board."""
        screens = self._screens(path.link)
        found: tuple[np.ndarray, np.ndarray, Motion] | None = None
        ends = ("tx", path.departure, path.tx_radius), ("rx", path.arrival, path.rx_radius)
        for end, towards, radius in ends if path.kind[0] != PathKind.LEAKAGE else ():
            name, far = getattr(path, end), min(radius[0], FAR) * towards[0]
            if name in screens:
                if not (path.link.own and found and (far == found[0]).all()):
                    axes = body_axes(self.swarm, name, path.epoch)
                    share, squares = squares_of(screens[name], far @ axes, path.epoch + time)
                    found = far, share, Motion(*(m @ axes.T for m in squares))
                yield end, *found

    def passed(self, path: PathSet, time: np.ndarray) -> np.ndarray:
        """Return the part (T,) of one path that the terminals' own blades leave in the middle of
        their arrays, at times (T,) [s since the epoch]."""
        left = [1 - share.sum(axis=1) for _, _, share, _ in self._taken(path, time)]
        return np.prod([np.ones(time.size), *left], axis=0)

    def _over_blades(
        self, paths: PathSet, poses: Poses, later: float, least: float
    ) -> Iterator[PathSet]:
        """Yield waves over squares of the terminals' own blades, slot by slot, that take from a
        link's paths what these hide, where that exceeds a power |gain|^2 together."""
        begin, time = pieces(self.waveform, 1, later)
        probes, screens = time[:: max(time.size // PROBES, 1)], self._screens(paths.link)
        for row in np.flatnonzero(paths.power > least) if screens else ():
            path = paths.select(np.array([row]))
            if np.abs(self.passed(path, probes) - 1).max() ** 2 * path.power[0] <= least:
                continue
            left = path.gain * np.ones((time.size, 1))
            for end, far, share, squares in self._taken(path, time):
                name, way = getattr(path, end), {"tx": "departure", "rx": "arrival"}[end]
                ways = squares.length(), squares._replace(place=squares.place - far).length()
                longer, rate, accel = (a + b for a, b in zip(*ways, strict=True))
                longer -= np.linalg.norm(far)
                towards = squares.place / ways[0][0][..., None]
                pattern = self._pattern(name, poses, towards, getattr(path, way))
                phase = np.exp(1j * screens[name].wave_number * longer)
                columns = {"gain": -left * share * phase * pattern, way: towards}
                columns |= {"delay": longer, "delay_rate": rate, "delay_accel": accel}
                yield _pieces(path, columns | {f"{end}_radius": ways[0][0]}, begin, time)
                left = left * (1 - share.sum(axis=1, keepdims=True))

    def _copies(self, base: Base, of: Of, poses: Poses, fade: np.ndarray, at: Pieces) -> PathSet:
        """Return the copies of one path to the centres of a model, times `fade` (T,). Each has the
        aspect and the antenna pattern of its own directions."""
        path, (_, model, attitude), (offset, begin, time) = base.path, of, at
        there = segment(base.sent, time, offset)
        back = there if base.received is base.sent else segment(base.received, time, offset)
        towards, seen = (leg.towards @ attitude.axes_at(time) for leg in (there, back))
        gain = base.gain * model.amplitudes(towards, seen, path.epoch + time) * fade[:, None]
        columns = {
            "gain": gain * there.spreading * back.spreading,
            "delay": there.longer + back.longer,
            "delay_rate": there.rate + back.rate,
            "delay_accel": there.accel + back.accel,
        }
        ends = ("tx", "departure", base.sent, there), ("rx", "arrival", base.received, back)
        for end, way, image, leg in ends:
            own, radius = getattr(path, way), getattr(path, f"{end}_radius")
            columns[way] = _unit(own + (image.towards - leg.towards) @ image.mirror.T)
            columns[f"{end}_radius"] = np.where(np.isinf(radius), np.inf, leg.length)
            columns["gain"] *= self._pattern(getattr(path, end), poses, columns[way], own)
        return _pieces(path, columns, begin, time)

    def _pattern(self, name: str, poses: Poses, towards: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the amplitude of a terminal's elements towards directions (..., 3), over that
        towards a path's own."""
        gain, to_body = self.arrays.of(name).element_gain, poses[name].to_body
        return np.sqrt(gain(to_body(towards)) / gain(to_body(own)))

    def _bases(self, paths: PathSet, which: np.ndarray, poses: Poses, of: Of) -> list[Base]:
        """Return the paths of a UAV that are copied to the centres of a model."""
        (name, model, attitude), out = of, []
        for row in np.flatnonzero(which):
            path = paths.select(np.array([row]))
            images = end_images(path, poses, name)
            section = self.sections[name].square_metres(
                *(poses[name].to_body(image.towards) for image in images)
            )
            towards = images[0].towards @ attitude.axes, images[1].towards @ attitude.axes
            gain = path.gain / np.sqrt(section)
            power = float(np.abs(gain[0]) ** 2 * model.square_metres(*towards))
            out.append(Base(int(row), path, *images, gain, power))
        return out

    def own_echoes(self, paths: PathSet, poses: Poses, later: float) -> PathSet | None:
        """Return the echoes of a radar's own blades, slot by slot, the middle of the frame `later`
        [s] than the epoch; None without."""
        if not paths.link.own or paths.tx not in self.own:
            return None
        name, model = paths.tx, self.own[paths.tx]
        begin, time = pieces(self.waveform, 1, later)
        axes = body_axes(self.swarm, name, paths.epoch)
        motion = Motion(*(m @ axes.T for m in model.motion(paths.epoch + time)))
        distance, rate, accel = motion.length()
        towards = motion.place / distance[..., None]
        section, wavelength = model.amplitude**2, self.waveform.wavelength
        columns = {
            "gain": radar_amplitude(wavelength, section, distance, distance)
            * self.arrays.of(name).element_gain(poses[name].to_body(towards)),
            "delay": 2 * distance,
            "delay_rate": 2 * rate,
            "delay_accel": 2 * accel,
            **dict.fromkeys(("departure", "arrival"), towards),
            **dict.fromkeys(("tx_radius", "rx_radius"), distance),
        }
        received = columns["gain"].any(axis=0)
        if not received.any():
            return None
        at: dict[str, Any] = dict.fromkeys(("departure", "arrival"), towards[0, :1])
        at |= {"gain": [1.0], "delay": [0.0], "kind": PathKind.LEAKAGE, "epoch": paths.epoch}
        at_arrays = make_paths(tx=name, rx=name, target_names=paths.target_names, **at)
        return _pieces(at_arrays, columns, begin, time).select(np.tile(received, time.size))

    def report(
        self,
        found: Mapping[Link, PathSet],
        poses: Poses,
        over_noise: Mapping[Link, float],
    ) -> list[dict[str, Any]]:
        """Return what the plan says of each model: `Item`'s values by name.

        Parameters
        ----------
        over_noise : by link, the mean power of a cell over the noise for a mean |gain|^2 of one
        """
        w, out = self.waveform, []
        slot = w.chirp_duration + (w.num_groups - 1) * w.group_spacing - w.window_start
        k = 2 * np.pi * (w.carrier_frequency + w.bandwidth) / SPEED_OF_LIGHT
        for name, model in self.models:
            most, slots = 0.0, 1
            for link, paths in found.items():
                attitude = attitude_about(self.swarm, name, paths.epoch, w.frame_duration / 2)
                of = name, model, attitude
                for base in self._bases(paths, _echoing(paths) == name, poses, of):
                    if (power := base.power * over_noise[link]) > most:
                        most, slots = power, self._slots_of_piece(paths, poses, of)
            half = (slot + (slots - 1) * w.slot_duration) / 2
            if not most and Link(name, name) in found and name in self.own:
                continue
            error = k * SPEED_OF_LIGHT * remainder(model.jerk, half) + model.fading * half
            error = max(PHASE_ERROR, error)
            about = f"moving parts of {name}", "jerk, turning, obliquity within pieces", error
            out.append(self._row(about, model, most))
        for link, paths in found.items():
            antennas, placed = self.arrays.at(link), np.flatnonzero(paths.kind != PathKind.LEAKAGE)
            ends = antennas.rx_positions, antennas.tx_positions
            reach = sum(float(np.linalg.norm(end, axis=1).max()) for end in ends)
            before = [blades.rotors for blades in self._screens(link).values()]
            if before and placed.size:
                strongest = placed[[paths.power[placed].argmax()]]
                left = self.passed(paths.select(strongest), pieces(w, 1, 0.0)[1])
                lines = float(left.std() / np.abs(left.mean()))
                row = {"what": "opaque blades before the arrays", "link": str(link)}
                row["modelled"] = f"lines of {20 * np.log10(lines):.0f} dB on the strongest path"
                row["left_out"] = "sizes of squares as antennas beside the arrays' middle see them"
                error = lines * k * reach * max((r.chord_m or 0) / 4 / r.nearest for r in before)
                out.append({**row, "estimate": error, "unit": "of a path's amplitude"})
            own = self.own_echoes(paths, poses, 0.0)
            if own is not None:
                blades, gain = self.own[link.tx], own.gain.real.reshape(w.num_chirps, -1)
                mean = float(own.power.sum()) / w.num_chirps * over_noise[link]
                error = k * reach * blades.speed / own.rx_radius.min() * slot / 2
                # the other change of a slot is in gain: by spreading and the elements' pattern
                error += float(np.linalg.norm(np.diff(gain, axis=0)) / np.linalg.norm(gain) / 2)
                about = f"own rotors of {link.tx}", "directions and ranges within a slot", error
                out.append(self._row(about, blades, mean))
        return out

    def _row(
        self, about: tuple[str, str, float], model: CentreModel, power: float
    ) -> dict[str, Any]:
        """Return what the plan says of moving parts: what they are, what is left out and its error
        [rad], and their power over the noise of a cell."""
        w, edge = self.waveform, 2 * model.speed / self.waveform.wavelength
        seen = "without effect: no terminal receives its echo"
        if power > 0:
            seen = (
                f"{10 * np.log10(power):.0f} dB over the noise of a cell; Doppler to {edge:.4g} Hz "
                f"either side, slots show {1 / (2 * w.slot_duration):.4g} Hz"
            )
        row = dict(zip(("what", "left_out", "estimate"), about, strict=True))
        return {**row, "modelled": f"{model.described()}, {seen}", "unit": "rad"}

    def _slots_of_piece(self, paths: PathSet, poses: Poses, of: Of) -> int:
        """Return the number of slots over which delays of the second order and constant directions
        keep within `PHASE_ERROR`.

        The direction to a centre turns by its speed over the distance. The jerk of a centre at rho
        that turns with the body and against the view at a rate w is 3 rho w^3 at most.
        """
        (name, model, attitude), w = of, self.waveform
        k = 2 * np.pi * (w.carrier_frequency + w.bandwidth) / SPEED_OF_LIGHT
        antennas, uav = self.arrays.at(paths.link), poses[name]
        places = model.motion(np.array([paths.epoch])).place
        extent = float(np.linalg.norm(places, axis=-1).max())
        spin, turning, fastest = float(np.linalg.norm(attitude.rate)), 0.0, 0.0
        arrays = antennas.tx_positions, antennas.rx_positions
        for end, elements in zip(paths.link, arrays, strict=True):
            distance = float(np.linalg.norm(uav.position - poses[end].position))
            passing = float(np.linalg.norm(uav.velocity - poses[end].velocity))
            reach = float(np.linalg.norm(elements, axis=1).max())
            turning += reach * (model.speed + spin * extent + passing) / distance
            fastest = max(fastest, spin + passing / distance)
        jerk = model.jerk + 3 * extent * fastest**3
        by_turning = PHASE_ERROR / max(k * turning, np.finfo(float).tiny)
        by_delay = (3 * PHASE_ERROR / max(k * jerk, np.finfo(float).tiny)) ** (1 / 3)
        return int(np.clip(2 * min(by_turning, by_delay) / w.slot_duration, 1, w.num_chirps))


class Attitude(NamedTuple):
    """Axes of a UAV's body at an epoch, (3, 3) columns right, ahead and up, and the rate [rad/s]
    and acceleration of their rotation vector, (3,) each in world axes."""

    axes: np.ndarray
    rate: np.ndarray
    accel: np.ndarray

    def axes_at(self, time: np.ndarray) -> np.ndarray:
        """Return the axes (T, 3, 3) at times (T,) [s since the epoch]."""
        t = time[:, None]
        return Rotation.from_rotvec((self.rate + self.accel * t / 2) * t).as_matrix() @ self.axes

    def turned(self, own: Motion, time: np.ndarray) -> Motion:
        """Return a motion in the body's axes in world axes, at times (T,) [s since the epoch]."""
        t, axes = time[:, None], self.axes_at(time)
        spin = (self.rate + self.accel * t)[:, None] @ axes  # in body axes
        turning = np.cross(spin, own.place)
        velocity = own.velocity + turning
        acceleration = own.acceleration + np.cross(spin, 2 * own.velocity + turning)
        acceleration += np.cross((self.accel @ axes)[:, None], own.place)
        return Motion(*(m @ axes.swapaxes(1, 2) for m in (own.place, velocity, acceleration)))


def attitude_about(swarm: Swarm, name: str, epoch: float, half: float) -> Attitude:
    """Return a UAV's attitude about an epoch, to the second order within `half` [s] of it."""
    before, now, after = (body_axes(swarm, name, epoch + t) for t in (-half, 0.0, half))
    ahead, behind = (Rotation.from_matrix(a @ now.T).as_rotvec() for a in (after, before))
    return Attitude(now, (ahead - behind) / (2 * half), (ahead + behind) / half**2)


def body_axes(swarm: Swarm, name: str, time: float) -> np.ndarray:
    """Return the axes of a UAV's body at a time [s], (3, 3) columns right, ahead and up.

    They are the waypoints' attitude where that is stated. Else Y is where the UAV looks, and Z
    along the thrust that the flight needs in still air without drag, acceleration plus gravity; of
    what stands on the ground it is up.
    """
    uav, pose = swarm.uavs[name], swarm.trajectories[name].pose(time)
    own = pose.rotation @ turned(uav.mount_deg).as_matrix().T
    if uav.waypoints is not None and uav.waypoints[0].attitude_deg is not None:
        return own
    stands = uav.extent is not None and uav.extent.kind in ("vehicle", "agv", "pedestrian")
    stands = stands or uav.box is not None
    up = GRAVITY if stands else pose.acceleration + GRAVITY
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > LEAST_THRUST else GRAVITY / GRAVITY[2]
    right = np.cross(own[:, 1], up)
    if np.linalg.norm(right) < 1e-6:  # it looks straight up or down
        right = np.cross(-own[:, 2], up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up], axis=1)


class EndImage(NamedTuple):
    """An end of a path as the UAV sees it.

    Attributes
    ----------
    towards : (3,) unit vector from the UAV to the end's image
    from_uav : motion of the image against the UAV, (3,) each, at the epoch
    mirror : (3, 3) turns directions at the UAV into those at the end
    """

    towards: np.ndarray
    from_uav: Motion
    mirror: np.ndarray


class Base(NamedTuple):
    """A path of a UAV, by its row, and its ends as the UAV sees them.

    Attributes
    ----------
    gain : (1,) of a centre of one square metre in place of the UAV
    power : |gain|^2 of all centres together
    """

    row: int
    path: PathSet
    sent: EndImage
    received: EndImage
    gain: np.ndarray
    power: float


def _echoing(paths: PathSet) -> np.ndarray:
    """Return the UAV (K,) whose echo each path is, over walls at rest; empty without."""
    target = np.where((paths.faces < -1).any(axis=1), -1, paths.target)
    return np.array([*paths.target_names, ""])[target]


def _pieces(
    path: PathSet, columns: dict[str, np.ndarray], begin: np.ndarray, time: np.ndarray
) -> PathSet:
    """Return paths that differ from one in columns (T, K), in pieces of the frame: `delay` [m] and
    its derivatives in the pieces' middles, as additions to those of the path."""
    rate, accel, t = columns["delay_rate"], columns["delay_accel"], time[:, None]
    columns["delay"] = columns["delay"] - (rate - accel * t / 2) * t
    columns["delay_rate"] = rate - accel * t
    for name in ("delay", "delay_rate", "delay_accel"):
        columns[name] = getattr(path, name) + columns[name] / SPEED_OF_LIGHT
    columns["begin"] = np.broadcast_to(np.maximum(begin[:-1, None], path.begin), rate.shape)
    columns["end"] = np.broadcast_to(np.minimum(begin[1:, None], path.end), rate.shape)
    for name in ("departure", "arrival", "tx_radius", "rx_radius"):
        columns.setdefault(name, getattr(path, name)[None])
    flat: dict[str, Any] = {
        k: np.broadcast_to(v, (*rate.shape, *v.shape[2:])).reshape(-1, *v.shape[2:])
        for k, v in columns.items()
    }
    same: dict[str, Any] = {k: getattr(path, k)[0] for k in ("kind", "target", "bounces")}
    (tx, rx), names = path.link, path.target_names
    return make_paths(tx=tx, rx=rx, epoch=path.epoch, target_names=names, **same, **flat)


def end_images(path: PathSet, poses: Poses, name: str) -> tuple[EndImage, EndImage]:
    """Return the transmitter and the receiver of one path as a UAV sees them; one object where
    they are the same."""
    uav, points = poses[name], path.points[0]
    at = int(np.nanargmin(np.linalg.norm(points - uav.position, axis=1)))
    sent = _end_image(poses[path.tx], uav, points[:at], path.faces[0, :at])
    if path.tx == path.rx and path.bounces[0] == 0 and not path.bent[0]:
        return sent, sent
    back, faces = points[:at:-1], path.faces[0, :at:-1]
    return sent, _end_image(poses[path.rx], uav, back, faces)


def _end_image(end: Pose, uav: Pose, points: np.ndarray, faces: np.ndarray) -> EndImage:
    """Return an end as the UAV sees it over points on walls, and on edges, whose face is -1."""
    there = np.isfinite(points).all(axis=1)
    places = np.concatenate([end.position[None], points[there], uav.position[None]])
    legs = np.diff(places, axis=0)
    length = np.linalg.norm(legs, axis=1)
    along, mirror = legs / length[:, None], np.eye(3)
    for before, after, face in zip(along[:-1], along[1:], faces[there], strict=True):
        if face >= 0:
            normal = _unit(after - before)
            mirror = mirror @ (np.eye(3) - 2 * np.outer(normal, normal))
    motion = end.motion()[1:] @ mirror - uav.motion()[1:]
    return EndImage(-along[-1], Motion(-length.sum() * along[-1], *motion), mirror)


class Segment(NamedTuple):
    """The way from an end of a path to centres, in comparison with the way to the UAV.

    Attributes
    ----------
    length : (T, K) of the way [m]
    longer, rate, accel : (T, K) its excess over the way to the UAV and its derivatives
    spreading : (T, K) length of the way to the UAV at the epoch over that to the centre
    towards : (T, K, 3) unit vectors from the centres to the end's image
    """

    length: np.ndarray
    longer: np.ndarray
    rate: np.ndarray
    accel: np.ndarray
    spreading: np.ndarray
    towards: np.ndarray


def segment(image: EndImage, time: np.ndarray, offset: Motion) -> Segment:
    """Return the way from an end to centres that move by `offset` about the UAV, at times (T,)
    [s since the epoch]."""
    place, velocity, acceleration = image.from_uav
    t = time[:, None, None]
    uav = Motion(
        place + (velocity + acceleration * t / 2) * t,
        velocity + acceleration * t,
        np.broadcast_to(acceleration, (time.size, 1, 3)),
    )
    centre = Motion(*(u - o for u, o in zip(uav, offset, strict=True)))
    of_uav, of_centre = uav.length(), centre.length()
    rho, q = offset.place, uav.place
    longer = np.vecdot(rho, rho - 2 * q) / (of_centre[0] + of_uav[0])
    rate, accel = (a - b for a, b in zip(of_centre[1:], of_uav[1:], strict=True))
    spreading, towards = (
        np.linalg.norm(place) / of_centre[0],
        centre.place / of_centre[0][..., None],
    )
    return Segment(of_centre[0], longer, rate, accel, spreading, towards)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.sqrt(np.vecdot(vectors, vectors))[..., None]


def remainder(jerk: float, half: float) -> float:
    """Return the bound of the error in delay [s] of a point of some jerk [m/s^3], at `half` [s]
    from the middle of a piece, out and back."""
    return 2 * jerk * half**3 / (6 * SPEED_OF_LIGHT)
