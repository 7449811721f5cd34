r"""Range transforms of many chirps at once: the FFTs of a reception, with what comes before and
after them in the same pass.

.. math:: Y[r, i, p] = g[i, p] \sum_n h[p, n]\, s[r, p, n]\, e^{-j 2 \pi c_i n / N}

Sixteen chirps lie side by side in a table that stays in the second-level cache from the first
factor to the last (`isac_rt.kernels.fourier`); the samples are read once and only the cells that
are wanted are written. `transform_plain` is the same by `scipy.fft`: the oracle, and what is used
for an N that is no product of 8 and twos, threes and fives.
"""

from __future__ import annotations

import numpy as np
import scipy.fft

from isac_rt.kernels import fourier as lanefft
from isac_rt.kernels import receive_transform
from isac_rt.kernels.fourier import ROW
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.receive_transform import Tables
from isac_rt.kernels.vector import aligned


def transform(
    samples: np.ndarray,
    factor: np.ndarray,
    cells: np.ndarray,
    out: np.ndarray,
    *,
    turn: np.ndarray | None = None,
    power: np.ndarray | None = None,
    tapered: np.ndarray | None = None,
) -> None:
    """Cells of the range spectra of one group (module docstring).

    Parameters
    ----------
    samples : (L_rx, P, N) complex64
    factor : (P, N) complex64, h: window, derotation
    cells : (rows,) int, c, modulo N
    out : (L_rx, rows, P) complex64, filled with Y; soonest from an address that is a multiple of 64
        (`isac_rt.kernels.vector.new_memory`)
    turn : (rows, P) complex64, g; None: 1
    power : (P, N) float32, to which sum_r |spectrum|^2 is added over all cells, without g
    tapered : likewise of the samples under Hann's window, which takes half of a cell less a quarter
        of both neighbours
    """
    size = samples.shape[-1]
    try:
        radices, twiddles, order = lanefft.plan(size)
    except ValueError:
        size = 0
    if size == 0 or size % 8:
        transform_plain(samples, factor, cells, out, turn=turn, power=power, tapered=tapered)
        return
    place = order[-np.arange(size) % size] * ROW  # the lane transform turns the other way
    turns = np.zeros((0, 1), np.complex64) if turn is None else turn
    none = np.zeros((0, size), np.float32)
    powers = none if power is None else power, none if tapered is None else tapered
    sizes = size, size, len(turns), *(len(wanted) and size // 2 for wanted in powers)
    fill_cells(
        _floats(samples),
        _floats(factor),
        _floats(turns),
        powers,
        out.view(np.float32),
        radices,
        twiddles,
        place,
        place[np.asarray(cells) % size],
        Tables(*(aligned(rows * ROW) for rows in sizes)),
    )


def _floats(values: np.ndarray) -> np.ndarray:
    """Complex values as float32 with real and imaginary parts in turn."""
    return np.ascontiguousarray(values, np.complex64).view(np.float32)


def transform_plain(
    samples: np.ndarray,
    factor: np.ndarray,
    cells: np.ndarray,
    out: np.ndarray,
    *,
    turn: np.ndarray | None = None,
    power: np.ndarray | None = None,
    tapered: np.ndarray | None = None,
) -> None:
    """`transform` with `scipy.fft`, for any N."""
    for r, one in enumerate(samples):
        spectrum = scipy.fft.fft(one * factor, axis=1, workers=1, overwrite_x=True)
        if power is not None:
            power += spectrum.real**2 + spectrum.imag**2
        if tapered is not None:
            beside = np.roll(spectrum, 1, axis=1) + np.roll(spectrum, -1, axis=1)
            tapered += np.abs(spectrum / 2 - beside / 4) ** 2
        out[r] = spectrum[:, np.asarray(cells) % samples.shape[-1]].T
        if turn is not None:
            out[r] *= turn


@twin_of(receive_transform.transform)
def fill_cells(
    samples: np.ndarray,
    factor: np.ndarray,
    turn: np.ndarray,
    powers: tuple[np.ndarray, np.ndarray],
    out: np.ndarray,
    radices: np.ndarray,
    twiddles: np.ndarray,
    place: np.ndarray,
    at: np.ndarray,
    work: Tables,
) -> None:
    """Fill cells of range spectra (module docstring), complex arrays as `_floats`.

    `place` says where each cell lies in the lane transform of `radices` and `twiddles`, `at` where
    the wanted cells do; `powers` are `power` and `tapered`, or empty.
    """
    order = np.argsort(place)
    cells = order[np.searchsorted(place[order], at)]
    transform_plain(
        samples.view(np.complex64),
        factor.view(np.complex64),
        cells,
        out.view(np.complex64),
        turn=turn.view(np.complex64) if turn.size else None,
        power=powers[0] if powers[0].size else None,
        tapered=powers[1] if powers[1].size else None,
    )
