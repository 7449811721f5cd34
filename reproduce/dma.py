r"""Chirp-DMA as it is in hardware: chirps mixed at a rate that holds the neighbours' beats, then
low-pass filtered and decimated.

Resource blocks start 2 T_d apart, so that a neighbour of `spacing` blocks beats at 2 `spacing` f_s
and up to f_s above that, and the IF filter of [0, f_s] keeps it out. `ifsignal` has the filter as a
gain on every chirp's beat, which is exact for tones that last. Here the oscillators themselves are
multiplied: chirps begin and end inside the window, the filter rings, and what is left of a
neighbour in the band is what its edges leave. `tests/reproduce/test_dma.py` asserts the
following, for the paper's numbers with a skirt of 0.4 MHz and data on every chirp:

- the neighbours' power over the window is at least 47 dB down at 1, 53 dB at 2 and 56 dB at 3
  blocks, on both sides; it lies at the edges of chirps, so that in Hann-windowed range spectra the
  strongest cell is 85 dB down;
- the spacing of 2 T_d tolerates T_d of timing error towards each other, and any error away from
  each other until the next occupied block comes near: a chirp of the next block enters the band
  when it is early by T_d plus its delay, one of the block before when it is late by 2 T_d less its
  delay, and data and path together may fill T_d. The whole 2 T_d is tolerated only of the late
  chirp without delay.

Two active terminals in the same blocks are not separated by anything. A passive terminal decides
the stronger tone in every chirp: with the other 3 dB down its delay SER is 0, with the other 3 dB
up it is 1 (the frame is erased, because the other one does not move as predicted). In a frame
without data the other one is one more detection, a ghost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from isac_rt.frame.waveform import Waveform

OVERSAMPLING = 32
"""Samples of the mixer's output per IF sample: beats within +-16 f_s, seven blocks to either
side."""


@dataclass(frozen=True)
class Isolation:
    """Attenuation of a neighbour by mixing and filtering.

    Attributes
    ----------
    spacing : blocks by which the neighbour's chirps start later than the reference
    power_db : power over the window, same block and no error over this neighbour
    peak_db : the strongest cell of its Hann-windowed range spectra against that of the same chirps
        in the same block
    """

    spacing: int
    power_db: float
    peak_db: float


def raised_cosine(time: np.ndarray, sampling_rate: float, transition: float) -> np.ndarray:
    """Impulse response [1/s] of the IF filter: gain 1 on [0, f_s], raised-cosine skirts of width
    `transition` outside.

    Linear phase; its constant delay is taken out. Closed form of the Fourier integral, written with
    two sincs so that it has no pole.
    """
    x = 2 * transition * time
    # cos(pi x/2)/(1 - x^2) = (pi/4) (sinc((x+1)/2) + sinc((x-1)/2))
    roll = np.pi / 4 * (np.sinc((x + 1) / 2) + np.sinc((x - 1) / 2))
    width = sampling_rate + transition
    return (
        width * np.sinc(width * time) * roll * np.exp(1j * np.pi * ((sampling_rate * time) % 2.0))
    )


def mix(
    waveform: Waveform,
    delay: np.ndarray,
    amplitude: np.ndarray,
    *,
    rate: float = 0.0,
    oversampling: int = OVERSAMPLING,
) -> np.ndarray:
    r"""IF samples of C reference chirps with the chirps that arrive, by multiplying oscillators and
    filtering.

    .. math::

        x(u) = \sum_k a_k\, e^{j2\pi[\varphi(u) - \varphi(u - \tau_k)]},\quad \varphi(s) = f_c s +
        \alpha s^2/2,\ 0 \le s < \tilde T

    Parameters
    ----------
    delay : (K, C) from the start of the reference to that of an arriving chirp, as seen at its
        start: data, path, clock and 2 T_d per block together, of either sign [s]
    amplitude : (K, C) complex, as it is in the IF (conjugate of what arrives)
    rate : of the delays
    oversampling : samples of the mixer per IF sample

    Returns
    -------
    samples : (C, N) complex128, at the instants of `Waveform.fast_time`
    """
    w = waveform
    lead = int(np.ceil(w.window_start / w.sample_interval))
    step = w.sample_interval / oversampling
    u = (
        w.window_start
        + (np.arange((lead + w.num_samples) * oversampling) - lead * oversampling) * step
    )
    taps = np.arange(-u.size, u.size + 1) * step
    size = scipy.fft.next_fast_len(3 * u.size + 1)
    response = scipy.fft.fft(raised_cosine(taps, w.sampling_rate, w.filter_transition) * step, size)
    out = np.empty((delay.shape[1], w.num_samples), np.complex128)
    for c in range(delay.shape[1]):
        product = np.zeros(u.size, np.complex128)
        for tau, a in zip(delay[:, c], amplitude[:, c], strict=True):
            since = u - tau - rate * u
            cycles = (_oscillator(w, u) - _oscillator(w, since)) % 1.0
            product += (
                a
                * _open(u, w.chirp_duration, step)
                * _open(since, w.chirp_duration, step)
                * np.exp(2j * np.pi * cycles)
            )
        filtered = scipy.fft.ifft(scipy.fft.fft(product, size) * response)[u.size :]
        out[c] = filtered[
            lead * oversampling : (lead + w.num_samples) * oversampling : oversampling
        ]
    return out


def _oscillator(waveform: Waveform, since: np.ndarray) -> np.ndarray:
    """Cycles of a chirp since its own start; times within a slot keep 1e-9 cycles in float64."""
    return waveform.carrier_frequency * since + waveform.slope * since * since / 2


def _open(since: np.ndarray, duration: float, step: float) -> np.ndarray:
    """Share of the sample interval around `since` in which a chirp of this duration is on: its
    edges lie between samples."""
    return np.clip(np.minimum(since, duration - since) / step + 0.5, 0.0, 1.0)


def isolation(
    waveform: Waveform,
    spacing: int,
    timing_error: float,
    rng: np.random.Generator,
    *,
    chirps: int = 24,
    path_cells: float | None = None,
    modulated: bool = True,
    oversampling: int = OVERSAMPLING,
) -> Isolation:
    """Isolation from the block `spacing` later (earlier if negative), averaged over chirps.

    Parameters
    ----------
    timing_error : of the neighbour, positive when late [s]
    path_cells : its path delay in range cells; None: uniform over the first half of the range,
        which data and path share
    modulated : whether uniform data are on its chirps
    """
    w = waveform
    path = (
        rng.uniform(0, w.num_delay_symbols, chirps)
        if path_cells is None
        else np.full(chirps, path_cells)
    )
    symbol = rng.integers(0, w.num_delay_symbols, chirps) if modulated else np.zeros(chirps)
    delay = (path + symbol) * w.delay_step
    amplitude = np.exp(2j * np.pi * rng.random((1, chirps)))
    own = mix(w, delay[None], amplitude, oversampling=oversampling)
    moved = delay + spacing * w.group_spacing + timing_error
    other = mix(w, moved[None], amplitude, oversampling=oversampling)
    return Isolation(
        spacing=spacing,
        power_db=_ratio_db(_power(own), _power(other)),
        peak_db=_ratio_db(_peak(own), _peak(other)),
    )


def _power(samples: np.ndarray) -> float:
    return float((np.abs(samples) ** 2).mean())


def _peak(samples: np.ndarray) -> float:
    spectra = scipy.fft.fft(samples * np.hanning(samples.shape[1]), axis=1)
    return float((np.abs(spectra) ** 2).max(axis=1).mean())


def _ratio_db(over: float, under: float) -> float:
    return float(10 * np.log10(over / under))
