"""Symbol decisions from beams towards the predicted paths.

The paper adds the powers of the receivers. Once the directions are tracked, the receivers can be
added in phase: one beam per predicted path, with the other paths that share its range cells kept
out by the weights. Beams of several paths, each read at its own beat and turned by its own motion,
are combined for the delay and for the DPSK symbols. The error of the predicted velocity turns the
transitions of all groups and antennas in proportion to their spacing in time: it is found from all
of them at once and taken out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import by_antenna, demodulate_bits, running_phases
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.arms import element_delays
from isac_rt.receive.clutter_filter import chirp_runs
from isac_rt.receive.spectrum import tones, transform
from isac_rt.receive.symbols import (
    WEAKEST_WEIGHT,
    ByPowers,
    Symbols,
    known_cycles,
    nearest_symbols,
    symbol_cells,
)
from isac_rt.receive.types import Prediction

SHARED_CELLS = 2.0
"""Paths nearer than this in beat lie in each other's cells."""
LOADING = 1e-2
"""Of the weights that keep another path out: noise they may take up, relative to a path of weight 1
on one receiver."""
VELOCITY_STEPS = 81
FARTHEST_BINS, FARTHEST_STDS = 1.0, 4.0
"""Where the true velocity is sought about the predicted one."""


def usable_paths(prediction: Prediction) -> np.ndarray:
    """Numbers of the predicted paths that have a direction and enough power; empty if the reference
    has none."""
    known = np.isfinite(prediction.direction).all(axis=1) & (prediction.weight >= WEAKEST_WEIGHT)
    known[0] = np.isfinite(prediction.direction[0]).all()
    return np.flatnonzero(known) if known[0] else np.zeros(0, int)


def beam_weights(
    prediction: Prediction, beats: np.ndarray, antennas: Antennas, waveform: Waveform
) -> np.ndarray:
    """(K, L_rx) weights of unit noise gain towards each path, against those within `SHARED_CELLS`.

    w_k ~ (sum_j g_j a_j a_j^H + loading I)^-1 a_k over the paths that share k's cells; alone this
    is the plain beam.
    """
    radius = np.maximum(prediction.range, waveform.range_cell(1))[:, None]
    delays = element_delays(antennas.rx_positions, prediction.direction, radius)[0]
    steer = np.exp(2j * np.pi * waveform.effective_carrier * delays)
    out = np.empty_like(steer)
    for k, a in enumerate(steer):
        near = np.abs(beats - beats[k]) < SHARED_CELLS
        near[k] = False
        R = LOADING * np.eye(a.size) + np.einsum(
            "j,jr,js->rs", prediction.weight[near], steer[near], steer[near].conj()
        )
        out[k] = np.linalg.solve(R, a)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def demodulate_beams(
    cube: IFCube,
    prediction: Prediction,
    antennas: Antennas,
    dpsk_order: int,
    run_cells: int | None = None,
) -> Symbols:
    """Decide all symbols of a frame from beams; parameters as for `demodulate`, which decides where
    the reference has no direction."""
    w = cube.waveform
    rows = usable_paths(prediction)
    p = Prediction(**{name: value[rows] for name, value in vars(prediction).items()})
    delays, rates = p.range / SPEED_OF_LIGHT, p.velocity / SPEED_OF_LIGHT
    cells = symbol_cells(w)
    spectra = _beam_spectra(cube, p, antennas, cells, run_cells)
    noise, snr, each = zip(*(_likelihood(one) for one in spectra), strict=True)
    likelihood = np.sum(each, axis=0)
    metric = np.einsum("k,kmps->mps", p.weight, np.abs(spectra) ** 2)
    best = likelihood.argmax(axis=-1)
    raw = cells[best]
    peak = np.take_along_axis(metric, best[..., None], axis=-1)[..., 0]
    sure = peak / np.maximum((metric.sum(axis=-1) - peak) / (cells.size - 1), 1e-300)
    picked = np.take_along_axis(spectra, best[None, ..., None], axis=-1)[..., 0].astype(complex)
    for k in range(len(rows)):
        picked[k] *= np.exp(-2j * np.pi * known_cycles(w, delays[k], rates[k], raw))
    delay = np.clip(raw, 0, w.num_delay_symbols - 1)
    product, length = transitions_of(picked, cube.schedule, w, raw)
    far = (FARTHEST_STDS * p.velocity_std + FARTHEST_BINS * w.velocity_cell(1)) / SPEED_OF_LIGHT
    summed = np.zeros(product.shape[1:], np.complex128)
    for k in range(len(rows)):
        rate = rate_error(product[k], length, far[k], dpsk_order, w)
        product[k] *= np.exp(-2j * np.pi * rate * w.effective_carrier * length)
        summed += product[k] * (2 * snr[k] / (noise[k] * (1 + 2 * snr[k])))
    transitions, spread = nearest_symbols(summed, dpsk_order)
    return Symbols(
        raw=raw,
        delay=delay,
        delay_confidence=sure,
        transitions=transitions,
        transition_confidence=special.i1e(np.abs(summed)) / special.i0e(np.abs(summed)),
        phase_spread=spread,
        phases=running_phases(transitions, cube.schedule, dpsk_order),
        bits=demodulate_bits(delay, transitions, w, dpsk_order),
        looks=1,
    )


class ByBeams(ByPowers):
    """Receivers added in phase towards the tracked paths; in power where the reference has no
    direction."""

    def read(self, cube: IFCube, prediction: Prediction, antennas: Antennas) -> Symbols:
        if not usable_paths(prediction).size:
            return super().read(cube, prediction, antennas)
        return demodulate_beams(cube, prediction, antennas, self.order, self.run_cells)


def _beam_spectra(
    cube: IFCube, p: Prediction, antennas: Antennas, cells: np.ndarray, run_cells: int | None
) -> np.ndarray:
    """(K, M, P, len(cells)) complex64, spectra of the beams, each derotated by its path's beat, at
    the cells of the symbols."""
    w, shape = cube.waveform, cube.schedule.shape
    beats = [
        w.beat_cells(r / SPEED_OF_LIGHT, v / SPEED_OF_LIGHT)
        for r, v in zip(p.range, p.velocity, strict=True)
    ]
    weights = beam_weights(p, np.array([b.mean() for b in beats]), antennas, w)
    weights = weights.conj().astype(np.complex64)
    out = np.empty((len(beats), *shape, cells.size), np.complex64)
    made = np.empty((1, cells.size, shape[1]), np.complex64)
    for m in range(shape[0]):
        beams = np.tensordot(weights, cube.samples[m], axes=1)
        for k, beat in enumerate(beats):
            derotation = tones(-beat[m] / w.num_samples, w.num_samples)
            transform(beams[k : k + 1], derotation, cells, made)
            out[k, m] = made[0].T
            if run_cells is not None:
                runs = chirp_runs(cube.samples[m], derotation, run_cells)
                out[k, m][runs[:, cells % w.num_samples]] = 0
    return out


def _likelihood(spectra: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Noise power of a cell, SNR of the path's cell, and the log likelihood of each cell (M, P, S)
    as the path's, its phase unknown: ln I_0(2 sqrt(g E / N)) with E the cell's power."""
    power = np.abs(spectra) ** 2
    noise = max(float(np.median(power)) / np.log(2), 1e-300)
    snr = max(float(np.median(power.max(axis=-1))) / noise - 1, 1e-3)
    x = 2 * np.sqrt(snr * power / noise)
    return noise, snr, x + np.log(special.i0e(x))


def transitions_of(
    picked: np.ndarray, schedule: Schedule, waveform: Waveform, raw: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Products of each antenna's consecutive chirps with the conjugate of the earlier one, (K, M,
    L_tx, P/L_tx - 1), and the time between them [s] (M, L_tx, P/L_tx - 1)."""
    w = waveform
    products = []
    for one in picked:
        chains = by_antenna(one, schedule, w.num_tx)
        products.append(chains[..., 1:] * chains[..., :-1].conj())
    times = by_antenna(w.middle_time + raw * w.delay_step, schedule, w.num_tx)
    return np.array(products), np.diff(times, axis=-1)


def rate_error(
    product: np.ndarray, length: np.ndarray, far: float, order: int, waveform: Waveform
) -> float:
    """Error of a predicted delay rate from the DPSK phases of all groups and antennas: the maximum
    of |sum of z^D / |z|^(D-1) turned back by D times the rate's phase|, real part, so that the
    constellation falls on its symbols; parabola through the three points."""
    raised = np.abs(product) * np.exp(1j * order * np.angle(product))
    rates = np.linspace(-far, far, VELOCITY_STEPS)
    turn = -2j * np.pi * order * waveform.effective_carrier * length
    fit = np.array([(raised * np.exp(r * turn)).sum().real for r in rates])
    i = int(np.clip(np.argmax(fit), 1, VELOCITY_STEPS - 2))
    return float(rates[i] + vertex(*fit[i - 1 : i + 2]) * (rates[1] - rates[0]))


def vertex(before: ArrayLike, peak: ArrayLike, after: ArrayLike) -> np.ndarray:
    """Where a parabola through three points has its top, in steps from the middle."""
    before, after = np.asarray(before), np.asarray(after)
    curvature = np.minimum(before - 2 * np.asarray(peak) + after, -1e-300)
    return np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)
