"""A run's stages before the data: from a scenario to blocks, links and clocks that its frames then
use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from isac_rt.access.protocol import Clock, Establishment, Link, Network, Scene, establish, scan
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.level import transmit_amplitude
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.scenario.tree import Scenario


@dataclass(frozen=True)
class Connections:
    """Who can hear whom, in which blocks, and by how much clocks are apart.

    Attributes
    ----------
    clocks : of every terminal against true time; empty where an external source keeps them equal
    establishment : outcome of the stages before the data; None when they were left out, and
        everything is as stated
    """

    clocks: Mapping[str, Clock] = field(default_factory=dict)
    establishment: Establishment | None = None

    def blocks(self) -> dict[str, int] | None:
        """First block of each active terminal that found one; None when the scenario's own hold."""
        if self.establishment is None:
            return None
        return {
            name: block for name, block in self.establishment.blocks.items() if block is not None
        }

    def refused(self) -> frozenset[Link]:
        """Links that carry no data: those that were not acknowledged."""
        links = {} if self.establishment is None else self.establishment.links
        return frozenset(link for link, state in links.items() if not state.acknowledged)

    def apart(self, sender: str, link: Link, time: float) -> Clock:
        """Clock of a sender against that of a link's receiver, corrected by what the receiver
        learnt of the link's transmitter.

        Returns
        -------
        Clock at `time` [s]: `offset` adds to every delay from the sender, `drift` to every delay
        rate
        """
        tx, rx = link
        if sender == rx:
            return Clock()
        one, other = self.clocks.get(sender, Clock()), self.clocks.get(rx, Clock())
        offset, drift = one.late(time) - other.late(time), one.drift - other.drift
        known = (
            None if self.establishment is None or tx == rx else self.establishment.links[link].clock
        )
        if known is not None:
            offset, drift = offset - known.offset_at(time), drift - known.drift
        return Clock(offset, drift)

    def offset_std(self, link: Link, time: float) -> float:
        """Standard deviation of what is left of a link's clocks at `time` [s]."""
        state = None if self.establishment is None else self.establishment.links[link].clock
        return 0.0 if state is None else state.offset_std_at(time)

    def summary(self, time: float) -> dict[str, Any] | None:
        """For `summary.json`: what was decided, what was decided wrongly, clock errors left at
        `time`; None without the stages."""
        e = self.establishment
        if e is None:
            return None
        links = {}
        for (tx, rx), state in e.links.items():
            left = self.apart(tx, (tx, rx), time)
            known = state.clock is not None
            links[f"{tx}->{rx}"] = {
                "identified": state.identified,
                "acknowledged": state.acknowledged,
                "clock_error_s": left.offset if known else None,
                "clock_error_std_s": self.offset_std((tx, rx), time) if known else None,
                "drift_error": left.drift if known else None,
            }
        return {
            "blocks": e.blocks,
            "links": links,
            "missed_blocks": e.missed_blocks,
            "false_blocks": e.false_blocks,
            "missed_announcements": e.missed_announcements,
            "wrong_announcements": e.wrong_announcements,
            "missed_acknowledgments": e.missed_acknowledgments,
            "false_acknowledgments": e.false_acknowledgments,
            "frames": e.num_frames,
            "duration_s": e.duration,
        }


def connect(
    scenario: Scenario,
    waveform: Waveform,
    antennas: Antennas,
    schedule: Schedule,
    scene: Scene,
    noise_power: Callable[[Link], float],
) -> Connections:
    """Go through the stages before the data if the scenario asks for them; the last of their frames
    ends by the first of the run's.

    Parameters
    ----------
    scene : poses and paths at any time, before 0 too
    noise_power : of a link's samples [W]
    """
    swarm = scenario.swarm
    active = [name for name, uav in swarm.items() if uav.role == "active"]
    passive = [name for name, uav in swarm.items() if uav.role == "passive"]
    external = scenario.access.synchronisation == "external"
    clocks = (
        {}
        if external
        else {
            name: Clock(swarm[name].clock_offset_s, swarm[name].clock_drift_ppm * 1e-6)
            for name in active + passive
        }
    )
    if not scenario.access.establish:
        return Connections(clocks)
    sweeps, answers = (
        len(scan(waveform.num_resource_blocks, waveform.num_groups)),
        -(-len(passive) // waveform.num_groups),
    )
    longest = len(active) * (2 * sweeps + 1 + 2 * answers) * waveform.frame_duration
    network = Network(
        waveform=waveform,
        antennas=antennas,
        schedule=schedule,
        receivers=scenario.receivers,
        scene=scene,
        wishes=scenario.first_blocks(),
        listeners={name: tuple(passive) for name in active},
        noise_power={name: noise_power((name, name)) for name in active}
        | {name: noise_power((active[0], name)) for name in passive},
        seed=scenario.seed,
        clocks=clocks,
        amplitude=transmit_amplitude(scenario.noise),
        external_clock=scenario.access.synchronisation != "two_round",
        dpsk_order=scenario.modulation.dpsk_order,
        start=-longest,
    )
    return Connections(clocks, establish(network))
