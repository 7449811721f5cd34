r"""A link acquired from data frames alone: no pilot, and any path.

A chirp of a data frame says where its cell lies, D + b(t) with an unknown symbol D and the beat b
of the path. Symbols are whole: chirp by chirp the fractions of the cells follow the beat's. Over a
batch of frames one path is left by its direction, the principal one of the chirps' strongest
cells, and its rate and fraction are where the comb

.. math:: \Big|\sum_i e^{j 2 \pi (c_i - r t_i - a t_i^2 / 2)}\Big|

is largest. What whole number of cells is still missing the alphabet says: data fill it, so that
only one shift leaves no symbol outside. A pilot in the batch says so too, as all its symbols are 0.

What is kept of a frame is small: the strongest cells of every chirp as each receive antenna sees
them (`Peaks`, 0.4 MB where the samples are 44). Symbols are decided from these once the path is
known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from isac_rt.extensions.city_receivers.beams import rate_error, transitions_of, vertex
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import by_antenna, demodulate_bits, running_phases
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.vector import new_memory
from isac_rt.receive.arms import element_delays
from isac_rt.receive.directions import denominators, search_of, settled
from isac_rt.receive.known import Known
from isac_rt.receive.spectrum import transform
from isac_rt.receive.symbols import Symbols, decide_by_carrier, known_cycles, nearest_symbols
from isac_rt.receive.types import Prediction

PEAKS = 8
"""Cells kept of every chirp. The strongest by power is the path's down to some 3 dB per cell and
antenna; by beam one of four still is some 3 dB under that, and one of eight in all chirps of a
frame."""
MIN_SPACING = 3
"""Half cells on each side of a cell that is kept in which no further one is."""
FASTEST = 45.0
"""Rate of a path's length within which it is sought [m/s]."""
CURVATURES, BENT = (-12.0, -6.0, 0.0, 6.0, 12.0), 6.0
"""Accelerations of the length that are tried, and their standard deviation [m/s^2]."""
FALSE_RATE = 1e-6
"""Chance that noise makes a chirp count."""
LEAST_SPREAD = 0.03
"""Deviation of a chirp's cell at least, for what other paths in it leave."""
LEAST_COMB = 0.5
LEAST_CHIRPS = 100
FRACTION = 0.25
"""Distance from the comb beyond which a chirp shows another path [cells]."""
READ_SHARE = 0.5
"""Share of a frame's chirps that must lie on the comb for its symbols to be read."""
MOST_OUTSIDE = 0.05
"""Share of chirps that may lie outside the alphabet."""
LEAST_ODDS = 300.0
"""Of the whole cells that are taken against any other."""
AGREED = 0.8
"""Share of a pilot's chirps that must agree on the whole cells."""
ALIAS_STDS, STEP_STDS = 4.0, 3.0
"""Deviations that a frame's own rate must keep from those that turn the comb by whole cells from
frame to frame, and the rate of all from those that turn every DPSK symbol by a whole step."""
JERK = 13.0
"""Variance that a path's acceleration gains [m^2/s^4/s]: its spread is new in 0.7 s."""


@dataclass(frozen=True)
class Peaks:
    """The strongest cells of every chirp of a frame, of which nothing else is known.

    Attributes
    ----------
    time : of the middle of the frame [s]
    modulated : whether the frame carries data
    waveform, schedule : public parameters of the frame
    cells : (M, P, K) where they lie, between half cells, strongest first
    values : (M, P, K, L_rx) complex64 of the half cells there, phases as in mid-chirp
    noise : mean power of an empty cell of one antenna
    """

    time: float
    modulated: bool
    waveform: Waveform
    schedule: np.ndarray
    cells: np.ndarray
    values: np.ndarray
    noise: float


@dataclass(frozen=True)
class DataPath:
    """A path over which data are read, whatever it is.

    Attributes
    ----------
    time : that the numbers are of [s]
    mean : (3,) length of the path, its rate and its acceleration [m, m/s, m/s^2]
    covariance : (3, 3) of these
    direction : (2,) u_x, u_z from which it arrives
    """

    time: float
    mean: np.ndarray
    covariance: np.ndarray
    direction: np.ndarray

    def at(self, time: float) -> DataPath:
        """The same path at another time."""
        t = time - self.time
        F = np.array([[1.0, t, t * t / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
        Q = np.diag([0.0, 0.0, JERK * abs(t)])
        return DataPath(time, F @ self.mean, F @ self.covariance @ F.T + Q, self.direction)

    def seen(self, measured: np.ndarray, std: np.ndarray, direction: np.ndarray) -> DataPath:
        """With its length and rate measured (2,), of deviations `std`, and its direction."""
        H = np.eye(2, 3)
        gain = self.covariance @ H.T @ np.linalg.inv(self.covariance[:2, :2] + np.diag(std**2))
        mean = self.mean + gain @ (measured - self.mean[:2])
        return DataPath(self.time, mean, (np.eye(3) - gain @ H) @ self.covariance, direction)

    @property
    def prediction(self) -> Prediction:
        """Return the prediction of the path."""
        one, std = np.ones(1), np.sqrt(np.diag(self.covariance))
        return Prediction(
            range=one * self.mean[0],
            velocity=one * self.mean[1],
            direction=self.direction[None],
            range_std=one * std[0],
            velocity_std=one * std[1],
            weight=one,
        )


def find_peaks(cube: IFCube, time: float, modulated: bool) -> Peaks:
    """The strongest cells of every chirp, on a grid of half cells; `time` is the frame's middle
    [s]."""
    w = cube.waveform
    groups, num_rx, chirps, size = cube.samples.shape
    fast = np.arange(size)
    halves = [np.exp(-1j * np.pi * h * fast / size) for h in (0, 1)]
    factors = [np.broadcast_to(h.astype(np.complex64), (chirps, size)) for h in halves]
    spectra = new_memory((2, num_rx, size, chirps))
    cells = np.empty((groups, chirps, PEAKS))
    half_cells = np.empty(cells.shape, np.int64)
    values = np.empty((*cells.shape, num_rx), np.complex64)
    noise = np.empty(groups)
    every, true = np.arange(chirps), np.linspace(-0.3, 0.3, 61)
    # of a tone without a window at `true` cells from the middle one of three half cells
    top = vertex(*(np.sinc(true - i / 2) ** 2 for i in (-1, 0, 1)))
    for m in range(groups):
        power = np.zeros((2, chirps, size), np.float32)
        for h in (0, 1):
            transform(cube.samples[m], factors[h], fast, spectra[h], power=power[h])
        dense = power.transpose(1, 2, 0).reshape(chirps, 2 * size)
        noise[m] = float(np.median(dense)) / gammaincinv(num_rx, 0.5)
        left = dense.copy()
        for k in range(PEAKS):
            at = left.argmax(axis=1)
            near = (at[:, None] + np.arange(-MIN_SPACING, MIN_SPACING + 1)) % (2 * size)
            left[every[:, None], near] = 0.0
            around = [dense[every, (at + i) % (2 * size)].astype(float) for i in (-1, 0, 1)]
            cells[m, :, k] = at / 2 + np.interp(vertex(*around), top, true)
            half_cells[m, :, k] = at
            values[m, :, k] = spectra[at % 2, :, at // 2, every]
    phasor = np.exp(1j * np.pi * half_cells / 2 * ((size - 1) / size))
    values = (values * phasor[..., None]).astype(np.complex64)
    frame = time, modulated, w, cube.schedule
    return Peaks(*frame, cells.astype(np.float32), values, float(noise.mean()))


def acquire(batch: Sequence[Peaks], antennas: Antennas, order: int) -> DataPath | None:
    """The path that the frames of a batch have in common, at the last one.

    Parameters
    ----------
    batch : in the order of time
    antennas : of the receiver
    order : D of the DPSK

    Returns
    -------
    path : None unless the comb shows one, its rate tells the DPSK symbols apart, and one whole
        number of cells is left
    """
    w = batch[0].waveform
    direction = _direction(batch, antennas, w)
    weights = _weights(direction, antennas, w)
    seen = [_Chirps.of(one, weights, batch[-1].time) for one in batch]
    fit = _comb([one for one in seen if one.modulated], w)
    if fit is None:
        return None
    state, covariance = fit
    cell = w.range_cell(1)
    step = SPEED_OF_LIGHT / (w.effective_carrier * order * w.num_tx * w.slot_duration)
    if STEP_STDS * np.sqrt(covariance[1, 1]) * cell > step / 2:
        return None
    whole = _whole_cells(seen, state, w.num_delay_symbols)
    if whole is None:
        return None
    rate = state[1] * cell / SPEED_OF_LIGHT
    beat = (state[0] + whole) / w.sampled_duration
    # the beat holds the path's Doppler, on a carrier that hardly depends on the delay
    delay = (beat - rate * w.carrier(beat / w.slope)) / w.slope
    mean = np.array([delay * SPEED_OF_LIGHT, state[1] * cell, state[2] * cell])
    return DataPath(batch[-1].time, mean, covariance * cell**2, direction)


def read_peaks(
    peaks: Peaks, prediction: Prediction, antennas: Antennas, order: int
) -> Symbols | None:
    """Decide the symbols of a frame that was kept; None where it does not show the path.

    Parameters
    ----------
    peaks : of a frame with data
    prediction : of the path, row 0
    order : D of the DPSK
    """
    w = peaks.waveform
    delay, rate = prediction.range[0] / SPEED_OF_LIGHT, prediction.velocity[0] / SPEED_OF_LIGHT
    beats = w.beat_cells(delay, rate)
    beams = peaks.values @ _weights(prediction.direction[0], antennas, w)
    power = np.abs(beams) ** 2
    off = peaks.cells - beats[..., None]
    whole = np.round(off).astype(np.int64)
    able = (whole >= 0) & (whole < w.num_delay_symbols)
    best = np.where(able, power, -1.0).argmax(axis=-1)[..., None]

    def of(values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, best, axis=-1)[..., 0]

    raw, strong = of(whole), of(power) / peaks.noise
    on = of(able) & (np.abs(of(off - whole)) < FRACTION) & (strong > _threshold(w))
    if on.mean() < READ_SHARE:
        return None
    raw = np.clip(raw, 0, w.num_delay_symbols - 1)
    # from the middle of the samples back to where the reader counts phases from
    phasors = np.exp(-1j * np.pi * (beats + raw) * ((w.num_samples - 1) / w.num_samples))
    picked = of(beams) * phasors * np.exp(-2j * np.pi * known_cycles(w, delay, rate, raw))
    product, length = transitions_of(picked[None], peaks.schedule, w, raw)
    far = (4 * prediction.velocity_std[0] + w.velocity_cell(1)) / SPEED_OF_LIGHT
    found = rate_error(product[0], length, far, order, w)
    product = product[0] * np.exp(-2j * np.pi * found * w.effective_carrier * length)
    transitions, spread = nearest_symbols(product, order)
    sure = by_antenna(strong, peaks.schedule, w.num_tx)
    least = np.minimum(sure[..., 1:], sure[..., :-1])
    symbols = Symbols(
        raw=raw,
        delay=raw,
        delay_confidence=strong,
        transitions=transitions,
        transition_confidence=least / (1 + least),
        phase_spread=spread,
        phases=running_phases(transitions, peaks.schedule, order),
        bits=demodulate_bits(raw, transitions, w, order),
        looks=1,
    )
    if symbols.is_intact(w, order):
        return symbols
    known = Known(w, peaks.schedule, raw, symbols.phases, antennas, 1)
    return symbols.with_phases(decide_by_carrier(known, picked, order), known, order)


@dataclass(frozen=True)
class _Chirps:
    """The chirps of a frame that stand out in the beam towards a path.

    Attributes
    ----------
    modulated : whether the frame carries data
    middle : time of the frame [s]
    time : (n,) of the chirps since the middle of the frame [s]
    cell : (n,) where they stand
    """

    modulated: bool
    middle: float
    time: np.ndarray
    cell: np.ndarray

    @classmethod
    def of(cls, peaks: Peaks, weights: np.ndarray, last: float) -> _Chirps:
        """Return the peaks of a frame, its middle counted from time `last`."""
        power = np.abs(peaks.values @ weights) ** 2
        best = power.argmax(axis=-1)[..., None]
        cell = np.take_along_axis(peaks.cells, best, axis=-1)[..., 0].astype(float)
        on = power.max(axis=-1) > _threshold(peaks.waveform) * peaks.noise
        return cls(peaks.modulated, peaks.time - last, peaks.waveform.middle_time[on], cell[on])


def _threshold(waveform: Waveform) -> float:
    """Power of a chirp's strongest cell in a beam that noise exceeds at `FALSE_RATE`, over that of
    a cell: half cells count as many as they are."""
    return float(np.log(2 * waveform.num_samples / FALSE_RATE))


def _weights(direction: np.ndarray, antennas: Antennas, waveform: Waveform) -> np.ndarray:
    """(L_rx,) of unit noise gain of the beam towards a plane wave, to be multiplied by samples."""
    delays = element_delays(antennas.rx_positions, direction, np.inf)[0]
    return np.exp(-2j * np.pi * waveform.effective_carrier * delays) / np.sqrt(delays.size)


def _direction(batch: Sequence[Peaks], antennas: Antennas, waveform: Waveform) -> np.ndarray:
    """Direction (2,) from which most of the chirps' strongest cells come."""
    R = np.zeros((antennas.num_rx, antennas.num_rx), complex)
    for one in batch:
        first = one.values[:, :, 0].reshape(-1, antennas.num_rx) / np.sqrt(one.noise)
        R += first.T @ first.conj()
    wavenumber = 2 * np.pi * waveform.effective_carrier / SPEED_OF_LIGHT
    search = search_of(antennas, wavenumber, 1)

    def power(a: np.ndarray) -> np.ndarray:
        return np.asarray(((a.conj() @ R) * a).sum(axis=-1).real)

    level = denominators(R[None], search)[0] * search.inside
    best = np.unravel_index(level.argmax(), level.shape)
    start = np.array([[u[i] for u, i in zip(search.cosines, best, strict=True)]])
    return settled(power, start, search)[0]


def _comb(seen: Sequence[_Chirps], waveform: Waveform) -> tuple[np.ndarray, np.ndarray] | None:
    """Fraction, rate and acceleration [cells, cells/s, cells/s^2] at the last frame that most
    chirps share, and their covariance; None where they share none."""
    count = sum(one.cell.size for one in seen)
    if count < LEAST_CHIRPS:
        return None
    w, cell = waveform, waveform.range_cell(1)
    span = max(-min(one.middle for one in seen), w.frame_duration)
    rates = np.linspace(-1, 1, 2 * int(np.ceil(4 * FASTEST / cell * span)) + 1) * FASTEST / cell
    curvatures = np.array(CURVATURES) / cell
    coarse = np.linspace(-1, 1, 2 * int(np.ceil(4 * FASTEST / cell * w.frame_duration)) + 1)
    coarse = coarse * FASTEST / cell  # within a frame
    nearest = np.abs(rates[:, None] - coarse).argmin(axis=1)
    total = np.zeros((rates.size, curvatures.size), np.complex128)
    within = np.zeros(coarse.size)
    for one in seen:
        inside = np.exp(2j * np.pi * (one.cell - coarse[:, None] * one.time)).sum(axis=1)
        moved = rates[:, None] * one.middle + curvatures * (one.middle**2 / 2)
        total += inside[nearest, None] * np.exp(-2j * np.pi * moved)
        within += np.abs(inside) ** 2
    gaps = np.diff([one.middle for one in seen if one.cell.size])
    if gaps.size:  # whole cells from frame to frame turn nothing but the frames' own rates
        own = _own_rate(seen, float(coarse[within.argmax()]))
        middle = sum(one.middle * one.cell.size for one in seen) / count
        total[np.abs(rates[:, None] + curvatures * middle - own) > 0.5 / gaps.min()] = 0
    i, j = np.unravel_index(np.abs(total).argmax(), total.shape)
    state = np.array([np.angle(total[i, j]) / (2 * np.pi), rates[i], curvatures[j]])
    time = np.concatenate([one.middle + one.time for one in seen])
    cells = np.concatenate([one.cell for one in seen])
    design = np.stack([np.ones(count), time, time**2 / 2], axis=1)
    prior = np.diag([0.0, 0.0, (cell / BENT) ** 2])
    for _ in range(4):
        off = cells - design @ state
        off -= np.round(off)
        near = np.abs(off) < FRACTION
        spread = max(float(off[near].var()), LEAST_SPREAD**2) if near.any() else 1.0
        inverse = design[near].T @ design[near] / spread + prior
        covariance = np.linalg.pinv(inverse)
        state = state + covariance @ (design[near].T @ off[near] / spread - prior @ state)
    off = cells - design @ state
    comb = np.abs(np.exp(2j * np.pi * off).mean())
    if comb < LEAST_COMB or near.sum() < LEAST_CHIRPS:
        return None
    own = np.concatenate([one.time for one in seen])[near]
    if gaps.size and ALIAS_STDS * np.sqrt(spread / (own @ own)) > 0.5 / gaps.min():
        return None
    return state, covariance


def _own_rate(seen: Sequence[_Chirps], rate: float) -> float:
    """Rate [cells/s] at which cells move within frames, whatever they do from one to the next."""
    time = np.concatenate([one.time for one in seen])
    for _ in range(4):
        parts = []
        for one in seen:
            off = one.cell - rate * one.time
            off = off - np.angle(np.exp(2j * np.pi * off).sum()) / (2 * np.pi)
            parts.append(off - np.round(off))
        off = np.concatenate(parts)
        near = np.abs(off) < FRACTION
        rate += float(time[near] @ off[near] / max(time[near] @ time[near], 1e-300))
    return rate


def _whole_cells(seen: Sequence[_Chirps], state: np.ndarray, symbols: int) -> int | None:
    """The whole cells that a path's beat has besides; None if more than one number can be.

    A chirp that shows another path lies anywhere, half of the time outside the alphabet. So a shift
    with d more symbols outside than the best one, which leaves o of n, is as likely as ((o+1)/n)^d.
    """
    wholes: dict[bool, list[np.ndarray]] = {True: [np.zeros(0)], False: [np.zeros(0)]}
    for one in seen:
        t = one.middle + one.time
        off = one.cell - (state[0] + state[1] * t + state[2] * t * t / 2)
        whole = np.round(off)
        wholes[one.modulated].append(whole[np.abs(off - whole) < FRACTION])
    data, pilot = (np.sort(np.concatenate(wholes[kind])) for kind in (True, False))
    shifts = np.arange(data[0] - symbols + 1, data[-1] + 1)
    inside = np.searchsorted(data, shifts + symbols) - np.searchsorted(data, shifts)
    if pilot.size >= LEAST_CHIRPS:
        sent = np.median(pilot)
        inside = np.where(shifts == sent, inside, 0)
        if (pilot == sent).mean() < AGREED:
            return None
    best = int(inside.argmax())
    outside = data.size - int(inside[best])
    if outside > MOST_OUTSIDE * data.size:
        return None
    further = int(inside[best] - np.delete(inside, best).max())
    clear = further * np.log(data.size / (outside + 1)) >= np.log(LEAST_ODDS)
    return int(shifts[best]) if clear else None
