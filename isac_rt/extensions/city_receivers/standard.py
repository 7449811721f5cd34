"""Terminals as the settings ask for them, with all rules and parts that the package has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from isac_rt.extensions.city_receivers.ghosts import Ghosts, Leeway
from isac_rt.extensions.city_receivers.images import Images
from isac_rt.extensions.city_receivers.known_paths import LearnedHardware
from isac_rt.extensions.city_receivers.out_of_sequence import OutOfSequence
from isac_rt.extensions.city_receivers.static_clutter import StaticClutter
from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.passive import PassiveReceiver
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import ExpectedClutter
from isac_rt.scenario.presets import ReceiverSet
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import Setup
from isac_rt.track.parts import (
    Equipment,
    HardwareModel,
    OtherPaths,
    TrackRule,
)
from isac_rt.track.settings import Tracking
from isac_rt.track.terminal import ActiveTerminal, PassiveTerminal
from isac_rt.world.swarm import Pose


@dataclass(frozen=True)
class Surroundings:
    """Knowledge of a passive terminal about the city.

    Attributes
    ----------
    walls : the mesh against which track initiation is tested; None: any detection may start one
    clutter : what the terminal expects of the mesh, from the state (6,) of its transmitter as its
        data say, or as it is tracked, and its own pose, both in world coordinates; None: nothing
    """

    walls: Walls | None = None
    clutter: Callable[[np.ndarray, Pose], ExpectedClutter] | None = None


def active_terminal(
    waveform: Waveform,
    antennas: Antennas,
    receivers: Receivers,
    tracking: Tracking,
    walls: Walls | None = None,
) -> ActiveTerminal:
    """Return an active terminal; `walls`, the city's mesh, are needed where tracks start only from
    what the mesh does not explain (`tracking.initiation`)."""
    equipment = _active_equipment(waveform, antennas, receivers, tracking, walls)
    return ActiveTerminal(waveform, antennas, receivers, tracking, equipment)


def passive_terminal(
    waveform: Waveform,
    antennas: Antennas,
    receivers: Receivers,
    tracking: Tracking,
    dpsk_order: int,
    transmit_amplitude: float,
    groups: Sequence[int] | None = None,
    surroundings: Surroundings | None = None,
) -> PassiveTerminal:
    """Return a passive terminal (`PassiveTerminal`) with what it knows of its surroundings."""
    known = waveform, antennas, receivers, tracking
    knows = surroundings or Surroundings()
    equipment = _passive_equipment(*known, dpsk_order, groups, knows)
    return PassiveTerminal(*known, dpsk_order, transmit_amplitude, groups, equipment)


def equipment_of(setup: Setup, link: Link, s: ReceiverSet | Scenario) -> Equipment:
    """Return what the terminal of a link has besides its receiver and its tracker."""
    walls = setup.walls if s.tracking.needs_mesh else None
    known = setup.waveform, setup.arrays.at(link), s.receivers, s.tracking
    if link.own:
        return _active_equipment(*known, walls)
    clutter = None
    if s.receivers.passive_detector == "beams" and setup.expectation is not None:
        between, amplitude = setup.expectation.between, setup.plan.amplitudes[link.tx]
        clutter = partial(between, link, amplitude)
    order, groups = setup.scenario.modulation.dpsk_order, setup.timetable.groups(link)
    return _passive_equipment(*known, order, groups, Surroundings(walls, clutter))


def _active_equipment(
    waveform: Waveform,
    antennas: Antennas,
    receivers: Receivers,
    tracking: Tracking,
    walls: Walls | None,
) -> Equipment:
    rules: list[TrackRule] = []
    if tracking.initiation == "unexplained":
        if walls is None:
            raise ValueError("tracking.initiation unexplained needs the walls of a city")
        rules += _rules_of_walls(walls, antennas, waveform, 2)
    return Equipment(rules, _hardware(receivers, waveform, antennas, 2))


def _passive_equipment(
    waveform: Waveform,
    antennas: Antennas,
    receivers: Receivers,
    tracking: Tracking,
    dpsk_order: int,
    groups: Sequence[int] | None,
    surroundings: Surroundings,
) -> Equipment:
    walls, clutter = surroundings.walls, surroundings.clutter
    rules: list[TrackRule] = []
    if tracking.initiation == "unexplained" and walls is not None:
        rules += _rules_of_walls(walls, antennas, waveform, 1)
    other_paths = OtherPaths()
    if receivers.link_acquisition == "blind":
        receiver = PassiveReceiver.of(antennas, receivers, dpsk_order, groups)
        other_paths = OutOfSequence(receiver, waveform, walls)
    hardware = _hardware(receivers, waveform, antennas, 1)
    return Equipment(rules, hardware, other_paths, expect_clutter=clutter)


def _rules_of_walls(
    walls: Walls, antennas: Antennas, waveform: Waveform, passes: int
) -> list[TrackRule]:
    """Return the rules of `tracking.initiation: unexplained`."""
    return [
        Images(walls, antennas, waveform, passes),
        Ghosts(walls, Leeway.of(waveform, antennas, passes)),
        StaticClutter.of(antennas, waveform, passes, walls),
    ]


def _hardware(
    receivers: Receivers, waveform: Waveform, antennas: Antennas, passes: int
) -> HardwareModel:
    if receivers.self_calibration == "none":
        return HardwareModel()
    return LearnedHardware(waveform, antennas, passes)
