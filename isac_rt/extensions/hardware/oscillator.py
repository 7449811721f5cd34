r"""Phase noise of an oscillator as one process over all chirps and frames.

The single-sideband mask L(f) is half the one-sided spectrum of the phase, S(f) = 2 L(f) [rad^2/Hz].
The process is a sum of bands, each 64 times (the fastest 512 times) as wide as its lowest
frequency. A band is a row of blocks on a fixed grid of absolute time. A block is drawn from
(seed, terminal, band, number of the block) alone: a sum of lines with independent normal
amplitudes, so that its spectrum is the mask's. Neighbouring blocks overlap by an eighth of their
length, where one goes over into the other with the weights cos and sin, whose squares add up to 1.
Any instant is therefore made without what came before, and the process has no period.

Left out: offsets below `SLOWEST`, slower than 10 s, and beyond half the sampling rate, which the IF
filter keeps from all but the outermost range cells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.fft

from isac_rt.frame import front_end as settings
from isac_rt.randomness import generator

SLOWEST = 0.1
"""Offset below which nothing is modelled any more [Hz]."""
OVERSAMPLING = 2
"""Samples of the phase to one of the IF: a delay falls between them."""
_WIDTH, _FASTEST_WIDTH = 64, 512
_STEPS = 8  # samples of a slower band's highest frequency
_SIZE, _FASTEST_SIZE = 8192, 65_536
_FADE = 8  # a block's length over that of its overlap
_SPAN = 4  # samples that a place between two is interpolated from


@dataclass(frozen=True)
class Mask:
    """Single-sideband noise over the offset from the carrier.

    Attributes
    ----------
    points : ((offset [Hz], level [dBc/Hz]), ...) in the order of the offsets
    locked : the level is held below the first point; if not, it goes on as between the first two

    Examples
    --------
    A free oscillator of -95 dBc/Hz at 1 MHz, of which 20 dB less remain at 10 MHz:

    >>> mask = Mask(((1e5, -75.0), (1e7, -115.0)), locked=False)
    >>> np.log10(mask.level(np.array([1e2, 1e6, 1e8]))).round(6).tolist()
    [-1.5, -9.5, -11.5]
    """

    points: tuple[tuple[float, float], ...]
    locked: bool = True

    def level(self, offset: np.ndarray) -> np.ndarray:
        """L(f) [1/Hz] at offsets above 0 [Hz]."""
        at, level = np.array(self.points).T
        at, wanted = np.log10(at), np.log10(offset)
        db = np.interp(wanted, at, level)
        if not self.locked:
            slope = (level[1] - level[0]) / (at[1] - at[0])
            db = np.where(wanted < at[0], level[0] + slope * (wanted - at[0]), db)
        return 10 ** (db / 10)


class _Band(NamedTuple):
    """Offsets from `low` to `high` [Hz], in blocks of `size` samples `step` [s] apart."""

    low: float
    high: float
    step: float
    size: int

    @property
    def hop(self) -> int:
        """Samples from block to block."""
        return self.size - self.size // _FADE


class Record(NamedTuple):
    """Phase of an oscillator over a stretch of time.

    Attributes
    ----------
    start, step : time of the first value, from value to value [s]
    values : (n,) float64 [rad]
    """

    start: float
    step: float
    values: np.ndarray

    def at(self, time: np.ndarray) -> np.ndarray:
        """Phase at times [s], by the cubic through four neighbours [rad]."""
        position = (np.asarray(time) - self.start) / self.step
        first = np.floor(position).astype(np.int64)
        weight = cubic(position - first)
        return sum(weight[..., i] * self.values[first - 1 + i] for i in range(_SPAN))

    def means(self, duration: float) -> Callable[[np.ndarray], np.ndarray]:
        """Gives the mean phase over `duration` [s] from any times on [rad]: the difference of two
        integrals, of straight lines between the values."""
        integral = self._replace(values=self.step * (np.cumsum(self.values) - self.values / 2))

        def mean(begin: np.ndarray) -> np.ndarray:
            return (integral.at(begin + duration) - integral.at(begin)) / duration

        return mean


def cubic(share: np.ndarray) -> np.ndarray:
    """(..., 4) weights of the samples at -1, 0, 1, 2 of the cubic through them, at `share` of the
    way from 0 to 1."""
    x = np.asarray(share, float)
    back, ahead, far = x + 1, x - 1, x - 2
    parts = -x * ahead * far / 6, back * ahead * far / 2, -back * x * far / 2, back * x * ahead / 6
    return np.stack(parts, axis=-1)


def _between(coarse: np.ndarray, ratio: int, first: int, count: int) -> np.ndarray:
    """Interpolate by the cubic through four values, `ratio` times as densely.

    Parameters
    ----------
    coarse : values at the dense places 0, `ratio`, 2 `ratio`, ...
    first, count : dense places of the result, from `ratio` on
    """
    windows = np.lib.stride_tricks.sliding_window_view(coarse, _SPAN)
    begin, end = first // ratio - 1, (first + count - 1) // ratio
    dense = windows[begin:end] @ cubic(np.arange(ratio) / ratio).T
    skipped = first % ratio
    return dense.ravel()[skipped : skipped + count]


@dataclass(frozen=True)
class Oscillator:
    """One terminal's oscillator.

    Attributes
    ----------
    mask : of its noise
    rate : sampling rate of the IF [Hz]
    seed, name : of the run and of the terminal, from which its noise is drawn
    """

    mask: Mask
    rate: float
    seed: int
    name: str

    def bands(self) -> list[_Band]:
        """From the fastest down."""
        high = self.rate / 2
        step = 1 / (OVERSAMPLING * self.rate)
        out = [_Band(high / _FASTEST_WIDTH, high, step, _FASTEST_SIZE)]
        while out[-1].low > SLOWEST:
            high = out[-1].low
            out.append(_Band(high / _WIDTH, high, 1 / (_STEPS * high), _SIZE))
        return out

    def record(self, begin: float, end: float) -> Record:
        """The phase from `begin` to `end` [s] and a little beyond both."""
        fastest, *slower = self.bands()
        step = fastest.step
        first = int(np.floor(begin / step)) - _SPAN
        count = int(np.ceil(end / step)) + _SPAN - first + 1
        values = self._slower(slower, first, count, step)
        self._add_band(values, 0, fastest, first)
        return Record(first * step, step, values)

    def _slower(self, bands: list[_Band], first: int, count: int, step: float) -> np.ndarray:
        """Sum of the slower bands at places first .. first + count - 1 of the fastest one."""
        ratio = round(bands[0].step / step)
        low = first // ratio - 1
        segments = (first + count) // ratio + 1 - low
        total = np.zeros(segments + _SPAN)
        for number, band in enumerate(bands, start=1):
            coarse = round(band.step / bands[0].step)
            begin = (low - 1) // coarse - 1
            size = (low + segments + _SPAN) // coarse + _SPAN - begin
            own = np.zeros(size)
            self._add_band(own, number, band, begin)
            total += _between(own, coarse, low - 1 - begin * coarse, total.size)
        return _between(total, ratio, first - (low - 1) * ratio, count)

    def _add_band(self, out: np.ndarray, number: int, band: _Band, first: int) -> None:
        """Add one band at the places of its own grid from `first` on."""
        hop, weight = band.hop, _fades(band.size, band.hop)
        last = first + out.size
        for index in range(first // hop - 1, (last - 1) // hop + 1):
            begin = index * hop
            low, high = max(begin, first), min(begin + band.size, last)
            if low >= high:
                continue
            inside = slice(low - begin, high - begin)
            block = _block(self, number, index)
            out[low - first : high - first] += weight[inside] * block[inside]


@lru_cache(maxsize=4)
def _fades(size: int, hop: int) -> np.ndarray:
    """Weights of a block (size,) float32: sin to 1, and cos from the next block's beginning on."""
    angle = (np.arange(size - hop) + 0.5) * (np.pi / 2 / (size - hop))
    out = np.ones(size, np.float32)
    out[: size - hop], out[hop:] = np.sin(angle), np.cos(angle)
    out.setflags(write=False)
    return out


@lru_cache(maxsize=48)
def _block(oscillator: Oscillator, number: int, index: int) -> np.ndarray:
    """The phase within one block of a band (size,) float32 [rad]."""
    band = oscillator.bands()[number]
    width = 1 / (band.size * band.step)
    lines = np.arange(int(np.ceil(band.low / width)), int(np.ceil(band.high / width)))
    rng = generator(oscillator.seed, "oscillator", oscillator.name, number, index)
    amplitude = _amplitudes(oscillator.mask, band)
    spectrum = np.zeros(band.size // 2 + 1, np.complex64)
    drawn = rng.standard_normal(2 * lines.size, dtype=np.float32).view(np.complex64)
    spectrum[lines] = drawn * amplitude
    out = scipy.fft.irfft(spectrum, band.size)
    out.setflags(write=False)
    return out


@lru_cache(maxsize=64)
def _amplitudes(mask: Mask, band: _Band) -> np.ndarray:
    """Size of each line of a block, for `scipy.fft.irfft`, float32.

    What the cubic between the values takes away of the highest frequencies, in the mean over all
    places, is given back.
    """
    width = 1 / (band.size * band.step)
    lines = np.arange(int(np.ceil(band.low / width)), int(np.ceil(band.high / width)))
    offset = lines * width
    phasors = np.exp(2j * np.pi * np.outer(np.array([-1, 0, 1, 2]), offset * band.step))
    share = (np.arange(16) + 0.5) / 16
    kept = np.sqrt((np.abs(cubic(share) @ phasors) ** 2).mean(axis=0))
    size = np.sqrt(2 * mask.level(offset) * width) * (band.size / 2) / kept
    return size.astype(np.float32)


def oscillator_of(o: settings.Oscillator, rate: float, seed: int, name: str) -> Oscillator | None:
    """The oscillator that a scenario states of a terminal; None where it is ideal."""
    if o.ideal:
        return None
    return Oscillator(Mask(o.mask_dbc_hz, o.locked), rate, seed, name)


def spread(mask: Mask | None, lag: float, duration: float, rate: float) -> np.ndarray:
    r"""Variances of phi(t) - phi(t - `lag`): of its mean over `duration` and of what is left
    within it (2,) [rad^2].

    .. math:: \int 2 L(f)\, 4\sin^2(\pi f \Delta)\,\{\mathrm{sinc}^2(fT),\ 1 -
        \mathrm{sinc}^2(fT)\}\,df

    Parameters
    ----------
    lag : Delta [s]; inf: of two oscillators, of which both have this mask
    """
    if mask is None:
        return np.zeros(2)
    offset = np.geomspace(SLOWEST, rate / 2, 4001)
    shape = 2.0 if np.isinf(lag) else 4 * np.sin(np.pi * offset * lag) ** 2
    density = 2 * mask.level(offset) * shape
    mean = np.sinc(offset * duration) ** 2
    both = np.stack([density * mean, density * (1 - mean)])
    return np.trapezoid(both, offset)
