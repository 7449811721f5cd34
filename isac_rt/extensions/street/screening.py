r"""Opaque blades before a terminal's arrays: what they take from the waves that pass.

The field behind thin opaque screens S is Kirchhoff's (M. Born and E. Wolf, *Principles of Optics*,
section 8.3). Of a wave between the arrays and its other end, R away, they take the part

.. math:: \frac j\lambda\int_S \frac{\cos\theta_1 + \cos\theta_2}2\,\frac R{r_1 r_2}\,
   e^{-jk(r_1 + r_2 - R)}\,dS

with :math:`r_{1,2}` from a point of a blade to both ends and :math:`\theta_{1,2}` between these
ways and the normal. Across the chord the integral is a Gauss-Legendre sum. On each of its lines
along the blade :math:`r_1 + r_2` has one minimum, from which u counts in Fresnel units:
:math:`u^2 = 4(r_1 + r_2 - \min)/\lambda`. With G(u) what stands before the exponential in du,

.. math:: \int G\,e^{-j\pi u^2/2}\,du \approx G(0)\big(C(u) - jS(u)\big)
   + \frac{G(u) - G(0)}{-j\pi u}\,e^{-j\pi u^2/2}

with Fresnel's integrals C and S: integration by parts, uniform in u (N. Bleistein and
R. Handelsman, *Asymptotic Expansions of Integrals*, chapter 9). Each square of a blade is a wave of
its own over its middle: antennas beside the arrays' middle and times within a slot see it there.
"""

from __future__ import annotations

import numpy as np
from scipy.special import fresnel

from isac_rt.extensions.street.motion import Motion
from isac_rt.extensions.street.rotors import Plates, num_points

FAR = 1e6
"""Distance [m] that stands for infinity: 1e-4 rad over a blade."""
TINY = 1e-12
"""Distance [m] from a minimum within which a blade ends on it, and least square of one [m^2]."""


def squares_of(blades: Plates, far: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, Motion]:
    """Return what squares of blades take of a wave between the arrays and a place (3,) in the
    body's axes, at times (T,) [s]: parts (T, K) of its amplitude, and the squares' motion."""
    chord, length = blades.rotors.chord_m or 0.0, blades.rotors.blade_length_m
    edges = np.linspace(0, length, int(np.ceil(length / chord)) + 1)
    blade, across, normal = blades.axes(blades.start + blades.spin * time[:, None])
    k, radius = blades.wave_number, np.linalg.norm(far)
    node, weight = np.polynomial.legendre.leggauss(num_points(k * chord))
    start = blades.hubs[:, None] + chord / 2 * node[:, None] * across[:, :, None]
    away = np.stack([-start, far - start])  # (2, T, N, M, 3)
    height = np.vecdot(away, normal[:, :, None])[..., None]
    foot = np.vecdot(away, blade[:, :, None])[..., None]
    off = np.sqrt(np.maximum(np.vecdot(away, away)[..., None] - foot**2, TINY))

    def amplitude(ways: np.ndarray) -> np.ndarray:
        """Return what places on the lines send on, per length, with `ways` to both ends."""
        cosines = np.abs(height[0]) / ways[0] - np.sign(height[0]) * height[1] / ways[1]
        return cosines / 2 * radius / ways.prod(axis=0)

    least = (foot * off[::-1]).sum(axis=0) / off.sum(axis=0)
    shortest, ways = (np.hypot(off, place - foot) for place in (least, edges))
    inner = amplitude(shortest) * np.sqrt(np.pi / k / (off**2 / shortest**3).sum(axis=0))
    # the difference of both lengths without cancellation
    detour = ((edges - least) * (edges + least - 2 * foot) / (ways + shortest)).sum(axis=0)
    u = np.copysign(np.sqrt(2 * k / np.pi * np.maximum(detour, TINY)), edges - least)
    slope = np.where(detour > TINY, ((edges - foot) / ways).sum(axis=0), 1)
    outer = np.where(detour > TINY, amplitude(ways) * np.pi * u / (k * slope), inner)
    sine, cosine = fresnel(u)
    edge = (outer - inner) / (-1j * np.pi * u) * np.exp(-0.5j * np.pi * u * u)
    along = np.diff(inner * (cosine - 1j * sine) + edge)
    along *= np.exp(-1j * k * (shortest.sum(axis=0) - radius))
    share = 1j * k / (2 * np.pi) * (chord / 2 * weight[:, None] * along).sum(axis=2)
    arm = ((edges[1:] + edges[:-1]) / 2)[:, None] * blade[:, :, None]
    speed = blades.spin[:, None, None] * np.cross(arm, [0.0, 0.0, 1.0])
    squares = blades.hubs[:, None] + arm, speed, -(blades.spin[:, None, None] ** 2) * arm
    return share.reshape(time.size, -1), Motion(*(s.reshape(time.size, -1, 3) for s in squares))
