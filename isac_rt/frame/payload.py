"""Bits to delay symbols and DPSK symbols and back, per group and chirp, and their check sum.

The last 8 bits of a frame are the remainder of the others, times D^8, by the polynomial gCRC8(D) =
D^8 + D^7 + D^4 + D^3 + D + 1 of 3GPP TS 36.212, section 5.1.1. A receiver divides all of them: the
remainder is zero, and of other bits in one frame of 256. Where terminals read some of the groups
alone, each set of groups that the same terminals read has a check sum of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import CHECK_BITS, Waveform

MODULATION_ORDERS = (2, 4, 8, 16)
CHECK_POLYNOMIAL = 0b1_1001_1011
"""gCRC8, the highest power first."""


@dataclass(frozen=True)
class Payload:
    """Bits and symbols that one frame carries.

    Attributes
    ----------
    bits : (bits_per_frame,) uint8, check sums included; the delay bits first, (group, chirp)-major,
        then the DPSK bits in the order (group, antenna, transition); empty when the frame is
        unmodulated
    delay_symbols : (M, P) int in [0, N/2)
    transitions : (M, L_tx, P/L_tx - 1) int in [0, D): the independent DPSK symbols
    phases : (M, P) complex128, beta^(D) of every chirp: the running product of its antenna's
        transitions
    num_delay_bits : how many of the bits are on the delay symbols
    check : (C,) places of the check sums among the bits
    """

    bits: np.ndarray
    delay_symbols: np.ndarray
    transitions: np.ndarray
    phases: np.ndarray
    num_delay_bits: int = 0
    check: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        for a in (self.bits, self.delay_symbols, self.transitions, self.phases):
            a.setflags(write=False)

    @property
    def modulated(self) -> bool:
        return self.bits.size > 0

    def bits_of(self, groups: Sequence[int]) -> np.ndarray:
        """The bits that some groups carry, in the order of `bits` with the other groups left
        out."""
        return self._of(groups, self.bits)

    def is_check(self, groups: Sequence[int]) -> np.ndarray:
        """Mark the check sums among `bits_of` groups."""
        return self._of(groups, np.isin(np.arange(self.bits.size), self.check))

    def _of(self, groups: Sequence[int], values: np.ndarray) -> np.ndarray:
        if not self.modulated:
            return values
        parts = np.split(values, [self.num_delay_bits])
        return np.concatenate(
            [part.reshape(len(self.delay_symbols), -1)[list(groups)].ravel() for part in parts]
        )


def unmodulated(waveform: Waveform) -> Payload:
    """A pilot frame: no delay, no phase, no bits."""
    w = waveform
    shape = (w.num_groups, w.num_chirps)
    return Payload(
        np.zeros(0, np.uint8),
        np.zeros(shape, np.int64),
        np.zeros((w.num_groups, w.num_tx, w.num_chirps // w.num_tx - 1), np.int64),
        np.ones(shape, np.complex128),
    )


def random_payload(
    waveform: Waveform, schedule: Schedule, dpsk_order: int, rng: np.random.Generator
) -> Payload:
    """Independent fair bits with their check sums, modulated."""
    bits = rng.integers(0, 2, waveform.bits_per_frame(dpsk_order), dtype=np.uint8)
    return modulate(with_check_sums(bits, waveform, dpsk_order), waveform, schedule, dpsk_order)


def with_check_sums(bits: np.ndarray, waveform: Waveform, dpsk_order: int) -> np.ndarray:
    """Return a frame's bits with the last 8 of each checked set of groups made their check sum."""
    bits = bits.copy()
    for places in _checked(waveform, dpsk_order):
        data, check = np.split(places, [-CHECK_BITS])
        padded = np.append(bits[data], np.zeros(CHECK_BITS, np.uint8))
        bits[check] = _unpack(np.array([remainder(padded)]), CHECK_BITS)
    return bits


def passes_check(bits: np.ndarray, waveform: Waveform, dpsk_order: int) -> bool:
    """Return whether the check sums among a frame's bits hold; True of bits without any."""
    return not any(remainder(bits[places]) for places in _checked(waveform, dpsk_order))


def remainder(bits: np.ndarray) -> int:
    """Remainder of bits, the highest power first, divided by the check sum's polynomial."""
    return int(np.bitwise_xor.reduce(_powers(bits.size)[bits > 0]))


@lru_cache(maxsize=64)
def _powers(count: int) -> np.ndarray:
    """Remainders of D^(count - 1) .. D^0."""
    out, power = np.empty(count, np.int64), 1
    for i in range(count):
        out[count - 1 - i] = power
        power <<= 1
        if power >> CHECK_BITS:
            power ^= CHECK_POLYNOMIAL
    return out


@lru_cache(maxsize=64)
def _checked(waveform: Waveform, dpsk_order: int) -> list[np.ndarray]:
    """Places of each checked set of groups among the bits of a frame, in their order."""
    split = waveform.num_groups * waveform.num_chirps * waveform.bits_per_delay_symbol
    parts = np.split(np.arange(waveform.bits_per_frame(dpsk_order)), [split])
    by_group = [part.reshape(waveform.num_groups, -1) for part in parts]
    return [
        np.concatenate([part[list(groups)].ravel() for part in by_group])
        for groups in waveform.check_sums(dpsk_order)
    ]


def modulate(bits: np.ndarray, waveform: Waveform, schedule: Schedule, dpsk_order: int) -> Payload:
    """Gray-mapped symbols of a frame's bits.

    Raises
    ------
    ValueError  If the number of bits is not `Waveform.bits_per_frame`.
    """
    w = waveform
    if bits.size != w.bits_per_frame(dpsk_order):
        raise ValueError(
            f"{bits.size} bits given, a frame with D = {dpsk_order} holds "
            f"{w.bits_per_frame(dpsk_order)}"
        )
    split = w.num_groups * w.num_chirps * w.bits_per_delay_symbol
    delay = _gray_decode(_pack(bits[:split], w.bits_per_delay_symbol)).reshape(
        w.num_groups, w.num_chirps
    )
    transitions = _gray_decode(_pack(bits[split:], dpsk_order.bit_length() - 1)).reshape(
        w.num_groups, w.num_tx, w.num_chirps // w.num_tx - 1
    )
    phases = running_phases(transitions, schedule, dpsk_order)
    sums = [places[-CHECK_BITS:] for places in _checked(w, dpsk_order)]
    check = np.concatenate([np.zeros(0, np.int64), *sums])
    return Payload(bits.copy(), delay, transitions, phases, split, check)


def demodulate_bits(
    delay_symbols: np.ndarray, transitions: np.ndarray, waveform: Waveform, dpsk_order: int
) -> np.ndarray:
    """Bits of decided symbols, in the order of `Payload.bits`."""
    w = waveform
    return np.concatenate(
        [
            _unpack(_gray_encode(np.asarray(delay_symbols)), w.bits_per_delay_symbol),
            _unpack(_gray_encode(np.asarray(transitions)), dpsk_order.bit_length() - 1),
        ]
    )


def running_phases(transitions: np.ndarray, schedule: Schedule, dpsk_order: int) -> np.ndarray:
    """beta_p' = prod_{i<p'} S_i of each antenna, put back at the chirps that it sends. (M, P)
    complex128.

    The paper's recursion is circular (it defines S by beta and beta by S); S is the independent
    symbol.
    """
    num_groups, num_tx, _ = transitions.shape
    steps = np.concatenate(
        [np.zeros((num_groups, num_tx, 1), np.int64), np.cumsum(transitions, axis=2)], axis=2
    )
    beta = np.exp(2j * np.pi / dpsk_order * (steps % dpsk_order))
    out = np.empty(schedule.shape, np.complex128)
    for m in range(num_groups):
        for tx in range(num_tx):
            out[m, schedule[m] == tx] = beta[m, tx]
    return out


def by_antenna(values: np.ndarray, schedule: Schedule, num_tx: int) -> np.ndarray:
    """Regroup (M, ..., P) into (M, L_tx, ..., P/L_tx): the chirps of each antenna in order of
    time."""
    return np.stack(
        [
            np.stack([values[m][..., schedule[m] == tx] for tx in range(num_tx)])
            for m in range(len(schedule))
        ]
    )


def _gray_encode(symbols: np.ndarray) -> np.ndarray:
    return symbols ^ (symbols >> 1)


def _gray_decode(words: np.ndarray) -> np.ndarray:
    out, shift = words.copy(), words >> 1
    while shift.any():
        out ^= shift
        shift >>= 1
    return out


def _pack(bits: np.ndarray, width: int) -> np.ndarray:
    return bits.reshape(-1, width).astype(np.int64) @ (1 << np.arange(width)[::-1])


def _unpack(words: np.ndarray, width: int) -> np.ndarray:
    return ((words.reshape(-1, 1) >> np.arange(width)[::-1]) & 1).astype(np.uint8).ravel()
