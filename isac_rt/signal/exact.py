r"""The exact model: IF samples of paths in float64, path by path and sample by sample.

The IF signal is the reference chirp times the conjugate of the received one. Its phase for one
path, in cycles, is

.. math:: \Phi = f_c\tau + \alpha\tau\,(u - \tau/2)

with tau the delay from the reference chirp and u the time since its start. All delays are float64,
and phases are reduced to one cycle in float64; f_c t is never formed. `docs/signal.md` states the
model and its limits.
"""

from __future__ import annotations

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.signal.tones import Tones


def filter_gain(waveform: Waveform, beat: np.ndarray) -> np.ndarray:
    """Return the amplitude gain of the IF filter at `beat` [Hz]: 1 on [0, f_s], raised-cosine
    transitions of width `filter_transition` on both sides."""
    w = waveform
    outside = np.clip(np.maximum(-beat, beat - w.sampling_rate) / w.filter_transition, 0.0, 1.0)
    return 0.5 + 0.5 * np.cos(np.pi * outside)


def exact(waveform: Waveform, tones: Tones) -> np.ndarray:
    """Evaluate the model in float64, path by path and sample by sample, as the reference of the
    faster methods.

    Returns
    -------
    samples : (M, L_rx, P, N) complex128

    Notes
    -----
    The gain of the filter is that at the beat at mid-chirp between the arrays' centroids. Not
    modelled are its transient and the end of a received chirp with a negative beat, which lies up
    to transition/slope before the end of the window (0.7 samples for 0.4 MHz).
    """
    w, t = waveform, tones
    out = np.zeros((w.num_groups, t.rx_delay.shape[1], w.num_chirps, w.num_samples), np.complex128)
    for k in range(t.size):
        q = t.link[k]
        for m in range(w.num_groups):
            time = w.chirp_time[m][:, None] - w.frame_duration / 2 + w.fast_time
            # delay of the path at each sample, tau + tau' t + tau'' t^2/2, t from mid-frame
            path = t.delay[k] + t.rate[k] * time + t.accel[k] * time**2 / 2
            alive = (time >= t.begin[k]) & (time < t.end[k])
            for source in range(w.num_groups):
                # delay of transmit group `source`, sent m - source groups before the reference
                base = path + t.symbol_delay[q, source][:, None] - (m - source) * w.group_spacing
                passed = filter_gain(w, w.slope * base[:, w.num_samples // 2])
                weight = (t.factor[k] * t.send[q, source] * passed)[:, None] * alive
                if not weight.any():
                    continue
                antenna = t.antenna[q, source]
                if t.tx_gain.size:
                    weight = weight * t.tx_gain[k, antenna][:, None]
                for rx in range(out.shape[1]):
                    # from element to element, far field or spherical
                    element = (
                        t.tx_delay[k, antenna]
                        + t.rx_delay[k, rx]
                        + t.cross[t.cross_row[k], antenna, rx]
                    )
                    tau = base + element[:, None]
                    gain = t.rx_gain[k, rx] if t.rx_gain.size else 1.0
                    out[m, rx] += gain * weight * np.exp(2j * np.pi * w.phase(tau, w.fast_time))
    return out
