"""Off-grid estimates of one detection: range and velocity by maximum likelihood on the cleaned
spectra, then direction cosines.

Around mid-frame, with tau(t) = tau_0 + tau_dot t and x the time from the middle of a chirp's window
(at u_c),

    Phi = [f_c tau_c + alpha tau_c u_c - alpha tau_c^2/2]  +  x [alpha tau_c + tau_dot (f_c + alpha
    u_c - alpha tau_c)],

where tau_c is the delay at the chirp's middle. So the beat follows the migration and carries the
range-Doppler coupling, and the slow-time phase follows tau_c. `Template` is this formula; nothing
of it is linearised in the frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import copysign
from typing import NamedTuple, TypeVar

import numpy as np

from isac_rt.frame.antennas import unit_vector
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, cos_sin_double, floor, load, splat, store
from isac_rt.receive import planar
from isac_rt.receive.arms import arm, element_delays
from isac_rt.receive.known import Known
from isac_rt.receive.maps import slow_window
from isac_rt.receive.modes import MODES, mode_shapes

# range cells on each side of the peak that a template covers: Hann's main lobe and the migration
HALF_WIDTH = 3
STENCILS = 0.2, 0.08, 0.03
"""Half widths of the stencils on which a peak of the likelihood is fitted [cells, bins]."""
_STENCIL = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [-1, 1], [1, -1], [1, 1]])
"""Places of a stencil down and across: its middle, the cross, the corners."""
PULL = 1.0
"""Distance of another path in the cell [cells, bins]."""
TIE = 1e-9
"""Share by which a direction must be stronger: both ends of the axis may be the same one."""
T = TypeVar("T", float, np.ndarray)


@dataclass(frozen=True)
class Estimate:
    """One detection off the grid.

    Attributes
    ----------
    delay, delay_rate : at mid-frame [s, 1]
    channels : (L_tx, L_rx) complex, response of every virtual channel at the estimate, normalised
        to the amplitude of a sample
    """

    delay: float
    delay_rate: float
    channels: np.ndarray


def hann_response(waveform: Waveform, offset: np.ndarray) -> np.ndarray:
    """Transform of the range window, about its middle, at `offset` cells from a tone; real,
    (samples)."""
    length = waveform.window_length
    d = np.asarray(offset) * length / waveform.num_samples
    near = np.abs(np.abs(d) - 1) < 1e-6
    safe = np.where(near, 0.5, d)
    return length / 2 * np.where(near, 0.5, np.sinc(safe) / (1 - safe**2))


class LocalSpectra:
    """The few range rows around a peak, ready for repeated evaluation of templates over the
    slow-time window."""

    def __init__(
        self,
        spectra: np.ndarray,
        known: Known,
        row: int,
        *,
        separate: bool = False,
    ) -> None:
        """`separate`: the groups are not added coherently, as where the velocity is known up to
        aliases only."""
        w, low = known.waveform, max(row - HALF_WIDTH, 0)
        self._sets = w.num_groups if separate else 1
        self.waveform = w
        rows = spectra[:, :, low : row + HALF_WIDTH + 1]
        # the window begins at sample 0 and its transform is real about its middle: the turn from
        # row to row is taken out here
        turn = np.exp(
            2j * np.pi * (low + np.arange(rows.shape[2])) * (w.window_length / 2 / w.num_samples)
        )
        own = np.arange(w.num_groups)[:, None] * w.num_tx if separate else 0
        chirps, self._num_rx = known.schedule.size, rows.shape[1]
        data = np.zeros((chirps, rows.shape[2], -(-self._num_rx // LANES), 2, LANES), np.float32)
        _gather(rows, turn, data)
        weight, time = np.zeros((2, chirps + -chirps % LANES))
        weight.reshape(-1)[:chirps].reshape(w.num_groups, -1)[:] = slow_window(w)
        time[:chirps] = known.times.ravel()
        self._chirps = _Chirps(
            data.ravel(),
            data.shape[1],
            data.shape[2],
            weight,
            time,
            np.ascontiguousarray((known.schedule + own).ravel()),
        )
        self._axis = _Axis(
            w.carrier_frequency,
            w.slope,
            w.window_middle,
            w.sampled_duration,
            w.window_length,
            w.window_length / w.num_samples,
            float(low),
        )

    def respond(self, delay: float, delay_rate: float) -> np.ndarray:
        """(L_tx, L_rx) matched response, normalised so that a path at (delay, delay_rate) gives its
        amplitude; of separate groups the mean, each antenna turned into the phase that it has in
        the first one."""
        sets = self._match(delay, delay_rate)
        turn = np.exp(-1j * np.angle((sets * sets[0].conj()).sum(axis=2, keepdims=True)))
        return (sets * turn).mean(axis=0)

    def _match(self, delay: float, delay_rate: float) -> np.ndarray:
        """Responses (sets, L_tx, L_rx)."""
        out, energy = _match(self._chirps, self._axis, delay, delay_rate, self._antennas)
        parts = out.reshape(self._antennas, -1, 2, LANES)
        values = (parts[:, :, 0] + 1j * parts[:, :, 1]).reshape(self._antennas, -1)
        values = values[:, : self._num_rx] / np.maximum(energy, 1e-30)[:, None]
        return values.reshape(self._sets, self.waveform.num_tx, -1)

    def modes(self, delay: float, delay_rate: float) -> np.ndarray:
        """(MODES, L_tx, L_rx) amplitudes of a path by polynomials over the chirp: the least squares
        of all rows and chirps (`isac_rt.receive.modes`)."""
        c, a = self._chirps, self._axis
        size, rows = c.tx.size, c.rows
        data = c.data.reshape(size, rows, c.blocks, 2, LANES)
        heard = (data[:, :, :, 0] + 1j * data[:, :, :, 1]).reshape(size, rows, -1)
        tau = delay + delay_rate * c.time.ravel()[:size]
        beat = a.slope * tau + delay_rate * (a.carrier + a.slope * (a.middle - tau))
        near = (beat * a.duration - a.first)[:, None] - np.arange(rows)
        cycles = (a.carrier * tau) % 1.0 + a.slope * tau * (a.middle - tau / 2)
        shapes = a.length / 2 * mode_shapes(near * a.share)
        shapes = shapes * np.exp(2j * np.pi * cycles)[:, None]
        weight = c.weight.ravel()[:size]
        out = np.empty((MODES, self._antennas, self._num_rx), complex)
        for antenna in range(self._antennas):
            sent = c.tx == antenna
            template = shapes[:, sent].reshape(MODES, -1)
            weighted = (template * np.repeat(weight[sent], rows)).conj()
            energy, found = (
                weighted @ template.T,
                weighted @ heard[sent].reshape(-1, heard.shape[2]),
            )
            out[:, antenna] = np.linalg.solve(energy, found[:, : self._num_rx])
        return out

    @property
    def _antennas(self) -> int:
        """Transmit antennas, in every set anew."""
        return self._sets * self.waveform.num_tx

    def powers(self, delays: np.ndarray, delay_rates: np.ndarray) -> np.ndarray:
        """Energies (K,) that templates explain, summed over the virtual channels: what the estimate
        maximises. At the ends of the range axis part of a template lies outside, so that the
        amplitude alone would draw the estimate out."""
        return _powers(self._chirps, self._axis, delays, delay_rates, self._antennas)

    def beam_powers(
        self, delays: np.ndarray, delay_rates: np.ndarray, beam: np.ndarray, *, in_phase: bool
    ) -> np.ndarray:
        """Powers (K,) of the responses, times a `beam` (L_tx, L_rx) and added over the receivers;
        over the transmit antennas in phase, or in power."""
        return _beam_powers(self._chirps, self._axis, delays, delay_rates, beam, in_phase)


class _Chirps(NamedTuple):
    """Samples of `rows` range rows, float32: of each chirp and row the real and imaginary parts of
    `blocks` times sixteen receivers; and of each chirp its weight, time [s] and antenna, the first
    two filled up to a multiple of sixteen."""

    data: np.ndarray
    rows: int
    blocks: int
    weight: np.ndarray
    time: np.ndarray
    tx: np.ndarray


class _Axis(NamedTuple):
    """What a template depends on of the waveform, the window's cells to a range cell, and the first
    row."""

    carrier: float
    slope: float
    middle: float
    duration: float
    length: float
    share: float
    first: float


@jit
def _gather(rows, turn, out):
    """out[m P + p, i, :, :, :] = rows[m, :, i, p] turn[i]."""
    groups, num_rx, count, num_chirps = rows.shape
    for m in range(groups):
        for r in range(num_rx):
            for i in range(count):
                for p in range(num_chirps):
                    value, at = rows[m, r, i, p] * turn[i], m * num_chirps + p
                    out[at, i, r // LANES, 0, r % LANES] = value.real
                    out[at, i, r // LANES, 1, r % LANES] = value.imag


@jit
def _template(chirps, axis, delay, delay_rate):
    """Of a path every chirp's weighted cosine and sine (P,) and its rows' real factors (rows, P):
    beat, phase and `hann_response`, which a test holds against them."""
    carrier, slope, middle, duration, length, share, first = axis
    size = chirps.time.size
    near, cycles, cosines = np.empty(size), np.empty((2, size)), np.empty((2, size))
    for i in range(size):
        tau = delay + delay_rate * chirps.time[i]
        beat = (slope * tau + delay_rate * (carrier + slope * (middle - tau))) * duration
        turns, chirp = carrier * tau, slope * tau * (middle - tau / 2)
        near[i] = (beat - first) * share
        cycles[0, i] = turns - np.floor(turns) + chirp - np.floor(chirp)
        cycles[1, i] = near[i] / 2
    sines, shape = np.empty((2, size)), np.empty((chirps.rows, size))
    for i in range(0, 2 * size, LANES):
        angle = load(cycles.reshape(-1), i)
        c, s = cos_sin_double(angle - floor(angle + splat(0.5)))
        store(cosines.reshape(-1), i, c)
        store(sines.reshape(-1), i, s)
    for k in range(chirps.rows):
        step_cos, step_sin = np.cos(np.pi * share * k), np.sin(np.pi * share * k)
        for i in range(size):
            d = near[i] - k * share
            value = sines[1, i] * step_cos - cosines[1, i] * step_sin
            under = np.pi * d * (1.0 - d * d)
            regular = abs(under) > 1e-8
            edge = 0.5 if abs(d) > 0.5 else 1.0
            shape[k, i] = length / 2 * (value / under if regular else edge)
    for i in range(size):
        cosines[0, i] *= chirps.weight[i]
        sines[0, i] *= chirps.weight[i]
    return cosines[0], sines[0], shape


@jit
def _match(chirps, axis, delay, delay_rate, antennas):
    """Of every transmit antenna the sum of conj(template) times data, as flat blocks of sixteen
    real and imaginary parts, and the energy of the template."""
    cosine, sine, shape = _template(chirps, axis, delay, delay_rate)
    rows, blocks, flat = chirps.rows, chirps.blocks, chirps.data
    line = 2 * LANES * blocks
    out, energy = np.zeros(antennas * line, np.float32), np.zeros(antennas)
    for i in range(chirps.tx.size):
        square = 0.0
        for k in range(rows):
            square += shape[k, i] * shape[k, i]
        energy[chirps.tx[i]] += chirps.weight[i] * square
        c, s = splat(np.float32(cosine[i])), splat(np.float32(sine[i]))
        for b in range(blocks):
            at = i * rows * line + 2 * LANES * b
            re, im = splat(np.float32(0)), splat(np.float32(0))
            for k in range(rows):
                factor = splat(np.float32(shape[k, i]))
                re = re + factor * load(flat, at)
                im = im + factor * load(flat, at + LANES)
                at += line
            to = chirps.tx[i] * line + 2 * LANES * b
            store(out, to, load(out, to) + c * re + s * im)
            store(out, to + LANES, load(out, to + LANES) + c * im - s * re)
    return out, energy


@jit
def _powers(chirps, axis, delays, delay_rates, antennas):
    """`LocalSpectra.powers`."""
    total = np.zeros(delays.size)
    for j in range(delays.size):
        out, energy = _match(chirps, axis, delays[j], delay_rates[j], antennas)
        line = out.size // antennas
        for t in range(antennas):
            square = 0.0
            for c in range(t * line, (t + 1) * line):
                square += np.float64(out[c]) ** 2
            total[j] += square / max(energy[t], 1e-30)
    return total


@jit
def _beam_powers(chirps, axis, delays, delay_rates, beam, in_phase):
    """`LocalSpectra.beam_powers`."""
    total, added = np.zeros(delays.size), np.empty(beam.shape[0], np.complex128)
    for j in range(delays.size):
        out, energy = _match(chirps, axis, delays[j], delay_rates[j], beam.shape[0])
        line = out.size // beam.shape[0]
        added[:] = 0.0
        for t in range(beam.shape[0]):
            for r in range(beam.shape[1]):
                at = t * line + r // LANES * 2 * LANES + r % LANES
                added[t] += beam[t, r] * complex(out[at], out[at + LANES])
            added[t] /= max(energy[t], 1e-30)
        if in_phase:
            added[0] = added.sum()
        for t in range(1 if in_phase else added.size):
            total[j] += added[t].real ** 2 + added[t].imag ** 2
    return total


def start_point(
    spectra_power: np.ndarray, row: int, column: int, waveform: Waveform
) -> tuple[float, float]:
    """Delay and delay rate of a peak of the centred map, by Hann's two-cell ratio on both axes.

    Exact for a tone that does not migrate; within a tenth of a cell otherwise.
    """
    rows, num_bins = spectra_power.shape
    line = np.sqrt(spectra_power[[max(row - 1, 0), row, min(row + 1, rows - 1)], column])
    line[[0, 2]] *= [row > 0, row < rows - 1]  # a neighbour that is not there decides nothing
    across = np.sqrt(spectra_power[row, [(column - 1) % num_bins, column, (column + 1) % num_bins]])
    cell, doppler = row + _hann_ratio(line), column - num_bins // 2 + _hann_ratio(across)
    return to_delay(cell, doppler, waveform)


def to_delay(cell: float, doppler_bin: float, waveform: Waveform) -> tuple[float, float]:
    """Delay and delay rate at mid-frame of a beat (cells) and a Doppler bin (receding is
    positive)."""
    w = waveform
    rate = doppler_bin / (w.frame_duration * w.effective_carrier)
    return (cell / w.sampled_duration - rate * w.effective_carrier) / w.slope, rate


def _hann_ratio(three: np.ndarray) -> float:
    before, peak, after = three
    if peak <= 0:
        return 0.0
    ratio = max(before, after) / peak
    offset = np.clip((2 * ratio - 1) / (1 + ratio), -0.5, 0.5)
    return float(offset if after >= before else -offset)


def refine(
    local: LocalSpectra, delay: float, delay_rate: float, steps: Sequence[float] = STENCILS
) -> Estimate:
    """Maximise the summed power by fitted paraboloids on shrinking stencils (cells and Doppler
    bins)."""
    w = local.waveform
    delay_unit, rate_unit = w.delay_step, 1.0 / (w.frame_duration * w.effective_carrier)
    # coordinates: beat at mid-frame and Doppler, which decouple; the beat holds the coupling
    coupling = w.sampled_duration / w.frame_duration
    beat = delay / delay_unit + delay_rate / rate_unit * coupling
    doppler = delay_rate / rate_unit

    def split(b: T, d: T) -> tuple[T, T]:
        return (b - d * coupling) * delay_unit, d * rate_unit

    hxy = 0.0
    for number, step in enumerate(steps):
        count = 5 if number else len(_STENCIL)
        down, across = step * _STENCIL[:count].T
        powers = local.powers(*split(beat + down, doppler + across))
        g = np.log(np.maximum(powers, 1e-300)).tolist()
        gx, gy = (g[2] - g[1]) / (2 * step), (g[4] - g[3]) / (2 * step)
        hxx = (g[2] - 2 * g[0] + g[1]) / step**2
        hyy = (g[4] - 2 * g[0] + g[3]) / step**2
        if not number:  # small in these coordinates: what the first stencil says is good enough
            hxy = (g[8] - g[7] - g[6] + g[5]) / (4 * step**2)
        det = hxx * hyy - hxy**2
        if hxx < 0 and det > 0:
            move = (hyy * gx - hxy * gy) / -det, (hxx * gy - hxy * gx) / -det
        else:
            move = copysign(step, gx), copysign(step, gy)
        beat += min(max(move[0], -3 * step), 3 * step)
        doppler += min(max(move[1], -3 * step), 3 * step)
    delay, delay_rate = split(beat, doppler)
    return Estimate(delay, delay_rate, local.respond(delay, delay_rate))


@dataclass(frozen=True)
class Estimator:
    """How a peak of the map becomes an estimate: off the grid, or `on_grid` as the centre of its
    cell and the nearest of the directions, eight to a beam."""

    on_grid: bool = False

    def at(self, local: LocalSpectra, power: np.ndarray, row: int, column: int) -> Estimate:
        """The estimate of a peak of the centred map `power`."""
        if not self.on_grid:
            return refine(local, *start_point(power, row, column, local.waveform))
        w = local.waveform
        delay, rate = to_delay(row, column - w.num_chirps // 2, w)
        return Estimate(delay, rate, local.respond(delay, rate))


OFF_GRID = Estimator()


def direction_cosine(
    channels: np.ndarray, known: Known, axis: int, *, on_grid: bool = False
) -> float:
    """Direction cosine along one axis of the L from the channel responses, by maximising the
    beamformed power.

    An element at r answers with exp(-j 2 pi f r u / c), f the frequency at the window's middle.
    Echoes are combined coherently over both arrays; one-way paths coherently over the
    receivers and in power over the transmitters, whose direction of departure is another and
    ambiguous.
    """
    return float(_along(channels[None], known, axis, on_grid=on_grid)[0])


def _along(channels: np.ndarray, known: Known, axis: int, *, on_grid: bool) -> np.ndarray:
    """(Q,) `direction_cosine` of channels (Q, L_tx, L_rx)."""
    a, echo, line = known.antennas, known.passes == 2, arm(known.antennas, axis, known.passes)
    if not a.observes(known.passes)[axis // 2]:
        return np.full(len(channels), np.nan)
    limit = min(1.0, np.pi / (known.wavenumber * a.spacing))
    rows = 1 if echo else a.num_tx
    values = channels[:, line.tx, line.rx].reshape(len(channels), rows, len(line) // rows)
    # the receivers stand alike for every transmitter
    apart = known.wavenumber * line.places[: values.shape[2], axis]
    count = 8 * (a.rx_x if axis == 0 else a.rx_z) * (2 if echo else 1) + 1
    best = np.array([_strongest(one, apart, limit, count, not on_grid) for one in values], float)
    return np.where(np.abs(best) <= 1, best, np.nan)


@jit
def _strongest(values, apart, limit, count, fine):
    """Direction cosine of the most power, of `count` from -limit to `limit`, and `fine` about the
    best of them by parabolas through the logarithm; `values` (T, L) of elements at `apart`
    [rad]."""
    step = 2 * limit / (count - 1)
    turn, move = np.exp(-1j * limit * apart), np.exp(1j * step * apart)
    best, most = -limit, -1.0
    for i in range(count):
        power = _beam(values, turn)
        if power > most * (1 + TIE):
            best, most = -limit + i * step, power
        turn *= move
    for part in (2.0, 12.0, 60.0):
        if not fine:
            break
        near = step / part
        low = np.log(max(_beam(values, np.exp(1j * (best - near) * apart)), 1e-300))
        mid = np.log(max(_beam(values, np.exp(1j * best * apart)), 1e-300))
        high = np.log(max(_beam(values, np.exp(1j * (best + near) * apart)), 1e-300))
        curve = low - 2 * mid + high
        up = 0.5 * (low - high) / curve * near if curve < 0 else near * np.sign(high - low)
        best += min(max(up, -2 * near), 2 * near)
    return best


@jit
def _beam(values, turn):
    """Power of the rows of `values` (T, L), each turned by `turn` and added in phase."""
    power = 0.0
    for t in range(values.shape[0]):
        re, im = 0.0, 0.0
        for i in range(turn.size):
            re += values[t, i].real * turn[i].real - values[t, i].imag * turn[i].imag
            im += values[t, i].real * turn[i].imag + values[t, i].imag * turn[i].real
        power += re * re + im * im
    return power


def direction_cosines(estimate: Estimate, known: Known, *, on_grid: bool = False) -> list[float]:
    """u_x and u_z of a detection (`directions`)."""
    delay = np.array([estimate.delay])
    return directions(estimate.channels[None], delay, known, on_grid=on_grid)[0].tolist()


def directions(
    channels: np.ndarray, delays: np.ndarray, known: Known, *, on_grid: bool = False
) -> np.ndarray:
    """(Q, 2) u_x and u_z of detections from their channels (Q, L_tx, L_rx) and delays (Q,) [s].

    A second pass takes out the curvature of the wavefront, k (|r|^2 - (r.u)^2) / (2 R) for an
    element at r and a source at R, which would turn the estimate by 0.02 degrees at 11 m. R is the
    estimated range; behind a reflector on the way to a PT the true radius is shorter.
    """
    u = _cosines(channels, known, on_grid=on_grid)
    radius = delays * SPEED_OF_LIGHT / known.passes
    flat_u = in_plane(u, known)
    bent = _within(flat_u) & (radius > 0)
    towards = unit_vector(flat_u[bent])
    scale = 2 * np.pi * known.waveform.effective_carrier / SPEED_OF_LIGHT / (2 * radius[bent, None])
    tx, rx = (
        scale * ((r**2).sum(1) - (towards @ r.T) ** 2)
        for r in (known.antennas.tx_positions, known.antennas.rx_positions)
    )
    flat = channels[bent] * np.exp(-1j * (tx[:, :, None] + rx[:, None, :]))
    u[bent] = _cosines(flat, known, on_grid=on_grid)
    return u


def _cosines(channels: np.ndarray, known: Known, *, on_grid: bool) -> np.ndarray:
    """(Q, 2) u_x and u_z of plane waves: by the arms of an L one by one, or by all channels."""
    if not known.antennas.is_l:
        found = [planar.cosines(one, known, on_grid=on_grid) for one in channels]
        return np.array(found, float).reshape(-1, 2)
    return np.stack([_along(channels, known, axis, on_grid=on_grid) for axis in (0, 2)], axis=1)


def in_plane(u: np.ndarray, known: Known) -> np.ndarray:
    """Direction cosines (Q, 2) with 0 on an axis that the array does not observe."""
    return np.where(known.antennas.observes(known.passes), u, 0.0)


def _within(u: np.ndarray) -> np.ndarray:
    """(Q,) which direction cosines (Q, 2) are of a direction."""
    return np.isfinite(u).all(axis=1) & (u[:, 0] ** 2 + u[:, 1] ** 2 <= 1)


def excess(
    channels: np.ndarray, delays: np.ndarray, u: np.ndarray, snr: np.ndarray, known: Known
) -> np.ndarray:
    """(Q,) power that one wave from a direction (Q, 2) leaves in the channels (Q, L_tx, L_rx) of an
    estimate, over the wave's own and beyond what noise leaves; 0 where there is no direction, and
    of a single channel.

    A wave has one amplitude at the active terminal and one for each transmit antenna at a passive
    one. What is left comes from other paths in the cell.
    """
    out, u = np.zeros(len(u)), in_plane(u, known)
    a, free = known.antennas, 1 if known.passes == 2 else known.antennas.num_tx
    some = _within(u)
    if free == known.channels or not some.any():
        return out
    heard, radius = channels[some], known.radius(delays[some])[:, None]
    turn = 2j * np.pi * known.waveform.effective_carrier
    to, fro = (
        np.exp(turn * element_delays(places, u[some], radius)[0]).conj() / len(places)
        for places in (a.tx_positions, a.rx_positions)
    )
    waves = (heard * fro[:, None]).sum(axis=2)
    if known.passes == 2:
        waves = (waves * to).sum(axis=1, keepdims=True)
    total = (np.abs(heard) ** 2).mean(axis=(1, 2))
    wave = (np.abs(waves) ** 2).mean(axis=1)
    left = (total - wave) / (1 - free / known.channels)
    beyond = np.maximum(left - total / np.maximum(snr[some], 1.0), 0.0)
    out[some] = beyond / np.maximum(wave, 1e-3 * total)
    return out


def standard_deviations(
    snr: float | np.ndarray, excess: float | np.ndarray, known: Known
) -> np.ndarray:
    """Standard deviations (..., 4) of range, velocity, u_x, u_z of paths; infinite on an axis that
    the array does not observe.

    Cramer-Rao of a tone, with Hann's loss of 2 on the two windowed axes, and never below the floors
    at which other paths' sidelobes usually end the gain. Other paths in the cell count twice: as
    noise of their power, different in every channel, and as a pull of range and velocity towards
    where they are, by their share of the power.

    Parameters
    ----------
    snr : of a channel, after processing (...)
    excess : power of other paths in the cell over the path's own (...)
    """
    w, least = known.waveform, 1.0 / known.channels
    total = np.maximum(known.channels / (1 / np.maximum(snr, least) + excess), 1.0)
    tone, pull = np.sqrt(2 * 6 / (4 * np.pi**2 * total)), PULL * excess / (1 + excess)
    spread = [
        np.hypot(np.maximum(tone, 2e-3), pull) * known.range_cell,
        np.hypot(np.maximum(tone, 4e-3), pull) * w.velocity_cell(known.passes),
    ]
    if not known.antennas.is_l:
        variance = [np.diag(planar.direction_covariance(t, known)) for t in np.ravel(total)]
        angles = np.maximum(np.sqrt(np.reshape(variance, (-1, 2))), 2e-4)
        return np.concatenate([np.stack(spread, axis=-1), angles.reshape(*total.shape, 2)], axis=-1)
    for axis, observed in zip((0, 2), known.antennas.observes(known.passes), strict=True):
        if not observed:
            spread.append(np.full(total.shape, np.inf))
            continue
        place = arm(known.antennas, axis, known.passes).places[:, axis]
        slope = 2 * np.pi * w.effective_carrier / SPEED_OF_LIGHT * max(place.std(), 1e-6)
        share = place.size / known.channels
        spread.append(np.maximum(1 / (slope * np.sqrt(2 * total * share)), 2e-4))
    return np.stack(spread, axis=-1)
