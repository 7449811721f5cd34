"""What the mesh's clutter is like, in the terms in which the paper states its Rayleigh model:
extent, level, distribution, Doppler, correlation.

All of it from the expected powers and rates of the scatterers of one place: their amplitudes are
circular Gaussian, so that means and correlations follow in closed form and no frame is drawn.
"""

from __future__ import annotations

import numpy as np

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.free_space import radar_amplitude
from isac_rt.receive.types import ExpectedClutter
from reproduce.clutter_scenes import SMALL_UAV_M2

RUN = 45
"""Cells of the paper's run."""
NEAR_DB = 20.0
SPAN_M = 20.0, 100.0

RAYLEIGH = {
    "run_m": 45 * 0.24983,
    "cells_within_20_db": 45.0,
    "level_over_uav_db": 10.0,
    "level_p10_db": 10.0,
    "level_p90_db": 10.0,
    "fourth_moment": 2.0,
    "level_correlation": 1.0,
    "doppler_rms_mps": 0.0,
    "doppler_cells": 1.0,
    "frame_correlation": 1.0,
}
"""The same numbers of the paper's model: one level in all cells, no motion. Drawn anew in each
frame its frames would not correlate; the paper does not say."""


def cell_powers(clutter: ExpectedClutter, waveform: Waveform) -> tuple[np.ndarray, np.ndarray]:
    """Cell of each scatterer, and the mean power per sample [W] of every range cell up to N/2."""
    cell = np.round(clutter.delay / waveform.delay_step).astype(int)
    inside = cell < waveform.num_delay_symbols
    return cell, np.bincount(cell[inside], clutter.power[inside], waveform.num_delay_symbols)


def strongest_run(power: np.ndarray, length: int = RUN) -> slice:
    """The consecutive cells with the most power."""
    start = int(np.convolve(power, np.ones(length), "valid").argmax())
    return slice(start, start + length)


def statistics(
    clutter: ExpectedClutter, waveform: Waveform, amplitude: float, gain: float
) -> dict[str, float]:
    """Numbers of one place and motion.

    Parameters
    ----------
    amplitude : sqrt(transmit power of one antenna) [sqrt(W)]
    gain : power gain of an element on boresight

    Returns
    -------
    statistics : the keys of `RAYLEIGH`. Levels are those of a range cell over a small UAV on
        boresight at the same range, over the cells of `SPAN_M`, median and percentiles; moments,
        Doppler and correlations are over the strongest run of `RUN` cells, weighted by power.
        fourth_moment: E|a|^4/(E|a|^2)^2 over the run, 2 for one Rayleigh law. level_correlation: of
        neighbouring cells' levels in dB. doppler_cells: bins that hold 90 % of a cell's power.
        frame_correlation: of a cell's amplitude from one frame to the next
    """
    w = waveform
    cell, power = cell_powers(clutter, w)
    ranges = (np.arange(power.size)) * w.range_cell(2)
    span = (ranges >= SPAN_M[0]) & (ranges < SPAN_M[1]) & (power > 0)
    uav = (
        amplitude
        * gain
        * np.asarray(radar_amplitude(w.wavelength, SMALL_UAV_M2, ranges[span], ranges[span]))
    ) ** 2
    level = 10 * np.log10(power[span] / uav)
    run = strongest_run(power)
    inside = np.flatnonzero((cell >= run.start) & (cell < run.stop))
    moments = _motion(clutter.select(inside), cell[inside] - run.start, w)
    part = power[run]
    part_db = 10 * np.log10(np.maximum(part, 1e-6 * part.max()))
    return {
        "run_m": float(np.ptp(ranges[run]) + w.range_cell(2)),
        "cells_within_20_db": float((power > power.max() * 10 ** (-NEAR_DB / 10)).sum()),
        "level_over_uav_db": float(np.median(level)),
        "level_p10_db": float(np.quantile(level, 0.1)),
        "level_p90_db": float(np.quantile(level, 0.9)),
        "fourth_moment": float(2 * (part**2).mean() / part.mean() ** 2),
        "level_correlation": float(np.corrcoef(part_db[:-1], part_db[1:])[0, 1])
        if np.ptp(part_db) > 1e-6
        else 1.0,
        **moments,
    }


def _motion(part: ExpectedClutter, cell: np.ndarray, waveform: Waveform) -> dict[str, float]:
    """Doppler and coherence of the run's cells, weighted by their power."""
    w = waveform
    velocity = part.delay_rate * SPEED_OF_LIGHT / 2
    weight, rms, bins, same = [], [], [], []
    for k in np.unique(cell):
        here = cell == k
        p, v = part.power[here], velocity[here]
        total = p.sum()
        mean = (p * v).sum() / total
        weight.append(total)
        rms.append(np.sqrt((p * (v - mean) ** 2).sum() / total))
        spectrum = np.sort(
            np.bincount(np.round((v - v.min()) / w.velocity_cell(2)).astype(int), p)
        )[::-1]
        bins.append(1 + np.searchsorted(np.cumsum(spectrum), 0.9 * total))
        turn = np.exp(2j * np.pi * w.effective_carrier * part.delay_rate[here] * w.frame_duration)
        same.append(np.abs((p * turn).sum()) / total)
    return {
        "doppler_rms_mps": float(np.average(rms, weights=weight)),
        "doppler_cells": float(np.average(bins, weights=weight)),
        "frame_correlation": float(np.average(same, weights=weight)),
    }
