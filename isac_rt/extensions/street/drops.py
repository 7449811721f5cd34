r"""Raindrops: how many there are of each size, how fast they fall, and what they scatter.

Diameters D follow Marshall and Palmer [1]_, :math:`N(D) \propto e^{-\Lambda D}` with Lambda = 4.1
R^-0.21 per mm, scaled so that drops which fall at Atlas' speed [2]_, 9.65 - 10.3 exp(-0.6 D) m/s,
carry the stated rain rate R [mm/h]. Each is a sphere of water (permittivity of ITU-R P.840), whose
scattering is Mie's series [3]_: at 77 GHz a drop of 1.2 mm is a wavelength round.

References
----------
.. [1] J. Marshall and W. Palmer, "The distribution of raindrops with size", J. Meteorology 5, 1948.
.. [2] D. Atlas, R. Srivastava and R. Sekhon, "Doppler radar characteristics of precipitation at
   vertical incidence", Rev. Geophysics 11, 1973.
.. [3] C. Bohren and D. Huffman, "Absorption and scattering of light by small particles", 1983,
   chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import spherical_jn, spherical_yn

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.segments.reflection import vertical

DIAMETERS_MM = np.arange(0.025, 8.0, 0.05)
"""Middles of the classes of diameter; no larger drop holds together."""
ANGLES = 181
"""Scattering angles of the tables, from 0 to pi."""


def permittivity(frequency: float, kelvin: float) -> complex:
    """Return the relative permittivity of water, positive imaginary part for losses (ITU-R P.840:
    two Debye relaxations)."""
    f, excess = frequency / 1e9, 300 / kelvin - 1
    static = 77.66 + 103.3 * excess
    middle, optical = 0.0671 * static, 3.52
    first = 20.20 - 146 * excess + 316 * excess**2
    second = 39.8 * first
    main = (static - middle) / (1 - 1j * f / first)
    return main + (middle - optical) / (1 - 1j * f / second) + optical


def fall_speed(diameter_mm: np.ndarray) -> np.ndarray:
    """Return the speed at which drops fall in still air [m/s]."""
    return np.maximum(9.65 - 10.3 * np.exp(-0.6 * diameter_mm), 0.0)


def mie_coefficients(size: float, index: complex) -> tuple[np.ndarray, np.ndarray]:
    """Return a_n and b_n, n = 1, 2, ..., of a sphere.

    Parameters
    ----------
    size : circumference over wavelength
    index : complex refractive index
    """
    n = np.arange(1, int(size + 4 * size ** (1 / 3) + 2) + 1)
    inner = index * size
    # Riccati-Bessel functions and their derivatives, outside and inside
    psi, psi_slope = _riccati(spherical_jn(n, size), spherical_jn(n, size, True), size)
    chi, chi_slope = _riccati(spherical_yn(n, size), spherical_yn(n, size, True), size)
    own, own_slope = _riccati(spherical_jn(n, inner), spherical_jn(n, inner, True), inner)
    xi, xi_slope = psi + 1j * chi, psi_slope + 1j * chi_slope
    a = (index * own * psi_slope - psi * own_slope) / (index * own * xi_slope - xi * own_slope)
    b = (own * psi_slope - index * psi * own_slope) / (own * xi_slope - index * xi * own_slope)
    return a, b


def _riccati(
    value: np.ndarray, slope: np.ndarray, argument: complex
) -> tuple[np.ndarray, np.ndarray]:
    """Return z f(z) and its derivative."""
    return argument * value, value + argument * slope


def mie_amplitudes(a: np.ndarray, b: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """Return S_1 (across the scattering plane) and S_2 (in it), (2, T), at cosines (T,) of the
    scattering angle."""
    before, pi = np.zeros_like(cosines), np.ones_like(cosines)
    out = np.zeros((2, cosines.size), complex)
    for n, (electric, magnetic) in enumerate(zip(a, b, strict=True), start=1):
        tau = n * cosines * pi - (n + 1) * before
        share = (2 * n + 1) / (n * (n + 1))
        out[0] += share * (electric * pi + magnetic * tau)
        out[1] += share * (electric * tau + magnetic * pi)
        before, pi = pi, ((2 * n + 1) * cosines * pi - (n + 1) * before) / n
    return out


@dataclass(frozen=True)
class Drops:
    """Drops of one rain at one frequency.

    Attributes
    ----------
    rain : rate [mm/h]
    frequency : [Hz]
    kelvin : temperature of the water
    """

    rain: float
    frequency: float
    kelvin: float

    @cached_property
    def density(self) -> np.ndarray:
        """(D,) drops of each class in a cubic metre."""
        shape = np.exp(-4.1 * self.rain**-0.21 * DIAMETERS_MM)
        volume = np.pi / 6 * (DIAMETERS_MM * 1e-3) ** 3
        carried = (shape * volume * fall_speed(DIAMETERS_MM)).sum() * 3.6e6  # [mm/h]
        return np.asarray(shape * self.rain / carried)

    @cached_property
    def _series(self) -> list[tuple[np.ndarray, np.ndarray]]:
        index = complex(np.sqrt(permittivity(self.frequency, self.kelvin)))
        sizes = self._wave_number * DIAMETERS_MM * 0.5e-3
        return [mie_coefficients(size, index) for size in sizes]

    @property
    def _wave_number(self) -> float:
        return 2 * np.pi * self.frequency / SPEED_OF_LIGHT

    @cached_property
    def amplitudes(self) -> np.ndarray:
        """(2, D, T) S_1 and S_2 at scattering angles from 0 to pi."""
        cosines = np.cos(np.linspace(0, np.pi, ANGLES))
        return np.stack([mie_amplitudes(a, b, cosines) for a, b in self._series], axis=1)

    @cached_property
    def scattered(self) -> np.ndarray:
        """(D,) total scattering cross-section of a drop of each class [m^2]."""
        powers = [
            ((2 * np.arange(1, a.size + 1) + 1) * (abs(a) ** 2 + abs(b) ** 2)).sum()
            for a, b in self._series
        ]
        return 2 * np.pi / self._wave_number**2 * np.array(powers)

    @cached_property
    def backscatter(self) -> np.ndarray:
        """(D,) radar cross-section of a drop of each class [m^2]."""
        return np.asarray(4 * np.pi / self._wave_number**2 * abs(self.amplitudes[0, :, -1]) ** 2)

    def cross_sections(
        self, classes: np.ndarray, along: np.ndarray, onward: np.ndarray
    ) -> np.ndarray:
        """Return the bistatic radar cross-sections (K,) [m^2] of drops, vertical polarisation sent
        and received.

        Parameters
        ----------
        classes : (K,) of diameter
        along, onward : (K, 3) unit vectors of the wave's direction before and after
        """
        cosine = np.clip((along * onward).sum(1), -1.0, 1.0)
        angle = np.rint(np.arccos(cosine) / np.pi * (ANGLES - 1)).astype(int)
        sent, received = vertical(along), vertical(onward)
        normal = np.cross(along, onward)
        size = np.linalg.norm(normal, axis=1, keepdims=True)
        # straight back and straight on every plane is the scattering plane
        normal = np.where(size > 1e-6, normal / np.maximum(size, 1e-6), sent)
        across = (sent * normal).sum(1) * (received * normal).sum(1)
        within = (sent * np.cross(normal, along)).sum(1)
        within *= (received * np.cross(normal, onward)).sum(1)
        s_1, s_2 = self.amplitudes[:, classes, angle]
        field = s_1 * across + s_2 * within
        return np.asarray(4 * np.pi / self._wave_number**2 * np.abs(field) ** 2)
