r"""Slow change of amplitude and phase over the chirp, estimated from the range rows about a path.

Over x = -1 .. 1 of the range window a channel's response is :math:`\sum_j q_j P_j(x)` with
polynomials that are orthonormal under the squared Hann window, so that noise in the q_j is alike
and independent. The window keeps the lobes of each low, and seven rows hold all that matters.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

MODES = 4
"""Polynomials of degree 0 to 3."""
_POINTS = 256
_FARTHEST, _STEPS = 12, 64
"""Cells on each side of a tone, and points of a cell, of which the modes' spectra are kept."""


@lru_cache(maxsize=1)
def _coefficients() -> np.ndarray:
    """(MODES, MODES) of powers and polynomials."""
    x = _midpoints()
    weight = np.cos(np.pi * x / 2) ** 2
    powers = np.vander(x, MODES, increasing=True)
    _, r = np.linalg.qr(powers * weight[:, None] / np.sqrt((weight**2).sum()))
    return np.linalg.inv(r * np.sign(np.diag(r))[:, None])


def _midpoints() -> np.ndarray:
    return (np.arange(_POINTS) + 0.5) * (2 / _POINTS) - 1


def polynomials(x: np.ndarray) -> np.ndarray:
    """(MODES, ...) values of the P_j at places x of the window."""
    powers = np.stack([np.asarray(x, float) ** i for i in range(MODES)], axis=-1)
    return np.moveaxis(powers @ _coefficients(), -1, 0)


@lru_cache(maxsize=1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Offsets (D,) [cells of the window] and spectra (MODES, D) of the windowed P_j."""
    offset = np.arange(-_FARTHEST * _STEPS, _FARTHEST * _STEPS + 1) / _STEPS
    x = _midpoints()
    windowed = polynomials(x) * np.cos(np.pi * x / 2) ** 2 * (2 / _POINTS)
    return offset, windowed @ np.exp(1j * np.pi * np.outer(x, offset))


def mode_shapes(offset: np.ndarray) -> np.ndarray:
    """(MODES, ...) spectra of the Hann window times each P_j, about its middle, `offset` cells of
    the window from a tone; 1 for the first one at 0."""
    at, table = _table()
    out = np.zeros((MODES, *np.shape(offset)), complex)
    for j, shape in enumerate(table):
        part = shape.imag if j % 2 else shape.real
        out[j] = np.interp(offset, at, part) * (1j if j % 2 else 1.0)
    return out
