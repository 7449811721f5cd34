r"""Specific attenuation of air [1]_ and of rain [2]_.

Gas: the sum over 44 lines of oxygen and 35 of water vapour (strength times shape, with its width
and interference) and the continuum of dry air. Rain of R mm/h: gamma = k R^alpha.

References
----------
.. [1] ITU-R P.676-13, "Attenuation by atmospheric gases and related effects", annex 1, 1 to 1000
   GHz; the files lines_*.csv are its tables 1 and 2.
.. [2] ITU-R P.838-3, "Specific attenuation model for rain for use in prediction methods", 1 to 1000
   GHz; rain_p838.csv holds the Gaussians of its tables 1
   to 4, (a, b, c) over log10 of the frequency [GHz].
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import numpy as np

ZERO_CELSIUS = 273.15
"""[K]"""
VAPOUR_CONSTANT = 216.7
"""Density of water vapour times temperature over its pressure [g K / (m^3 hPa)], P.676 eq. 4."""
_LINES = {
    "k_h": (-0.18961, 0.71147),
    "k_v": (-0.16398, 0.63297),
    "alpha_h": (0.67849, -1.95537),
    "alpha_v": (-0.053739, 0.83433),
}
"""P.838: slope m and offset c of the straight line under the Gaussians."""


def vapour_pressure(density: float, kelvin: float) -> float:
    """Return the pressure of water vapour [hPa] of a density [g/m^3]."""
    return density * kelvin / VAPOUR_CONSTANT


@cache
def _table(name: str) -> np.ndarray:
    """Return a table of this folder, with its columns by name."""
    lines = files(__package__).joinpath(f"{name}.csv").read_text().splitlines()
    return np.genfromtxt(lines, delimiter=",", names=True, dtype=None, encoding="utf-8")


def _columns(name: str) -> tuple[np.ndarray, ...]:
    table = _table(name)
    return tuple(table[column].astype(float) for column in table.dtype.names or ())


def gas_db_per_km(frequency: float, kelvin: float, dry: float, vapour: float) -> float:
    """Return the specific attenuation of air [dB/km].

    Parameters
    ----------
    frequency : [Hz]
    dry, vapour : pressures of dry air and of water vapour [hPa]
    """
    f, p, e, theta = frequency / 1e9, dry, vapour, 300 / kelvin
    line, a1, a2, a3, a4, a5, a6 = _columns("lines_oxygen")
    strength = 1e-7 * a1 * p * theta**3 * np.exp(a2 * (1 - theta))
    width = 1e-4 * a3 * (p * theta ** (0.8 - a4) + 1.1 * e * theta)
    width = np.sqrt(width**2 + 2.25e-6)  # Zeeman splitting
    interference = 1e-4 * (a5 + a6 * theta) * (p + e) * theta**0.8
    total = (strength * _shape(f, line, width, interference)).sum()
    line, b1, b2, b3, b4, b5, b6 = _columns("lines_water_vapour")
    strength = 0.1 * b1 * e * theta**3.5 * np.exp(b2 * (1 - theta))
    width = 1e-4 * b3 * (p * theta**b4 + b5 * e * theta**b6)
    width = 0.535 * width + np.sqrt(0.217 * width**2 + 2.1316e-12 * line**2 / theta)  # Doppler
    total += (strength * _shape(f, line, width, 0.0)).sum()
    debye = 5.6e-4 * (p + e) * theta**0.8
    continuum = 6.14e-5 / (debye * (1 + (f / debye) ** 2))
    continuum += 1.4e-12 * p * theta**1.5 / (1 + 1.9e-5 * f**1.5)
    return float(0.1820 * f * (total + f * p * theta**2 * continuum))


def _shape(
    f: float, line: np.ndarray, width: np.ndarray, interference: np.ndarray | float
) -> np.ndarray:
    """Return the shape factors of lines at a frequency, all in GHz (P.676 eq. 5)."""
    near, far = line - f, line + f
    below = (width - interference * near) / (near**2 + width**2)
    above = (width - interference * far) / (far**2 + width**2)
    return np.asarray(f / line * (below + above))


def rain_coefficients(
    frequency: float, elevation: np.ndarray | float, tilt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return k and alpha of P.838.

    Parameters
    ----------
    frequency : [Hz]
    elevation : of the path [rad]
    tilt : of the polarisation against the horizontal [rad]; pi/2: vertical
    """
    log, gaussians, value = np.log10(frequency / 1e9), _table("rain_p838"), {}
    for name, (slope, offset) in _LINES.items():
        a, b, c = (gaussians[gaussians["of"] == name][key] for key in "abc")
        value[name] = (a * np.exp(-(((log - b) / c) ** 2))).sum() + slope * log + offset
    k_h, k_v = 10 ** value["k_h"], 10 ** value["k_v"]
    turned = np.cos(elevation) ** 2 * np.cos(2 * tilt)
    k = (k_h + k_v + (k_h - k_v) * turned) / 2
    h, v = k_h * value["alpha_h"], k_v * value["alpha_v"]
    return np.asarray(k), np.asarray((h + v + (h - v) * turned) / (2 * k))
