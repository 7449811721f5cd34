r"""Amplifier, mixer and converters of a receiver, and the transmit amplifier.

Amplifiers are Rapp's [1]_ with p = 2: an amplitude A becomes :math:`A (1 + (A/A_s)^4)^{-1/4}`,
without a turn of the phase. The quadrature channel with the gain g and the angle theta too much
makes of x

.. math::

    x_I + j g (x_Q \cos\theta + x_I \sin\theta), \qquad
    \text{image} = \left|\frac{1 - g e^{j\theta}}{1 + g e^{j\theta}}\right|^2

A converter of b bits has 2^b steps of 2 A / 2^b between -A and A, each read in its middle: of a
sine that fills it, noise of -6.02 b - 1.76 dB is left. It is white only where the signal crosses
several steps.

References
----------
.. [1] C. Rapp, "Effects of HPA-nonlinearity on a 4-DPSK/OFDM-signal for a digital sound
   broadcasting system", 2nd European Conference on Satellite Communications, 1991
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.frame import front_end as settings

_AT_ONE_DB = np.sqrt(10**0.2 - 1)  # power over the saturation's where the gain is 1 dB lower

HEADROOM_DB = 12.0
"""Full scale of the automatic gain over the mean power: room for four equal waves."""


def watts(dbm: float) -> float:
    """Power [W]."""
    return float(1e-3 * 10 ** (dbm / 10))


@dataclass(frozen=True)
class Converter:
    """Effects on the samples of each element, in this order.

    Attributes
    ----------
    saturation : power at which the amplifier saturates [W]; inf: never
    mixing : ((I of I, I of Q), (Q of I, Q of Q))
    constant : added to I and Q alike [sqrt(W)]
    real : whether Q is dropped
    bits : of each converter; 0: none
    full_scale : largest amplitude [sqrt(W)]; 0: by the automatic gain
    headroom : of the automatic gain, in amplitude
    """

    saturation: float
    mixing: tuple[tuple[float, float], tuple[float, float]]
    constant: float
    real: bool
    bits: int
    full_scale: float
    headroom: float


def converter_of(o: settings.Converter) -> Converter | None:
    """The converter that a scenario states; None where it is ideal."""
    if o.ideal:
        return None
    gain, angle = 10 ** (o.iq_gain_db / 20), np.radians(o.iq_phase_deg)
    return Converter(
        np.inf if o.compression_dbm is None else watts(o.compression_dbm) / _AT_ONE_DB,
        ((1.0, 0.0), (float(gain * np.sin(angle)), float(gain * np.cos(angle)))),
        0.0 if o.dc_dbm is None else float(np.sqrt(watts(o.dc_dbm) / 2)),
        o.real,
        o.bits or 0,
        0.0 if o.full_scale_dbm is None else float(np.sqrt(watts(o.full_scale_dbm))),
        10 ** (HEADROOM_DB / 20),
    )


def saturated(power: float, saturation: float | None) -> float:
    """Factor of the amplitude of a wave of this power [W] behind an amplifier that saturates."""
    return 1.0 if saturation is None else float((1 + (power / saturation) ** 2) ** -0.25)
