r"""Errors of the elements of an array: gain, phase, delay, place, pattern, coupling, drift.

Of a plane wave from (to) the body direction u, element r has the delay :math:`-r\cdot u/c` and
here :math:`\delta_r - d_r\cdot u/c` more: a wrong line and a wrong place. These act on the whole
chirp. All else is one complex factor of a path and element, taken at the middle of the chirp and of
the frame:

.. math::

    g_r e^{\dot g_r t} \sqrt{\frac{G(R_r u)}{G(u)}}\,
    \frac{\sum_{r'} C^*_{rr'} a_{r'}(u)}{a_r(u)}, \qquad a_r(u) = e^{-j2\pi f r\cdot u/c}

with R_r the turn of its pattern G and C the coupling of the waves, of which the IF holds the
conjugate. Left out: that coupling changes over the sweep (0.01 rad between neighbours for 640 MHz),
and the curvature of near waves in what the errors add (2 pi d r / (lambda R), under 1 mrad for a
tenth of a millimetre at 10 m).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.hardware import settings
from isac_rt.randomness import generator

_MOST_DRIFT = 60 * np.log(10) / 20  # gains that drift for long stop there


@dataclass(frozen=True)
class Elements:
    """Errors of the elements of one array.

    Attributes
    ----------
    gain : (L,) complex128, factor of the IF samples at time 0
    drift : (L,) complex128, rate of its logarithm [1/s]
    delay : (L,) of each line [s]
    place : (L, 3) beside where it should be, body frame [m]
    tilt : (L, 2) turn of the pattern to the right and upwards [rad]
    coupling : (L, L) complex128 of the waves at the carrier
    """

    gain: np.ndarray
    drift: np.ndarray
    delay: np.ndarray
    place: np.ndarray
    tilt: np.ndarray
    coupling: np.ndarray

    def delays(self, direction: np.ndarray) -> np.ndarray:
        """What each element adds to the delay of plane waves from (to) body directions (K, 3):
        (K, L) [s]."""
        return self.delay - direction @ self.place.T / SPEED_OF_LIGHT

    def factors(
        self,
        direction: np.ndarray,
        positions: np.ndarray,
        antennas: Antennas,
        frequency: float,
        time: float,
    ) -> np.ndarray:
        """The complex factor of each path and element (K, L).

        Parameters
        ----------
        direction : (K, 3) unit vectors, body frame
        positions : (L, 3) of the elements [m]
        antennas : whose elements' pattern it is
        frequency : at which phases are taken [Hz]
        time : since the start of the run [s]
        """
        louder = np.clip(self.drift.real * time, -_MOST_DRIFT, _MOST_DRIFT)
        gain = self.gain * np.exp(louder + 1j * self.drift.imag * time)
        out = np.broadcast_to(gain, (len(direction), self.gain.size))
        if not np.array_equal(self.coupling, np.eye(self.gain.size)):
            cycles = frequency / SPEED_OF_LIGHT * (direction @ positions.T)
            angle = (-2 * np.pi * (cycles - np.rint(cycles))).astype(np.float32)
            steering = np.empty(angle.shape, np.complex64)  # to 4e-7, as are the samples
            steering.real, steering.imag = np.cos(angle), np.sin(angle)
            coupled = steering @ self.coupling.conj().T.astype(np.complex64)
            out = out * (coupled * steering.conj())
        if self.tilt.any() and antennas.pattern != "isotropic":
            straight = antennas.element_gain(direction)
            own = antennas.element_gain(_turned(direction[:, None], self.tilt))
            ratio = np.divide(
                own, straight[:, None], out=np.zeros_like(own), where=straight[:, None] > 0
            )
            out = out * np.sqrt(ratio)
        return out


def _turned(direction: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Directions (K, 1, 3) as elements see them whose patterns are turned by (L, 2) [rad] to the
    right, then upwards: (K, L, 3)."""
    x, y, z = np.moveaxis(direction, -1, 0)
    c, s = np.cos(tilt[:, 0]), np.sin(tilt[:, 0])
    across, ahead = c * x - s * y, s * x + c * y
    c, s = np.cos(tilt[:, 1]), np.sin(tilt[:, 1])
    return np.stack([across, c * ahead + s * z, c * z - s * ahead], axis=-1)


def coupling_of(o: settings.Elements, positions: np.ndarray, wavelength: float) -> np.ndarray:
    """(L, L) the coupling that a scenario states of elements at positions (L, 3) [m]."""
    out = np.eye(len(positions), dtype=complex)
    if o.coupling:
        stated = np.array(o.coupling)
        return stated[..., 0] + 1j * stated[..., 1]
    if o.coupling_db is None or len(positions) < 2:
        return out
    apart = np.linalg.norm(positions[:, None] - positions, axis=2)
    others = ~np.eye(len(positions), dtype=bool)
    nearest = apart[others].min()
    level = 10 ** (o.coupling_db / 20) * (nearest / apart[others]) ** 2
    out[others] = level * np.exp(-2j * np.pi * apart[others] / wavelength)
    return out


def elements_of(
    o: settings.Elements, positions: np.ndarray, wavelength: float, seed: int, *name: str
) -> Elements | None:
    """The errors that a scenario states of elements at positions (L, 3) [m]; None where there are
    none. What is drawn depends on the seed and the name alone."""
    if o.ideal:
        return None
    size = len(positions)

    def drawn(what: str, stated: tuple, spread: float, *shape: int) -> np.ndarray:
        rng = generator(seed, "element", what, *name)
        return rng.normal(size=(size, *shape)) * spread + (np.array(stated) if stated else 0.0)

    def factor(what: str, unit: float, stated: tuple, spread: float) -> np.ndarray:
        return drawn(what, stated, spread) * unit

    neper, turn = np.log(10) / 20, np.pi / 180
    gain = factor("gain", neper, o.gain_db, o.gain_std_db)
    phase = factor("phase", turn, o.phase_deg, o.phase_std_deg)
    faster = factor("gain drift", neper, (), o.gain_drift_std_db_per_s)
    turning = factor("phase drift", turn, (), o.phase_drift_std_deg_per_s)
    return Elements(
        gain=np.exp(gain + 1j * phase),
        drift=faster + 1j * turning,
        delay=factor("delay", 1e-12, o.delay_ps, o.delay_std_ps) + 1e-12 * o.common_delay_ps,
        place=1e-3 * drawn("place", o.position_mm, o.position_std_mm, 3),
        tilt=turn * drawn("tilt", o.tilt_deg, o.tilt_std_deg, 2),
        coupling=coupling_of(o, positions, wavelength),
    )
