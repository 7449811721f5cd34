"""Orthogonal matching pursuit off the grid as it is written down: path after path, the map made
anew after each, everything within six rows estimated again in numpy. Slow; the oracle of
`isac_rt.receive.pursuit`, with which it shares the estimator and the map."""

from __future__ import annotations

import numpy as np

from isac_rt.receive.arms import element_delays
from isac_rt.receive.cfar import CfarRule, first_row
from isac_rt.receive.estimate import (
    Estimate,
    LocalSpectra,
    direction_cosines,
    hann_response,
    refine,
    start_point,
)
from isac_rt.receive.known import Known
from isac_rt.receive.maps import power_map
from isac_rt.receive.settings import Receivers

REACH, CYCLES, LEFT_OVER_DB, NEAR = 24, 3, 35.0, (3, 4)


def pursue(
    spectra: np.ndarray, known: Known, settings: Receivers
) -> tuple[list[Estimate], np.ndarray, np.ndarray]:
    """Paths of a frame from cleaned spectra, in the order in which they were found, their SNR on
    the map that was left, and the map (rows, P) before anything was taken out.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) from `clean_spectrum`; not changed
    """
    w, left = known.waveform, spectra.copy()
    rule, first = CfarRule.of(settings, known.channels), first_row(settings, known.range_cell)
    power = power_map(left, known)
    whole = power.copy()
    taken = np.zeros(power.shape)  # power under which a cell holds a remainder
    found: list[Estimate] = []
    snr: list[float] = []
    while len(found) < settings.max_detections:
        above, level = rule.detect(power)
        above[:first] = False
        above &= power > taken
        if not above.any():
            break
        row, column = divmod(int(np.where(above, power, 0).argmax()), power.shape[1])
        local = LocalSpectra(left, known, row)
        estimate = refine(local, *start_point(power, row, column, w))
        found.append(estimate)
        snr.append(float(power[row, column] / level[row, column]))
        rows = np.arange(max(row - NEAR[0], 0), min(row + NEAR[0] + 1, len(power)))
        columns = (np.arange(-NEAR[1], NEAR[1] + 1) + column) % w.num_chirps
        block = np.ix_(rows, columns)
        taken[block] = np.maximum(taken[block], power[row, column] * 10 ** (-LEFT_OVER_DB / 10))
        changed = _take_out(left, estimate, known)
        _fit_again(left, found, known)
        power[changed] = power_map(left[:, :, changed], known)
    return found, np.array(snr), whole


def _fit_again(spectra: np.ndarray, found: list[Estimate], known: Known) -> None:
    """Estimate the last path and those within its rows once more, each with the others taken out:
    the orthogonal step. In place."""
    w = known.waveform
    place = [float(w.beat_cells(e.delay, e.delay_rate).mean()) for e in found]
    near = [k for k in range(len(found)) if abs(place[k] - place[-1]) < 2 * NEAR[0]]
    for _ in range(CYCLES if len(near) > 1 else 0):
        for k in near:
            _take_out(spectra, found[k], known, back=True)
            row = min(max(round(place[k]), 0), spectra.shape[2] - 1)
            local = LocalSpectra(spectra, known, row)
            found[k] = refine(local, found[k].delay, found[k].delay_rate)
            _take_out(spectra, found[k], known)


def _take_out(
    spectra: np.ndarray, estimate: Estimate, known: Known, *, back: bool = False
) -> slice:
    """Subtract a path in place from the rows that it reaches, or put it `back`; returns the rows.
    The template is that of `LocalSpectra` with each element's own delay."""
    w, e, schedule = known.waveform, estimate, known.schedule
    beat = w.beat_cells(e.delay, e.delay_rate, known.times)
    cycles = w.phase(e.delay + e.delay_rate * known.times, w.window_middle)
    middle = round(float(w.beat_cells(e.delay, e.delay_rate).mean()))
    rows = np.arange(max(middle - REACH, 0), min(middle + REACH + 1, spectra.shape[2]))
    direction = np.nan_to_num(direction_cosines(e, known))
    received, sent = (
        element_delays(positions, direction, known.radius(e.delay))[0] / w.delay_step
        for positions in (known.antennas.rx_positions, known.antennas.tx_positions)
    )
    sent = sent * (known.passes == 2)
    for m in range(len(spectra)):
        turn = np.exp(
            2j * np.pi * (cycles[m] - rows[:, None] * (w.window_length / 2 / w.num_samples))
        )
        for rx in range(spectra.shape[1]):
            shape = hann_response(w, beat[m] + sent[schedule[m]] + received[rx] - rows[:, None])
            path = (e.channels[schedule[m], rx] * shape * turn).astype(np.complex64)
            spectra[m, rx, rows] += path if back else -path
    return slice(int(rows[0]), int(rows[-1]) + 1)
