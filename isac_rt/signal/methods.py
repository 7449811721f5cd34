"""The methods of synthesis as values: each holds its own numbers and makes samples of tones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.vector import cube_memory
from isac_rt.signal.choice import CANDIDATES, DIRECT, SHIPPED, CostModel, read
from isac_rt.signal.direct import add_direct
from isac_rt.signal.exact import exact
from isac_rt.signal.gridded import DEFAULT, GRIDDED_ERROR, Setting, add_gridded
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

    def samples(self, waveform: Waveform, tones: Tones) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        return exact(waveform, tones).astype(np.complex64)


@dataclass(frozen=True)
class Separable:
    """The paper's separable model, for comparison (`isac_rt.signal.separable`)."""

    name: ClassVar[str] = "paper"

    def samples(self, waveform: Waveform, tones: Tones) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        return separable(waveform, tones).astype(np.complex64)


@dataclass(frozen=True)
class Direct:
    """Path by path in float32 sums: relative error 1e-6, time in proportion to the paths."""

    name: ClassVar[str] = "direct"

    def samples(self, waveform: Waveform, tones: Tones) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        return _made(waveform, tones, DEFAULT, np.ones(tones.size, bool))


@dataclass(frozen=True)
class Gridded:
    """All paths through a grid of frequencies, for many: the error is that of the `setting`."""

    name: ClassVar[str] = "gridded"
    setting: Setting = DEFAULT

    def samples(self, waveform: Waveform, tones: Tones) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        return _made(waveform, tones, self.setting, np.zeros(tones.size, bool))


@dataclass(frozen=True)
class Auto:
    """All direct, or a grid and some paths direct, whichever is cheapest within an error.

    Direct go lines of sight (their joint curvature is not gridded); paths too fast for `max_error`;
    and of those whose error, integrated coherently over the cube, could exceed the noise of a cell
    (power error^2 size > noise_power), the `max_direct` strongest.

    Attributes
    ----------
    noise_power : per complex sample [W]; with 0 the `max_direct` strongest paths go direct
    max_error : relative RMS error of the samples, at least that of the direct method (1e-6)
    max_direct : paths that go direct for their strength, at the most
    costs : what the methods cost; None: what ships with the program
    decide_for : number of paths whose cost decides, where the links hold some of them only
    """

    name: ClassVar[str] = "auto"
    noise_power: float = 0.0
    max_error: float = GRIDDED_ERROR
    max_direct: int = 16
    costs: CostModel | None = None
    decide_for: int | None = None

    def samples(self, waveform: Waveform, tones: Tones) -> np.ndarray:
        """(M, L_rx, P, N) complex64."""
        speed = tones.speed(waveform.frame_duration)
        choice = self.choose(_shape(waveform, tones), tones.power, speed, tones.sight)
        return _made(waveform, tones, *choice)

    def choose(
        self, shape: tuple[int, ...], power: np.ndarray, speed: np.ndarray, sight: np.ndarray
    ) -> tuple[Setting, np.ndarray]:
        """Setting of the grid for a cube of this shape (M, L_rx, P, N), and which paths (K,) go
        direct past it.

        Parameters
        ----------
        power, speed, sight : (K,) of each path: received power [W], c ``|delay rate|`` / 2 [m/s],
            whether it is a line of sight
        """
        model = self.costs or read(SHIPPED)
        scale = 1.0 if self.decide_for is None else self.decide_for / max(power.size, 1)
        best = (DEFAULT, np.ones(power.size, bool))
        least = model.seconds(DIRECT, shape, scale * power.size)
        top = np.zeros(power.size, bool)
        top[np.argsort(-power, kind="stable")[: self.max_direct]] = True
        for candidate in CANDIDATES:
            error = candidate.error_at(speed)
            strong = power * error**2 * float(np.prod(shape)) > self.noise_power
            alone = (strong & top) | sight | (error > self.max_error)
            if alone.all():
                continue
            cost = model.seconds(candidate.name, shape, scale * int((~alone).sum()))
            if alone.any():
                cost += model.seconds(DIRECT, shape, scale * int(alone.sum()))
            if cost < least:
                best, least = (candidate.setting, alone), cost
        return best


Method = Exact | Direct | Gridded | Auto | Separable


def _shape(waveform: Waveform, tones: Tones) -> tuple[int, ...]:
    w = waveform
    return w.num_groups, tones.rx_delay.shape[1], w.num_chirps, w.num_samples


def _made(waveform: Waveform, tones: Tones, setting: Setting, alone: np.ndarray) -> np.ndarray:
    """Samples with the paths of the mask `alone` made one by one, the others through a grid."""
    samples = cube_memory(_shape(waveform, tones))
    if not alone.all():
        add_gridded(samples, waveform, tones.select(~alone), setting, fresh=True)
    add_direct(samples, waveform, tones.select(alone), fresh=bool(alone.all()))
    return samples
