r"""Foreign FMCW radars: their chirps where they cross the IF band of a receiver (docs/weather.md).

The IF signal is the receiver's reference chirp times the conjugate of what arrives. With u the time
since the start of the reference chirp and v = (1 - r) u - a that since the start of the foreign one
(r: delay rate of the path, a: its delay less how much earlier the foreign chirp began), the phase
in cycles is quadratic in u,

.. math:: f_c u + \tfrac12\alpha u^2 - f_e v - \tfrac12\alpha_e v^2
   = \varphi_0 + f_0 u + \tfrac12\kappa u^2,

so the foreign chirp is one of slope kappa in the IF, whose spectrum over the time in which both
last is a difference of Fresnel integrals. Reference chirps last `MARGIN` transients of the filter
longer than the samples on both sides. Chirps of one emitter begin with the same phase and are timed
by its own clock; it sends from one place with the pattern of one element. Paths are traced from it
as from a terminal, with one bounce at most, and lose what weather takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.fft import next_fast_len
from scipy.special import fresnel

from isac_rt.document import ScenarioError
from isac_rt.extensions.street.weather import Air
from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathSet
from isac_rt.propagation.settings import Clutter
from isac_rt.randomness import generator
from isac_rt.scenario.emitters import Emitter
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.exact import filter_gain
from isac_rt.signal.methods import Method
from isac_rt.signal.noise import SILENCE, WhiteNoise
from isac_rt.signal.tones import Tones, element_delay
from isac_rt.simulation.setup import propagation_in
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.passage import enclosed, obstacles
from isac_rt.world.swarm import Pose, Trajectory

MARGIN = 4.0
"""Time that reference chirps last beyond the samples, over the filter's transient."""
TONE = 1e-4
"""Curvature of the phase over the window [cycles] below which the IF signal is a tone."""
WEAKEST = 0.01
"""Power of all paths left out of an emitter, over the noise of a sample."""
CLICKS = 5.0
"""Distance from the band, over the sampling rate, at which ends of chirps click no more."""
AT_ONCE = 64
"""Crossings whose samples are made together, which bounds the memory."""


@dataclass(frozen=True)
class Train:
    """Chirps of one emitter, all alike.

    Attributes
    ----------
    frequency : at the start of a chirp [Hz]
    slope : [Hz/s], either sign
    duration, repetition : of the ramp, and from start to start [s]
    offset : start of the first chirp of a burst after the burst's start [s]
    burst : chirps in each burst; None: without end
    interval : from burst to burst [s]
    """

    frequency: float
    slope: float
    duration: float
    repetition: float
    offset: float
    burst: int | None
    interval: float

    @classmethod
    def of(cls, emitter: Emitter, name: str, seed: int) -> Train:
        """Return the chirps that an emitter's settings state; an offset that they leave open is
        drawn by its name."""
        e, repetition = emitter, (emitter.ramp_us + emitter.idle_us) * 1e-6
        offset = generator(seed, "emitter", name).uniform(0, repetition)
        if e.offset_us is not None:
            offset = e.offset_us * 1e-6
        times, interval = (e.ramp_us * 1e-6, repetition, offset), e.burst_interval_s or 0.0
        return cls(e.start_hz, e.slope_mhz_per_us * 1e12, *times, e.burst_chirps, interval)

    def as_received(self, sender: Emitter, receiver: Uav) -> Train:
        """Return the chirps, which are timed by their sender's clock, on a receiver's clock."""
        sent, received = (1 + end.clock_drift_ppm * 1e-6 for end in (sender, receiver))
        stretch = sent / received
        return replace(
            self,
            frequency=self.frequency / stretch,
            slope=self.slope / stretch**2,
            duration=self.duration * stretch,
            repetition=self.repetition * stretch,
            offset=self.offset * stretch - receiver.clock_offset_s / received,
            interval=self.interval * stretch,
        )

    def starts(self, begin: float, end: float) -> np.ndarray:
        """Return the starts of the chirps between two times (Q,) [s]."""
        if self.burst is None:
            first, last = (np.ceil((t - self.offset) / self.repetition) for t in (begin, end))
            return np.arange(first, last) * self.repetition + self.offset
        first, last = ((t - self.offset) / self.interval for t in (begin, end))
        bursts = np.arange(np.floor(first) - 1, np.ceil(last) + 1)
        within = np.arange(self.burst) * self.repetition + self.offset
        starts = (bursts[:, None] * self.interval + within).ravel()
        return starts[(starts >= begin) & (starts < end)]


@dataclass(frozen=True)
class Arrival:
    """Signal of one emitter at one receiver in one frame.

    Attributes
    ----------
    train : its chirps
    amplitude : sqrt(transmit power) [sqrt(W)]
    paths : from it to the receiver
    """

    train: Train
    amplitude: float
    paths: PathSet

    def strongest(self, noise: float) -> Arrival:
        """Return the signal without its weakest paths, whose sum is `WEAKEST` of the noise [W]."""
        power = self.amplitude**2 * self.paths.power
        order = np.argsort(power)
        weak = order[np.cumsum(power[order]) <= WEAKEST * noise]
        return replace(self, paths=self.paths.select(np.setdiff1d(np.arange(order.size), weak)))


class Emitters:
    """Foreign radars of a scenario with their paths."""

    def __init__(self, scenario: Scenario, city: CityMesh, waveform: Waveform) -> None:
        self._scenario, self._city, self._waveform = scenario, city, waveform
        each = scenario.emitters.items()
        self._uavs = {name: e.uav() for name, e in each}
        self._flights = {name: Trajectory(uav) for name, uav in self._uavs.items()}
        self._trains = {name: Train.of(e, name, scenario.seed) for name, e in each}
        for name, flight in self._flights.items():
            place = flight.pose(0.0).position - city.origin
            if enclosed(city, place) and enclosed(obstacles(city, place[None]), place):
                raise ScenarioError(
                    f"emitters.{name}: starts inside a building of {city.name} or under its "
                    "ground; change its position_m or waypoints"
                )

    @cached_property
    def _model(self) -> Any:
        """Paths from emitters: another swarm, in which they are terminals."""
        s, found = self._scenario, self._scenario.propagation
        bounces = {"max_bounces": min(found.max_bounces, 1), "ghosts": False}
        parts: dict[str, Any] = {
            "swarm": {**s.swarm, **self._uavs},
            "propagation": found.model_copy(update=bounces),
            "clutter": Clutter(),
            "weather": None,
        }
        return propagation_in(self._city, s.model_copy(update=parts))

    def arrivals(
        self, poses: Mapping[str, Pose], epoch: float, receivers: Sequence[str]
    ) -> dict[str, list[Arrival]]:
        """Trace what arrives at receivers at an instant [s]."""
        every = {**poses, **{name: flight.pose(epoch) for name, flight in self._flights.items()}}
        links = [Link(name, rx) for rx in receivers for name in self._flights]
        paths = self._model.trace(every, epoch, links).paths
        weather, out = self._scenario.weather, dict[str, list[Arrival]]()
        air = None if weather is None else Air(weather, self._waveform.effective_carrier)
        for link in links:
            found = paths[link]
            if air is not None:
                found = replace(found, gain=found.gain * 10 ** (-air.loss_db(found) / 20))
            amplitude = 10 ** ((self._scenario.emitters[link.tx].power_dbm - 30) / 20)
            ends = self._scenario.emitters[link.tx], self._scenario.swarm[link.rx]
            train = self._trains[link.tx].as_received(*ends)
            out.setdefault(link.rx, []).append(Arrival(train, amplitude, found))
        return out


@dataclass(frozen=True)
class WithForeign:
    """A method of synthesis that adds what arrives of emitters to the samples.

    Attributes
    ----------
    method : of the terminals' own chirps
    arrivals, receiver, reference : at one receiver in one frame
    level : noise of a sample, against which weak paths are left out [W]
    """

    method: Method
    arrivals: Sequence[Arrival]
    receiver: ReceiveArray
    reference: Reference
    level: float

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        out = self.method.samples(waveform, tones, noise)
        for arrival in self.arrivals:
            add_foreign(out, waveform, arrival.strongest(self.level), self.receiver, self.reference)
        return out


@dataclass(frozen=True)
class Crossings:
    """Foreign chirps in the IF of some reference chirps (I,): phase at the start of the reference
    chirp [cycles], frequency there [Hz], slope [Hz/s], begin and end [s], and the reference
    chirp."""

    phase: np.ndarray
    frequency: np.ndarray
    slope: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    chirp: np.ndarray

    def select(self, which: np.ndarray | slice) -> Crossings:
        return Crossings(*(column[which] for column in vars(self).values()))

    def in_band(self, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
        """Return begin and end (I,) of the time between two IF frequencies [Hz], or twice the time
        that is nearest to it."""
        slope = np.where(self.slope == 0, np.finfo(float).tiny, self.slope)
        with np.errstate(over="ignore"):
            ends = np.sort([(edge - self.frequency) / slope for edge in (low, high)], axis=0)
        begin, end = np.clip(ends, self.begin, self.end)
        return begin, end

    def since(self, start: np.ndarray, length: float) -> Crossings:
        """Return the crossings with times from `start` (I,) on, cut to a length [s]."""
        return Crossings(
            phase=self.phase + (self.frequency * start) % 1 + (self.slope * start**2 / 2) % 1,
            frequency=self.frequency + self.slope * start,
            slope=self.slope,
            begin=np.clip(self.begin - start, 0, length),
            end=np.clip(self.end - start, 0, length),
            chirp=self.chirp,
        )

    def spectrum(self, frequency: np.ndarray) -> np.ndarray:
        """Return the Fourier integrals (I, K) at frequencies (K,) [Hz]."""
        out = np.empty((self.phase.size, frequency.size), complex)
        length = self.end - self.begin
        tone = np.abs(self.slope) * length**2 < TONE
        f = frequency - self.frequency[:, None]
        middle = ((self.begin + self.end) / 2)[:, None]
        phase, slope = self.phase[:, None], self.slope[:, None]
        out[tone] = (
            np.exp(2j * np.pi * ((phase + slope * middle**2 / 2 - f * middle) % 1))
            * length[:, None]
            * np.sinc((f - slope * middle) * length[:, None])
        )[tone]
        chirp = ~tone
        f, phase, slope = f[chirp], phase[chirp], slope[chirp]
        scale, sign = np.sqrt(2 * np.abs(slope)), np.sign(slope)
        between = np.zeros_like(f, complex)
        for bound, side in ((self.end, 1), (self.begin, -1)):
            sine, cosine = fresnel(scale * (bound[chirp, None] - f / slope))
            between += side * (cosine + 1j * sign * sine)
        out[chirp] = np.exp(2j * np.pi * ((phase - f**2 / (2 * slope)) % 1)) * between / scale
        return out


def crossings(
    waveform: Waveform, train: Train, delay: np.ndarray, rate: np.ndarray, starts: np.ndarray
) -> Crossings:
    """Return where an emitter's chirps cross the IF band in some reference chirps.

    Parameters
    ----------
    delay, rate : (R,) of the path at the starts of the reference chirps [s, 1]
    starts : (R,) of the reference chirps [s]
    """
    w, margin = waveform, MARGIN / waveform.filter_transition
    low, high = w.fast_time[0] - margin, w.fast_time[-1] + margin
    first, last = starts + low - delay - train.duration, starts + high - delay
    sent = train.starts(float(first.min()), float(last.max()))
    # pairs of a reference chirp and a foreign one that overlap
    from_, to = np.searchsorted(sent, first), np.searchsorted(sent, last)
    chirp = np.repeat(np.arange(starts.size), to - from_)
    number = np.arange(chirp.size) - np.repeat(np.cumsum(to - from_) - to + from_, to - from_)
    late = delay[chirp] - (starts[chirp] - sent[from_[chirp] + number])
    speed = 1 - rate[chirp]
    found = Crossings(
        phase=(train.frequency * late) % 1 - (train.slope * late**2 / 2) % 1,
        frequency=w.carrier_frequency - train.frequency * speed + train.slope * speed * late,
        slope=w.slope - train.slope * speed**2,
        begin=np.maximum(late / speed, low),
        end=np.minimum((late + train.duration) / speed, high),
        chirp=chirp,
    )
    ends = np.sort([found.frequency + found.slope * t for t in (found.begin, found.end)], axis=0)
    skirt = CLICKS * w.sampling_rate
    return found.select((ends[1] > -skirt) & (ends[0] < w.sampling_rate + skirt))


def crossing_samples(waveform: Waveform, found: Crossings) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples (I, T) of crossings behind the IF filter, over a window that is long
    enough for each, and the number of each window's first sample (I,)."""
    w, rate = waveform, waveform.sampling_rate
    margin = MARGIN / w.filter_transition
    guard = margin / 4  # where the window's ends click
    within = found.in_band(-w.filter_transition, rate + w.filter_transition)
    about = found.in_band(-CLICKS * rate, (1 + CLICKS) * rate)
    begin = np.minimum(within[0] - margin, about[0] - 2 * guard)
    end = np.maximum(within[1] + margin, about[1] + 2 * guard)
    size = int(np.ceil((end - begin).max() * rate))
    first = np.floor((begin - w.fast_time[0]) * rate).astype(int)
    if size > (most := w.num_samples + 2 * int(np.ceil(margin * rate))):
        size, first = most, np.full(first.size, (w.num_samples - most) // 2)
    size = next_fast_len(size)
    moved = found.since(w.fast_time[0] + first / rate, size / rate)
    beyond = int(w.filter_transition / rate * size)
    frequency = np.arange(-beyond, size + beyond + 1) * (rate / size)
    spectrum = moved.spectrum(frequency) * filter_gain(w, frequency)
    folded = spectrum[:, beyond : beyond + size].copy()  # by sampling
    folded[:, : beyond + 1] += spectrum[:, beyond + size :]
    folded[:, size - beyond :] += spectrum[:, :beyond]
    inner = int(guard * rate)
    return np.fft.ifft(folded, axis=1)[:, inner : size - inner] * rate, first + inner


def add_foreign(
    out: np.ndarray,
    waveform: Waveform,
    arrival: Arrival,
    receiver: ReceiveArray,
    reference: Reference,
) -> None:
    """Add what arrives of one emitter to the samples (M, L_rx, P, N) of a receiver."""
    w, paths = waveform, arrival.paths
    elements = element_delay(
        receiver.pose.to_world(receiver.antennas.rx_positions), paths.arrival, paths.rx_radius
    )
    for m in range(w.num_groups):
        starts = reference.start_time + w.chirp_time[m]
        time = starts - paths.epoch
        for k in range(len(paths)):
            rate = paths.delay_rate[k] + paths.delay_accel[k] * time
            delay = paths.delay[k] + (paths.delay_rate[k] + rate) / 2 * time
            found = crossings(w, arrival.train, delay, rate, starts)
            alive = (time >= paths.begin[k]) & (time < paths.end[k])
            found = found.select(alive[found.chirp])
            weight = arrival.amplitude * paths.gain[k].conj()
            for first in range(0, found.chirp.size, AT_ONCE):
                some = found.select(slice(first, first + AT_ONCE))
                made, sample = crossing_samples(w, some)
                for row, chirp in enumerate(some.chirp):
                    begin, end = np.clip((0, made.shape[1]) + sample[row], 0, w.num_samples)
                    u = w.fast_time[begin:end]
                    beat = np.clip(some.frequency[row] + some.slope[row] * u, 0, w.sampling_rate)
                    arriving = w.carrier_frequency + w.slope * u - beat
                    turned = np.exp(2j * np.pi * (elements[k][:, None] * arriving))
                    crossing = weight * made[row, begin - sample[row] : end - sample[row]]
                    out[m, :, chirp, begin:end] += turned * crossing


def plan_row(
    waveform: Waveform,
    arrivals: Sequence[Arrival],
    receiver: ReceiveArray,
    reference: Reference,
    noise: float,
) -> dict[str, Any]:
    """Return the row of the plan of one link from one frame: the samples in which emitters are over
    the noise [W], and the rise of the floor."""
    shape = waveform.num_groups, receiver.antennas.num_rx, waveform.num_chirps, waveform.num_samples
    foreign = np.zeros(shape, complex)
    for arrival in arrivals:
        add_foreign(foreign, waveform, arrival.strongest(noise), receiver, reference)
    over = np.abs(foreign) ** 2 / noise
    rise, most = 10 * np.log10(1 + over.mean()), 10 * np.log10(over.max() + 1e-40)
    level = f"floor {rise:.2g} dB up: {100 * (over > 1).mean():.2g} % of the samples over the noise"
    if over.max() > 1:
        level += f", {most:.3g} dB at most"
    row = {"modelled": level, "left_out": "weak paths; two bounces, clutter"}
    return row | {"estimate": 10 * np.log10(WEAKEST), "unit": "dB"}
