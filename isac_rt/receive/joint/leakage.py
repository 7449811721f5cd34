"""Coupling of an active terminal's transmitter into its own receivers, as a path of the joint fit.

A tone that no window tapers has sidelobes that fall with the distance alone: a coupling 60 dB over
an echo buries it 100 cells on. Every pair of a transmit and a receive antenna couples by a path of
its own, at rest: it has an amplitude and a delay. These are the least squares of the samples, and
what they explain is taken out before the echoes are fitted.

With tau_0 a delay common to all pairs and delta a pair's own beyond it, the signal of a chirp is

    a T(tau_0) exp(j phi x),    phi = 2 pi delta / (cell of delay),    x = (u - tau_D) / T - middle,

so that the sums of s T* x^q over a pair's samples hold all that its fit asks for.
"""

from __future__ import annotations

from collections.abc import Callable
from math import factorial

import numpy as np

from isac_rt.receive.known import Known

STEP = 0.5
"""Spacing of the delays tried [cells]."""
ORDERS = 7
"""Powers of x that hold a pair's own delay: within 0.1 cell of the common one they leave 1e-7 of
the coupling."""
ITERATIONS = 3
MIN_COUPLING = 10.0
"""Energy of a pair's coupling over the noise, in the mean of all pairs, from which on it is taken
out: below, its sidelobes are under the noise."""

Shapes = Callable[[np.ndarray], np.ndarray]
"""From x (P, N) to the factors of T(tau_0) (P, Q, N)."""


def without_leakage(
    samples: np.ndarray, known: Known, noise: float, max_range: float
) -> np.ndarray:
    """Return the samples without the coupling of the transmit antennas into the receivers, or the
    same samples where they show none.

    Parameters
    ----------
    samples : (M, L_rx, P, N) of a frame at the terminal that sent it
    known : Known
    noise : power of a sample
    max_range : farthest range of the coupling [m], one way
    """
    cells = np.arange(0.0, max_range / known.range_cell + STEP / 2, STEP)
    exponent = 2j * np.pi * cells[:, None]
    sums = _sums(samples, known, 0.0, lambda x: np.exp(exponent * x[:, None]))
    counts = np.array([mine.sum() for mine in known.sent_by]) * known.waveform.num_samples
    energy = (np.abs(sums) ** 2 / counts[:, None, None]).sum(axis=(0, 1)) / noise
    best = int(energy.argmax())
    if energy[best] < MIN_COUPLING * known.channels:
        return samples
    delay = cells[best] * known.waveform.delay_step
    amplitude, own = _fit(known, _sums(samples, known, delay, _powers))
    weight = np.abs(amplitude) ** 2
    common = float((weight * own).sum() / weight.sum())
    delay += common / (2 * np.pi) * known.waveform.delay_step
    return _subtracted(samples, known, delay, *_fit(known, _sums(samples, known, delay, _powers)))


def _powers(x: np.ndarray) -> np.ndarray:
    """(P, ORDERS, N) powers of x."""
    out = np.ones((len(x), ORDERS, x.shape[1]))
    for q in range(1, ORDERS):
        np.multiply(out[:, q - 1], x, out=out[:, q])
    return out


def _tones(known: Known, delay: float, group: int) -> np.ndarray:
    """(P, N) the signal of a path of some delay at rest in the chirps of a group."""
    w = known.waveform
    cycles = w.phase(_data_delays(known, group) + delay, w.fast_time)
    return np.asarray(known.phases[group][:, None] * np.exp(2j * np.pi * (cycles % 1)))


def _times(known: Known, group: int) -> np.ndarray:
    """(P, N) x of the samples of a group."""
    w = known.waveform
    middle = float(w.fast_time.mean() / w.sampled_duration)
    return (w.fast_time - _data_delays(known, group)) / w.sampled_duration - middle


def _data_delays(known: Known, group: int) -> np.ndarray:
    """(P, 1) delays that carry the data of a group's chirps [s]."""
    return known.delay_symbols[group][:, None] * known.waveform.delay_step


def _sums(samples: np.ndarray, known: Known, delay: float, shapes: Shapes) -> np.ndarray:
    """(L_tx, L_rx, Q) sums of s T* g* over the samples of each pair, for the factors g."""
    out: np.ndarray | float = 0.0
    for group, (mine, schedule) in enumerate(zip(samples, known.schedule, strict=True)):
        factors = shapes(_times(known, group))
        design = (_tones(known, delay, group)[:, None] * factors).conj().astype(np.complex64)
        products = mine.swapaxes(0, 1) @ design.swapaxes(1, 2)  # chirp, receiver, factor
        sent = schedule == np.arange(known.antennas.num_tx)[:, None]
        out = out + np.einsum("ap,prq->arq", sent, products.astype(complex))
    return np.asarray(out)


def _fit(known: Known, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(L_tx, L_rx) amplitude and phi of every pair, by Gauss-Newton from phi = 0."""
    x = [_times(known, group) for group in range(len(known.schedule))]
    times = [
        np.concatenate([a[s == tx] for a, s in zip(x, known.schedule, strict=True)])
        for tx in range(known.antennas.num_tx)
    ]
    count, first, second = np.array([[(a**q).sum() for a in times] for q in range(3)])[..., None]
    phi = np.zeros(sums.shape[:2])
    for _ in range(ITERATIONS):
        back = _series(-phi)
        zeroth = (back[..., :-1] * sums[..., :-1]).sum(axis=-1)
        slant = (back[..., :-1] * sums[..., 1:]).sum(axis=-1)
        amplitude = zeroth / count
        slope = (amplitude.conj() * (slant - amplitude * first)).imag
        curvature = np.abs(amplitude) ** 2 * (second - first**2 / count)
        phi = np.clip(
            phi + slope / np.maximum(curvature, 1e-300), -2 * np.pi * STEP, 2 * np.pi * STEP
        )
    return (_series(-phi)[..., :-1] * sums[..., :-1]).sum(axis=-1) / count, phi


def _series(phi: np.ndarray) -> np.ndarray:
    """(..., ORDERS) coefficients of exp(j phi x) by the powers of x."""
    orders = np.arange(ORDERS)
    return (1j * phi[..., None]) ** orders / np.array([factorial(q) for q in orders])


def _subtracted(
    samples: np.ndarray, known: Known, delay: float, amplitude: np.ndarray, phi: np.ndarray
) -> np.ndarray:
    """The samples less a coupling of every pair."""
    out = np.empty_like(samples)
    weights = amplitude[..., None] * _series(phi)
    for group, schedule in enumerate(known.schedule):
        factors = _powers(_times(known, group))
        design = (_tones(known, delay, group)[:, None] * factors).astype(np.complex64)
        model = weights[schedule].astype(np.complex64) @ design
        np.subtract(samples[group], model.swapaxes(0, 1), out=out[group])
    return out
