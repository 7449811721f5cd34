"""J-SPEDD: a passive terminal decodes the data and senses with the same frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.chain import Refiner, excised, passive_detector_of, reader_of, refiner_of
from isac_rt.receive.directions import search_of
from isac_rt.receive.estimate import Estimate
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.joint.neighbours import separate
from isac_rt.receive.joint.tones import JointPath
from isac_rt.receive.known import Known
from isac_rt.receive.sense import Cfar, Sensed, describe, make_maps, measure_channels
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import cleaned
from isac_rt.receive.symbols import (
    ByPowers,
    CarrierPhases,
    Symbols,
    confidence_threshold,
    decide_phases,
    moves_as_predicted,
    symbol_cells,
    transition_error_rate,
    velocity_spread,
)
from isac_rt.receive.types import (
    NO_HINTS,
    Detections,
    Hints,
    PathChannels,
    Prediction,
    Reception,
    no_detections,
)

REFERENCE_SPAN_DB = 20.0
"""The line of sight arrives first; what precedes the strongest path by more is a sidelobe or
noise."""
GATE_CELLS, GATE_BINS = 1, 4
"""Range rows and Doppler bins searched on each side of the predicted cell: the fraction of a row is
known, the whole row is the prediction's."""

MOST_WRONG = 1.0
"""Transitions of a frame that may be expected wrong where its samples are fitted all the same: a
chain that turns in its middle looks like several paths."""

SAME_PATH = 0.3, 0.15
"""Detections are of one path within so many cells of range and velocity and so many resolutions of
direction."""

SAME_PHASE = 1e-3
"""Phases that are decided once more are those before, if they differ by no more: rounding."""


@dataclass(frozen=True)
class PassiveReceiver:
    """A passive terminal's chain: symbol reader, data out, CFAR with its estimator, refiner.

    Attributes
    ----------
    groups : that carry data for this terminal, None for all (see `receive_passive`)
    """

    antennas: Antennas
    settings: Receivers
    reader: ByPowers
    detector: Cfar
    refiner: Refiner | None
    groups: Sequence[int] | None = None

    @classmethod
    def of(
        cls,
        antennas: Antennas,
        settings: Receivers,
        dpsk_order: int,
        groups: Sequence[int] | None = None,
    ) -> PassiveReceiver:
        """The chain that the settings name."""
        reader, refiner = reader_of(settings, dpsk_order), refiner_of(settings)
        return cls(antennas, settings, reader, passive_detector_of(settings), refiner, groups)

    def receive(
        self,
        cube: IFCube,
        prediction: Prediction | None,
        modulated: bool,
        hints: Hints = NO_HINTS,
        *,
        maps: bool = False,
    ) -> Reception:
        """See `receive_passive`."""
        if self.groups is not None and modulated:
            part, every = cube.of_groups(self.groups), replace(self, groups=None)
            mine = every.receive(part, prediction, True, hints, maps=maps)
            return _among_all(mine, self.groups, cube.waveform)
        w = cube.waveform
        if not modulated:
            pilot = Known.unmodulated(w, cube.schedule, self.antennas, 1)
            spectra, known = cleaned(cube, pilot)
            moments = Moments(cube.samples, known)
            sensed = self.detector.sense(spectra, known, hints)
            detections, reference = self._earliest(sensed, known)
            sensed = replace(
                sensed, path_channels=self._measure_channels(spectra, known, detections, reference)
            )
            detections, reference = self._alone(moments, detections, reference)
            return self._reception(cube, moments, sensed, detections, reference, maps=maps)
        symbols = None if prediction is None else self._read(cube, prediction)
        if prediction is None or symbols is None:
            power = np.zeros((w.num_range_cells, w.num_chirps))
            kept_maps = make_maps(power, cube, self.settings, 1) if maps else None
            return Reception.undecoded(w, no_detections(), kept_maps)
        read = Known(w, cube.schedule, symbols.raw, symbols.phases, self.antennas, 1)
        spectra, known = cleaned(cube, read)
        moments = Moments(cube.samples, known)
        sensed, detections, reference = self._sense_data(spectra, moments, prediction, hints)
        decided = None
        if self.refiner is not None and reference is not None:
            decided = self._phases(moments, detections)
        if decided is not None:
            phasor = decided.phases.conj() * known.phases
            if np.abs(phasor - 1).max() > SAME_PHASE:
                spectra = spectra * phasor.astype(np.complex64)[:, None, None]
                moments = moments.read_by(replace(known, phases=decided.phases))
                sensed, detections, reference = self._sense_data(
                    spectra, moments, prediction, hints
                )
        else:
            spread = velocity_spread(symbols, self.reader.order, prediction, w)
            detections = detections.widened(np.array([0.0, spread, 0.0, 0.0]))
        chain = self
        wrong = transition_error_rate(symbols, self.reader.order) * symbols.transitions.size
        if decided is None and wrong > MOST_WRONG:
            chain = replace(self, refiner=None)
        reception = chain._reception(cube, moments, sensed, detections, reference, maps=maps)
        return reception if reference is None else self._decoded(reception, symbols, w)

    def receive_over(
        self,
        cube: IFCube,
        path: Prediction,
        hints: Hints = NO_HINTS,
        *,
        maps: bool = False,
    ) -> Reception:
        """A data frame read over any `path`, row 0: once its data are out it is as one without, and
        its reference the earliest detection. Otherwise as `receive`."""
        if self.groups is not None:
            part, every = cube.of_groups(self.groups), replace(self, groups=None)
            mine = every.receive_over(part, path, hints, maps=maps)
            return _among_all(mine, self.groups, cube.waveform)
        w = cube.waveform
        symbols = self._read(cube, path)
        if symbols is None:
            return Reception.undecoded(w, no_detections())
        read = Known(w, cube.schedule, symbols.raw, symbols.phases, self.antennas, 1)
        spectra, known = cleaned(cube, read)
        moments = Moments(cube.samples, known)
        sensed = self.detector.sense(spectra, known, hints)
        detections, reference = self._alone(moments, *self._earliest(sensed, known))
        spread = velocity_spread(symbols, self.reader.order, path, w)
        detections = detections.widened(np.array([0.0, spread, 0.0, 0.0]))
        reception = self._reception(cube, moments, sensed, detections, reference, maps=maps)
        return self._decoded(reception, symbols, w)

    def of_symbols(self, symbols: Symbols, read: Waveform, waveform: Waveform) -> Reception | None:
        """Return the reception of symbols that were read by a waveform of this receiver's groups;
        None where they are not believed."""
        if not self._believed(symbols, read):
            return None
        out = self._decoded(Reception.undecoded(read, no_detections()), symbols, read)
        return out if self.groups is None else _among_all(out, self.groups, waveform)

    def _read(self, cube: IFCube, prediction: Prediction) -> Symbols | None:
        """Decide the symbols by all predicted paths and, where these are not believed or fail the
        check, by the reference alone; None: neither is believed."""
        failed = None
        for paths in (prediction, prediction.reference)[: prediction.range.size]:
            symbols = self.reader.read(cube, paths, self.antennas)
            if self._believed(symbols, cube.waveform):
                symbols = self._decided_again(cube, symbols, paths)
                if symbols.is_intact(cube.waveform, self.reader.order):
                    return symbols
                failed = failed or symbols
        return failed

    def _decided_again(self, cube: IFCube, symbols: Symbols, path: Prediction) -> Symbols:
        """Decide the phases once more, against one carrier over the frame, where the check sum of
        those decided from chirp to chirp fails; kept if it holds then."""
        w, order = cube.waveform, self.reader.order
        if symbols.is_intact(w, order):
            return symbols
        known = Known(w, cube.schedule, symbols.raw, symbols.phases, self.antennas, 1)
        decided = self._phases(Moments(cube.samples, known), path)
        return symbols.with_phases(decided, known, order)

    def _decoded(self, reception: Reception, symbols: Symbols, waveform: Waveform) -> Reception:
        """A reception with the symbols that were read."""
        return replace(
            reception,
            decoded=True,
            intact=symbols.is_intact(waveform, self.reader.order),
            delay_symbols=symbols.delay,
            transitions=symbols.transitions,
            bits=symbols.bits,
            delay_confidence=symbols.delay_confidence,
            transition_confidence=symbols.transition_confidence,
            raw_delay_symbols=symbols.raw,
            confidence_looks=symbols.looks,
        )

    def _phases(self, moments: Moments, paths: Detections | Prediction) -> CarrierPhases | None:
        """The phases as the reference, row 0 of the paths, shows them over the whole frame."""
        if not np.isfinite(paths.direction[0]).all():
            return None
        first = paths
        delay, rate = first.range[0] / SPEED_OF_LIGHT, first.velocity[0] / SPEED_OF_LIGHT
        path = JointPath(delay, rate, first.direction[0], np.ones(1), np.zeros(4))
        return decide_phases(moments, path, self.reader.order)

    def _believed(self, symbols: Symbols, waveform: Waveform) -> bool:
        """Return whether the decisions look neither like noise nor like a path with another
        velocity."""
        least = confidence_threshold(symbols.looks, symbol_cells(waveform).size, symbols.raw.size)
        confident = np.median(symbols.delay_confidence) >= least
        return bool(confident) and moves_as_predicted(symbols, self.reader.order)

    def _sense_data(
        self,
        spectra: np.ndarray,
        moments: Moments,
        prediction: Prediction,
        hints: Hints,
    ) -> tuple[Sensed, Detections, Estimate | None]:
        """Sense in a frame whose symbols are removed, with the reference put first."""
        known = moments.known
        sensed = self.detector.sense(spectra, known, hints)
        detections, reference = self._at_prediction(spectra, known, sensed, prediction)
        sensed = replace(
            sensed, path_channels=self._measure_channels(spectra, known, detections, reference)
        )
        return sensed, *self._alone(moments, detections, reference)

    def _measure_channels(
        self,
        spectra: np.ndarray,
        known: Known,
        detections: Detections,
        reference: Estimate | None,
    ) -> tuple[PathChannels, ...]:
        """Return the channels as the reference shows them, where that is asked for."""
        if reference is None or self.settings.self_calibration == "none":
            return ()
        return measure_channels(
            spectra, known, [reference], detections.snr[detections.is_reference]
        )

    def _alone(
        self, moments: Moments, detections: Detections, reference: Estimate | None
    ) -> tuple[Detections, Estimate | None]:
        """The reference told apart from another path in its cell, where one wave does not explain
        it, and the other one among the detections."""
        if reference is None or not self.settings.separate_reference:
            return detections, reference
        first = detections.select(detections.is_reference)
        separated = None if first.starts[0] else separate(moments, first)
        if separated is None:
            return detections, reference
        both, power = separated
        line = float(power[both.is_reference][0])
        channels = reference.channels * np.sqrt(line / _power(reference))
        clear = detections.select(_off(detections, both, moments.known) & ~detections.is_reference)
        return Detections.joined([both, clear]), replace(reference, channels=channels)

    def _earliest(self, sensed: Sensed, known: Known) -> tuple[Detections, Estimate | None]:
        """Mark the earliest detection within REFERENCE_SPAN_DB of the strongest, if it is sure: the
        false-alarm rate is asked of the whole map here and not of one cell, or an empty pilot would
        now and then be acquired."""
        d, rule = sensed.detections, self.detector.rule(known)
        sure = d.snr > replace(rule, rate=rule.rate / sensed.power.size).threshold
        power = np.array([_power(e) for e in sensed.estimates])
        sure &= power >= 10 ** (-REFERENCE_SPAN_DB / 10) * power.max(initial=0.0)
        if not sure.any():
            return d, None
        first = np.flatnonzero(sure)[np.argmin(d.range[sure])]
        return replace(d, is_reference=np.arange(len(d)) == first), sensed.estimates[first]

    def _at_prediction(
        self, spectra: np.ndarray, known: Known, sensed: Sensed, prediction: Prediction
    ) -> tuple[Detections, Estimate | None]:
        """The reference within the gate, put first with its own estimate, and the other detections
        beside it."""
        w, power = known.waveform, sensed.power
        row, column = predicted_cell(prediction, w)
        if not 0 <= row < len(power):
            return no_detections(), None
        rows = np.arange(max(row - GATE_CELLS, 0), min(row + GATE_CELLS + 1, len(power)))
        columns = (np.arange(-GATE_BINS, GATE_BINS + 1) + column) % w.num_chirps
        gate = power[np.ix_(rows, columns)]
        i, j = np.unravel_index(gate.argmax(), gate.shape)
        row, column = rows[i], columns[j]
        snr = power[row, column] / sensed.level[row, column]
        if not snr > self.detector.rule(known).factors(len(power))[row]:
            return no_detections(), None
        estimate = self.detector.estimates(
            spectra, known, power, rows[i : i + 1], columns[j : j + 1]
        )[0]
        on_grid = self.detector.estimator.on_grid
        reference = describe([estimate], np.array([snr]), known, on_grid=on_grid)
        d = sensed.detections
        first = replace(reference, is_reference=np.ones(1, bool))
        return Detections.joined([first, d.select(_off(d, reference, known))]), estimate

    def _reception(
        self,
        cube: IFCube,
        moments: Moments,
        sensed: Sensed,
        detections: Detections,
        reference: Estimate | None,
        *,
        maps: bool,
    ) -> Reception:
        """Return the refined detections, without the symbols."""
        kept_maps = make_maps(sensed.power, cube, self.settings, 1) if maps else None
        out = Reception.undecoded(cube.waveform, detections, kept_maps, sensed.sparse)
        if reference is not None:
            level = _power(reference)
            out = replace(
                out, line_of_sight=True, reference_power=level, path_channels=sensed.path_channels
            )
        if self.refiner is None:
            return out
        detections, power = self.refiner(moments, detections)
        mine = power[detections.is_reference]
        fitted = mine.size and np.isfinite(mine[0])
        return replace(
            out,
            detections=detections,
            reference_power=float(mine[0]) if fitted else out.reference_power,
        )


def receive_passive(
    cube: IFCube,
    antennas: Antennas,
    settings: Receivers,
    dpsk_order: int,
    prediction: Prediction | None,
    modulated: bool,
    *,
    groups: Sequence[int] | None = None,
    maps: bool = False,
) -> Reception:
    """Data symbols, bits and detections of one frame.

    Parameters
    ----------
    cube : IFCube
    antennas : of both ends
    settings : Receivers
    dpsk_order : D
    prediction : row 0 is the line of sight; None when nothing is tracked. Unmodulated frames need
        none
    modulated : whether the frame carries data (public)
    groups : that carry data for this terminal, None for all. It decodes these, and senses with
        these alone while there are data: what the others carry it does not know
    maps : also return pictures

    Returns
    -------
    Reception; in an unmodulated frame the reference is the earliest detection within 20 dB of the
    strongest. Without a prediction a modulated frame cannot be read: nothing is detected. When the
    decisions look like noise or like a path that moves otherwise, or nothing is found where the
    reference is expected, `line_of_sight` is False and all symbols are erased.

    Examples
    --------
    An unmodulated frame with a line of sight of 10 m; its data frames are read with a prediction:

    >>> from isac_rt.frame.schedule import conventional_schedule
    >>> w = Waveform(num_samples=64, num_chirps=24)
    >>> antennas = Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5 * w.wavelength)
    >>> t = w.chirp_time[:, :, None] + w.fast_time - w.frame_duration / 2
    >>> samples = np.exp(2j * np.pi * w.phase(0 * t + 10 / 299792458, w.fast_time))[:, None]
    >>> cube = IFCube(
    ...     samples=samples.repeat(3, axis=1).astype(np.complex64),
    ...     waveform=w,
    ...     schedule=conventional_schedule(3, 24, 3),
    ...     start_time=0.0,
    ... )
    >>> receive_passive(cube, antennas, Receivers(), 8, None, modulated=False)
    <Reception 1 detections, line of sight, no data decoded>
    """
    chain = PassiveReceiver.of(antennas, settings, dpsk_order, groups)
    return chain.receive(excised(cube, settings), prediction, modulated, maps=maps)


def _off(detections: Detections, paths: Detections, known: Known) -> np.ndarray:
    """(Q,) which detections are of none of some paths (`SAME_PATH`)."""
    w, d, beam = known.waveform, detections, search_of(known.antennas, known.wavenumber, 1).beam
    cell, resolution = SAME_PATH
    is_far = np.abs(d.range[:, None] - paths.range) / w.range_cell(1) > cell
    is_far |= np.abs(d.velocity[:, None] - paths.velocity) / w.velocity_cell(1) > cell
    turned = np.abs(np.nan_to_num(d.direction)[:, None] - np.nan_to_num(paths.direction))
    is_far |= (turned > resolution * beam).any(axis=2)
    return is_far.all(axis=1)


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


def _power(estimate: Estimate) -> float:
    """Mean power of a path per sample and receive antenna [W]."""
    return float((np.abs(estimate.channels) ** 2).mean())


def predicted_cell(prediction: Prediction, waveform: Waveform) -> tuple[int, int]:
    """Row and centred Doppler column where the reference is expected."""
    w = waveform
    doppler = prediction.velocity[0] / w.velocity_cell(1)
    beat = prediction.range[0] / w.range_cell(1) + doppler * (w.sampled_duration / w.frame_duration)
    return round(beat), (round(doppler) + w.num_chirps // 2) % w.num_chirps
