r"""Phase shifters of transmit antennas that send at once.

A code's phase is rounded to the nearest of 2^b steps, of which each has an error of its own. What
is left over repeats with the code: of a code of B phases the antenna's echoes show as lines in the
other B - 1 bands of velocity, at the levels of the discrete Fourier transform of the phasors that
are sent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.frame import front_end as settings
from isac_rt.randomness import generator


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
