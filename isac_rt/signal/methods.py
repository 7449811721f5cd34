"""Methods of IF synthesis: each is a value that turns tones and noise into samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.kernels import signal_direct, signal_gridded
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.signal_below_noise import below_noise_error
from isac_rt.kernels.signal_gridded import GRIDDED_ERROR, OVERSAMPLING, WIDTH, grid_size
from isac_rt.kernels.vector import LANES, new_memory
from isac_rt.propagation.clutter.merging import resolution_cell
from isac_rt.signal.exact import exact, filter_gain
from isac_rt.signal.noise import SILENCE, WhiteNoise
from isac_rt.signal.tones import Tones


def separable(waveform: Waveform, tones: Tones) -> np.ndarray:
    r"""Return samples (M, L_rx, P, N) complex128 by the paper's separable model, which its
    receivers assume: no reception between groups, paths that last for the whole frame.

    .. math::

        \beta_p\,\bar g\,e^{j2\pi f_c(\tau_0 + \tau_l)}\,e^{j2\pi n(f_\tau + f_D[p])/N}\,e^{j2\pi
        f_c\dot\tau p\bar T}

    with tau_0 the delay at the frame's start, f_tau = alpha T tau_0 and f_D the data in range
    cells, tau_l the elements' delays at the carrier alone. Omitted are Doppler within a chirp,
    range migration, the time offsets of groups, the elements' delay of the modulation, and the
    phase terms of the data delay. The relative RMS error against the exact model is 0.042 at 0.5
    m/s and 0.91 at 15 m/s for an echo, and 1 with data.
    """
    w, t = waveform, tones
    start = t.delay - t.rate * w.frame_duration / 2
    fast = np.arange(w.num_samples) * w.sample_interval
    slots = np.arange(w.num_chirps) * w.slot_duration
    out = np.zeros((w.num_groups, t.rx_delay.shape[1], w.num_chirps, w.num_samples), np.complex128)
    for k in range(t.size):
        q = t.link[k]
        for m in range(w.num_groups):
            with_data = start[k] + t.symbol_delay[q, m]  # tau_0 and data delay of each chirp
            weight = t.factor[k] * t.send[q, m] * filter_gain(w, w.slope * with_data)
            # slow time: carrier phase of tau_0, of the transmit element and of the Doppler
            carrier = (
                w.carrier_frequency
                * (start[k] + t.tx_delay[k, t.antenna[q, m]] + t.rate[k] * slots)
            ) % 1
            # fast time: beat frequency, f_tau + f_D
            beat = (
                np.exp(2j * np.pi * ((w.slope * with_data[:, None] * fast) % 1))
                * (weight * np.exp(2j * np.pi * carrier))[:, None]
            )
            out[m] += np.exp(2j * np.pi * w.carrier_frequency * t.rx_delay[k])[:, None, None] * beat
    return out


ERROR_AT_REST, ERROR_PER_SPEED = 5e-5, 1e-6
"""Bound of the relative RMS error of a gridded path at rest, and its increase per m/s of c/2 times
the delay rate; up to direction cosines of 0.87 and 640 MHz (tests/signal/test_gridding.py)."""
GRID_PATHS = 150
"""Paths times blocks of 16 receive elements up to which direct sums are faster than the grid (100
to 250 by processor)."""
MAX_CELLS = 1 << 24
"""Largest span of range-Doppler cells held in one array, a hundred times that of a link. Clocks
that differ by a second span 10^11 cells, which are then numbered."""


@dataclass(frozen=True)
class Exact:
    """Synthesis by a float64 sum per path and sample: the reference of the fast methods.

    Examples
    --------
    >>> import numpy as np
    >>> import isac_rt as irt
    >>> setup = irt.prepare(irt.load("scenes/paper_swarm_consistent.yaml"))
    >>> frame = setup.frame(0)
    >>> links = [(frame.sent["AT"], frame.paths["AT", "PT1"])]
    >>> ear = irt.ReceiveArray(frame.poses["PT1"], setup.antennas)
    >>> at = irt.Reference(setup.timetable.start_time(0, "AT"))
    >>> exact, fast = (
    ...     irt.if_signal(setup.waveform, links, ear, at, method).samples
    ...     for method in (irt.Exact(), irt.Direct())
    ... )
    >>> bool(np.linalg.norm(fast - exact) < 1e-6 * np.linalg.norm(exact))
    True
    """

    name: ClassVar[str] = "exact"

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        samples = exact(waveform, tones).astype(np.complex64)
        noise.add_to(samples)
        return samples


@dataclass(frozen=True)
class Separable:
    """The paper's separable model, for comparison (`separable`)."""

    name: ClassVar[str] = "paper"

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        samples = separable(waveform, tones).astype(np.complex64)
        noise.add_to(samples)
        return samples


@dataclass(frozen=True)
class Direct:
    """Synthesis path by path in float32 sums: relative error 1e-6, time proportional to the number
    of paths."""

    name: ClassVar[str] = "direct"

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        every = np.ones(tones.size, bool)
        return _made(waveform, tones, noise, every, ~every)


@dataclass(frozen=True)
class Gridded:
    """Synthesis by a non-uniform FFT over a grid of beat frequencies, for many paths: relative
    error `GRIDDED_ERROR`, or with `faint` that of below-noise paths
    (`isac_rt.kernels.signal_below_noise.below_noise_error`)."""

    name: ClassVar[str] = "gridded"
    faint: bool = False

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        none = np.zeros(tones.size, bool)
        return _made(waveform, tones, noise, none, none | self.faint)


@dataclass(frozen=True)
class Auto:
    """Synthesis by a method for each path: `Direct` for few paths, else `Gridded` for most.

    Paths that exist for half a frame at most are direct. Of many others `Direct` takes

    - lines of sight, whose joint curvature the grid omits;
    - paths too fast for `GRIDDED_ERROR`;
    - the `max_direct` strongest of the paths whose error, integrated coherently over the cube,
      could exceed the noise of a cell: power error^2 size > noise_power.

    Below-noise paths take a faster grid with a larger error. Integrated coherently and summed over
    a range-Doppler cell, that error stays below `below_noise` times the noise.

    Attributes
    ----------
    noise_power : per complex sample [W]; with 0 the `max_direct` strongest paths are direct
    max_direct : largest number of paths that are direct for their power
    below_noise : largest error of below-noise paths relative to the noise of a cell of all elements
        and chirps; 0: no path is below noise
    """

    name: ClassVar[str] = "auto"
    noise_power: float = 0.0
    max_direct: int = 16
    below_noise: float = 0.0

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        return _made(waveform, tones, noise, *self.choose(waveform, tones))

    def choose(self, waveform: Waveform, tones: Tones) -> tuple[np.ndarray, np.ndarray]:
        """Mark the paths for `Direct`, and the below-noise paths among the others: (K,) bool
        each."""
        brief = signal_direct.lives_briefly(waveform, tones)
        if brief.any():
            alone, faint = brief.copy(), np.zeros(tones.size, bool)
            alone[~brief], faint[~brief] = self.choose(waveform, tones.select(~brief))
            return alone, faint
        every, elements = np.ones(tones.size, bool), tones.rx_delay.shape[1]
        # paths whose gridded error could exceed the noise
        size = float(np.prod(_shape(waveform, tones)))
        error = ERROR_AT_REST + ERROR_PER_SPEED * tones.speed(waveform.frame_duration)
        strong = tones.power * error**2 * size > self.noise_power
        faint = ~every
        if self.below_noise and tones.size:
            limit = self.below_noise * self.noise_power / size
            faint = ~tones.is_los & _below_noise(waveform, tones, limit)
        top = _strongest(tones.power, self.max_direct)
        alone = ~faint & ((strong & top) | tones.is_los | (error > GRIDDED_ERROR))
        if (~alone).sum() * elements <= GRID_PATHS * -(-elements // LANES):
            return every, ~every
        return alone, faint


Method = Exact | Direct | Gridded | Auto | Separable


def _strongest(power: np.ndarray, count: int) -> np.ndarray:
    """Mark the `count` largest powers (K,), the first of equal ones."""
    out = np.zeros(power.size, bool)
    out[np.argsort(-power, kind="stable")[:count]] = True
    return out


def _shape(waveform: Waveform, tones: Tones) -> tuple[int, ...]:
    w = waveform
    return w.num_groups, tones.rx_delay.shape[1], w.num_chirps, w.num_samples


def _below_noise(waveform: Waveform, tones: Tones, limit: float) -> np.ndarray:
    """Mark the below-noise paths (K,): the error power of all paths of their range-Doppler cell
    stays within `limit` [W]."""
    error = below_noise_error(waveform, tones, grid_size(waveform.num_samples, OVERSAMPLING, WIDTH))
    cell = resolution_cell(waveform, tones.delay, tones.rate)
    number = cell - cell.min()
    if number.max() > MAX_CELLS:
        number = np.unique(number, return_inverse=True)[1]
    return np.bincount(number, tones.power * error**2)[number] <= limit


def _fast(
    samples: np.ndarray,
    waveform: Waveform,
    tones: Tones,
    noise: WhiteNoise,
    alone: np.ndarray,
    faint: np.ndarray,
) -> None:
    """`add_up` by the kernels."""
    strong, rest = tones.select(alone), tones.select(~alone)
    if rest.sources(waveform)[0].size:
        signal_gridded.make_gridded(samples, waveform, rest, faint[~alone], strong, noise.numbers)
    else:
        signal_direct.add_direct(samples, waveform, strong, fresh=True)
        noise.add_to(samples)


@twin_of(_fast)
def add_up(
    samples: np.ndarray,
    waveform: Waveform,
    tones: Tones,
    noise: WhiteNoise,
    alone: np.ndarray,
    faint: np.ndarray,
) -> None:
    """Write the sum of all tones and the noise to samples (M, L_rx, P, N). The masks `alone` and
    `faint` (K,) of `Auto.choose` matter to the kernels alone.

    The phase f_c tau + alpha tau (u - tau/2) of `exact` is expanded about the middle of each chirp
    to phase + step n + curvature n^2. With n = a + b, a in steps of 32, a sample is the product
    of a coarse tone in a and a fine tone in b, and of 1 + j 4 pi curvature a b for the mixed term.
    """
    w, t, half = waveform, tones, waveform.num_samples // 2
    ts, u, a, b = w.sample_interval, w.fast_time[half], np.arange(-half, half, 32), np.arange(32)
    samples[:] = 0
    for m, p, source in np.ndindex(w.num_groups, w.num_chirps, w.num_groups):
        # delay and delay rate at mid-chirp, amplitude; paths that exist and pass the filter
        time = w.chirp_time[m, p] + u - w.frame_duration / 2
        rate, symbol = t.rate + t.accel * time, t.symbol_delay[t.link, source, p]
        base = t.delay + (rate + t.rate) / 2 * time + symbol - (m - source) * w.group_spacing
        weight = t.factor * t.send[t.link, source, p] * filter_gain(w, w.slope * base)
        k = np.flatnonzero(weight * ((t.begin <= time) & (time < t.end)))
        tx, rho, accel = t.antenna[t.link[k], source, p], rate[k], t.accel[k]
        weight = weight[k] * (t.tx_gain[k, tx] if t.tx_gain.size else 1.0)
        for rx in range(samples.shape[1] if k.size else 0):
            # phase [cycles], its step and its curvature per sample
            joint = t.cross[t.cross_row[k], tx, rx]
            tau = base[k] + t.tx_delay[k, tx] + t.rx_delay[k, rx] + joint
            carrier = w.carrier_frequency + w.slope * (u - tau)
            phase = w.carrier_frequency * tau + w.slope * tau * (u - tau / 2)
            step = (carrier * rho + w.slope * tau) * ts
            curvature = (carrier * accel / 2 + w.slope * rho * (1 - rho / 2)) * ts**2
            # sum over paths of coarse (a) times fine tones (b)
            strength = weight * (t.rx_gain[k, rx] if t.rx_gain.size else 1.0)
            coarse = np.exp(
                2j * np.pi * (phase % 1 + np.outer(a, step) + np.outer(a**2, curvature))
            )
            fine = np.exp(2j * np.pi * (np.outer(step, b) + np.outer(curvature, b**2)))
            coarse *= strength
            both = coarse @ fine + (4j * np.pi * a[:, None] * curvature * coarse) @ (b * fine)
            samples[m, rx, p] += both.ravel()[: w.num_samples]
    noise.add_to(samples)


def _made(
    waveform: Waveform, tones: Tones, noise: WhiteNoise, alone: np.ndarray, faint: np.ndarray
) -> np.ndarray:
    samples = new_memory(_shape(waveform, tones))
    add_up(samples, waveform, tones, noise, alone, faint)
    return samples
