"""Parts of a run that all frames share, built once from the scenario."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from isac_rt.frame.antennas import Antennas, Arrays, antennas_of
from isac_rt.frame.clock import Clock
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference, Transmission
from isac_rt.frame.level import (
    LinkBudget,
    link_budget,
    noise_power,
    thermal_noise_power,
    transmit_amplitude,
)
from isac_rt.frame.link import Link
from isac_rt.frame.schedule import Schedule, codes_of, schedule_of
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import Waveform, waveform_of
from isac_rt.propagation.build import Ground, make_propagation
from isac_rt.propagation.clutter.merging import NoiseFloor
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Propagation, Traced
from isac_rt.propagation.pathset import PathSet
from isac_rt.propagation.store import CachedPropagation, PathStore
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive.types import ExpectedClutter
from isac_rt.registry import extension
from isac_rt.results.provenance import path_content
from isac_rt.results.records import Use
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.if_signal import noisy_if_signal
from isac_rt.signal.noise import WhiteNoise
from isac_rt.simulation.connections import Connections
from isac_rt.simulation.coverage import Coverage, coverage
from isac_rt.simulation.plan import Plan, decisions, extent, mechanisms
from isac_rt.simulation.preflight import (
    check_flights,
    check_memory,
    check_passage,
    check_reach,
    check_reference,
    warn_of_aliases,
    warn_of_interference,
    warn_of_other_chirps,
    warn_of_unseen,
)
from isac_rt.simulation.stopwatch import NONE, Seconds
from isac_rt.world.area import city_about, city_digest
from isac_rt.world.city import CityMesh
from isac_rt.world.city.materials import believed_materials
from isac_rt.world.swarm import Pose, Swarm

BY_BEAM = 10.0
"""Sensitivity gained by coherent integration over channels, a power ratio: 10 to 16 dB with 45."""


@dataclass(frozen=True)
class Frame:
    """One frame with its transmissions and paths, built by `Setup.frame`.

    Attributes
    ----------
    number : from 0
    poses : of every UAV at the middle of the frame
    paths : of each link from an active terminal to a receiver, with interference between active
        terminals, without the paths that the plan omits
    sent : by every active terminal
    expected : clutter of its monostatic link that each active terminal expects from the mesh, in
        frames that it processes; empty if no receiver uses it
    uses : selection of paths of each link by the plan
    dropped : traced paths rejected by the float64 geometry

    Examples
    --------
    The samples that PT1 receives from the AT:

    >>> import isac_rt as irt
    >>> scenario = irt.load("scenes/paper_swarm_consistent.yaml")
    >>> setup = irt.prepare(scenario)
    >>> frame = setup.frame(0)
    >>> frame.samples(("AT", "PT1")).samples.shape
    (3, 15, 120, 1024)
    >>> frame.paths["AT", "PT1"].counts()["line_of_sight"]
    1
    """

    number: int
    poses: dict[str, Pose]
    paths: Mapping[Link, PathSet]
    sent: Mapping[str, Transmission]
    expected: Mapping[str, ExpectedClutter]
    uses: Mapping[Link, Use]
    dropped: int
    _setup: Setup = field(repr=False)
    foreign: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """What arrives of emitters at each receiver
    (`isac_rt.extensions.street.emitters.Arrival`)."""
    _by_chirp: Mapping[str, Frame] = field(default_factory=dict, repr=False)
    """The frame as the radars of each chirp have it, by transmitter; empty where all share one."""

    def __repr__(self) -> str:
        return f"<Frame {self.number}: {', '.join(map(str, self.paths))}>"

    def sent_by(self, schedules: Mapping[str, Schedule]) -> Frame:
        """Return the frame with other antenna schedules of some active terminals."""
        s = self._setup
        sent = {
            name: s.transmission(name, self.number, self.poses[name], schedule)
            for name, schedule in schedules.items()
            if schedule is not self.sent[name].schedule
        }
        return replace(self, sent={**self.sent, **sent})

    def noise_power(self, link: tuple[str, str]) -> float:
        """E|n|^2 of a sample at a link's receiver [W], Gaussian clutter included."""
        frame, link = self._at(link)
        return frame._setup.noise_power(frame.poses, link)

    def _at(self, link: tuple[str, str]) -> tuple[Frame, Link]:
        """Return the frame as the radars of a link's chirp have it, and the link."""
        return self._by_chirp.get(link[0], self), Link(*link)

    def ends(self, link: tuple[str, str]) -> Any:
        """Return the hardware that affects the samples of a link's receiver
        (`isac_rt.extensions.hardware.front_end.Ends`)."""
        frame, link = self._at(link)
        all_of, sent = frame._setup.front_ends, frame.sent
        senders = dict.fromkeys([link.tx, *sent])
        front_ends = [all_of[name] for name in senders for _ in sent[name].streams()]
        return extension("front_ends")(all_of[link.rx], tuple(front_ends))

    def oscillator_noise_left_out(self, link: tuple[str, str]) -> float:
        """Return the oscillator noise within a chirp that `samples` omit, over the thermal
        noise."""
        frame, link = self._at(link)
        power, waveform = frame.noise_power(link), frame._setup.waveform
        left_out = extension("hardware_noise_left_out")
        return float(left_out(waveform, frame._arriving(link), frame.ends(link), power))

    def samples(self, link: tuple[str, str], ends: Any = None) -> IFCube:
        """Synthesise the IF samples of a link's receiver with noise, dechirped in the resource
        blocks of the link's transmitter; `ends`: other hardware than the terminals' own.

        They include the chirps of other active terminals in these blocks, and depend on frame and
        link alone."""
        frame, link = self._at(link)
        if frame is not self:
            return frame.samples(link, ends)
        s, arriving, noise = self._setup, self._arriving(link), self._noise(link)
        lasting = sum(len(self.paths[Link(sent.name, link.rx)]) for sent, _ in arriving)
        method = s.plan.synthesis(lasting, noise.power)
        received = self._listening(link)
        if link.rx in self.foreign:
            method = extension("with_foreign")(
                method, self.foreign[link.rx], *received, noise.power
            )
        if ends is None and not s.has_ideal_hardware:
            ends = self.ends(link)
        if ends is not None and not ends.ideal:
            make = extension("hardware_samples")
            cube: IFCube = make(s.waveform, arriving, *received, ends, method, noise)
            return cube
        return noisy_if_signal(s.waveform, arriving, *received, method, noise)

    def received(self, link: tuple[str, str]) -> IFCube:
        """Return the samples of a link's receiver with the board's calibration applied."""
        frame, link = self._at(link)
        return frame._setup.calibrated(frame.samples(link))

    def _arriving(self, link: Link) -> list[tuple[Transmission, PathSet]]:
        """Return the signals at a link's receiver, those of its transmitter first; antennas that
        send at once are separate signals."""
        if link not in self.paths:
            received = ", ".join(map(str, self.paths))
            raise ValueError(f"{link} is not received in frame {self.number}; there are {received}")
        s, when = self._setup, self._setup.timetable.epoch(self.number, link.tx)
        out: list[tuple[Transmission, PathSet]] = []
        for name in dict.fromkeys([link.tx, *self.sent]):
            clock = s.connections.clock_difference(name, link, when)
            paths = self.paths[Link(name, link.rx)]
            if s.moving_centres is not None or s.boxes is not None:
                paths = self._moving(paths, when, s.plan.weakest * self.noise_power(link))
            sent = replace(self.sent[name], clock_offset=clock.offset, clock_drift=clock.drift)
            out += [(stream, paths) for stream in sent.streams()]
        return out

    def parts(self, link: Link) -> PathSet:
        """Return a link's paths with those over the scattering centres of rigid targets in place of
        the targets' own."""
        paths, centres = self.paths[link], self._setup.moving_centres
        if centres is not None:
            rigid = [(name, model) for name, model in centres.models if not model.speed]
            centres = replace(centres, models=rigid, own={})
            paths = centres.with_centres(paths, self.poses, paths.epoch)
        return paths

    def _moving(self, paths: PathSet, when: float, least: float) -> PathSet:
        """Return the paths of a link with moving centres and shadows that change in the frame.

        Parameters
        ----------
        when : middle of the receiver's frame [s]
        least : power of a sample over all chirps below which neither matters [W]
        """
        s = self._setup
        least /= s.plan.cell_noise_gain(paths.tx) / s.waveform.num_chirps  # of one chirp
        shadows = None if s.boxes is None else s.boxes.shadows(paths, self.poses)
        if s.moving_centres is not None:
            shadow = None if shadows is None else shadows.change
            paths = s.moving_centres.with_centres(paths, self.poses, when, least, shadow)
        if shadows is not None:
            paths = shadows.in_pieces(paths, s.waveform, when - paths.epoch, least)
        return paths

    def _listening(self, link: Link) -> tuple[ReceiveArray, Reference]:
        """Return the receive array and the reference chirps of a link's receiver."""
        s = self._setup
        start = s.timetable.start_time(self.number, link.tx)
        return ReceiveArray(self.poses[link.rx], s.arrays.of(link.rx)), Reference(start)

    def _noise(self, link: Link) -> WhiteNoise:
        seed = self._setup.scenario.seed
        words = seed_sequence(seed, "noise", *link, self.number).generate_state(2)
        return WhiteNoise(self.noise_power(link), words)


@dataclass(frozen=True)
class Setup:
    """Parts of a run that are the same for all frames, built by `prepare`.

    Examples
    --------
    >>> import isac_rt as irt
    >>> setup = irt.prepare(irt.load("scenes/paper_swarm_consistent.yaml"))
    >>> setup.waveform.num_groups, setup.antennas.num_rx, list(setup.swarm.uavs)
    (3, 15, ['AT', 'PT1', 'PT2'])
    >>> [str(link) for link in setup.timetable.links(0)]
    ['AT->AT', 'AT->PT1', 'AT->PT2']
    """

    scenario: Scenario
    waveform: Waveform
    arrays: Arrays
    swarm: Swarm
    city: CityMesh
    believed_city: CityMesh
    """The city in the terminals' maps, with the errors of `belief`."""
    propagation: Propagation
    reference: FreeSpace
    """Closed forms of the reference paths, as they would be unoccluded and in view."""
    timetable: Timetable
    connections: Connections
    plan: Plan
    expectation: Any
    """Clutter that receivers expect from the mesh
    (`isac_rt.extensions.city_receivers.expectation.MeshExpectation`); None if no detector uses
    it."""
    seconds: Seconds = NONE
    """Time that `prepare` took."""
    by_chirp: tuple[Setup, ...] = ()
    """Set-ups of the radars of each chirp if they do not share one; chirp, paths and plan above are
    then those of the first."""

    def __repr__(self) -> str:
        return f"<Setup of {self.scenario.name}: {', '.join(map(str, self.timetable.links(0)))}>"

    @property
    def each(self) -> tuple[Setup, ...]:
        """Set-ups of all chirps; this one if all terminals share a chirp."""
        return self.by_chirp or (self,)

    def of(self, name: str) -> Setup:
        """Return the set-up of a terminal's chirp."""
        return next((part for part in self.by_chirp if name in part.plan.timetable.blocks), self)

    def with_antennas(self, antennas: Antennas) -> Setup:
        """Return the set-up with other antennas at every terminal and newly traced paths.

        Raises
        ------
        ValueError  If their number of transmit antennas is not that of the waveform.
        """
        if self.by_chirp:
            raise ValueError("terminals have chirps of their own; state swarm.NAME.array")
        if antennas.num_tx != self.waveform.num_tx:
            raise ValueError(
                f"the waveform is of {self.waveform.num_tx} transmit antennas, the array has "
                f"{antennas.num_tx}; prepare a scenario with this array"
            )
        arrays = Arrays(antennas)
        free = replace(self.reference, arrays=arrays)
        plan = replace(self.plan, arrays=arrays)
        s, floor = self.scenario, noise_floor(self.scenario, plan, free)
        return replace(
            self,
            arrays=arrays,
            reference=free,
            plan=plan,
            propagation=_extended(s, _maker(s, plan, free, self.city, floor)(), free, self.city),
            expectation=_expectation_of(s, plan, free, self.believed_city),
        )

    @property
    def antennas(self) -> Antennas:
        """Antennas of terminals without an array of their own; `arrays.at(link)` are those of a
        link."""
        return self.arrays.common

    @property
    def schedule(self) -> Schedule:
        return self.timetable.schedule

    @property
    def has_ideal_hardware(self) -> bool:
        """True if all front ends of the scenario are ideal."""
        s = self.scenario
        return all(s.front_end_of(name).ideal for name, u in s.swarm.items() if u.is_terminal)

    @cached_property
    def front_ends(self) -> dict[str, Any]:
        """Hardware of each terminal (`isac_rt.extensions.hardware.front_end.FrontEnd`)."""
        s, make = self.scenario, extension("front_end")
        return {
            name: make(s.front_end_of(name), self.waveform, self.arrays.of(name), s.seed, name)
            for name, uav in s.swarm.items()
            if uav.is_terminal
        }

    @cached_property
    def moving_centres(self) -> Any:
        """Scattering centres of UAVs beside their echoes, which synthesis alone sees
        (`isac_rt.extensions.street.centres.MovingCentres`); None without."""
        if not any(uav.rotors or uav.extent for uav in self.swarm.uavs.values()):
            return None
        make, sections = extension("moving_centres"), self.reference.sections
        return make(self.swarm, sections, self.waveform, self.arrays, self.scenario.seed)

    @cached_property
    def boxes(self) -> Any:
        """Boxes of UAVs (`isac_rt.extensions.street.boxes.Boxes`); None without."""
        if not self.swarm.has_boxes:
            return None
        return part_of(self.propagation, extension("boxes"))

    @cached_property
    def emitters(self) -> Any:
        """Foreign radars (`isac_rt.extensions.street.emitters.Emitters`); None without."""
        if not self.scenario.emitters:
            return None
        return extension("emitters")(self.scenario, self.city, self.waveform)

    @cached_property
    def calibration(self) -> Any:
        """Return the calibration of the terminals' boards that `radio.calibration` names.

        Raises
        ------
        isac_rt.extensions.hardware.types.CaptureError  If the file is no calibration, or that of a
        board of another size.
        """
        file = self.scenario.calibration_path()
        if file is None:
            return None
        calibration = extension("calibration")(file)
        for antennas in self.arrays:
            calibration.check_size(antennas.num_rx, antennas.num_tx)
        return calibration

    def calibrated(self, cube: IFCube) -> IFCube:
        """Return samples with the calibration of the board applied."""
        if self.calibration is None:
            return cube
        corrected: IFCube = extension("calibrated")(self.calibration, cube)
        return corrected

    @cached_property
    def walls(self) -> Any:
        """Terminals' model of the city, with which track initiation and track management test
        detections (`isac_rt.extensions.city_receivers.walls.Walls`)."""
        return extension("walls")(self.believed_city)

    def believed(self, name: str, pose: Pose) -> Pose:
        """Return a terminal's pose with its navigation errors, drawn once by `belief`."""
        belief = self.scenario.belief
        std = belief.position_std_m, belief.velocity_std_mps, np.radians(belief.attitude_std_deg)
        if not any(std):
            return pose
        rng = generator(self.scenario.seed, "belief", name)
        position, velocity, rotation_vector = np.array(std)[:, None] * rng.standard_normal((3, 3))
        return replace(
            pose,
            position=pose.position + position,
            velocity=pose.velocity + velocity,
            rotation=Rotation.from_rotvec(rotation_vector).as_matrix() @ pose.rotation,
        )

    def fidelity(self) -> dict[str, Any]:
        """Return what is modelled, as in `isac-rt plan` and summary.json: of the first chirp, and
        under `by_chirp` what differs for the radars of others."""
        s = self.scenario
        out = {
            **mechanisms(s.propagation, s.clutter),
            **decisions(self.plan),
            **extent(self.city, self.propagation.census(), s.clutter),
        }
        others = {", ".join(one.plan.timetable.blocks): one for one in self.by_chirp[1:]}
        differs = {
            names: {key: value for key, value in one.fidelity().items() if value != out[key]}
            for names, one in others.items()
        }
        return out | {"by_chirp": differs} if differs else out

    @cached_property
    def coverage(self) -> Coverage:
        """Coverage of the links, and the UAVs outside it."""
        s = self.scenario
        if self.by_chirp:
            each = [one.coverage for one in self.by_chirp]
            links = tuple(link for one in each for link in one.links)
            outside = tuple(row for one in each for row in one.outside)
            return replace(each[0], links=links, outside=outside)
        return coverage(self.swarm, self.timetable, self.arrays, s.receivers, s.schedule)

    def noise_power(self, poses: dict[str, Pose], link: Link) -> float:
        """E|n|^2 of a sample at the link's receiver [W], Gaussian clutter included."""
        return _noise_power(self.scenario, self.waveform, self.reference, poses, link)

    def frame(self, number: int) -> Frame:
        """Trace a frame, with the schedule of the scenario.

        Raises
        ------
        ValueError  If the scenario has no such frame.
        """
        if not 0 <= number < self.timetable.frames:
            raise ValueError(f"frame {number}: there are 0 to {self.timetable.frames - 1}")
        if self.by_chirp:
            return self._joint_frame(number)
        poses, traced = self._traced(number)
        return self.frame_of(number, poses, *traced)

    def frame_of(
        self, number: int, poses: dict[str, Pose], traced: Mapping[Link, PathSet], dropped: int = 0
    ) -> Frame:
        """Build the frame from the paths of `find`."""
        planned = {
            link: self.plan.apply(paths, self.noise_power(poses, link))
            for link, paths in traced.items()
        }
        active = self.timetable.with_role("active", number)
        return Frame(
            number,
            poses,
            {link: paths for link, (paths, _) in planned.items()},
            {name: self.transmission(name, number, poses[name]) for name in active},
            self._expected_clutter(number),
            {link: use for link, (_, use) in planned.items()},
            dropped,
            self,
            self._foreign(number, poses, traced),
        )

    def _foreign(
        self, number: int, poses: dict[str, Pose], links: Iterable[Link]
    ) -> Mapping[str, Any]:
        """Trace what arrives of emitters at the receivers of a frame."""
        if self.emitters is None:
            return {}
        receivers = dict.fromkeys(link.rx for link in links)
        found: Mapping[str, Any] = self.emitters.arrivals(
            poses, self.timetable.epoch(number), list(receivers)
        )
        return found

    def find(self, frame: int) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        """Return the poses and all paths of a frame, weak ones included."""
        if self.by_chirp:
            found = [one.find(frame)[1] for one in self.by_chirp]
            return self.swarm.poses(self.timetable.epoch(frame)), _union(found)
        poses, traced = self._traced(frame)
        return poses, traced.paths

    def _joint_frame(self, number: int) -> Frame:
        """Return the frames of the radars of each chirp as one."""
        frames = [one.frame(number) for one in self.by_chirp]
        return Frame(
            number,
            self.swarm.poses(self.timetable.epoch(number)),
            _union([one.paths for one in frames]),
            _union([one.sent for one in frames]),
            _union([one.expected for one in frames]),
            _union([one.uses for one in frames]),
            sum(one.dropped for one in frames),
            self,
            _by_chirp={name: one for one in frames for name in one.sent},
        )

    def _traced(self, frame: int) -> tuple[dict[str, Pose], Traced]:
        epoch = self.timetable.epoch(frame)
        poses = self.swarm.poses(epoch)
        receivers = dict.fromkeys(link.rx for link in self.timetable.links(frame))
        active = self.timetable.with_role("active", frame)
        return poses, self.propagation.trace(
            poses, epoch, [Link(tx, rx) for tx in active for rx in receivers]
        )

    def transmission(
        self, active: str, frame: int, pose: Pose, schedule: Schedule | None = None
    ) -> Transmission:
        """Return the transmission of an active terminal in a frame; `schedule`: other than that of
        the scenario."""
        return Transmission(
            name=active,
            pose=pose,
            antennas=self.arrays.of(active),
            schedule=self.schedule if schedule is None else schedule,
            payload=self.timetable.payload(active, frame, schedule),
            amplitude=self.plan.amplitudes[active],
            first_block=self.timetable.first_block(active, frame),
            codes=codes_of(self.waveform),
        )

    def _expected_clutter(self, frame: int) -> dict[str, ExpectedClutter]:
        if self.expectation is None:
            return {}
        out = {}
        for name in (link.tx for link in self.timetable.links(frame) if link.own):
            when = self.timetable.epoch(frame, name)
            pose = self.believed(name, self.swarm.trajectories[name].pose(when))
            out[name] = self.expectation.clutter(name, pose, when, self.plan.amplitudes[name])
        return out


def _union(parts: Iterable[Mapping[Any, Any]]) -> dict[Any, Any]:
    """Return the entries of all mappings as one."""
    return {key: value for part in parts for key, value in part.items()}


def link_budgets(setup: Setup) -> list[LinkBudget]:
    """Return the link budget of each link at the first frame."""
    if setup.by_chirp:
        return [row for one in setup.by_chirp for row in link_budgets(one)]
    poses = setup.swarm.poses(setup.timetable.epoch(0))
    rows = []
    for link in setup.timetable.links(0):
        tx, rx = link
        if link.own and not setup.reference.has_target(tx):
            continue
        amplitude = setup.reference.reference_amplitude(poses, link)
        name = setup.reference.strongest_target(poses, tx) if link.own else rx
        distance = float(np.linalg.norm(poses[name].position - poses[tx].position))
        what = f"echo of {name}" if link.own else "line of sight"
        sent, received = (setup.scenario.noise_of(name) for name in link)
        power = (transmit_amplitude(sent) * amplitude) ** 2
        noise = noise_power(received, setup.waveform, amplitude)
        antennas = setup.arrays.at(link)
        rows.append(link_budget(link, what, distance, (power, noise), setup.waveform, antennas))
    return rows


def prepare(scenario: Scenario, store: PathStore | None = None, digest: str | None = None) -> Setup:
    """Load and build everything that the frames of a run share.

    Parameters
    ----------
    scenario : Scenario
    store : cache of traced paths
    digest : `city_digest`, if known

    Raises
    ------
    ScenarioError  If the run is impossible: two UAVs meet, or memory is too small.

    Examples
    --------
    >>> import isac_rt as irt
    >>> setup = irt.prepare(irt.load("scenes/paper_swarm_consistent.yaml"))
    >>> setup.frame(0).samples(("AT", "AT")).samples.dtype
    dtype('complex64')
    """
    begin = Seconds.of_process()
    digest = city_digest(scenario.city, scenario.folder) if digest is None else digest
    alone = [(one, planned(one)) for one in scenario.by_chirp()]
    # with `access.establish` the blocks, and so the reach, are known after the access stages only
    reach = max(plan.mesh_radius(plan.swarm.middle) for _, plan in alone)
    parts = [_prepared(one, plan, reach, store, digest) for one, plan in alone]
    setup = parts[0] if parts[0].scenario is scenario else _joint(scenario, parts)
    setup = replace(setup, seconds=Seconds.of_process() - begin)
    warn_of_unseen(setup.coverage)
    return setup


def planned(scenario: Scenario) -> Plan:
    """Return the plan of a scenario whose terminals share the chirp, after checks of its size and
    flights."""
    waveform = waveform_of(scenario.radio, scenario.array, scenario.modulation)
    arrays, swarm = arrays_of(scenario, waveform), swarm_of(scenario)
    schedule = schedule_of(scenario.schedule, waveform, generator(scenario.seed, "schedule"))
    timetable = timetable_of(scenario, waveform, schedule)
    check_memory(arrays, timetable, swarm)
    check_flights(swarm, timetable)
    check_reference(scenario.noise, scenario.clutter, swarm, timetable)
    return plan_of(scenario, arrays, timetable, swarm)


def _joint(scenario: Scenario, parts: Sequence[Setup]) -> Setup:
    """Return the set-ups of the radars of each chirp as one."""
    if scenario.noise.model == "snr":
        warn_of_other_chirps({", ".join(one.plan.timetable.blocks): one.waveform for one in parts})
    roles = {name: uav.role for name, uav in scenario.swarm.items()}
    silent: dict[str, int | None] = dict.fromkeys(scenario.first_blocks())
    each = []
    for part in parts:
        blocks = silent | dict(part.timetable.blocks)
        each.append(
            replace(part, timetable=replace(part.timetable, first_roles=roles, blocks=blocks))
        )
    of = {name: one for one in each for name in one.plan.timetable.blocks}
    timetable = replace(
        each[0].timetable,
        blocks=scenario.first_blocks(),
        own={name: one.timetable for name, one in of.items() if one is not each[0]},
    )
    arrays = Arrays(each[0].arrays.common, {name: one.arrays.of(name) for name, one in of.items()})
    return replace(
        each[0],
        scenario=scenario,
        arrays=arrays,
        swarm=swarm_of(scenario),
        timetable=timetable,
        by_chirp=tuple(each),
    )


def _prepared(
    scenario: Scenario, plan: Plan, reach: float, store: PathStore | None, digest: str
) -> Setup:
    """Return the set-up of a scenario whose terminals share the chirp; the city as far as
    `reach` [m]."""
    waveform, arrays, swarm, timetable = plan.waveform, plan.arrays, plan.swarm, plan.timetable
    radius = np.inf if scenario.access.establish or plan.whole_mesh else reach
    carrier = waveform.carrier_frequency
    about = swarm.middle, scenario.city, scenario.folder, carrier
    city = city_about(*about, radius, digest)
    whole = city_about(*about, digest=digest)
    check_passage(swarm, timetable, whole)
    if scenario.propagation.model == "ray_traced":
        check_reach(scenario.city, whole, reach)
    warn_of_aliases(swarm, timetable, arrays, scenario.receivers.velocity_method, scenario.schedule)
    free = FreeSpace(swarm.uavs, arrays, waveform.wavelength, scenario.seed)
    level = partial(_noise_power, scenario, waveform, free)
    warn_of_interference(swarm, timetable, arrays, whole, (plan.amplitudes, level))
    floor = noise_floor(scenario, plan, free)
    make = _maker(scenario, plan, free, city, floor)
    if store is None or scenario.propagation.model != "ray_traced":
        propagation = make()
    else:
        content = path_content(scenario.model_dump(mode="json"), digest)
        content = json.dumps([content, city.num_faces, "" if floor is None else floor.record()])
        propagation = CachedPropagation(make, store, content)
    believed = _believed_city(scenario, city)
    setup = Setup(
        scenario,
        waveform,
        arrays,
        swarm,
        city,
        believed,
        _extended(scenario, propagation, free, city),
        free,
        timetable,
        Connections(),
        plan,
        _expectation_of(scenario, plan, free, believed),
    )
    _ = setup.calibration, setup.emitters  # what cannot be is refused here
    return _connected(setup)


def _maker(
    scenario: Scenario, plan: Plan, free: FreeSpace, city: CityMesh, floor: NoiseFloor | None
) -> Callable[[], Propagation]:
    """Return the factory of a run's propagation model."""
    settings = scenario.propagation, scenario.clutter
    ground = Ground(*settings, plan.swarm, city, plan.waveform, free, plan.max_untraced, floor)
    return partial(make_propagation, ground)


def part_of(model: Any, kind: type) -> Any:
    """Return the part of a propagation model that is of a type; each has the next as `model`."""
    return model if isinstance(model, kind) else part_of(model.model, kind)


def _extended(
    scenario: Scenario, model: Propagation, free: FreeSpace, city: CityMesh
) -> Propagation:
    """Return a propagation model with the scenario's boxes and weather."""
    waveform = waveform_of(scenario.radio, scenario.array)
    hiding = city if scenario.propagation.model == "ray_traced" else None
    if (swarm := swarm_of(scenario)).has_boxes:
        materials = {} if scenario.city is None else scenario.city.materials
        model = extension("boxes")(swarm, materials, model, free, waveform, hiding)
    if scenario.weather is not None:
        model = extension("weather")(scenario.weather, model, free, waveform, hiding)
    return model


def _expectation_of(scenario: Scenario, plan: Plan, free: FreeSpace, believed: CityMesh) -> Any:
    if not scenario.needs_mesh:
        return None
    about = scenario.clutter, plan.swarm, believed, plan.waveform
    monostatic = [link for link in plan.timetable.all_links if link.own]
    floor = _floor_of(scenario, plan, free, monostatic)
    level = scenario.belief.level_db
    return extension("expected_clutter")(*about, plan.arrays, scenario.seed, floor, level)


def _believed_city(scenario: Scenario, city: CityMesh) -> CityMesh:
    belief = scenario.belief
    rng = generator(scenario.seed, "mesh error")
    believed = city.without(belief.missing_m).displaced(belief.mesh_m, rng)
    if belief.materials:
        believed = replace(
            believed, materials=believed_materials(believed.materials, belief.materials)
        )
    return believed


def _noise_power(
    scenario: Scenario, waveform: Waveform, reference: FreeSpace, poses: dict[str, Pose], link: Link
) -> float:
    noise, rise = scenario.noise_of(link.rx), scenario.clutter.noise_rise
    if noise.model == "link_budget":
        return rise * thermal_noise_power(noise, waveform)
    amplitude = reference.reference_amplitude(poses, link)
    return rise * noise_power(noise, waveform, amplitude)


def noise_floor(scenario: Scenario, plan: Plan, reference: FreeSpace) -> NoiseFloor | None:
    """Return the noise floor of each link for merging scatterers. None, without merging: for links
    established in the run, for mirrors, which move clutter to other cells, and for the preset
    everything."""
    clutter, timetable = scenario.clutter, plan.timetable
    wanted = clutter.model == "field" and scenario.propagation.model == "ray_traced"
    if not wanted or clutter.mirrors or scenario.access.establish or plan.preset == "everything":
        return None
    return _floor_of(scenario, plan, reference, timetable.all_links)


def _floor_of(
    scenario: Scenario, plan: Plan, reference: FreeSpace, links: list[Link]
) -> NoiseFloor:
    """Return the noise floor of some links."""
    timetable, frames = plan.timetable, plan.spread_frames()
    times = np.array([timetable.epoch(frame) for frame in frames])
    poses = [plan.swarm.poses(time) for time in times]
    sets = [
        scenario.receivers,
        *(receiver_set.receivers for receiver_set in scenario.compare.values()),
    ]
    over_noise = {}
    for link in links:
        by_beam = any(receivers.looks_by_beam(link.own) for receivers in sets)
        gain = plan.cell_noise_gain(link.tx) * (BY_BEAM if by_beam else 1.0)
        over_noise[link] = np.array(
            [
                gain / _noise_power(scenario, plan.waveform, reference, pose, link)
                if timetable.holds(link, frame)
                else 0.0
                for frame, pose in zip(frames, poses, strict=True)
            ]
        )
    return NoiseFloor(plan.waveform, plan.arrays, plan.longest_delay, times, over_noise)


def timetable_of(scenario: Scenario, waveform: Waveform, schedule: Schedule) -> Timetable:
    """Build the timetable of a scenario."""
    return Timetable(
        waveform=waveform,
        schedule=schedule,
        modulation=scenario.modulation,
        first_roles={name: uav.role for name, uav in scenario.swarm.items()},
        blocks=scenario.first_blocks(),
        frames=scenario.frames,
        interval=scenario.frame_interval_s or scenario.frame_duration_s,
        active_every=scenario.receivers.active_every_frames,
        seed=scenario.seed,
        role_changes=scenario.role_changes,
    )


def arrays_of(scenario: Scenario, waveform: Waveform) -> Arrays:
    """Build the antennas of a scenario's terminals."""
    by_name = {n: antennas_of(u.array, waveform) for n, u in scenario.swarm.items() if u.array}
    return Arrays(antennas_of(scenario.array, waveform), by_name)


def plan_of(scenario: Scenario, arrays: Arrays, timetable: Timetable, swarm: Swarm) -> Plan:
    """Build the plan of a scenario."""
    return Plan(
        scenario.accuracy,
        scenario.propagation,
        arrays,
        timetable,
        swarm,
        {name: transmit_amplitude(scenario.noise_of(name)) for name in swarm.terminals},
    )


def _connected(setup: Setup) -> Setup:
    """Return the set-up after the access stages of the scenario, whose last frame ends before the
    first of the run."""
    s = setup.scenario
    clocks = {
        name: Clock(uav.clock_offset_s, uav.clock_drift_ppm * 1e-6)
        for name, uav in s.swarm.items()
        if uav.is_terminal and s.access.synchronisation != "external"
    }
    if not s.access.establish:
        return replace(setup, connections=Connections(clocks))

    outcome = extension("access")(setup, clocks)
    connections = Connections(clocks, outcome)
    timetable = replace(setup.timetable, blocks=outcome.blocks, refused=connections.refused)
    plan = replace(setup.plan, timetable=timetable)
    return replace(setup, timetable=timetable, connections=connections, plan=plan)


def swarm_of(scenario: Scenario) -> Swarm:
    """Build the scenario's UAVs and their flights."""
    successors = tuple(change.to_uav for change in scenario.role_changes)
    return Swarm(scenario.swarm, scenario.flight_duration_s, successors)


def city_of(scenario: Scenario, radius: float = np.inf) -> CityMesh:
    """Return the scenario's city within `radius` [m] of the middle of the flights; equal scenarios
    share one object."""
    centre, carrier = swarm_of(scenario).middle, scenario.radio.carrier_hz
    return city_about(centre, scenario.city, scenario.folder, carrier, radius)


def propagation_in(city: CityMesh, scenario: Scenario, sample_spacing: float = 0.0) -> Propagation:
    """Return the scenario's propagation model in any city."""
    waveform, swarm = waveform_of(scenario.radio, scenario.array), swarm_of(scenario)
    free = FreeSpace(swarm.uavs, arrays_of(scenario, waveform), waveform.wavelength, scenario.seed)
    settings = scenario.propagation, scenario.clutter
    model = make_propagation(Ground(*settings, swarm, city, waveform, free, sample_spacing))
    return _extended(scenario, model, free, city)


def trace(scenario: Scenario, frame: int, *, setup: Setup | None = None) -> dict[Link, PathSet]:
    """Return the paths of all links of one frame.

    Examples
    --------
    >>> import isac_rt as irt
    >>> paths = irt.trace(irt.load("scenes/paper_swarm_consistent.yaml"), 0)
    >>> float((paths["AT", "PT1"].delay.min() * 299792458).round(2))
    11.33
    """
    return dict((setup or prepare(scenario)).frame(frame).paths)
