"""Range spectra of a frame with the data taken out: one FFT per chirp.

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
"""

from __future__ import annotations

import numpy as np

from isac_rt.frame.cube import IFCube, SharedCube
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import new_memory
from isac_rt.receive.known import Known
from isac_rt.receive.transform import transform


def _factors(
    num_samples: int, delay_symbols: np.ndarray, starts: np.ndarray, length: float
) -> np.ndarray:
    """Hann's window at sample n less each start, times exp(-j 2 pi D n/N), which moves cell k + D
    to k: (P, N) complex64."""
    out = np.empty((len(starts), num_samples), np.complex64)
    _fill_factors(
        np.asarray(delay_symbols, np.int64) % num_samples,
        starts.astype(np.float64),
        length,
        np.exp(2j * np.pi / length * np.arange(num_samples)),
        np.exp(-2j * np.pi / num_samples * np.arange(num_samples)),
        out,
    )
    return out


@jit
def _fill_factors(symbols, starts, length, places, roots, out):
    """Sines of sums made of few sines: `places` are those of the window, `roots` those of the
    transform."""
    for p in range(out.shape[0]):
        begin = np.exp(-2j * np.pi * starts[p] / length)
        at = 0
        for n in range(out.shape[1]):
            inside = starts[p] <= n <= starts[p] + length
            out[p, n] = (0.5 - 0.5 * (begin * places[n]).real) * roots[at] if inside else 0.0
            at += symbols[p]
            if at >= out.shape[1]:
                at -= out.shape[1]


def tones(frequency: np.ndarray, num_samples: int) -> np.ndarray:
    """exp(j 2 pi f n) for n = 0 .. N-1 and each of (P,) frequencies: (P, N) complex64, each a
    product of two phasors reduced in float64."""
    coarse, fine = np.arange(0, num_samples, 32), np.arange(32)
    start, step = (
        np.exp(2j * np.pi * (np.asarray(frequency)[:, None] * n % 1.0)) for n in (coarse, fine)
    )
    out = np.empty((len(start), num_samples), np.complex64)
    _fill_tones(start, step, out)
    return out


@jit
def _fill_tones(start, step, out):
    for p in range(out.shape[0]):
        for n in range(out.shape[1]):
            out[p, n] = start[p, n // 32] * step[p, n % 32]


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
        turn = phase.astype(np.complex64) * tones(shift[m] / num_samples, num_rows).T
        transform(samples[m], factor, np.arange(num_rows), out[m], turn=turn)
    return out


def cleaned(cube: IFCube, known: Known) -> tuple[np.ndarray, Known]:
    """`clean_spectrum`, made once for all receivers of a shared cube that read the same data, and
    what the first of them knew. Whoever changes the spectra changes a copy."""
    if not isinstance(cube, SharedCube):
        return clean_spectrum(cube, known), known
    kept = cube.made.get("cleaned")
    if kept is None or not kept[1].alike(known):
        kept = cube.made["cleaned"] = clean_spectrum(cube, known), known
    return kept
