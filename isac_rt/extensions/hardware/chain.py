"""Effects of hardware on samples behind the antennas: phases, gains, ramps, noise, amplifier and
converter, chirp by chirp."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from isac_rt.extensions.hardware.oscillator import OVERSAMPLING, Record, cubic
from isac_rt.signal.noise import SILENCE, WhiteNoise, add_stream

MAX_DRIVE = np.float32(1e15)
"""Power over the saturation's whose square float32 still holds."""


def weights_at(record: Record, begin: np.ndarray, sign: float) -> tuple[np.ndarray, np.ndarray]:
    """Find where rows of samples that begin at times (R,) [s] lie in an oscillator's phase.

    Returns
    -------
    first : (R,) the value before the first sample
    weight : (R, 4) of the cubic through those around it, in cycles, with the sign
    """
    index = (begin - record.start) / record.step
    first = np.floor(index).astype(np.int64)
    return first, cubic(index - first) * (sign / (2 * np.pi))


def add_phase(
    out: np.ndarray, values: np.ndarray, first: np.ndarray | int, weight: np.ndarray
) -> None:
    """Add a cubic through `values` to samples (..., N), the first of which lies after the value
    `first` (...), with weights (..., 4)."""
    at = np.asarray(first)[..., None] + OVERSAMPLING * np.arange(out.shape[-1])
    for tap in range(4):
        out += weight[..., tap, None] * values[at + tap - 1]


def add_phases(out: np.ndarray, record: Record, begin: np.ndarray, sign: float) -> None:
    """Add the phase of an oscillator to rows of samples, in cycles.

    Parameters
    ----------
    out : (R, N) float64 [cycles], added to
    begin : (R,) time of the first sample of each row [s]; the others follow at the IF's rate
    sign : 1 or -1
    """
    add_phase(out, record.values, *weights_at(record, begin, sign))


def phasors(cycles: np.ndarray) -> np.ndarray:
    """exp(j 2 pi cycles) of float64, complex64."""
    return np.exp(2j * np.pi * (cycles % 1.0)).astype(np.complex64)


@dataclass(frozen=True)
class CommonFactor:
    """The complex factor of each chirp's samples that all receive elements share; None: nothing of
    the kind.

    Attributes
    ----------
    oscillators : phase values [rad], and of each chirp the value before its first sample (R,) and
        the weights of the cubic (R, 4), divided by 2 pi, with the sign
    always : (N,) the same in all chirps [cycles]
    sample_index, beat : (N,) places of the samples, (R,) cycles per sample by which they turn
    sent : (A, W) complex64 gains of each transmit antenna
    antenna, begin : (R,) which of them, and where in it, each chirp begins
    gain : (N,) complex64, gain of all chirps
    """

    oscillators: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...] = ()
    always: np.ndarray | None = None
    sample_index: np.ndarray | None = None
    beat: np.ndarray | None = None
    sent: np.ndarray | None = None
    antenna: np.ndarray | None = None
    begin: np.ndarray | None = None
    gain: np.ndarray | None = None

    def of_rows(self, every: int) -> CommonFactor:
        """Return the rows of one chirp in `every`."""
        rows = {name: getattr(self, name) for name in ("beat", "antenna", "begin")}
        return replace(
            self,
            oscillators=tuple((v, f[::every], w[::every]) for v, f, w in self.oscillators),
            **{name: None if row is None else row[::every] for name, row in rows.items()},
        )

    def factor(self, row: int, size: int) -> np.ndarray:
        """(N,) complex64, of one chirp."""
        cycles = np.zeros(size) if self.always is None else self.always.copy()
        for values, first, weight in self.oscillators:
            add_phase(cycles, values, first[row], weight[row])
        if self.beat is not None:
            cycles += self.beat[row] * self.sample_index
        out = phasors(cycles)
        if self.sent is not None and self.antenna is not None and self.begin is not None:
            at = self.begin[row]
            out *= self.sent[self.antenna[row], at : at + size]
        return out if self.gain is None else out * self.gain


@dataclass(frozen=True)
class Work:
    """Steps of one pass through the samples, in this order.

    Attributes
    ----------
    taps, shift : (1 + T, 2) and (N,), with which samples are read at places nearby
        (`isac_rt.extensions.hardware.sweep.short_read`); None: they are not
    reads, first : (T, N) weights with which samples are read farther away; the first of the
        neighbours (`isac_rt.extensions.hardware.sweep.read_at`); None: they are not
    margin : samples that a chirp has besides, before and behind, for those that are read there
    common : of each chirp; its `beat` moves the samples' band to the middle before they are read
    elements : (L_rx, N) complex64, factors of each element's samples; None: 1
    noise : per sample
    saturation : power at which the amplifier saturates [W]; 0: never
    mixing, constant, real : I and Q of I and Q (2, 2), the constant in both, and whether Q is left
        out
    step, most : of the converters [sqrt(W)], and half their number of steps; 0: none
    """

    common: CommonFactor = CommonFactor()
    taps: np.ndarray | None = None
    shift: np.ndarray | None = None
    reads: np.ndarray | None = None
    first: int = 0
    margin: int = 0
    elements: np.ndarray | None = None
    noise: WhiteNoise = SILENCE
    saturation: float = 0.0
    mixing: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))
    constant: float = 0.0
    real: bool = False
    step: float = 0.0
    most: float = 0.0


def finish(samples: np.ndarray, work: Work) -> np.ndarray:
    """Do to samples (M, L_rx, P, margin + N + margin) complex64 what hardware does behind antennas:
    (M, L_rx, P, N), in place without a margin."""
    groups, elements, chirps, size = samples.shape
    size -= 2 * work.margin
    out = np.empty((groups, elements, chirps, size), np.complex64) if work.margin else samples
    power, key0, key1 = work.noise.numbers
    for row, (m, p) in enumerate(np.ndindex(groups, chirps)):
        own = _read(samples[m, :, p], row, work) * work.common.factor(row, size)
        if work.elements is not None:
            own *= work.elements
        if power > 0:
            for r in range(elements):
                draw = ((m * elements + r) * chirps + p) * size
                add_stream(own[r].view(np.float32), power, key0, key1, np.uint64(draw))
        out[m, :, p] = _converted(own, work)
    return out


def _read(own: np.ndarray, row: int, work: Work) -> np.ndarray:
    """Samples (L_rx, N) read at other places, from those of the margins too."""
    if work.taps is None and work.reads is None:
        return own
    beat, size = work.common.beat, own.shape[1] - 2 * work.margin
    assert beat is not None
    back = own * phasors(-beat[row] * (np.arange(own.shape[1]) - work.margin))

    def beside(tap: int) -> np.ndarray:
        return back[:, work.margin + tap : work.margin + tap + size]

    if work.reads is not None:
        read = [w * beside(work.first + tap) for tap, w in enumerate(work.reads)]
        return np.sum(read, axis=0).astype(np.complex64)
    assert work.taps is not None and work.shift is not None
    slope = sum(work.taps[t, 0] * (beside(t) - beside(-t)) for t in range(1, len(work.taps)))
    curvature = work.taps[0, 1] * beside(0) + work.taps[1, 1] * (beside(1) + beside(-1))
    return np.asarray(beside(0) + work.shift * (slope + work.shift * curvature), np.complex64)


def _converted(own: np.ndarray, work: Work) -> np.ndarray:
    """Samples behind Rapp's amplifier with p = 2, the errors of quadrature, the constant, and the
    converters: the middle of each value's step, within `most` steps on both sides of zero."""
    if work.saturation > 0:
        drive = np.minimum(np.abs(own) ** 2 / np.float32(work.saturation), MAX_DRIVE)
        own = own * (1 + drive**2) ** np.float32(-0.25)
    if (work.mixing, work.constant, work.real) != (Work.mixing, 0.0, False):
        (a, b), (c, d) = work.mixing
        i, q = own.real, own.imag
        own = (a * i + b * q + work.constant) + 1j * (c * i + d * q + work.constant)
    parts = [own.real, own.imag]
    if work.step > 0:
        steps = [np.clip(np.floor(x / work.step), -work.most, work.most - 1) for x in parts]
        parts = [(x + 0.5) * work.step for x in steps]
    return np.asarray(parts[0] + (0.0 if work.real else 1j * parts[1]), np.complex64)
