"""Numbers of the chirp, the frame and the resource blocks, and all that derives from them (Table
I)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from isac_rt.frame.settings import (
    TRANSITION_SHARE,
    Array,
    ChirpTimes,
    Modulation,
    Radio,
    chirp_times,
    num_resource_blocks,
)

SPEED_OF_LIGHT = 299_792_458.0
BOLTZMANN = 1.380649e-23
CHECK_BITS = 8
"""Bits of a check sum."""


Scheme = Literal["tdm", "ddm", "bpm"]


class Sweep(NamedTuple):
    """Timing of a plain FMCW chirp, counted from the start of its ramp.

    Attributes
    ----------
    slope : alpha [Hz/s]
    ramp_end, adc_start : end of the ramp and first sample [s]
    repetition : start of the next ramp [s]
    """

    slope: float
    ramp_end: float
    adc_start: float
    repetition: float


@dataclass(frozen=True, kw_only=True)
class Waveform:
    """One frame of the chirp signal: M groups (resource blocks) of P chirps with N samples each.

    The chirp lasts longer than the sampled window by two maximal delays, so that an echo of the
    window's first sample is still the same chirp: T~ = T + 2 T_d, T_d = f_s T~ / B, hence
    T_d = f_s T / (B - 2 f_s). (The paper prints f_s T / B, which its own settings contradict.)

    Attributes
    ----------
    carrier_frequency, bandwidth : start frequency of the chirp and its full sweep [Hz]
    sampling_rate : complex IF sampling rate f_s [Hz]
    num_samples : N, samples per chirp
    num_chirps : P, slots per frame
    num_groups : M, resource blocks that are used at once
    num_tx : L_tx, transmit antennas that share the slots
    filter_transition : width of the skirts of the IF filter [Hz], which passes [0, f_s]
    blocks : resource block of each group, counted from the transmitter's first; None: 0 .. M-1. A
        receiver that reads some of the groups only sees a waveform of these (`of_groups`)
    sweep : timing of a plain FMCW chirp; None: that of the paper, in which `bandwidth` sets it
    carries_data : whether half of the range cells are kept free for delay symbols
    scheme : how antennas share the chirps: "tdm", one in each group and slot; "ddm" and "bpm", all
        at once, by codes (`isac_rt.frame.schedule.codes_of`)
    bands : Doppler bands, or length of the codes, of antennas that send at once; 1: they do not
    checked : sets of groups whose bits end with one check sum; None: one for all groups

    Examples
    --------
    >>> w = Waveform(num_samples=1024, num_chirps=120)
    >>> round(w.range_cell(2), 4), round(w.velocity_cell(2), 4), round(w.max_velocity(1), 2)
    (0.2498, 0.249, 29.89)
    """

    carrier_frequency: float = 77e9
    bandwidth: float = 640e6
    sampling_rate: float = 20e6
    num_samples: int = 1024
    num_chirps: int = 120
    num_groups: int = 3
    num_tx: int = 3
    filter_transition: float = 0.4e6
    blocks: tuple[int, ...] | None = None
    sweep: Sweep | None = None
    carries_data: bool = True
    scheme: Scheme = "tdm"
    bands: int = 1
    checked: tuple[tuple[int, ...], ...] | None = None

    def __post_init__(self) -> None:
        if self.sweep is None and self.bandwidth <= 2 * self.sampling_rate:
            raise ValueError(
                f"bandwidth {self.bandwidth:g} Hz must exceed twice the sampling rate "
                f"{self.sampling_rate:g} Hz; raise the bandwidth or lower the sampling rate"
            )
        if self.num_chirps % (self.bands if self.bands > 1 else self.num_tx):
            raise ValueError(
                f"{self.num_chirps} chirps per frame are not a multiple of the {self.num_tx} "
                f"transmit antennas or {self.bands} bands; every antenna needs the same number of "
                "slots"
            )
        if not 1 <= self.num_groups <= self.num_tx:
            raise ValueError(
                f"{self.num_groups} groups: the Latin schedule needs 1 to {self.num_tx} (the "
                "transmit antennas)"
            )

    @cached_property
    def _times(self) -> ChirpTimes:
        if self.sweep is not None:
            sampled, longest = (
                self.num_samples / self.sampling_rate,
                self.sampling_rate / self.sweep.slope,
            )
            return ChirpTimes(sampled, longest, self.sweep.ramp_end, self.sweep.repetition)
        return chirp_times(self.bandwidth, self.sampling_rate, self.num_samples, self.num_tx)

    @property
    def sampled_duration(self) -> float:
        """T [s], the sampled part of a chirp."""
        return self._times.sampled

    @property
    def max_delay(self) -> float:
        """T_d [s], the delay whose beat is the sampling rate."""
        return self._times.max_delay

    @property
    def chirp_duration(self) -> float:
        """T~ [s]."""
        return self._times.chirp

    @property
    def guard_interval(self) -> float:
        """T_GI [s], room for the resource blocks of all transmit antennas."""
        return 2 * self.num_tx * self.max_delay

    @property
    def slot_duration(self) -> float:
        """T- [s], from one chirp of a group to its next."""
        return self._times.slot

    @cached_property
    def frame_duration(self) -> float:
        """P T- [s]."""
        return self.num_chirps * self.slot_duration

    @cached_property
    def slope(self) -> float:
        """alpha = B / T~ [Hz/s]."""
        return self.sweep.slope if self.sweep is not None else self.bandwidth / self.chirp_duration

    @cached_property
    def sample_interval(self) -> float:
        """T_s [s]."""
        return 1.0 / self.sampling_rate

    @property
    def window_start(self) -> float:
        """T~ - T [s], where sampling starts after the start of the reference chirp."""
        if self.sweep is not None:
            return self.sweep.adc_start
        return self.chirp_duration - self.sampled_duration

    @property
    def group_spacing(self) -> float:
        """2 T_d [s], from one resource block to the next."""
        return 2 * self.max_delay

    @property
    def num_resource_blocks(self) -> int:
        """Resource blocks in a slot: as many chirps, 2 T_d apart, start in it."""
        if self.sweep is not None:
            return max(int(self.slot_duration / self.group_spacing), 1)
        return num_resource_blocks(self.bandwidth, self.sampling_rate, self.num_tx)

    @property
    def wavelength(self) -> float:
        """c / f_c [m], the unit of the array spacing."""
        return SPEED_OF_LIGHT / self.carrier_frequency

    @cached_property
    def effective_carrier(self) -> float:
        """Frequency at the middle of the sampled window [Hz]: what Doppler and steering scale
        with."""
        return self.carrier_frequency + self.slope * (self.window_start + self.sampled_duration / 2)

    @cached_property
    def delay_step(self) -> float:
        """1 / (alpha T) [s]: the delay of one range cell and of one data symbol step."""
        return 1.0 / (self.slope * self.sampled_duration)

    @property
    def num_delay_symbols(self) -> int:
        """N/2, size of the delay alphabet."""
        return self.num_samples // 2

    @property
    def num_range_cells(self) -> int:
        """Range cells that a receiver looks at: those that every chirp shows whatever its data
        symbol, or all N of a plain radar."""
        return self.num_delay_symbols if self.carries_data else self.num_samples

    @property
    def decoded(self) -> Waveform:
        """The frame of antennas that send at once after their codes are taken out: a group of
        chirps for each antenna, all of them at the same times."""
        blocks = (0,) * self.num_tx
        return replace(self, num_groups=self.num_tx, blocks=blocks, scheme="tdm")

    @property
    def bits_per_delay_symbol(self) -> int:
        return self.num_delay_symbols.bit_length() - 1

    def bits_per_frame(self, dpsk_order: int) -> int:
        """N_bit = M P floor(log2(N/2)) + M (P - L_tx) log2(D); none of a plain radar."""
        if not self.carries_data:
            return 0
        return self.num_groups * (
            self.num_chirps * self.bits_per_delay_symbol
            + (self.num_chirps - self.num_tx) * (dpsk_order.bit_length() - 1)
        )

    @property
    def _checked(self) -> tuple[tuple[int, ...], ...]:
        return (tuple(range(self.num_groups)),) if self.checked is None else self.checked

    def check_sums(self, dpsk_order: int) -> list[tuple[int, ...]]:
        """Return the groups of each check sum; those with no bit besides have none."""
        bits = self.bits_per_frame(dpsk_order) // self.num_groups
        return [groups for groups in self._checked if len(groups) * bits > CHECK_BITS]

    def payload_bits(self, dpsk_order: int) -> int:
        """Bits of a frame that are left beside its check sums."""
        sums = len(self.check_sums(dpsk_order))
        return self.bits_per_frame(dpsk_order) - CHECK_BITS * sums

    def range_cell(self, passes: int) -> float:
        """Range of one cell [m]: c T~ / (B T) for one pass (PT), half of it for an echo (passes =
        2, AT)."""
        return SPEED_OF_LIGHT * self.delay_step / passes

    def velocity_cell(self, passes: int) -> float:
        """Radial velocity of one Doppler bin [m/s], with the effective carrier."""
        return SPEED_OF_LIGHT / (passes * self.frame_duration * self.effective_carrier)

    def max_velocity(self, passes: int) -> float:
        """Largest unambiguous radial speed [m/s] of a slow-time sampling in every slot."""
        return SPEED_OF_LIGHT / (2 * passes * self.slot_duration * self.effective_carrier)

    @cached_property
    def fast_time(self) -> np.ndarray:
        """u = n T_s + T~ - T [s] (num_samples,): time since the start of the reference chirp."""
        u = np.arange(self.num_samples) * self.sample_interval + self.window_start
        u.setflags(write=False)
        return u

    def of_groups(self, groups: Sequence[int]) -> Waveform:
        """The same frame seen by a receiver that reads only these groups."""
        blocks, place = self.blocks or tuple(range(self.num_groups)), list(groups).index
        whole = tuple(tuple(map(place, one)) for one in self._checked if set(one) <= set(groups))
        blocks = tuple(blocks[m] for m in groups)
        return replace(self, num_groups=len(groups), blocks=blocks, checked=whole)

    @cached_property
    def chirp_time(self) -> np.ndarray:
        """Start of each reference chirp [s] (num_groups, num_chirps) since the start of the first
        block's first."""
        blocks = range(self.num_groups) if self.blocks is None else self.blocks
        m, p = np.array(blocks)[:, None], np.arange(self.num_chirps)[None, :]
        t = p * self.slot_duration + m * self.group_spacing
        t.setflags(write=False)
        return t

    @cached_property
    def middle_time(self) -> np.ndarray:
        """Middle of each chirp's range window [s] (num_groups, num_chirps) since mid-frame."""
        t = self.chirp_time + self.window_middle - self.frame_duration / 2
        t.setflags(write=False)
        return t

    @cached_property
    def window_length(self) -> float:
        """Samples that the range window may cover, whatever the data: N less the largest s_D."""
        if not self.carries_data:
            return float(self.num_samples)
        return self.num_samples - float(self.data_shift(self.num_delay_symbols))

    @cached_property
    def window_middle(self) -> float:
        """u_c [s], the middle of the range window since the start of the reference chirp."""
        return self.window_start + self.window_length / 2 * self.sample_interval

    def data_shift(self, delay_symbols: npt.ArrayLike) -> np.ndarray:
        """s_D, the delay of data symbols in samples."""
        return np.asarray(delay_symbols) * self.delay_step * self.sampling_rate

    def data_phase(self, delay_symbols: npt.ArrayLike) -> np.ndarray:
        """Phase of the data's delay where the sampled window begins [cycles], as of `phase`."""
        return self.phase(np.asarray(delay_symbols) * self.delay_step, self.window_start)

    def phase(self, delay: np.ndarray, time: float | np.ndarray) -> np.ndarray:
        """Phase of a tone: f_c tau + alpha tau (u - tau/2) [cycles], each of the two modulo 1.

        Parameters
        ----------
        delay : tau [s], float64, from the start of the reference chirp to that of the arriving one
        time : u [s], since the start of the reference chirp
        """
        tau = delay
        return (self.carrier_frequency * tau) % 1.0 + (self.slope * tau * (time - tau / 2)) % 1.0

    def carrier(
        self, delay: float | np.ndarray = 0.0, time: float | np.ndarray | None = None
    ) -> np.ndarray:
        """Frequency [Hz] of a chirp that arrives `delay` late, at `time` [s] since the start of the
        reference chirp: f_c + alpha (u - tau). By default at `window_middle`."""
        u = self.window_middle if time is None else time
        return self.carrier_frequency + self.slope * (u - np.asarray(delay))

    def beat_cells(
        self,
        delay: float | np.ndarray,
        delay_rate: float | np.ndarray,
        time: float | np.ndarray | None = None,
    ) -> np.ndarray:
        """Beat [range cells] of a path without data at `window_middle`: T (alpha tau + tau_dot (f_c
        + alpha (u_c - tau))).

        Parameters
        ----------
        delay, delay_rate : of the path at mid-frame [s, 1]
        time : since mid-frame [s]; by default `middle_time`, which makes the beat (M, P)
        """
        tau = delay + delay_rate * (self.middle_time if time is None else time)
        return (self.slope * tau + delay_rate * self.carrier(tau)) * self.sampled_duration


def read_together(
    streams: Mapping[str, Sequence[int]], num_groups: int
) -> tuple[tuple[int, ...], ...]:
    """Return the groups in sets that the same terminals read, by the `streams` of some terminals;
    the others read all."""
    readers: dict[tuple[str, ...], list[int]] = {}
    for m in range(num_groups):
        names = tuple(name for name, groups in streams.items() if m in groups)
        readers.setdefault(names, []).append(m)
    return tuple(map(tuple, readers.values()))


def waveform_of(r: Radio, a: Array, modulation: Modulation | None = None) -> Waveform:
    """The waveform that a scenario's radio and array state, and its check sums."""
    num_tx, sweep, scheme = a.num_tx, None, r.scheme
    if r.chirp is not None:
        slope, start = r.chirp.slope_mhz_per_us * 1e12, r.chirp.adc_start_us * 1e-6
        sweep = Sweep(slope, r.ramp_end_s, start, r.repetition_s)
    return Waveform(
        carrier_frequency=r.carrier_hz,
        bandwidth=r.bandwidth_hz,
        sampling_rate=r.sampling_rate_hz,
        num_samples=r.samples_per_chirp,
        num_chirps=r.chirps_per_frame,
        num_groups=r.groups,
        num_tx=num_tx,
        filter_transition=TRANSITION_SHARE * r.sampling_rate_hz,
        sweep=sweep,
        carries_data=r.mode == "isac",
        scheme=scheme if r.bands(num_tx) > 1 and scheme != "simo" else "tdm",
        bands=r.bands(num_tx),
        checked=None if modulation is None else read_together(modulation.streams, r.groups),
    )


MAIN_LOBE = 2
"""Half width of a Hann window's main lobe [cells]."""


def hann(position: np.ndarray, length: float) -> np.ndarray:
    """Hann window of `length` that starts at 0, at any (fractional) position; 0 outside."""
    inside = (position >= 0) & (position <= length)
    return np.where(inside, np.sin(np.pi * position / length) ** 2, 0.0)
