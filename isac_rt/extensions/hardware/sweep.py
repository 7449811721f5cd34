r"""Changes over a chirp: the complex gain of the front ends, and the chirp's own frequency.

A chirp whose frequency is e(u) off a straight line has the phase :math:`\epsilon = 2\pi\int e`
more. A wave of delay tau, data and all, then has in the IF

.. math::

    \epsilon_{rx}(u) - \epsilon_{tx}(u - \tau) \approx \epsilon_{rx}(u) - \epsilon_{tx}(u)
    + 2\pi\tau\, e_{tx}(u - \tau/2)

of which the last term is that of an ideal chirp at the time :math:`u + e_{tx}(u -
\tau/2)/\alpha`: the samples are read at other places. Left out: that tau/2 is taken of one path and
the mean data symbol for all, which turns the others by :math:`\pi\tau\,\Delta\tau\,e'` (0.05 rad
for 64 kHz of quadratic error and the longest delay), and third orders of tau.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isac_rt.frame import front_end as settings
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import generator


@dataclass(frozen=True, eq=False)
class Response:
    """Complex gain over the chirp of each element of an array.

    Attributes
    ----------
    of : the stated table
    slopes : (L,) complex128, of the logarithm from the middle of the chirp to its end
    """

    of: settings.Response
    slopes: np.ndarray

    @property
    def common(self) -> bool:
        """True if all elements share one response."""
        return not self.slopes.any()

    def at(self, position: np.ndarray) -> np.ndarray:
        """Gain of the elements at places from -1 to 1 over the samples: (L, ...) complex128. Beyond
        the ends a table is held."""
        o, x = self.of, np.asarray(position, float)
        db, deg = np.zeros(x.shape), np.zeros(x.shape)
        for total, table in ((db, o.table_db), (deg, o.table_deg)):
            if table:
                total += np.interp(x, np.linspace(-1, 1, len(table)), table)
        exponent = db * (np.log(10) / 20) + 1j * np.radians(deg)
        exponent = exponent + np.multiply.outer(self.slopes, x)
        return np.exp(exponent)


@lru_cache(maxsize=32)
def sampled(response: Response, count: int, before: int = 0) -> np.ndarray:
    """Gain of each element at so many samples of a chirp, and at `before` more ahead of them:
    (L, before + count) complex64, kept for the next frame: not to be written to."""
    position = 2 * np.arange(-before, count) / (count - 1) - 1
    return response.at(position).astype(np.complex64)


def response_of(o: settings.Response, size: int, seed: int, *name: str) -> Response | None:
    """The response that a scenario states of so many elements; None where it is flat."""
    if o.ideal:
        return None
    rng = generator(seed, "response", *name)
    db, deg = rng.normal(size=(2, size))
    slopes = db * o.slope_std_db * (np.log(10) / 20) + 1j * np.radians(deg * o.slope_std_deg)
    return Response(o, slopes)


RIPPLE_S = 10e-6
"""Period of a ramp's ripple: that of a synthesiser's loop of 100 kHz."""


@dataclass(frozen=True)
class Ramp:
    """Errors of a chirp's frequency.

    Attributes
    ----------
    quadratic : at the ends of the chirp [Hz]
    ripple, period : swing [Hz] and period [s] of a sine from the start of the chirp on
    duration : of the chirp [s]
    """

    quadratic: float
    ripple: float
    period: float
    duration: float

    def frequency(self, time: np.ndarray) -> np.ndarray:
        """e at times since the start of the chirp [Hz]."""
        x = 2 * time / self.duration - 1
        wave = self.ripple * np.sin(2 * np.pi * time / self.period)
        return self.quadratic * x * x + wave

    def cycles(self, time: np.ndarray) -> np.ndarray:
        """Its integral from the middle of the chirp on [cycles]."""
        x, half = 2 * time / self.duration - 1, self.duration / 2
        wave = np.cos(np.pi * self.duration / self.period) - np.cos(2 * np.pi * time / self.period)
        wave = wave * self.ripple * self.period / (2 * np.pi)
        return half * (x * x * x) * self.quadratic / 3 + wave


def ramp_of(o: settings.Ramp, waveform: Waveform) -> Ramp | None:
    """The errors that a scenario states; None where there are none."""
    if o.ideal:
        return None
    return Ramp(o.quadratic_hz, o.ripple_hz, RIPPLE_S, waveform.chirp_duration)


READ_ERROR = 2e-3
"""What `short_read` may be wrong by, over a full tone anywhere in the band."""
_HALF_BAND = 1 / 3
_SHORT = 3, 5  # neighbours to each side, beyond which `read_at` serves


@lru_cache(maxsize=16)
def short_read(most: float) -> np.ndarray | None:
    r"""Taps that read samples up to `most` of a sample away, for a band of two thirds of the
    sampling rate about zero, to `READ_ERROR`; None where none so few do.

    .. math:: x(n + s) \approx x(n) + s\sum_t a_t (x_{n+t} - x_{n-t}) + s^2 \big(b_0 x_n +
        b_1 (x_{n+1} + x_{n-1})\big)

    with a and b of the least largest error over the band and the places. More of b would take away
    a tenth of what so few a leave.

    Returns
    -------
    taps : (1 + T, 2) of each neighbour, the sample itself first: a (0 of it) and b (0 beyond b_1)
    """
    frequency = np.linspace(0, _HALF_BAND, 41)[:, None]
    shift = np.linspace(0.2, 1.0, 5) * most
    angle = 2 * np.pi * frequency
    for count in _SHORT:
        t = np.arange(1, count + 1)
        odd = np.einsum("s,ft->fst", shift, 2 * np.sin(angle * t)).reshape(-1, count)
        waves = np.concatenate([np.ones_like(angle), 2 * np.cos(angle)], axis=1)
        even = np.einsum("s,ft->fst", shift**2, waves).reshape(-1, 2)
        truth = np.exp(1j * angle * shift).ravel() - 1
        weight = np.ones(truth.size)
        for _ in range(8):  # Lawson's way from least squares to the least largest error
            a = np.linalg.lstsq(odd * weight[:, None], truth.imag * weight, rcond=None)[0]
            b = np.linalg.lstsq(even * weight[:, None], truth.real * weight, rcond=None)[0]
            error = np.abs(even @ b + 1j * (odd @ a) - truth)
            weight *= np.sqrt(error / error.max() + 1e-3)
        if error.max() <= READ_ERROR:
            return np.column_stack([np.append(0.0, a), np.append(b, np.zeros(count - 1))])
    return None


REACH = 6
"""Samples to each side from which one between them is made."""
_SHAPE = 6.0  # Kaiser's beta


def read_at(shift: np.ndarray) -> tuple[int, np.ndarray]:
    """Interpolate samples at other instants, for a band of two thirds of the sampling rate about
    zero: Kaiser's window of `REACH` samples to each side.

    Parameters
    ----------
    shift : (N,) of each sample [samples]

    Returns
    -------
    first : of the neighbours, relative to the sample
    weights : (T, N) float64 of the neighbours `first` .. `first` + T - 1
    """
    most = int(np.ceil(max(np.abs(shift).max(initial=0.0) - 0.5, 0.0)))
    first, count = -REACH - most, 2 * (REACH + most) + 1
    distance = shift - np.arange(first, first + count)[:, None]
    inside = np.clip(1 - (distance / (REACH + 0.5)) ** 2, 0, None)
    window = np.where(inside > 0, np.i0(_SHAPE * np.sqrt(inside)) / np.i0(_SHAPE), 0.0)
    return first, np.sinc(distance) * window
