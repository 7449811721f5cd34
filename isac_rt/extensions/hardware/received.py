r"""IF samples behind real front ends: the ideal synthesis with what the hardware of both ends adds.

Of a path with delay tau the oscillators add the phase

.. math:: \phi_{rx}(t) - \phi_{tx}(t - \tau)

at every sample. It is applied in three parts:

- by sample to the whole cube, with the delay of the strongest path of the link, tau_0;
- once a chirp to all others, by `BINS` of delay: the mean over the chirp of what their own delay
  makes of it;
- by sample to those paths alone whose noise within a chirp, P times its variance, would be more
  than `SHARE` of the thermal noise; at most `MOST_ALONE`, the strongest.

What is left out is a path's noise within a chirp beyond that of tau_0 (`oscillator.spread` is its
variance), and the difference of the mean within a bin of delay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from isac_rt.extensions.hardware.chain import (
    CommonFactor,
    Work,
    add_phases,
    finish,
    phasors,
    weights_at,
)
from isac_rt.extensions.hardware.converter import saturated
from isac_rt.extensions.hardware.front_end import IDEAL, Ends
from isac_rt.extensions.hardware.oscillator import Mask, Oscillator, Record, spread
from isac_rt.extensions.hardware.sweep import Ramp, read_at, sampled, short_read
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference
from isac_rt.frame.schedule import codes_of
from isac_rt.frame.waveform import Sweep, Waveform
from isac_rt.kernels.signal_direct import add_direct
from isac_rt.signal.if_signal import received_tones
from isac_rt.signal.methods import Method
from isac_rt.signal.noise import WhiteNoise
from isac_rt.signal.tones import Links, Tones

BINS = 8
"""Cells of delay of a link, each of which has one phase a chirp."""
SHARE = 0.01
"""Noise that an oscillator makes of a path within a chirp, over the thermal noise, from which on
the path is made by itself."""
MOST_ALONE = 16


def received(
    waveform: Waveform,
    links: Links,
    receiver: ReceiveArray,
    reference: Reference,
    ends: Ends,
    method: Method,
    noise: WhiteNoise,
) -> IFCube:
    """Return the samples of a receiver with real hardware of real transmitters in one frame, noise
    included.

    Parameters
    ----------
    waveform, links, receiver, reference, method : as of `isac_rt.signal.if_signal.if_signal`
    ends : the hardware, its senders in the order of the links
    noise : at the receiver's input
    """
    schedule, tones = received_tones(waveform, links, receiver, reference)
    tones = _with_elements(tones, waveform, links, receiver, ends)
    delays = np.concatenate([s.delay for _, s in links] or [np.zeros(0)])
    common, read = _common_factor(waveform, tones, ends), _read(waveform, tones, ends)
    longer = _with_margin(waveform, read.margin)
    flicker = _Flicker.of(longer, reference, ends, tones, delays)
    if flicker is None:
        samples = method.samples(longer, tones)
    else:
        alone = flicker.alone(noise.power)
        rest = flicker.binned().select(np.setdiff1d(np.arange(tones.size), alone))
        samples = method.samples(longer, rest)
        for k in alone:
            factor = flicker.relative_factor(int(k))
            add_direct(samples, longer, tones.select(np.array([k])), factor=factor)
        common = flicker.common(common, read.margin * waveform.sample_interval)
    read = replace(read, common=common, noise=noise)
    samples = finish(samples, _work(waveform, ends, read, samples))
    return IFCube(
        samples=samples,
        waveform=waveform,
        schedule=schedule,
        start_time=reference.start_time,
    )


def _main(tones: Tones) -> int | None:
    """The strongest path of the first link."""
    of_first = np.flatnonzero(tones.link == 0)
    return int(of_first[np.argmax(tones.power[of_first])]) if of_first.size else None


def _lag(tones: Tones) -> np.ndarray:
    """(M, P) how much later than the reference the chirps of the strongest path arrive [s]."""
    main = _main(tones)
    return np.zeros((1, 1)) if main is None else tones.delay[main] + tones.symbol_delay[0]


def _common_factor(w: Waveform, tones: Tones, ends: Ends) -> CommonFactor:
    """Return the phase and gain that all receive elements share, oscillators excluded: gains over
    the chirp, and the difference of the two ramps."""
    sender, out = ends.senders[0] if ends.senders else IDEAL, CommonFactor()
    if sender.transmit_response is not None:
        late = np.rint(_lag(tones) * w.sampling_rate).astype(np.int64)
        most = max(int(late.max()), 0)
        antenna = tones.antenna[0] if len(tones.antenna) else np.zeros((1, 1), np.int64)
        out = replace(
            out,
            sent=sampled(sender.transmit_response, w.num_samples, most).astype(np.complex64),
            antenna=_by_chirp(w, antenna),
            begin=_by_chirp(w, np.clip(most - late, 0, most)),
        )
    own = ends.receiver.receive_response
    if own is not None and own.common:
        out = replace(out, gain=sampled(own, w.num_samples)[0].astype(np.complex64))
    ramps = sender.ramp, ends.receiver.ramp
    if any(ramps):
        theirs, mine = (0.0 if r is None else r.cycles(w.fast_time) for r in ramps)
        out = replace(out, always=mine - theirs + np.zeros(w.num_samples))
        if sender.ramp is not None:
            sample_index = np.arange(w.num_samples) + _shift(w, tones, sender.ramp)
            out = replace(out, sample_index=sample_index, beat=_by_chirp(w, _band(w, tones)))
    return out


def _by_chirp(w: Waveform, values: np.ndarray) -> np.ndarray:
    """(M, P) or what broadcasts to it, as one row."""
    return np.broadcast_to(values, (w.num_groups, w.num_chirps)).ravel()


def _shift(w: Waveform, tones: Tones, ramp: Ramp) -> np.ndarray:
    """(N,) how many samples later than they are taken a transmitter's ramp has them."""
    middle = w.fast_time - float(_lag(tones).mean()) / 2
    return ramp.frequency(middle) / w.slope * w.sampling_rate


_BAND_MIDDLE = 0.28
"""Middle of the beats that receivers look at, without data, over the sampling rate."""


def _band(w: Waveform, tones: Tones) -> np.ndarray:
    """(M, P) middle of the beats in each chirp [cycles per sample]."""
    data = tones.symbol_delay[0] if len(tones.symbol_delay) else np.zeros((1, 1))
    return data * w.slope / w.sampling_rate + _BAND_MIDDLE


def _read(w: Waveform, tones: Tones, ends: Ends) -> Work:
    """The places at which samples are read where the transmitter's ramp has errors."""
    ramp = ends.senders[0].ramp if ends.senders else None
    if ramp is None:
        return Work()
    late = _shift(w, tones, ramp)
    near = short_read(float(np.abs(late).max()))
    if near is not None:
        taps, shift = near.astype(np.float32), late.astype(np.float32)
        return Work(taps=taps, shift=shift, margin=len(near) - 1)
    first, weights = read_at(late)
    return Work(reads=weights.astype(np.float32), first=first, margin=-first)


def _with_margin(w: Waveform, margin: int) -> Waveform:
    """The same chirps sampled from `margin` samples earlier until as many later."""
    if not margin:
        return w
    start = w.window_start - margin * w.sample_interval
    sweep = Sweep(w.slope, w.chirp_duration, start, w.slot_duration)
    return replace(w, sweep=sweep, num_samples=w.num_samples + 2 * margin)


def _work(w: Waveform, ends: Ends, work: Work, samples: np.ndarray) -> Work:
    """List the steps of the pass through the `samples`, beginning with `work`."""
    own, c = ends.receiver.receive_response, ends.receiver.converter
    if own is not None and not own.common:
        work = replace(work, elements=sampled(own, w.num_samples).astype(np.complex64))
    if c is None:
        return work
    saturation = 0.0 if np.isinf(c.saturation) else c.saturation
    work = replace(work, saturation=saturation, mixing=c.mixing, constant=c.constant, real=c.real)
    if not c.bits:
        return work
    full = c.full_scale or c.headroom * _level(samples, work, w.num_chirps)
    return replace(work, step=2 * full / 2**c.bits, most=2.0 ** (c.bits - 1))


def _level(samples: np.ndarray, work: Work, num_chirps: int) -> float:
    """RMS of the strongest element in a chirp like the first of each group, noise included."""
    trial = np.ascontiguousarray(samples[:, :, :1])
    trial = finish(trial, replace(work, common=work.common.of_rows(num_chirps)))
    return float(np.sqrt((np.abs(trial) ** 2).mean(axis=(0, 2, 3)).max())) or 1.0


def _with_elements(
    tones: Tones, w: Waveform, links: Links, receiver: ReceiveArray, ends: Ends
) -> Tones:
    """The tones with what the elements of both ends add to delays and amplitudes."""
    frequency = float(w.carrier(time=w.fast_time[w.num_samples // 2]))
    own = ends.receiver.receive
    if own is not None and tones.size:
        arrival = receiver.pose.to_body(np.concatenate([s.arrival for _, s in links]))
        at = receiver.antennas
        tones = tones._replace(
            rx_delay=tones.rx_delay + own.delay,
            rx_gain=own.factors(arrival, at.rx_positions, frequency),
        )
    powers = [sent.amplitude**2 for sent, _ in links]
    driven = [saturated(p, one.saturation) for p, one in zip(powers, ends.senders, strict=True)]
    if set(driven) - {1.0}:
        tones = tones._replace(send=tones.send * np.array(driven)[:, None, None])
    tones = _with_shifters(tones, w, links, ends)
    if all(one.transmit is None for one in ends.senders) or not tones.size:
        return tones
    delay, gain = tones.tx_delay.copy(), np.ones(tones.tx_delay.shape, complex)
    for q, ((sent, paths), one) in enumerate(zip(links, ends.senders, strict=True)):
        if one.transmit is None:
            continue
        departure, at = sent.pose.to_body(paths.departure), sent.antennas
        here = np.ix_(tones.link == q, np.arange(at.num_tx))
        delay[here] += one.transmit.delay
        gain[here] = one.transmit.factors(departure, at.tx_positions, frequency)
    return tones._replace(tx_delay=delay, tx_gain=gain)


def _with_shifters(tones: Tones, w: Waveform, links: Links, ends: Ends) -> Tones:
    """The tones as phase shifters send the codes of antennas that send at once."""
    codes = codes_of(w)
    if codes is None or all(one.shifter is None for one in ends.senders):
        return tones
    send = tones.send.copy()
    for q, ((sent, _), one) in enumerate(zip(links, ends.senders, strict=True)):
        if one.shifter is not None:
            antenna = int(sent.schedule[0, 0])
            send[q] *= one.shifter.sent(antenna, codes[antenna]) / codes[antenna]
    return tones._replace(send=send)


@dataclass(frozen=True)
class _Flicker:
    """Phases of the oscillators in one frame of one receiver.

    Attributes
    ----------
    waveform, tones : of the frame
    begin : (M, P) time of the first sample of each chirp [s]
    delays : (K,) of each path, without data and clocks [s]
    mine : phase of the receiver's oscillator; None: ideal
    theirs : of each link's transmitter
    ends : whose oscillators they are
    """

    waveform: Waveform
    tones: Tones
    begin: np.ndarray
    delays: np.ndarray
    mine: Record | None
    theirs: tuple[Record | None, ...]
    ends: Ends

    @classmethod
    def of(
        cls, w: Waveform, reference: Reference, ends: Ends, tones: Tones, delays: np.ndarray
    ) -> _Flicker | None:
        """None where all oscillators are ideal."""
        mine, theirs = ends.receiver.oscillator, [one.oscillator for one in ends.senders]
        if mine is None and not any(theirs):
            return None
        begin = reference.start_time + w.chirp_time + w.window_start
        first = begin[0, 0] - delays.max(initial=0.0)
        last = begin[-1, -1] + w.sampled_duration
        made = {
            one: one.record(first, last)
            for one in dict.fromkeys([mine, *theirs])
            if one is not None
        }
        records = tuple(None if one is None else made[one] for one in theirs)
        own = None if mine is None else made[mine]
        return cls(w, tones, begin, delays, own, records, ends)

    @property
    def main(self) -> float:
        """Delay of the strongest path of the first link [s]."""
        main = _main(self.tones)
        return 0.0 if main is None else float(self.delays[main])

    def _cycles(self, parts: list[tuple[Record | None, float, float]]) -> np.ndarray:
        """(M, P, N) sum of phases: records, delays [s], signs."""
        out = np.zeros((self.begin.size, self.waveform.num_samples))
        for record, delay, sign in parts:
            if record is not None:
                add_phases(out, record, self.begin.ravel() - delay, sign)
        return out.reshape(*self.begin.shape, -1)

    def common(self, common: CommonFactor, margin: float) -> CommonFactor:
        """`common` with the phase of the strongest path, of samples from `margin` [s] later on."""
        theirs = self.theirs[0] if self.theirs else None
        if theirs is not None and theirs is self.mine and self.main == 0:
            return common
        begin, parts = self.begin.ravel() + margin, []
        for one, late, sign in ((self.mine, 0.0, 1.0), (theirs, self.main, -1.0)):
            if one is not None:
                parts.append((one.values, *weights_at(one, begin - late, sign)))
        return replace(common, oscillators=tuple(parts))

    def relative_factor(self, path: int) -> np.ndarray:
        """(M, P, N) complex64, the phase of a path beside the common one, as a factor."""
        theirs = self.theirs[self.tones.link[path]]
        first = self.theirs[0]
        parts = [(first, self.main, 1.0), (theirs, float(self.delays[path]), -1.0)]
        return phasors(self._cycles(parts))

    def binned(self) -> Tones:
        """The tones with the mean phase of each chirp beside the common one in what is sent, each
        cell of delay a link of its own."""
        t, w = self.tones, self.waveform
        duration = w.sampled_duration
        send, link = np.repeat(t.send, BINS, axis=0), t.link * BINS
        first = self.theirs[0] if self.theirs else None
        means = {id(one): one.means(duration) for one in self.theirs if one is not None}
        main = 0.0 if first is None else means[id(first)](self.begin - self.main)
        for q, record in enumerate(self.theirs):
            of_link = np.flatnonzero(t.link == q)
            if not of_link.size:
                continue
            low, high = self.delays[of_link].min(), self.delays[of_link].max()
            width = max((high - low) / BINS, 1e-15)
            bins = np.clip((self.delays[of_link] - low) // width, 0, BINS - 1).astype(np.int64)
            link[of_link] += bins
            cell = np.unique(bins)
            middle = low + (cell[:, None, None] + 0.5) * width
            own = 0.0 if record is None else means[id(record)](self.begin - middle)
            phase = main - own + np.zeros(middle.shape)
            send[q * BINS + cell] *= np.exp(1j * phase)
        return t._replace(
            link=link,
            send=send,
            symbol_delay=np.repeat(t.symbol_delay, BINS, axis=0),
            antenna=np.repeat(t.antenna, BINS, axis=0),
        )

    def alone(self, noise_power: float) -> np.ndarray:
        """The paths that are made by themselves, strongest first."""
        t = self.tones
        power = noise_within(self.waveform, self.ends, t.link, t.power, self.delays)
        return _strongest(power, noise_power)


def _strongest(power: np.ndarray, noise_power: float) -> np.ndarray:
    """Mark the paths (K,) whose noise within a chirp [W] needs samples of its own."""
    strongest = np.argsort(-power, kind="stable")[:MOST_ALONE]
    return strongest[power[strongest] > SHARE * noise_power]


def noise_within(
    w: Waveform, ends: Ends, link: np.ndarray, power: np.ndarray, delays: np.ndarray
) -> np.ndarray:
    """Noise that oscillators make of each path within a chirp beside what they make of the
    strongest path of the first link: (K,) [W].

    Parameters
    ----------
    link, power, delays : (K,) of each path: its link, received power [W], delay [s]
    """
    first = ends.senders[0].oscillator if ends.senders else None
    of_first = np.flatnonzero(link == 0)
    main = delays[of_first[np.argmax(power[of_first])]] if of_first.size else 0.0
    out = np.zeros(power.size)
    for q, end in enumerate(ends.senders):
        of_link = link == q
        lag = np.abs(delays[of_link] - main)
        if end.oscillator is first:
            variance = within(first, w.sampled_duration, lag)
        else:
            two = [one for one in (first, end.oscillator) if one is not None]
            never = np.full(lag.shape, np.inf)
            parts = [within(one, w.sampled_duration, never) / 2 for one in two]
            variance = np.sum(parts, axis=0)
        out[of_link] = power[of_link] * variance
    return out


def noise_left_out(w: Waveform, links: Links, ends: Ends, noise_power: float) -> float:
    """Noise of oscillators that the samples of `received` leave out, over the thermal noise."""
    link = np.repeat(np.arange(len(links)), [len(s) for _, s in links])
    power = np.concatenate([t.amplitude**2 * s.power for t, s in links])
    noise = noise_within(w, ends, link, power, np.concatenate([s.delay for _, s in links]))
    noise[_strongest(noise, noise_power)] = 0.0
    return float(noise.sum() / noise_power)


def within(oscillator: Oscillator | None, duration: float, lag: np.ndarray) -> np.ndarray:
    """Variance of the phase within a chirp for delays that differ by `lag` (K,) [rad^2]."""
    if oscillator is None:
        return np.zeros(lag.shape)
    grid, table, of_two = _within(oscillator.mask, duration, oscillator.rate)
    far = np.isinf(lag)
    out = np.interp(np.where(far, 0.0, lag), grid, table)
    out[far] = of_two
    return out


@lru_cache(maxsize=16)
def _within(mask: Mask, duration: float, rate: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Delays [s] and the variances within a chirp at them, and that of two oscillators."""
    grid = np.concatenate([[0.0], np.geomspace(1e-2, 1e2, 60) / rate])
    table = np.array([spread(mask, lag, duration, rate)[1] for lag in grid])
    return grid, table, float(spread(mask, np.inf, duration, rate)[1])
