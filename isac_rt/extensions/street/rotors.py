r"""Blades of rotors as scattering centres: a thin wire as a sum of points that equals its integral.

A blade is a wire of uniform cross-section per length from the hub to the tip. Its amplitude
towards bistatic directions with the sum :math:`s = u_1 + u_2`, for a wave number k and the blade's
direction e, is the closed form (V. C. Chen, The Micro-Doppler Effect in Radar, chapter 3)

.. math:: \frac{\sqrt\sigma}{L}\int_0^L e^{jk r\,s\cdot e}dr = \sqrt\sigma\,\mathrm{sinc}(x/\pi)\,
   e^{jx}, \qquad x = \tfrac12 k L\,s\cdot e

A flash is broadside, x = 0, and has the cross-section sigma. The integral is summed by
Gauss-Legendre quadrature: with N points it leaves out at most
:math:`\sum_{n\ge 2N}(2n+1)|j_n(kL)|` of the flash, since the points integrate polynomials of
degrees below 2N exactly and the Legendre coefficients of :math:`e^{jax}` are
:math:`(2n+1)j^nj_n(a)`. About one point each quarter of a wavelength leaves 1e-5.

A metal edge seen across its length L has :math:`\sigma = L^2/\pi` (E. F. Knott, Radar Cross
Section, 2nd edition, section 6.3, the field along the edge); plastic with a permittivity of 3
reflects 11.4 dB less (Fresnel).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.special import spherical_jn

from isac_rt.extensions.street.motion import Motion
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.randomness import generator
from isac_rt.world.settings import Rotors

LEFT_OUT = 1e-5
"""Amplitude that the sum of points may miss of a flash."""
PLASTIC = ((np.sqrt(3.0) - 1) / (np.sqrt(3.0) + 1)) ** 2
"""Power that a plastic surface with a permittivity of 3 reflects."""


@dataclass(frozen=True)
class Blades:
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
        """Speed of the fastest point [m/s]."""
        return float(np.abs(self.radius * self.turning).max())

    @property
    def jerk(self) -> float:
        """Largest jerk of a point [m/s^3]."""
        return float(np.abs(self.radius * self.turning**3).max())

    def described(self) -> str:
        """Return the blades in words."""
        each = int((self.hub == self.hub[0]).all(axis=1).sum())
        ends = np.isclose(self.radius, self.radius.max()).sum()
        return f"{self.radius.size // each} rotors, {ends} blades as {self.radius.size} points"

    def amplitudes(self, incident: np.ndarray, observed: np.ndarray) -> np.ndarray:
        """(K,) square root of each point's cross-section [m]."""
        return self.amplitude

    def motion(self, time: np.ndarray) -> Motion:
        """Return the points' motion in the body's axes at times (T,) [s]."""
        angle = self.phase + self.turning * time[:, None]
        arm = np.zeros((*angle.shape, 3))
        arm[..., 0], arm[..., 1] = self.radius * np.sin(angle), self.radius * np.cos(angle)
        speed = np.zeros_like(arm)
        speed[..., 0], speed[..., 1] = self.turning * arm[..., 1], -self.turning * arm[..., 0]
        return Motion(self.hub + arm, speed, -(self.turning[:, None] ** 2) * arm)


def blades_of(rotors: Rotors, waveform: Waveform, seed: int, name: str) -> Blades:
    """Return the points of a UAV's rotors, with phases at time 0 drawn by the UAV's name."""
    r = rotors
    highest = waveform.carrier_frequency + waveform.bandwidth
    length, weight = blade_points(r.blade_length_m, 2 * np.pi * highest / SPEED_OF_LIGHT)
    rotor = np.arange(r.number)
    where = (rotor + 0.5) * 2 * np.pi / r.number
    arm = r.arm_m if r.number > 1 else 0.0
    hub = arm * np.stack([np.sin(where), np.cos(where), np.zeros(r.number)], axis=1)
    start = generator(seed, "rotors", name).uniform(0, 2 * np.pi, r.number)
    phase = start[:, None] + np.arange(r.blades) * 2 * np.pi / r.blades
    turning = (-1.0) ** rotor * 2 * np.pi * r.rev_per_min / 60
    shape = (r.number, r.blades, length.size)
    return Blades(
        np.broadcast_to(hub[:, None, None], (*shape, 3)).reshape(-1, 3),
        np.broadcast_to(length, shape).ravel(),
        np.broadcast_to(phase[:, :, None], shape).ravel(),
        np.broadcast_to(turning[:, None, None], shape).ravel(),
        np.broadcast_to(np.sqrt(blade_section(r)) * weight, shape).ravel(),
    )


def blade_section(rotors: Rotors) -> float:
    """Return the cross-section of a blade at its flash [m^2]."""
    if rotors.blade_dbsm is not None:
        return 10 ** (rotors.blade_dbsm / 10)
    return float(PLASTIC * rotors.blade_length_m**2 / np.pi)


def blade_points(length: float, wave_number: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places on a blade (N,) [m from the hub] and their shares of its amplitude, fit for
    wave numbers up to `wave_number` [rad/m]."""
    count = num_points(wave_number * length)
    place, weight = np.polynomial.legendre.leggauss(count)
    return length * (1 + place) / 2, weight / 2


def num_points(argument: float) -> int:
    """Return the number of Gauss-Legendre points whose error bound is `LEFT_OUT` for
    exp(j a x), |a| up to `argument`."""
    orders = np.arange(int(1.1 * argument) + 60)
    terms = (2 * orders + 1) * np.abs(spherical_jn(orders, argument))
    beyond = np.cumsum(terms[::-1])[::-1]  # from each order on
    return int(np.flatnonzero(beyond <= LEFT_OUT)[0] + 1) // 2
