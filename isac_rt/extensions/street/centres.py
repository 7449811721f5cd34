r"""Moving scattering centres of a UAV, from its echoes: exact delays within chirps.

A UAV's echoes and ghosts are copied to each centre. With :math:`T'` and :math:`R'` the images of
the ends of a link as the UAV sees them, over all walls of the path, U the UAV and
:math:`C = U + \rho`, a centre's delay is that of the UAV's path plus

.. math:: \delta(t) = \big(|T'-C| - |T'-U| + |R'-C| - |R'-U|\big)/c

which is exact for mirrors. It is cut into pieces of whole slots, each a polynomial of the second
order about its middle. The remainder in delay is at most :math:`|\dddot\tau| h^3/6` at h from it:
:math:`2 v\Omega^2 h^3/(6 c)` for a point that circles at speed v and angular rate :math:`\Omega`,
1e-15 s or 5e-4 rad for 75 m/s, 6000 rev/min and h = 32 us (`remainder`). Pieces are as long as
`PHASE_ERROR` allows, a slot at least.

Directions and radii at both ends follow the centre from piece to piece; so does spherical
spreading. The elements' pattern, reflection and occlusion are those of the UAV's path, and edges
round which a path bends move with the UAV. Copies are made after the plan's choice of paths and
before synthesis: what scores and draws paths sees the UAV's own, and stored paths stay small.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from isac_rt.extensions.street.extent import fixed_of
from isac_rt.extensions.street.motion import CentreModel, Motion
from isac_rt.extensions.street.rotors import blades_of
from isac_rt.extensions.street.walker import walker_of_flight
from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathSet, make_paths, merge
from isac_rt.propagation.rcs import CrossSection
from isac_rt.world.swarm import Pose, Swarm, turned

GRAVITY = np.array([0.0, 0.0, 9.81])  # what a hovering UAV's thrust bears [m/s^2]
LEAST_THRUST = 0.1
"""Acceleration of thrust [m/s^2] below which the body's Z axis is left upright: it falls freely."""
PHASE_ERROR = 1e-3
"""Largest phase error [rad] at the ends of a piece; 0.06 % of its samples on average."""


def moving_centres(
    swarm: Swarm,
    sections: Mapping[str, CrossSection],
    waveform: Waveform,
    arrays: Arrays,
    seed: int,
) -> MovingCentres:
    """Return the moving centres of all UAVs that have any."""
    models: list[tuple[str, CentreModel]] = []
    for name, uav in swarm.uavs.items():
        if uav.extent is not None and uav.extent.kind == "pedestrian":
            models.append((name, walker_of_flight(uav.extent, swarm, seed, name)))
        elif uav.extent is not None:
            models.append((name, fixed_of(uav.extent, seed, name)))
        if uav.rotors is not None:
            models.append((name, blades_of(uav.rotors, waveform, seed, name)))
    return MovingCentres(swarm, sections, waveform, arrays, models)


@dataclass(frozen=True)
class MovingCentres:
    """Scattering centres of the UAVs of a swarm.

    Attributes
    ----------
    swarm, waveform, arrays : of the run
    sections : cross-section of each UAV's own echo
    models : of centres, with the name of the UAV each
    """

    swarm: Swarm
    sections: Mapping[str, CrossSection]
    waveform: Waveform
    arrays: Arrays
    models: Sequence[tuple[str, CentreModel]]

    def with_centres(
        self,
        paths: PathSet,
        poses: Mapping[str, Pose],
        middle: float,
        least_power: float = 0.0,
    ) -> PathSet:
        """Return a link's paths with those over centres, piece by piece of the frame.

        Parameters
        ----------
        poses : at the paths' epoch
        middle : of the receiver's frame [s]
        least_power : |gain|^2 of all centres together that a path over them must exceed
        """
        target = np.array([*paths.target_names, ""])[paths.target]
        gives_way = [name for name, model in self.models if model.replaces_echo]
        parts = [paths.select(~np.isin(target, gives_way))]
        for name, model in self.models:
            attitude = self._attitude(name, paths.epoch)
            bases = self._bases(paths, target == name, poses, (name, model, attitude))
            least = 0.0 if model.replaces_echo else least_power
            bases = [base for base in bases if base.power > least]
            if bases:
                slots = self._slots_of_piece(paths, poses, (name, model, attitude))
                begin, time = self.pieces(slots, middle - paths.epoch)
                offset = attitude.turned(model.motion(paths.epoch + time), time)
                parts += [_copies(base, offset, begin, time) for base in bases]
        return merge(parts) if len(parts) > 1 else paths

    def _bases(
        self,
        paths: PathSet,
        which: np.ndarray,
        poses: Mapping[str, Pose],
        of: tuple[str, CentreModel, Attitude],
    ) -> list[Base]:
        """Return the paths of a UAV that are copied to the centres of a model."""
        (name, model, attitude), out = of, []
        for row in np.flatnonzero(which):
            path = paths.select(np.array([row]))
            images = end_images(path, poses, name)
            towards = [poses[name].to_body(image.towards) for image in images]
            section = self.sections[name].square_metres(*towards)
            by_axes = (image.towards @ attitude.axes for image in images)
            gain = model.amplitudes(*by_axes) * (path.gain / np.sqrt(section))
            out.append(Base(path, *images, gain))
        return out

    def report(
        self,
        found: Mapping[Link, PathSet],
        poses: Mapping[str, Pose],
        over_noise: Mapping[Link, float],
    ) -> list[dict[str, Any]]:
        """Return what the plan says of each model: `Item`'s values by name.

        Parameters
        ----------
        over_noise : by link, the mean power of a cell over the noise for a mean |gain|^2 of one
        """
        w, out = self.waveform, []
        widest = 1 / (2 * w.slot_duration)
        slot = w.chirp_duration + (w.num_groups - 1) * w.group_spacing - w.window_start
        for name, model in self.models:
            edge, level = 2 * model.speed / w.wavelength, -np.inf
            for link, paths in found.items():
                which = np.array([*paths.target_names, ""])[paths.target] == name
                of = name, model, self._attitude(name, paths.epoch)
                for base in self._bases(paths, which, poses, of):
                    level = max(level, 10 * np.log10(base.power * over_noise[link]))
            frequency = w.carrier_frequency + w.bandwidth
            error = 2 * np.pi * frequency * remainder(model.jerk, slot / 2)
            out.append(
                {
                    "what": f"moving parts of {name}",
                    "modelled": f"{model.described()}, {level:.0f} dB over the noise of a cell; "
                    f"Doppler to {edge:.4g} Hz either side, slots show {widest:.4g} Hz",
                    "left_out": "jerk and turning within pieces of the frame",
                    "estimate": max(PHASE_ERROR, error),
                    "unit": "rad",
                }
            )
        return out

    def pieces(self, slots: int, later: float) -> tuple[np.ndarray, np.ndarray]:
        """Return when pieces of so many slots begin and the last ends (T + 1,), and their middles
        (T,) [s since the epoch], the middle of the frame `later` than the epoch."""
        w = self.waveform
        first = np.append(np.arange(0, w.num_chirps, slots), w.num_chirps)
        begin = first * w.slot_duration - w.frame_duration / 2 + later
        samples = w.window_start, w.chirp_duration + (w.num_groups - 1) * w.group_spacing
        middle = (begin[:-1] + begin[1:] - w.slot_duration + sum(samples)) / 2
        return (np.array([-np.inf, np.inf]) if middle.size == 1 else begin), middle

    def _slots_of_piece(
        self,
        paths: PathSet,
        poses: Mapping[str, Pose],
        of: tuple[str, CentreModel, Attitude],
    ) -> int:
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
        for end, elements in zip(
            paths.link, (antennas.tx_positions, antennas.rx_positions), strict=True
        ):
            distance = float(np.linalg.norm(uav.position - poses[end].position))
            passing = float(np.linalg.norm(uav.velocity - poses[end].velocity))
            reach = float(np.linalg.norm(elements, axis=1).max())
            turning += reach * (model.speed + spin * extent + passing) / distance
            fastest = max(fastest, spin + passing / distance)
        jerk = model.jerk + 3 * extent * fastest**3
        by_turning = PHASE_ERROR / max(k * turning, np.finfo(float).tiny)
        by_delay = (3 * PHASE_ERROR / max(k * jerk, np.finfo(float).tiny)) ** (1 / 3)
        return int(np.clip(2 * min(by_turning, by_delay) / w.slot_duration, 1, w.num_chirps))

    def _attitude(self, name: str, epoch: float) -> Attitude:
        """Return a UAV's attitude about the epoch, to the second order in a frame."""
        return attitude_about(self.swarm, name, epoch, self.waveform.frame_duration / 2)


class Attitude(NamedTuple):
    """Axes of a UAV's body at an epoch, (3, 3) columns right, ahead and up, and the rate [rad/s]
    and acceleration of their rotation vector, (3,) each in world axes."""

    axes: np.ndarray
    rate: np.ndarray
    accel: np.ndarray

    def turned(self, own: Motion, time: np.ndarray) -> Motion:
        """Return a motion in the body's axes in world axes, at times (T,) [s since the epoch]."""
        t = time[:, None]
        turn = Rotation.from_rotvec((self.rate + self.accel * t / 2) * t)
        axes = turn.as_matrix() @ self.axes
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
    """A path of a UAV, its ends as the UAV sees them, and the gains (K,) of centres there."""

    path: PathSet
    sent: EndImage
    received: EndImage
    gain: np.ndarray

    @property
    def power(self) -> float:
        """|gain|^2 of all centres: their mean power within 3 dB."""
        return float((np.abs(self.gain) ** 2).sum())


def _copies(base: Base, offset: Motion, begin: np.ndarray, time: np.ndarray) -> PathSet:
    """Return the copies of one path to centres that move by `offset` about the UAV, in pieces from
    `begin` (T + 1,) about `time` (T,) [s since the epoch]."""
    path = base.path
    there = segment(base.sent, time, offset)
    back = there if base.received is base.sent else segment(base.received, time, offset)
    rate = (there.rate + back.rate) / SPEED_OF_LIGHT
    accel = (there.accel + back.accel) / SPEED_OF_LIGHT
    t = time[:, None]
    longer = (there.longer + back.longer) / SPEED_OF_LIGHT
    columns = {
        "gain": base.gain * there.spreading * back.spreading,
        "delay": path.delay + longer - (rate - accel * t / 2) * t,
        "delay_rate": path.delay_rate + rate - accel * t,
        "delay_accel": path.delay_accel + accel,
        "departure": _unit(path.departure + there.turn @ base.sent.mirror.T),
        "arrival": _unit(path.arrival + back.turn @ base.received.mirror.T),
        "tx_radius": np.where(np.isinf(path.tx_radius), np.inf, there.length),
        "rx_radius": np.where(np.isinf(path.rx_radius), np.inf, back.length),
        "begin": np.broadcast_to(np.maximum(begin[:-1, None], path.begin), rate.shape),
        "end": np.broadcast_to(np.minimum(begin[1:, None], path.end), rate.shape),
    }
    flat: dict[str, Any] = {k: v.reshape(-1, *v.shape[2:]) for k, v in columns.items()}
    same: dict[str, Any] = {k: getattr(path, k)[0] for k in ("kind", "target", "bounces")}
    (tx, rx), names = path.link, path.target_names
    return make_paths(tx=tx, rx=rx, epoch=path.epoch, target_names=names, **same, **flat)


def end_images(path: PathSet, poses: Mapping[str, Pose], name: str) -> tuple[EndImage, EndImage]:
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
    place = -length.sum() * along[-1]
    motion = [
        mirror.T @ own - of_uav
        for own, of_uav in (
            (end.velocity, uav.velocity),
            (end.acceleration, uav.acceleration),
        )
    ]
    return EndImage(-along[-1], Motion(place, *motion), mirror)


class Segment(NamedTuple):
    """The way from an end of a path to centres, in comparison with the way to the UAV.

    Attributes
    ----------
    length : (T, K) of the way [m]
    longer, rate, accel : (T, K) its excess over the way to the UAV and its derivatives
    spreading : (T, K) length of the way to the UAV over that to the centre
    turn : (T, K, 3) direction to the centre less that to the UAV at the epoch, at the UAV
    """

    length: np.ndarray
    longer: np.ndarray
    rate: np.ndarray
    accel: np.ndarray
    spreading: np.ndarray
    turn: np.ndarray


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
    of_uav, of_centre = _distance(uav), _distance(centre)
    rho, q = offset.place, uav.place
    longer = np.vecdot(rho, rho - 2 * q) / (of_centre[0] + of_uav[0])
    rate, accel = (a - b for a, b in zip(of_centre[1:], of_uav[1:], strict=True))
    turn = image.towards - centre.place / of_centre[0][..., None]
    return Segment(of_centre[0], longer, rate, accel, of_uav[0] / of_centre[0], turn)


def _distance(motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the length of a vector that moves, and its first and second derivative."""
    place, velocity, acceleration = motion
    length = np.sqrt(np.vecdot(place, place))
    rate = np.vecdot(place, velocity) / length
    accel = np.vecdot(velocity, velocity) + np.vecdot(place, acceleration) - rate * rate
    return length, rate, accel / length


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.sqrt(np.vecdot(vectors, vectors))[..., None]


def remainder(jerk: float, half: float) -> float:
    """Return the bound of the error in delay [s] of a point of some jerk [m/s^3], at `half` [s]
    from the middle of a piece, out and back."""
    return 2 * jerk * half**3 / (6 * SPEED_OF_LIGHT)
