r"""Fresnel diffraction in closed form: a knife edge and a disc.

Both factors multiply the amplitude that the straight path would have, and take phases as exp(-jkd).
Lengths across the path are counted in Fresnel units, :math:`\nu = h\sqrt{2(d_1+d_2)/(\lambda d_1
d_2)}` with d_1 and d_2 the distances to the ends of the path; one unit is 0.22 m in the middle of
100 m at 77 GHz. Scalar, small angles, one screen: the polarisation and the shape of what stands
behind the edge (a wedge's angle, a rounded rim) are left out, which matters at bending angles
beyond some degrees and losses beyond some 20 dB.

References
----------
.. [1] ITU-R P.526-15, "Propagation by diffraction", section 4.1.
.. [2] M. Born and E. Wolf, "Principles of Optics", 7th ed., sections 8.7.3 (straight edge) and 8.9
(boundary diffraction wave).
"""

from __future__ import annotations

import numpy as np
from scipy.special import fresnel

LIT_REACH = 6.0
"""Fresnel units from the edge of a shadow, on its lit side, at which an obstacle stops to matter;
its ripple is 4 % there and tapered."""
SHADOW_REACH = 22.0
"""The same on the dark side; 40 dB down."""


def knife_edge(nu: np.ndarray) -> np.ndarray:
    r"""Factor of a straight edge, :math:`F(\nu) = \frac{1+j}{2}\int_\nu^\infty e^{-j\pi t^2/2}\,dt`
    (eqs. 26 to 30 of [1]_).

    Parameters
    ----------
    nu : (...) height of the edge over the path in Fresnel units; positive in the shadow

    Returns
    -------
    (...) complex128; 1 far on the lit side, 1/2 at the edge
    """
    s, c = fresnel(nu)
    return (1 + 1j) / 2 * ((0.5 - c) - 1j * (0.5 - s))


def disc(nu: np.ndarray, radius: np.ndarray) -> np.ndarray:
    r"""Factor of an opaque disc across the path, by its boundary wave ([2]_, section 8.9, in the
    Fresnel approximation):

    .. math::

        1 - \frac{1}{2\pi}\oint \left(1 - e^{-j\pi\rho^2/2}\right) \frac{\alpha^2 +
        \alpha\nu\cos\phi}{\rho^2}\,d\phi, \quad \rho^2 = \nu^2 + \alpha^2 + 2\alpha\nu\cos\phi.

    Parameters
    ----------
    nu : (K,) distance of the disc's centre from the path in Fresnel units, >= 0
    radius : (K,) alpha, in the same units

    Returns
    -------
    (K,) complex128; on the axis exp(-j pi alpha^2 / 2), Poisson's spot
    """
    out = np.empty(nu.size, complex)
    for k, (v, a) in enumerate(zip(nu, radius, strict=True)):
        # periodic and smooth: the mean converges at once when phases are resolved
        count = 24 + int(np.ceil(2 * v * a * np.pi))
        cosine = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        square = np.maximum(v * v + a * a + 2 * a * v * cosine, 1e-12)
        wave = (1 - np.exp(-0.5j * np.pi * square)) / square
        out[k] = 1 - (wave * (a * a + a * v * cosine)).mean()
    return out


def tapered(factor: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """A factor that goes over to 1 between half and all of `LIT_REACH` (Fresnel units from the
    edge, lit side)."""
    return 1 + (factor - 1) * _falling(2 * distance / LIT_REACH - 1)


def edge_factor(nu: np.ndarray) -> np.ndarray:
    """`knife_edge`, tapered to 1 at `LIT_REACH` and to 0 at `SHADOW_REACH`."""
    return tapered(knife_edge(nu), -nu) * _falling(4 * nu / SHADOW_REACH - 3)


def _falling(x: np.ndarray) -> np.ndarray:
    """Smooth step from 1 at 0 to 0 at 1."""
    x = np.clip(x, 0.0, 1.0)
    return 1 - x * x * (3 - 2 * x)


def fresnel_unit(wavelength: float, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Length across a path [m] that is one Fresnel unit, at distances `before` and `after` from its
    ends [m]."""
    return np.sqrt(wavelength * before * after / (2 * (before + after)))
