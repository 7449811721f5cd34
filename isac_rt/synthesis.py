r"""IF samples of a flat list of paths: the exact model and the direct kernel.

Cycles of the IF of one path (reference times conjugate of the received chirp), notes section 2:

.. math:: \Phi = f_c\tau + \alpha\tau\,(u - \tau/2)

with the delay tau counted from the reference chirp and u the time since its start. Every delay is float64 and every
phase is reduced to one cycle in float64; f_c t is never formed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from isac_rt.waveform import Waveform

FAST = {"contract", "nnan", "ninf", "nsz"}
"""Freedoms of the compiler that do not depend on the vector width."""
_BLOCK = 64  # samples between two restarts of the phasor recurrence; its error stays below 1e-13


@dataclass(frozen=True, kw_only=True)
class Tones:
    """K paths of Q links as plain arrays. Times are seconds since the middle of the frame.

    Attributes
    ----------
    link : (K,) int64
    factor : (K,) complex128, conj(path gain)
    delay, rate, accel : (K,) float64, the clock of the transmitter included
    begin, end : (K,) when the path lives
    tx_delay, rx_delay : (K, L_tx), (K, L_rx) what an element adds to the delay [s]
    cross_row : (K,) int64 row of `cross`
    cross : (R, L_tx, L_rx) joint part of the element delays [s]; row 0 is zero
    symbol_delay : (Q, M, P) delay of the data [s]
    send : (Q, M, P) complex128, amplitude times DPSK phase, zero where nothing is sent
    antenna : (Q, M, P) int64 transmit element
    """

    link: np.ndarray
    factor: np.ndarray
    delay: np.ndarray
    rate: np.ndarray
    accel: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    tx_delay: np.ndarray
    rx_delay: np.ndarray
    cross_row: np.ndarray
    cross: np.ndarray
    symbol_delay: np.ndarray
    send: np.ndarray
    antenna: np.ndarray

    def __len__(self) -> int:
        return self.delay.shape[0]

    def select(self, which: np.ndarray) -> Tones:
        """The paths that a mask or an index array chooses."""
        per_path = ("link", "factor", "delay", "rate", "accel", "begin", "end", "tx_delay", "rx_delay", "cross_row")
        return Tones(**{k: v[which] if k in per_path else v for k, v in vars(self).items()})


def filter_gain(beat: np.ndarray, sampling_rate: float, transition: float) -> np.ndarray:
    """Amplitude gain of the IF filter: 1 on [0, f_s], a raised-cosine skirt of width `transition` [Hz] on both sides."""
    outside = np.clip(np.maximum(-beat, beat - sampling_rate) / transition, 0.0, 1.0)
    return 0.5 + 0.5 * np.cos(np.pi * outside)


def exact(waveform: Waveform, tones: Tones, transition: float) -> np.ndarray:
    """The model itself in float64, path by path, sample by sample: the oracle of the faster methods.

    Returns
    -------
    samples : (M, L_rx, P, N) complex128

    Notes
    -----
    Temporary memory is a few (P, N) arrays. The gain of the filter follows the beat at the middle of each chirp, seen from
    the arrays' centroids; the filter's own transient is not modelled. Nor is the end of a chirp: at the edge of the skirt
    (a negative beat) the received chirp ends transition/slope before the window does, 0.7 samples for 0.4 MHz.
    """
    w, t = waveform, tones
    out = np.zeros((w.num_groups, t.rx_delay.shape[1], w.num_chirps, w.num_samples), np.complex128)
    for k in range(len(t)):
        q = t.link[k]
        for m in range(w.num_groups):
            time = w.chirp_time[m][:, None] - w.frame_duration / 2 + w.fast_time
            path = t.delay[k] + t.rate[k] * time + t.accel[k] * time**2 / 2
            alive = (time >= t.begin[k]) & (time < t.end[k])
            for source in range(w.num_groups):
                base = path + t.symbol_delay[q, source][:, None] - (m - source) * w.group_spacing
                passed = filter_gain(w.slope * base[:, w.num_samples // 2], w.sampling_rate, transition)
                weight = (t.factor[k] * t.send[q, source] * passed)[:, None] * alive
                if not weight.any():
                    continue
                antenna = t.antenna[q, source]
                for rx in range(out.shape[1]):
                    element = t.tx_delay[k, antenna] + t.rx_delay[k, rx] + t.cross[t.cross_row[k], antenna, rx]
                    tau = base + element[:, None]
                    cycles = (w.carrier_frequency * tau) % 1 + (w.slope * tau * (w.fast_time - tau / 2)) % 1
                    out[m, rx] += weight * np.exp(2j * np.pi * cycles)
    return out


def sources(waveform: Waveform, tones: Tones, transition: float) -> tuple[np.ndarray, np.ndarray]:
    """Which (path, offset = m - m') can pass the filter in some chirp: indices into `tones`, offsets. Both (C,) int64."""
    w, t = waveform, tones
    half = w.frame_duration / 2 + w.chirp_duration + w.num_groups * w.group_spacing
    motion = np.abs(t.rate) * half + np.abs(t.accel) * half**2 / 2
    longest = float(t.symbol_delay.max(initial=0.0))
    margin = transition / w.slope
    paths, offsets = [], []
    for offset in range(1 - w.num_groups, w.num_groups):
        delay = t.delay - offset * w.group_spacing
        passes = (delay + motion + longest >= -margin) & (delay - motion <= w.max_delay + margin)
        paths.append(np.flatnonzero(passes))
        offsets.append(np.full(paths[-1].size, offset))
    return np.concatenate(paths), np.concatenate(offsets).astype(np.int64)


def numbers(waveform: Waveform, transition: float) -> np.ndarray:
    """The waveform as a vector for the kernels; the order is that of `chirp_terms` and its callers."""
    w = waveform
    middle = w.fast_time[w.num_samples // 2]
    return np.array(
        [
            w.carrier_frequency,
            w.slope,
            w.sample_interval,
            middle,
            w.slot_duration,
            w.group_spacing,
            middle - w.frame_duration / 2,
            w.sampling_rate,
            transition,
        ]
    )


@njit(inline="always")
def chirp_terms(w, tau, rate, accel):
    """Start phase [cycles], frequency [cycles/sample] and quadratic term of a path about the middle sample.

    `tau`, `rate`: there, elements included. What is left out is cubic, below 1e-8 cycles for 10 m/s^2.
    """
    f_c, slope, ts, u = w[0], w[1], w[2], w[3]
    b = rate * ts
    a = accel * ts * ts / 2
    phase = f_c * tau + slope * tau * (u - tau / 2)
    frequency = (f_c + slope * (u - tau)) * b + slope * ts * tau
    quadratic = (f_c + slope * (u - tau)) * a + slope * b * (ts - b / 2)
    return phase - np.floor(phase), frequency, quadratic


@njit(inline="always")
def passed(w, tau):
    """Gain of the IF filter for the centroid's delay `tau`."""
    beat = w[1] * tau
    outside = max(-beat, beat - w[7]) / w[8]
    if outside <= 0.0:
        return 1.0
    if outside >= 1.0:
        return 0.0
    return 0.5 + 0.5 * np.cos(np.pi * outside)


@njit(nogil=True, fastmath=FAST, error_model="numpy")
def _rotation(step, bend, re, im):
    """re + j im = exp(j 2 pi (step i + bend i^2)) for i = 0, 1, ... by two recurrences."""
    zr, zi = 1.0, 0.0
    rr, ri = np.cos(2 * np.pi * (step + bend)), np.sin(2 * np.pi * (step + bend))
    dr, di = np.cos(4 * np.pi * bend), np.sin(4 * np.pi * bend)
    for i in range(re.shape[0]):
        re[i], im[i] = zr, zi
        zr, zi = zr * rr - zi * ri, zr * ri + zi * rr
        rr, ri = rr * dr - ri * di, rr * di + ri * dr


@njit(nogil=True, fastmath=FAST, error_model="numpy")
def _tone(sums, lane, half, amplitude, phase, frequency, quadratic):
    """Add amplitude exp(j 2 pi (phase + frequency x + quadratic x^2)), x = n - N/2, to `sums`.

    `sums` holds _BLOCK real parts, then their imaginary parts, block after block. Each block starts from a phase reduced
    in float64. `lane` is flat: the phasors inside a block (real, imaginary) and how they change from a block to the next.
    Constant lengths and offsets, and slices instead of sums of indices (which may be negative), let the compiler vectorise.
    """
    x = -half
    _rotation(frequency + 2 * quadratic * x, quadratic, lane[:_BLOCK], lane[_BLOCK : 2 * _BLOCK])
    for start in range(0, sums.shape[0], 2 * _BLOCK):
        cycles = phase + (frequency + quadratic * x) * x
        angle = 2 * np.pi * (cycles - np.floor(cycles))
        c, s = np.cos(angle), np.sin(angle)
        pr = amplitude.real * c - amplitude.imag * s
        pi = amplitude.real * s + amplitude.imag * c
        part = sums[start : start + 2 * _BLOCK]
        for i in range(_BLOCK):
            lr, li, tr, ti = lane[i], lane[_BLOCK + i], lane[2 * _BLOCK + i], lane[3 * _BLOCK + i]
            part[i] += pr * lr - pi * li
            part[_BLOCK + i] += pr * li + pi * lr
            lane[i] = lr * tr - li * ti
            lane[_BLOCK + i] = lr * ti + li * tr
        x += _BLOCK


@njit(nogil=True, fastmath=FAST, error_model="numpy")
def _flush(row, sums):
    """Add the sums of one chirp to its samples (2 N,) float32 and clear them."""
    for start in range(0, row.shape[0], 2 * _BLOCK):
        samples, part = row[start : start + 2 * _BLOCK], sums[start : start + 2 * _BLOCK]
        for i in range(samples.shape[0] // 2):
            samples[2 * i] += np.float32(part[i])
            samples[2 * i + 1] += np.float32(part[_BLOCK + i])
    sums[:] = 0.0


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _direct(out, w, path, offset, link, factor, delay, rate, accel, begin, end, tx, rx, row, cross, symbol, send, antenna):
    """Add the listed (path, group offset) to out (M, L_rx, P, 2 N) float32."""
    groups, num_rx, chirps, width = out.shape
    half = float(width // 2 // 2)
    sums = np.zeros((num_rx, 2 * _BLOCK * ((width // 2 + _BLOCK - 1) // _BLOCK)))
    lane = np.empty(4 * _BLOCK)
    for m in range(groups):
        for p in range(chirps):
            time = w[6] + p * w[4] + m * w[5]
            used = False
            for i in range(path.shape[0]):
                k, source = path[i], m - offset[i]
                if source < 0 or source >= groups or time < begin[k] or time >= end[k]:
                    continue
                q = link[k]
                tau = symbol[q, source, p] + delay[k] + (rate[k] + accel[k] * time / 2) * time - offset[i] * w[5]
                amplitude = factor[k] * send[q, source, p] * passed(w, tau)
                if amplitude == 0:
                    continue
                used = True
                a = antenna[q, source, p]
                speed = rate[k] + accel[k] * time
                bend = chirp_terms(w, tau, speed, accel[k])[2]
                _rotation(2 * bend * _BLOCK, 0.0, lane[2 * _BLOCK : 3 * _BLOCK], lane[3 * _BLOCK :])
                for r in range(num_rx):
                    element = tau + tx[k, a] + rx[k, r] + cross[row[k], a, r]
                    phase, frequency, quadratic = chirp_terms(w, element, speed, accel[k])
                    _tone(sums[r], lane, half, amplitude, phase, frequency, quadratic)
            if used:
                for r in range(num_rx):
                    _flush(out[m, r, p], sums[r])


def add_direct(samples: np.ndarray, waveform: Waveform, tones: Tones, transition: float) -> None:
    """Add paths one by one by phasor recurrences, every element with its own delay (wideband, spherical).

    Relative error against `exact` below 1e-6: the rounding of complex64. A path lives in whole chirps (it does where the
    middle of the window lies in its life). Runs in one thread without the interpreter's lock.

    Parameters
    ----------
    samples : (M, L_rx, P, N) complex64, contiguous, added to
    """
    path, offset = sources(waveform, tones, transition)
    if path.size == 0:
        return
    t = tones
    _direct(
        samples.view(np.float32),
        numbers(waveform, transition),
        path,
        offset,
        t.link,
        t.factor,
        t.delay,
        t.rate,
        t.accel,
        t.begin,
        t.end,
        t.tx_delay,
        t.rx_delay,
        t.cross_row,
        t.cross,
        t.symbol_delay,
        t.send,
        t.antenna,
    )
