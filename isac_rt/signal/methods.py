"""The methods of synthesis as values: each holds its own numbers and makes samples of tones and
noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.vector import new_memory
from isac_rt.propagation.clutter.merging import resolution_cell
from isac_rt.signal.choice import CANDIDATES, DIRECT, SHIPPED, CostModel, Cover, read
from isac_rt.signal.covered import covered_error, summed_share
from isac_rt.signal.direct import add_direct
from isac_rt.signal.exact import exact
from isac_rt.signal.gridded import (
    COVERING,
    DEFAULT,
    GRIDDED_ERROR,
    Setting,
    grid_size,
    make_gridded,
)
from isac_rt.signal.noise import SILENCE, WhiteNoise
from isac_rt.signal.separable import separable
from isac_rt.signal.tones import Tones


@dataclass(frozen=True)
class Exact:
    """Float64 per path and sample: the truth that the fast methods are held against.

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
    """The paper's separable model, for comparison (`isac_rt.signal.separable`)."""

    name: ClassVar[str] = "paper"

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        samples = separable(waveform, tones).astype(np.complex64)
        noise.add_to(samples)
        return samples


@dataclass(frozen=True)
class Direct:
    """Path by path in float32 sums: relative error 1e-6, time in proportion to the paths."""

    name: ClassVar[str] = "direct"

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        every = np.ones(tones.size, bool)
        return _made(waveform, tones, noise, Choice(DEFAULT, every, ~every))


@dataclass(frozen=True)
class Gridded:
    """All paths through a grid of frequencies, for many: the error is that of the `setting`, of all
    or of those that noise covers (`faint`)."""

    name: ClassVar[str] = "gridded"
    setting: Setting = DEFAULT
    faint: bool = False

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        none, faint = np.zeros(tones.size, bool), np.full(tones.size, self.faint)
        return _made(waveform, tones, noise, Choice(self.setting, none, faint))


class Choice(NamedTuple):
    """Setting of the grid, and which paths (K,) go direct past it; which of the others noise
    covers."""

    setting: Setting
    alone: np.ndarray
    faint: np.ndarray


@dataclass(frozen=True)
class Auto:
    """All direct, or a grid and some paths direct, whichever is cheapest within an error.

    Direct go lines of sight (their joint curvature is not gridded); paths too fast for `max_error`;
    and of those whose error, integrated coherently over the cube, could exceed the noise of a cell
    (power error^2 size > noise_power), the `max_direct` strongest. Some settings have a faster way
    with a larger error for paths that noise covers: all of a range-Doppler cell together keep it
    under `covered` times the noise, integrated coherently over the cube.

    Attributes
    ----------
    noise_power : per complex sample [W]; with 0 the `max_direct` strongest paths go direct
    max_error : relative RMS error of the samples, at least that of the direct method (1e-6); of
        those of paths that noise does not cover
    max_direct : paths that go direct for their strength, at the most
    costs : what the methods cost; None: what ships with the program
    decide_for : number of paths whose cost decides, where the links hold some of them only
    covered : error that noise covers, over the noise of a cell of all elements and chirps; 0: no
        path is taken for covered
    """

    name: ClassVar[str] = "auto"
    noise_power: float = 0.0
    max_error: float = GRIDDED_ERROR
    max_direct: int = 16
    costs: CostModel | None = None
    decide_for: int | None = None
    covered: float = 0.0

    def samples(self, waveform: Waveform, tones: Tones, noise: WhiteNoise = SILENCE) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        shape, speed = _shape(waveform, tones), tones.speed(waveform.frame_duration)
        cover = _cover(waveform, tones) if self.covered and tones.size else None
        choice = self.choose(shape, tones.power, speed, tones.sight, cover)
        return _made(waveform, tones, noise, choice)

    def choose(
        self,
        shape: tuple[int, ...],
        power: np.ndarray,
        speed: np.ndarray,
        sight: np.ndarray,
        cover: Cover | None = None,
    ) -> Choice:
        """How a cube of this shape (M, L_rx, P, N) is made.

        Parameters
        ----------
        power, speed, sight : (K,) of each path: received power [W], c ``|delay rate|`` / 2 [m/s],
            whether it is a line of sight
        cover : which paths noise may cover; None: it is taken to cover none
        """
        model = self.costs or read(SHIPPED)
        scale = 1.0 if self.decide_for is None else self.decide_for / max(power.size, 1)
        size, none = float(np.prod(shape)), np.zeros(power.size, bool)
        best = Choice(DEFAULT, ~none, none)
        least = model.seconds(DIRECT, shape, scale * power.size)
        top = _strongest(power, self.max_direct)
        for candidate in CANDIDATES:
            error = candidate.error_at(speed)
            strong = power * error**2 * size > self.noise_power
            faint = none
            if cover is not None:
                limit = self.covered * self.noise_power / size
                faint = ~sight & candidate.covered(power, cover, limit)
            alone = ~faint & ((strong & top) | sight | (error > self.max_error))
            if alone.all():
                continue
            dearer = scale if cover is None else scale * cover.dearer
            several = scale * int((~alone & ~faint).sum()), dearer * int(faint.sum())
            cost = model.seconds(candidate.name, shape, *several)
            if alone.any():
                cost += model.seconds(DIRECT, shape, scale * int(alone.sum()))
            if cost < least:
                best, least = Choice(candidate.setting, alone, faint), cost
        return best


Method = Exact | Direct | Gridded | Auto | Separable


def _strongest(power: np.ndarray, count: int) -> np.ndarray:
    """Which (K,) of some powers are the strongest, so many of them; of equal ones the first."""
    if count >= power.size:
        return np.ones(power.size, bool)
    least = np.partition(power, power.size - count)[power.size - count] if count else np.inf
    top = power > least
    top[np.flatnonzero(power == least)[: count - top.sum()]] = True
    return top


def _shape(waveform: Waveform, tones: Tones) -> tuple[int, ...]:
    w = waveform
    return w.num_groups, tones.rx_delay.shape[1], w.num_chirps, w.num_samples


def _cover(waveform: Waveform, tones: Tones) -> Cover:
    """Where paths are seen, and their errors if noise is taken to cover them."""
    size = grid_size(waveform.num_samples, COVERING.oversampling, COVERING.width)
    cell = resolution_cell(waveform, tones.delay, tones.rate)
    dearer = summed_share(waveform, tones, size)
    return Cover(cell, covered_error(waveform, tones, size), dearer)


def _made(waveform: Waveform, tones: Tones, noise: WhiteNoise, choice: Choice) -> np.ndarray:
    """Samples with some paths made one by one, the others through a grid, and noise."""
    samples = new_memory(_shape(waveform, tones))
    setting, alone, faint = choice
    strong = tones.select(alone)
    if alone.all():
        add_direct(samples, waveform, strong, fresh=True)
        noise.add_to(samples)
    else:
        rest = tones.select(~alone)
        parts = {"faint": faint[~alone], "alone": strong, "noise": noise}
        make_gridded(samples, waveform, rest, setting, **parts)
    return samples
