"""The stages before the data, on the exact signal: blocks found and announced, clocks measured,
links acknowledged.

Active terminals join one after the other; those that have joined send data all the while, so that
the next ones receive them (or collide with them, if they cannot). One terminal's stages, each frame
right after the last:

1. It listens to M blocks per frame until it has received all of them, takes the free run nearest to
its wish, and announces its first block
   by on-off keying in all M blocks while the passive terminals scan the blocks as it did.
2. Round 1: it sends an unmodulated frame to all. Round 2: its passive terminals answer unmodulated,
up to M in one frame, each in one
   block of the run. With an external clock this stage is left out.
3. Those that understood the announcement and received round 1 acknowledge by on-off keying in their
block.

Whoever sends here sends `hold` later than its clock says, so that a clock that is ahead by more
than the path's delay is received all the same; receivers know it. Not modelled: the passage of
round 1's estimate and of both ends' positions and velocities to where the clock is computed, taken
as free of errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from isac_rt.extensions.access.ook import (
    Codebook,
    Message,
    choose_run,
    consensus,
    hot_chirps,
    keyed,
    needed_chirps,
    read,
)
from isac_rt.extensions.access.synchronise import (
    EXTERNAL,
    ClockEstimate,
    Round,
    estimate_clock,
    measured_alone,
    path_acceleration,
    round_of,
)
from isac_rt.frame.antennas import Arrays
from isac_rt.frame.clock import Clock
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference, Transmission
from isac_rt.frame.link import Link
from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathSet
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections
from isac_rt.registry import extension
from isac_rt.signal.if_signal import noisy_if_signal
from isac_rt.signal.methods import Auto, Method
from isac_rt.signal.noise import WhiteNoise
from isac_rt.simulation.setup import Setup
from isac_rt.world.swarm import Pose

Scene = Callable[[float, list[Link]], tuple[Mapping[str, Pose], Mapping[Link, PathSet]]]
"""Poses of all terminals at a time, and the paths of these links with this time as their epoch."""

HOLD_SHARE = 0.125
"""Agreed lateness of every sender here, as a share of T_d (213 ns, 64 m with the paper's
numbers)."""
BLOCK_FALSE_RATE = 1e-4
"""Chance that noise makes a free block look taken."""


@dataclass(frozen=True, kw_only=True)
class Network:
    """Everything that the stages need, none of it known to the terminals beyond the public numbers.

    Attributes
    ----------
    waveform, arrays, schedule : public
    receivers : settings of the passive receiver
    scene : poses and paths at any time
    wishes : first block that each active terminal would like, in the order in which they join; None
        for no wish
    listeners : passive terminals of each active one
    clocks : of every terminal; those left out are right
    noise_power : E|n|^2 per IF sample of every receiver [W]
    amplitudes : sqrt(transmit power) of an antenna of each terminal; 1 by default
    seed : of all randomness here
    external_clock : whether stage 2 is left out
    dpsk_order : of the data of those that have joined
    start : of the first frame [s]
    foreign : what arrives of emitters at terminals, by poses, time and their names; None: nothing
    """

    waveform: Waveform
    arrays: Arrays
    schedule: Schedule
    receivers: Receivers
    scene: Scene
    wishes: Mapping[str, int | None]
    listeners: Mapping[str, Sequence[str]]
    noise_power: Mapping[str, float]
    seed: int
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    amplitudes: Mapping[str, float] = field(default_factory=dict)
    external_clock: bool = False
    dpsk_order: int = 8
    start: float = 0.0
    foreign: Callable[[Mapping[str, Pose], float, list[str]], Mapping[str, Any]] | None = None

    @property
    def names(self) -> list[str]:
        """Active terminals in their order, then the passive ones."""
        return [
            *self.wishes,
            *dict.fromkeys(name for pts in self.listeners.values() for name in pts),
        ]

    @property
    def codebook(self) -> Codebook:
        return Codebook(len(self.names), self.waveform.num_resource_blocks)

    @property
    def hold(self) -> float:
        return HOLD_SHARE * self.waveform.max_delay

    @property
    def longest(self) -> float:
        """Most that all of it can last [s]."""
        w, frames = self.waveform, 0
        for pts in self.listeners.values():
            sweeps = len(scan(w.num_resource_blocks, w.num_groups))
            frames += 2 * sweeps + 1 + 2 * -(-len(pts) // w.num_groups)
        return frames * w.frame_duration


@dataclass(frozen=True)
class LinkState:
    """Outcome of one link.

    Attributes
    ----------
    received_block : first block on the passive terminal's own grid, None when no announcement was
        understood
    message : what it understood
    identified : whether that is what was announced
    clock : estimate, `EXTERNAL` with an external clock, None when a round was missed
    sent_acknowledgment, acknowledged : by the passive terminal; as the active one read it
    """

    received_block: int | None
    message: Message | None
    identified: bool
    clock: ClockEstimate | None
    sent_acknowledgment: bool
    acknowledged: bool


@dataclass(frozen=True)
class Establishment:
    """Outcome of the stages before the data.

    Attributes
    ----------
    blocks : first block of each active terminal, None where no run was free
    links : state of every (active, passive) link
    missed_blocks, false_blocks : taken blocks that each active terminal did not receive, free ones
        that it thought taken
    missed_announcements, wrong_announcements : links whose passive terminal understood nothing, or
        something else
    missed_acknowledgments, false_acknowledgments : sent and not read; read and not sent
    num_frames, duration : of all of it [1, s]
    """

    blocks: dict[str, int | None]
    links: dict[Link, LinkState]
    missed_blocks: dict[str, int]
    false_blocks: dict[str, int]
    missed_announcements: int
    wrong_announcements: int
    missed_acknowledgments: int
    false_acknowledgments: int
    num_frames: int
    duration: float


class _Air:
    """The frames as they go by: who has joined, what everybody receives."""

    def __init__(self, network: Network) -> None:
        self.n = network
        self.frame = 0
        self.blocks: dict[str, int | None] = {}

    @property
    def time(self) -> float:
        """Middle of the present frame [s]."""
        return self.n.start + (self.frame + 0.5) * self.n.waveform.frame_duration

    def sender(
        self, name: str, block: int, *, data: bool = False, active: np.ndarray | None = None
    ) -> Transmission:
        """A transmission of a terminal on its own grid: held, and unmodulated unless it has joined;
        `active` chirps of it only."""
        w, n = self.n.waveform, self.n
        rng = generator(n.seed, "access", "payload", name, self.frame)
        payload = random_payload(w, n.schedule, n.dpsk_order, rng) if data else unmodulated(w)
        return Transmission(
            name=name,
            pose=n.scene(self.time, [])[0][name],
            antennas=n.arrays.of(name),
            schedule=n.schedule,
            payload=payload,
            amplitude=n.amplitudes.get(name, 1.0),
            first_block=block,
            clock_offset=0.0 if data else n.hold,
            active=active,
        )

    def received(self, name: str, first_block: int, sent: Sequence[Transmission] = ()) -> IFCube:
        """Samples of a terminal with its references in M blocks from `first_block` of its own grid,
        those that have joined included."""
        n, w = self.n, self.n.waveform
        busy = {t.name for t in sent} | {name}
        joined = [
            self.sender(at, b, data=True)
            for at, b in self.blocks.items()
            if b is not None and at not in busy
        ]
        every = [*sent, *joined]
        poses, paths = n.scene(self.time, [Link(t.name, name) for t in every])
        own = n.clocks.get(name, Clock())
        links = []
        for t in every:
            clock = n.clocks.get(t.name, Clock())
            difference = clock.late(self.time) - own.late(self.time)
            shifted = replace(
                t, clock_offset=t.clock_offset + difference, clock_drift=clock.drift - own.drift
            )
            links.append((shifted, paths[Link(t.name, name)]))
        start, noise = self.time - w.frame_duration / 2, n.noise_power[name]
        reference = Reference(start + first_block * w.group_spacing, first_block, n.schedule)
        array, method = ReceiveArray(poses[name], n.arrays.of(name)), cast(Method, Auto(noise))
        if n.foreign is not None:
            arrivals = n.foreign(poses, self.time, [name])[name]
            method = extension("with_foreign")(method, arrivals, array, reference, noise)
        words = seed_sequence(n.seed, "access", "noise", name, self.frame).generate_state(2)
        return noisy_if_signal(w, links, array, reference, method, WhiteNoise(noise, words))


def establish(network: Network) -> Establishment:
    """Stages 1 to 3 for all active terminals of a network.

    Returns
    -------
    Establishment; wrong decisions are among its counts and have their consequences: a terminal that
    misses the announcement receives no round, one whose clock is unknown is not acknowledged.
    """
    air = _Air(network)
    links: dict[Link, LinkState] = {}
    missed: dict[str, int] = {}
    false: dict[str, int] = {}
    for at, wish in network.wishes.items():
        busy = _listen(air, at)
        truth = _occupied(air)
        missed[at], false[at] = int((truth & ~busy).sum()), int((busy & ~truth).sum())
        block = choose_run(busy, network.waveform.num_groups, wish)
        if block is None:
            links |= {
                Link(at, pt): LinkState(None, None, False, None, False, False)
                for pt in network.listeners[at]
            }
        else:
            links |= _join(air, at, block)
        air.blocks[at] = block
    states = list(links.values())
    return Establishment(
        blocks=dict(air.blocks),
        links=links,
        missed_blocks=missed,
        false_blocks=false,
        missed_announcements=sum(s.message is None for s in states),
        wrong_announcements=sum(s.message is not None and not s.identified for s in states),
        missed_acknowledgments=sum(s.sent_acknowledgment and not s.acknowledged for s in states),
        false_acknowledgments=sum(s.acknowledged and not s.sent_acknowledgment for s in states),
        num_frames=air.frame,
        duration=air.frame * network.waveform.frame_duration,
    )


def scan(num_blocks: int, width: int) -> list[int]:
    """First blocks of the stretches of `width` blocks in which all blocks are received; the last
    stretch may overlap."""
    return [min(first, num_blocks - width) for first in range(0, num_blocks, width)]


def _occupied(air: _Air) -> np.ndarray:
    """(blocks,) bool, where those that have joined send."""
    truth = np.zeros(air.n.waveform.num_resource_blocks, bool)
    for block in air.blocks.values():
        if block is not None:
            truth[block : block + air.n.waveform.num_groups] = True
    return truth


def _listen(air: _Air, at: str) -> np.ndarray:
    """Blocks that an active terminal receives somebody in, (blocks,) bool."""
    w = air.n.waveform
    busy = np.zeros(w.num_resource_blocks, bool)
    for first in scan(busy.size, w.num_groups):
        hot = hot_chirps(air.received(at, first).samples)
        busy[first : first + w.num_groups] |= hot >= needed_chirps(w.num_chirps, BLOCK_FALSE_RATE)
        air.frame += 1
    return busy


def _join(air: _Air, at: str, block: int) -> dict[Link, LinkState]:
    """Announcement, two rounds and acknowledgments of one active terminal."""
    n = air.n
    pts = list(n.listeners[at])
    said = Message(n.names.index(at), block)
    announced = _announce(air, said, pts)
    first: dict[str, Round | None] = {}
    second: dict[str, Round | None] = {}
    understood = {pt: got[0] for pt, got in announced.items() if got is not None}
    if not n.external_clock:
        first = _first_round(air, at, block, understood)
        understood = {pt: b for pt, b in understood.items() if first[pt] is not None}
        second = _second_round(air, at, block, pts, understood)
    read_back = _acknowledge(air, at, block, pts, understood)
    out = {}
    for pt in pts:
        got = announced[pt]
        message = None if got is None else got[1]
        clock = EXTERNAL if n.external_clock else _clock(n, at, pt, first.get(pt), second.get(pt))
        out[Link(at, pt)] = LinkState(
            received_block=None if got is None else got[0],
            message=message,
            identified=message == said,
            clock=clock,
            sent_acknowledgment=pt in understood,
            acknowledged=pt in read_back and clock is not None,
        )
    return out


def _announce(
    air: _Air, said: Message, pts: Sequence[str]
) -> dict[str, tuple[int, Message] | None]:
    """Return what each passive terminal decoded of the announcement: (first block on its own grid,
    message)."""
    n, w = air.n, air.n.waveform
    mask = keyed(w, n.codebook.encode(said))
    votes: dict[str, list[tuple[int, Message]]] = {pt: [] for pt in pts}
    known: dict[str, set[int]] = {pt: set() for pt in pts}
    for first in scan(w.num_resource_blocks, w.num_groups):
        sent = air.sender(n.names[said.sender], said.block, active=mask)
        for pt in pts:
            samples = air.received(pt, first, [sent]).samples
            for m in range(w.num_groups):
                if first + m in known[pt]:
                    continue
                known[pt].add(first + m)
                got = read(samples[m : m + 1], n.codebook.num_bits)
                message = n.codebook.decode(got.bits) if got.found else None
                if message is not None:
                    votes[pt].append((first + m, message))
        air.frame += 1
    return {pt: _first_received(v, w.num_groups) for pt, v in votes.items()}


def _first_received(votes: Sequence[tuple[int, Message]], width: int) -> tuple[int, Message] | None:
    """The message that most blocks carry, in at least half of a run, and the first of these blocks:
    another's data may look like one."""
    agreed = consensus([message for _, message in votes])
    blocks = [block for block, message in votes if message == agreed]
    return None if agreed is None or 2 * len(blocks) < width else (min(blocks), agreed)


def _clock(
    n: Network, at: str, pt: str, first: Round | None, second: Round | None
) -> ClockEstimate | None:
    """Return a link's clock from both rounds and the flights that its ends report; None where a
    round was missed."""
    if first is None or second is None:
        return None
    poses = (n.scene(r.time, [])[0] for r in (first, second))
    before, after = ((p[at], p[pt]) for p in poses)
    acceleration = path_acceleration(before, after, second.time - first.time)
    return estimate_clock([first, second], acceleration)


def _line_of_sight(air: _Air, cube: IFCube, link: Link) -> Detections:
    n, antennas = air.n, air.n.arrays.at(link)
    found = receive_passive(cube, antennas, n.receivers, n.dpsk_order, None, False).detections
    return measured_alone(found, cube, antennas)


def _first_round(
    air: _Air, at: str, block: int, understood: Mapping[str, int]
) -> dict[str, Round | None]:
    """The active terminal's unmodulated frame at every passive one that knows where to listen."""
    sent, w, out = air.sender(at, block), air.n.waveform, {}
    for pt, first in understood.items():
        found = _line_of_sight(air, air.received(pt, first, [sent]), Link(at, pt))
        whole = (first - block) * w.group_spacing  # blocks by which the two grids differ
        held = air.n.hold - whole
        out[pt] = round_of(found, air.time, True, cell=w.range_cell(1), held=held)
    air.frame += 1
    return out


def _rounds(pts: Sequence[str], width: int) -> list[list[tuple[int, str]]]:
    """(group, passive terminal) of each frame in which they answer."""
    return [list(enumerate(pts[first : first + width])) for first in range(0, len(pts), width)]


def _answers(
    air: _Air,
    answering: Sequence[tuple[int, str]],
    understood: Mapping[str, int],
    bits: Mapping[str, np.ndarray],
) -> list[Transmission]:
    """Transmissions of those of a turn that have something to answer, each in its group alone."""
    w, out = air.n.waveform, []
    for group, pt in answering:
        if pt not in understood:
            continue
        mask = keyed(w, bits[pt]) if pt in bits else np.ones((w.num_groups, w.num_chirps), bool)
        mask[np.arange(w.num_groups) != group] = False
        out.append(air.sender(pt, understood[pt], active=mask))
    return out


def _second_round(
    air: _Air, at: str, block: int, pts: Sequence[str], understood: Mapping[str, int]
) -> dict[str, Round | None]:
    """The passive terminals' unmodulated answers at the active one."""
    w, out = air.n.waveform, {}
    for answering in _rounds(pts, w.num_groups):
        cube = air.received(at, block, _answers(air, answering, understood, {}))
        for group, pt in answering:
            if pt in understood:
                found = _line_of_sight(air, cube.of_groups([group]), Link(pt, at))
                # it answers on its own grid, whole blocks late by the other one's, as both know
                held = air.n.hold + (understood[pt] - block) * w.group_spacing
                out[pt] = round_of(found, air.time, False, cell=w.range_cell(1), held=held)
        air.frame += 1
    return out


def _acknowledge(
    air: _Air, at: str, block: int, pts: Sequence[str], understood: Mapping[str, int]
) -> set[str]:
    """Passive terminals whose acknowledgment the active one reads: their own name and its block."""
    n = air.n
    words = {pt: n.codebook.encode(Message(n.names.index(pt), block)) for pt in pts}
    out = set()
    for answering in _rounds(pts, n.waveform.num_groups):
        cube = air.received(at, block, _answers(air, answering, understood, words))
        for group, pt in answering:
            got = read(cube.samples[group : group + 1], n.codebook.num_bits)
            if got.found and n.codebook.decode(got.bits) == Message(n.names.index(pt), block):
                out.add(pt)
        air.frame += 1
    return out


def establish_links(setup: Setup, clocks: Mapping[str, Clock]) -> Establishment:
    """Run the stages before the data in a run's scene; the last of their frames ends by the first
    of the run's."""
    s, timetable = setup.scenario, setup.timetable
    active, passive = (
        [n for n, u in s.swarm.items() if u.role == r] for r in ("active", "passive")
    )

    def scene(when: float, links: list[Link]) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        poses = setup.swarm.poses(when)
        return poses, setup.propagation.trace(poses, when, links).paths if links else {}

    first = setup.swarm.poses(timetable.epoch(0))
    network = Network(
        waveform=setup.waveform,
        arrays=setup.arrays,
        schedule=setup.schedule,
        receivers=s.receivers,
        scene=scene,
        wishes=s.first_blocks(),
        listeners={name: tuple(passive) for name in active},
        noise_power={name: setup.noise_power(first, Link(name, name)) for name in active}
        | {name: setup.noise_power(first, Link(active[0], name)) for name in passive},
        seed=s.seed,
        clocks=clocks,
        amplitudes=setup.plan.amplitudes,
        external_clock=s.access.synchronisation != "two_round",
        dpsk_order=s.modulation.dpsk_order,
        foreign=None if setup.emitters is None else setup.emitters.arrivals,
    )
    return establish(replace(network, start=-network.longest))
