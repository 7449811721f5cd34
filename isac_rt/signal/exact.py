r"""The exact model: IF samples of paths in float64, path by path and sample by sample.

Cycles of the IF of one path (reference times conjugate of the received chirp), notes section 2:

.. math:: \Phi = f_c\tau + \alpha\tau\,(u - \tau/2)

with the delay tau counted from the reference chirp and u the time since its start. Every delay is
float64 and every phase is reduced to one cycle in float64; f_c t is never formed.
"""

from __future__ import annotations

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.signal.tones import Tones


def filter_gain(waveform: Waveform, beat: np.ndarray) -> np.ndarray:
    """Amplitude gain of the IF filter at `beat` [Hz]: 1 on [0, f_s], a raised-cosine skirt of width
    `filter_transition` on both sides."""
    w = waveform
    outside = np.clip(np.maximum(-beat, beat - w.sampling_rate) / w.filter_transition, 0.0, 1.0)
    return 0.5 + 0.5 * np.cos(np.pi * outside)


def exact(waveform: Waveform, tones: Tones) -> np.ndarray:
    """The model itself in float64, path by path, sample by sample: the oracle of the faster
    methods.

    Returns
    -------
    samples : (M, L_rx, P, N) complex128

    Notes
    -----
    Temporary memory is a few (P, N) arrays. The gain of the filter follows the beat at the middle
    of each chirp, seen from the arrays' centroids; the filter's own transient is not modelled. Nor
    is the end of a chirp: at the edge of the skirt (a negative beat) the received chirp ends
    transition/slope before the window does, 0.7 samples for 0.4 MHz.
    """
    w, t = waveform, tones
    out = np.zeros((w.num_groups, t.rx_delay.shape[1], w.num_chirps, w.num_samples), np.complex128)
    for k in range(t.size):
        q = t.link[k]
        for m in range(w.num_groups):
            time = w.chirp_time[m][:, None] - w.frame_duration / 2 + w.fast_time
            path = t.delay[k] + t.rate[k] * time + t.accel[k] * time**2 / 2
            alive = (time >= t.begin[k]) & (time < t.end[k])
            for source in range(w.num_groups):
                base = path + t.symbol_delay[q, source][:, None] - (m - source) * w.group_spacing
                passed = filter_gain(w, w.slope * base[:, w.num_samples // 2])
                weight = (t.factor[k] * t.send[q, source] * passed)[:, None] * alive
                if not weight.any():
                    continue
                antenna = t.antenna[q, source]
                if t.tx_gain.size:
                    weight = weight * t.tx_gain[k, antenna][:, None]
                for rx in range(out.shape[1]):
                    element = (
                        t.tx_delay[k, antenna]
                        + t.rx_delay[k, rx]
                        + t.cross[t.cross_row[k], antenna, rx]
                    )
                    tau = base + element[:, None]
                    own = t.rx_gain[k, rx] if t.rx_gain.size else 1.0
                    out[m, rx] += own * weight * np.exp(2j * np.pi * w.phase(tau, w.fast_time))
    return out
