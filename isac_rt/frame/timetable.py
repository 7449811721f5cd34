"""Who sends what to whom in every frame: roles and their changes, resource blocks, pilots, streams.
All of it public."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.frame.payload import Payload, random_payload, unmodulated
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import generator
from isac_rt.scenario.tree import Scenario


@dataclass(frozen=True)
class Timetable:
    """The frames of a run."""

    scenario: Scenario
    waveform: Waveform
    schedule: Schedule
    blocks: Mapping[str, int] | None = None
    """First resource blocks where the stages before the data chose them, without those that found
    none and stay silent; None: as the scenario has them."""
    refused: frozenset[Link] = frozenset()
    """Links that these stages did not establish."""

    def start_time(self, frame: int, active: str | None = None) -> float:
        """Of a frame's first slot [s]; of the first chirp of an active terminal, whose block may
        start later in the slot."""
        interval = self.scenario.frame_interval_s or self.waveform.frame_duration
        block = 0 if active is None else self.first_block(active, frame)
        return frame * interval + block * self.waveform.group_spacing

    def epoch(self, frame: int, active: str | None = None) -> float:
        """Middle of a frame [s]; of the chirps of an active terminal."""
        return self.start_time(frame, active) + self.waveform.frame_duration / 2

    def modulated(self, frame: int) -> bool:
        """Whether a frame carries data: all but the periodic pilots and the acquisition frames at
        the start and after a change of roles."""
        m = self.scenario.modulation
        pilot = m.pilot_every_frames is not None and frame % m.pilot_every_frames == 0
        since = frame - max(
            (c.frame for c in self.scenario.role_changes if c.frame <= frame), default=0
        )
        return since >= m.acquisition_frames and not pilot

    @cached_property
    def _roles(self) -> list[tuple[int, dict[str, str]]]:
        """(first frame, role of every UAV) of each stretch between changes."""
        roles = {name: str(uav.role) for name, uav in self.scenario.swarm.items()}
        out = [(0, roles)]
        for change in self.scenario.role_changes:
            roles = roles | {change.from_uav: "passive", change.to_uav: "active"}
            out.append((change.frame, roles))
        return out

    def roles(self, frame: int) -> dict[str, str]:
        """Role of every UAV in a frame."""
        return [roles for first, roles in self._roles if first <= frame][-1]

    def with_role(self, role: str, frame: int) -> list[str]:
        """Names of the UAVs of one role in a frame, in the scenario's order; active ones that
        send."""
        silent = (
            ()
            if self.blocks is None or role != "active"
            else set(self.scenario.first_blocks()) - set(self.blocks)
        )
        return [
            name
            for name, is_now in self.roles(frame).items()
            if is_now == role and name not in silent
        ]

    def roles_taken(self, name: str) -> list[str]:
        """The roles of a UAV over the run, in order."""
        every = [roles[name] for _, roles in self._roles]
        return [role for i, role in enumerate(every) if i == 0 or role != every[i - 1]]

    def first_block(self, active: str, frame: int) -> int:
        """First resource block of an active terminal: its own, or that of the terminal whose role
        it took over."""
        blocks = dict(self.scenario.first_blocks() if self.blocks is None else self.blocks)
        for change in self.scenario.role_changes:
            if change.frame <= frame:
                blocks[change.to_uav] = blocks.pop(change.from_uav)
        return blocks[active]

    def links(self, frame: int) -> list[Link]:
        """Links that are received in a frame: every active terminal's own (when it processes the
        frame), and from each active terminal to every passive one."""
        active, passive = self.with_role("active", frame), self.with_role("passive", frame)
        own = frame % self.scenario.receivers.active_every_frames == 0
        return [Link(a, a) for a in active if own] + [
            Link(a, p) for a in active for p in passive if (a, p) not in self.refused
        ]

    @cached_property
    def all_links(self) -> list[Link]:
        """Every link that is received at some time, in the order of first use."""
        found: dict[Link, None] = {}
        for first, roles in self._roles:
            active = self.with_role("active", first)
            found |= dict.fromkeys(Link(a, a) for a in active)
            found |= dict.fromkeys(
                Link(a, p)
                for a in active
                for p, role in roles.items()
                if role == "passive" and (a, p) not in self.refused
            )
        return list(found)

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
        chosen = self.scenario.modulation.streams.get(link.rx)
        return None if chosen is None or link.own else tuple(sorted(chosen))

    def payload(self, active: str, frame: int, schedule: Schedule | None = None) -> Payload:
        """What an active terminal's chirps carry in a frame; `schedule`: if it is another than the
        usual one. The bits are the same."""
        if not self.modulated(frame):
            return unmodulated(self.waveform)
        rng = generator(self.scenario.seed, "payload", active, frame)
        return random_payload(
            self.waveform,
            self.schedule if schedule is None else schedule,
            self.scenario.modulation.dpsk_order,
            rng,
        )


def snapshot_frames(scenario: Scenario, count: int) -> set[int]:
    """Frames of which maps and ledger are kept: from the first in data mode to the last, of those
    that the active terminal processes."""
    step = scenario.receivers.active_every_frames
    heard = [
        f for f in range(0, scenario.frames, step) if f >= scenario.modulation.acquisition_frames
    ] or [0]
    return {
        heard[i] for i in np.linspace(0, len(heard) - 1, min(count, len(heard))).round().astype(int)
    }
