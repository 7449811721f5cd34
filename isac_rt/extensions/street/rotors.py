r"""Blades of rotors as scattering centres: sums of points that equal the integral over the blade.

A blade is a thin wire or, with a chord, a flat plate (docs/moving.md has formulas and sources). The
integral along it is summed by Gauss-Legendre quadrature: with N points it leaves out at most
:math:`\sum_{n\ge 2N}(2n+1)|j_n(kL)|` of a flash, since the points integrate polynomials of degrees
below 2N exactly and the Legendre coefficients of :math:`e^{jax}` are :math:`(2n+1)j^nj_n(a)`. About
one point each quarter of a wavelength leaves 1e-5.

The obliquity of a plate with the normal n is the mean of :math:`|n\cdot u_1|` of a field across the
plane of incidence and of :math:`|n\cdot u_2|` of one in it; from one place both are the same. The
chord has a few points with exact delays. Near the direction in the middle of a piece, seen from the
chord's middle, their amplitudes give the integral over the chord: its phase is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.interpolate import BarycentricInterpolator, CubicSpline
from scipy.special import spherical_jn

from isac_rt.extensions.street.motion import PHASE_ERROR, CentreModel, Motion
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.randomness import generator
from isac_rt.world.settings import Rotors

LEFT_OUT = 1e-5
"""Amplitude that the sum of points may miss of a flash."""
CHORD_LEFT_OUT = 1e-3
"""Amplitude that the points of a chord may miss, a tenth of what pieces miss of the obliquity."""
ANGLES = 8
"""Angles of a blade in each lobe of its pattern at which mean powers are summed."""
Y_STEPS = 16
"""Samples of a chord's pattern in a radian of y, between which it is cubic to 1e-6."""
PLASTIC = ((np.sqrt(3.0) - 1) / (np.sqrt(3.0) + 1)) ** 2
"""Power that a plastic surface with a permittivity of 3 reflects."""


@dataclass(frozen=True)
class Blades(CentreModel):
    """Points on the blades of a UAV's rotors.

    Attributes
    ----------
    hub : (K, 3) each point's hub [m, body axes]
    radius : (K,) distance from the hub [m]
    phase : (K,) angle from ahead to the right at time 0 [rad]
    turning : (K,) angular velocity [rad/s]
    amplitude : (K,) square root of the cross-section [m]
    """

    hub: np.ndarray
    radius: np.ndarray
    phase: np.ndarray
    turning: np.ndarray
    amplitude: np.ndarray

    replaces_echo: ClassVar[bool] = False

    @property
    def speed(self) -> float:
        return float(np.abs(self.radius * self.turning).max())

    @property
    def jerk(self) -> float:
        return float(np.abs(self.radius * self.turning**3).max())

    def described(self) -> str:
        ends = np.isclose(self.radius, self.radius.max()).sum()
        return f"{ends} blades as {self.radius.size} points"

    def motion(self, time: np.ndarray) -> Motion:
        angle = self.phase + self.turning * time[:, None]
        arm = np.zeros((*angle.shape, 3))
        arm[..., 0], arm[..., 1] = self.radius * np.sin(angle), self.radius * np.cos(angle)
        speed = np.zeros_like(arm)
        speed[..., 0], speed[..., 1] = self.turning * arm[..., 1], -self.turning * arm[..., 0]
        return Motion(self.hub + arm, speed, -(self.turning[:, None] ** 2) * arm)


@dataclass(frozen=True)
class Plates(Blades):
    """Points on flat blades: several along each blade for each of its chord.

    Attributes
    ----------
    rotors : size and incidence of the blades
    wave_number : in the middle of the band [rad/m]
    nodes : (M,) places on the chord over half its length
    start, spin, lead : (N,) of each blade: angle at time 0 [rad], angular velocity [rad/s], and
        which way its leading edge points, 1: to the right of a blade that points ahead
    """

    rotors: Rotors
    wave_number: float
    nodes: np.ndarray
    start: np.ndarray
    spin: np.ndarray
    lead: np.ndarray

    @property
    def hubs(self) -> np.ndarray:
        """(N, 3) of each blade [m, body axes]."""
        return self.hub.reshape(self.start.size, -1, 3).mean(axis=1)

    @property
    def fading(self) -> float:
        return float(np.abs(self.spin * np.sin(np.radians(self.rotors.incidence_deg))).max())

    def described(self) -> str:
        return f"{self.start.size} flat blades as {self.radius.size} points"

    def amplitudes(
        self, incident: np.ndarray, observed: np.ndarray, time: np.ndarray
    ) -> np.ndarray:
        shape = time.size, self.start.size, self.nodes.size, -1, 3
        ends = (np.broadcast_to(u, (time.size, *self.hub.shape)) for u in (incident, observed))
        middle = (u.reshape(shape)[:, :, self.nodes.size // 2] for u in ends)
        obliquity, _, y = self._aspect(self.start + self.spin * time[:, None], *middle)
        most = float(np.abs(y).max()) + 1
        place, weight = np.polynomial.legendre.leggauss(num_points(most))
        # Lagrange's polynomials of the nodes at the places
        share = weight / 2 * BarycentricInterpolator(self.nodes, np.eye(self.nodes.size))(place).T
        at = np.linspace(-most, most, int(2 * most * Y_STEPS) + 2)[:, None]
        chord = np.exp(1j * at * place) @ share.T * np.exp(-1j * at * self.nodes)
        chord = CubicSpline(at[:, 0], chord)(y) * obliquity[..., None]
        return np.asarray(self.amplitude * np.moveaxis(chord, 3, 2).reshape(time.size, -1))

    def square_metres(self, incident: np.ndarray, observed: np.ndarray) -> float:
        lobes = int(4 * self.wave_number * self.rotors.blade_length_m / np.pi) + 1
        angle = np.linspace(0, 2 * np.pi, ANGLES * lobes, endpoint=False)
        obliquity, x, y = self._aspect(angle[:, None] + 0 * self.lead, incident, observed)
        pattern = (obliquity * np.sinc(x / np.pi) * np.sinc(y / np.pi)) ** 2
        return float(blade_section(self.rotors, self.wave_number) * pattern.mean(axis=0).sum())

    def _aspect(
        self, angle: np.ndarray, incident: np.ndarray, observed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return obliquity, x and y (..., N, A) of blades at angles (..., N), towards ends
        (..., N, A, 3), or (3,) and A = 1."""
        blade, chord, normal = (v[..., None, :] for v in self.axes(angle))
        obliquity = sum(np.abs(np.vecdot(normal, end)) for end in (incident, observed)) / 2
        x, y = (np.vecdot(v, incident + observed) for v in (blade, chord))
        x, y = x * self.rotors.blade_length_m, y * (self.rotors.chord_m or 0.0)
        return obliquity, self.wave_number / 2 * x, self.wave_number / 2 * y

    def axes(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return unit vectors (..., N, 3) along blades at angles (..., N), from their trailing to
        their leading edges, and across both."""
        sine, cosine = np.sin(angle), np.cos(angle)
        flat, tilt = np.zeros_like(angle), np.radians(self.rotors.incidence_deg)
        blade = np.stack([sine, cosine, flat], axis=-1)
        ahead = np.stack([self.lead * cosine, -self.lead * sine, flat], axis=-1)
        chord = np.cos(tilt) * ahead + np.sin(tilt) * np.array([0.0, 0.0, 1.0])
        return blade, chord, np.cross(blade, chord)


def blades_of(rotors: Rotors, waveform: Waveform, seed: int, name: str) -> Blades:
    """Return the points of a UAV's rotors, their phases at time 0 stated or drawn by its name."""
    r, w = rotors, waveform
    highest = 2 * np.pi * (w.carrier_frequency + w.bandwidth) / SPEED_OF_LIGHT
    middle = 2 * np.pi * (w.carrier_frequency + w.bandwidth / 2) / SPEED_OF_LIGHT
    length, weight = blade_points(r.blade_length_m, highest)
    nodes, tilt = chord_nodes(r, w), np.radians(r.incidence_deg)
    where = (np.arange(r.number) + 0.5) * 2 * np.pi / r.number
    arm = r.arm_m if r.number > 1 else 0.0
    hub = arm * np.stack([np.sin(where), np.cos(where), np.zeros(r.number)], axis=1)
    begin = generator(seed, "rotors", name).uniform(0, 2 * np.pi, r.number)
    if r.phase_deg is not None:
        begin = np.radians(r.phase_deg)
    start = begin[:, None] + np.arange(r.blades) * 2 * np.pi / r.blades
    spin = 2 * np.pi * np.array(r.speeds) / 60
    lead = np.copysign(1.0, spin)
    shape = (r.number, r.blades, nodes.size, length.size)
    off = (r.chord_m or 0.0) / 2 * nodes[:, None]
    side = lead[:, None, None, None] * np.cos(tilt) * off  # ahead of the blade's axis
    place = np.broadcast_to(hub[:, None, None, None], (*shape, 3)).copy()
    place[..., 2] += r.height_m + np.sin(tilt) * off
    section = blade_section(r, middle)
    numbers = (
        place.reshape(-1, 3),
        np.broadcast_to(np.hypot(length, side), shape).ravel(),
        (start[..., None, None] + np.arctan2(side, length)).ravel(),
        np.broadcast_to(spin[:, None, None, None], shape).ravel(),
        np.broadcast_to(np.sqrt(section) * weight, shape).ravel(),
    )
    if r.chord_m is None:
        return Blades(*numbers)
    of_blades = (np.broadcast_to(v[:, None], start.shape).ravel() for v in (spin, lead))
    return Plates(*numbers, r, middle, nodes, start.ravel(), *of_blades)


def points_of(rotors: Rotors, waveform: Waveform) -> int:
    """Return the number of points of a UAV's blades, of which a path has one copy in each slot."""
    return blades_of(rotors, waveform, 0, "").radius.size


def chord_nodes(rotors: Rotors, waveform: Waveform) -> np.ndarray:
    """Return the points of a chord, as parts of half its length; of a wire the one in its middle.

    Within a piece a blade turns by half a slot, or by as much as keeps `PHASE_ERROR` along it; that
    and the band are what the phase on the chord changes by.
    """
    r, w = rotors, waveform
    if r.chord_m is None:
        return np.zeros(1)
    k = 2 * np.pi * (w.carrier_frequency + w.bandwidth) / SPEED_OF_LIGHT
    turn = max(
        r.tip_speed / r.blade_length_m / 2 * w.slot_duration,
        (3 * PHASE_ERROR / (k * r.blade_length_m)) ** (1 / 3),
    )
    beyond = k * r.chord_m * (turn + w.bandwidth / (2 * w.carrier_frequency))
    return np.asarray(np.polynomial.legendre.leggauss(degree(beyond, CHORD_LEFT_OUT))[0])


def blade_section(rotors: Rotors, wave_number: float = 0.0) -> float:
    """Return the cross-section of a blade at its flash, of a flat one along its normal, at a wave
    number [rad/m] [m^2]."""
    r = rotors
    if r.blade_dbsm is not None:
        return 10 ** (r.blade_dbsm / 10)
    if r.chord_m is None:
        return float(PLASTIC * r.blade_length_m**2 / np.pi)
    return float(PLASTIC * (wave_number * r.blade_length_m * r.chord_m) ** 2 / np.pi)


def blade_points(length: float, wave_number: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places on a blade (N,) [m from the hub] and their shares of its amplitude, fit for
    wave numbers up to `wave_number` [rad/m]."""
    count = num_points(wave_number * length)
    place, weight = np.polynomial.legendre.leggauss(count)
    return length * (1 + place) / 2, weight / 2


def num_points(argument: float) -> int:
    """Return the number of Gauss-Legendre points whose error bound is `LEFT_OUT` for
    exp(j a x), |a| up to `argument`."""
    return (degree(argument, LEFT_OUT) + 1) // 2


def degree(argument: float, left_out: float) -> int:
    """Return from which degree on the Legendre coefficients of exp(j a x), |a| up to `argument`,
    add up to `left_out` at most."""
    orders = np.arange(int(1.1 * argument) + 60)
    terms = (2 * orders + 1) * np.abs(spherical_jn(orders, argument))
    beyond = np.cumsum(terms[::-1])[::-1]  # from each order on
    return int(np.flatnonzero(beyond <= left_out)[0])
