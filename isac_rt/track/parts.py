"""Optional parts of a terminal besides its receiver and its tracker: rules for its tracks, a model
of its own hardware, and reading over other paths. Without any of them it detects and tracks.

The classes here do nothing; those that do are handed in (`isac_rt.registry.EXTENSIONS`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.plain import Stateful
from isac_rt.receive.types import Detections, ExpectedClutter, Prediction, Reception
from isac_rt.track.filter import Gaussian
from isac_rt.track.tracker import Track, Tracker
from isac_rt.world.swarm import Pose

if TYPE_CHECKING:
    from isac_rt.track.reference import Reference

POSE_STD = (0.05, 0.05)
"""Deviations of a terminal's own position and velocity on each axis, as satellites and inertial
sensors give them [m, m/s]. They are part of what it says of itself and of others."""
MOTION_CELLS = 1.0
"""Doppler cells to which the transmitter's motion must be known before the mesh explains
clutter."""
Measured = TypeVar("Measured", Detections, Prediction)


class ReportedUav(NamedTuple):
    """A UAV that a terminal knows of from others: its position and velocity (6,), and the terminal
    of the swarm that it is by its own report, "" if it is none."""

    terminal: str
    state: Gaussian


def of_itself(own: Pose) -> Gaussian:
    """Return what a terminal reports of its own position and velocity."""
    variance = np.repeat(np.square(POSE_STD), 3)
    return Gaussian(np.concatenate([own.position, own.velocity]), np.diag(variance))


@dataclass(frozen=True)
class Ownship:
    """Knowledge of a terminal about a frame besides its samples.

    Attributes
    ----------
    pose, time : its own pose, and the middle of the frame [s]
    reported_poses : poses that other terminals report, for the calibration of the own hardware
    reports : targets and terminals that others report
    sender : a passive terminal's transmitter as its data report it; None where they say nothing
        that counts
    over_other_path : whether data are read over another path than the line of sight
    clock : delay [s] and its rate by which all paths come late, as far as that is known
    clutter : what the terminal expects of its mesh; None: unknown
    clutter_known : whether the clutter that it wants to know of is known
    reference : the track, or the report, of the transmitter on which all other tracks rest; None
        at an active terminal
    tentative : numbers of the tracks that were not reported before this frame
    """

    pose: Pose
    time: float
    reported_poses: Sequence[Pose] = ()
    reports: Sequence[ReportedUav] = ()
    sender: Track | None = None
    over_other_path: bool = False
    clock: np.ndarray = field(default_factory=lambda: np.zeros(2))
    clutter: ExpectedClutter | None = None
    clutter_known: bool = True
    reference: Track | None = None
    tentative: frozenset[int] = frozenset()

    @property
    def transmitter(self) -> Gaussian | None:
        """The transmitter of a passive terminal where its data say that it is, else as it is
        tracked."""
        known = self.sender or self.reference
        return None if known is None else known.state

    @property
    def straight(self) -> float | None:
        """Distance to where the transmitter reports to be [m]; None: it does not."""
        if self.sender is None:
            return None
        return float(np.linalg.norm(self.sender.state.mean[:3] - self.pose.position))


class TrackRule(Stateful):
    """A rule that keeps false tracks out; by itself it allows all."""

    def candidates(self, detections: Detections, own: Ownship) -> Detections:
        """Return the detections, of which fewer may start a track."""
        return detections

    def prune(self, tracker: Tracker, own: Ownship) -> None:
        """Doubt tracks, end them, or take their confirmation back."""


def follow(tracker: Tracker, rules: Sequence[TrackRule], found: Detections, own: Ownship) -> None:
    """Update the tracks by what was `found` in a frame, and start and end them by the rules."""
    tentative = frozenset(t.id for t in tracker.tracks if not t.credible)
    own = replace(own, tentative=tentative)
    for rule in rules:
        found = rule.candidates(found, own)
    tracker.update(found, own.pose, None if own.reference is None else own.reference.state)
    for rule in rules:
        rule.prune(tracker, own)


def is_placed(sender: Gaussian, cell: float) -> bool:
    """Return whether a transmitter's motion is known to a Doppler `cell` [m/s]: what is expected of
    the city before that explains nothing."""
    spread = np.linalg.eigvalsh(sender.covariance[3:6, 3:6])[-1]
    return bool(np.sqrt(spread) < MOTION_CELLS * cell)


class HardwareModel(Stateful):
    """Knowledge of a terminal about its own hardware: by default that it is ideal."""

    @property
    def clock(self) -> np.ndarray:
        """Delay [s] and its rate by which all paths come late."""
        return np.zeros(2)

    def correct(self, cube: IFCube, time: float) -> IFCube:
        """Return the samples of a frame at a time [s] without the errors that are known."""
        return cube

    def learn_from(
        self, reception: Reception, own: Ownship, tracker: Tracker, reference: Track | None
    ) -> None:
        """Learn from a frame, and correct the tracks by what was learned."""


@dataclass(frozen=True)
class Late:
    """A frame that was read after others had come.

    Attributes
    ----------
    time : of its middle [s]
    reception : its symbols
    """

    time: float
    reception: Reception


class OtherPaths(Stateful):
    """Reading of data over other paths than the line of sight: by itself none is tried.

    Attributes
    ----------
    late : earlier frames that the last one made readable
    """

    late: tuple[Late, ...] = ()

    @property
    def is_reading(self) -> bool:
        """True if a path is known over which data are read."""
        return False

    def take_over(self, reference: Prediction, own: Ownship) -> None:
        """Go on over a reference that is no line of sight, row 0, from this frame on."""

    def read_frame(
        self,
        cube: IFCube,
        reception: Reception,
        own: Ownship,
        reference: Reference,
        *,
        refused: bool,
        anchored: bool,
        maps: bool,
    ) -> tuple[Reception, bool]:
        """Read a data frame that the reference does not read, over any path where one is known, or
        learn a path from a frame without data.

        Parameters
        ----------
        refused : whether the reference that was found is no line of sight
        anchored : whether the frame carries no data, and so shows paths without a prediction

        Returns
        -------
        reception : the same one, or what is read over another path
        anchored : also where data read over the path show that it is the line of sight
        """
        return reception, anchored


@dataclass(frozen=True)
class Equipment:
    """Parts of a terminal besides its receiver and its tracker; by default none.

    Attributes
    ----------
    rules : for its tracks, in their order
    hardware : what it learns of its own boards and clock
    other_paths : a passive terminal's reading of data over other paths than the line of sight
    expect_clutter : what the mesh returns of a passive terminal's transmitter in a state (6,) at
        its own pose, both in world coordinates; None: unknown
    """

    rules: Sequence[TrackRule] = ()
    hardware: HardwareModel = field(default_factory=HardwareModel)
    other_paths: OtherPaths = field(default_factory=OtherPaths)
    expect_clutter: Callable[[np.ndarray, Pose], ExpectedClutter] | None = None

    @property
    def parts(self) -> dict[str, Stateful]:
        """All that carries something over from frame to frame."""
        rules = {f"rule {i}": rule for i, rule in enumerate(self.rules)}
        return {**rules, "hardware": self.hardware, "other paths": self.other_paths}


def delayed(measured: Measured, clock: np.ndarray, sign: int = 1) -> Measured:
    """Return what was measured or is expected with all paths later (1) or sooner (-1) by a
    `clock`'s delay [s] and rate."""
    metres, speed = sign * SPEED_OF_LIGHT * clock
    return replace(measured, range=measured.range + metres, velocity=measured.velocity + speed)
