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

from functools import lru_cache

import numpy as np

from isac_rt.frame.cube import IFCube, SharedCube
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import (
    LANES,
    cos_sin_double,
    floor,
    load,
    narrow,
    new_memory,
    store,
    zip_high,
    zip_low,
)
from isac_rt.receive.known import Known
from isac_rt.receive.transform import transform


def _factors(
    num_samples: int, delay_symbols: np.ndarray, starts: np.ndarray, length: float
) -> np.ndarray:
    """Hann's window at sample n less each start, times exp(-j 2 pi D n/N), which moves cell k + D
    to k: (P, N) complex64."""
    out = _padded_tones(-np.asarray(delay_symbols) / num_samples, num_samples)
    window = _window_phases(out.shape[1], length)
    _weigh(starts.astype(np.float64), length, *window, out.view(np.float32))
    return np.ascontiguousarray(out[:, :num_samples])


@lru_cache(maxsize=8)
def _window_phases(num_samples: int, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Cosine and sine of the window that begins at sample 0, at every sample."""
    angle = 2 * np.pi / length * np.arange(num_samples)
    return np.cos(angle), np.sin(angle)


@jit
def _weigh(starts, length, cosine, sine, out):
    """Multiply rows by Hann's window from each start on, 0 outside."""
    flat, at = out.reshape(-1), 0
    for p in range(out.shape[0]):
        angle = 2 * np.pi * starts[p] / length
        c, s = 0.5 * np.cos(angle), 0.5 * np.sin(angle)
        for n in range(0, cosine.size, LANES):
            window = narrow(0.5 - (c * load(cosine, n) + s * load(sine, n)))
            store(flat, at, zip_low(window, window) * load(flat, at))
            store(flat, at + LANES, zip_high(window, window) * load(flat, at + LANES))
            at += 2 * LANES
        out[p, : 2 * max(int(np.ceil(starts[p])), 0)] = 0
        out[p, 2 * int(np.floor(starts[p] + length)) + 2 :] = 0


def tones(frequency: np.ndarray, num_samples: int) -> np.ndarray:
    """exp(j 2 pi f n) for n = 0 .. N-1 and each of (P,) frequencies: (P, N) complex64, to 2e-7."""
    return np.ascontiguousarray(_padded_tones(frequency, num_samples)[:, :num_samples])


def _padded_tones(frequency: np.ndarray, num_samples: int) -> np.ndarray:
    """`tones` of the next multiple of sixteen samples."""
    blocks = -(-num_samples // LANES)
    places = np.arange(blocks + -blocks % LANES, dtype=float)
    out = np.empty((len(frequency), blocks * LANES), np.complex64)
    starts = np.empty(2 * places.size, np.float32)
    flat = out.view(np.float32).reshape(-1)
    _fill_tones(np.asarray(frequency, float), blocks, places, starts, flat)
    return out


@jit
def _fill_tones(frequency, blocks, places, starts, out):
    """Of each sixteen samples the first one's phase, reduced in float64, times those of sixteen
    from 0."""
    at = 0
    for p in range(frequency.size):
        for b in range(0, places.size, LANES):
            cycles = LANES * frequency[p] * load(places, b)
            c, s = cos_sin_double(cycles - floor(cycles + 0.5))
            store(starts, b, narrow(c))
            store(starts, places.size + b, narrow(s))
        cycles = frequency[p] * load(places, 0)
        c, s = cos_sin_double(cycles - floor(cycles + 0.5))
        lr, li = narrow(c), narrow(s)
        for b in range(blocks):
            c, s = starts[b], starts[places.size + b]
            re, im = c * lr - s * li, c * li + s * lr
            store(out, at, zip_low(re, im))
            store(out, at + LANES, zip_high(re, im))
            at += 2 * LANES


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
