"""The swarm talks: after every frame terminals take down their tracks, receive what the links
carried, and send the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from isac_rt.extensions.city_receivers.ghosts import occluded_by
from isac_rt.extensions.cooperation.fusion import JOIN_PROBABILITY, Detection, FusedTracks
from isac_rt.extensions.cooperation.messages import CODE_RATE, CORRECTED, Channel, Notes, SelfReport
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.plain import Stateful
from isac_rt.propagation.free_space import radar_amplitude
from isac_rt.propagation.rcs import SMALL_MEAN_DBSM
from isac_rt.results.losses import Sensitivity
from isac_rt.results.metrics import SymbolCount
from isac_rt.results.records import LateRecord
from isac_rt.results.scoring import LinkResult
from isac_rt.results.swarm import SWARM, Traffic, View
from isac_rt.simulation.setup import Setup
from isac_rt.simulation.stations import PREFETCHED_FRAMES
from isac_rt.track import existence
from isac_rt.track.filter import Ambiguity, Gaussian, costs, expected, predict, wrapped
from isac_rt.track.fused import Fused, Key, Name
from isac_rt.track.parts import ReportedUav, of_itself
from isac_rt.track.reference import TerminalState
from isac_rt.track.tracker import Track, in_plane
from isac_rt.world.swarm import Pose

MASKED_CELLS = 3.0
"""An echo that comes no more range cells than this behind a passive terminal's line of sight is
pushed away from it: by the line's sidelobes, and by what is left where these were taken out."""
PULL = 0.5
"""Range cells of that push, which is alike from frame to frame."""
CHANCE = 0.02
"""Share of the frames in which an active terminal detects something where there is no UAV but an
artefact of passive ones: none in 39 of two cities, so that (0 + 1) / (39 + 2) is expected."""


class Record(NamedTuple):
    """Log-odds that a UAV exists by the frames in which an active terminal should have detected it,
    and how many of these `frames` were `hits`."""

    odds: float = 0.0
    hits: int = 0
    frames: int = 0

    def after(self, probability: float, hit: bool) -> Record:
        """Return the record after a frame with a probability of detection by noise alone. What
        clutter leaves of it is between 0 and 1 alike, so that its mean is (hits + 1) / (frames + 2)
        (Laplace's rule of succession)."""
        odds = existence.updated(self.odds, hit, self.hits, self.frames, probability, CHANCE)
        odds = max(odds, self.odds) if hit else odds
        return Record(odds, self.hits + hit, self.frames + 1)


@dataclass
class Talk:
    """Messages on their way between terminals, and what each knew.

    Attributes
    ----------
    channels : by way
    known : by frame its time [s], and by link the UAVs that its receiver knew of then from others
    records : of the swarm's UAVs, by name and active terminal
    """

    channels: dict[Link, Channel] = field(default_factory=dict)
    known: dict[int, tuple[float, dict[Link, list[ReportedUav]]]] = field(default_factory=dict)
    records: dict[tuple[Name, Link], Record] = field(default_factory=dict)


class Cooperation(Stateful):
    """The terminals of one set of receivers, with what each knows."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        links = setup.timetable.all_links
        self._names = list(dict.fromkeys(link.rx for link in links))
        s = setup.scenario
        self._notes = {name: Notes(name) for name in [*self._names, SWARM]}
        self._acceleration = s.tracking.acceleration_std_mps2
        origins = [str(link) for link in links]
        self._fused = {
            name: FusedTracks(self._names, origins, self._acceleration) for name in self._notes
        }
        self.state = Talk()
        self._feedback = int(s.access.feedback_rate_bps * setup.timetable.interval)

    @property
    def parts(self) -> Mapping[str, Stateful | None]:
        notes = {f"notes of {name}": notes for name, notes in self._notes.items()}
        return notes | {f"fused {name}": fused for name, fused in self._fused.items()}

    def step(
        self,
        frame: int,
        received: Mapping[Link, LinkResult],
        symbols: Mapping[Link, SymbolCount],
        late: Mapping[Link, Sequence[LateRecord]],
    ) -> dict[str, View]:
        """The set of fused tracks after a frame, by terminal, and under `SWARM` what all of them
        know together, as if links took no time and lost nothing.

        Parameters
        ----------
        received : what the links' receivers made of the frame
        symbols : what was sent to them and became of it; their checksums say as much
        late : earlier frames that they read only now
        """
        timetable = self._setup.timetable
        time = max(timetable.epoch(frame, tx) for tx in timetable.with_role("active", frame))
        traffic = self._carry(frame, received, symbols)
        self._carry_late(late, traffic)
        poses = {n: self._setup.believed(n, p) for n, p in self._setup.swarm.poses(time).items()}
        for name in self._names:
            for notes in (self._notes[name], self._notes[SWARM]):
                notes.terminals[name] = SelfReport(time, of_itself(poses[name]))
        for link, result in received.items():
            self._observe(frame, link, result)
        views = {
            name: View(time, self._fuse(name, time), notes.ages(time), traffic[name])
            for name, notes in self._notes.items()
        }
        views[SWARM] = View(time, self._existing(views[SWARM].fused, frame, poses, received))
        links = self._setup.timetable.all_links
        known = self.state.known | {
            frame: (time, {link: self._reported_uavs(link, views[link.rx], time) for link in links})
        }
        self.state.known = {k: v for k, v in known.items() if k > frame - PREFETCHED_FRAMES}
        self._send(frame)
        return views

    def _fuse(self, name: str, time: float) -> tuple[Fused, ...]:
        """Return the fused tracks of a terminal at a time [s], and let it know the UAVs by their
        names."""
        notes = self._notes[name]
        notes.forget(time)
        keys, detections = notes.of_tracks()
        known = {
            other: self._coasted(s.state, time - s.time) for other, s in notes.terminals.items()
        }
        fused = self._fused[name].update(time, detections, keys, known)
        notes.names |= {key: uav.name for uav in fused for key in uav.members}
        return tuple(fused)

    def _coasted(self, state: Gaussian, interval: float) -> Gaussian:
        """Return a position and velocity (6,) after an interval [s], of an unknown acceleration."""
        g = predict(Track.of_state(state, self._acceleration).state, interval, self._acceleration)
        return Gaussian(g.mean[:6], g.covariance[:6, :6])

    def _reported_uavs(self, link: Link, view: View, time: float) -> list[ReportedUav]:
        """Return the targets that the receiver of a link knows of from others: terminals but its
        ends, by their reports, and fused tracks that are none of these nor of this link alone."""
        terminals = [
            ReportedUav(other, self._coasted(s.state, time - s.time))
            for other, s in self._notes[link.rx].terminals.items()
            if other not in link
        ]
        others = (b for b in view.fused if {key.origin for key in b.members} - {str(link)})
        return terminals + [ReportedUav("", b.state) for b in others if b.terminal is None]

    def reports(self, link: Link, frame: int, time: float) -> list[ReportedUav]:
        """The UAVs that a link's receiver knew of after a frame, at a time [s]; none where the
        frame is not remembered."""
        then, known = self.state.known.get(frame, (time, {}))
        return [
            uav._replace(state=self._coasted(uav.state, time - then)) for uav in known.get(link, [])
        ]

    def _existing(
        self,
        fused: Sequence[Fused],
        frame: int,
        poses: Mapping[str, Pose],
        received: Mapping[Link, LinkResult],
    ) -> tuple[Fused, ...]:
        """Return the swarm's UAVs without those that active terminals should have detected and did
        not, and those of passive terminals alone that none lights. Errors near the line of sight
        and over unknown paths are larger than known: most of these are doubles of another."""
        records, odds = self.state.records, {uav.name: 0.0 for uav in fused}
        for link in received:
            if not link.own:
                continue
            hits = self._hits(fused, link, received[link], poses[link.rx])
            for uav, hit in zip(fused, hits, strict=True):
                record, place = records.get((uav.name, link), Record()), uav.state.mean[:3]
                tracked = str(link) in {key.origin for key in uav.members}
                p = 1.0 if tracked else self._detection_probability(link, place, frame, poses)
                if p > 0:
                    records[uav.name, link] = record.after(p, tracked or bool(hit))
        holds = self._setup.timetable.holds  # an active terminal may skip a frame
        records = {k: r for k, r in records.items() if k[0] in odds and holds(k[1], frame)}
        for (name, _), record in records.items():
            odds[name] += record.odds
        self.state.records = records
        own = {str(link) for link in self._setup.timetable.all_links if link.own}
        active = self._setup.timetable.with_role("active", frame)

        def is_lit(uav: Fused) -> bool:
            by_active = not own.isdisjoint(key.origin for key in uav.members)
            return by_active or any(self._lights(name, uav, poses[name]) for name in active)

        return tuple(u for u in fused if u.terminal or (odds[u.name] >= 0 and is_lit(u)))

    def _hits(
        self, fused: Sequence[Fused], link: Link, received: LinkResult, own: Pose
    ) -> np.ndarray:
        """Return by UAV whether one of a frame's detections is more likely its own than another
        UAV's."""
        found = in_plane(received.reception.detections)
        if not fused or not len(found):
            return np.zeros(len(fused), bool)
        means, covariances = (
            np.array(of) for of in zip(*(uav.state for uav in fused), strict=True)
        )
        ambiguity = Ambiguity.of(self._setup.of(link.tx).waveform, link.passes)
        z = *expected(means, covariances, own), ambiguity, JOIN_PROBABILITY
        cost = costs(found.measured, found.std, *z)
        return (np.isfinite(cost) & (cost == cost.min(axis=0))).any(axis=1)

    def _detection_probability(
        self, link: Link, place: np.ndarray, frame: int, poses: Mapping[str, Pose]
    ) -> float:
        """Return the probability that an active terminal detects a small UAV at a place: 0 outside
        its range or field of view and where it is occluded, else by the radar equation in noise."""
        s, pose = self._setup.of(link.tx), poses[link.rx]
        w, antennas = s.waveform, s.arrays.of(link.rx)
        distance = float(np.linalg.norm(place - pose.position))
        towards = pose.to_body((place - pose.position) / distance)
        far = distance > w.num_range_cells * w.range_cell(2)
        if far or not antennas.in_view(towards) or s.walls.blocking(pose.position, place).size:
            return 0.0
        section = 10 ** (SMALL_MEAN_DBSM / 10)
        amplitude = radar_amplitude(w.wavelength, section, distance, distance)
        sent, noise = s.transmission(link.tx, frame, pose), s.noise_power(dict(poses), link)
        sees = Sensitivity.of(
            w, antennas, s.scenario.receivers, sent, noise, w.num_groups, own=True
        )
        return sees.clutter_free(
            float((amplitude * antennas.element_gain(towards)) ** 2 * sees.cell)
        )

    def _lights(self, name: str, uav: Fused, pose: Pose) -> bool:
        """Return whether an active terminal sends towards a UAV, and no wall hides its place."""
        s, place = self._setup.of(name), uav.state.mean[:3]
        towards = (place - pose.position) / np.linalg.norm(place - pose.position)
        sends = s.arrays.of(name).element_gain(pose.to_body(towards)) > 0
        P, cell = uav.state.covariance[:3, :3], s.waveform.range_cell(2)
        return bool(sends) and occluded_by(place, P, [pose.position], s.walls, cell) < 0

    def _observe(self, frame: int, link: Link, received: LinkResult) -> None:
        """A terminal takes down what the tracks of one of its links detected."""
        setup, tracks = self._setup.of(link.tx), received.tracks
        time, w = setup.timetable.epoch(frame, link.tx), setup.waveform
        own, there = (setup.believed(n, setup.swarm.trajectories[n].pose(time)) for n in link[::-1])
        tracks = tracks.select(~tracks.is_reference)
        hit = tracks.select(tracks.detection >= 0)
        found = in_plane(received.reception.detections).select(hit.detection)
        ambiguity = Ambiguity.of(w, link.passes)
        z = hit.measured + wrapped(found.measured - hit.measured, ambiguity)
        transmitter, bias = np.zeros(0), np.zeros(len(z))
        if not link.own:
            transmitter, cell = of_itself(there).mean, w.range_cell(1)
            behind = z[:, 0] - np.linalg.norm(there.position - own.position)
            clock = SPEED_OF_LIGHT * setup.connections.offset_std(link, time)
            bias = np.hypot(clock, PULL * cell * (behind < MASKED_CELLS * cell))
        detections = [
            Detection(
                Key(str(link), n), time, Name(time, str(link), n), time, own, transmitter, *of
            )
            for n, *of in zip(hit.ids.tolist(), bias.tolist(), z, found.std, strict=True)
        ]
        for notes in (self._notes[link.rx], self._notes[SWARM]):
            notes.observe(str(link), time, detections, tracks.ids[tracks.confirmed].tolist())

    def _capacities(self, frame: int) -> dict[Link, int]:
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
        self, frame: int, received: Mapping[Link, LinkResult], symbols: Mapping[Link, SymbolCount]
    ) -> dict[str, Traffic]:
        """Let a frame pass over all channels; how many messages came to each terminal, and how many
        were lost."""
        came = dict.fromkeys(self._notes, Traffic())
        for link, capacity in self._capacities(frame).items():
            channel = self.state.channels.setdefault(link, Channel())
            if link in received:
                read = received[link].reception.decoded and _corrected(symbols[link])
            else:
                read = received[Link(link.rx, link.tx)].state == TerminalState.TRACKING
            came[link.rx] += Traffic(capacity=capacity)
            done = channel.carry(frame, capacity, read)
            if done is not None:
                message, arrived = done
                came[link.rx] += Traffic(
                    1, not arrived, bits=message.bits, left_out=message.left_out
                )
                if arrived:
                    self._notes[link.rx].receive(message)
        return came

    def _carry_late(
        self, late: Mapping[Link, Sequence[LateRecord]], came: dict[str, Traffic]
    ) -> None:
        """Add to `came` what arrives with frames that were read late."""
        for link, records in late.items():
            for one in records:
                if link in self.state.channels and _corrected(one.symbols):
                    for message in self.state.channels[link].late(one.frame):
                        came[link.rx] += Traffic(late=1)
                        self._notes[link.rx].receive(message)

    def _send(self, frame: int) -> None:
        """Put new messages on the channels that are free; channels between terminals that have no
        link any more are closed."""
        if frame + 1 >= self._setup.timetable.frames:
            return
        capacities = self._capacities(frame + 1)
        self.state.channels = {
            link: self.state.channels.get(link, Channel()) for link in capacities
        }
        for link, channel in self.state.channels.items():
            if channel.message is None and capacities[link] > 0:
                channel.send(self._notes[link.tx].compose(link.rx, capacities[link]))


def _corrected(count: SymbolCount) -> bool:
    """Return whether the code of a frame that was read corrects its errors."""
    return count.bit_errors <= CORRECTED * count.bits_total
