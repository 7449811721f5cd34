r"""Errors of the elements of an array: gain, phase, delay, coupling.

Element r delays all waves by :math:`\delta_r` more, the whole chirp. All else is one complex factor
of a path from (to) the body direction u and an element, taken at the middle of the chirp:

.. math::

    g_r \frac{\sum_{r'} C^*_{rr'} a_{r'}(u)}{a_r(u)}, \qquad a_r(u) = e^{-j2\pi f r\cdot u/c}

with C the coupling of the waves, of which the IF holds the conjugate. Left out: that coupling
changes over the sweep (0.01 rad between neighbours for 640 MHz).

Transmit antennas that send at once have phase shifters. A code's phase is rounded to the nearest of
2^b steps, of which each has an error of its own. What is left over repeats with the code: of a code
of B phases the antenna's echoes show as lines in the other B - 1 bands of velocity, at the levels
of the discrete Fourier transform of the phasors that are sent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.frame import front_end as settings
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.randomness import generator


@dataclass(frozen=True)
class Elements:
    """Errors of the elements of one array.

    Attributes
    ----------
    gain : (L,) complex128, factor of the IF samples
    delay : (L,) of each line [s]
    coupling : (L, L) complex128 of the waves at the carrier
    """

    gain: np.ndarray
    delay: np.ndarray
    coupling: np.ndarray

    def factors(self, direction: np.ndarray, positions: np.ndarray, frequency: float) -> np.ndarray:
        """The complex factor of each path and element (K, L).

        Parameters
        ----------
        direction : (K, 3) unit vectors, body frame
        positions : (L, 3) of the elements [m]
        frequency : at which phases are taken [Hz]
        """
        out = np.broadcast_to(self.gain, (len(direction), self.gain.size))
        if not np.array_equal(self.coupling, np.eye(self.gain.size)):
            cycles = frequency / SPEED_OF_LIGHT * (direction @ positions.T)
            angle = (-2 * np.pi * (cycles - np.rint(cycles))).astype(np.float32)
            steering = np.empty(angle.shape, np.complex64)  # to 4e-7, as are the samples
            steering.real, steering.imag = np.cos(angle), np.sin(angle)
            coupled = steering @ self.coupling.conj().T.astype(np.complex64)
            out = out * (coupled * steering.conj())
        return out


def coupling_of(o: settings.Elements, positions: np.ndarray, wavelength: float) -> np.ndarray:
    """(L, L) the coupling that a scenario states of elements at positions (L, 3) [m]."""
    out = np.eye(len(positions), dtype=complex)
    if o.coupling_db is None or len(positions) < 2:
        return out
    distance = np.linalg.norm(positions[:, None] - positions, axis=2)
    others = ~np.eye(len(positions), dtype=bool)
    nearest = distance[others].min()
    level = 10 ** (o.coupling_db / 20) * (nearest / distance[others]) ** 2
    out[others] = level * np.exp(-2j * np.pi * distance[others] / wavelength)
    return out


def elements_of(
    o: settings.Elements, positions: np.ndarray, wavelength: float, seed: int, *name: str
) -> Elements | None:
    """The errors that a scenario states of elements at positions (L, 3) [m]; None where there are
    none. What is drawn depends on the seed and the name alone."""
    if o.ideal:
        return None
    size = len(positions)

    def drawn(what: str, unit: float, stated: tuple[float, ...], spread: float) -> np.ndarray:
        rng = generator(seed, "element", what, *name)
        return (rng.normal(size=size) * spread + (np.array(stated) if stated else 0.0)) * unit

    gain = drawn("gain", np.log(10) / 20, o.gain_db, o.gain_std_db)
    phase = drawn("phase", np.pi / 180, o.phase_deg, o.phase_std_deg)
    return Elements(
        gain=np.exp(gain + 1j * phase),
        delay=drawn("delay", 1e-12, o.delay_ps, o.delay_std_ps),
        coupling=coupling_of(o, positions, wavelength),
    )


@dataclass(frozen=True)
class Shifter:
    """Phase shifters of an array.

    Attributes
    ----------
    steps : (L, 2^bits) complex128, phasor of each antenna's steps
    """

    steps: np.ndarray

    def sent(self, antenna: int, code: np.ndarray) -> np.ndarray:
        """Return the phasors that an antenna sends for phasors (...) of a code.

        Examples
        --------
        >>> two_bits = Shifter(np.array([[1, 1j, -1, -1j]]))
        >>> two_bits.sent(0, np.exp(1j * np.radians([0, 50, 91, 181]))).round(9).tolist()
        [(1+0j), 1j, 1j, (-1+0j)]
        """
        size = self.steps.shape[1]
        step = np.rint(np.angle(code) * (size / (2 * np.pi))).astype(int) % size
        return np.asarray(self.steps[antenna, step])


def shifter_of(o: settings.Shifter, size: int, seed: int, name: str) -> Shifter | None:
    """The shifters that a scenario states of so many antennas; None where any phase can be sent."""
    if o.bits is None:
        return None
    nominal = np.arange(2**o.bits) * (360 / 2**o.bits)
    drawn = generator(seed, "shifter", name).normal(size=(size, nominal.size)) * o.errors_std_deg
    stated = np.array(o.errors_deg) if o.errors_deg else np.zeros(nominal.size)
    return Shifter(np.exp(1j * np.radians(nominal + stated + drawn)))
