"""Who sends what to whom in every frame: roles and their changes, resource blocks, pilots, streams.
All of it public."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.frame.payload import Payload, random_payload, unmodulated
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.settings import Modulation, RoleChange
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import generator


@dataclass(frozen=True, kw_only=True)
class Timetable:
    """The frames of a run.

    Attributes
    ----------
    waveform, schedule : of every frame
    modulation : pilots, acquisition frames, alphabet and streams
    first_roles : role of every UAV at the start, in the scenario's order
    blocks : first resource block of every UAV that is active at the start; None: it found none and
        stays silent
    frames : how many there are
    interval : from the start of a frame to that of the next [s]
    active_every : active terminals process one frame in so many
    seed : of the data
    role_changes : in rising order of their frames
    refused : links that were not established before the data
    begins : frame with which the acquisition frames of the start begin
    own : timetables of plain radars whose chirp differs from `waveform`, by name
    """

    waveform: Waveform
    schedule: Schedule
    modulation: Modulation
    first_roles: Mapping[str, str]
    blocks: Mapping[str, int | None]
    frames: int
    interval: float
    active_every: int = 1
    seed: int = 1
    role_changes: tuple[RoleChange, ...] = ()
    refused: frozenset[Link] = frozenset()
    begins: int = 0
    own: Mapping[str, Timetable] = field(default_factory=dict)

    def of(self, name: str) -> Timetable:
        """Return the timetable of a terminal's chirp."""
        return self.own.get(name, self)

    def start_time(self, frame: int, active: str | None = None) -> float:
        """Start of a frame's first slot, or of the first chirp of an active terminal, whose block
        may start later in the slot [s]."""
        if active is not None and active in self.own:
            return self.own[active].start_time(frame, active)
        block = 0 if active is None else self.first_block(active, frame)
        return frame * self.interval + block * self.waveform.group_spacing

    def epoch(self, frame: int, active: str | None = None) -> float:
        """Middle of a frame, or of the chirps of an active terminal [s]."""
        waveform = self.waveform if active is None else self.of(active).waveform
        return self.start_time(frame, active) + waveform.frame_duration / 2

    def modulated(self, frame: int) -> bool:
        """Return whether a frame carries data: all but the periodic pilots and the acquisition
        frames at the start and after a change of roles, and none of a plain radar."""
        every = self.modulation.pilot_every_frames
        pilot = every is not None and frame % every == 0
        if not self.waveform.carries_data:
            return False
        starts = [self.begins, *(c.frame for c in self.role_changes if c.frame <= frame)]
        since = frame - max(starts)
        return since >= self.modulation.acquisition_frames and not pilot

    @cached_property
    def _stretches(self) -> list[tuple[int, dict[str, str], dict[str, int | None]]]:
        """(first frame, roles, blocks of the active terminals) of each stretch between changes."""
        roles, blocks = dict(self.first_roles), dict(self.blocks)
        out = [(0, roles, blocks)]
        for change in self.role_changes:
            roles = roles | {change.from_uav: "passive", change.to_uav: "active"}
            blocks = {
                change.to_uav if name == change.from_uav else name: block
                for name, block in blocks.items()
            }
            out.append((change.frame, roles, blocks))
        return out

    def _stretch(self, frame: int) -> tuple[int, dict[str, str], dict[str, int | None]]:
        return [stretch for stretch in self._stretches if stretch[0] <= frame][-1]

    def roles(self, frame: int) -> dict[str, str]:
        """Role of every UAV in a frame."""
        return self._stretch(frame)[1]

    def with_role(self, role: str, frame: int) -> list[str]:
        """Names of the UAVs of one role in a frame, in the scenario's order; active ones that
        send."""
        _, roles, blocks = self._stretch(frame)
        return [
            name
            for name, is_now in roles.items()
            if is_now == role and (role != "active" or blocks[name] is not None)
        ]

    def roles_taken(self, name: str) -> list[str]:
        """The roles of a UAV over the run, in order."""
        every = [roles[name] for _, roles, _ in self._stretches]
        return [role for i, role in enumerate(every) if i == 0 or role != every[i - 1]]

    def first_block(self, active: str, frame: int) -> int:
        """First resource block of an active terminal that sends: its own, or that of the terminal
        whose role it took over."""
        block = self._stretch(frame)[2][active]
        assert block is not None, f"{active} is silent"
        return block

    def links(self, frame: int) -> list[Link]:
        """Links that are received in a frame: every active terminal's own (when it processes the
        frame), and from each active terminal to every passive one."""
        return self._links(frame, own=frame % self.active_every == 0)

    def _links(self, frame: int, own: bool) -> list[Link]:
        active, passive = self.with_role("active", frame), self.with_role("passive", frame)
        return [Link(a, a) for a in active if own] + [
            Link(a, p) for a in active for p in passive if (a, p) not in self.refused
        ]

    def holds(self, link: Link, frame: int) -> bool:
        """Return whether the roles of a frame have a link, even where its own terminal skips the
        frame."""
        return link in self._links(frame, own=True)

    @cached_property
    def all_links(self) -> list[Link]:
        """Every link that is received at some time, in the order of first use."""
        links = (link for first, _, _ in self._stretches for link in self._links(first, own=True))
        return list(dict.fromkeys(links))

    @cached_property
    def labels(self) -> dict[Link, str]:
        """A name for each of `all_links`: the receiver's where it has one transmitter in the whole
        run, else "TX->RX"."""
        receivers = [link.rx for link in self.all_links]
        one_each = len(set(receivers)) == len(receivers)
        alone = one_each and len({link.tx for link in self.all_links}) == 1
        return {link: link.rx if alone else str(link) for link in self.all_links}

    def groups(self, link: Link) -> tuple[int, ...] | None:
        """Groups whose data are meant for a link's receiver; None: all of them."""
        chosen = self.modulation.streams.get(link.rx)
        return None if chosen is None or link.own else tuple(sorted(chosen))

    def payload(self, active: str, frame: int, schedule: Schedule | None = None) -> Payload:
        """Return the payload of an active terminal's chirps in a frame; `schedule`: if it is
        another than the usual one. The bits are the same."""
        if not self.modulated(frame):
            return unmodulated(self.of(active).waveform)
        rng = generator(self.seed, "payload", active, frame)
        usual = self.schedule if schedule is None else schedule
        return random_payload(self.waveform, usual, self.modulation.dpsk_order, rng)

    def snapshots(self, count: int) -> set[int]:
        """At most `count` frames, spread over those in data mode that active terminals process; all
        frames where `count` is as large."""
        if count >= self.frames:
            return set(range(self.frames))
        received = [
            f
            for f in range(0, self.frames, self.active_every)
            if f >= self.modulation.acquisition_frames or not self.waveform.carries_data
        ] or [0]
        index = np.linspace(0, len(received) - 1, min(count, len(received)))
        return {received[i] for i in index.round().astype(int)}
