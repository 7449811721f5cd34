"""Orthogonal matching pursuit off the grid: paths found one after the other, each taken out whole
before the next is sought.

The dictionary is not the Doppler grid but every path that the frame can hold: range, velocity and
migration by maximum likelihood, an amplitude for each channel, and each element's delay. A strong
path then takes one atom, not several, and leaves its row to the weaker ones; the sidelobes of
sparse sampling go with it.
"""

from __future__ import annotations

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.cfar import CfarRule, first_row
from isac_rt.receive.estimate import (
    Estimate,
    LocalSpectra,
    direction_cosines,
    hann_response,
    refine,
    start_point,
)
from isac_rt.receive.joint.fit import element_delays
from isac_rt.receive.maps import power_map
from isac_rt.scenario.receivers import Receivers

REACH = 24
"""Range rows on each side in which a path is taken out; Hann's lobes are 90 dB down there."""
CYCLES = 3
"""Times that the paths about a new one are estimated again, each with the others taken out."""
LEFT_OVER_DB = 35.0
"""What is this far under a path found before, within `NEAR` rows and bins of it, is what its
removal left."""
NEAR = (3, 4)


def pursue(
    spectra: np.ndarray,
    waveform: Waveform,
    schedule: Schedule,
    delay_symbols: np.ndarray,
    antennas: Antennas,
    settings: Receivers,
    passes: int,
) -> tuple[list[Estimate], np.ndarray, np.ndarray]:
    """Paths of a frame from cleaned spectra, in the order in which they were found, their SNR on
    the map that was left, and the map (rows, P) before anything was taken out.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) from `clean_spectrum`; not changed
    delay_symbols : (M, P), those that were removed
    passes : 2 for echoes, 1 at a PT
    """
    w, left = waveform, spectra.copy()
    rule = CfarRule.of(settings, antennas.num_tx * antennas.num_rx)
    first = first_row(settings, w.range_cell(passes))
    power = power_map(left, w, schedule, delay_symbols)
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
        local = LocalSpectra(left, w, schedule, delay_symbols, row)
        estimate = refine(local, *start_point(power, row, column, w))
        found.append(estimate)
        snr.append(float(power[row, column] / level[row, column]))
        rows = np.arange(max(row - NEAR[0], 0), min(row + NEAR[0] + 1, len(power)))
        columns = (np.arange(-NEAR[1], NEAR[1] + 1) + column) % w.num_chirps
        block = np.ix_(rows, columns)
        taken[block] = np.maximum(taken[block], power[row, column] * 10 ** (-LEFT_OVER_DB / 10))
        changed = _take_out(left, estimate, w, schedule, delay_symbols, antennas, passes)
        _fit_again(left, found, w, schedule, delay_symbols, antennas, passes)
        power[changed] = power_map(left[:, :, changed], w, schedule, delay_symbols)
    return found, np.array(snr), whole


def _fit_again(
    spectra: np.ndarray,
    found: list[Estimate],
    waveform: Waveform,
    schedule: Schedule,
    delay_symbols: np.ndarray,
    antennas: Antennas,
    passes: int,
) -> None:
    """Estimate the last path and those within its rows once more, each with the others taken out:
    the orthogonal step. In place."""
    w, place = waveform, [float(waveform.beat_cells(e.delay, e.delay_rate).mean()) for e in found]
    near = [k for k in range(len(found)) if abs(place[k] - place[-1]) < 2 * NEAR[0]]
    for _ in range(CYCLES if len(near) > 1 else 0):
        for k in near:
            _take_out(spectra, found[k], w, schedule, delay_symbols, antennas, passes, back=True)
            local = LocalSpectra(
                spectra,
                w,
                schedule,
                delay_symbols,
                min(max(round(place[k]), 0), spectra.shape[2] - 1),
            )
            found[k] = refine(local, found[k].delay, found[k].delay_rate)
            _take_out(spectra, found[k], w, schedule, delay_symbols, antennas, passes)


def _take_out(
    spectra: np.ndarray,
    estimate: Estimate,
    waveform: Waveform,
    schedule: Schedule,
    delay_symbols: np.ndarray,
    antennas: Antennas,
    passes: int,
    *,
    back: bool = False,
) -> slice:
    """Subtract a path in place from the rows that it reaches, or put it `back`; returns the rows.
    The template is that of `LocalSpectra` with each element's own delay."""
    w = waveform
    time = w.middle_time + delay_symbols * w.delay_step
    beat = w.beat_cells(estimate.delay, estimate.delay_rate, time)
    cycles = w.phase(estimate.delay + estimate.delay_rate * time, w.window_middle)
    middle = round(float(w.beat_cells(estimate.delay, estimate.delay_rate).mean()))
    rows = np.arange(max(middle - REACH, 0), min(middle + REACH + 1, spectra.shape[2]))
    direction = np.nan_to_num(direction_cosines(estimate, antennas, w, passes))
    radius = max(estimate.delay * SPEED_OF_LIGHT / passes, w.range_cell(passes))
    heard = element_delays(antennas.rx_positions, direction, radius)[0] / w.delay_step
    sent = (
        element_delays(antennas.tx_positions, direction, radius)[0] / w.delay_step * (passes == 2)
    )
    for m in range(len(spectra)):
        turn = np.exp(
            2j * np.pi * (cycles[m] - rows[:, None] * (w.window_length / 2 / w.num_samples))
        )
        for rx in range(spectra.shape[1]):
            shape = hann_response(w, beat[m] + sent[schedule[m]] + heard[rx] - rows[:, None])
            path = (estimate.channels[schedule[m], rx] * shape * turn).astype(np.complex64)
            spectra[m, rx, rows] += path if back else -path
    return slice(int(rows[0]), int(rows[-1]) + 1)
