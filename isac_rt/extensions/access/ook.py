"""On-off keyed messages: a chirp is sent or not, and the receiver compares energies without phases.

A frame begins with a stretch of chirps that are all on (it tells the range cell) and one that are
all off (it tells the noise); each bit is then repeated on as many consecutive chirps. Energies are
added over repeats, antennas and groups. Without a window, and with the fraction of a cell taken
out, the cells of noise are independent, so that thresholds and error rates follow from F
distributions.

Occupied resource blocks are detected at the slot grid, and a free run of them is chosen. Data move
a sender's beat from chirp to chirp, so energies cannot be added over chirps cell by cell. A chirp
is *hot* when its strongest cell, added over antennas, stands out of its other cells; a block is
taken when more chirps are hot than noise explains.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import scipy.fft
from scipy.special import bdtrc, betainccinv

from isac_rt.frame.waveform import Waveform

T = TypeVar("T", bound=Hashable)

HOT_RATE = 0.01
"""Chance that noise alone makes a chirp hot."""


def hot_threshold(num_rx: int, num_cells: int, rate: float = HOT_RATE) -> float:
    """Strongest cell over the mean of the others that noise exceeds in this share of chirps: the
    largest of `num_cells` F-distributed ratios with 2 L_rx and 2 L_rx (num_cells - 1) degrees of
    freedom."""
    a, b = num_rx, num_rx * (num_cells - 1)
    share = betainccinv(a, b, -np.expm1(np.log1p(-rate) / num_cells))  # a x / (a x + b)
    return float(share / (1 - share) * b / a)


def hot_chirps(samples: np.ndarray) -> np.ndarray:
    """Hot chirps per group, (M,) int, of samples (M, L_rx, P, N)."""
    groups, num_rx, num_chirps, num_cells = samples.shape
    limit = hot_threshold(num_rx, num_cells)
    count = np.zeros(groups, int)
    for m in range(groups):
        power = np.zeros((num_chirps, num_cells))
        for one in samples[m]:
            spectra = scipy.fft.fft(one, axis=1, workers=1)
            power += spectra.real**2 + spectra.imag**2
        peak = power.max(axis=1)
        count[m] = (peak > limit * (power.sum(axis=1) - peak) / (num_cells - 1)).sum()
    return count


def needed_chirps(num_chirps: int, false_rate: float) -> int:
    """Hot chirps from which a block counts as taken: noise reaches them with at most
    `false_rate`."""
    tail = np.append(1.0, bdtrc(np.arange(num_chirps), num_chirps, HOT_RATE))
    return int(np.flatnonzero(tail <= false_rate)[0])


def choose_run(occupied: np.ndarray, length: int, wished: int | None = None) -> int | None:
    """First block of a free run: the wished one, else the free start nearest to it (the lower of
    two); without a wish the lowest.

    Parameters
    ----------
    occupied : (blocks,) bool
    length : consecutive blocks needed; a run does not wrap around the slot
    """
    starts = [b for b in range(len(occupied) - length + 1) if not occupied[b : b + length].any()]
    if not starts:
        return None
    return min(starts, key=lambda b: (abs(b - (wished or 0)), b))


def consensus(votes: Sequence[T]) -> T | None:
    """Return the value that most blocks agree on; None without any or with a tie."""
    ranked = Counter(votes).most_common(2)
    if not ranked or (len(ranked) > 1 and ranked[0][1] == ranked[1][1]):
        return None
    return ranked[0][0]


FRACTIONS = 4
"""Fractions of a cell tried: the worst loss, an eighth of a cell off, is 0.22 dB."""
PREAMBLE = 2  # stretches: on, off


@dataclass(frozen=True)
class Message:
    """Content of a message: the sender, and the first resource block that it names."""

    sender: int
    block: int


@dataclass(frozen=True)
class Codebook:
    """Fields of a message: sender, block, and a parity bit that makes the number of ones odd, so
    that silence is no message."""

    num_senders: int
    num_blocks: int

    @property
    def widths(self) -> tuple[int, int]:
        return max((self.num_senders - 1).bit_length(), 1), max(
            (self.num_blocks - 1).bit_length(), 1
        )

    @property
    def num_bits(self) -> int:
        return sum(self.widths) + 1

    def encode(self, message: Message) -> np.ndarray:
        """(num_bits,) uint8.

        Raises
        ------
        ValueError  If a field is out of range.
        """
        fields = ((message.sender, self.num_senders), (message.block, self.num_blocks))
        if any(not 0 <= value < count for value, count in fields):
            raise ValueError(
                f"{message} does not fit {self.num_senders} senders and {self.num_blocks} blocks"
            )
        bits = [
            (value >> bit_index) & 1
            for (value, _), width in zip(fields, self.widths, strict=True)
            for bit_index in range(width - 1, -1, -1)
        ]
        return np.array([*bits, (sum(bits) + 1) % 2], np.uint8)

    def decode(self, bits: np.ndarray) -> Message | None:
        """The message, or None when the parity or a field is wrong."""
        if bits.sum() % 2 == 0:
            return None
        first = self.widths[0]
        sender = int("".join(map(str, bits[:first])), 2)
        block = int("".join(map(str, bits[first:-1])), 2)
        return (
            Message(sender, block)
            if sender < self.num_senders and block < self.num_blocks
            else None
        )


def repeats(num_chirps: int, num_bits: int) -> int:
    """Chirps per bit in a frame.

    Raises
    ------
    ValueError  If the frame is too short.
    """
    count = num_chirps // (num_bits + PREAMBLE)
    if count < 1:
        raise ValueError(
            f"{num_bits} bits need {num_bits + PREAMBLE} chirps in a frame, it has {num_chirps}; "
            "lengthen the frame"
        )
    return count


def keyed(waveform: Waveform, bits: np.ndarray) -> np.ndarray:
    """(M, P) bool mask of a message, the same in every group: for `Transmission.active`."""
    w = waveform
    each = repeats(w.num_chirps, bits.size)
    row = np.zeros(w.num_chirps, bool)
    word = np.repeat(np.concatenate([[1, 0], bits]).astype(bool), each)
    row[: word.size] = word
    return np.broadcast_to(row, (w.num_groups, w.num_chirps)).copy()


@dataclass(frozen=True)
class Reading:
    """Result of demodulating a frame.

    Attributes
    ----------
    found : whether somebody is on in the first stretch
    cell : beat of the sender in range cells
    bits : (num_bits,) uint8; meaningless when nothing was found
    energy : (num_bits,) of each bit over the noise, linear
    """

    found: bool
    cell: float
    bits: np.ndarray
    energy: np.ndarray


def threshold(rate: float, looks: int, num_cells: int) -> float:
    """Energy over the mean noise of `num_cells` cells that noise alone exceeds with this rate: both
    are means of `looks` exponentials per cell, their ratio is F distributed with 2 `looks` and 2
    `looks` `num_cells` degrees of freedom."""
    share = betainccinv(looks, looks * num_cells, rate)  # x / (x + num_cells)
    return float(share / (1 - share) * num_cells)


def read(
    samples: np.ndarray, num_bits: int, *, find_rate: float = 1e-4, on_rate: float = 1e-4
) -> Reading:
    """Find a sender and decide the bits of its message.

    Parameters
    ----------
    samples : (G, L_rx, P, N), the groups in which the same message is sent
    num_bits : of the message
    find_rate : chance that a frame of noise is taken for a sender (union bound over cells and
        fractions)
    on_rate : chance that noise alone turns a bit on
    """
    groups, num_rx, num_chirps, num_samples = samples.shape
    each = repeats(num_chirps, num_bits)
    looks = groups * num_rx * each
    energy = np.stack(
        [_stretches(samples, f / FRACTIONS, each, num_bits + PREAMBLE) for f in range(FRACTIONS)]
    )
    noise = energy[0, 1].mean()  # the stretch that is off
    fraction, cell = np.unravel_index(energy[:, 0].argmax(), energy[:, 0].shape)
    found = energy[fraction, 0, cell] > noise * threshold(
        find_rate / (FRACTIONS * num_samples), looks, num_samples
    )
    level = energy[fraction, PREAMBLE:, cell] / noise
    bits = (level > threshold(on_rate, looks, num_samples)).astype(np.uint8)
    return Reading(bool(found), float(cell + fraction / FRACTIONS), bits, level)


def _stretches(samples: np.ndarray, fraction: float, each: int, count: int) -> np.ndarray:
    """(count, N) mean energy of the cells k + fraction over the groups, antennas and chirps of each
    stretch."""
    num_samples = samples.shape[-1]
    phasor = np.exp(-2j * np.pi * fraction * np.arange(num_samples) / num_samples).astype(
        np.complex64
    )
    total = np.zeros((count, num_samples))
    for one in samples.reshape(-1, *samples.shape[2:]):
        spectra = scipy.fft.fft(one[: count * each] * phasor, axis=1, workers=1, overwrite_x=True)
        total += (spectra.real**2 + spectra.imag**2).reshape(count, each, num_samples).sum(axis=1)
    return total / (samples.shape[0] * samples.shape[1] * each)
