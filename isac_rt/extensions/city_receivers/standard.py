"""Equipment of a terminal as the settings ask for it, with all rules and parts that the package
has."""

from __future__ import annotations

from functools import partial

from isac_rt.extensions.city_receivers.ghosts import Ghosts, Leeway
from isac_rt.extensions.city_receivers.images import Images
from isac_rt.extensions.city_receivers.out_of_sequence import OutOfSequence
from isac_rt.extensions.city_receivers.static_clutter import StaticClutter
from isac_rt.extensions.hardware.known_paths import LearnedHardware
from isac_rt.frame.link import Link
from isac_rt.receive.passive import PassiveReceiver
from isac_rt.scenario.presets import ReceiverSet
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import Setup
from isac_rt.track.parts import Equipment, HardwareModel, OtherPaths, TrackRule


def equipment_of(setup: Setup, link: Link, s: ReceiverSet | Scenario) -> Equipment:
    """Return what the terminal of a link has besides its receiver and its tracker."""
    waveform, antennas, passes = setup.waveform, setup.arrays.at(link), 2 if link.own else 1
    rules: list[TrackRule] = []
    walls = setup.walls if s.tracking.needs_mesh else None
    if walls is not None:
        rules = [
            Images(walls, antennas, waveform, passes),
            Ghosts(walls, Leeway.of(waveform, antennas, passes)),
            StaticClutter.of(antennas, waveform, passes, walls),
        ]
    learns = s.receivers.self_calibration != "none"
    hardware = LearnedHardware(waveform, antennas, passes) if learns else HardwareModel()
    if link.own:
        return Equipment(rules, hardware)
    other_paths = OtherPaths()
    if s.receivers.link_acquisition == "blind":
        order, groups = setup.scenario.modulation.dpsk_order, setup.timetable.groups(link)
        receiver = PassiveReceiver.of(antennas, s.receivers, order, groups)
        other_paths = OutOfSequence(receiver, waveform, walls)
    clutter = None
    if s.receivers.passive_detector == "beams" and setup.expectation is not None:
        amplitude = setup.plan.amplitudes[link.tx]
        clutter = partial(setup.expectation.between, link, amplitude)
    return Equipment(rules, hardware, other_paths, clutter)
