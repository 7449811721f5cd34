r"""A terminal's estimate of its own hardware, from frame to frame.

An echo at the active terminal has in the channel of transmit element t and receive element r

.. math:: A\, s_{tr}(u)\, e^{\rho_r + \tau_t}\,\bigl(1 + (\rho'_r + \tau'_t) P_1(x) + c_2 P_2(x) +
    c_3 P_3(x)\bigr)

with the array's response s towards u, complex logarithms of the elements' gains, their slopes over
the chirp (a delay is an imaginary one), and a response that is common to all. At a passive terminal
every transmit element has an amplitude A of its own, for it is another terminal's. Samples are
corrected by what is known so far; what a measured path still shows is the correction of that.

Amplitudes and phases are two Gaussians of independent elements, carried in information form, so
that what no measured path tells stays as the prior has it: the common gain and phase and, where the
direction of a measured path is not known from elsewhere, what turns all directions alike. The
amplitude of a measured path, its delay and its direction are nuisances of each measured path anew,
of which the direction has the deviation that it is known by. The noise of a measured path is what
its channels hold beside one wave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.arms import element_delays
from isac_rt.receive.modes import MODES, polynomials
from isac_rt.receive.types import PathChannels
from isac_rt.track.parts import HardwareModel

GAIN_STD = 0.2, 0.6
"""Before the first measured path: logarithm of an element's amplitude (1.7 dB) and phase [rad] (34
degrees)."""
SLOPE_STD = 0.1
"""Of both, over the chirp."""
COMMON_STD = 0.5
"""Of what all elements have in common over the chirp."""
CLOCK_STD = (1e-8, 0.0), (1e-3, 1e-4)
"""Delay [s] and its rate beside what the geometry says: of a terminal's own boards, and between the
clocks of two."""
DRIFT = 0.01
"""How far gains [neper, rad] wander in a second."""
CLOCK_DRIFT = 1e-12, 1e-10
"""The same of delay [s] and rate."""
FREE = 0.2
"""Deviation of a direction cosine that the measured path itself is to find."""
CELLS = 0.02
"""Share of a cell to which a path's delay and rate are measured at best."""
ROUNDS = 5
LEAST_SNR = 1.0
"""Of a channel, under which a measured path says nothing."""
LEAST_NOISE = 1e-4
"""Least noise of a channel over its power: what plane waves and seven range rows leave out."""
MISFIT = 1.5
"""Misfit beyond what chance makes, from which on a measured path counts for less."""


class KnownDirection(NamedTuple):
    """From where a path is known to come.

    Attributes
    ----------
    direction : (2,) u_x, u_z
    radius : of its wavefront [m]
    direction_std : of both cosines; `FREE`: the measured path is to find them
    path : delay, delay rate and the deviations of both [s, 1, s, 1]; None where not known
    """

    direction: np.ndarray
    radius: float
    direction_std: float
    path: tuple[float, float, float, float] | None = None


class Change(NamedTuple):
    """Change of a terminal's hardware since an earlier frame: delay [s] with its rate, and offset
    in u_x and u_z (2,); `spread` (2,) is the deviation of a direction estimate from that."""

    delay: float
    rate: float
    direction: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class Belief:
    """Independent Gaussians of elements, of amplitudes (row 0) and phases (row 1).

    Attributes
    ----------
    value : (2, K)
    information : (2, K, K), the inverse covariances
    """

    value: np.ndarray
    information: np.ndarray

    @classmethod
    def prior(cls, size: int, std: tuple[float, float]) -> Belief:
        """Zero means of these deviations."""
        return cls(np.zeros((2, size)), np.stack([np.eye(size) / s**2 for s in std]))

    def later(self, variance: float) -> Belief:
        """After a random walk of this variance."""
        if variance == 0:
            return self
        covariance = np.linalg.inv(self.information) + variance * np.eye(self.value.shape[1])
        return replace(self, information=np.linalg.inv(covariance))


@dataclass
class Hardware:
    """Estimate of a terminal's hardware.

    Attributes
    ----------
    gains, slopes : of the elements, at the active terminal the transmit elements first
    common, common_information : (2, MODES) response over the chirp that all elements have,
        amplitude and phase by mode, of which the first and the phase of the second belong to each
        path
    clock, clock_covariance : (2,) delay [s] and rate of paths beyond what the geometry says. An
        active terminal's boards are so late, and its samples are corrected; at a passive one it is
        mostly the clocks, and `PassiveTerminal` takes it out of ranges: to turn a tone by a
        microsecond would turn each data symbol by another phase
    time : of the last frame [s]
    """

    gains: Belief
    slopes: Belief
    common: np.ndarray
    common_information: np.ndarray
    clock: np.ndarray
    clock_covariance: np.ndarray
    time: float = np.nan


class SelfCalibration(HardwareModel):
    """Estimator of a terminal's hardware, and the correction of its samples by it.

    Parameters
    ----------
    passes : 2 at the active terminal, whose transmit elements are its own; 1 at a passive one
    """

    def __init__(self, waveform: Waveform, antennas: Antennas, passes: int) -> None:
        self.waveform, self._antennas, self._passes = waveform, antennas, passes
        receives = np.tile(np.eye(antennas.num_rx), (antennas.num_tx, 1))
        sends = np.repeat(np.eye(antennas.num_tx), antennas.num_rx, axis=0)
        self._elements = np.hstack([sends, receives]) if passes == 2 else receives
        self._amplitudes = np.ones((len(sends), 1)) if passes == 2 else sends
        size = self._elements.shape[1]
        self.state = Hardware(
            Belief.prior(size, GAIN_STD),
            Belief.prior(size, (SLOPE_STD, SLOPE_STD)),
            np.zeros((2, MODES)),
            np.full((2, MODES), COMMON_STD**-2),
            np.zeros(2),
            np.diag(np.square(CLOCK_STD[2 - passes])),
        )
        self._corrected = replace(self.state)  # by which the frame's samples were corrected

    @property
    def clock(self) -> np.ndarray:
        """Delay [s] and its rate by which all paths come late."""
        return self.state.clock

    # ---- samples

    def correct(self, cube: IFCube, time: float) -> IFCube:
        """The samples of a frame at `time` [s] without what is known of the hardware."""
        elapsed = 0.0 if np.isnan(self.state.time) else time - self.state.time
        self.state.time = time
        self.state.gains = self.state.gains.later(DRIFT**2 * elapsed)
        F = np.array([[1.0, elapsed], [0.0, 1.0]])
        self.state.clock = F @ self.state.clock
        walk = np.diag(np.square(CLOCK_DRIFT)) * (elapsed * (self.state.clock_covariance[1, 1] > 0))
        self.state.clock_covariance = F @ self.state.clock_covariance @ F.T + walk
        clock = self.state.clock if self._passes == 2 else np.zeros(2)
        self._corrected = replace(self.state, clock=clock)
        table = self._table(cube.waveform)
        out = np.empty_like(cube.samples)
        for m, senders in enumerate(cube.schedule):
            own = senders if self._passes == 2 else np.zeros_like(senders)
            for r in range(out.shape[1]):
                np.multiply(cube.samples[m, r], table[own, r], out=out[m, r])
        return replace(cube, samples=out)

    def _table(self, w: Waveform) -> np.ndarray:
        """(L_tx or 1, L_rx, N) complex64 by which samples of the antennas are multiplied."""
        n = np.arange(w.num_samples) - (w.num_samples - 1) / 2
        modes = polynomials(n / (w.window_length / 2))
        gain, slope, common = (
            v[0] + 1j * v[1]
            for v in (self.state.gains.value, self.state.slopes.value, self.state.common)
        )
        tone = 2 * np.pi * w.slope * self._corrected.clock[0] * w.sample_interval * n
        shared = common @ modes + 1j * tone
        own = self._elements if self._passes == 2 else self._elements[: self._antennas.num_rx]
        each = (own @ gain)[:, None] + np.multiply.outer(own @ slope, modes[1])
        table = np.exp(-(each + shared)).astype(np.complex64)
        return table.reshape(-1, self._antennas.num_rx, w.num_samples)

    # ---- measured paths

    def learn_all(self, seen: Sequence[tuple[PathChannels, KnownDirection]]) -> Change:
        """Take in the measured paths of a frame, and say how paths are seen otherwise from now
        on."""
        before, clock = self.state.gains.value[1], self.state.clock
        for measured, known_direction in seen:
            self.learn(measured, known_direction)
        change = self.state.gains.value[1] - before
        _, across = self._steering(KnownDirection(np.zeros(2), np.inf, FREE))
        lines = np.linalg.pinv(np.hstack([self._amplitudes, across]))[-2:] @ self._elements
        delay, rate = self.state.clock - clock
        spread = np.sqrt(np.mean(change**2) * (lines**2).sum(axis=1))
        return Change(delay, rate, lines @ change, spread)

    def learn(self, measured: PathChannels, known_direction: KnownDirection) -> None:
        """Take in a measured path at corrected samples."""
        towards, across = self._steering(known_direction)
        known, corrected = self.state, self._corrected
        gains = known.gains.value - corrected.gains.value
        slopes = known.slopes.value - corrected.slopes.value
        common, clock = known.common - corrected.common, known.clock - corrected.clock
        left_out = self._elements @ (gains[0] + 1j * gains[1])
        modes = measured.modes.reshape(MODES, -1) * np.exp(-left_out) * towards.conj()
        power = float(np.mean(np.abs(modes[0]) ** 2))
        noise = max(self._noise(modes[0], measured.snr), LEAST_NOISE * power)
        if noise * LEAST_SNR >= power:
            return
        fitted = self._fit(modes[0], noise, across, known_direction.direction_std)
        if fitted.misfit > MISFIT:
            noise *= fitted.misfit
            fitted = self._fit(modes[0], noise, across, known_direction.direction_std)
        self.state.gains = fitted.gains
        weight = 2 * np.abs(fitted.wave) ** 2 / noise
        left = modes[1:] / fitted.wave - (common[0] + 1j * common[1])[1:, None]
        left[0] -= self._elements @ (slopes[0] + 1j * slopes[1])
        self._learn_response(left, weight)
        self._learn_clock(measured, known_direction, clock)

    def _steering(self, known_direction: KnownDirection) -> tuple[np.ndarray, np.ndarray]:
        """Response (C,) of the channels to a wave, and its phase's derivative (C, 2) with respect
        to u_x and u_z."""
        omega, a = 2 * np.pi * self.waveform.effective_carrier, self._antennas
        towards = known_direction.direction, known_direction.radius
        rx, d_rx = element_delays(a.rx_positions, *towards)
        tx, d_tx = element_delays((self._passes - 1) * a.tx_positions, *towards)
        phase = omega * (tx[:, None] + rx).ravel()
        across = omega * (d_tx[:, :, None] + d_rx[:, None]).reshape(2, -1)
        return np.exp(1j * phase), across.T

    def _noise(self, received: np.ndarray, snr: float) -> float:
        """Power of a channel that is not of one wave: whatever the elements do to a wave, it stays
        a matrix of rank one."""
        by_antenna = received.reshape(self._antennas.num_tx, -1)
        free = (by_antenna.shape[0] - 1) * (by_antenna.shape[1] - 1)
        if free == 0:
            return float(np.mean(np.abs(received) ** 2)) / max(snr, 1.0)
        others = np.linalg.svd(by_antenna, compute_uv=False)[1:]
        return float((others**2).sum()) / free

    def _fit(
        self, received: np.ndarray, noise: float, across: np.ndarray, direction_std: float
    ) -> _Fitted:
        """The most likely gains with a measured path (C,) whose direction has been taken out, by
        Gauss and Newton."""
        E, B, K = self._elements, self._amplitudes, self._elements.shape[1]
        X = np.hstack([E, B]), np.hstack([E, B, across])
        priors = [_padded(self.state.gains.information[i], X[i].shape[1]) for i in (0, 1)]
        priors[1][-2:, -2:] = np.eye(2) / direction_std**2
        at = [np.zeros(x.shape[1]) for x in X]
        wave = received
        for _ in range(ROUNDS):
            model = np.exp(E @ at[0][:K] + 1j * (E @ at[1][:K] + across @ at[1][-2:]))
            power = B.T @ np.abs(model) ** 2
            wave = model * (B @ (B.T @ (received * model.conj()) / power))
            weight = 2 * np.abs(wave) ** 2 / noise
            left = received / wave - 1
            for i, part in enumerate((left.real, left.imag)):
                at[i][K : K + B.shape[1]] = 0  # the amplitude has just been fitted
                total = part + X[i] @ at[i]
                full = priors[i] + (X[i].T * weight) @ X[i]
                at[i] = np.linalg.solve(full, X[i].T @ (weight * total))
        cost, after = 0.0, []
        for i, part in enumerate((left.real, left.imag)):
            cost += float(weight @ part**2 + at[i] @ priors[i] @ at[i])
            after.append(_marginal(priors[i] + (X[i].T * weight) @ X[i], K))
        value = self.state.gains.value + np.stack([a[:K] for a in at])
        misfit = cost / (2 * max(len(received) - B.shape[1], 1))
        return _Fitted(Belief(value, np.stack(after)), wave, misfit)

    def _learn_response(self, left: np.ndarray, weight: np.ndarray) -> None:
        """Slopes of the elements, and what all have in common, from the modes (3, C) of degree 1 to
        3 over a measured path's wave."""
        K = self._elements.shape[1]
        X = np.hstack([self._elements, self._amplitudes])
        steps, after = [], []
        for i, part in enumerate((left[0].real, left[0].imag)):
            full = _padded(self.state.slopes.information[i], X.shape[1]) + (X.T * weight) @ X
            steps.append(np.linalg.solve(full, X.T @ (weight * part))[:K])
            after.append(_marginal(full, K))
        self.state.slopes = Belief(self.state.slopes.value + np.stack(steps), np.stack(after))
        own = np.stack([left[0] - self._elements @ (steps[0] + 1j * steps[1]), *left[1:]])
        mean = own @ weight / weight.sum()
        # a common imaginary slope is the path's delay
        seen = np.array([[0, 1, 1, 1], [0, 0, 1, 1]])
        new = np.stack([np.append(0, mean.real), np.append(0, mean.imag)]) * seen
        information = self.state.common_information + seen * weight.sum()
        self.state.common = self.state.common + new * (seen * weight.sum() / information)
        self.state.common_information = information

    def _learn_clock(
        self, measured: PathChannels, known_direction: KnownDirection, learnt: np.ndarray
    ) -> None:
        """By how much the path comes late, of which the frame's samples still hold what it has
        `learnt`."""
        if known_direction.path is None:
            return
        delay, rate, *std = known_direction.path
        left = np.array([measured.delay - delay, measured.delay_rate - rate]) - learnt
        best = CELLS * np.array([self.waveform.delay_step, self._rate_cell])
        P = self.state.clock_covariance
        gain = P @ np.linalg.inv(P + np.diag(np.square(std) + best**2))
        self.state.clock = self.state.clock + gain @ left
        self.state.clock_covariance = P - gain @ P

    @property
    def _rate_cell(self) -> float:
        return self.waveform.velocity_cell(1) / SPEED_OF_LIGHT


class _Fitted(NamedTuple):
    """Gains after a measured path, its wave (C,), and how much worse than its noise it fits."""

    gains: Belief
    wave: np.ndarray
    misfit: float


def _padded(information: np.ndarray, size: int) -> np.ndarray:
    """With further values of which nothing is known."""
    out = np.zeros((size, size))
    out[: len(information), : len(information)] = information
    return out


def _marginal(information: np.ndarray, size: int) -> np.ndarray:
    """Information of the first values, whatever the others are."""
    mixed, other = information[:size, size:], information[size:, size:]
    out = information[:size, :size] - mixed @ np.linalg.solve(other, mixed.T)
    return (out + out.T) / 2
