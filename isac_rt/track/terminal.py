"""One terminal from frame to frame: receive, track, predict. Samples and public knowledge in, never
the truth.

A terminal knows its own pose, the waveform, the antennas and their schedule, the transmit power,
which frames carry data, and, at the active terminal, its own payload. It consists of a receiver, a
tracker and a list of rules for tracks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload
from isac_rt.frame.waveform import Waveform
from isac_rt.plain import Stateful
from isac_rt.receive.active import ActiveReceiver
from isac_rt.receive.chain import excised
from isac_rt.receive.passive import PassiveReceiver
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import (
    NO_HINTS,
    Correction,
    ExpectedClutter,
    Hints,
    Prediction,
    Reception,
)
from isac_rt.track.filter import Ambiguity
from isac_rt.track.parts import (
    Equipment,
    Late,
    Ownship,
    ReportedUav,
    delayed,
    follow,
    is_placed,
    of_itself,
)
from isac_rt.track.reference import Reference, TerminalState
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Tracker, TrackSet, in_plane
from isac_rt.world.swarm import Pose


@runtime_checkable
class Receiver(Protocol):
    """Anything with `receive`: what `ActiveTerminal.receive` or `PassiveTerminal.receive` is given
    in, a `Reception` out."""

    def receive(self, cube: Any, /, *known: Any) -> Reception:
        """Return what is made of one frame's samples."""
        ...


@dataclass
class OwnErrors:
    """Estimate from clutter so far of an active terminal's own velocity and level errors."""

    correction: Correction | None = None


def _reception(made: Reception) -> Reception:
    """Return what a receiver made of a frame.

    Raises
    ------
    TypeError  If a custom receiver returned anything but a `Reception`.
    """
    if not isinstance(made, Reception):
        raise TypeError(
            f"receive returned {type(made).__name__}, not a Reception; return the one that "
            "isac_rt.receive.types.Reception describes"
        )
    return made


class ActiveTerminal(Stateful):
    """The AT: senses with its own echoes and tracks what it finds.

    Parameters
    ----------
    waveform, antennas, receivers, tracking : with `tracking.initiation` unexplained the rules are
        those of `isac_rt.extensions.city_receivers.standard`, which needs a city
    equipment : rules for its tracks, and what else it has

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
    >>> len(set(tracks.detection)) == len(reception.detections)
    True
    """

    def __init__(
        self,
        waveform: Waveform,
        antennas: Antennas,
        receivers: Receivers,
        tracking: Tracking,
        equipment: Equipment | None = None,
    ) -> None:
        self.equipment = equipment or Equipment()
        if tracking.initiation == "unexplained" and not self.equipment.rules:
            raise ValueError(
                "tracking.initiation unexplained needs rules, as those of a city's walls"
            )
        self._receiver = ActiveReceiver.of(antennas, receivers)
        self.tracker = Tracker(tracking, Ambiguity.of(waveform, 2))
        self.state = OwnErrors()

    @property
    def parts(self) -> Mapping[str, Stateful | None]:
        return {**self.equipment.parts, "tracker": self.tracker}

    def step(
        self,
        cube: IFCube,
        payload: Payload,
        own_pose: Pose,
        time: float,
        *,
        clutter: ExpectedClutter | None = None,
        reported_poses: Sequence[Pose] = (),
        reports: Sequence[ReportedUav] = (),
        maps: bool = False,
    ) -> tuple[Reception, TrackSet]:
        """Receive and track one frame.

        Parameters
        ----------
        time : of its middle [s]
        clutter : what the terminal expects of its mesh there
        reported_poses : poses that other terminals report, for its calibration
        reports : UAVs that others report
        """
        cube = excised(cube, self._receiver.settings)
        cube = self.equipment.hardware.correct(cube, time)
        before = self.state.correction
        if clutter is not None and before is not None:
            clutter = before.apply(clutter)
        self.tracker.predict(time)
        own = Ownship(own_pose, time, reported_poses, reports)
        reception = _reception(self.receive(cube, payload, clutter, maps))
        if reception.correction is not None:
            before = before or Correction(0.0, np.zeros(3))
            self.state.correction = before.then(reception.correction)
        follow(self.tracker, self.equipment.rules, in_plane(reception.detections), own)
        tracks = self.tracker.snapshot(own_pose)
        self.equipment.hardware.learn_from(reception, own, self.tracker, None)
        return reception, tracks

    def receive(
        self, cube: IFCube, payload: Payload, clutter: ExpectedClutter | None, maps: bool
    ) -> Reception:
        """Return what the terminal makes of one frame's samples; custom receivers replace it."""
        return self._receiver.receive(cube, payload, Hints(clutter), maps=maps)


class PassiveTerminal(Stateful):
    """A PT: acquires from unmodulated frames, decodes and senses, says when it loses the line of
    sight, and comes back.

    Parameters
    ----------
    waveform, antennas, receivers, tracking : as of `ActiveTerminal`
    transmit_amplitude : sqrt(transmit power of one antenna) [sqrt(W)], public
    groups : that carry data for it, None for all (see `receive_passive`)
    equipment : rules for its tracks, and what else it has

    Attributes
    ----------
    reference : the line of sight to the active terminal
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
        equipment: Equipment | None = None,
    ) -> None:
        self._receiver = PassiveReceiver.of(antennas, receivers, dpsk_order, groups)
        self.tracker = Tracker(tracking, Ambiguity.of(waveform, 1))
        self.equipment = equipment or Equipment()
        self.reference = Reference(waveform, antennas, tracking, transmit_amplitude, groups)
        self._hints = NO_HINTS

    @property
    def parts(self) -> Mapping[str, Stateful | None]:
        return {**self.equipment.parts, "tracker": self.tracker, "reference": self.reference}

    @property
    def late(self) -> tuple[Late, ...]:
        """Earlier frames that the last step made readable."""
        return self.equipment.other_paths.late

    @property
    def status(self) -> TerminalState:
        """Return the status of the link."""
        return self.reference.state.status

    def step(
        self,
        cube: IFCube,
        own_pose: Pose,
        time: float,
        modulated: bool,
        *,
        reported_poses: Sequence[Pose] = (),
        sender: Pose | None = None,
        reports: Sequence[ReportedUav] = (),
        maps: bool = False,
    ) -> tuple[Reception, TrackSet]:
        """Receive and track one frame.

        Parameters
        ----------
        time : of its middle [s]
        modulated : whether it carries data, which is public
        reported_poses : pose that the transmitter reports, for the terminal's calibration
        sender : pose that its data report, which counts once a frame was read
        reports : UAVs that others report
        """
        cube = excised(cube, self._receiver.settings)
        cube = self.equipment.hardware.correct(cube, time)
        self.reference.predict(time)
        self.tracker.predict(time)
        own = self._own(Ownship(own_pose, time, reported_poses, reports), sender)
        self._hints = Hints(own.clutter)
        self._hand_over(own)
        reception = self._read(cube, own, modulated, maps)
        refused = reception.line_of_sight and not self.reference.is_plausible(
            reception, own.straight
        )
        if refused:
            reception = reception.without_reference()
        reception, anchored = self.equipment.other_paths.read_frame(
            cube, reception, own, self.reference, refused=refused, anchored=not modulated, maps=maps
        )
        if modulated:
            self.reference.state.read = reception.is_read
        self.reference.update(reception, own_pose, self.tracker, anchored)
        self._track(reception, own)
        tracks = self._snapshot(own_pose)
        self.equipment.hardware.learn_from(reception, own, self.tracker, self.reference.track)
        return reception, tracks

    def _own(self, own: Ownship, sender: Pose | None) -> Ownship:
        """Return what is known of a frame with where the transmitter is, and with the clutter that
        the mesh returns of it from there."""
        over_other_path = sender is not None and self.equipment.other_paths.is_reading
        own = replace(own, over_other_path=over_other_path, clock=self.equipment.hardware.clock)
        if sender is not None and (self.reference.state.read or over_other_path):
            own = replace(own, sender=self.reference.reported(of_itself(sender)))
        expect_clutter = self.equipment.expect_clutter
        if expect_clutter is None:
            return own
        known = own.sender or self.reference.track
        if known is None or not is_placed(known.state, self.reference.cells[1]):
            return replace(own, clutter_known=False)
        clutter = expect_clutter(known.state.mean[:6], own.pose)
        delay, rate = own.clock
        clutter = replace(
            clutter, delay=clutter.delay + delay, delay_rate=clutter.delay_rate + rate
        )
        return replace(own, clutter=clutter)

    def _hand_over(self, own: Ownship) -> None:
        """Go on over the reference as over another path where it is not as long as the straight one
        from where the transmitter reports to be."""
        if self.reference.track is not None and own.sender is not None:
            path = self.tracker.to_prediction(own.pose, self.reference.track)
            if not self.reference.is_near(path.range[0], own.straight):
                self.equipment.other_paths.take_over(path, own)
                self.reference.forget(self.tracker)

    def _snapshot(self, own: Pose) -> TrackSet:
        """Return the tracks, relative to the transmitter as it is tracked, else as it reported."""
        track = self.reference.track
        tracks = self.tracker.snapshot(own, track or self.reference.state.report)
        return tracks if track is not None else tracks.select(~tracks.is_reference)

    def _read(self, cube: IFCube, own: Ownship, modulated: bool, maps: bool) -> Reception:
        """Receive a frame; where symbols outside the alphabet show a slip, move the reference by
        whole cells and receive it again."""
        order = self._receiver.reader.order
        expected = self.reference.prediction(self.tracker, own.pose) if modulated else None
        reception = self._receive(cube, expected, own, modulated, maps)
        cells = self.reference.slip(reception, order) if reception.decoded else 0
        track = self.reference.track
        if cells == 0 or track is None:
            return reception
        before = track.state
        self.reference.lengthen(cells, own.pose)
        expected = self.reference.prediction(self.tracker, own.pose)
        again = reception
        if expected is not None:
            again = self._receive(cube, expected, own, True, maps)
        if not again.decoded:
            track.state = before
            return reception
        return again

    def _receive(
        self, cube: IFCube, expected: Prediction | None, own: Ownship, modulated: bool, maps: bool
    ) -> Reception:
        """`receive` between clocks that are set alike."""
        late = None if expected is None else delayed(expected, own.clock)
        reception = _reception(self.receive(cube, late, modulated, maps))
        return replace(reception, detections=delayed(reception.detections, own.clock, -1))

    def _track(self, reception: Reception, own: Ownship) -> None:
        """Carry on the reflectors' tracks and start new ones, where the frame shows the transmitter
        or its data say where it is."""
        if reception.line_of_sight:
            los = self.reference.track
        else:
            los = own.sender if own.over_other_path and reception.decoded else None
        if los is not None and reception.placed:
            own = replace(own, reference=los)
            follow(self.tracker, self.equipment.rules, in_plane(reception.detections), own)

    def shorten(self, cells: int, own_pose: Pose) -> None:
        """Take whole cells off the reference's range, as the active terminal's answer to feedback
        says."""
        self.reference.lengthen(-cells, own_pose)

    def receive(
        self, cube: IFCube, prediction: Prediction | None, modulated: bool, maps: bool
    ) -> Reception:
        """Return what the terminal makes of one frame's samples; custom receivers replace it."""
        return self._receiver.receive(cube, prediction, modulated, self._hints, maps=maps)
