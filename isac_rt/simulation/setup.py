"""All that the frames of a run share, built once from the scenario."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from isac_rt.access import Connections, connect
from isac_rt.frame.antennas import Antennas, antennas_of
from isac_rt.frame.cube import IFCube, RangeProfiles, Transmission
from isac_rt.frame.level import (
    LinkBudget,
    link_budget,
    noise_power,
    noise_rise,
    thermal_noise_power,
    transmit_amplitude,
)
from isac_rt.frame.link import Link
from isac_rt.frame.schedule import Schedule, schedule_of
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import Waveform, waveform_of
from isac_rt.propagation import FreeSpace, PathSet, Propagation, make_propagation
from isac_rt.propagation.store import CachedPropagation, PathStore
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive.types import ExpectedClutter
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.if_signal import add_noise, if_signal, range_profiles
from isac_rt.simulation.content import path_content
from isac_rt.simulation.plan import Plan, Use
from isac_rt.simulation.preflight import check_flights, check_memory, check_reference
from isac_rt.terminal.expectation import ClutterExpectation, make_expectation
from isac_rt.world.area import city_of, flight_centre
from isac_rt.world.city import City
from isac_rt.world.swarm import Pose, Swarm


@dataclass(frozen=True)
class Setup:
    """What stays the same over a run."""

    scenario: Scenario
    waveform: Waveform
    antennas: Antennas
    schedule: Schedule
    swarm: Swarm
    city: City
    propagation: Propagation
    reference: FreeSpace
    """Closed forms of the reference paths, as they would be unshadowed and in view."""
    timetable: Timetable
    connections: Connections
    plan: Plan
    uses: dict[tuple[int, Link], Use] = field(default_factory=dict)
    """What the plan kept of the paths of each frame and link traced so far."""
    expectation: ClutterExpectation | None = None
    """What an active terminal's receiver predicts of its clutter from the mesh; None where its
    detector needs none."""

    def expected_clutter(self, frame: int) -> dict[str, ExpectedClutter]:
        """What each active terminal expects of its own link. Traces rays: from the thread that
        traces only."""
        if self.expectation is None:
            return {}
        amplitude, out = transmit_amplitude(self.scenario.noise), {}
        for name in self.timetable.with_role("active", frame):
            when = self.timetable.epoch(frame, name)
            out[name] = self.expectation.clutter(
                name, self.swarm.trajectories[name].pose(when), when, amplitude
            )
        return out

    def noise_power(self, poses: dict[str, Pose], link: Link) -> float:
        """E|n|^2 of a sample at the link's receiver [W], Gaussian clutter included."""
        rise = noise_rise(self.scenario.clutter)
        if self.scenario.noise.model == "link_budget":
            return rise * thermal_noise_power(self.scenario.noise, self.waveform)
        return rise * noise_power(
            self.scenario.noise, self.waveform, self.reference.reference_amplitude(poses, *link)
        )

    def trace(self, frame: int) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        """Poses and paths of a frame, interference between active terminals included; what the plan
        leaves out is not there."""
        poses, found = self.find(frame)
        thinned = {
            link: self.plan.apply(p, self.noise_power(poses, link)) for link, p in found.items()
        }
        self.uses.update({(frame, link): use for link, (_, use) in thinned.items()})
        return poses, {link: paths for link, (paths, _) in thinned.items()}

    def find(self, frame: int) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        """Poses and all paths of a frame, however weak."""
        epoch = self.timetable.epoch(frame)
        poses = self.swarm.poses(epoch)
        heard = self.timetable.links(frame)
        active, receivers = (
            self.timetable.with_role("active", frame),
            dict.fromkeys(rx for _, rx in heard),
        )
        return poses, self.propagation.paths(
            poses, epoch, [Link(tx, rx) for tx in active for rx in receivers]
        )

    def transmission(
        self, active: str, frame: int, pose: Pose, schedule: Schedule | None = None
    ) -> Transmission:
        """What an active terminal sends in a frame, by another `schedule` than the usual one if
        there is one."""
        return Transmission(
            name=active,
            pose=pose,
            antennas=self.antennas,
            schedule=self.schedule if schedule is None else schedule,
            payload=self.timetable.payload(active, frame, schedule),
            amplitude=transmit_amplitude(self.scenario.noise),
            first_block=self.timetable.first_block(active, frame),
        )

    def receive_samples(
        self,
        frame: int,
        link: Link,
        sent: dict[str, Transmission],
        paths: dict[Link, PathSet],
        poses: dict[str, Pose],
    ) -> IFCube:
        """IF samples of a link's receiver, dechirped in the resource blocks of the link's
        transmitter, with noise.

        `sent` holds every active terminal; what the others' chirps leave in these blocks is in the
        samples. They depend on nothing but the frame and the link.
        """
        arriving, level, words, frame_of = self._arriving(frame, link, sent, paths, poses)
        method = self.plan.synthesis(sum(len(p) for _, p in arriving))
        cube = if_signal(
            self.waveform,
            arriving,
            poses[link[1]],
            self.antennas,
            noise_power=level,
            method=method,
            max_error=self.plan.synthesis_error,
            costs=self.plan.costs,
            **frame_of,
        )
        return add_noise(cube, level, words)

    def receive_input(
        self,
        frame: int,
        link: Link,
        sent: dict[str, Transmission],
        paths: dict[Link, PathSet],
        poses: dict[str, Pose],
    ) -> IFCube | RangeProfiles:
        """What a link's receiver is given: samples, or with ``receivers.active_input: profiles`` at
        the active terminal range profiles."""
        if link[0] != link[1] or self.scenario.receivers.active_input == "samples":
            return self.receive_samples(frame, link, sent, paths, poses)
        arriving, level, words, frame_of = self._arriving(frame, link, sent, paths, poses)
        own = sent[link[0]].payload
        return range_profiles(
            self.waveform,
            arriving,
            poses[link[1]],
            self.antennas,
            own,
            noise_power=level,
            seed_words=words,
            **frame_of,
        )

    def _arriving(
        self,
        frame: int,
        link: Link,
        sent: dict[str, Transmission],
        paths: dict[Link, PathSet],
        poses: dict[str, Pose],
    ) -> tuple[list[tuple[Transmission, PathSet]], float, np.ndarray, dict[str, Any]]:
        """What reaches a link's receiver, its noise power and the noise's stream, and when and
        through what it listens."""
        tx, rx = link
        when = self.timetable.epoch(frame, tx)
        arriving = []
        for name in [tx, *(name for name in sent if name != tx)]:
            clock = self.connections.apart(name, link, when)
            arriving.append(
                (
                    replace(sent[name], clock_offset=clock.offset, clock_drift=clock.drift),
                    paths[name, rx],
                )
            )
        words = seed_sequence(self.scenario.seed, "noise", tx, rx, frame).generate_state(2)
        frame_of = {
            "start_time": self.timetable.start_time(frame, tx),
        }
        return arriving, self.noise_power(poses, link), words, frame_of


def link_budgets(setup: Setup) -> list[LinkBudget]:
    """The link budget of every link at the first frame."""
    poses = setup.swarm.poses(setup.timetable.epoch(0))
    rows = []
    for tx, rx in setup.timetable.links(0):
        if tx == rx and not setup.reference.has_target(tx):
            continue
        amplitude = setup.reference.reference_amplitude(poses, tx, rx)
        name = rx if tx != rx else setup.reference.strongest_target(poses, tx)
        distance = float(np.linalg.norm(poses[name].position - poses[tx].position))
        what = "line of sight" if tx != rx else f"echo of {name}"
        rows.append(
            link_budget(
                Link(tx, rx),
                what,
                distance,
                amplitude,
                setup.scenario.noise,
                setup.waveform,
                setup.antennas,
            )
        )
    return rows


def prepare(scenario: Scenario, store: PathStore | None = None) -> Setup:
    """Load and build everything that frames share. With a `store` traced paths are looked up there
    first and kept there."""
    waveform = waveform_of(scenario)
    antennas = antennas_of(scenario, waveform)
    swarm = Swarm.from_scenario(scenario)
    schedule = schedule_of(scenario, waveform, generator(scenario.seed, "schedule"))
    timetable = Timetable(scenario, waveform, schedule)
    check_memory(waveform, antennas, scenario, timetable)
    check_flights(scenario, swarm, timetable)
    check_reference(scenario, timetable)
    plan = Plan(scenario, waveform, antennas, timetable, swarm)
    city = city_of(scenario, plan.mesh_radius(flight_centre(scenario)))
    setup = Setup(
        scenario,
        waveform,
        antennas,
        schedule,
        swarm,
        city,
        _propagation(scenario, waveform, antennas, city, plan.instants, store),
        FreeSpace(scenario.swarm, antennas, waveform.wavelength, scenario.seed),
        timetable,
        Connections(),
        plan,
        expectation=make_expectation(scenario, waveform, antennas, city),
    )
    return _connected(setup)


def _connected(setup: Setup) -> Setup:
    """The same after the stages before the data, where the scenario has them."""

    def scene(when: float, links: list[Link]) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        poses = setup.swarm.poses(when)
        return poses, setup.propagation.paths(poses, when, links) if links else {}

    first = setup.swarm.poses(setup.timetable.epoch(0))
    found = connect(
        setup.scenario,
        setup.waveform,
        setup.antennas,
        setup.schedule,
        scene,
        lambda link: setup.noise_power(first, link),
    )
    timetable = replace(setup.timetable, blocks=found.blocks(), refused=found.refused())
    return replace(
        setup, timetable=timetable, connections=found, plan=replace(setup.plan, timetable=timetable)
    )


def _propagation(
    scenario: Scenario,
    waveform: Waveform,
    antennas: Antennas,
    city: City,
    instants: tuple[float, ...],
    store: PathStore | None,
) -> Propagation:
    def make() -> Propagation:
        return make_propagation(scenario, waveform, antennas, city, instants)

    if store is None or scenario.propagation.model == "free_space":
        return make()
    return CachedPropagation(make, store, json.dumps([path_content(scenario), city.num_faces]))


def trace(scenario: Scenario, frame: int, *, setup: Setup | None = None) -> dict[Link, PathSet]:
    """The paths of all links of one frame."""
    return (setup or prepare(scenario)).trace(frame)[1]
