"""Truths in long double and closed form. Nothing here is taken from the modules that are validated,
not even constants."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import dblquad

LIGHT = np.longdouble(299_792_458)
CARRIER = 77e9
WAVELENGTH = 299_792_458.0 / CARRIER
EPSILON_0 = 8.8541878128e-12
Triple = Sequence[float] | np.ndarray
Plane = tuple[Triple, Triple]
"""Normal (any length) and a point."""


def norm(v: np.ndarray) -> np.longdouble:
    """Length of a vector."""
    return np.sqrt((v * v).sum())


def wide(v: Triple) -> np.ndarray:
    """In long double."""
    return np.array(v, np.longdouble)


def flown(place: Triple, velocity: Triple, acceleration: Triple, t: np.longdouble) -> np.ndarray:
    """Where a body in curved flight is, long double."""
    return wide(place) + t * wide(velocity) + t * t / 2 * wide(acceleration)


def mirrored(planes: Sequence[Plane], start: np.ndarray) -> np.ndarray:
    """Image of a point behind a chain of planes, by Householder matrices."""
    image = wide(start)
    for normal, point in planes:
        n = wide(normal)
        n = n / norm(n)
        image = (np.eye(3, dtype=np.longdouble) - 2 * np.outer(n, n)) @ (
            image - wide(point)
        ) + wide(point)
    return image


def chain_length(planes: Sequence[Plane], start: np.ndarray, end: np.ndarray) -> np.longdouble:
    """Length of the path over mirrors, the straight distance from the image to the end [m]."""
    return norm(wide(end) - mirrored(planes, start))


def derivatives(length: Callable[[np.longdouble], np.longdouble]) -> tuple[float, float]:
    """First and second derivative at 0 by central differences of fourth order over 1 ms."""
    h = np.longdouble("1e-3")
    f = {k: length(k * h) for k in (-2, -1, 0, 1, 2)}
    first = (8 * (f[1] - f[-1]) - (f[2] - f[-2])) / (12 * h)
    second = (16 * (f[1] + f[-1]) - (f[2] + f[-2]) - 30 * f[0]) / (12 * h * h)
    return float(first), float(second)


def slab_reflection(
    permittivity: float, conductivity: float, thickness: float, cosine: float
) -> tuple[complex, complex]:
    """Reflection (TE, TM) of a slab by adding up its inner echoes from Fresnel's equations; TM as
    the electric field in its plane."""
    eta = permittivity - 1j * conductivity / (2 * np.pi * CARRIER * EPSILON_0)
    inside = np.sqrt(1 - (1 - cosine**2) / eta)  # cosine of the refracted angle
    n, turn = np.sqrt(eta), np.exp(-2j * np.pi * thickness / WAVELENGTH * np.sqrt(eta) * inside)
    out = []
    for first in (
        (cosine - n * inside) / (cosine + n * inside),
        (n * cosine - inside) / (n * cosine + inside),
    ):
        total, echo = first, (1 - first**2) * -first * turn**2
        for _ in range(400):
            total, echo = total + echo, echo * first**2 * turn**2
        out.append(complex(total))
    return out[0], out[1]


def lambertian_wall(
    a: np.ndarray, p: np.ndarray, coefficient: float, y: float, half: tuple[float, float]
) -> float:
    """Power from a to p, isotropic ends, over a perfectly reflecting Lambertian wall |x| < half[0],
    |z| < half[1] at y."""

    def density(z: float, x: float) -> float:
        r = np.array([x, y, z])
        r1, r2 = np.linalg.norm(r - a), np.linalg.norm(r - p)
        return (y - a[1]) / r1 * (y - p[1]) / r2 / np.pi / (r1 * r2) ** 2

    total, _ = dblquad(density, -half[0], half[0], -half[1], half[1], epsrel=1e-8)
    return float(coefficient**2 * (WAVELENGTH / (4 * np.pi)) ** 2 * total)


class Chirps:
    """Times of a frame in long double, from the five numbers of the waveform."""

    def __init__(self, w) -> None:
        ld = np.longdouble
        self.carrier, self.rate = ld(w.carrier_frequency), ld(w.sampling_rate)
        window = ld(w.num_samples) / self.rate
        self.longest = self.rate * window / (ld(w.bandwidth) - 2 * self.rate)
        chirp = window + 2 * self.longest
        self.slope = ld(w.bandwidth) / chirp
        self.slot = chirp + 2 * w.num_tx * self.longest
        self.frame = w.num_chirps * self.slot
        self.fast = np.arange(w.num_samples).astype(ld) / self.rate + 2 * self.longest
        self.step = 1 / (self.slope * window)

    def beat(self, tau: np.ndarray) -> np.ndarray:
        """exp(j phase) of the reference chirp times the conjugate of the one that comes tau later,
        by subtracting their phases."""

        def oscillator(since: np.ndarray) -> np.ndarray:
            return self.carrier * since + self.slope * since * since / 2

        turn = oscillator(self.fast) - oscillator(self.fast - tau)
        return np.exp(2j * np.pi * (turn - np.floor(turn)).astype(float))


def if_samples(
    w, schedule, payload, length: Callable, gain: complex, send: np.ndarray, hear: np.ndarray
) -> np.ndarray:
    """IF samples (M, L_rx, P, N) of one path by mixing chirps in long double, as if no filter were
    there.

    Parameters
    ----------
    length : of the way [m] from a transmit element to a receive element as a function of (time
        since mid-frame, element, element)
    gain : complex, constant over the frame
    send, hear : element positions that `length` is called with
    """
    c = Chirps(w)
    out = np.zeros((len(schedule), len(hear), w.num_chirps, w.num_samples), np.complex128)
    for m, r, p in np.ndindex(*out.shape[:3]):
        t = c.fast + p * c.slot + 2 * m * c.longest - c.frame / 2
        tau = (
            length(t, send[schedule[m, p]], hear[r]) / LIGHT
            + int(payload.delay_symbols[m, p]) * c.step
        )
        out[m, r, p] = np.conj(gain * np.conj(payload.phases[m, p])) * c.beat(tau)
    return out
