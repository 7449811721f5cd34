"""Paths as unit tones of a frame's chirps, and the sums of such tones against each other.

What a fit needs of two tones are sums of T' T* n^q g(t) over the samples n of a chirp and over the
chirps t of a transmit antenna, receiver by receiver. Over the samples they are closed form, and a
smooth function of the frequency between the tones. That frequency hardly changes over a frame, by
what the paths migrate: a few Chebyshev nodes hold it. So the chirps are gone through once for all
receivers, and the closed form is computed at the nodes instead of at every chirp and receiver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.jit import jit
from isac_rt.receive.arms import element_delays
from isac_rt.receive.known import Known

PARAMETERS = 4  # delay, delay rate, u_x, u_z
BY_PATH = "cycles", "frequency", "carrier", "middle", "delay"
TURNED = 1e-7
"""Share of a sum that the turn between receivers may leave where its next order is left out."""
EXACT = 1e-8
"""Of the largest sum, what the nodes leave."""


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
    """How sums over a chirp are added up.

    Attributes
    ----------
    factors : (I, M, P) complex, by which each chirp counts
    place : (M, P) int, the sum to which it belongs, of `places`: its transmit antenna, or itself
    places : A
    """

    factors: np.ndarray
    place: np.ndarray
    places: int

    @classmethod
    def by_antenna(cls, known: Known, factors: np.ndarray) -> Weights:
        """One sum for the chirps of each transmit antenna."""
        place = np.ascontiguousarray(known.schedule, np.int64)
        return cls(factors.astype(complex), place, known.antennas.num_tx)

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
    shape = len(pairs), powers, len(weights.factors), weights.places, tones.delay.shape[1]
    out = np.empty(shape, complex)
    if len(pairs):
        _cross(tones, np.asarray(pairs, np.int64), weights, out)
    return out


def own_sums(size: float, weights: Weights, powers: int = 3) -> np.ndarray:
    """(powers, I, A, 1) `cross_sums` of a tone with itself, for real factors."""
    total = np.zeros((weights.places, len(weights.factors)))
    each = weights.factors.real.reshape(len(weights.factors), -1)
    np.add.at(total, weights.place.ravel(), each.T)
    over = np.array([size, 0.0, size * (size**2 - 1) / 12])[:powers]
    return over[:, None, None, None] * total.T[..., None]


@jit(borrows=True)
def _nodes(reach):
    """Chebyshev nodes for sums over frequencies within `reach` cells of the middle one: they are
    band-limited to half a cycle a cell."""
    count, left = 1, np.pi * reach
    while left > EXACT and count < 64:
        count += 1
        left *= np.pi * reach / 2 / count
    return count


@jit(fast=True)
def _cross(tones, pairs, weights, out):
    factors, place, places = weights
    num_weights, num_groups, num_chirps = factors.shape
    for s in range(len(pairs)):
        k, j = pairs[s]
        low, high, wide = np.inf, -np.inf, 0.0
        for m in range(num_groups):
            for p in range(num_chirps):
                x = tones.frequency[j, m, p] - tones.frequency[k, m, p]
                low, high = min(low, x), max(high, x)
                wide = max(wide, abs(tones.carrier[k, m, p] - tones.middle[k]))
        middle, half = (low + high) / 2, max((high - low) / 2, 1e-30)
        count = _nodes(half * tones.size)
        wobble = 2 * np.pi * wide * np.abs(tones.delay[j] - tones.delay[k]).max()
        orders = 1 if wobble < TURNED else (2 if wobble * wobble / 2 < TURNED else 3)
        sums = np.zeros((orders, num_weights, places, count), np.complex128)
        level = np.empty(count)
        for m in range(num_groups):
            for p in range(num_chirps):
                turns = tones.cycles[j, m, p] - tones.cycles[k, m, p]
                angle = 2 * np.pi * (turns - np.floor(turns))
                turn = complex(np.cos(angle), np.sin(angle))
                x = (tones.frequency[j, m, p] - tones.frequency[k, m, p] - middle) / half
                level[0] = 1.0
                if count > 1:
                    level[1] = x
                for c in range(2, count):
                    level[c] = 2 * x * level[c - 1] - level[c - 2]
                a, z = place[m, p], tones.carrier[k, m, p] - tones.middle[k]
                for i in range(num_weights):
                    one = turn * factors[i, m, p]
                    for b in range(orders):
                        for c in range(count):
                            sums[b, i, a, c] += one * level[c]
                        one *= z
        _over_nodes(tones, (k, j), (middle, half), sums, out[s])


@jit(fast=True)
def _over_nodes(tones, pair, span, sums, out):
    """The sums over chirps for each Chebyshev polynomial of the frequency, brought together with
    the closed form at the nodes of each receiver."""
    k, j = pair
    middle, half = span
    powers, num_weights, places, num_rx = out.shape
    orders, count = sums.shape[0], sums.shape[3]
    value, shape = np.empty((3, count)), np.empty((3, count))
    for rx in range(num_rx):
        mine, other = tones.delay[k, rx], tones.delay[j, rx]
        ramp = (other - mine) * tones.slope * tones.interval
        for i in range(count):
            node = middle + half * np.cos(np.pi * (i + 0.5) / count)
            value[0, i], value[1, i], value[2, i] = closed_sums(node + ramp, tones.size)
        for c in range(count):
            share = (1.0 if c == 0 else 2.0) / count
            for q in range(powers):
                shape[q, c] = 0.0
            for i in range(count):
                at = share * np.cos(np.pi * c * (i + 0.5) / count)
                for q in range(powers):
                    shape[q, c] += at * value[q, i]
        turns = other * tones.middle[j] - mine * tones.middle[k]
        turns -= tones.slope * (other * other - mine * mine) / 2
        angle = 2 * np.pi * (turns - np.floor(turns))
        turn = complex(np.cos(angle), np.sin(angle))
        apart = 2 * np.pi * (other - mine)
        for i in range(num_weights):
            for a in range(places):
                for q in range(powers):
                    total = 0j
                    for c in range(count):
                        one = sums[0, i, a, c]
                        if orders > 1:
                            one += complex(0, apart) * sums[1, i, a, c]
                        if orders > 2:
                            one -= apart * apart / 2 * sums[2, i, a, c]
                        total += shape[q, c] * one
                    out[q, i, a, rx] = total * turn * (1j if q == 1 else 1.0)


@jit(inline=True)
def closed_sums(x, size):
    """Sums of exp(j 2 pi x n) times 1, -j n and n^2 over a chirp, n from its middle."""
    second = size * (size * size - 1) / 12
    if abs(x) < 1e-2 / size:  # the closed forms lose digits there
        y = 2 * np.pi * x
        fourth = second * (3 * size * size - 7) / 20
        return (
            size - second * y * y / 2,
            second * y - fourth * y * y * y / 6,
            second - fourth * y * y / 2,
        )
    s, k = np.sin(np.pi * size * x), np.cos(np.pi * size * x)
    t, u = np.sin(np.pi * x), np.cos(np.pi * x)
    edge = (size * k * t - s * u) / (t * t) / 2
    return s / t, -edge, u / t * edge - (1 - size * size) * s / t / 4
