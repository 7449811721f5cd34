"""Moving scattering centres against closed forms."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.special import jv

from isac_rt.extensions.street.centres import MovingCentres
from isac_rt.extensions.street.extent import KINDS
from isac_rt.extensions.street.rotors import (
    Blades,
    Plates,
    blade_points,
    blade_section,
    blades_of,
)
from isac_rt.extensions.street.screening import FAR, squares_of
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.propagation.rcs import CrossSection, lobe_db
from isac_rt.world.settings import Rcs, Rotors, Uav
from isac_rt.world.swarm import Pose, Swarm
from truths.case import Errors, case


def echo_over(place: np.ndarray, ends: np.ndarray, rx: str = "B") -> PathSet:
    """Echo of unit gain of a UAV U at a place (3,) between A and `rx` at `ends` (2, 3)."""
    segments = place - ends
    length = np.linalg.norm(segments, axis=1)
    return make_paths(
        gain=[1.0],
        delay=[length.sum() / SPEED_OF_LIGHT],
        departure=segments[:1] / length[0],
        arrival=segments[1:] / length[1],
        kind=PathKind.TARGET,
        target=0,
        points=place[None, None],
        faces=[[-1]],
        tx="A",
        rx=rx,
        epoch=0.0,
        target_names=("U",),
    )


def _circling(
    w: Waveform, radius: float, turns: float, ends: np.ndarray, place: np.ndarray
) -> PathSet:
    """Paths over a point that circles about a UAV by so many turns a frame, without those of the
    UAV."""
    poses = {"A": Pose.at_rest(ends[0]), "B": Pose.at_rest(ends[1])}
    echo = echo_over(place, ends)
    swarm = Swarm({"U": Uav(role="target", position_m=(place[0], place[1], place[2]))})
    turning = 2 * np.pi * turns / w.frame_duration
    numbers = (np.array([v]) for v in (radius, 0.3, turning, 1.0))
    point = Blades(np.zeros((1, 3)), *numbers)
    sections = {"U": CrossSection(Rcs(model="constant", value_dbsm=0.0), "U", 1)}
    arrays = Arrays(Antennas(tx_x=1, tx_z=1, rx_x=1, rx_z=1, spacing=0.0))
    moving = MovingCentres(swarm, sections, w, arrays, [("U", point)])
    paths = moving.with_centres(echo, poses | swarm.poses(0.0), 0.0)
    return paths.select(np.arange(1, len(paths)))


@case(
    "2 v cos(beta/2) / lambda",
    "2e-4 of the shift",
    "the fastest of the slots' middles is up to 1 degree from the extreme",
)
def doppler_edge_of_a_rotor() -> Errors:
    """The largest Doppler shift of a blade's tip, from one place and from two."""
    w = Waveform(num_chirps=300, num_groups=1)
    for across in (0.0, 700.0, 2000.0):
        ends = np.array([[0.0, 0.0, 0.0], [across, 0.0, 0.0]])
        paths = _circling(w, 0.12, 2.2, ends, np.array([0.0, 1000.0, 0.0]))
        t = (np.maximum(paths.begin, -1) + np.minimum(paths.end, 1)) / 2
        rate = paths.delay_rate + paths.delay_accel * t
        speed = 2 * np.pi * 2.2 / w.frame_duration * 0.12
        edge = 2 * speed * np.cos(np.arctan2(across, 1000.0) / 2) / w.wavelength
        yield abs(np.abs(rate * w.carrier_frequency).max() / edge - 1)


@case(
    "Bessel functions: line n has the amplitude J_n(4 pi a / lambda)",
    "1e-6 of the carrier",
    "curvature of the wave over 1 cm at 1000 km, and delays of 7 ms in float64",
)
def lines_of_a_circling_point() -> Errors:
    """The spectrum of a point that circles 37 times in a frame, folded by the slots."""
    w, radius, turns = Waveform(num_chirps=255, num_groups=1), 0.01, 37
    place = np.array([0.0, 1e6, 0.0])
    paths = _circling(w, radius, turns, np.zeros((2, 3)), place)
    slots = np.arange(w.num_chirps) * w.slot_duration - w.frame_duration / 2
    t = slots + (w.window_start + w.chirp_duration) / 2
    row = np.searchsorted(paths.begin, t, side="right") - 1
    late = paths.delay[row] + (paths.delay_rate[row] + paths.delay_accel[row] * t / 2) * t
    signal = np.exp(2j * np.pi * w.carrier_frequency * (late - 2e6 / SPEED_OF_LIGHT))
    orders = np.arange(-40, 41)
    lines = np.abs(np.fft.fft(signal))[orders * turns % 255] / signal.size
    yield float(np.abs(lines - np.abs(jv(orders, 4 * np.pi * radius / w.wavelength))).max())


@case("the integral over the wire, a sinc", "1e-5 of a flash", "bound of the number of points")
def blade_of_points() -> Errors:
    """The echo of a blade of points in all directions."""
    for length in (0.03, 0.12, 0.4):
        k = 2 * np.pi * 77.6e9 / SPEED_OF_LIGHT
        place, weight = blade_points(length, k)
        x = np.linspace(-1, 1, 997) * k * length
        found = np.exp(2j * np.outer(x, place / length)) @ weight
        yield float(np.abs(found - np.sinc(x / np.pi) * np.exp(1j * x)).max())


@case(
    "physical optics of a plate: two sincs and the mean obliquity",
    "1e-3 of a flash",
    "bound of the number of points on the chord",
)
def flat_blade_of_points() -> Errors:
    """The echo of a flat blade half a slot from the middle of a piece, at a bistatic angle."""
    w = Waveform(num_chirps=6)
    rotors = Rotors(number=1, blades=1, chord_m=0.015, rev_per_min=6000.0)
    body = blades_of(rotors, w, 1, "U")
    assert isinstance(body, Plates)
    k, tilt, lengths = body.wave_number, np.radians(rotors.incidence_deg), (0.12, 0.015)
    late = w.slot_duration / 2
    for off, below in itertools.product(np.linspace(-0.05, 0.05, 21), (-1.5, -1.3, -1.0)):
        across = body.start[0] + np.pi / 2 + off
        u1, u2 = _towards(across + 0.2, below), _towards(across - 0.2, below)
        gain = body.amplitudes(u1, u2, np.zeros(1))[0]
        found = gain.conj() @ np.exp(-1j * k * body.motion(np.array([late])).place[0] @ (u1 + u2))
        angle, still = body.start[0] + body.spin[0] * late, body.start[0]
        e, t = np.array([_towards(a, 0.0) for a in (angle, angle + np.pi / 2)])
        chord = np.cos(tilt) * t + np.sin(tilt) * np.array([0.0, 0.0, 1.0])
        x, y = (k / 2 * n * axis @ (u1 + u2) for n, axis in zip(lengths, (e, chord), strict=True))
        e, t = np.array([_towards(a, 0.0) for a in (still, still + np.pi / 2)])
        normal = np.cross(e, np.cos(tilt) * t + np.sin(tilt) * np.array([0.0, 0.0, 1.0]))
        obliquity = (abs(normal @ u1) + abs(normal @ u2)) / 2
        truth = obliquity * np.sinc(x / np.pi) * np.exp(-1j * x) * np.sinc(y / np.pi)
        yield float(abs(found / np.sqrt(blade_section(rotors, k)) - truth))


OPAQUE = Rotors(
    number=2,
    chord_m=0.015,
    height_m=0.1,
    rev_per_min=(6000.0, -5600.0),
    phase_deg=(20.0, 75.0),
)


def surface(rotors: Rotors, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (K, 3) on all flat blades at a time, normals (K, 3) and areas (K,), in body axes."""
    places, normals = [], []
    r, tilt, chord = rotors, np.radians(rotors.incidence_deg), rotors.chord_m or 0.0
    (length, of_length), (width, of_width) = map(np.polynomial.legendre.leggauss, (180, 32))
    length, width = (1 + length) / 2 * r.blade_length_m, width / 2 * chord
    area = np.multiply.outer(of_length, of_width).ravel() / 4 * r.blade_length_m * chord
    up = np.array([0.0, 0.0, 1.0])
    for i, (speed, phase) in enumerate(zip(r.speeds, r.phase_deg or (), strict=True)):
        where = 2 * np.pi * (i + 0.5) / r.number
        hub = r.height_m * up + r.arm_m * _towards(where, 0.0) * (r.number > 1)
        for blade in range(r.blades):
            angle = np.radians(phase + 6 * speed * time) + 2 * np.pi * blade / r.blades
            out = _towards(angle, 0.0)
            ahead = np.sign(speed) * _towards(angle + np.pi / 2, 0.0)
            across = np.cos(tilt) * ahead + np.sin(tilt) * up
            spot = hub + length[:, None, None] * out + width[:, None] * across
            places.append(spot.reshape(-1, 3))
            normals.append(np.broadcast_to(np.cross(out, across), places[-1].shape))
    return np.concatenate(places), np.concatenate(normals), np.tile(area, len(places))


def kirchhoff(
    blades: tuple[np.ndarray, np.ndarray, np.ndarray],
    near: np.ndarray,
    far: np.ndarray,
    wavelength: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Weights of places on a surface in what it takes of a wave between two ends, over j, and how
    much longer the ways over them are [m]."""
    (spot, normal, area), span = blades, np.linalg.norm(far - near)
    r1, r2 = np.linalg.norm(spot - near, axis=1), np.linalg.norm(far - spot, axis=1)
    first = ((spot - near) * normal).sum(axis=1) / r1
    second = ((far - spot) * normal).sum(axis=1) / r2
    weight = np.sign(first) * (first + second) / 2 * span / (r1 * r2) * area / wavelength
    return weight, r1 + r2 - span


@case(
    "Kirchhoff's integral over the blades as a sum in float64",
    "1e-3 of the wave, of which they take up to 0.4",
    "integration by parts along the blade, which is cut after its first term",
)
def what_opaque_blades_take() -> Errors:
    """Opaque blades over and under the arrays, from all elevations, from near and far."""
    for height, distance in itertools.product((0.1, -0.1), (2.0, FAR)):
        rotors = OPAQUE.model_copy(update={"height_m": height})
        body = blades_of(rotors, Waveform(num_chirps=6), 1, "U")
        assert isinstance(body, Plates)
        k, times = body.wave_number, np.array([0.0, 0.0013, 0.0042])
        for elevation in np.radians((-60, -25, 0, 8, 25, 90)):
            far = distance * _towards(np.radians(80), elevation)
            found = squares_of(body, far, times)[0].sum(axis=1)
            for time, one in zip(times, found, strict=True):
                weight, longer = kirchhoff(surface(rotors, time), np.zeros(3), far, 2 * np.pi / k)
                yield abs(one - 1j * (weight * np.exp(-1j * k * longer)).sum())


def _towards(azimuth: float, elevation: float) -> np.ndarray:
    """Return the unit vector towards an azimuth from ahead to the right and an elevation [rad]."""
    level = np.cos(elevation)
    return np.array([level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation)])


@case(
    "means over all aspects printed in TR 38.901 v19, table 7.9.2.1-4 and -6: 11.25, -4.25 dBsm",
    "0.01 dB",
    "the means are printed to two digits",
)
def cross_section_of_a_vehicle_and_an_agv() -> Errors:
    """The largest lobe in each direction, averaged over the sphere."""
    mu, weight = np.polynomial.legendre.leggauss(400)
    phi = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    s = np.sqrt(1 - mu**2)[:, None]
    height = np.broadcast_to(mu[:, None], (400, 720))
    u = np.stack([s * np.cos(phi), s * np.sin(phi), height], axis=-1)
    for kind, printed in (("vehicle", 11.25), ("agv", -4.25)):
        lobes, constants = KINDS[kind].lobes, KINDS[kind].bistatic
        largest = np.max(
            [lobe_db(lobe, constants, u, np.zeros((400, 720))) for lobe in lobes], axis=0
        )
        yield abs(10 * np.log10((10 ** (largest / 10)).mean(axis=1) @ weight / 2) - printed)
