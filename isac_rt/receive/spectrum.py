"""Range spectra of a frame with the data taken out: one FFT per chirp.

With a data delay tau_D = D / (alpha T) the tone of a path at cell f becomes (cycles, over sample n)

    (f + D) n/N  -  f s_D/N  +  [f_c tau_D + alpha (T~ - T) tau_D - alpha tau_D^2 / 2],      s_D = D f_s / (alpha T).

The bracket and the ramp D n/N do not depend on the path. The cross term does: it shifts the tone's time origin
by s_D samples (17 for the largest symbol of the paper's settings). So the window is laid s_D samples later, over the same
stretch of the shifted time for every symbol, and the spectrum's cell k is turned by exp(+j 2 pi k s_D/N) after
it is read at k + D. What remains is the unmodulated frame, at fractional cells too; the only error is the motion
during s_D samples: 2 pi f_c (dtau/dt) s_D / f_s, at most 0.04 rad at 15 m/s for an echo, different from chirp to chirp, which
spreads -60 dB of a path's power over the Doppler axis.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numba import njit

from isac_rt.ifsignal import IFCube
from isac_rt.waveform import Waveform


def window_length(waveform: Waveform) -> float:
    """Samples that the range window may cover, whatever the data: N less the largest time shift."""
    return waveform.num_samples - shift_of(waveform, waveform.num_delay_symbols)


def shift_of(waveform: Waveform, delay_symbol: np.ndarray | int) -> np.ndarray | float:
    """s_D, the data delay in samples."""
    return np.asarray(delay_symbol) * waveform.delay_step * waveform.sampling_rate


def hann(position: np.ndarray, length: float) -> np.ndarray:
    """Hann window of `length` samples that starts at 0, at any (fractional) position; 0 outside."""
    inside = (position >= 0) & (position <= length)
    return np.where(inside, np.sin(np.pi * position / length) ** 2, 0.0)


def data_phase(waveform: Waveform, delay_symbols: np.ndarray) -> np.ndarray:
    """f_c tau_D + alpha (T~ - T) tau_D - alpha tau_D^2/2 [cycles mod 1], float64."""
    w = waveform
    tau = np.asarray(delay_symbols) * w.delay_step
    return (w.carrier_frequency * tau) % 1.0 + (w.slope * tau * (w.window_start - tau / 2)) % 1.0


def clean_spectrum(cube: IFCube, delay_symbols: np.ndarray, phases: np.ndarray, num_rows: int) -> np.ndarray:
    """Hann-windowed range spectra without the data.

    Parameters
    ----------
    cube : IFCube
    delay_symbols : (M, P) int, as sent or as decided
    phases : (M, P) complex, beta^(D)
    num_rows : range cells wanted, from cell 0

    Returns
    -------
    spectra : (M, L_rx, num_rows, P) complex64; a path of unit amplitude at cell f gives
        sum_n w(n) exp(j 2 pi (f - k) n/N) times its phase at sample 0
    """
    w, samples = cube.waveform, cube.samples
    num_groups, num_rx, num_chirps, num_samples = samples.shape
    shift = shift_of(w, delay_symbols)
    out = np.empty((num_groups, num_rx, num_rows, num_chirps), np.complex64)
    for m in range(num_groups):
        window = hann(np.arange(num_samples)[None, :] - shift[m][:, None], window_length(w)).astype(np.float32)
        factor = phases[m].conj() * np.exp(-2j * np.pi * data_phase(w, delay_symbols[m]))
        step = np.exp(2j * np.pi * shift[m] / num_samples)
        for rx in range(num_rx):
            spectrum = scipy.fft.fft(samples[m, rx] * window, axis=1, workers=1, overwrite_x=True)
            _gather(spectrum, delay_symbols[m].astype(np.int64), factor, step, out[m, rx])
    return out


@njit(nogil=True, cache=True)
def _gather(spectrum, symbols, factor, step, out):  # pragma: no cover - compiled
    """out[k, p] = spectrum[p, (k + D_p) mod N] * factor_p * step_p^k."""
    num_rows, num_chirps = out.shape
    num_samples = spectrum.shape[1]
    for p in range(num_chirps):
        turn = factor[p]
        for k in range(num_rows):
            out[k, p] = np.complex64(spectrum[p, (k + symbols[p]) % num_samples] * turn)
            turn *= step[p]


def motion_floor(waveform: Waveform) -> float:
    """Largest share of a path's power in one Doppler bin that motion during the data's time shift leaves (module docstring).

    The phase error is uniform over 2 pi f_c (dtau/dt) s_D/f_s at the fastest unambiguous path; its variance spreads over P bins,
    with Hann's 3/2, and a bin exceeds ten times the mean of its few independent antennas once in thousands.
    """
    w = waveform
    fastest = 0.5 / (w.slot_duration * w.effective_carrier)
    span = 2 * np.pi * w.carrier_frequency * fastest * w.num_delay_symbols * w.delay_step
    return float(10 * 1.5 / w.num_chirps * span**2 / 12)
