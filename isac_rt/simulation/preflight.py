"""Checks before a run: memory, collisions between UAVs and with the city, and coverage."""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from isac_rt.document import ScenarioError, ScenarioWarning
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.settings import Noise
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.settings import Clutter
from isac_rt.registry import extension
from isac_rt.runtime import available_memory
from isac_rt.scenario.tree import NEAREST_M
from isac_rt.simulation.coverage import Coverage, Outside, unambiguous_velocity
from isac_rt.world.city.georeference import local_origin
from isac_rt.world.city.mesh import CityMesh, empty_city
from isac_rt.world.city.meshfiles import point_in_file
from isac_rt.world.passage import TOUCH_M, enclosed, first_passage, hits, obstacles
from isac_rt.world.settings import City
from isac_rt.world.swarm import Pose, Swarm

SAMPLE_BYTES = 8
RECORD_BYTES = 2e4
"""Bound of the record of a link's frame; measured: 4 kB with few detections and tracks."""
PROGRAM_BYTES = 4e8
"""Interpreter, libraries and a small city, measured: 0.35 GB after the first frame of
scenes/paper_swarm.yaml."""
COPY_BYTES = 550
"""Path to a point of a blade in one slot, with its tone; measured on scenes/quadcopter.yaml."""
MOST_EPOCHS = 4_000
ALIAS_EPOCHS = 50


def memory_needed(
    waveform: Waveform, antennas: Antennas, frames: int, links: int, at_once: int
) -> float:
    """Estimate a run's memory [bytes], without the city's mesh and its clutter.

    Each active receiver holds its cube, a derotated copy, range spectra and Doppler maps; each
    frame of a link adds a record."""
    w = waveform
    chirps = w.num_groups * w.num_chirps
    cube = chirps * antennas.num_rx * w.num_samples
    maps = antennas.num_tx * antennas.num_rx * w.num_chirps * w.num_samples / 2
    at_work = SAMPLE_BYTES * min(links, at_once) * (2.5 * cube + maps)
    return PROGRAM_BYTES + at_work + frames * links * RECORD_BYTES


def receivers_at_work() -> int:
    """Return the number of receiver threads: one more than cores, as one may wait for the
    interpreter."""
    return (os.cpu_count() or 1) + 1


def copies_needed(swarm: Swarm, waveform: Waveform) -> int:
    """Return the number of paths to points of blades in a frame of a link with one path to each
    UAV: one for each point in each slot."""
    with_rotors = [uav.rotors for uav in swarm.uavs.values() if uav.rotors is not None]
    return waveform.num_chirps * sum(
        extension("points_of_rotors")(rotors, waveform) for rotors in with_rotors
    )


def check_memory(arrays: Arrays, timetable: Timetable, swarm: Swarm) -> None:
    """Refuse a run that exceeds the free memory.

    Raises
    ------
    ScenarioError  With the estimate and the free memory.
    """
    free, links = available_memory(), len(timetable.all_links)
    at_work = receivers_at_work()
    needed = max(
        memory_needed(timetable.waveform, antennas, timetable.frames, links, at_work)
        for antennas in arrays
    )
    copies = copies_needed(swarm, timetable.waveform) * COPY_BYTES * min(links, at_work)
    needed += copies
    if free is not None and needed > free:
        shorter = f", or shorten blades of rotors ({copies / 1e9:.3g} GB)" if copies else ""
        raise ScenarioError(
            f"the run would need about {needed / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are "
            "free; lower radio.samples_per_chirp, radio.chirps_per_frame, array.rx_x, array.rx_z "
            f"or frames{shorter}"
        ) from MemoryError()


def check_flights(swarm: Swarm, timetable: Timetable) -> None:
    """Refuse flights on which two UAVs meet or coordinates overflow float64. Long runs are checked
    every n-th frame.

    Raises
    ------
    ScenarioError
    """
    _check_times(swarm, timetable)
    step = max(1, timetable.frames // MOST_EPOCHS)
    epochs = np.array([timetable.epoch(frame) for frame in range(0, timetable.frames, step)])
    with np.errstate(over="ignore", invalid="ignore"):
        polylines = {
            name: np.array([flight.pose(t).position for t in epochs])
            for name, flight in swarm.trajectories.items()
        }
    for name, polyline in polylines.items():
        if not np.isfinite(polyline).all() or np.abs(polyline).max() > 1e12:
            raise ScenarioError(
                f"swarm.{name}: flies beyond all bounds; lower its velocity, or the time between "
                "its waypoints"
            )
    for (a, first), (b, second) in itertools.combinations(polylines.items(), 2):
        distance = np.linalg.norm(first - second, axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] < NEAREST_M:
            raise ScenarioError(
                f"swarm.{b}: is {distance[nearest]:.2g} m from {a} at {epochs[nearest]:.4g} s "
                f"(frame {nearest * step}), at least "
                f"{NEAREST_M:g} m are needed; change one of their flights"
            )
        _check_box(swarm, epochs, (a, b), second - first)
        _check_box(swarm, epochs, (b, a), first - second)


def _check_box(
    swarm: Swarm, epochs: np.ndarray, names: tuple[str, str], offset: np.ndarray
) -> None:
    """Refuse flights on which the second of two UAVs, `offset` (T, 3) from the first, is in its
    box."""
    name, inner = names
    if (box := swarm.uavs[name].box) is None:
        return
    solid = extension("solid_of_box")(name, box)
    for i in np.flatnonzero(np.linalg.norm(offset, axis=1) < solid.reach):
        pose = swarm.trajectories[name].pose(epochs[i])
        if (solid.depths(pose.to_body(offset[i])) >= 0).all():
            raise ScenarioError(
                f"swarm.{inner}: is inside the box of {name} at {epochs[i]:.4g} s; change one of "
                "their flights, or the box"
            )


def _check_times(swarm: Swarm, timetable: Timetable) -> None:
    """Refuse waypoints outside the time of the run, and warn of those that cover a part of it."""
    begin, end = timetable.epoch(0), timetable.epoch(timetable.frames - 1)
    for name, uav in swarm.uavs.items():
        if uav.waypoints is None:
            continue
        first, last = uav.waypoints[0].time_s, uav.waypoints[-1].time_s
        message = (
            f"swarm.{name}: its waypoints are from {first:g} to {last:g} s, the run is from "
            f"{begin:.3g} to {end:.3g} s"
        )
        if first > end or last < begin:
            raise ScenarioError(f"{message}; count time_s from the start of the run")
        if max(first - begin, end - last) > timetable.interval:
            _warn(f"{message}; it flies straight on before and after them")


def check_passage(swarm: Swarm, timetable: Timetable, city: CityMesh) -> None:
    """Refuse UAVs that begin inside a building or under the ground, or fly through a surface.

    Parameters
    ----------
    city : the whole city; the part beyond the reach may be the ground under a target

    Raises
    ------
    ScenarioError
    """
    begin, end = timetable.epoch(0), timetable.epoch(timetable.frames - 1)
    starts = np.array([flight.pose(begin).position for flight in swarm.trajectories.values()])
    inside = [enclosed(city, start) for start in starts - city.origin]
    solid = obstacles(city, starts - city.origin) if any(inside) else empty_city("", city.origin)
    remedy = ", or turn the faces of a room inward" if all(inside) else ""
    for name, flight in swarm.trajectories.items():
        times, points = flight.polyline(begin, end)
        polyline = points - city.origin
        keys = "waypoints" if swarm.uavs[name].waypoints else "position_m or velocity_mps"
        if enclosed(solid, polyline[0]):
            up = np.array([1e-5, 2e-5, 1.0]) * (city.bounds()[1][2] + 1 - polyline[0, 2])
            shares = hits(city.corners, polyline[0], polyline[0] + up)[1]
            roof = points[0, 2] + up[2] * shares.max(initial=0.0)
            raise ScenarioError(
                f"swarm.{name}: starts inside a building of {city.name} or under its ground, at "
                f"{_said(points[0])} m, under a surface at {roof:.1f} m; change its {keys}{remedy}"
            )
        found = first_passage(city, _off_the_ends(polyline))
        if found is not None:
            a, b = found.segment, found.segment + 1
            when = times[a] + found.share * (times[b] - times[a])
            where = points[a] + found.share * (points[b] - points[a])
            made_of = city.materials[city.face_material[found.face]].name
            raise ScenarioError(
                f"swarm.{name}: flies through a surface of {city.name} ({made_of}) at {when:.3g} s "
                f"(frame {int(when / timetable.interval)}), at {_said(where)} m; change its {keys}"
            )


def check_reach(settings: City | None, city: CityMesh, reach: float) -> None:
    """Refuse a city out of reach, and warn of doubts about it.

    Parameters
    ----------
    city : the whole city, about the middle of the flights
    reach : distance from there beyond which no surface contributes [m]

    Raises
    ------
    ScenarioError
    """
    for doubt in city.doubts:
        _warn(f"city: {doubt}")
    if settings is None or not city.num_faces or city.within(reach).num_faces:
        return
    low, high = city.bounds() + city.origin
    message = (
        f"city: nothing of {city.name} is within {reach:.0f} m of the middle of the flights, "
        f"{_said(city.origin)} m; it reaches from {_said(low)} to {_said(high)} m"
    )
    if ((low <= city.origin) & (city.origin <= high))[:2].all():
        return _warn(f"{message}; fly lower")
    point, where = np.append((low + high)[:2] / 2, low[2]), ""
    if settings.source == "mesh":
        where = _said(point_in_file(settings, Path(settings.file or ""), point))
    elif city.georeference is not None:
        where = str(list(local_origin(city.georeference, point)))
    origin = "state the point of the file that becomes the world's origin, such as city.origin: "
    raise ScenarioError(f"{message}; {f'{origin}{where}, or ' if where else ''}move the swarm")


def _off_the_ends(polyline: np.ndarray) -> np.ndarray:
    """Shorten a polyline (T, 3) by `TOUCH_M` at both ends, at most to a point."""
    out = polyline.copy()
    for end, inner in ((0, 1), (-1, -2)) if len(out) > 1 else ():
        step = polyline[inner] - polyline[end]
        length = float(np.linalg.norm(step))
        out[end] += step * min(TOUCH_M / length, 0.5) if length else 0.0
    return out


def _said(position: np.ndarray) -> str:
    return "[" + ", ".join(f"{value:.1f}" for value in position) + "]"


def warn_of_aliases(
    swarm: Swarm, timetable: Timetable, arrays: Arrays, velocity_method: str, schedule: str
) -> None:
    """Warn of UAVs in the field of view beyond the unambiguous velocity: their velocity aliases by
    a period, and the time offsets of groups give weak further detections.

    Checks echoes at active terminals and lines of sight, in `ALIAS_EPOCHS` frames of the run.

    Parameters
    ----------
    velocity_method, schedule : ``receivers.velocity_method`` and ``array.schedule``
    """
    frames = np.unique(np.linspace(0, timetable.frames - 1, ALIAS_EPOCHS).round().astype(int))
    poses = [swarm.poses(timetable.epoch(int(frame))) for frame in frames]
    for link in timetable.all_links:
        tx, rx = link
        limit = unambiguous_velocity(link, timetable, velocity_method, schedule)
        for name in [n for n in swarm.uavs if n != tx] if link.own else [rx]:
            ends = [arrays.of(end) for end in dict.fromkeys(link)]
            rates = np.array([_closing(at[tx], at[name], ends) for at in poses])
            worst = int(np.abs(rates).argmax())
            if abs(rates[worst]) > limit:
                shown = (rates[worst] + limit) % (2 * limit) - limit
                what = f"the echo of {name} at {tx}" if link.own else f"{name} from {tx}"
                warnings.warn(
                    f"{what} moves at {rates[worst]:.4g} m/s (receding is positive) in frame "
                    f"{frames[worst]}, beyond the unambiguous {limit:.4g} m/s: it is reported at "
                    f"about {shown:.3g} m/s, with weaker false detections",
                    ScenarioWarning,
                    stacklevel=3,
                )


def _closing(pose: Pose, other_pose: Pose, ends: list[Antennas]) -> float:
    """Return the range rate of another UAV [m/s]; 0 outside the field of view of the antennas at
    the one end, or at both ends."""
    line = other_pose.position - pose.position
    line = line / np.linalg.norm(line)
    towards = pose.to_body(line), other_pose.to_body(-line)
    seen = all(end.in_view(u) for end, u in zip(ends, towards, strict=False))
    return float((other_pose.velocity - pose.velocity) @ line) if seen else 0.0


def warn_of_interference(
    swarm: Swarm,
    timetable: Timetable,
    arrays: Arrays,
    city: CityMesh,
    budget: tuple[Mapping[str, float], Callable[[dict[str, Pose], Link], float]],
) -> None:
    """Warn of plain radars that receive each other over the noise of a sample: the simulation
    assumes one clock and separate slots.

    Checks direct paths in `ALIAS_EPOCHS` frames of the run; power by Friis' equation with the
    patterns of both antennas.

    Parameters
    ----------
    city : surfaces that block direct paths
    budget : amplitude of one transmit antenna of each terminal [sqrt(W)], and the noise power of a
        sample by poses and link [W]
    """
    w, (amplitudes, noise) = timetable.waveform, budget
    if w.carries_data:
        return
    # of each path: power over the noise, power [W], distance [m], frame
    most: dict[tuple[str, str], tuple[float, ...]] = {}
    for frame in np.unique(np.linspace(0, timetable.frames - 1, ALIAS_EPOCHS).round().astype(int)):
        poses = swarm.poses(timetable.epoch(int(frame)))
        for tx, rx in itertools.permutations(timetable.with_role("active", int(frame)), 2):
            sender, receiver = ((poses[name], arrays.of(name)) for name in (tx, rx))
            power = amplitudes[tx] ** 2 * _direct_gain(sender, receiver, w)
            over = power / noise(poses, Link(rx, rx))
            if over > max(1.0, most[tx, rx][0] if (tx, rx) in most else 0.0):
                ends = np.array([poses[tx].position, poses[rx].position])
                if first_passage(city, _off_the_ends(ends - city.origin)) is None:
                    most[tx, rx] = over, power, float(np.linalg.norm(ends[1] - ends[0])), frame
    if not most:
        return
    (tx, rx), (over, power, distance, frame) = max(most.items(), key=lambda item: item[1][0])
    more = f"; {len(most) - 1} more such paths" if len(most) > 1 else ""
    low, top = w.carrier_frequency / 1e9, (w.carrier_frequency + w.slope * w.chirp_duration) / 1e9
    share = 100 * min(w.max_delay / w.slot_duration, 1.0)
    _warn(
        f"the chirps of {tx} arrive at {rx} with {10 * np.log10(power / 1e-3):.1f} dBm, "
        f"{10 * np.log10(over):.1f} dB over the noise of a sample ({distance:.4g} m, frame "
        f"{frame}{more}), both sweep {low:.5g} to {top:.5g} GHz; the run holds for radars on one "
        f"clock, whose chirps take turns {w.group_spacing * 1e6:.3g} us apart; on clocks of their "
        f"own they interfere, within the receiver's band at {share:.2g} % of the clock offsets; "
        "give one a clock_offset_s, turn or move it, or run each alone"
    )


def warn_of_other_chirps(waveforms: Mapping[str, Waveform]) -> None:
    """Warn of plain radars without a stated power whose different chirps, by name, sweep over the
    same frequencies: a run leaves out their interference."""
    bands = {
        name: (w.carrier_frequency, w.carrier_frequency + w.slope * w.chirp_duration)
        for name, w in waveforms.items()
    }
    pairs = [
        f"{a} and {b}"
        for (a, first), (b, second) in itertools.combinations(bands.items(), 2)
        if max(first[0], second[0]) < min(first[1], second[1])
    ]
    if pairs:
        _warn(
            f"{', '.join(pairs)} sweep over the same frequencies with different chirps or clocks; "
            "the run leaves out that they interfere, for noise.model snr knows no power; take "
            "link_budget"
        )


def _direct_gain(
    sender: tuple[Pose, Antennas], receiver: tuple[Pose, Antennas], waveform: Waveform
) -> float:
    """Return the received power of a direct path over the power of one transmit antenna: Friis'
    equation with the patterns of both elements, times the antennas that send at once."""
    (tx, sending), (rx, receiving) = sender, receiver
    polyline = rx.position - tx.position
    distance = float(np.linalg.norm(polyline))
    sent = float(sending.element_gain(tx.to_body(polyline / distance)))
    received = float(receiving.element_gain(rx.to_body(-polyline / distance)))
    at_once = waveform.num_tx if waveform.bands > 1 else 1
    return at_once * sent * received * (waveform.wavelength / (4 * np.pi * distance)) ** 2


def warn_of_unseen(seen: Coverage) -> None:
    """Warn of terminals whose data are lost, and of UAVs outside all coverage."""
    limits, by_uav = {of.link: of for of in seen.links}, dict[str, list[Outside]]()
    for axis in ("azimuth", "elevation"):
        if blind := [
            link for link in limits if vars(limits[link])[f"{axis}_resolution_deg"] is None
        ]:
            _warn(
                f"{' and '.join(blind)}: the array does not observe {axis}; tracks assume UAVs in "
                "its plane; add elements outside that plane (array.tx, array.rx)"
            )
    for row in seen.outside:
        tx, _, rx = row.link.partition("->")
        if row.uav != tx:
            by_uav.setdefault(row.uav, []).append(row)
        elif row.beyond_range:
            _warn(
                f"{rx} is beyond {limits[row.link].max_range_m:.4g} m from {tx} in "
                f"{row.beyond_range} of {row.frames} frames, where it receives no data; fly it "
                "nearer, raise radio.samples_per_chirp or lower radio.bandwidth_hz"
            )
        elif row.unseen == row.frames:
            _warn(
                f"{tx} is outside the coverage of {rx}, {_causes(row)}: no data are received; "
                "rotate the boresight of one of them, or move it"
            )
    unseen: dict[str, list[str]] = {}
    for name, rows in by_uav.items():
        others = [link for link in limits if link.partition("->")[2] != name]
        if len(rows) == len(others) and all(row.unseen == row.frames for row in rows):
            causes = "; ".join(f"{row.link.replace('->', ' to ')}: {_causes(row)}" for row in rows)
            unseen.setdefault(causes, []).append(name)
    for causes, names in unseen.items():
        _warn(
            f"{', '.join(names)}: outside the coverage of all terminals ({causes}); move or rotate"
        )


def _warn(message: str) -> None:
    warnings.warn(message, ScenarioWarning, stacklevel=4)


def _causes(row: Outside) -> str:
    """Return the causes with the frames of each."""
    counts = {
        "outside the field of view": row.out_of_view,
        "beyond the range": row.beyond_range,
        "too near": row.too_near,
    }
    return ", ".join(f"{cause} in {n} frames" for cause, n in counts.items() if n)


def check_reference(noise: Noise, clutter: Clutter, swarm: Swarm, timetable: Timetable) -> None:
    """Refuse noise or clutter relative to an echo that does not exist.

    Raises
    ------
    ScenarioError
    """
    if noise.model != "snr" and clutter.model != "rayleigh":
        return
    key = "noise.model = snr" if noise.model == "snr" else "clutter.model = rayleigh"
    for name in dict.fromkeys(link.tx for link in timetable.all_links if link.own):
        if not any(n != name and uav.rcs.model != "relative" for n, uav in swarm.uavs.items()):
            raise ScenarioError(
                f"{key} refers to the strongest echo at {name}, and there is no UAV with a "
                "cross-section of its own; add one, or use another model"
            )
