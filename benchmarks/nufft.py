"""The gridded method's job by a library: one type-1 transform of finufft [1]_ per chirp.

The receive elements only turn the phase, as in the narrowband settings of the gridded method; a
second set of strengths carries the quadratic phase of motion, so that 30 vectors are transformed.

References
----------
.. [1] A. Barnett, J. Magland, L. af Klinteberg, "A parallel nonuniform fast Fourier transform
   library based on an exponential of semicircle kernel", SIAM J. Sci. Comput. 41(5), 2019
"""

from __future__ import annotations

import importlib.util

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.signal.exact import filter_gain
from isac_rt.signal.tones import Tones

NAME = "finufft narrowband, type 1, tolerance 1e-4"
TOLERANCE = 1e-4


def missing() -> str | None:
    """Why the row is left out, in words; None where it can be measured."""
    if importlib.util.find_spec("finufft") is not None:
        return None
    return "finufft is not installed; pip install isac_rt[bench]"


def by_finufft(waveform: Waveform, tones: Tones) -> np.ndarray:
    """Samples (M, L_rx, P, N) complex64 of paths that live for the whole frame."""
    import finufft

    w, t, half = waveform, tones, waveform.num_samples // 2
    middle, step = w.fast_time[half], w.sample_interval
    square = ((np.arange(w.num_samples) - half) / half) ** 2
    centre = square.mean()
    num_rx = t.rx_delay.shape[1]
    steer = np.exp(2j * np.pi * w.phase(t.rx_delay, middle)).T
    out = np.zeros((w.num_groups, num_rx, w.num_chirps, w.num_samples), np.complex64)
    for m, source, p in np.ndindex(w.num_groups, w.num_groups, w.num_chirps):
        time = w.chirp_time[m, p] + middle - w.frame_duration / 2
        late = t.symbol_delay[t.link, source, p] + (source - m) * w.group_spacing
        whole = t.delay + (t.rate + t.accel * time / 2) * time + late
        strength = t.factor * t.send[t.link, source, p] * filter_gain(w, w.slope * whole)
        loud = np.flatnonzero(strength)
        if not loud.size:
            continue
        antenna = t.antenna[t.link[loud], source, p]
        delay, rate = (
            whole[loud] + t.tx_delay[loud, antenna],
            (t.rate + t.accel * time)[loud],
        )
        carrier, beat = w.carrier(delay, middle), w.slope * delay
        frequency = (carrier * rate + beat) * step % 1.0
        bend = carrier * t.accel[loud] / 2 + w.slope * rate * (1 - rate / 2)
        bow = 2 * np.pi * bend * (step * half) ** 2
        turned = strength[loud] * np.exp(2j * np.pi * w.phase(delay, middle) + 1j * bow * centre)
        one = turned * steer[:, loud]
        sums = finufft.nufft1d1(
            (2 * np.pi * frequency).astype(np.float32),
            np.ascontiguousarray(np.concatenate([one, 1j * bow * one]), np.complex64),
            w.num_samples,
            eps=TOLERANCE,
            isign=1,
            nthreads=1,
        )
        out[m, :, p] += sums[:num_rx] + (square - centre) * sums[num_rx:]
    return out
