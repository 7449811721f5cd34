"""Error budget of a run: estimates before it, and errors measured against the full model.

Estimates are the largest values of `PILOT_FRAMES` frames spread over the run, times a margin, and
at most the bounds of the plan. Errors are measured on frames drawn at random, against the full
model: all paths, spherical wavefronts at all elements, true positions at the ends of the frame, and
direct synthesis. Missed paths are those that only Sionna's solver finds, with `CHECK_RAYS`."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from isac_rt.frame.cube import IFCube, ReceiveArray, Reference
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.kernels.signal_gridded import GRIDDED_ERROR
from isac_rt.propagation.clutter.cells import Density, error_for
from isac_rt.propagation.clutter.merging import difference_db, resolution_cell
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.segments.geometry import plane_of_each_face, unfold
from isac_rt.randomness import generator
from isac_rt.receive.known import Known
from isac_rt.receive.maps import power_map
from isac_rt.receive.sense import window_gain
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.registry import extension
from isac_rt.results.metrics import decibels
from isac_rt.results.records import Use
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Auto, Direct, Method
from isac_rt.simulation.plan import (
    COUNTS_DB,
    MATTERS_DB,
    extent,
    flight_of_light,
    frame_reach,
    next_slot_delay,
)
from isac_rt.simulation.setup import Frame, Setup, link_budgets, part_of
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose

if TYPE_CHECKING:
    from isac_rt.propagation.clutter.field import ClutterField
    from isac_rt.propagation.raytrace import RayTracer

_LOG = logging.getLogger(__name__)
PILOT_FRAMES = 5
"""Frames that `make_plan` traces."""
CHECK_RAYS = 300_000
"""Rays of the check against Sionna's solver."""
POWER_MARGIN = 10.0
"""Margin of power estimates over the largest of the pilot frames (3.2 in amplitude)."""
PHASE_MARGIN = 2.0
"""Margin of phase estimates over the largest of the pilot frames."""
MOST_COMPARED = 150
"""Largest number of paths of a frame whose synthesis is compared with the direct one."""
SAME_DELAY = 1e-14
"""Largest difference of delay between equal paths of two traces [s]: 3 um, 5 mrad at 77 GHz."""


@dataclass(frozen=True)
class Item:
    """One line of the plan.

    Attributes
    ----------
    what : effect
    modelled, left_out : parts of it in words
    estimate : of the error; None without one
    unit : "rad", "dB" (power over the noise of a cell), "dB of a cell's mean", "dB of noise
        and clutter", "relative", "paths/frame", "of the power radiated" or "of a path's amplitude"
    link : "TX->RX", or "all"
    """

    what: str
    modelled: str
    left_out: str = "nothing"
    estimate: float | None = None
    unit: str = ""
    link: str = "all"


def tracer_of(setup: Setup) -> RayTracer | None:
    """Return the ray tracer of a set-up; None in free space."""
    if setup.scenario.propagation.model != "ray_traced":
        return None
    from isac_rt.propagation.raytrace import RayTracer

    tracer: RayTracer = part_of(setup.propagation, RayTracer)
    return tracer


def _spread(values: Sequence[int], count: int) -> list[int]:
    """Select at most `count` values, evenly spread, with the first and the last."""
    index = np.unique(np.linspace(0, len(values) - 1, min(count, len(values))).round().astype(int))
    return [values[i] for i in index]


def make_plan(setup: Setup) -> dict[str, Any]:
    """Trace `PILOT_FRAMES` frames and return the plan of a run: its decisions, and one `Item` per
    effect with the estimated error."""
    frames = _spread(range(setup.timetable.frames), PILOT_FRAMES)
    items = []
    for part in setup.each:
        names = ", ".join(part.plan.timetable.blocks) if setup.by_chirp else "all"
        items += [replace(i, link=names) if i.link == "all" else i for i in _items(part, frames)]
    if setup.by_chirp:
        stated = setup.scenario.noise.model == "link_budget"
        left = "nothing" if stated else "interference, where their bands overlap"
        said = "where their bands overlap" if stated else "those of the same chirp"
        items.append(Item("chirps of other radars", said, left))
    return {
        **setup.fidelity(),
        "coverage": asdict(setup.coverage),
        "pilot_frames": frames,
        "items": [asdict(item) for item in items],
    }


def _items(setup: Setup, frames: Sequence[int]) -> list[Item]:
    """Return the items of the terminals of one chirp, from the paths of some frames."""
    uses: dict[Link, list[Use]] = {}
    light, next_slot, short_lived, seen = 0.0, 0.0, 0, []
    for frame in frames:
        _LOG.info("tracing frame %d, one of %d", frame, len(frames))
        poses, traced = setup.find(frame)
        if setup.boxes is not None:
            seen.append((poses, traced))
        fastest = max(float(np.linalg.norm(pose.velocity)) for pose in poses.values())
        last = setup.frame_of(frame, poses, traced)
        for link, use in last.uses.items():
            uses.setdefault(link, []).append(use)
            paths = traced[link].select(traced[link].power > 0)
            light = max(light, flight_of_light(paths, setup.waveform, fastest))
            next_slot = max(next_slot, _late(setup, paths, last.noise_power(link)))
            short_lived += int((np.isfinite(paths.begin) | np.isfinite(paths.end)).sum())
    items = [_tracing_item(setup, frames), *_scene_items(setup)]
    for link, of_link in uses.items():
        items += _link_items(setup, link, of_link)
    items += _unmodelled_items(setup, light, next_slot, short_lived / len(frames))
    if setup.moving_centres is not None:
        chirps = setup.waveform.num_chirps
        over_noise = {
            link: setup.plan.cell_noise_gain(link.tx) / chirps / last.noise_power(link)
            for link in traced
        }
        rows = setup.moving_centres.report(traced, poses, over_noise)
        items += [Item(**row) for row in rows]
    if setup.boxes is not None:
        items += [Item(**row) for row in setup.boxes.report(seen)]
    items += [] if setup.has_ideal_hardware else _hardware_items(last)
    return (
        items
        + _self_calibration_items(setup, last)
        + _weather_items(setup)
        + _emitter_items(setup, last)
    )


def _next_slot(setup: Setup) -> float:
    """Return `next_slot_delay` of the run's blocks [s]."""
    blocks = [b for b in setup.timetable.blocks.values() if b is not None] or [0]
    return next_slot_delay(setup.waveform, blocks)


def _late(setup: Setup, paths: PathSet, noise_power: float) -> float:
    """Return the power of the paths whose chirps reach the next slot, over the noise of a cell."""
    power = float(paths.power[paths.delay >= _next_slot(setup)].sum())
    return power * setup.plan.cell_noise_gain(paths.tx) / noise_power


def _unmodelled_items(
    setup: Setup, light: float, next_slot: float, short_lived: float
) -> list[Item]:
    """Return the items of effects that no run models: phases [rad], power over the noise of a cell,
    paths per frame."""
    limit = f"paths longer than {_next_slot(setup) * SPEED_OF_LIGHT:.0f} m"
    out = [
        Item("motion during the flight of light", "no", "always", light, "rad"),
        Item("chirps that reach the next slot", "no", limit, decibels(next_slot), "dB"),
    ]
    if short_lived:
        modelled = f"{short_lived:.3g} paths a frame begin or end in whole chirps"
        share = 1 / (2 * setup.waveform.num_chirps)
        out.append(Item("short paths", modelled, "half a chirp", share, "of a path's amplitude"))
    return out


def _hardware_items(frame: Frame) -> list[Item]:
    """Return an item for each non-ideal hardware part of each link, with the oscillator noise that
    is omitted."""
    out = []
    for link in frame.paths:
        ends = frame.ends(link)
        for part in dict.fromkeys(p for end in (ends.receiver, *ends.senders) for p in end.parts):
            left, error = "nothing", None
            if part == "oscillator":
                left = "noise within a chirp of weak paths"
                error = decibels(frame.oscillator_noise_left_out(link))
            words, unit = part.replace("_", " "), "dB" if part == "oscillator" else ""
            out.append(Item("hardware", words, left, error, unit, str(link)))
    return out


def _self_calibration_items(s: Setup, frame: Frame) -> list[Item]:
    """Return an item for each link with a self-calibrating receiver."""
    if s.scenario.receivers.self_calibration == "none":
        return []
    modelled = f"elements, chirp and clocks ({s.scenario.receivers.self_calibration})"
    left = "coupling, patterns, oscillators"
    return [Item("self-calibration", modelled, left, link=str(link)) for link in frame.paths]


def _weather_items(s: Setup) -> list[Item]:
    """Return an item for each link budget in weather."""
    if s.scenario.weather is None:
        return []
    rows = extension("weather_plan")(s.scenario.weather, s.waveform, link_budgets(s))
    return [Item(**row) for row in rows]


def _emitter_items(s: Setup, frame: Frame) -> list[Item]:
    """Return an item for each link that receives emitters."""
    rows = {}
    for link in frame.paths:
        if link.rx in frame.foreign:
            receiver = ReceiveArray(frame.poses[link.rx], s.arrays.of(link.rx))
            reference = Reference(s.timetable.start_time(frame.number, link.tx))
            about = frame.foreign[link.rx], receiver, reference, frame.noise_power(link)
            rows[link] = extension("emitters_plan")(s.waveform, *about)
    return [Item("foreign radars", link=str(link), **row) for link, row in rows.items()]


def missed_per_frame(setup: Setup, frames: Sequence[int]) -> float:
    """Estimate the missed paths per frame over `MATTERS_DB`, of all links, from a few frames: the
    number found, times the share that only one half of the time samples finds
    (`isac_rt.simulation.plan`)."""
    tracer = tracer_of(setup)
    assert tracer is not None
    alone, weak, strong = 0, 0, 0
    for frame in frames:
        poses, traced = setup.find(frame)
        when, links = setup.timetable.epoch(frame), list(traced)
        halves = [tracer.by_half(k).trace(poses, when, links).paths for k in (0, 1)]
        for link in links:
            level = setup.noise_power(poses, link) / setup.plan.cell_noise_gain(link.tx)
            first, second = (_over(half[link], level, COUNTS_DB) for half in halves)
            more = second.select(~present(second, first))
            alone += len(more) + int((~present(first, second)).sum())
            weak += len(first) + len(more)
            strong += sum(len(_over(paths, level, MATTERS_DB)) for paths in (first, more))
    return strong * alone / (len(frames) * weak) if weak else 0.0


def _over(paths: PathSet, level: float, decibels: float) -> PathSet:
    """Select the paths over a level."""
    return paths.select(paths.power > level * 10 ** (decibels / 10))


def _tracing_item(setup: Setup, frames: Sequence[int]) -> Item:
    tracer, spacing = tracer_of(setup), setup.plan.max_untraced
    if tracer is None:
        return Item("propagation", "closed forms", "the city")
    where = f"every {spacing:g} m of flight" if spacing else "each frame"
    rays = setup.scenario.propagation.rays
    modelled = f"{rays:,} rays for walls from {where}; images of each frame"
    missed = missed_per_frame(setup, frames)
    left = f"paths over {MATTERS_DB:g} dB over walls that no ray met"
    return Item("tracing", modelled, left, missed, "paths/frame")


def _scene_items(setup: Setup) -> list[Item]:
    """Return the items of the mesh and its scatterers."""
    out, record = [], extent(setup.city, setup.propagation.census(), setup.scenario.clutter)
    faces, dropped = record["city_faces"], record["city_faces_beyond_reach"]
    if faces + dropped:
        whole = setup.plan.preset == "everything" or setup.scenario.access.establish
        why = f"{dropped:,} faces out of reach, {setup.plan.reach:,.0f} m by the IF filter"
        out.append(Item("mesh", f"{faces:,} faces", "nothing" if whole else why))
    if (count := record["scatterers"]) is not None:
        unseen = record["scatterer_cells"] - count
        density = f"{record['cell_area_per_metre_m']:.3g} m2 per metre from the flights"
        modelled = f"{count:,} scatterers, one to {density}"
        why = f"{unseen:,} cells that no transmitter sees"
        error, again = record["clutter_error_db"], record["overlap_m2"]
        why += f"; overlapping surfaces of {again:.0f} m2" if again else ""
        out.append(Item("clutter field", modelled, why, error, "dB of a cell's mean"))
        for link, left in record["merged"].items():
            below_noise = f"{count - left:,} merged below the noise or occluded"
            merged, unit = f"{left:,} scatterers", "dB of noise and clutter"
            out.append(Item("clutter of the link", merged, below_noise, error, unit, link))
        out.append(_mirrors_item(record["mirrors"]))
    return out


def _mirrors_item(record: dict[str, dict[str, Any]] | None) -> Item:
    """Return the item of two-bounce clutter: mirrors by terminal, and the power of the omitted
    ones."""
    what = "clutter by mirrors"
    if record is None:
        return Item(what, "one bounce", "two bounces (clutter.mirrors)")
    counts = ", ".join(f"{row['count']} of {name}" for name, row in record.items())
    shares = [100 * row["share"] for row in record.values()]
    power = " to ".join(dict.fromkeys(f"{share:.2g}" for share in (min(shares), max(shares))))
    modelled = (
        f"mirrors {counts}: scatterers lit or received by way of one, {power} % of what a terminal "
        "radiates"
    )
    rest = max(row["share_left_out"] for row in record.values())
    left = "weaker mirrors, paths over two"
    return Item(what, modelled, left, rest, "of the power radiated")


def _link_items(setup: Setup, link: Link, uses: list[Use]) -> list[Item]:
    """Return the items of one link."""
    name, share = str(link), setup.plan.phase_share
    mean = {
        key: float(np.mean([getattr(use, key) for use in uses]))
        for key in ("found", "filtered", "weak", "plane", "straight")
    }
    kinds = dict.fromkeys(kind for use in uses for kind in use.kept)
    by_kind = ", ".join(
        f"{np.mean([use.kept.get(k, 0) for use in uses]):,.0f} {k.replace('_', ' ')}" for k in kinds
    )
    modelled = f"{by_kind or 'none'}; bounces: {max(use.bounces for use in uses)} at most"
    dropped = f"{mean['weak']:,.0f} too weak, {mean['filtered']:,.0f} out of reach"
    left = decibels(min(POWER_MARGIN * max(use.left_out for use in uses), setup.plan.weakest))
    num_kept = max(mean["found"] - mean["filtered"] - mean["weak"], 1.0)

    def phase(errors: Iterable[float]) -> float:
        return float(min(PHASE_MARGIN * max(errors), share))

    plane, straight = mean["plane"], mean["straight"]
    method = setup.plan.synthesis(int(num_kept))
    error = 1e-6 if isinstance(method, Direct) else GRIDDED_ERROR
    return [
        Item("paths", modelled, dropped, left, "dB", name),
        Item(
            "wavefronts",
            f"{abs(num_kept - plane):,.0f} spherical",
            f"curvature of {plane:,.0f}",
            phase(use.plane_error for use in uses),
            "rad",
            name,
        ),
        Item(
            "flight in a frame",
            f"{abs(num_kept - straight):,.0f} accelerated",
            f"acceleration of {straight:,.0f}",
            phase(use.straight_error for use in uses),
            "rad",
            name,
        ),
        Item(
            "directions in a frame",
            "those at mid-frame",
            "rotation within the frame",
            PHASE_MARGIN * max(use.turning_error for use in uses),
            "rad",
            name,
        ),
        Item("synthesis", method.name, "rounding of the grid", error, "relative", name),
    ]


def check(setup: Setup, frames: int = 4) -> dict[str, Any]:
    """Measure the errors of each link on frames drawn at random: the largest error and the largest
    bound of these frames."""
    rng, count = generator(setup.scenario.seed, "budget check"), setup.timetable.frames
    chosen = sorted(rng.choice(count, min(frames, count), replace=False).tolist())
    links = {name: row for part in setup.each for name, row in _measured(part, chosen).items()}
    return {"frames": chosen, "links": {name: _in_decibels(row) for name, row in links.items()}}


def _measured(setup: Setup, frames: Sequence[int]) -> dict[str, dict[str, float]]:
    """Return the largest errors and bounds of the links of one chirp in some frames."""
    tracer, out = tracer_of(setup), dict[str, dict[str, float]]()
    for number in frames:
        poses, traced = setup.find(number)
        frame, truth = setup.frame_of(number, poses, traced), traced
        if tracer is not None:
            epoch = setup.timetable.epoch(number)
            truth = tracer.by_sionna(CHECK_RAYS).trace(poses, epoch, list(traced)).paths
        for link in traced:
            into = out.setdefault(str(link), {})
            for key, value in _errors(setup, frame, link, traced[link], truth[link]).items():
                into[key] = max(into.get(key, 0.0), value)
    return out


def _in_decibels(row: dict[str, float]) -> dict[str, float | None]:
    powers = ("left_out", "left_out_bound", "missed_strongest", "below_noise", "below_noise_bound")
    return {
        (f"{key}_db" if key in powers else key): (decibels(value) if key in powers else value)
        for key, value in row.items()
    }


def _errors(
    setup: Setup, frame: Frame, link: Link, traced: PathSet, full: PathSet
) -> dict[str, float]:
    """Measure the errors of one link and frame; powers are over the noise of a cell."""
    plan, level = setup.plan, frame.noise_power(link)
    paths, use = frame.paths[link], frame.uses[link]
    ratio = plan.cell_noise_gain(link.tx) / level
    received, weak, _ = plan.chosen(traced, level)
    missed = ~present(full, traced) & (full.delay <= plan.longest_delay)
    delay = np.append(traced.delay[weak], full.delay[missed])
    cell = np.floor(delay / setup.waveform.delay_step).astype(int)
    power = np.append(traced.power[weak], full.power[missed]) * ratio
    lost = np.bincount(cell - cell.min(), power) if cell.size else np.zeros(1)
    return {
        "left_out": float(lost.max()),
        "left_out_bound": use.left_out,
        "missed_chains": float(missed.sum()),
        "missed_strongest": float((full.power[missed] * ratio).max(initial=0.0)),
        "plane_rad": _plane_error(setup, frame, link, traced.select(received & ~weak)),
        "plane_bound_rad": use.plane_error,
        "clutter_db": _clutter_error(setup, frame, link),
        "clutter_bound_db": error_for(Density.of(setup.scenario.clutter).per_metre),
        "flight_rad": _flight_error(setup, frame.number, paths),
        "straight_bound_rad": use.straight_error,
        "turning_rad": _turning_error(setup, frame.number, paths),
        "turning_bound_rad": use.turning_error,
        "synthesis": _synthesis_error(setup, frame, link, level),
        "below_noise": _below_noise_error(setup, frame, link, level),
        "below_noise_bound": plan.below_noise,
    }


def present(paths: PathSet, among: PathSet) -> np.ndarray:
    """Mark the paths (K,) that are among the others, with the same kind, UAV and delay."""
    out = np.zeros(len(paths), bool)
    for kind, target in {(int(k), int(t)) for k, t in zip(paths.kind, paths.target, strict=True)}:
        here = np.flatnonzero((paths.kind == kind) & (paths.target == target))
        there = np.sort(among.delay[(among.kind == kind) & (among.target == target)])
        if there.size:
            at = np.searchsorted(there, paths.delay[here])
            near = [
                np.abs(there[np.clip(at + step, 0, there.size - 1)] - paths.delay[here])
                for step in (-1, 0)
            ]
            out[here] = np.minimum(*near) < SAME_DELAY
    return out


def _plane_error(setup: Setup, frame: Frame, link: Link, raw: PathSet) -> float:
    """Return the largest phase error of plane wavefronts against spherical ones [rad], both ends
    added."""
    plane = np.isinf(frame.paths[link].rx_radius) & np.isfinite(raw.rx_radius)
    if not plane.any():
        return 0.0
    k = 2 * np.pi * setup.waveform.effective_carrier / SPEED_OF_LIGHT
    total = np.zeros(int(plane.sum()))
    raw = raw.select(plane)
    ends = (
        (frame.poses[link.tx], setup.arrays.of(link.tx).tx_positions, raw.departure, raw.tx_radius),
        (frame.poses[link.rx], setup.arrays.of(link.rx).rx_positions, raw.arrival, raw.rx_radius),
    )
    for pose, positions, direction, radius in ends:
        elements = pose.to_world(positions)
        along = direction @ elements.T
        change = (elements**2).sum(1) - 2 * radius[:, None] * along
        exact = change / (np.sqrt(radius[:, None] ** 2 + change) + radius[:, None])
        total += np.abs(exact + along).max(axis=1)
    return float(k * total.max())


def _clutter_error(setup: Setup, frame: Frame, link: Link) -> float:
    """Return the 90th percentile of the error of mean noise plus clutter by merging, over
    range-Doppler cells with clutter [dB]."""
    tracer = tracer_of(setup)
    if tracer is None or tracer.field is None or link not in tracer.field.merged:
        return 0.0
    both = (tracer.field.whole(), tracer.field)
    return cells_apart(*(clutter_by_cell(setup, frame, link, field) for field in both))


def clutter_by_cell(
    setup: Setup, frame: Frame, link: Link, field: ClutterField
) -> tuple[np.ndarray, np.ndarray]:
    """Return the range-Doppler cells in which a link receives the scatterers of a field, and their
    mean powers over the noise of a cell."""
    level = setup.plan.cell_noise_gain(link.tx) / frame.noise_power(link)
    origin, epoch = setup.city.origin, setup.timetable.epoch(frame.number)
    start, end = (
        replace(frame.poses[name], position=frame.poses[name].position - origin) for name in link
    )
    state = LinkState(link, epoch, start, end)
    seen = field.seen(state)
    received = seen.length < SPEED_OF_LIGHT * setup.plan.longest_delay
    motion = seen.length[received] / SPEED_OF_LIGHT, seen.rate[received] / SPEED_OF_LIGHT
    power = level * (seen.magnitude * state.elements(setup.arrays, seen))[received] ** 2
    return resolution_cell(setup.waveform, *motion), power


def cells_apart(
    every: tuple[np.ndarray, np.ndarray], fewer: tuple[np.ndarray, np.ndarray]
) -> float:
    """Return the 90th percentile of the difference of mean noise plus clutter between two results
    of `clutter_by_cell`, over cells with clutter [dB]."""
    cells, powers = zip(every, fewer, strict=True)
    _, number = np.unique(np.concatenate(cells), return_inverse=True)
    count = number.max(initial=-1) + 1
    if not count:
        return 0.0
    a, b = (
        np.bincount(part, power, count)
        for part, power in zip(np.split(number, [len(cells[0])]), powers, strict=True)
    )
    return float(np.quantile(difference_db(a, b), 0.9))


def _flight_error(setup: Setup, frame: int, paths: PathSet) -> float:
    """Return the largest phase error of the extrapolated delays at the ends of the frame, against
    the true positions [rad]."""
    reach, epoch = frame_reach(setup.waveform), setup.timetable.epoch(frame)
    moving = _with_chains(paths)
    if not len(moving):
        return 0.0
    drift = []
    for t in (0.0, -reach, reach):
        exact = delays(moving, setup.swarm.poses(epoch + t), setup.city)
        drift.append(exact - (moving.delay + (moving.delay_rate + moving.delay_accel * t / 2) * t))
    error = np.maximum(*(np.abs(d - drift[0]) for d in drift[1:]))
    return float(2 * np.pi * setup.waveform.effective_carrier * error.max())


def _with_chains(paths: PathSet) -> PathSet:
    """Select the paths whose delays `delays` can evaluate, which are none over mirrors that move.
    Two-bounce clutter moves like a farther scatterer and is left out: one bounce is the worse
    case."""
    one_bounce = (paths.faces >= 0).any(axis=1) & (paths.bounces == 1)
    there = (paths.kind != PathKind.DIFFUSE) | one_bounce
    there &= (paths.kind != PathKind.SPECULAR) | (paths.faces >= 0).any(axis=1)
    return paths.select(~paths.bent & (paths.kind != PathKind.LEAKAGE) & there)


def _turning_error(setup: Setup, frame: int, paths: PathSet) -> float:
    """Return the largest phase error of constant directions within the frame [rad]: change of the
    element delays against those of the centroids at the ends of the frame, for all transmit
    elements with the first and last receive element."""
    reach, epoch = frame_reach(setup.waveform), setup.timetable.epoch(frame)
    moving = _with_chains(paths)
    if not len(moving):
        return 0.0
    antennas, lags = setup.arrays.at(paths.link), []
    for t in (0.0, -reach, reach):
        poses = setup.swarm.poses(epoch + t)
        centre = delays(moving, poses, setup.city)
        tx = poses[paths.tx].to_world(antennas.tx_positions)
        rx = poses[paths.rx].to_world(antennas.rx_positions[[0, -1]])
        pairs = itertools.product(tx, rx)
        lags.append([delays(moving, poses, setup.city, pair) - centre for pair in pairs])
    error = np.abs(np.array(lags[1:]) - np.array(lags[0]))
    return float(2 * np.pi * setup.waveform.effective_carrier * error.max())


def delays(
    paths: PathSet,
    poses: dict[str, Pose],
    city: CityMesh,
    elements: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Return the delays (K,) [s] of the same interaction sequences and scatterers for other poses,
    between two `elements` (3,), (3,) about the centroids."""
    local = {
        name: replace(pose, position=pose.position - city.origin) for name, pose in poses.items()
    }
    start, end = local[paths.tx], local[paths.rx]
    if elements is not None:
        start = replace(start, position=start.position + elements[0])
        end = replace(end, position=end.position + elements[1])
    out = np.zeros(len(paths))
    scattered = paths.kind == PathKind.DIFFUSE
    points = paths.points[scattered, 0] - city.origin if scattered.any() else np.zeros((0, 3))
    out[scattered] = sum(np.linalg.norm(points - pose.position, axis=1) for pose in (start, end))
    plain = np.isin(paths.kind, (PathKind.LINE_OF_SIGHT, PathKind.SPECULAR))
    out[plain] = _lengths(paths.faces[plain], start, end, city)
    middle = (paths.faces.shape[1] - 1) // 2
    for number in np.unique(paths.target[paths.target >= 0]):
        here = (paths.target == number) & np.isin(paths.kind, (PathKind.TARGET, PathKind.GHOST))
        pose = local[paths.target_names[number]]
        there, back = paths.faces[here, :middle], paths.faces[here, middle + 1 :][:, ::-1]
        out[here] = _lengths(there, start, pose, city) + _lengths(back, end, pose, city)
    return out / SPEED_OF_LIGHT


def _lengths(faces: np.ndarray, start: Pose, end: Pose, city: CityMesh) -> np.ndarray:
    """Return the lengths (K,) [m] of unfolded interaction sequences (K, B), padded with -1."""
    out = np.zeros(len(faces))
    normals, offsets = (
        plane_of_each_face(city) if city.num_faces else (np.zeros((0, 3)), np.zeros(0))
    )
    count = (faces >= 0).sum(axis=1)
    for bounces in np.unique(count):
        rows = np.flatnonzero(count == bounces)
        chain = faces[rows, :bounces]
        out[rows] = unfold(normals[chain], offsets[chain], start, end).length
    return out


def _synthesis_error(setup: Setup, frame: Frame, link: Link, level: float) -> float:
    """Return the relative RMS error of the run's synthesis on some of a frame's paths, below-noise
    paths excluded."""
    paths = frame.paths[link]
    if not len(paths):
        return 0.0
    rng = generator(setup.scenario.seed, "synthesis check", *link, frame.number)
    rows = rng.choice(len(paths), min(len(paths), MOST_COMPARED), replace=False)
    sample = paths.select(np.sort(rows))
    methods = Direct(), _uncovered(setup.plan.synthesis(len(paths), level))
    exact, fast = (_made(setup, frame, link, sample, method).samples for method in methods)
    scale = float(np.linalg.norm(exact))
    return float(np.linalg.norm(fast - exact)) / scale if scale else 0.0


def _below_noise_error(setup: Setup, frame: Frame, link: Link, level: float) -> float:
    """Return the largest error power of below-noise paths in a range-Doppler cell, over its noise,
    with the errors of all channels in phase."""
    paths = frame.paths[link]
    if not len(paths) or not setup.plan.below_noise:
        return 0.0
    method = setup.plan.synthesis(len(paths), level)
    cube = _made(setup, frame, link, paths, method)
    cube.samples[:] -= _made(setup, frame, link, paths, _uncovered(method)).samples
    passes = 2 if link.own else 1
    known = Known.of(cube, frame.sent[link.tx].payload, setup.arrays.at(link), passes)
    power = power_map(clean_spectrum(cube, known), known)
    window = 3 / 8 * setup.waveform.window_length
    return float(power.max()) * known.channels / (level * window * window_gain(known))


def _uncovered(method: Method) -> Method:
    """Return the method without below-noise paths."""
    return replace(method, below_noise=0.0) if isinstance(method, Auto) else method


def _made(setup: Setup, frame: Frame, link: Link, paths: PathSet, method: Method) -> IFCube:
    """Synthesise some of a link's paths without noise."""
    links = [(frame.sent[link.tx], paths)]
    receiver = ReceiveArray(frame.poses[link.rx], setup.arrays.of(link.rx))
    reference = Reference(setup.timetable.start_time(frame.number, link.tx))
    return if_signal(setup.waveform, links, receiver, reference, method)
