"""Off-grid estimates of one detection: range and velocity by maximum likelihood on the cleaned
spectra, then direction cosines.

A path of delay tau(t) = tau_0 + tau_dot t, t from mid-frame, has in the chirp at time t the phase
[cycles]

    Phi(x) = f_c tau + alpha tau (u_c - tau/2)  +  x [alpha tau + tau_dot (f_c + alpha (u_c - tau))]
                                                                                                 (1)

at the time x from the middle u_c of the chirp's window, with the carrier f_c, the slope alpha and
tau at that middle. The first term is the phase over slow time, the bracket the beat frequency: it
moves with the range (migration) and holds the Doppler shift (range-Doppler coupling). A template is
a path of unit amplitude by (1) in the few range rows around a peak (`match`). With the matches z of
the templates with the samples and the energies E of the templates, by transmit antenna n and
receiver l, the maximum-likelihood estimate in white noise maximises

    sum over n, l of |z_nl|^2 / E_n                                                              (2)

over tau_0 and tau_dot; its amplitudes are z_nl / E_n.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np

from isac_rt.frame.antennas import unit_vector
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels import receive_estimate
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.receive_estimate import STENCIL, Chirps, WindowAxis
from isac_rt.kernels.vector import LANES, aligned, unset
from isac_rt.receive.arms import element_delays
from isac_rt.receive.directions import (
    direction_bound,
    search_of,
    settled,
    statistic_of,
    strongest,
)
from isac_rt.receive.known import Known
from isac_rt.receive.maps import slow_window
from isac_rt.receive.modes import MODES, mode_shapes

HALF_WIDTH = 3
"""Range rows of a template on each side of the peak: Hann's main lobe and the migration."""
STENCILS = 0.2, 0.08, 0.03
"""Half widths of the stencils of the Newton steps on (2), in this order [cells, bins]."""
PULL = 1.0
"""Distance assumed between a path and another one in its cell [cells, bins]."""
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
    """Return the transform of the Hann window about its middle at `offset` cells from a tone:
    real, L/2 sinc(d)/(1 - d^2) with d in cells of the window of L samples."""
    length = waveform.window_length
    d = np.asarray(offset) * length / waveform.num_samples
    removable = np.abs(np.abs(d) - 1) < 1e-6  # 0/0 with the limit 1/2
    safe = np.where(removable, 0.5, d)
    return length / 2 * np.where(removable, 0.5, np.sinc(safe) / (1 - safe**2))


class LocalSpectra:
    """Range rows around a peak, gathered once for many evaluations of (2)."""

    def __init__(
        self,
        spectra: np.ndarray,
        known: Known,
        row: int,
        *,
        separate: bool = False,
        beam: np.ndarray | None = None,
        in_phase: bool = False,
    ) -> None:
        """Gather the rows around `row`.

        Parameters
        ----------
        separate : match each group by itself, for a velocity known up to aliases only
        beam : (L_tx, L_rx) weights of a beam, whose power replaces (2); the receivers add in phase,
            the transmit antennas in power, or with `in_phase` in phase too
        """
        self.waveform, self._sent = known.waveform, _sent(known, separate)
        self._beam, self._in_phase = beam, in_phase
        low, count = _rows_about(row, spectra.shape[2])
        self._axis = _axis(known.waveform)._replace(first=float(low))
        self._num_rx = spectra.shape[1]
        self._chirps = _workspace(self._sent, self._num_rx, count)
        gather(np.ascontiguousarray(spectra), low, self._axis.share, self._chirps)

    def _matched(self, delays: np.ndarray, delay_rates: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the matches z (K, L_tx, L_rx) of templates with the samples and the energies E
        (K, L_tx) of the templates."""
        size, blocks = self._sent.antennas, self._chirps.blocks
        out = np.zeros((delays.size, size * blocks * 2 * LANES), np.float32)
        energy = np.zeros((delays.size, size))
        match(self._chirps, self._axis, delays, delay_rates, out, energy)
        return _complex(out, energy, self._num_rx), np.maximum(energy, 1e-30)

    def respond(self, delay: float, delay_rate: float) -> np.ndarray:
        """Return the amplitudes z/E (L_tx, L_rx) of a path; with separate groups their mean, in
        the phases of the first group."""
        matched, energy = self._matched(np.array([delay]), np.array([delay_rate]))
        return _amplitudes(matched, energy, self.waveform.num_tx)[0]

    def modes(self, delay: float, delay_rate: float) -> np.ndarray:
        """Return the amplitudes (MODES, L_tx, L_rx) of a path whose response is a polynomial over
        the chirp (`isac_rt.receive.modes`): least squares over all rows and chirps."""
        c, a = self._chirps, self._axis
        size, rows = c.tx.size, c.rows
        data = c.data.reshape(size, rows, c.blocks, 2, LANES)
        received = (data[:, :, :, 0] + 1j * data[:, :, :, 1]).reshape(size, rows, -1)
        w, time = self.waveform, c.time[:size]
        # templates (MODES, chirp, row) by (1)
        beat = w.beat_cells(delay, delay_rate, time)
        offset = (beat - a.first)[:, None] - np.arange(rows)
        cycles = w.phase(delay + delay_rate * time, w.window_middle)
        shapes = a.length / 2 * mode_shapes(offset * a.share)
        shapes = shapes * np.exp(2j * np.pi * cycles)[:, None]
        # weighted normal equations of each transmit antenna
        weight = c.weight[:size]
        out = np.empty((MODES, self._sent.antennas, self._num_rx), complex)
        for antenna in range(self._sent.antennas):
            sent = c.tx == antenna
            template = shapes[:, sent].reshape(MODES, -1)
            weighted = (template * np.repeat(weight[sent], rows)).conj()
            matches = weighted @ received[sent].reshape(-1, received.shape[2])
            out[:, antenna] = np.linalg.solve(weighted @ template.T, matches[:, : self._num_rx])
        return out

    def powers(self, delays: np.ndarray, delay_rates: np.ndarray) -> np.ndarray:
        """Return (2), or the power of the beam, (K,). The energies E matter at the ends of the
        range axis, where part of a template lies outside: the amplitude alone would draw the
        estimate out."""
        matched, energy = self._matched(delays, delay_rates)
        if self._beam is None:
            explained = (matched.real**2 + matched.imag**2).sum(axis=2) / energy
            return np.asarray(explained.sum(axis=1))
        added = (self._beam * matched).sum(axis=2) / energy
        if self._in_phase:
            added = added.sum(axis=1, keepdims=True)
        return np.asarray((added.real**2 + added.imag**2).sum(axis=1))

    def climb(self, delay: float, delay_rate: float, steps: Sequence[float]) -> tuple[float, float]:
        """Move to the maximum of `powers` by Newton steps on stencils of half widths `steps`."""
        return _climb(self.powers, delay, delay_rate, steps, _units(self.waveform))


def _climb(
    powers: Callable[[np.ndarray, np.ndarray], np.ndarray],
    delay: float,
    delay_rate: float,
    steps: Iterable[float],
    units: tuple[float, float, float],
) -> tuple[float, float]:
    """Maximise `powers` over the beat at mid-frame [cells] and the Doppler [bins], in which its
    mixed derivative is small: the first stencil measures it, later ones have no corners."""
    delay_unit, rate_unit, coupling = units
    beat = delay / delay_unit + delay_rate / rate_unit * coupling
    doppler, mixed = delay_rate / rate_unit, 0.0
    for number, step in enumerate(steps):
        stencil = STENCIL[: 5 if number else len(STENCIL)]
        across = doppler + step * stencil[:, 1]
        delays = (beat + step * stencil[:, 0] - across * coupling) * delay_unit
        down, up, mixed = newton(powers(delays, across * rate_unit), step, mixed)
        beat, doppler = beat + down, doppler + up
    return (beat - doppler * coupling) * delay_unit, doppler * rate_unit


class _Sent(NamedTuple):
    """Weight, time [s] and antenna of each chirp, the first two padded to a multiple of sixteen,
    and the number of antennas; each separate group has antennas of its own."""

    weight: np.ndarray
    time: np.ndarray
    tx: np.ndarray
    antennas: int


@lru_cache(maxsize=8)
def _sent(known: Known, separate: bool) -> _Sent:
    w, chirps = known.waveform, known.schedule.size
    first_antenna = np.arange(w.num_groups)[:, None] * w.num_tx if separate else 0
    weight, time = np.zeros((2, chirps + -chirps % LANES))
    weight[:chirps].reshape(w.num_groups, -1)[:] = slow_window(w)
    time[:chirps] = known.times.ravel()
    tx = np.ascontiguousarray((known.schedule + first_antenna).ravel())
    return _Sent(weight, time, tx, w.num_tx * (w.num_groups if separate else 1))


def _rows_about(row: Any, num_rows: int) -> tuple[Any, Any]:
    """Return the first row of a template at `row`, and the number of its rows."""
    low = np.maximum(row - HALF_WIDTH, 0)
    return low, np.minimum(row + HALF_WIDTH + 1, num_rows) - low


def _complex(out: np.ndarray, energy: np.ndarray, num_rx: int) -> np.ndarray:
    """Return complex matches (K, antennas, L_rx) from the `out` of `match`."""
    blocks = -(-num_rx // LANES)
    parts = out.reshape(*energy.shape, blocks, 2, LANES).astype(float)
    values = (parts[..., 0, :] + 1j * parts[..., 1, :]).reshape(*energy.shape, blocks * LANES)
    return np.asarray(values[..., :num_rx])


def _amplitudes(matched: np.ndarray, energy: np.ndarray, num_tx: int) -> np.ndarray:
    """Return the amplitudes z/E (K, L_tx, L_rx) from matches (K, antennas, L_rx) and energies; of
    separate groups the mean, after a rotation of each antenna to its phase in the first group."""
    values = matched / energy[..., None]
    sets = values.reshape(len(values), energy.shape[1] // num_tx, num_tx, values.shape[2])
    if sets.shape[1] == 1:
        return np.asarray(sets[:, 0])
    phasor = np.exp(-1j * np.angle((sets * sets[:, :1].conj()).sum(axis=3, keepdims=True)))
    return np.asarray((sets * phasor).mean(axis=1))


def _workspace(sent: _Sent, num_rx: int, rows: int) -> Chirps:
    """Return the buffer of `gather` and `match` for a number of rows, without samples."""
    weight, time, tx, _ = sent
    blocks = -(-num_rx // LANES)
    data = unset(tx.size * rows * blocks * 2 * LANES)
    return Chirps(data, rows, blocks, weight, time, tx, aligned(LANES * LANES))


def _axis(waveform: Waveform) -> WindowAxis:
    """Return the parameters of templates on the whole range axis."""
    w = waveform
    share = w.window_length / w.num_samples
    window = w.window_middle, w.sampled_duration, w.window_length, share
    return WindowAxis(w.carrier_frequency, w.slope, *window, 0.0)


@twin_of(receive_estimate.gather)
def gather(spectra: np.ndarray, low: int, share: float, chirps: Chirps) -> None:
    """Fill `chirps.data` with rows from `low` of spectra (M, L_rx, rows, P).

    The window begins at sample 0. The phase pi row share refers the spectra to its middle, about
    which its transform is real.
    """
    row = low + np.arange(chirps.rows)
    centred = spectra[:, :, row] * np.exp(1j * np.pi * row * share)[:, None]
    by_chirp = centred.transpose(0, 3, 2, 1).reshape(-1, chirps.rows, spectra.shape[1])
    lanes = chirps.blocks * LANES
    padded = np.pad(by_chirp, ((0, 0), (0, 0), (0, lanes - by_chirp.shape[2])))
    padded = padded.reshape(*padded.shape[:2], chirps.blocks, 1, LANES)
    chirps.data[:] = np.concatenate([padded.real, padded.imag], axis=3).ravel()


@twin_of(receive_estimate.match)
def match(
    chirps: Chirps,
    axis: WindowAxis,
    delays: np.ndarray,
    delay_rates: np.ndarray,
    out: np.ndarray,
    energy: np.ndarray,
) -> None:
    """Add the matches z of templates (1) at K delays and delay rates to `out` and their energies E
    to `energy` (K, antennas); chirps have weights, rows the window's transform.

    `out` (K, antennas * line) float32: blocks of sixteen real, then sixteen imaginary parts.
    """
    size, a = chirps.tx.size, axis
    data = chirps.data.reshape(size, chirps.rows, -1)
    weight, time = chirps.weight[:size], chirps.time[:size]
    for k, (delay, rate) in enumerate(zip(delays, delay_rates, strict=True)):
        # beat of (1) [cells], and Hann's transform at its distance from each row
        tau = delay + rate * time
        beat = (a.slope * tau + rate * (a.carrier + a.slope * (a.middle - tau))) * a.duration
        d = ((beat - a.first)[:, None] - np.arange(chirps.rows)) * a.share
        removable = np.abs(np.abs(d) - 1) < 1e-9
        safe = np.where(removable, 0.5, d)
        factor = a.length / 2 * np.where(removable, 0.5, np.sinc(safe) / (1 - safe**2))
        # phase of (1); sums over rows, then over the chirps of each antenna
        phasor = np.exp(2j * np.pi * (a.carrier * tau % 1 + a.slope * tau * (a.middle - tau / 2)))
        parts = np.einsum("cr,crl->cl", weight[:, None] * factor, data).reshape(size, -1, 2, LANES)
        matched = (parts[:, :, 0] + 1j * parts[:, :, 1]) * phasor.conj()[:, None, None]
        sums = np.zeros((energy.shape[1], *matched.shape[1:]), complex)
        np.add.at(sums, chirps.tx, matched)
        out[k] += np.stack([sums.real, sums.imag], axis=2).ravel()
        np.add.at(energy[k], chirps.tx, weight * (factor**2).sum(axis=1))


def start_point(spectra_power: np.ndarray, row: T, column: T, waveform: Waveform) -> tuple[T, T]:
    """Return delay and delay rate of peaks of the centred map, by Hann's two-cell ratio on both
    axes: exact for a tone that does not migrate, within a tenth of a cell otherwise."""
    rows, num_bins = spectra_power.shape
    step = np.arange(-1, 2)
    i, j = np.asarray(row)[..., None] + step, np.asarray(column)[..., None] + step
    line = np.sqrt(spectra_power[np.clip(i, 0, rows - 1), j[..., 1:2]])
    line[(i < 0) | (i >= rows)] = 0  # beyond the ends of the range axis
    across = np.sqrt(spectra_power[i[..., 1:2], j % num_bins])
    cell, doppler = row + _hann_ratio(line), column - num_bins // 2 + _hann_ratio(across)
    return to_delay(cell, doppler, waveform)


def to_delay(cell: T, doppler_bin: T, waveform: Waveform) -> tuple[T, T]:
    """Return delay and delay rate at mid-frame of a beat [cells] and a Doppler bin (receding is
    positive): beat/T = alpha tau + tau_dot f, bin = tau_dot f T_frame."""
    w = waveform
    rate = doppler_bin / (w.frame_duration * w.effective_carrier)
    return (cell / w.sampled_duration - rate * w.effective_carrier) / w.slope, rate


def _hann_ratio(three: np.ndarray) -> np.ndarray:
    """Return the offset of a tone from the middle of three cells, (2 r - 1)/(1 + r) with the ratio
    r of the larger neighbour's magnitude to the peak's."""
    before, peak, after = np.moveaxis(three, -1, 0)
    ratio = np.maximum(before, after) / np.where(peak > 0, peak, 1)
    offset = np.clip((2 * ratio - 1) / (1 + ratio), -0.5, 0.5).astype(float)
    return np.where(peak > 0, np.where(after >= before, offset, -offset), 0.0)[()]


def refine(
    local: LocalSpectra, delay: float, delay_rate: float, steps: Sequence[float] = STENCILS
) -> Estimate:
    """Maximise (2) from a start by `LocalSpectra.climb`."""
    delay, delay_rate = local.climb(delay, delay_rate, steps)
    return Estimate(delay, delay_rate, local.respond(delay, delay_rate))


def _units(waveform: Waveform) -> tuple[float, float, float]:
    """Return the delay of a cell [s], the delay rate of a Doppler bin, and the cells by which a
    bin shifts the beat."""
    w = waveform
    rate = 1.0 / (w.frame_duration * w.effective_carrier)
    return w.delay_step, rate, w.sampled_duration / w.frame_duration


@twin_of(receive_estimate.newton)
def newton(powers: np.ndarray, step: float, mixed: float) -> tuple[float, float, float]:
    """Return the Newton step (down, across) on the logarithm g of the powers at `STENCIL`, of half
    width `step`, and the mixed derivative: that of the corners, or `mixed` without corners."""
    # central differences of g
    g = np.log(np.maximum(powers, 1e-300)).tolist()
    gx, gy = (g[2] - g[1]) / (2 * step), (g[4] - g[3]) / (2 * step)
    hxx = (g[2] - 2 * g[0] + g[1]) / step**2
    hyy = (g[4] - 2 * g[0] + g[3]) / step**2
    hxy = (g[8] - g[7] - g[6] + g[5]) / (4 * step**2) if len(g) > 5 else mixed
    # -H^-1 grad g where g is concave, else one step uphill; at most three half widths
    det = hxx * hyy - hxy**2
    down, across = math.copysign(step, gx), math.copysign(step, gy)
    if hxx < 0 and det > 0:
        down, across = (hyy * gx - hxy * gy) / -det, (hxx * gy - hxy * gx) / -det
    most = 3 * step
    return min(max(down, -most), most), min(max(across, -most), most), hxy


@twin_of(receive_estimate.estimate)
def estimate(
    spectra: np.ndarray,
    chirps: Chirps,
    axis: WindowAxis,
    lows: np.ndarray,
    counts: np.ndarray,
    delays: np.ndarray,
    rates: np.ndarray,
    steps: np.ndarray,
    units: tuple[float, float, float],
    out: np.ndarray,
    energy: np.ndarray,
) -> None:
    """Maximise (2) as `LocalSpectra.climb` for all peaks (Q,): changes `delays` and `rates` in
    place and adds the matches at the maxima to `out` and `energy` (`match`). The templates of a
    peak cover `counts` rows from `lows` on."""
    lanes, num_tx = 2 * LANES * chirps.blocks, energy.shape[1]
    for q, (low, count) in enumerate(zip(lows.tolist(), counts.tolist(), strict=True)):
        workspace = chirps.data[: chirps.tx.size * count * lanes]
        here, about = chirps._replace(data=workspace, rows=count), axis._replace(first=float(low))
        gather(spectra, low, axis.share, here)

        def explained(
            delays: np.ndarray, rates: np.ndarray, here: Chirps = here, about: WindowAxis = about
        ) -> np.ndarray:
            matches = np.zeros((len(delays), num_tx * lanes), np.float32)
            sums = np.zeros((len(delays), num_tx))
            match(here, about, delays, rates, matches, sums)
            power = (matches.reshape(len(delays), num_tx, -1).astype(float) ** 2).sum(axis=2)
            return np.asarray((power / np.maximum(sums, 1e-30)).sum(axis=1))

        delays[q], rates[q] = _climb(explained, delays[q], rates[q], steps, units)
        peak = slice(q, q + 1)
        match(here, about, delays[peak], rates[peak], out[peak], energy[peak])


@dataclass(frozen=True)
class Estimator:
    """Estimator of a path at a peak of the map: off the grid, or `on_grid` at the centre of its
    cell and the nearest direction of a grid of eight to a beam."""

    on_grid: bool = False

    def at(self, local: LocalSpectra, power: np.ndarray, row: int, column: int) -> Estimate:
        """Return the estimate of a peak of the centred map `power`."""
        start, steps = self._start(power, row, column, local.waveform)
        return refine(local, *start, steps)

    def at_peaks(
        self,
        spectra: np.ndarray,
        known: Known,
        power: np.ndarray,
        rows: np.ndarray,
        columns: np.ndarray,
        *,
        separate: bool = False,
    ) -> list[Estimate]:
        """Return the estimates at all peaks (Q,); `separate` as in `LocalSpectra`."""
        w, sent, num_rx = known.waveform, _sent(known, separate), spectra.shape[1]
        (delays, rates), steps = self._start(power, rows, columns, w)
        lows, counts = _rows_about(np.asarray(rows, np.int64), spectra.shape[2])
        chirps = _workspace(sent, num_rx, 2 * HALF_WIDTH + 1)
        energy = np.zeros((len(rows), sent.antennas))
        out = np.zeros((len(rows), sent.antennas * chirps.blocks * 2 * LANES), np.float32)
        peaks = lows, counts, delays, rates
        to = np.array(steps), _units(w), out, energy
        estimate(np.ascontiguousarray(spectra), chirps, _axis(w), *peaks, *to)
        energy = np.maximum(energy, 1e-30)
        channels = _amplitudes(_complex(out, energy, num_rx), energy, w.num_tx)
        return [Estimate(*e) for e in zip(delays.tolist(), rates.tolist(), channels, strict=True)]

    def _start(
        self, power: np.ndarray, row: T, column: T, waveform: Waveform
    ) -> tuple[tuple[T, T], Sequence[float]]:
        """Return the start of the search at peaks, and its stencils."""
        if self.on_grid:
            return to_delay(row, column - waveform.num_chirps // 2, waveform), ()
        return start_point(power, row, column, waveform), STENCILS


OFF_GRID = Estimator()


def direction_cosines(estimate: Estimate, known: Known, *, on_grid: bool = False) -> list[float]:
    """Return u_x and u_z of a detection (`directions`)."""
    delay = np.array([estimate.delay])
    return directions(estimate.channels[None], delay, known, on_grid=on_grid)[0].tolist()


def directions(
    channels: np.ndarray, delays: np.ndarray, known: Known, *, on_grid: bool = False
) -> np.ndarray:
    """Return u_x and u_z (Q, 2) of detections from their channels (Q, L_tx, L_rx) and delays (Q,)
    [s].

    A second pass removes the phase of the wavefront's curvature, k (|r|^2 - (r.u)^2) / (2 R) for an
    element at r and a source at distance R, which would bias the estimate by 0.02 degrees at 11 m.
    R is the estimated range; the wavefront of a reflection towards a PT is more curved.
    """
    u = _cosines(channels, known, on_grid=on_grid)  # first pass: plane waves
    radius = delays * SPEED_OF_LIGHT / known.passes
    flat_u = in_plane(u, known)
    valid = _within(flat_u) & (radius > 0)
    towards = unit_vector(flat_u[valid])
    k = 2 * np.pi * known.waveform.effective_carrier / SPEED_OF_LIGHT
    scale = k / (2 * radius[valid, None])
    tx, rx = (
        scale * ((r**2).sum(1) - (towards @ r.T) ** 2)
        for r in (known.antennas.tx_positions, known.antennas.rx_positions)
    )
    flat = channels[valid] * np.exp(-1j * (tx[:, :, None] + rx[:, None, :]))
    u[valid] = _cosines(flat, known, on_grid=on_grid)
    return u


def _cosines(channels: np.ndarray, known: Known, *, on_grid: bool) -> np.ndarray:
    """Return u_x and u_z (Q, 2) of plane waves: from all channels in phase for an echo; at a
    passive terminal from the receivers, with the powers of the transmit antennas added, since
    departure and arrival differ."""
    search = search_of(known.antennas, known.wavenumber, known.passes)
    y = channels.reshape(-1, 1, known.channels) if known.passes == 2 else channels
    return strongest(y, search, on_grid=on_grid)


def near_beam(
    estimate: Estimate, known: Known, cosines: np.ndarray, inverse: np.ndarray | None = None
) -> np.ndarray:
    """Return (u_x, u_z) of the largest likelihood near a beam at `cosines`: with the inverse
    covariance R^-1 (L, L) of the channels, or in white noise (`Search.reading`)."""
    search = search_of(known.antennas, known.wavenumber, known.passes, known.antennas.view_limit)
    y = estimate.channels[None]
    if known.passes == 2:
        y = y.reshape(1, 1, -1)
    white = y if inverse is None else y @ inverse.T
    statistic = statistic_of(white, None if inverse is None else inverse[None])
    return search.reading(settled(statistic, cosines[None], search)[0])


def in_plane(u: np.ndarray, known: Known) -> np.ndarray:
    """Return the direction cosines (Q, 2) with 0 on an axis that the array does not observe."""
    return np.where(known.antennas.observes(known.passes), u, 0.0)


def _within(u: np.ndarray) -> np.ndarray:
    """Mark the direction cosines (Q, 2) that belong to a direction, (Q,) bool."""
    return np.isfinite(u).all(axis=1) & (u[:, 0] ** 2 + u[:, 1] ** 2 <= 1)


def excess(
    channels: np.ndarray, delays: np.ndarray, u: np.ndarray, snr: np.ndarray, known: Known
) -> np.ndarray:
    """Return the power of other paths in the cell over that of the path, (Q,): the residual of the
    channels (Q, L_tx, L_rx) after the fit of one wave from u (Q, 2), less the expected noise.

    The wave has one amplitude at an active terminal, and one for each transmit antenna at a passive
    one. The ratio is 0 without a direction, and for a single channel.
    """
    out, u = np.zeros(len(u)), in_plane(u, known)
    a, free = known.antennas, 1 if known.passes == 2 else known.antennas.num_tx
    valid = _within(u)
    if free == known.channels or not valid.any():
        return out
    received, radius = channels[valid], known.radius(delays[valid])[:, None]
    # least-squares amplitudes of the wave: channels times the conjugate steering vectors
    j_omega = 2j * np.pi * known.waveform.effective_carrier
    at_tx, at_rx = (
        np.exp(j_omega * element_delays(positions, u[valid], radius)[0]).conj() / len(positions)
        for positions in (a.tx_positions, a.rx_positions)
    )
    waves = (received * at_rx[:, None]).sum(axis=2)
    if known.passes == 2:
        waves = (waves * at_tx).sum(axis=1, keepdims=True)
    # residual per remaining degree of freedom, less the noise
    total = (np.abs(received) ** 2).mean(axis=(1, 2))
    wave = (np.abs(waves) ** 2).mean(axis=1)
    residual = (total - wave) / (1 - free / known.channels)
    others = np.maximum(residual - total / np.maximum(snr[valid], 1.0), 0.0)
    out[valid] = others / np.maximum(wave, 1e-3 * total)
    return out


def standard_deviations(
    snr: float | np.ndarray, excess: float | np.ndarray, known: Known
) -> np.ndarray:
    """Return the standard deviations (..., 4) of range, velocity, u_x, u_z of paths; infinite on an
    axis that the array does not observe.

    The Cramer-Rao bound of a tone, times Hann's loss of 2 in variance on range and Doppler, and not
    below floors set by other paths' sidelobes. Other paths in the cell enter as noise of their
    power in every channel, and as a bias of range and velocity, `PULL` times their share.

    Parameters
    ----------
    snr : of a channel, after processing (...)
    excess : power of other paths in the cell over the path's own (...)
    """
    w, least = known.waveform, 1.0 / known.channels
    # SNR of all channels; deviation of a tone's frequency, sqrt(2 * 6 / SNR) / (2 pi) [cells]
    total = np.maximum(known.channels / (1 / np.maximum(snr, least) + excess), 1.0)
    tone, pull = np.sqrt(2 * 6 / (4 * np.pi**2 * total)), PULL * excess / (1 + excess)
    spread = [
        np.hypot(np.maximum(tone, 2e-3), pull) * known.range_cell,
        np.hypot(np.maximum(tone, 4e-3), pull) * w.velocity_cell(known.passes),
    ]
    bound = np.diag(direction_bound(known.antennas, known.passes, known.wavenumber))
    spread += [np.maximum(np.sqrt(variance / total), 2e-4) for variance in bound]
    return np.stack(spread, axis=-1)
