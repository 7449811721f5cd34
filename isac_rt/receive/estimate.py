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

import numpy as np

from isac_rt.frame.antennas import unit_vector
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.jit import jit
from isac_rt.receive.arms import arm, element_delays
from isac_rt.receive.known import Known
from isac_rt.receive.maps import slow_window

# range cells on each side of the peak that a template covers: Hann's main lobe and the migration
HALF_WIDTH = 3
STENCILS = 0.2, 0.08, 0.03
"""Half widths of the stencils on which a peak of the likelihood is fitted [cells, bins]."""
PULL = 1.0
"""Distance of another path in the cell [cells, bins]."""


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
        self.waveform, self._first = w, low
        rows = spectra[:, :, low : row + HALF_WIDTH + 1]
        # the window begins at sample 0 and its transform is real about its middle: the turn from
        # row to row is taken out here
        turn = np.exp(
            2j * np.pi * (low + np.arange(rows.shape[2])) * (w.window_length / 2 / w.num_samples)
        )
        self._data = np.ascontiguousarray(rows.transpose(0, 3, 2, 1) * turn[:, None]).reshape(
            known.schedule.size, rows.shape[2], -1
        )
        self._weight = np.tile(slow_window(w).astype(np.float64), w.num_groups)
        own = np.arange(w.num_groups)[:, None] * w.num_tx if separate else 0
        self._tx = np.ascontiguousarray((known.schedule + own).ravel())
        self._time = known.times.ravel()
        self._numbers = np.array(
            [
                w.carrier_frequency,
                w.slope,
                w.window_middle,
                w.sampled_duration,
                w.window_length,
                w.num_samples,
            ]
        )

    def respond(self, delay: float, delay_rate: float) -> np.ndarray:
        """(L_tx, L_rx) matched response, normalised so that a path at (delay, delay_rate) gives its
        amplitude; of separate groups the mean, each antenna turned into the phase that it has in
        the first one."""
        sets = self._match(delay, delay_rate)[0]
        turn = np.exp(-1j * np.angle((sets * sets[0].conj()).sum(axis=2, keepdims=True)))
        return (sets * turn).mean(axis=0)

    def _match(self, delay: float, delay_rate: float) -> tuple[np.ndarray, np.ndarray]:
        """Responses (sets, L_tx, L_rx) and the templates' energies (sets, L_tx, 1)."""
        out = np.zeros((self._sets * self.waveform.num_tx, self._data.shape[2]), np.complex128)
        energy = np.zeros(len(out))
        _match(
            self._data.view(np.float64),
            self._weight,
            self._tx,
            self._time,
            self._first,
            self._numbers,
            delay,
            delay_rate,
            out,
            energy,
        )
        shape = self._sets, self.waveform.num_tx, -1
        return out.reshape(shape), energy.reshape(shape)

    def power(self, delay: float, delay_rate: float) -> float:
        """Energy that the template explains, summed over the virtual channels: what the estimate
        maximises. At the ends of the range axis part of a template lies outside, so that the
        amplitude alone would draw the estimate out."""
        out, energy = self._match(delay, delay_rate)
        return float(((out.real**2 + out.imag**2) * energy).sum())


@jit
def _match(data, weight, tx, time, first, numbers, delay, delay_rate, out, energy):
    """out[tx, rx] = sum of conj(template) * data over the energy[tx] of the
    template: beat, phase and `hann_response` in one loop, which a test holds against them.

    `data` alternates real and imaginary parts, and is turned so that the template's rows differ by
    real factors.
    """
    carrier, slope, middle, duration, length, size = numbers
    chirps, rows, width = data.shape
    share = length / size
    step_cos, step_sin = (
        np.cos(np.pi * share * np.arange(rows)),
        np.sin(np.pi * share * np.arange(rows)),
    )
    line = np.empty(width)
    for i in range(chirps):
        tau = delay + delay_rate * time[i]
        beat = (slope * tau + delay_rate * (carrier + slope * (middle - tau))) * duration
        turns, chirp = carrier * tau, slope * tau * (middle - tau / 2)
        cycles = 2 * np.pi * (turns - np.floor(turns) + chirp - np.floor(chirp))
        near = (beat - first) * share
        sine, cosine = np.sin(np.pi * near), np.cos(np.pi * near)
        line[:] = 0.0
        for k in range(rows):
            d = near - k * share
            if abs(abs(d) - 1.0) < 1e-6:
                shape = length / 4
            elif abs(d) < 1e-9:
                shape = length / 2
            else:
                shape = (
                    length
                    / 2
                    * (sine * step_cos[k] - cosine * step_sin[k])
                    / (np.pi * d * (1.0 - d * d))
                )
            energy[tx[i]] += weight[i] * shape * shape
            row = data[i, k]
            for c in range(width):
                line[c] += shape * row[c]
        turn = weight[i] * complex(np.cos(cycles), -np.sin(cycles))
        for c in range(width // 2):
            out[tx[i], c] += turn * complex(line[2 * c], line[2 * c + 1])
    for t in range(out.shape[0]):
        out[t] /= max(energy[t], 1e-30)


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
    beat = delay / delay_unit + delay_rate / rate_unit * (w.sampled_duration / w.frame_duration)
    doppler = delay_rate / rate_unit

    def split(b: float, d: float) -> tuple[float, float]:
        return (b - d * (w.sampled_duration / w.frame_duration)) * delay_unit, d * rate_unit

    for step in steps:
        at = np.array([-step, 0.0, step])
        grid = np.log(
            [[max(local.power(*split(beat + i, doppler + j)), 1e-300) for j in at] for i in at]
        )
        gx, gy = (grid[2, 1] - grid[0, 1]) / (2 * step), (grid[1, 2] - grid[1, 0]) / (2 * step)
        hxx = (grid[2, 1] - 2 * grid[1, 1] + grid[0, 1]) / step**2
        hyy = (grid[1, 2] - 2 * grid[1, 1] + grid[1, 0]) / step**2
        hxy = (grid[2, 2] - grid[2, 0] - grid[0, 2] + grid[0, 0]) / (4 * step**2)
        det = hxx * hyy - hxy**2
        if hxx < 0 and det > 0:
            move = np.array([hyy * gx - hxy * gy, hxx * gy - hxy * gx]) / -det
        else:
            move = step * np.sign([gx, gy])
        beat, doppler = np.array([beat, doppler]) + np.clip(move, -3 * step, 3 * step)
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
    a, echo, line = known.antennas, known.passes == 2, arm(known.antennas, axis, known.passes)
    limit = min(1.0, np.pi / (known.wavenumber * a.spacing))
    values = channels[line.tx, line.rx].reshape(1 if echo else a.num_tx, -1).T
    # the receivers stand alike for every transmitter
    apart = 1j * known.wavenumber * line.places[: len(values), axis]

    def beam(u: np.ndarray) -> np.ndarray:
        return (np.abs(np.exp(np.outer(u, apart)) @ values) ** 2).sum(axis=1)

    count = 8 * (a.rx_x if axis == 0 else a.rx_z) * (2 if echo else 1) + 1
    u = np.linspace(-limit, limit, count)
    best = u[np.argmax(beam(u))]
    for step in () if on_grid else ((u[1] - u[0]) / 2, (u[1] - u[0]) / 12, (u[1] - u[0]) / 60):
        low, mid, high = np.log(np.maximum(beam(best + np.array([-step, 0.0, step])), 1e-300))
        curve = low - 2 * mid + high
        best += np.clip(
            0.5 * (low - high) / curve * step if curve < 0 else step * np.sign(high - low),
            -2 * step,
            2 * step,
        )
    return float(best) if abs(best) <= 1 else float("nan")


def direction_cosines(estimate: Estimate, known: Known, *, on_grid: bool = False) -> list[float]:
    """u_x and u_z of a detection.

    A second pass takes out the curvature of the wavefront, k (|r|^2 - (r.u)^2) / (2 R) for an
    element at r and a source at R, which would turn the estimate by 0.02 degrees at 11 m. R is the
    estimated range; behind a reflector on the way to a PT the true radius is shorter.
    """
    channels = estimate.channels
    u = [direction_cosine(channels, known, axis, on_grid=on_grid) for axis in (0, 2)]
    radius = estimate.delay * SPEED_OF_LIGHT / known.passes
    if not np.all(np.isfinite(u)) or u[0] ** 2 + u[1] ** 2 > 1 or radius <= 0:
        return u
    towards = unit_vector(u)
    scale = 2 * np.pi * known.waveform.effective_carrier / SPEED_OF_LIGHT / (2 * radius)
    tx, rx = (
        scale * ((r**2).sum(1) - (r @ towards) ** 2)
        for r in (known.antennas.tx_positions, known.antennas.rx_positions)
    )
    flat = channels * np.exp(-1j * (tx[:, None] + rx[None, :]))
    return [direction_cosine(flat, known, axis, on_grid=on_grid) for axis in (0, 2)]


def excess(estimate: Estimate, direction: Sequence[float], snr: float, known: Known) -> float:
    """Power that one wave from `direction` leaves in the channels of an estimate, over the wave's
    own and beyond what noise leaves; 0 where there is no direction.

    A wave has one amplitude at the active terminal and one for each transmit antenna at a passive
    one. What is left comes from other paths in the cell.
    """
    u = np.asarray(direction, float)
    if not np.isfinite(u).all() or (u**2).sum() > 1:
        return 0.0
    a, radius = known.antennas, known.radius(estimate.delay)
    turn = 2j * np.pi * known.waveform.effective_carrier
    sent, heard = (
        np.exp(turn * element_delays(places, u, radius)[0])
        for places in (a.tx_positions, a.rx_positions)
    )
    waves = estimate.channels @ heard.conj() / heard.size
    free = waves.size
    if known.passes == 2:
        waves, free = np.atleast_1d(waves @ sent.conj() / sent.size), 1
    total = float((np.abs(estimate.channels) ** 2).mean())
    wave = float((np.abs(waves) ** 2).mean())
    left = (total - wave) / (1 - free / estimate.channels.size)
    return max(left - total / max(snr, 1.0), 0.0) / max(wave, 1e-3 * total)


def standard_deviations(snr: float, excess: float, known: Known) -> np.ndarray:
    """Standard deviations of range, velocity, u_x, u_z of a path.

    Cramer-Rao of a tone, with Hann's loss of 2 on the two windowed axes, and never below the floors
    at which other paths' sidelobes usually end the gain. Other paths in the cell count twice: as
    noise of their power, different in every channel, and as a pull of range and velocity towards
    where they are, by their share of the power.

    Parameters
    ----------
    snr : of a channel, after processing
    excess : power of other paths in the cell over the path's own
    """
    w, total = known.waveform, known.channels / (1 / max(snr, 1.0 / known.channels) + excess)
    tone, pull = np.sqrt(2 * 6 / (4 * np.pi**2 * max(total, 1.0))), PULL * excess / (1 + excess)
    spread = [
        np.hypot(max(tone, 2e-3), pull) * known.range_cell,
        np.hypot(max(tone, 4e-3), pull) * w.velocity_cell(known.passes),
    ]
    angles = []
    for axis in (0, 2):
        place = arm(known.antennas, axis, known.passes).places[:, axis]
        slope = 2 * np.pi * w.effective_carrier / SPEED_OF_LIGHT * max(place.std(), 1e-6)
        share = place.size / known.channels
        angles.append(max(1 / (slope * np.sqrt(2 * max(total, 1.0) * share)), 2e-4))
    return np.array(spread + angles)
