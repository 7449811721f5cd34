"""J-SPEDD: a passive terminal decodes the data and senses with the same frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.cfar import CfarRule
from isac_rt.receive.estimate import Estimate, LocalSpectra
from isac_rt.receive.joint.fit import Frame, JointPath
from isac_rt.receive.joint.separate import separate
from isac_rt.receive.sense import (
    Sensed,
    describe,
    estimate_at,
    make_maps,
    num_looks,
    sense,
    velocity_method,
)
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.symbols.beams import demodulate_beams, usable_paths
from isac_rt.receive.symbols.phases import decide_phases
from isac_rt.receive.symbols.powers import (
    EXTRA_CELLS,
    Symbols,
    confidence_threshold,
    demodulate,
    moves_as_predicted,
)
from isac_rt.receive.types import Detections, Prediction, Reception, no_detections
from isac_rt.scenario.receivers import Receivers

# the line of sight arrives first; what precedes the strongest path by more is a sidelobe or noise
REFERENCE_SPAN_DB = 20.0
# range rows searched on each side of the predicted one: the fraction is known, the whole cell is
# the prediction's
GATE_CELLS = 1
GATE_BINS = 4


def receive_passive(
    cube: IFCube,
    antennas: Antennas,
    settings: Receivers,
    dpsk_order: int,
    prediction: Prediction | None,
    modulated: bool,
    *,
    groups: Sequence[int] | None = None,
    profile: np.ndarray | None = None,
    maps: bool = False,
) -> Reception:
    """Data symbols, bits and detections of one frame.

    Parameters
    ----------
    cube : IFCube
    prediction : row 0 is the line of sight; None when nothing is tracked. Unmodulated frames need
        none
    modulated : whether the frame carries data (public)
    groups : that carry data for this terminal, None for all. It decodes these, and senses with
        these alone while there are data: what the others carry it does not know
    profile : range profile with which the delay symbols are decided
        (`isac_rt.receive.symbols.profile`), None: by the strongest cell
    maps : also return pictures

    Returns
    -------
    Reception; in an unmodulated frame the reference is the earliest detection within 20 dB of the
    strongest. Without a prediction a modulated frame cannot be read: nothing is detected. When the
    decisions look like noise or like a path that moves otherwise, or nothing is found where the
    reference is expected, `line_of_sight` is False and all symbols are erased.
    """
    if groups is not None and modulated:
        part = cube.of_groups(groups)
        mine = receive_passive(
            part, antennas, settings, dpsk_order, prediction, modulated, profile=profile, maps=maps
        )
        return _among_all(mine, groups, cube.waveform)
    w = cube.waveform
    if not modulated:
        pilot = unmodulated(w)
        spectra = clean_spectrum(cube, pilot.delay_symbols, pilot.phases, w.num_delay_symbols)
        found = sense(spectra, w, cube.schedule, pilot.delay_symbols, antennas, settings, passes=1)
        reception = _reception(
            cube, settings, *_earliest(found, cube.schedule, antennas, settings), found, None, maps
        )
        return _jointly(
            reception, Frame(cube, pilot.delay_symbols, pilot.phases, antennas, 1), settings
        )
    if prediction is None:
        return _reception(cube, settings, no_detections(), None, None, None, maps)
    run_cells = settings.clutter_run_cells if settings.clutter_filter == "runs" else None
    if settings.symbol_decision == "beams" and usable_paths(prediction).size:
        symbols = demodulate_beams(cube, prediction, antennas, dpsk_order, run_cells)
    else:
        symbols = demodulate(cube, prediction, dpsk_order, run_cells, profile)
    cells = w.num_delay_symbols + 2 * EXTRA_CELLS
    confident = np.median(symbols.delay_confidence) >= confidence_threshold(
        symbols.looks, cells, symbols.raw.size
    )
    if not confident or not moves_as_predicted(symbols, dpsk_order):
        return _reception(cube, settings, no_detections(), None, None, None, maps)
    frame = Frame(cube, symbols.raw, symbols.phases, antennas, 1)
    found, detections, reference = _sense_data(frame, prediction, settings)
    if (
        settings.refinement == "joint"
        and reference is not None
        and np.isfinite(detections.direction[0]).all()
    ):
        first = detections  # row 0 is the reference
        start = (
            first.range[0] / SPEED_OF_LIGHT,
            first.velocity[0] / SPEED_OF_LIGHT,
            first.direction[0],
        )
        phases = decide_phases(frame, JointPath(*start, np.ones(1), np.zeros(4)), dpsk_order)
        if not np.allclose(phases, frame.phases):
            frame = replace(frame, phases=phases)
            found, detections, reference = _sense_data(frame, prediction, settings)
    reception = _reception(
        cube, settings, detections, reference, found, symbols if reference else None, maps
    )
    return _jointly(reception, frame, settings)


def _sense_data(
    frame: Frame, prediction: Prediction, settings: Receivers
) -> tuple[Sensed, Detections, Estimate | None]:
    """What a frame shows once its symbols are taken out, with the reference put first."""
    cube, raw = frame.cube, frame.delay_symbols
    spectra = clean_spectrum(cube, raw, frame.phases, frame.waveform.num_delay_symbols)
    found = sense(spectra, frame.waveform, cube.schedule, raw, frame.antennas, settings, passes=1)
    return found, *_at_prediction(spectra, raw, found, prediction, cube, frame.antennas, settings)


def _jointly(reception: Reception, frame: Frame, settings: Receivers) -> Reception:
    """With `joint` refinement all detections fitted at once, and the reference's power with
    them."""
    if settings.refinement != "joint":
        return reception
    detections, power = separate(frame, reception.detections)
    mine = power[detections.is_reference]
    known = mine.size and np.isfinite(mine[0])
    return replace(
        reception,
        detections=detections,
        reference_power=float(mine[0]) if known else reception.reference_power,
    )


def _among_all(mine: Reception, groups: Sequence[int], waveform: Waveform) -> Reception:
    """A reception of some groups in the shapes of all: nothing is decided in the others."""

    def spread(values: np.ndarray, missing: int) -> np.ndarray:
        out = np.full((waveform.num_groups, *values.shape[1:]), missing, values.dtype)
        out[list(groups)] = values
        return out

    return replace(
        mine,
        delay_symbols=spread(mine.delay_symbols, -1),
        transitions=spread(mine.transitions, -1),
        delay_confidence=spread(mine.delay_confidence, 0),
        transition_confidence=spread(mine.transition_confidence, 0),
    )


def _earliest(
    found: Sensed, schedule: Schedule, antennas: Antennas, settings: Receivers
) -> tuple[Detections, Estimate | None]:
    """Mark the earliest detection within REFERENCE_SPAN_DB of the strongest, if it is sure: the
    false-alarm rate is asked of the whole map here and not of one cell, or an empty pilot would now
    and then be acquired."""
    d = found.detections
    rule = CfarRule.of(settings, num_looks(settings, schedule, antennas))
    sure = d.snr > replace(rule, rate=rule.rate / found.power.size).threshold
    if not sure.any():
        return d, None
    power = np.array([_power(e) for e in found.estimates])
    sure &= power >= 10 ** (-REFERENCE_SPAN_DB / 10) * power.max()
    first = np.flatnonzero(sure)[np.argmin(d.range[sure])]
    return replace(d, is_reference=np.arange(len(d)) == first), found.estimates[first]


def _power(estimate: Estimate) -> float:
    """Mean power of a path per sample and receive antenna [W]."""
    return float((np.abs(estimate.channels) ** 2).mean())


def _at_prediction(
    spectra: np.ndarray,
    delay_symbols: np.ndarray,
    found: Sensed,
    prediction: Prediction,
    cube: IFCube,
    antennas: Antennas,
    settings: Receivers,
) -> tuple[Detections, Estimate | None]:
    """The reference within the gate, put first with its own estimate, and the other detections
    beside it."""
    w = cube.waveform
    row, column = predicted_cell(prediction, w)
    if not 0 <= row < found.power.shape[0]:
        return no_detections(), None
    rows = np.arange(max(row - GATE_CELLS, 0), min(row + GATE_CELLS + 1, found.power.shape[0]))
    columns = (np.arange(-GATE_BINS, GATE_BINS + 1) + column) % w.num_chirps
    gate = found.power[np.ix_(rows, columns)]
    i, j = np.unravel_index(gate.argmax(), gate.shape)
    rule = CfarRule.of(settings, num_looks(settings, cube.schedule, antennas))
    factors = rule.factors(len(found.power))
    snr = found.power[rows[i], columns[j]] / found.level[rows[i], columns[j]]
    if not snr > factors[rows[i]]:
        return no_detections(), None
    separate = velocity_method(settings, cube.schedule, w.num_tx) == "conventional"
    local = LocalSpectra(spectra, w, cube.schedule, delay_symbols, int(rows[i]), separate=separate)
    estimate = estimate_at(local, found.power, int(rows[i]), int(columns[j]), settings)
    reference = describe(
        [estimate], np.array([snr]), antennas, w, 1, on_grid=settings.refinement == "grid"
    )
    d = found.detections
    apart = np.abs(d.range - reference.range[0]) / w.range_cell(1) > 1
    apart |= np.abs(d.velocity - reference.velocity[0]) / w.velocity_cell(1) > 1
    first = replace(reference, is_reference=np.ones(1, bool))
    return Detections.joined([first, d.select(apart)]), estimate


def predicted_cell(prediction: Prediction, waveform: Waveform) -> tuple[int, int]:
    """Row and centred Doppler column where the reference is expected."""
    w = waveform
    doppler = prediction.velocity[0] / w.velocity_cell(1)
    beat = prediction.range[0] / w.range_cell(1) + doppler * (w.sampled_duration / w.frame_duration)
    return round(beat), (round(doppler) + w.num_chirps // 2) % w.num_chirps


def _reception(
    cube: IFCube,
    settings: Receivers,
    detections: Detections,
    reference: Estimate | None,
    found: Sensed | None,
    symbols: Symbols | None,
    maps: bool,
) -> Reception:
    w = cube.waveform
    picture = None
    if maps:
        power = found.power if found else np.zeros((w.num_delay_symbols, w.num_chirps))
        picture = make_maps(power, cube, settings, 1)
    out = Reception.undecoded(w, detections, picture, found.sparse if found else None)
    if reference is not None:
        out = replace(out, line_of_sight=True, reference_power=_power(reference))
    if symbols is None:
        return out
    return replace(
        out,
        decoded=True,
        delay_symbols=symbols.delay,
        transitions=symbols.transitions,
        bits=symbols.bits,
        delay_confidence=symbols.delay_confidence,
        transition_confidence=symbols.transition_confidence,
        raw_delay_symbols=symbols.raw,
        soft_bits=symbols.soft_bits,
        confidence_looks=symbols.looks,
    )
