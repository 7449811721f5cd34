"""The reference of a passive terminal: the tracked line of sight to its transmitter, whose range
must be known to a fraction of a cell for data to be read.

Frames without data find it anew and anchor it. While data flow, a range that is whole cells off
shows by symbols outside the alphabet, and is repaired.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from scipy.special import gammainccinv

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import demodulate_bits, passes_check
from isac_rt.frame.waveform import Waveform
from isac_rt.plain import Stateful
from isac_rt.receive.symbols import EXTRA_CELLS
from isac_rt.receive.types import Detections, Prediction, Reception
from isac_rt.track.filter import (
    Ambiguity,
    Gaussian,
    expected,
    initiate_all,
    measurement_covariance,
    predict,
    update,
    wrapped,
)
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Track, Tracker, in_plane
from isac_rt.world.swarm import Pose

LEVEL_DROP = 10.0
"""A reference this factor in power under what free space gives at its range is a reflection. Off
boresight both ends lose some 4 dB at most inside the field of view; a mirror reflection off a wall
loses more than the rest, scattering far more."""
EVIDENCE_FRAMES = 12
"""Frames for which a symbol outside the alphabet is remembered."""
SLIP_FALSE_RATE = 1e-6
"""Chance that noise alone makes one chirp's decision confident enough to count as evidence of a
slip."""
BELIEVED_CELLS = (0.15, 0.3)
"""A reference off its prediction by more cells of range or of velocity than these, and four
deviations, is not believed: a second path in the same cell pulls the estimate, and the track, if it
followed, would soon misread the symbols. It coasts instead."""
MOST_CELLS = 0.4
"""However uncertain the prediction, a reference farther off in range is not believed: two equal
paths a cell apart are found in their middle."""
ANCHOR_CELLS = 0.75
"""A pilot off by more than this has found another cell: the track starts anew from it."""
PATIENCE = 25
"""After so many frames of disbelief in a row the next pilot is right and the track wrong."""
REFERENCE_STD_CELLS = 0.02
"""Floor of the reference's range and velocity deviations in cells, for what other paths near it
leave."""
COAST_CELLS = 0.2
"""A prediction whose range is known worse than this many cells cannot read the fraction of a
cell."""
PLACE_CELLS = 3.0
"""A reference whose length is farther than this from where the transmitter reports to be [cells] is
another path: two paths in the cell of the line of sight pull it by one, clocks by less."""


class TerminalState(IntEnum):
    """State of a terminal's link."""

    ACQUIRING = 0  # nothing known yet
    TRACKING = 1  # its reference path is in sight
    LOST = 2  # it had a reference and does not see it now


@dataclass
class Followed:
    """State that is carried over of a reference.

    Attributes
    ----------
    track : of the transmitter; None before acquisition
    time : that it was predicted to last [s]
    status : of the link
    read : whether the last data frame was read
    ends : symbols at and beyond the alphabet's ends, by frame, the newest last
    report : the transmitter as its data reported it last; None: they never did
    """

    track: Track | None = None
    time: float = -np.inf
    status: TerminalState = TerminalState.ACQUIRING
    read: bool = False
    ends: list[np.ndarray] = field(default_factory=list)
    report: Track | None = None


class Reference(Stateful):
    """The line of sight of a passive terminal, from frame to frame.

    Parameters
    ----------
    transmit_amplitude : sqrt(transmit power of one antenna) [sqrt(W)], public
    groups : that carry data for the terminal; None: all
    """

    def __init__(
        self,
        waveform: Waveform,
        antennas: Antennas,
        tracking: Tracking,
        transmit_amplitude: float,
        groups: Sequence[int] | None,
    ) -> None:
        self.state = Followed()
        self._waveform, self._groups = waveform, groups
        self._ambiguity = Ambiguity.of(waveform, 1)
        self._acceleration_std = tracking.acceleration_std_mps2
        self._level = (transmit_amplitude * antennas.gain * waveform.wavelength / (4 * np.pi)) ** 2
        self.cells = np.array([waveform.range_cell(1), waveform.velocity_cell(1)])

    @property
    def track(self) -> Track | None:
        """Track of the transmitter; None before acquisition."""
        return self.state.track

    def predict(self, time: float) -> None:
        """Bring the track to a time [s]."""
        for track in (self.track, self.state.report):
            if track is not None:
                interval = time - self.state.time
                track.state = predict(track.state, interval, self._acceleration_std)
                track.age += 1
                track.detection = -1
        self.state.time = time

    def reported(self, state: Gaussian) -> Track:
        """Return the transmitter as its data report it (6,), as a track."""
        self.state.report = Track.of_state(state, self._acceleration_std, self.state.time)
        return self.state.report

    def forget(self, tracker: Tracker) -> None:
        """End the track, and the others that rested on it: it was another path's."""
        if self.track is not None:
            self.state.track, self.state.ends = None, []
            tracker.clear()

    def prediction(self, tracker: Tracker, own: Pose) -> Prediction | None:
        """Return what is expected of a data frame; None when the range is no longer known well
        enough to read a fraction of a cell."""
        if self.track is None:
            return None
        prediction = tracker.to_prediction(own, self.track)
        return prediction if prediction.range_std[0] < COAST_CELLS * self.cells[0] else None

    def is_plausible(self, reception: Reception, straight: float | None) -> bool:
        """Return whether the reference found is as strong as a line of sight of its length, as
        transmit power and antennas are public, and no longer or shorter than the straight one."""
        d = reception.detections
        length = d.range[d.is_reference][0]
        strong = reception.reference_power * length**2 >= self._level / LEVEL_DROP
        return bool(strong) and self.is_near(length, straight)

    def is_near(self, length: float, straight: float | None) -> bool:
        """Return whether a path is as long [m] as the `straight` one, or that is unknown."""
        return straight is None or bool(abs(length - straight) <= PLACE_CELLS * self.cells[0])

    def update(self, reception: Reception, own: Pose, tracker: Tracker, anchored: bool) -> None:
        """Update the track by a frame, or restart it, and say where the terminal stands. A frame
        that is `anchored` found its reference without the track."""
        if not reception.line_of_sight:
            if self.track is not None:
                self.track.missed += 1
                self.state.status = TerminalState.LOST
            return
        d = in_plane(reception.detections)
        q = int(np.flatnonzero(d.is_reference)[0])
        z = d.measured[q]
        std = np.maximum(d.std[q], REFERENCE_STD_CELLS * np.array([*self.cells, 0.0, 0.0]))
        off = self._disbelief(z, own)
        track = self.track
        if track is None or (anchored and (off > ANCHOR_CELLS or track.missed > PATIENCE)):
            self._restart(d, q, std, own, tracker)
        elif off > 0:
            track.missed += 1
        else:
            R = measurement_covariance(std, track.state.mean)
            track.state = update(track.state, z, R, own, ambiguity=self._ambiguity)
            track.snr, track.missed, track.detection = float(d.snr[q]), 0, q
        if self.track is not None:
            self.state.status = TerminalState.TRACKING

    def _restart(self, d: Detections, q: int, std: np.ndarray, own: Pose, tracker: Tracker) -> None:
        """Start the track from detection `q`; the other tracks rested on the old one."""
        acceleration_std = self._acceleration_std
        states = initiate_all(d.measured[[q]], std[None], own, acceleration_std=acceleration_std)[1]
        if len(states.mean):
            state = Gaussian(states.mean[0], states.covariance[0])
            number, snr = tracker.new_id(), float(d.snr[q])
            self.state.track = Track(number, state, snr, confirmed=True, detection=q)
            self.state.ends = []
            tracker.clear()

    def _disbelief(self, z: np.ndarray, own: Pose) -> float:
        """Return 0 where a reference lies where the track has it, else how many cells of range it
        is off."""
        if self.track is None:
            return 0.0
        mean, S = expected(*self.track.state, own)
        residual = np.abs(wrapped(z - mean, self._ambiguity))[:2]
        allowed = np.array(BELIEVED_CELLS) * self.cells + 4 * np.sqrt(np.diag(S)[:2])
        allowed[0] = min(allowed[0], MOST_CELLS * self.cells[0])
        return float(residual[0] / self.cells[0]) if (residual > allowed).any() else 0.0

    def slip(self, reception: Reception, order: int) -> int:
        """Return by how many whole cells the true range exceeds the track's, as symbols outside the
        alphabet show; 0 as long as they do not, or the frame's check sum holds.

        With the range k cells too long every symbol is read k too low: the symbols 0..k-1 fall
        below the alphabet, and none is read in its last k places. A frame of M P chirps holds k M P
        / (N/2) of the former on average (0.7 k for the paper's numbers); two are asked for, over at
        most `EVIDENCE_FRAMES` frames, and none of the latter, which a second path in the cell would
        leave there. One will do if the check sum holds for the symbols moved.
        """
        if reception.intact:
            self.state.ends = []
            return 0
        new = end_symbols(reception, self._groups, self._waveform)
        self.state.ends = [*self.state.ends, new][-EVIDENCE_FRAMES:]
        if self.track is None:
            return 0
        ends, last = np.concatenate(self.state.ends), self._waveform.num_delay_symbols - 1
        cells = slip_cells(ends, last + 1)
        if cells or not ((ends < 0) | (ends > last)).any():
            return cells
        tried = sorted(range(-EXTRA_CELLS, EXTRA_CELLS + 1), key=abs)
        return next((k for k in tried if self._holds(reception, k, order)), 0)

    def _holds(self, reception: Reception, cells: int, order: int) -> bool:
        """Return whether a frame's check sum holds for delay symbols `cells` lower."""
        groups = list(range(self._waveform.num_groups) if self._groups is None else self._groups)
        w, raw = self._waveform.of_groups(groups), reception.raw_delay_symbols - cells
        if raw.min() < 0 or raw.max() >= w.num_delay_symbols:
            return False
        return passes_check(demodulate_bits(raw, reception.transitions[groups], w, order), w, order)

    def lengthen(self, cells: int, own: Pose) -> None:
        """Push the track along the line of sight by whole cells; what is known of slips is over."""
        if self.track is not None:
            mean = self.track.state.mean.copy()
            span = mean[:3] - own.position
            mean[:3] += span / np.linalg.norm(span) * (cells * self.cells[0])
            self.track.state = Gaussian(mean, self.track.state.covariance)
            self.state.ends = []


def end_symbols(
    reception: Reception, groups: Sequence[int] | None, waveform: Waveform
) -> np.ndarray:
    """Return the confident raw symbols of a frame near and beyond either end of the alphabet."""
    confidence = (
        reception.delay_confidence if groups is None else reception.delay_confidence[list(groups)]
    )
    raw, last = reception.raw_delay_symbols, waveform.num_delay_symbols - 1
    searched = waveform.num_delay_symbols + 2 * EXTRA_CELLS
    looks = reception.confidence_looks
    sure = confidence > gammainccinv(looks, SLIP_FALSE_RATE / searched) / looks
    return raw[sure & ((raw < EXTRA_CELLS) | (raw > last - EXTRA_CELLS))]


def slip_cells(ends: np.ndarray, num_symbols: int) -> int:
    """Return the whole cells by which the true range exceeds the predicted one, from confident raw
    symbols at the alphabet's ends.

    0 without two symbols outside at one end, or with one where such a slip leaves none.
    """
    last = num_symbols - 1
    low, high = int((ends < 0).sum()), int((ends > last).sum())
    if low >= 2 and not (ends > last + ends.min()).any():
        return int(ends.min())
    if high >= 2 and not (ends < ends.max() - last).any():
        return int(ends.max()) - last
    return 0
