"""Delay symbols and DPSK symbols of a frame, given a prediction of the reference path.

Every chirp is derotated by the predicted beat, fraction and migration included, so that the symbol
is the number of the strongest cell. A prediction that is a whole cell off gives symbols that are
all one off: the same signal. That is why the search runs a few cells past the alphabet (`raw`),
where such a slip shows.

With all of the frame's paths estimated, DPSK phases are decided once more (`decide_phases`):
differential decisions chain, so that one wrong transition turns all later chirps of its antenna and
group, and what is sensed with such phases is off by many of its standard deviations. The chirps are
added over the receivers in phase and held against one carrier phase per antenna for the whole
frame. That carrier and what is left of the velocity are found without the data: to the power D a
chirp's phase no longer holds them (Viterbi and Viterbi). A wrong decision then spoils its own chirp
alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import special

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import by_antenna, demodulate_bits, passes_check, running_phases
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.vector import new_memory
from isac_rt.receive.clutter_filter import runs
from isac_rt.receive.joint.fit import fit, match_chirps
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.joint.tones import JointPath, rate_bin
from isac_rt.receive.known import Known
from isac_rt.receive.spectrum import tones, transform
from isac_rt.receive.types import Prediction

EXTRA_CELLS = 4
WEAKEST_WEIGHT = 0.05  # predicted paths below this share of the strongest do not vote on the symbol

GATHERED = 0.6
"""Share of the spread of phases that lie anywhere, below which the spread of transitions about
their symbols is their error: wrapping hides a tenth of it at most."""

UNREAD_RATE = 0.1
"""Chance that noise in a chirp reaches the level that half the chirps of a frame must reach."""
PREDICTED_STDS, MAX_READABLE_CYCLES = 3.0, 1 / 3
"""Deviations of the predicted velocity within which a path moves as predicted, and turn of a mean
transition [symbols]: beyond it most are wrong."""
ELSEWHERE_RATE = 1e-4
"""Chance that noise makes the phases of a path that moves as predicted likelier elsewhere."""


class Gathering(NamedTuple):
    """Mean cosine of the D-th powers of transitions, for the best velocity `inside` what the
    prediction allows and the best of all `outside`, and the numbers of `transitions` and of
    `velocities` tried."""

    inside: float
    outside: float
    transitions: int
    velocities: int

    def elsewhere(self, phase_noise: float) -> bool:
        """Return whether a velocity outside is likelier than those inside beyond chance.

        Phases to the power D have von Mises' density of a concentration that follows from the RMS
        `phase_noise` of the D-th powers [rad], or from what is seen, which clutter spreads. Where
        the path moves as predicted, the likelihood ratio to each other velocity exceeds 1/q with a
        chance of q at most (Markov).
        """
        mean = min(np.exp(-(phase_noise**2) / 2), max(self.inside, self.outside, 0.0), 1 - 1e-9)
        concentration = mean * (2 - mean**2) / (1 - mean**2)
        ratio = self.transitions * concentration * (self.outside - self.inside)
        return bool(ratio > np.log(self.velocities / ELSEWHERE_RATE))


@dataclass(frozen=True)
class Symbols:
    """Decisions of a frame; shapes as in `Reception`.

    `confidence` of a delay symbol is its cell's power over the mean of the other cells; of a
    transition, the cosine-like share
    |sum y conj(y')| / sum |y y'|, in [0, 1]. `phase_spread` is the RMS distance of the transitions
    from their symbols [rad], `least_spread` the least that it is for any velocity within
    `PREDICTED_STDS` deviations of the predicted one; None: the same. `gathering` compares these
    velocities with all others; None: not compared. `looks` receivers are added in power.
    """

    raw: np.ndarray
    delay: np.ndarray
    delay_confidence: np.ndarray
    transitions: np.ndarray
    transition_confidence: np.ndarray
    phase_spread: float
    phases: np.ndarray
    bits: np.ndarray
    looks: int
    least_spread: float | None = None
    gathering: Gathering | None = None

    def is_intact(self, waveform: Waveform, order: int) -> bool:
        """Return whether the check sums among the bits hold."""
        return passes_check(self.bits, waveform, order)

    def with_phases(self, decided: CarrierPhases | None, known: Known, order: int) -> Symbols:
        """Return the same delay symbols with phases that were decided once more, if the check sums
        hold then; else these."""
        for phases in () if decided is None else (decided.phases, decided.second):
            chains = by_antenna(phases, known.schedule, known.waveform.num_tx)
            phase_steps = np.angle(chains[..., 1:] * chains[..., :-1].conj())
            transitions = np.round(phase_steps * order / (2 * np.pi)).astype(np.int64) % order
            again = replace(
                self,
                transitions=transitions,
                phases=running_phases(transitions, known.schedule, order),
                bits=demodulate_bits(self.delay, transitions, known.waveform, order),
            )
            if again.is_intact(known.waveform, order):
                return again
        return self


@lru_cache(maxsize=64)
def confidence_threshold(num_rx: int, num_cells: int, num_chirps: int) -> float:
    """Median delay confidence over a frame that noise alone exceeds in fewer than one frame in a
    million, and that a frame exceeds of whose symbols less than about four in ten are wrong.

    In noise the confidence is the largest of `num_cells` Gamma(L_rx) means. Its median over the
    chirps exceeds the level that one chirp exceeds with probability q in P[Binomial(num_chirps, q)
    >= num_chirps/2]. At q = `UNREAD_RATE` half of the chirps reach the level where noise decides
    0.35 to 0.4 of the symbols, for 9 to 15 receivers.
    """
    share = np.linspace(0.01, 0.5, 491)
    tail = special.bdtrc(num_chirps // 2 - 1, num_chirps, share)
    q = min(float(share[np.flatnonzero(tail < 1e-6)[-1]]), UNREAD_RATE)
    return float(special.gammaincinv(num_rx, (1 - q) ** (1 / num_cells)) / num_rx)


def symbol_cells(waveform: Waveform) -> np.ndarray:
    """Where a derotated chirp may have its symbol: the alphabet and `EXTRA_CELLS` on both sides."""
    return np.arange(-EXTRA_CELLS, waveform.num_delay_symbols + EXTRA_CELLS)


def demodulate(
    cube: IFCube,
    prediction: Prediction,
    dpsk_order: int,
    run_cells: int | None = None,
) -> Symbols:
    """Decide all symbols of a frame.

    Parameters
    ----------
    cube : IFCube of a modulated frame
    prediction : row 0 is the reference path; further rows vote with their predicted power
    dpsk_order : D
    run_cells : leave runs of so many occupied cells out of the decision
        (`isac_rt.receive.clutter_filter`); None: do not look
    """
    w = cube.waveform
    delays, rates = prediction.range / SPEED_OF_LIGHT, prediction.velocity / SPEED_OF_LIGHT
    beats = w.beat_cells(delays[0], rates[0])
    others = [
        (
            float(prediction.weight[k]),
            np.round(w.beat_cells(delays[k], rates[k]) - beats).astype(int),
        )
        for k in range(1, delays.size)
        if prediction.weight[k] >= WEAKEST_WEIGHT
    ]
    shape = cube.schedule.shape
    raw, sure = np.empty(shape, np.int64), np.empty(shape)
    picked = np.empty((shape[0], cube.samples.shape[1], shape[1]), np.complex128)
    cells = symbol_cells(w)
    spectra = new_memory((picked.shape[1], cells.size, shape[1]))
    for m in range(shape[0]):
        derotation = tones(-beats[m] / w.num_samples, w.num_samples)
        power, tapered = np.zeros((2, *derotation.shape), np.float32)
        wanted = None if run_cells is None else tapered
        transform(cube.samples[m], derotation, cells, spectra, power=power, tapered=wanted)
        if run_cells is not None:
            power[runs(tapered / len(spectra), len(spectra), run_cells)] = 0
        raw[m], sure[m] = decide(power, [(g, o[m]) for g, o in others], w)
        picked[m] = spectra[:, raw[m] - cells[0], np.arange(shape[1])]
    delay = np.clip(raw, 0, w.num_delay_symbols - 1)
    cycles = known_cycles(w, delays[0], rates[0], raw)
    picked *= np.exp(-2j * np.pi * cycles)[:, None, :]
    summed, share = transition_sums(picked, cube.schedule, w.num_tx)
    transitions, spread = nearest_symbols(summed, dpsk_order)
    times = by_antenna(w.middle_time + raw * w.delay_step, cube.schedule, w.num_tx)
    lengths = np.diff(times, axis=-1)
    far = PREDICTED_STDS * prediction.velocity_std[0] / SPEED_OF_LIGHT * w.effective_carrier
    return Symbols(
        raw=raw,
        delay=delay,
        delay_confidence=sure,
        transitions=transitions,
        transition_confidence=share,
        phase_spread=spread,
        phases=running_phases(transitions, cube.schedule, dpsk_order),
        bits=demodulate_bits(delay, transitions, w, dpsk_order),
        looks=cube.samples.shape[1],
        least_spread=least_spread(summed, lengths, far, dpsk_order),
        gathering=gathering(summed, lengths, far, 0.5 / w.slot_duration, dpsk_order),
    )


@dataclass(frozen=True)
class ByPowers:
    """The paper's reader: the receivers' powers added.

    Attributes
    ----------
    order : D of the DPSK
    run_cells : leave runs of so many occupied cells out of the decision; None: do not look
    """

    order: int
    run_cells: int | None = None

    def read(self, cube: IFCube, prediction: Prediction, antennas: Antennas) -> Symbols:
        """The symbols of a modulated frame."""
        return demodulate(cube, prediction, self.order, self.run_cells)


def known_cycles(
    waveform: Waveform, delay: float, delay_rate: float, raw: np.ndarray
) -> np.ndarray:
    """(M, P) phase [cycles] of the picked cells of a path that is as predicted and carries the
    symbols `raw`, but for its DPSK."""
    w, beats = waveform, waveform.beat_cells(delay, delay_rate)
    cycles = w.phase(delay + delay_rate * w.middle_time, w.window_middle)
    cycles = cycles - beats * (w.window_length / 2 / w.num_samples)
    return cycles + w.data_phase(raw) - (w.slope * w.delay_step * raw) * delay


def decide(
    power: np.ndarray, others: list[tuple[float, np.ndarray]], waveform: Waveform
) -> tuple[np.ndarray, np.ndarray]:
    """Strongest symbol of every chirp in [-EXTRA_CELLS, N/2 + EXTRA_CELLS) and its confidence, from
    (P, N) power."""
    cells = symbol_cells(waveform)
    metric = power[:, cells % waveform.num_samples].astype(np.float64)
    chirps = np.arange(power.shape[0])[:, None]
    for weight, offset in others:
        metric += weight * power[chirps, (cells[None, :] + offset[:, None]) % waveform.num_samples]
    best = metric.argmax(axis=1)
    peak = metric[chirps[:, 0], best]
    rest = (metric.sum(axis=1) - peak) / (cells.size - 1)
    return cells[best], peak / np.maximum(rest, 1e-300)


def transition_sums(
    picked: np.ndarray, schedule: np.ndarray, num_tx: int
) -> tuple[np.ndarray, np.ndarray]:
    """Products of each antenna's consecutive chirps with the conjugate of the earlier one, summed
    over receivers, (M, L_tx, P/L_tx - 1), and the share of the aligned sum that they reach."""
    chains = by_antenna(picked, schedule, num_tx)  # M, L_tx, L_rx, P/L_tx
    product = chains[..., 1:] * chains[..., :-1].conj()
    summed = product.sum(axis=2)
    return summed, np.abs(summed) / np.maximum(np.abs(product).sum(axis=2), 1e-300)


def decide_transitions(
    picked: np.ndarray, schedule: np.ndarray, num_tx: int, order: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """DPSK symbols of `transition_sums`, their shares and their `phase_spread`."""
    summed, share = transition_sums(picked, schedule, num_tx)
    symbols, spread = nearest_symbols(summed, order)
    return symbols, share, spread


def nearest_symbols(summed: np.ndarray, order: int) -> tuple[np.ndarray, float]:
    """DPSK symbols of products of chirps, and their `phase_spread`."""
    steps = np.angle(summed) / (2 * np.pi / order)
    spread = np.sqrt(np.mean((steps - np.round(steps)) ** 2)) * 2 * np.pi / order
    return np.round(steps).astype(np.int64) % order, float(spread)


def least_spread(summed: np.ndarray, length: np.ndarray, far: float, order: int) -> float:
    """Return the least `phase_spread` of `transition_sums`, `length` apart in time [s], of all
    errors of the Doppler frequency up to `far` [Hz], and to `MAX_READABLE_CYCLES`."""
    phase, radians = np.angle(summed), 2 * np.pi * length
    far = min(far, MAX_READABLE_CYCLES / (order * float(length.mean())))
    # neighbouring errors turn the longest transition by a fifth of a symbol
    steps = int(np.ceil(far * length.max() * order / 0.2))
    errors = np.linspace(-far, far, 2 * steps + 1)
    off = (phase - np.multiply.outer(errors, radians)) / (2 * np.pi / order)
    spread = ((off - np.round(off)) ** 2).reshape(errors.size, -1).mean(axis=1)
    return float(np.sqrt(spread.min()) * 2 * np.pi / order)


def gathering(
    summed: np.ndarray, length: np.ndarray, far: float, farthest: float, order: int
) -> Gathering:
    """Return how `transition_sums`, `length` apart in time [s], gather for errors of the Doppler
    frequency up to `far` [Hz], and for those beyond, up to `farthest`."""
    radians = 2 * np.pi * order * length.ravel()
    # spacings that turn the longest transition to the power D by a fiftieth, and by a fifth
    fine, coarse = (share / (length.max() * order) for share in (0.02, 0.2))
    near = np.linspace(-far, far, 2 * int(np.ceil(far / fine)) + 1)
    beyond = np.arange(far + coarse, farthest, coarse)
    beyond = np.concatenate([-beyond, beyond])
    inside, outside = (
        np.cos(order * np.angle(summed).ravel() - np.multiply.outer(errors, radians)).mean(axis=1)
        for errors in (near, beyond)
    )
    size = near.size + beyond.size
    return Gathering(float(inside.max()), float(outside.max(initial=-1.0)), summed.size, size)


def moves_as_predicted(symbols: Symbols, order: int) -> bool:
    """Return whether the DPSK phases gather at the symbols, as far as the noise lets this be seen.

    The delay decisions take whatever path is strongest, and the DPSK decisions take up the whole
    symbols of its Doppler, so that a reflection always ends up near the predicted cell. But unless
    it moves as predicted its phases lie anywhere between the symbols: a spread of pi/D/sqrt(3).
    A path that the prediction allows, within its deviation, moves as predicted, unless another
    velocity explains the phases better (`Gathering`).
    """
    anywhere = np.pi / order / np.sqrt(3)
    from_noise, least = transition_noise(symbols), symbols.least_spread
    spread = symbols.phase_spread if least is None else min(least, symbols.phase_spread)
    if from_noise > 0.6 * anywhere:
        return True
    elsewhere = symbols.gathering is not None and symbols.gathering.elsewhere(order * from_noise)
    return bool(spread < 0.8 * anywhere) and not elsewhere


def transition_noise(symbols: Symbols) -> float:
    """RMS phase that noise gives a transition [rad], by the confidence of the delay symbols: with g
    the SNR of a cell, sqrt((1 + 1/(2 g)) / (L_rx g))."""
    g = max(float(np.median(symbols.delay_confidence)) - 1, 1e-3)
    return float(np.sqrt((1 + 1 / (2 * g)) / (symbols.looks * g)))


def transition_error(symbols: Symbols, order: int) -> float:
    """RMS phase error of a transition [rad]: what noise gives, or what is seen where the phases
    gather and clutter in the other cells makes the noise look stronger."""
    anywhere, seen = np.pi / order / np.sqrt(3), symbols.phase_spread
    noise = transition_noise(symbols)
    return min(noise, seen) if seen < GATHERED * anywhere else noise


def transition_error_rate(symbols: Symbols, order: int) -> float:
    """Share of the transitions that are expected to have turned to a neighbouring symbol."""
    error = max(transition_error(symbols, order), 1e-9)
    return float(special.erfc(np.pi / order / (np.sqrt(2) * error)))


def velocity_spread(
    symbols: Symbols, order: int, prediction: Prediction, waveform: Waveform
) -> float:
    """Standard deviation that decided transitions add to all velocities of a frame [m/s].

    Two things are in it. A wrong transition turns the rest of its chain by 2 pi/D: over n chirps
    with an error rate q the phase walks, and the slope of a walk has the variance 6 q n / (5 D^2)
    in squared turns per chain, over M L_tx chains. And decisions take up part of what the predicted
    velocity is off: a phase error moves their mean by all but the density of the noise, wrapped to
    2 pi/D, at the edge between two symbols, times 2 pi/D.
    """
    w, step = waveform, 2 * np.pi / order
    rate = transition_error_rate(symbols, order)
    walk = 1.2 * rate * w.num_chirps / (w.num_tx * order) ** 2 / len(symbols.raw)
    error = min(max(transition_error(symbols, order), 1e-9), 4 * step)  # beyond, all is lost
    edges = (np.arange(-30, 30) + 0.5) * step / error
    lost = float(np.exp(-(edges**2) / 2).sum()) * step / (error * np.sqrt(2 * np.pi))
    return float(np.hypot(np.sqrt(walk) * w.velocity_cell(1), lost * prediction.velocity_std[0]))


FARTHEST = 1.5
"""Error of the first velocity within which it is sought [bins]."""
STEP = 0.32
"""Spacing of the offsets tried, in bins of the D-th power: a line between two loses 4 %."""
UNAMBIGUOUS = 0.45
"""Share of the D-th power's period in velocity, P/D bins, that is searched on each side."""
FALSE_RATE = 1e-3
"""Chance that noise is taken for the carrier."""
ROUNDS = 2


class CarrierPhases(NamedTuple):
    """Running phases (M, P) decided against one carrier over a frame, the velocity's error [bins]
    that they show, and the phases with the least sure chirp at its second choice."""

    phases: np.ndarray
    offset: float
    second: np.ndarray


def decide_phases(moments: Moments, path: JointPath, order: int) -> CarrierPhases | None:
    """Return the running phases of a modulated frame at a PT; None where it shows no carrier.

    Hard decisions add up nearly in phase whatever the carrier and the velocity: of uniform phases
    they leave sin(pi/D)/(pi/D) of the sum, 0.994 for D = 16. So it is no evidence that the decided
    chirps gather. What counts is that the D-th powers do, more than noise makes them.

    Parameters
    ----------
    moments : of the frame's samples, with the phases decided so far
    path : near estimate of the reference path, within 1.5 Doppler bins
    order : D

    Returns
    -------
    CarrierPhases; phases are as sent but for whole steps that an antenna has in common over the
    frame: those belong to its amplitude
    """
    known, decided = moments.known, None
    for _ in range(ROUNDS):
        path = fit(moments, [path]).paths[0]
        matched = match_chirps(moments, path)
        decision = decide_by_carrier(known, matched * known.phases, order)
        if decision is None:
            break
        decided = decision
        rate = path.delay_rate + decision.offset * rate_bin(known.waveform)
        path = replace(path, delay_rate=rate)
        known = replace(known, phases=decision.phases)
        moments = moments.read_by(known)
    return decided


def decide_by_carrier(known: Known, chirps: np.ndarray, order: int) -> CarrierPhases | None:
    """Return the phases of the chirps' sums (M, P); None where noise alone would show as much."""
    w = known.waveform
    far = min(FARTHEST, UNAMBIGUOUS * w.num_chirps / order)
    offsets = np.linspace(-far, far, 2 * int(np.ceil(far * order / STEP)) + 1)
    times = known.sampled_times / w.frame_duration
    powers = (chirps / np.maximum(np.abs(chirps), 1e-300)) ** order
    sums = np.array(
        [
            np.exp(-2j * np.pi * order * np.outer(offsets, times[a])) @ powers[a]
            for a in known.sent_by
        ]
    )
    counts = np.array([[a.sum()] for a in known.sent_by])
    line = (np.abs(sums) ** 2 / counts).sum(axis=0)  # in noise a sum of L_tx exponentials
    best = int(line.argmax())
    if line[best] < special.gammainccinv(w.num_tx, FALSE_RATE / offsets.size):
        return None
    carrier = np.angle(sums[:, best])[known.schedule] / order
    exact = (np.angle(chirps) - 2 * np.pi * offsets[best] * times - carrier) * order / (2 * np.pi)
    steps = np.round(exact)
    doubt = np.unravel_index(np.abs(exact - steps).argmax(), steps.shape)
    side = np.sign(exact - steps)[doubt]
    for a in known.sent_by:  # as before, in the middle
        common_phase = np.exp(2j * np.pi * steps[a] / order) @ known.phases[a].conj()
        steps[a] -= np.round(np.angle(common_phase) * order / (2 * np.pi))
    phases = np.exp(2j * np.pi * steps / order)
    second = phases.copy()
    second[doubt] *= np.exp(2j * np.pi * side / order)
    return CarrierPhases(phases, float(offsets[best]), second)
