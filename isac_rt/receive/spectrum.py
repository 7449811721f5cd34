r"""Range spectra of a frame with the data taken out: one FFT per chirp.

With a data delay tau_D = D / (alpha T) the tone of a path at cell f becomes (cycles, over sample n)

    (f + D) n/N  -  f s_D/N  +  [f_c tau_D + alpha (T~ - T) tau_D - alpha tau_D^2 / 2],      s_D = D
    f_s / (alpha T).

The bracket and the ramp D n/N do not depend on the path. The cross term does: it shifts the tone's
time origin by s_D samples (17 for the largest symbol of the paper's settings). So the window is
laid s_D samples later, over the same stretch of the shifted time for every symbol, and the
spectrum's cell k, which was k + D before the factor exp(-j 2 pi D n/N), is turned by exp(+j 2 pi k
s_D/N). What remains is, at fractional cells too, an unmodulated chirp that was sent tau_D later:
the path's motion during tau_D is in it, and whoever follows the phase from chirp to chirp has to
count tau_D to the chirp's time.

All range transforms are FFTs of many chirps at once, with what comes before and after them in the
same pass (`transform`):

.. math:: Y[r, i, p] = g[i, p] \sum_n h[p, n]\, s[r, p, n]\, e^{-j 2 \pi c_i n / N}

Sixteen chirps lie side by side in a table that stays in the second-level cache from the first
factor to the last (`isac_rt.kernels.fourier`); the samples are read once and only the cells that
are wanted are written.
"""

from __future__ import annotations

import numpy as np
import scipy.fft

from isac_rt.frame.cube import IFCube, SharedCube
from isac_rt.kernels import fourier as lanefft
from isac_rt.kernels import receive_transform
from isac_rt.kernels.fourier import ROW
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.receive_transform import Tables
from isac_rt.kernels.vector import aligned, new_memory
from isac_rt.receive.known import Known


def transform(
    samples: np.ndarray,
    factor: np.ndarray,
    cells: np.ndarray,
    out: np.ndarray,
    *,
    phasor: np.ndarray | None = None,
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
    phasor : (rows, P) complex64, g; None: 1
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
        transform_plain(samples, factor, cells, out, phasor=phasor, power=power, tapered=tapered)
        return
    lane_order = order[-np.arange(size) % size] * ROW  # the lane transform turns the other way
    phasors = np.zeros((0, 1), np.complex64) if phasor is None else phasor
    none = np.zeros((0, size), np.float32)
    powers = none if power is None else power, none if tapered is None else tapered
    sizes = size, size, len(phasors), *(len(wanted) and size // 2 for wanted in powers)
    fill_cells(
        _floats(samples),
        _floats(factor),
        _floats(phasors),
        powers,
        out.view(np.float32),
        radices,
        twiddles,
        lane_order,
        lane_order[np.asarray(cells) % size],
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
    phasor: np.ndarray | None = None,
    power: np.ndarray | None = None,
    tapered: np.ndarray | None = None,
) -> None:
    """`transform` with `scipy.fft`: the oracle, and what is used for an N that is no product of 8
    and twos, threes and fives."""
    for r, group in enumerate(samples):
        spectrum = scipy.fft.fft(group * factor, axis=1, workers=1, overwrite_x=True)
        if power is not None:
            power += spectrum.real**2 + spectrum.imag**2
        if tapered is not None:
            beside = np.roll(spectrum, 1, axis=1) + np.roll(spectrum, -1, axis=1)
            tapered += np.abs(spectrum / 2 - beside / 4) ** 2
        out[r] = spectrum[:, np.asarray(cells) % samples.shape[-1]].T
        if phasor is not None:
            out[r] *= phasor


@twin_of(receive_transform.transform)
def fill_cells(
    samples: np.ndarray,
    factor: np.ndarray,
    phasor: np.ndarray,
    powers: tuple[np.ndarray, np.ndarray],
    out: np.ndarray,
    radices: np.ndarray,
    twiddles: np.ndarray,
    lane_order: np.ndarray,
    at: np.ndarray,
    work: Tables,
) -> None:
    """Fill cells of range spectra (module docstring), complex arrays as `_floats`.

    `lane_order` holds each cell's row in the lane transform of `radices` and `twiddles`, `at` where
    the wanted cells do; `powers` are `power` and `tapered`, or empty.
    """
    order = np.argsort(lane_order)
    cells = order[np.searchsorted(lane_order[order], at)]
    transform_plain(
        samples.view(np.complex64),
        factor.view(np.complex64),
        cells,
        out.view(np.complex64),
        phasor=phasor.view(np.complex64) if phasor.size else None,
        power=powers[0] if powers[0].size else None,
        tapered=powers[1] if powers[1].size else None,
    )


def _factors(
    num_samples: int, delay_symbols: np.ndarray, starts: np.ndarray, length: float
) -> np.ndarray:
    """Hann's window at sample n less each start, times exp(-j 2 pi D n/N), which moves cell k + D
    to k: (P, N) complex64."""
    angle, start = 2 * np.pi / length * np.arange(num_samples), 2 * np.pi / length * starts
    # (1 - cos(angle - start)) / 2 as a product of matrices
    at = np.stack([np.ones(len(start)), -np.cos(start), -np.sin(start)], axis=1) / 2
    along = np.stack([np.ones(num_samples), np.cos(angle), np.sin(angle)])
    window = (at @ along).astype(np.float32)
    for line, first in zip(window, starts.tolist(), strict=True):
        line[: max(int(np.ceil(first)), 0)] = 0.0
        line[int(np.floor(first + length)) + 1 :] = 0.0
    out = tones(-np.asarray(delay_symbols) / num_samples, num_samples)
    out *= window
    return out


def tones(frequency: np.ndarray, num_samples: int) -> np.ndarray:
    """Return exp(j 2 pi f n) for n = 0 .. N-1 and each of (P,) frequencies [cycles per sample]:
    (P, N) complex64, rounded once. Phases of every 32nd sample times those of the 32 from 0."""
    first, within = np.arange(0, num_samples, 32), np.arange(32)
    starts, turns = (np.exp(2j * np.pi * (np.outer(frequency, n) % 1.0)) for n in (first, within))
    out = np.empty((len(starts), len(first), 32), np.complex64)
    np.multiply(starts[:, :, None], turns[:, None], out=out, casting="same_kind")
    return np.ascontiguousarray(out.reshape(len(starts), -1)[:, :num_samples])


def clean_spectrum(cube: IFCube, known: Known, num_rows: int | None = None) -> np.ndarray:
    """Hann-windowed range spectra without the data.

    Parameters
    ----------
    cube : IFCube
    known : Known, whose data are taken out
    num_rows : range cells wanted, from cell 0; None: the N/2 that hold every chirp

    Returns
    -------
    spectra : (M, L_rx, num_rows, P) complex64; a path of unit amplitude at cell f gives
        sum_n w(n) exp(j 2 pi (f - k) n/N) times its phase at sample 0
    """
    w, samples, symbols = known.waveform, cube.samples, known.delay_symbols
    num_groups, num_rx, num_chirps, num_samples = samples.shape
    num_rows = w.num_range_cells if num_rows is None else num_rows
    shift = w.data_shift(symbols)
    out = new_memory((num_groups, num_rx, num_rows, num_chirps))
    for m in range(num_groups):
        factor = _factors(num_samples, symbols[m], shift[m], w.window_length)
        phase = known.phases[m].conj() * np.exp(-2j * np.pi * w.data_phase(symbols[m]))
        phasor = phase.astype(np.complex64) * tones(shift[m] / num_samples, num_rows).T
        transform(samples[m], factor, np.arange(num_rows), out[m], phasor=phasor)
    return out


def cleaned(cube: IFCube, known: Known) -> tuple[np.ndarray, Known]:
    """`clean_spectrum`, made once for all receivers of a shared cube that read the same data, and
    what the first of them knew. Whoever changes the spectra changes a copy."""
    if not isinstance(cube, SharedCube):
        return clean_spectrum(cube, known), known
    cached = cube.made.get("cleaned")
    if cached is None or not cached[1].alike(known):
        cached = cube.made["cleaned"] = clean_spectrum(cube, known), known
    return cached
