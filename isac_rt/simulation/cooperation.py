"""The swarm talks: after every frame terminals take down their tracks, hear what the links carried,
and send the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from isac_rt.access.messages import CODE_RATE, CORRECTED, Channel, Notes
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.results.metrics import SymbolCount
from isac_rt.results.scoring import Heard
from isac_rt.results.swarm import SWARM, Traffic, View
from isac_rt.simulation.setup import Setup
from isac_rt.terminal.fusion import Picture, in_world, of_itself
from isac_rt.terminal.terminal import TerminalState


class Cooperation:
    """The terminals of one set of receivers, with what each knows."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        links = setup.timetable.all_links
        self._notes = {name: Notes(name) for name in dict.fromkeys(link.rx for link in links)}
        self._swarm = Picture()
        self._channels: dict[Link, Channel] = {}
        s = setup.scenario
        self._acceleration = s.tracking.acceleration_std_mps2
        self._feedback = int(s.access.feedback_rate_bps * setup.timetable.interval)

    def step(
        self, frame: int, heard: Mapping[Link, Heard], symbols: Mapping[Link, SymbolCount]
    ) -> dict[str, View]:
        """The pictures after a frame, by terminal, and under `SWARM` what all of them know
        together, as if links took no time and lost nothing.

        Parameters
        ----------
        heard : what the links' receivers made of the frame
        symbols : what was sent to them and became of it; their checksums say as much
        """
        timetable = self._setup.timetable
        time = max(timetable.epoch(frame, tx) for tx in timetable.with_role("active", frame))
        traffic = self._carry(frame, heard, symbols)
        for link, result in heard.items():
            self._see(frame, link, result)
        poses = {n: self._setup.believed(p) for n, p in self._setup.swarm.poses(time).items()}
        for name, notes in self._notes.items():
            notes.stand(time, of_itself(poses[name]))
        views = {
            name: View(
                time,
                tuple(notes.look(time, self._acceleration)),
                tuple(time - r.time for r, via in notes.reports.values() if via),
                traffic[name],
            )
            for name, notes in self._notes.items()
        }
        own = [r for n in self._notes.values() for r, via in n.reports.values() if not via]
        together = self._swarm.update(
            [report.at(time, self._acceleration) for report in own],
            {name: of_itself(poses[name]) for name in self._notes},
        )
        self._send(frame)
        return {**views, SWARM: View(time, tuple(together))}

    def _see(self, frame: int, link: Link, heard: Heard) -> None:
        """A terminal takes down the confirmed tracks of one of its links."""
        setup, tracks = self._setup, heard.tracks
        time = setup.timetable.epoch(frame, link.tx)
        own = setup.believed(setup.swarm.trajectories[link.rx].pose(time))
        clock = 0.0
        if not link.own:
            clock = SPEED_OF_LIGHT * setup.connections.offset_std(link, time)
        told = (tracks.confirmed & ~tracks.is_reference).nonzero()[0]
        states = {int(tracks.ids[k]): in_world(tracks, int(k), own, clock) for k in told}
        self._notes[link.rx].see(str(link), time, states)

    def _ways(self, frame: int) -> dict[Link, int]:
        """Bits that each way from terminal to terminal has for messages in a frame: an active
        terminal's data frames, and a passive one's feedback."""
        timetable, out = self._setup.timetable, {}
        order = self._setup.scenario.modulation.dpsk_order
        w = timetable.waveform
        for link in timetable.links(frame):
            if link.own:
                continue
            groups = timetable.groups(link)
            count = w.num_groups if groups is None else len(groups)
            bits = w.bits_per_frame(order) * count // w.num_groups
            out[link] = int(CODE_RATE * bits) if timetable.modulated(frame) else 0
            out[Link(link.rx, link.tx)] = self._feedback
        return out

    def _carry(
        self, frame: int, heard: Mapping[Link, Heard], symbols: Mapping[Link, SymbolCount]
    ) -> dict[str, Traffic]:
        """Let a frame pass over all channels; how many messages came to each terminal, and how many
        were lost."""
        came = dict.fromkeys(self._notes, Traffic())
        for way, capacity in self._ways(frame).items():
            channel = self._channels.setdefault(way, Channel())
            if way in heard:
                count = symbols[way]
                read = heard[way].reception.decoded
                read = read and count.bit_errors <= CORRECTED * count.bits_total
            else:
                read = heard[Link(way.rx, way.tx)].state == TerminalState.TRACKING
            done = channel.carry(capacity, read)
            if done is not None:
                message, arrived = done
                came[way.rx] += Traffic(1, not arrived)
                if arrived:
                    self._notes[way.rx].hear(message)
        return came

    def _send(self, frame: int) -> None:
        """Put new messages on the channels that are free; channels between terminals that have no
        link any more are closed."""
        if frame + 1 >= self._setup.timetable.frames:
            return
        ways = self._ways(frame + 1)
        self._channels = {way: self._channels.get(way, Channel()) for way in ways}
        for way, channel in self._channels.items():
            if channel.message is None and ways[way] > 0:
                channel.send(self._notes[way.tx].compose(way.rx, ways[way]))

    def memory(self) -> dict[str, Any]:
        """What is carried over to the next frame as plain numbers and arrays, for `restore`."""
        return {
            "notes": {name: notes.memory() for name, notes in self._notes.items()},
            "swarm": self._swarm.memory(),
            "channels": [[*way, channel.memory()] for way, channel in self._channels.items()],
        }

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on from a `memory`."""
        for name, notes in self._notes.items():
            notes.restore(memory["notes"][name])
        self._swarm.restore(memory["swarm"])
        self._channels = {}
        for tx, rx, kept in memory["channels"]:
            channel = self._channels[Link(tx, rx)] = Channel()
            channel.restore(kept)
