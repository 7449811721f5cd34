"""One terminal from frame to frame: receive, track, predict. Samples and public knowledge in, never
the truth.

A terminal knows its own pose, the waveform, the antennas and their schedule, the transmit power,
which frames carry data, and, at the active terminal, its own payload.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.special import gammainccinv

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, RangeProfiles
from isac_rt.frame.payload import Payload
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.plain import plain, restored
from isac_rt.receive.active import ActiveReceiver
from isac_rt.receive.passive import PassiveReceiver
from isac_rt.receive.settings import Receivers
from isac_rt.receive.symbols.powers import EXTRA_CELLS
from isac_rt.receive.types import (
    Correction,
    Detections,
    ExpectedClutter,
    Gates,
    Hints,
    Prediction,
    Reception,
)
from isac_rt.track.filter import (
    Ambiguity,
    Gaussian,
    birth,
    expected,
    measure,
    measurement_covariance,
    predict,
    reported,
    update,
    wrapped,
)
from isac_rt.track.fusion import KnownBody, of_itself
from isac_rt.track.ghosts import Walls
from isac_rt.track.images import WELL_INSIDE, Doubts, sender_images
from isac_rt.track.retrospect import COAST_CELLS, Late, Retrospect
from isac_rt.track.self_calibration import calibration_of
from isac_rt.track.settings import Tracking
from isac_rt.track.sights import echoes, lines_of_sight, seen_after
from isac_rt.track.standing import Standing, rests
from isac_rt.track.tracker import Track, Tracker, TrackSet, in_plane
from isac_rt.world.swarm import Pose

LEVEL_DROP = 10.0
"""A reference this factor in power under what free space gives at its range is a reflection. Off
boresight both ends lose some 4 dB at most inside the field of view; a mirror reflection off a wall
loses more than the rest, scattering far more."""
EVIDENCE_FRAMES = 12
"""How long a symbol outside the alphabet is remembered."""
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
MOTION_BINS = 1.0
"""Doppler bins to which the transmitter's motion must be known before the mesh explains clutter."""
PATIENCE = 25
"""So many frames of disbelief in a row, and the next pilot is right and the track wrong."""
NAMED_CELLS = 1.5
"""Cells of length and of its rate within which a path is one that the city explains."""
WORD_FRAMES = 5
"""A passive terminal that is told of others' tracks confirms none of its own before so many frames
after the first. It cannot see what flies near its line of sight, but hears its echoes over walls.
The active terminal sees such a body a frame later at worst, confirms it in the third frame, and its
word takes two more."""
REFERENCE_STD_CELLS = 0.02
"""Floor of the reference's range and velocity deviations in cells, for what other paths beside it
leave."""


class TerminalState(IntEnum):
    """What a terminal says of its link."""

    ACQUIRING = 0  # nothing known yet
    TRACKING = 1  # its reference path is in sight
    LOST = 2  # it had a reference and does not see it now


@runtime_checkable
class Receiver(Protocol):
    """Anything with `receive`: what `ActiveTerminal.receive` or `PassiveTerminal.receive` is given
    in, a `Reception` out."""

    def receive(self, cube: Any, /, *known: Any) -> Reception:
        """What is made of one frame's samples."""
        ...


class ActiveTerminal:
    """The AT: senses with its own echoes and tracks what it finds.

    `walls`, the city's mesh, are needed where tracks start only from what the mesh does not explain
    (`tracking.births`).

    Examples
    --------
    >>> import isac_rt as irt
    >>> scenario = irt.load("scenes/paper_swarm_consistent.yaml")
    >>> setup = irt.prepare(scenario)
    >>> frame, link = setup.frame(0), ("AT", "AT")
    >>> cube, sent = frame.samples(link), frame.sent["AT"]
    >>> terminal = irt.ActiveTerminal(
    ...     setup.waveform, setup.antennas, scenario.receivers, scenario.tracking
    ... )
    >>> reception, tracks = terminal.step(
    ...     cube, sent.payload, sent.pose, time=frame.paths[link].epoch
    ... )
    >>> len(tracks) == len(reception.detections)
    True
    """

    def __init__(
        self,
        waveform: Waveform,
        antennas: Antennas,
        receivers: Receivers,
        tracking: Tracking,
        walls: Walls | None = None,
    ) -> None:
        self._receiver = ActiveReceiver.of(antennas, receivers)
        self.other: Receiver | None = None
        self.tracker = Tracker(tracking, Ambiguity.of(waveform, 2))
        self._doubts = None
        if tracking.births == "unexplained":
            if walls is None:
                raise ValueError("tracking.births unexplained needs the walls of a city")
            self._doubts = Doubts(walls, antennas, waveform)
        self.calibration = calibration_of(receivers, waveform, antennas, 2)
        self._standing = Standing.of(antennas, waveform, 2, walls)
        self._correction: Correction | None = None
        self._gates: Gates | None = None

    def step(
        self,
        cube: IFCube | RangeProfiles,
        payload: Payload,
        own_pose: Pose,
        time: float,
        *,
        clutter: ExpectedClutter | None = None,
        mates: Sequence[Pose] = (),
        told: Sequence[KnownBody] = (),
        maps: bool = False,
    ) -> tuple[Reception, TrackSet]:
        """Receive and track one frame; `time` is its middle [s], `clutter` what the terminal
        expects of its mesh there, `mates` where other terminals are by what its calibration is
        told, `told` the bodies that it knows of from them."""
        if self.calibration is not None and isinstance(cube, IFCube):
            cube = self.calibration.correct(cube, time)
        if clutter is not None and self._correction is not None:
            clutter = self._correction.apply(clutter)
        self.tracker.predict(time)
        self._gates = self._sought(own_pose, told)
        reception = self.receive(cube, payload, clutter, maps)
        if reception.correction is not None:
            before = self._correction or Correction(0.0, np.zeros(3))
            self._correction = before.then(reception.correction)
        found = in_plane(reception.detections)
        if self._doubts is None:
            self.tracker.update(found, own_pose)
        else:
            new = {track.id for track in self.tracker.tracks if not track.confirmed}
            found = self._doubts.births(found, own_pose)
            crowd = self._standing.look(found, own_pose, time, self.tracker.ambiguity.period)
            found = replace(found, starts=found.starts & ~crowd)
            self.tracker.update(found, own_pose)
            self._doubts.remove_ghosts(self.tracker, new, own_pose, None, [b.state for b in told])
            self._standing.prune(self.tracker, new, crowd)
        tracks = self.tracker.snapshot(own_pose)
        if self.calibration is not None:
            seen = echoes(reception.looks, self.calibration.waveform, own_pose, mates, tracks)
            change = self.calibration.learn_all(seen, reception.neighbours)
            for track in self.tracker.tracks:
                track.state = seen_after(track.state, own_pose, change, 2)
        return reception, tracks

    def receive(
        self,
        cube: IFCube | RangeProfiles,
        payload: Payload,
        clutter: ExpectedClutter | None,
        maps: bool,
    ) -> Reception:
        """What the terminal makes of one frame's samples; a custom receiver replaces this, or is
        `other`, which is given the same."""
        if self.other is not None:
            return self.other.receive(cube, payload, clutter, maps)
        return self._receiver.receive(cube, payload, Hints(clutter, self._gates), maps=maps)

    def _sought(self, own: Pose, told: Sequence[KnownBody]) -> Gates | None:
        """Where tracks that move, and other terminals by their word, are expected; None: that is
        not asked for. What stands still may be a wall that the mesh lacks, whose clutter nothing
        whitens."""
        if self._receiver.settings.gate_false_alarm_rate is None:
            return None
        error = of_itself(own).covariance
        mates = [
            Track.of_body(Gaussian(body.state.mean, body.state.covariance + error)).state
            for body in told
            if body.terminal
        ]
        moving = [t.state for t in self.tracker.tracks if not rests(t)]
        return Gates(*reported(moving + mates, own))

    def memory(self) -> dict[str, Any]:
        """What is carried over to the next frame as plain numbers and arrays, for `restore`."""
        found = self._correction
        return {
            "tracker": self.tracker.memory(),
            "correction": None if found is None else [found.level, found.velocity],
            "standing": self._standing.memory(),
            "calibration": None if self.calibration is None else self.calibration.memory(),
        }

    def restore(self, memory: dict[str, Any]) -> None:
        """Go on from a `memory`."""
        self.tracker.restore(memory["tracker"])
        self._standing.restore(memory["standing"])
        if self.calibration is not None:
            self.calibration.restore(memory["calibration"])
        found = memory["correction"]
        self._correction = None if found is None else Correction(*found)


@dataclass(frozen=True)
class Surroundings:
    """What a passive terminal knows of the city.

    Attributes
    ----------
    walls : the mesh, against which births are held; None: all are allowed
    clutter : what the terminal expects of the mesh, from the state (6,) of its transmitter as its
        data say, or as it is tracked, and its own pose, both in world coordinates; None: nothing
    """

    walls: Walls | None = None
    clutter: Callable[[np.ndarray, Pose], ExpectedClutter] | None = None


class PassiveTerminal:
    """A PT: acquires from unmodulated frames, decodes and senses, says when it loses the line of
    sight, and comes back.

    `groups` carry data for it, None for all (see `receive_passive`); `surroundings` are what it
    knows of the city.

    Attributes
    ----------
    state : TerminalState
    reference : the track of the active terminal, None before acquisition
    slips_repaired : times that the range of the reference was moved by whole cells while data
        flowed
    """

    def __init__(
        self,
        waveform: Waveform,
        antennas: Antennas,
        receivers: Receivers,
        tracking: Tracking,
        dpsk_order: int,
        transmit_amplitude: float,
        groups: Sequence[int] | None = None,
        surroundings: Surroundings | None = None,
    ) -> None:
        self._receiver = PassiveReceiver.of(antennas, receivers, dpsk_order, groups)
        self.other: Receiver | None = None
        self._groups, self._waveform = groups, waveform
        self._acceleration = tracking.acceleration_std_mps2
        self._ambiguity = Ambiguity.of(waveform, 1)
        self._cells = np.array([waveform.range_cell(1), waveform.velocity_cell(1)])
        self._time = -np.inf
        self._level = (transmit_amplitude * antennas.gain * waveform.wavelength / (4 * np.pi)) ** 2
        self._surroundings = surroundings or Surroundings()
        self._doubts = None
        if tracking.births == "unexplained" and self._surroundings.walls is not None:
            self._doubts = Doubts(self._surroundings.walls, antennas, waveform, passes=1)
        self._standing = Standing.of(antennas, waveform, 1, self._surroundings.walls)
        self.tracker = Tracker(tracking, self._ambiguity)
        self.state = TerminalState.ACQUIRING
        self.reference: Track | None = None
        self.slips_repaired = 0
        self.calibration = calibration_of(receivers, waveform, antennas, 1)
        self._ends: deque[np.ndarray] = deque(maxlen=EVIDENCE_FRAMES)
        self._clutter: ExpectedClutter | None = None
        self._teller: Track | None = None
        self._word: Track | None = None
        self._read = self._awaits_word = False
        self._retrospect: Retrospect | None = None
        if receivers.link_acquisition == "blind":
            self._retrospect = Retrospect(self._receiver, waveform)

    @property
    def late(self) -> tuple[Late, ...]:
        """Earlier frames that the last step made readable."""
        return () if self._retrospect is None else self._retrospect.late

    def step(
        self,
        cube: IFCube,
        own_pose: Pose,
        time: float,
        modulated: bool,
        *,
        mates: Sequence[Pose] = (),
        sender: Pose | None = None,
        told: Sequence[KnownBody] = (),
        maps: bool = False,
    ) -> tuple[Reception, TrackSet]:
        """Receive and track one frame; `time` is its middle [s], `modulated` is public, `mates` is
        where the transmitter says that it is, `sender` where its data do, which count once a frame
        was read, `told` the bodies that the terminal knows of from others."""
        if self.calibration is not None:
            cube = self.calibration.correct(cube, time)
        if self.reference is not None:
            self.reference.state = predict(
                self.reference.state, time - self._time, self._acceleration
            )
            self.reference.age += 1
            self.reference.detection = -1
        self._time = time
        self.tracker.predict(time)
        self._word = self._teller = None
        self._awaits_word = sender is not None
        if sender is not None:
            word = Track.of_body(of_itself(sender), self._acceleration, self._time)
            over_another = self._retrospect is not None and self._retrospect.state.path is not None
            self._word = word if self._read or over_another else None
            self._teller = word if over_another else None
        self._clutter = self._expected_clutter(own_pose)
        reception = self._hear(cube, self._expect(own_pose) if modulated else None, modulated, maps)
        if reception.decoded:
            reception = self._repair_slip(cube, reception, own_pose, maps)
        refused = reception.line_of_sight and not self._plausible(reception)
        if refused:
            reception = reception.without_reference()
        anchored = not modulated
        if self._retrospect is not None:
            reception, anchored = self._look_back(
                self._retrospect,
                cube,
                reception,
                own_pose,
                refused=refused,
                anchored=anchored,
                maps=maps,
            )
        if modulated:
            self._read = reception.decoded
        self._follow(reception, own_pose, anchored)
        sight = self.reference if reception.line_of_sight else self._teller
        seen = reception.line_of_sight or reception.decoded
        if sight is not None and seen and reception.placed:
            self._track(in_plane(reception.detections), own_pose, sight, told)
        tracks = self.tracker.snapshot(own_pose, self.reference)
        self._calibrate(reception, own_pose, mates)
        return reception, tracks

    def _calibrate(self, reception: Reception, own: Pose, mates: Sequence[Pose]) -> None:
        """Learn of the own hardware from the line of sight, if it was one."""
        if self.calibration is None or self.reference is None or self.reference.missed:
            return
        seen = lines_of_sight(reception.looks, own, mates, self.reference.state)
        change = self.calibration.learn_all(seen)
        self.reference.state = seen_after(self.reference.state, own, change, 1)
        for track in self.tracker.tracks:
            track.state = seen_after(track.state, own, change, 2)

    def _look_back(
        self,
        kept: Retrospect,
        cube: IFCube,
        reception: Reception,
        own: Pose,
        *,
        refused: bool,
        anchored: bool,
        maps: bool,
    ) -> tuple[Reception, bool]:
        """A data frame that the reference does not read, read over any path where one is known, and
        whether it shows the line of sight as a frame without data does (`anchored`)."""
        kept.late, time = (), self._time
        if anchored:
            kept.look(cube, time)
            if refused:
                kept.start(self._late(reception.detections, 1), time)
        if reception.line_of_sight:
            kept.forget()
        if anchored or reception.decoded:
            return reception, anchored
        out = kept.read(cube, time, Hints(self._clutter), maps=maps)
        if out is None:
            return reception, False
        out = replace(out, detections=self._late(out.detections, -1))
        if out.line_of_sight and self._plausible(out) and self._well_inside(out):
            kept.forget()
            return out, True
        return out.without_sight(self._named(kept, own)), False

    def _named(self, kept: Retrospect, own: Pose) -> bool:
        """Whether the path that is read over is as long, and changes as fast, as a way from the
        transmitter over the city's walls or about an edge."""
        walls = self._surroundings.walls
        if walls is None or self._teller is None or kept.state.path is None:
            return False
        there = self._teller.state.mean
        length = kept.state.path.mean[:2] - SPEED_OF_LIGHT * np.array(self._clock)
        straight = measure(there, own)[None, :2]
        ways = sender_images(there[:6], own, walls, float(length[0]) + 1)
        apart = np.abs(np.concatenate([straight, ways]) - length)
        return bool((apart < NAMED_CELLS * self._cells).all(axis=1).any())

    def _well_inside(self, reception: Reception) -> bool:
        """Whether the reference is not so near the edge of the view that it may have come from the
        opposite one: a track of it would fly elsewhere."""
        d = reception.detections
        edge = WELL_INSIDE * self._receiver.antennas.view_limit
        return bool((np.abs(d.direction[d.is_reference]) < edge).all())

    def _track(
        self, detections: Detections, own: Pose, reference: Track, told: Sequence[KnownBody]
    ) -> None:
        """Carry on the reflectors' tracks, and start those that the city does not explain."""
        sender = reference.state
        if self._doubts is None:
            self.tracker.update(detections, own, sender)
            return
        known, place = self._surroundings.clutter, (self._word or reference).state
        if known is not None and not self._placed(place):
            detections = replace(detections, starts=np.zeros(len(detections), bool))
        new = {track.id for track in self.tracker.tracks if not track.confirmed}
        allowed = self._doubts.births(detections, own, place.mean[:6])
        crowd = np.zeros(len(allowed), bool)
        if known is None or self._clutter is not None:  # else the city's own echoes are among them
            period = self._ambiguity.period
            crowd = self._standing.look(allowed, own, self._time, period, place.mean[:6])
        allowed = replace(allowed, starts=allowed.starts & ~crowd)
        self.tracker.update(allowed, own, sender)
        if self._awaits_word:
            for track in self.tracker.tracks:
                track.confirmed &= track.age >= WORD_FRAMES
        self._doubts.remove_ghosts(self.tracker, new, own, reference, [b.state for b in told])
        self._standing.prune(self.tracker, new, crowd)

    def _placed(self, sender: Gaussian) -> bool:
        """Whether the transmitter's motion is known to a Doppler bin: what is expected of the city
        before that explains nothing."""
        spread = np.linalg.eigvalsh(sender.covariance[3:6, 3:6])[-1]
        return bool(np.sqrt(spread) < MOTION_BINS * self._cells[1])

    def _expected_clutter(self, own: Pose) -> ExpectedClutter | None:
        """What the mesh returns of the transmitter where its data say that it is, else as it is
        tracked; None where neither is known."""
        known, sender = self._surroundings.clutter, self._word or self.reference
        if known is None or sender is None or not self._placed(sender.state):
            return None
        clutter = known(sender.state.mean[:6], own)
        delay, rate = self._clock
        return replace(clutter, delay=clutter.delay + delay, delay_rate=clutter.delay_rate + rate)

    def memory(self) -> dict[str, Any]:
        """What is carried over to the next frame as plain numbers and arrays, for `restore`."""
        return {
            "tracker": self.tracker.memory(),
            "time": self._time,
            "state": int(self.state),
            "reference": plain(self.reference),
            "slips_repaired": self.slips_repaired,
            "ends": list(self._ends),
            "read": self._read,
            "standing": self._standing.memory(),
            "calibration": None if self.calibration is None else self.calibration.memory(),
            "retrospect": None if self._retrospect is None else self._retrospect.memory(),
        }

    def restore(self, memory: dict[str, Any]) -> None:
        """Go on from a `memory`."""
        self.tracker.restore(memory["tracker"])
        self._standing.restore(memory["standing"])
        reference = memory["reference"]
        self.reference = restored(Track | None, reference)
        self._time, self.state = memory["time"], TerminalState(memory["state"])
        self.slips_repaired = memory["slips_repaired"]
        self._read = memory["read"]
        self._ends = deque(memory["ends"], maxlen=EVIDENCE_FRAMES)
        if self.calibration is not None:
            self.calibration.restore(memory["calibration"])
        if self._retrospect is not None:
            self._retrospect.restore(memory["retrospect"])

    def shorten(self, cells: int, own_pose: Pose) -> None:
        """Take whole cells off the reference's range, as the active terminal's answer to feedback
        says."""
        if self.reference is not None:
            self.reference.state = _moved(self.reference.state, own_pose, -cells * self._cells[0])
            self._ends.clear()

    def receive(
        self, cube: IFCube, prediction: Prediction | None, modulated: bool, maps: bool
    ) -> Reception:
        """What the terminal makes of one frame's samples; a custom receiver replaces this, or is
        `other`, which is given the same."""
        if self.other is not None:
            return self.other.receive(cube, prediction, modulated, maps)
        hints = Hints(self._clutter)
        return self._receiver.receive(cube, prediction, modulated, hints, maps=maps)

    @property
    def _clock(self) -> np.ndarray:
        """Delay [s] and rate by which all paths are heard late, as far as that is known."""
        return np.zeros(2) if self.calibration is None else self.calibration.state.clock

    def _late(self, what: Detections | Prediction, sign: int) -> Any:
        """What has been found or is expected, by so much later (1) or sooner (-1)."""
        metres, speed = sign * SPEED_OF_LIGHT * self._clock
        return replace(what, range=what.range + metres, velocity=what.velocity + speed)

    def _hear(
        self, cube: IFCube, prediction: Prediction | None, modulated: bool, maps: bool
    ) -> Reception:
        """`receive` between clocks that are set alike."""
        if self.calibration is None:
            return self.receive(cube, prediction, modulated, maps)
        heard = None if prediction is None else self._late(prediction, 1)
        reception = self.receive(cube, heard, modulated, maps)
        return replace(reception, detections=self._late(reception.detections, -1))

    def _expect(self, own: Pose) -> Prediction | None:
        """Prediction for a data frame; None when the range is no longer known well enough to read a
        fraction of a cell."""
        if self.reference is None:
            return None
        prediction = self.tracker.to_prediction(own, self.reference)
        return prediction if prediction.range_std[0] < COAST_CELLS * self._cells[0] else None

    def _plausible(self, reception: Reception) -> bool:
        """Whether the reference is as strong as a line of sight of its length: transmit power and
        antennas are public."""
        d = reception.detections
        scaled = reception.reference_power * d.range[d.is_reference][0] ** 2
        return bool(scaled >= self._level / LEVEL_DROP)

    def _follow(self, reception: Reception, own: Pose, anchored: bool) -> None:
        """Update or restart the reference track, and say where the terminal stands. A frame that is
        `anchored` found its reference without the track."""
        if not reception.line_of_sight:
            if self.reference is not None:
                self.reference.missed += 1
                self.state = TerminalState.LOST
            return
        d = in_plane(reception.detections)
        q = int(np.flatnonzero(d.is_reference)[0])
        z = np.array([d.range[q], d.velocity[q], *d.direction[q]])
        std = np.maximum(d.std[q], REFERENCE_STD_CELLS * np.array([*self._cells, 0.0, 0.0]))
        off = self._disbelief(z, own)
        if self.reference is None or (
            anchored and (off > ANCHOR_CELLS or self.reference.missed > PATIENCE)
        ):
            self._restart(d, q, std, own)
        elif off > 0:
            self.reference.missed += 1
        else:
            R = measurement_covariance(std, self.reference.state.mean)
            self.reference.state = update(
                self.reference.state, z, R, own, ambiguity=self._ambiguity
            )
            self.reference.snr, self.reference.missed = float(d.snr[q]), 0
            self.reference.detection = q
        if self.reference is not None:
            self.state = TerminalState.TRACKING

    def _restart(self, d: Detections, q: int, std: np.ndarray, own: Pose) -> None:
        """A reference track from detection `q`; the other tracks rested on the old one."""
        z = np.array([d.range[q], d.velocity[q], *d.direction[q]])
        state = birth(z, std, own, acceleration_std=self._acceleration)
        if state is not None:
            self.reference = Track(
                self.tracker.new_id(), state, float(d.snr[q]), confirmed=True, detection=q
            )
            self.tracker.clear()
            self._ends.clear()

    def _disbelief(self, z: np.ndarray, own: Pose) -> float:
        """0 where a reference lies where the track has it; else how many cells of range it is
        off."""
        if self.reference is None:
            return 0.0
        mean, S = expected(*self.reference.state, own)
        residual = np.abs(wrapped(z - mean, self._ambiguity))[:2]
        allowed = np.array(BELIEVED_CELLS) * self._cells + 4 * np.sqrt(np.diag(S)[:2])
        allowed[0] = min(allowed[0], MOST_CELLS * self._cells[0])
        return float(residual[0] / self._cells[0]) if (residual > allowed).any() else 0.0

    def _repair_slip(self, cube: IFCube, reception: Reception, own: Pose, maps: bool) -> Reception:
        """Move the reference by whole cells when symbols outside the alphabet show a slip, and read
        the frame again.

        With the range k cells too long every symbol is read k too low: the symbols 0..k-1 fall
        below the alphabet, and none is read in its last k places. A frame of M P chirps holds k M P
        / (N/2) of the former on average (0.7 k for the paper's numbers); two are asked for, over at
        most `EVIDENCE_FRAMES` frames, and none of the latter, which a second path in the cell would
        leave there.
        """
        self._ends.append(_end_symbols(reception, self._groups, self._waveform))
        cells = slip_cells(np.concatenate(self._ends), self._waveform.num_delay_symbols)
        if cells == 0 or self.reference is None:
            return reception
        before = self.reference.state
        self.reference.state = _moved(before, own, cells * self._cells[0])
        prediction = self._expect(own)
        again = self._hear(cube, prediction, True, maps) if prediction else reception
        self._ends.clear()
        if not again.decoded:
            self.reference.state = before
            return reception
        self.slips_repaired += 1
        return again


def _end_symbols(
    reception: Reception, groups: Sequence[int] | None, waveform: Waveform
) -> np.ndarray:
    """Confident raw symbols of a frame near and beyond either end of the alphabet."""
    confidence = (
        reception.delay_confidence if groups is None else reception.delay_confidence[list(groups)]
    )
    raw, last = reception.raw_delay_symbols, waveform.num_delay_symbols - 1
    searched = waveform.num_delay_symbols + 2 * EXTRA_CELLS
    looks = reception.confidence_looks
    sure = confidence > gammainccinv(looks, SLIP_FALSE_RATE / searched) / looks
    return raw[sure & ((raw < EXTRA_CELLS) | (raw > last - EXTRA_CELLS))]


def slip_cells(ends: np.ndarray, num_symbols: int) -> int:
    """Whole cells by which the true range exceeds the predicted one, from confident raw symbols at
    the alphabet's ends.

    0 without two symbols outside at one end, or with one where such a slip leaves none.
    """
    last = num_symbols - 1
    low, high = int((ends < 0).sum()), int((ends > last).sum())
    if low >= 2 and not (ends > last + ends.min()).any():
        return int(ends.min())
    if high >= 2 and not (ends < ends.max() - last).any():
        return int(ends.max()) - last
    return 0


def _moved(state: Gaussian, own: Pose, distance: float) -> Gaussian:
    """A state pushed along the line of sight."""
    span = state.mean[:3] - own.position
    mean = state.mean.copy()
    mean[:3] += span / np.linalg.norm(span) * distance
    return Gaussian(mean, state.covariance)
