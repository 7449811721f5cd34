"""Paths as unit tones of a frame's chirps, and the sums of such tones against each other.

What a fit needs of two tones are sums of T' T* n^q g(t) over the samples n of a chirp and over the
chirps t of a transmit antenna, receiver by receiver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.kernels import receive_joint
from isac_rt.kernels.jit import twin_of
from isac_rt.receive.arms import element_delays
from isac_rt.receive.known import Known

PARAMETERS = 4  # delay, delay rate, u_x, u_z
BY_PATH = "cycles", "frequency", "carrier", "middle", "delay"


@dataclass(frozen=True)
class JointPath:
    """One path of the joint model.

    Attributes
    ----------
    delay, delay_rate : of the whole path at mid-frame [s, 1]
    direction : (2,) direction cosines u_x, u_z, of arrival at a PT, of both ways at the AT
    amplitude : (1,) complex of an echo; (L_tx,) at a PT, where the directions of departure are free
    std : (4,) standard deviations of delay, delay_rate, u_x, u_z by the curvature of the likelihood
    """

    delay: float
    delay_rate: float
    direction: np.ndarray
    amplitude: np.ndarray
    std: np.ndarray


def rate_bin(waveform: Waveform) -> float:
    """Delay rate of one Doppler bin."""
    return 1 / (waveform.frame_duration * waveform.effective_carrier)


def units(known: Known) -> np.ndarray:
    """(4,) steps of the scaled parameters: a cell of delay, a bin of delay rate, and 1 and 1."""
    return np.array([known.waveform.delay_step, rate_bin(known.waveform), 1.0, 1.0])


class Tones(NamedTuple):
    """Signals of unit amplitude of some paths, K.

    Attributes
    ----------
    cycles, frequency, carrier : (K, M, P) phase [cycles] and frequency [cycles per sample] at
        mid-chirp, and cycles per second of delay, for a receiver at the centroid
    middle : (K,) mean of the carrier
    delay : (K, L_rx) of the receivers
    slope, interval, size : of a chirp [Hz/s, s], and its number of samples
    """

    cycles: np.ndarray
    frequency: np.ndarray
    carrier: np.ndarray
    middle: np.ndarray
    delay: np.ndarray
    slope: float
    interval: float
    size: float

    @classmethod
    def of(cls, known: Known, paths: Sequence[JointPath]) -> tuple[Tones, np.ndarray]:
        """The tones of paths, and (K, 4, L_tx, L_rx) the change of their delay by each scaled
        parameter, by the rate at 1 s."""
        w, a, schedule = known.waveform, known.antennas, known.schedule
        delay, rate = (np.array([getattr(p, n) for p in paths]) for n in ("delay", "delay_rate"))
        direction = np.array([path.direction for path in paths])
        radius = known.radius(delay)[:, None]
        late, by_rx = element_delays(a.rx_positions, direction, radius)
        levers = np.ones((len(paths), PARAMETERS, a.num_tx, a.num_rx))
        levers[:, 2:] = by_rx.transpose(1, 0, 2)[:, :, None]
        ahead = np.zeros((len(paths), a.num_tx))
        if known.passes == 2:
            ahead, by_tx = element_delays(a.tx_positions, direction, radius)
            levers[:, 2:] += by_tx.transpose(1, 0, 2)[..., None]
        levers *= units(known)[:, None, None]
        delay, rate = delay[:, None, None], rate[:, None, None]
        tau = delay + rate * known.sampled_times + ahead[:, schedule]
        tau += known.delay_symbols * w.delay_step
        u = w.window_start + (w.num_samples - 1) / 2 * w.sample_interval
        carrier = w.carrier(tau, u)
        frequency = (rate * carrier + w.slope * tau) * w.sample_interval
        middle = carrier.mean(axis=(1, 2))
        chirp = w.slope, w.sample_interval, float(w.num_samples)
        return cls(w.phase(tau, u), frequency, carrier, middle, late, *chirp), levers

    def select(self, which: slice) -> Tones:
        """Some of the tones."""
        return self._replace(**{name: getattr(self, name)[which] for name in BY_PATH})

    def put(self, which: np.ndarray, tones: Tones) -> None:
        """Others in place of some, in place."""
        for name in BY_PATH:
            getattr(self, name)[which] = getattr(tones, name)


class Weights(NamedTuple):
    """Summation weights over a chirp.

    Attributes
    ----------
    factors : (I, M, P) complex, by which each chirp counts
    sum_index : (M, P) int, the sum to which it belongs, of `num_sums`: its transmit antenna,
        or itself
    num_sums : A
    """

    factors: np.ndarray
    sum_index: np.ndarray
    num_sums: int

    @classmethod
    def by_antenna(cls, known: Known, factors: np.ndarray) -> Weights:
        """One sum for the chirps of each transmit antenna."""
        sum_index = np.array(
            known.schedule, np.int64, order="C"
        )  # one that may be written, as others
        return cls(factors.astype(complex), sum_index, known.antennas.num_tx)

    @classmethod
    def by_chirp(cls, known: Known) -> Weights:
        """One sum for each chirp."""
        shape = known.schedule.shape
        number = np.arange(known.schedule.size).reshape(shape)
        return cls(np.ones((1, *shape), complex), number, known.schedule.size)


def powers_of_time(known: Known, count: int) -> Weights:
    """Chirps weighted by 1, t, t^2 .. [s^i], added up by transmit antenna."""
    times = known.sampled_times ** np.arange(count)[:, None, None]
    return Weights.by_antenna(known, times)


def cross_sums(tones: Tones, pairs: np.ndarray, weights: Weights, powers: int = 3) -> np.ndarray:
    """(Q, powers, I, A, L_rx) sums of n^q g_i T_j T_k*, for `pairs` (Q, 2) of k and j, n from the
    chirp's middle."""
    shape = len(pairs), powers, len(weights.factors), weights.num_sums, tones.delay.shape[1]
    out = np.empty(shape, complex)
    if len(pairs):
        fill_cross_sums(tones, np.asarray(pairs, np.int64), weights, out)
    return out


def own_sums(size: float, weights: Weights, powers: int = 3) -> np.ndarray:
    """(powers, I, A, 1) `cross_sums` of a tone with itself, for real factors."""
    total = np.zeros((weights.num_sums, len(weights.factors)))
    each = weights.factors.real.reshape(len(weights.factors), -1)
    np.add.at(total, weights.sum_index.ravel(), each.T)
    over = np.array([size, 0.0, size * (size**2 - 1) / 12])[:powers]
    return over[:, None, None, None] * total.T[..., None]


@twin_of(receive_joint.cross)
def fill_cross_sums(tones: Tones, pairs: np.ndarray, weights: Weights, out: np.ndarray) -> None:
    """Fill (Q, powers, I, A, L_rx) sums of n^q g_i T_j T_k* over the samples n of each chirp, from
    its middle, and over the chirps of each place, for `pairs` (Q, 2) of k and j."""
    t, size = tones, int(tones.size)
    n = np.arange(size) - (size - 1) / 2
    powers = n ** np.arange(out.shape[1])[:, None]
    for s, (k, j) in enumerate(pairs):
        cycles, frequency = t.cycles[j] - t.cycles[k], t.frequency[j] - t.frequency[k]
        wobble = t.carrier[k] - t.middle[k]
        for rx in range(out.shape[4]):
            mine, other = t.delay[k, rx], t.delay[j, rx]
            own = other * t.middle[j] - mine * t.middle[k] - t.slope * (other**2 - mine**2) / 2
            phase = cycles + own + (other - mine) * wobble
            beat = frequency + (other - mine) * t.slope * t.interval
            chirps = np.exp(2j * np.pi * beat[..., None] * n) @ powers.T  # (M, P, powers)
            chirps = chirps * np.exp(2j * np.pi * (phase % 1))[..., None]
            for a in range(weights.num_sums):
                here = weights.sum_index == a
                out[s, :, :, a, rx] = chirps[here].T @ weights.factors[:, here].T
