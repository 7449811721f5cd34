"""Coverage of a radar: limits in range, velocity and angle by link, and frames in which UAVs are
outside them.

A receiver's maps hold N/2 range cells, or all N of a plain radar. Paths within them pass the IF
filter in every chirp, for any data symbol; half a cell farther a passive terminal finds no line of
sight and loses every symbol. From there to N cells the filter passes only chirps with small enough
symbols, and beyond N cells (the delay T_d) none. Occlusion by the city is not considered: it is
known only after tracing. Clocks are assumed to agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isac_rt.frame.antennas import Antennas, Arrays, resolutions
from isac_rt.frame.link import Link
from isac_rt.frame.schedule import unambiguous_share
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.cfar import first_row
from isac_rt.receive.settings import Receivers
from isac_rt.world.swarm import Swarm

MOST_FRAMES = 1_000
"""Largest number of frames that are tested; longer runs are sampled evenly."""


@dataclass(frozen=True, kw_only=True)
class LinkCoverage:
    """Coverage of one link's receiver.

    Attributes
    ----------
    link : "TX->RX"
    slot_s, frame_s : duration of a chirp of each group, and of a frame
    max_range_m : largest range of the maps, with data and without: one way for an echo at an active
        terminal, the length of a path at a passive one
    filtered_range_m : range beyond which the IF filter stops a path in every chirp
    min_range_m : range below which detections are discarded, lines of sight of pilots included
    range_resolution_m, velocity_resolution_mps : one cell of the map
    max_velocity_mps : unambiguous velocity; faster ones are reported a period off
    azimuth_resolution_deg, elevation_resolution_deg : wavelength over aperture, at broadside; None
        where the array does not observe them
    field_of_view_deg : to each side of the boresight
    unambiguous_angle_deg : to each side; directions beyond it alias
    bit_rate_bps : mean to the end of the last frame, pilots and pauses in; None for echoes
    """

    link: str
    slot_s: float
    frame_s: float
    max_range_m: float
    filtered_range_m: float
    min_range_m: float
    range_resolution_m: float
    velocity_resolution_mps: float
    max_velocity_mps: float
    azimuth_resolution_deg: float | None
    elevation_resolution_deg: float | None
    field_of_view_deg: float
    unambiguous_angle_deg: float
    bit_rate_bps: float | None


@dataclass(frozen=True, kw_only=True)
class Outside:
    """Numbers of frames in which a UAV is outside the coverage of a link, by the first cause.

    Attributes
    ----------
    link : "TX->RX"
    uav : reflector, or the transmitter, whose line of sight carries the data
    frames : tested
    out_of_view : outside the field of view of the receiver or of the transmitter
    beyond_range, too_near : outside `LinkCoverage.max_range_m` or `min_range_m`
    too_fast : over `LinkCoverage.max_velocity_mps`: detected at an aliased velocity
    """

    link: str
    uav: str
    frames: int
    out_of_view: int
    beyond_range: int
    too_near: int
    too_fast: int

    @property
    def unseen(self) -> int:
        """Number of frames in which no detection is possible."""
        return self.out_of_view + self.beyond_range + self.too_near


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Coverage of all links, with the time scales of a run; `outside` has the rows with a frame
    outside."""

    frame_interval_s: float
    links: tuple[LinkCoverage, ...]
    outside: tuple[Outside, ...]


def coverage(
    swarm: Swarm, timetable: Timetable, arrays: Arrays, receivers: Receivers, schedule: str
) -> Coverage:
    """Return the coverage of every link of a run, and the part of the swarm outside it.

    Parameters
    ----------
    swarm, timetable, arrays : of the run
    receivers : for `min_range_m` and `velocity_method`
    schedule : ``array.schedule``
    """
    step = max(1, -(-timetable.frames // MOST_FRAMES))
    frames = range(0, timetable.frames, step)
    flights = _flights(swarm, [timetable.epoch(f) for f in frames])
    received = [set(timetable.links(f)) for f in frames]
    links, outside = [], []
    for link in timetable.all_links:
        here = np.array([link in of_frame for of_frame in received])
        seen = _link_coverage(link, timetable, arrays.at(link), receivers, schedule)
        links.append(seen)
        flown = {name: flight.at(here) for name, flight in flights.items()}
        rows = (_outside(link, name, flown, arrays, seen) for name in flown if name != link.rx)
        outside += [row for row in rows if row.unseen or row.too_fast]
    return Coverage(frame_interval_s=timetable.interval, links=tuple(links), outside=tuple(outside))


def unambiguous_velocity(
    link: Link, timetable: Timetable, velocity_method: str, schedule: str
) -> float:
    """Return the largest unambiguous radial speed of a link [m/s]: that of one chirp per slot,
    divided by the number of transmit antennas if each is processed alone and sends periodically."""
    w = timetable.waveform
    if not w.carries_data:
        return w.max_velocity(link.passes) * unambiguous_share(w)
    groups = len(timetable.groups(link) or range(w.num_groups))
    whole = schedule == "pseudo_random" or (
        groups == w.num_tx and velocity_method != "conventional"
    )
    return w.max_velocity(link.passes) / (1 if whole else w.num_tx)


def _link_coverage(
    link: Link, timetable: Timetable, antennas: Antennas, receivers: Receivers, schedule: str
) -> LinkCoverage:
    w, passes = timetable.waveform, link.passes
    cell, velocity, across, up = resolutions(w, antennas, passes).tolist()
    sideways, upwards = antennas.observes(passes)
    unambiguous_span = antennas.cosine_period(SPEED_OF_LIGHT / float(w.carrier()), passes)[0]
    return LinkCoverage(
        link=str(link),
        slot_s=w.slot_duration,
        frame_s=w.frame_duration,
        max_range_m=w.num_range_cells * cell,
        filtered_range_m=w.num_samples * cell,
        min_range_m=first_row(receivers, cell) * cell,
        range_resolution_m=cell,
        velocity_resolution_mps=velocity,
        max_velocity_mps=unambiguous_velocity(link, timetable, receivers.velocity_method, schedule),
        azimuth_resolution_deg=_degrees(across) if sideways else None,
        elevation_resolution_deg=_degrees(up) if upwards else None,
        field_of_view_deg=float(np.degrees(antennas.half_view)),
        unambiguous_angle_deg=_degrees(unambiguous_span / 2),
        bit_rate_bps=None if link.own else _bit_rate(link, timetable),
    )


def _degrees(sine: float) -> float:
    return float(np.degrees(np.arcsin(min(sine, 1.0))))


def _bit_rate(link: Link, timetable: Timetable) -> float:
    groups, order = timetable.groups(link), timetable.modulation.dpsk_order
    w = timetable.waveform if groups is None else timetable.waveform.of_groups(groups)
    frames, after_first = timetable.frames, (timetable.frames - 1) * timetable.interval
    carried = sum(timetable.modulated(f) for f in range(frames) if link in timetable.links(f))
    return w.payload_bits(order) * carried / (after_first + w.frame_duration)


class _Flight(NamedTuple):
    """Positions and velocities (T, 3) of a UAV, and its axes (T, 3, 3)."""

    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray

    def at(self, frames: np.ndarray) -> _Flight:
        return _Flight(*(values[frames] for values in self))


def _flights(swarm: Swarm, epochs: list[float]) -> dict[str, _Flight]:
    out = {}
    for name, flight in swarm.trajectories.items():
        poses = [flight.pose(t) for t in epochs]
        states = [[p.position, p.velocity, p.rotation] for p in poses]
        out[name] = _Flight(*(np.array(values) for values in zip(*states, strict=True)))
    return out


def _segment(start: _Flight, end: _Flight, antennas: Antennas) -> tuple[np.ndarray, ...]:
    """Return the length (T,) of the segment between two UAVs, its rate, and a mask of the frames in
    which the end is in the field of view of the start."""
    offset = end.position - start.position
    length = np.linalg.norm(offset, axis=1)
    towards = offset / length[:, None]
    rate = (towards * (end.velocity - start.velocity)).sum(axis=1)
    return length, rate, antennas.in_view(np.einsum("ti,tij->tj", towards, start.rotation))


def _outside(
    link: Link, name: str, flights: dict[str, _Flight], arrays: Arrays, of: LinkCoverage
) -> Outside:
    tx, rx, uav = (flights[n] for n in (link.tx, link.rx, name))
    length, rate, in_view = _segment(rx, uav, arrays.of(link.rx))
    if name == link.tx:  # the line of sight
        in_view &= _segment(tx, rx, arrays.of(link.tx))[2]
    elif not link.own:
        first, first_rate, lit = _segment(tx, uav, arrays.of(link.tx))
        length, rate, in_view = length + first, rate + first_rate, in_view & lit
    half = of.range_resolution_m / 2  # a path belongs to the nearest row
    far, near = length >= of.max_range_m - half, length < of.min_range_m - half
    return Outside(
        link=of.link,
        uav=name,
        frames=len(length),
        out_of_view=int((~in_view).sum()),
        beyond_range=int((in_view & far).sum()),
        too_near=int((in_view & near).sum()),
        too_fast=int((in_view & ~far & ~near & (np.abs(rate) > of.max_velocity_mps)).sum()),
    )
