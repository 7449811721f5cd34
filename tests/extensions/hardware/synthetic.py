"""Boards that are made up: samples by the equation of the beat, written as each format has them."""

from __future__ import annotations

import numpy as np
import scipy.io

C = 299_792_458.0


def channels(
    *,
    num_rx: int = 5,
    num_tx: int = 3,
    size: int = 128,
    slope: float = 61.3e12,
    rate: float = 9.1e6,
    distance: float = 4.37,
    level: float = 1000.0,
    noise: float = 0.0,
    leakage: float = 0.0,
    curvature: complex = 0.0,
    seed: int = 4,
):
    """Samples (N, L_rx, L_tx) of a point echo by a board with errors, and these errors.

    The equation: level g_r h_t (1 + b x) exp(2 pi j (f_b (n - middle)/f_s)), with beat f_b = slope
    times delay, x = -1 .. 1 over the sweep.
    """
    rng = np.random.default_rng(seed)

    def gains(count):
        level_db, phase = rng.normal(0, 0.8, count), rng.uniform(-np.pi, np.pi, count)
        return 10 ** (level_db / 20) * np.exp(1j * phase)

    g, h = gains(num_rx), gains(num_tx)
    d, e = rng.normal(0, 30e-12, num_rx), rng.normal(0, 30e-12, num_tx)
    d, e = d - d.mean(), e - e.mean()
    middle = np.arange(size) - (size - 1) / 2
    tau = 2 * distance / C + d[:, None] + e
    beat = np.exp(2j * np.pi * slope * tau * (middle / rate)[:, None, None])
    echo = level * g[:, None] * h * (1 + curvature * middle / (size / 2))[:, None, None] * beat
    shape = (size, num_rx, num_tx)
    white = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    near = rng.normal(size=shape[1:]) + 1j * rng.normal(size=shape[1:])
    near = leakage * near * np.exp(2j * np.pi * 2.1 / size * middle)[:, None, None]
    return echo + noise / np.sqrt(2) * white + near, (g, h, d, e)


def write_ti(file, samples, slope_mhz_per_us, rate=None, padding=5, **changes):
    """As TI's cascade calibration keeps a capture: zero-padded FFT under its Hann window."""
    size = len(samples)
    window = np.sin(np.pi * np.arange(1, size + 1) / (size + 1)) ** 2
    spectra = np.fft.fft(samples * window[:, None, None], padding * size, axis=0)
    params = {"Slope_MHzperus": float(slope_mhz_per_us)}
    if rate is not None:
        params["Sampling_Rate_sps"] = np.int32(rate)
    names = {"calibResult": {"Rx_fft": spectra, "RangeMat": np.ones((2, 3), np.uint16)}}
    scipy.io.savemat(file, names | {"params": params} | changes, do_compression=True)
