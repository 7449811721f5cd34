r"""Error budget: the effects that each link and frame needs, and bounds of those omitted.

Phases. Two approximations change the phase of a path; each may use half of
``accuracy.max_phase_error_rad``:

- plane for spherical wavefronts: an element at r from its array's centroid errs by :math:`k
  r^2/(2R)\,(1 + r/R)` at most, at a wavefront of radius R; a line of sight also by :math:`k\,
  r_{tx} r_{rx}/R` (the joint term);
- straight for accelerated flight within a frame: :math:`\pi f_c |\ddot\tau| t^2`, t to the farthest
  chirp of the frame.

Omitted paths. Paths that the IF filter stops in all groups, chirps and symbols are omitted without
error. The weakest ghosts and paths of the city are omitted while their power per range cell stays
``propagation.weakest_path_db`` below the noise of a range-Doppler-antenna cell; on average powers
add, whatever the phases. Interaction sequences that no ray hits are missed
(`isac_rt.propagation.segments.chains`); the others have no error.

Missed paths. The even and the odd time samples are two searches with half of the rays each; the
second adds half of the paths that only one of them finds. All further rays are assumed to add twice
as much, so the share of missed paths is the share that only one search finds. (Capture-recapture
underestimates tenfold here: hit probabilities span decades.) The share is that of all paths over
`COUNTS_DB`, because those over `MATTERS_DB` are too few.

Never modelled: change of directions within a frame (`turning_bound`, not part of
``accuracy.max_phase_error_rad``), jerk, motion during the flight of light, and chirps that reach
the next slot (`next_slot_delay`). Except in `Exact`, paths begin and end at whole chirps: an error
of half a chirp of P at either end, 1/(2 P) of the path's amplitude."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.signal_gridded import GRIDDED_ERROR
from isac_rt.propagation.clutter.cells import Density, error_for
from isac_rt.propagation.model import Census
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.settings import Clutter, Propagation
from isac_rt.results.records import Use
from isac_rt.signal.methods import Auto, Direct, Method
from isac_rt.signal.settings import Accuracy
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Swarm

MATTERS_DB = -10.0
"""Least power of a path that counts as missed [dB over the noise of a cell]."""
COUNTS_DB = -40.0
"""Least power of the paths that estimate the missed share [dB over the noise of a cell]."""
MOST_DIRECT = 2000
"""Most paths for direct synthesis by the preset everything; `Auto` for more."""

BELOW_NOISE_DB = 20.0
"""Level of the error of below-noise paths under the noise of a cell of all channels [dB]: a
hundredth of its power."""
MOST_SPREAD = 12
"""Most instants of a run at which clutter is compared with noise."""
REACH_MARGIN_M = 1.0
"""Margin of the mesh radius for accelerations within a frame [m]."""


@dataclass(frozen=True)
class Plan:
    """Decisions before a run.

    Attributes
    ----------
    accuracy, propagation : settings of the scenario
    arrays, timetable, swarm : of the run
    amplitudes : sqrt(transmit power) of an antenna of each terminal [sqrt(W)]
    """

    accuracy: Accuracy
    propagation: Propagation
    arrays: Arrays
    timetable: Timetable
    swarm: Swarm
    amplitudes: Mapping[str, float]

    @property
    def waveform(self) -> Waveform:
        return self.timetable.waveform

    @property
    def preset(self) -> str:
        return self.accuracy.preset

    @property
    def phase_share(self) -> float:
        """Bound of the phase error of either approximation [rad]."""
        return 0.0 if self.preset == "everything" else self.accuracy.max_phase_error_rad / 2

    @property
    def weakest(self) -> float:
        """Largest omitted power of a range cell over the noise of a cell (linear)."""
        if self.preset == "everything":
            return 0.0
        return float(10 ** (-self.propagation.weakest_path_db / 10))

    @property
    def max_untraced(self) -> float:
        """Largest flight between two time samples, from which rays search for walls [m]; 0: search
        from each frame."""
        return 0.0 if self.preset == "everything" else self.accuracy.max_untraced_m

    def synthesis(self, num_paths: int, noise_power: float = 0.0) -> Method:
        """Return the method of synthesis for a number of paths and a noise power [W]."""
        if self.preset == "everything" and num_paths <= MOST_DIRECT:
            return Direct()
        return Auto(noise_power=noise_power, below_noise=self.below_noise)

    @property
    def below_noise(self) -> float:
        """Error of below-noise paths over the noise of a cell of all channels; 0: no path is below
        noise."""
        return 0.0 if self.preset != "budget" else float(10 ** (-BELOW_NOISE_DB / 10))

    def spread_frames(self) -> list[int]:
        """Return evenly spaced frames, a metre of flight apart, `MOST_SPREAD` at most."""
        frames = self.timetable.frames
        poses = [self.swarm.poses(self.timetable.epoch(frame)) for frame in range(frames)]
        flown_distance = max(
            sum(
                float(np.linalg.norm(b[name].position - a[name].position))
                for a, b in itertools.pairwise(poses)
            )
            for name in self.swarm.terminals
        )
        count = min(frames, MOST_SPREAD, int(np.ceil(flown_distance)) + 1)
        return np.unique(np.linspace(0, frames - 1, count).round().astype(int)).tolist()

    @cached_property
    def longest_delay(self) -> float:
        """Largest delay of a received path [s]; beyond, the IF filter stops it in all groups."""
        w = self.waveform
        blocks = [b for b in self.timetable.blocks.values() if b is not None] or [0]
        groups_between = max(blocks) - min(blocks) + w.num_groups - 1
        last = self.timetable.epoch(self.timetable.frames)
        clocks = 2 * max(
            abs(u.clock_offset_s) + 1e-6 * abs(u.clock_drift_ppm) * last
            for u in self.swarm.uavs.values()
        )
        transition = w.filter_transition / w.slope
        return w.max_delay + transition + groups_between * w.group_spacing + clocks

    @property
    def reach(self) -> float:
        """Largest distance of a received surface from its terminal [m]."""
        return self.longest_delay * SPEED_OF_LIGHT / 2

    @property
    def whole_mesh(self) -> bool:
        """True if the mesh is not cut to `mesh_radius`."""
        return self.preset == "everything" or self.propagation.model != "ray_traced"

    def mesh_radius(self, centre: np.ndarray) -> float:
        """Return the distance from a position beyond which no surface contributes, in whole metres
        [m].

        All points of a path of length L, and what blocks it, lie within L/2 of the middle between
        its ends, which is no farther from the position than the farther end. Motion during a frame
        is added. The field of view is not used: a second wall may lie outside it."""
        terminals = [name for name, uav in self.swarm.uavs.items() if uav.is_terminal]
        times = map(self.timetable.epoch, range(self.timetable.frames))
        poses = [self.swarm.poses(time) for time in times]
        farthest = max(
            float(np.linalg.norm(pose[name].position - centre))
            for pose in poses
            for name in terminals
        )
        fastest = max(
            float(np.linalg.norm(pose.velocity)) for state in poses for pose in state.values()
        )
        flown_distance = 2 * fastest * frame_reach(self.waveform)
        return float(np.ceil(farthest + self.reach + flown_distance + REACH_MARGIN_M))

    def cell_noise_gain(self, tx: str) -> float:
        """Return the factor from |gain|^2 of a path of a transmitter to its power over the noise of
        a range-Doppler-antenna cell, per watt of noise in a sample."""
        return self.amplitudes[tx] ** 2 * self.waveform.num_samples * self.waveform.num_chirps

    def chosen(self, paths: PathSet, noise_power: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Mark received paths and those too weak, (K,) bool each; also return the largest omitted
        power of a range cell over the noise."""
        over_noise = paths.power * self.cell_noise_gain(paths.tx) / noise_power
        everything = self.preset == "everything"
        received = (
            np.full(len(paths), True)
            if everything
            else paths.delay - motion(paths, self.waveform) <= self.longest_delay
        )
        always = np.isin(paths.kind, (PathKind.LINE_OF_SIGHT, PathKind.TARGET, PathKind.LEAKAGE))
        cell = np.floor(paths.delay / self.waveform.delay_step).astype(np.int64)
        weak, left_out = faintest(
            np.where(received & ~always, over_noise, np.inf), cell, self.weakest
        )
        return received, weak, left_out

    def apply(self, paths: PathSet, noise_power: float) -> tuple[PathSet, Use]:
        """Select the paths of a link's frame and their approximations.

        Parameters
        ----------
        paths : all that were found
        noise_power : of a sample at the receiver [W]
        """
        w, antennas = self.waveform, self.arrays.at(paths.link)
        received, weak, left_out = self.chosen(paths, noise_power)
        needed = paths.select(received & ~weak)
        plane_error, straight_error = plane_bound(needed, antennas, w), straight_bound(needed, w)
        plane, straight = plane_error <= self.phase_share, straight_error <= self.phase_share
        use = Use(
            found=len(paths),
            filtered=int((~received).sum()),
            weak=int(weak.sum()),
            kept={name: count for name, count in needed.counts().items() if count},
            bounces=int(needed.bounces.max(initial=0)),
            left_out=left_out,
            plane=int(plane.sum()),
            straight=int(straight.sum()),
            plane_error=float(plane_error[plane].max(initial=0.0)),
            straight_error=float(straight_error[straight].max(initial=0.0)),
            turning_error=float(turning_bound(needed, antennas, w, self.swarm).max(initial=0.0)),
        )
        left = replace(
            needed,
            tx_radius=np.where(plane, np.inf, needed.tx_radius),
            rx_radius=np.where(plane, np.inf, needed.rx_radius),
            delay_accel=np.where(straight, 0.0, needed.delay_accel),
        )
        return left, use


def frame_reach(waveform: Waveform) -> float:
    """Return the time from mid-frame to the farthest sample [s]."""
    return waveform.frame_duration / 2 + (waveform.num_groups - 1) * waveform.group_spacing


def motion(paths: PathSet, waveform: Waveform) -> np.ndarray:
    """Return the largest change of each delay by motion within the frame (K,) [s]."""
    t = frame_reach(waveform)
    return np.abs(paths.delay_rate) * t + np.abs(paths.delay_accel) * t**2 / 2


def faintest(power: np.ndarray, cell: np.ndarray, limit: float) -> tuple[np.ndarray, float]:
    """Mark the weakest paths of each cell whose sum of powers stays within a limit.

    Parameters
    ----------
    power : (K,); inf for a path that must stay
    cell : (K,) int

    Returns
    -------
    mask : (K,) bool
    most : largest omitted sum of a cell"""
    weak = np.flatnonzero(power <= limit)
    order = weak[np.lexsort([power[weak], cell[weak]])]
    sums, cells = np.cumsum(power[order]), cell[order]
    starts = np.flatnonzero(np.diff(cells, prepend=cells[:1] - 1))
    before = np.where(starts > 0, sums[starts - 1], 0.0) if starts.size else sums
    total = sums - np.repeat(before, np.diff(starts, append=sums.size))
    dropped = total <= limit
    mask = np.zeros(len(power), bool)
    mask[order] = dropped
    return mask, float(total[dropped].max(initial=0.0))


def plane_bound(paths: PathSet, antennas: Antennas, waveform: Waveform) -> np.ndarray:
    """Return the bound (K,) of the phase error of a plane wavefront at the farthest elements
    [rad]."""
    reach = [
        np.linalg.norm(positions, axis=1).max()
        for positions in (antennas.tx_positions, antennas.rx_positions)
    ]
    k = 2 * np.pi * _highest(waveform) / SPEED_OF_LIGHT
    out = np.zeros(len(paths))
    for r, radius in zip(reach, (paths.tx_radius, paths.rx_radius), strict=True):
        out += k * r**2 / (2 * radius) * (1 + r / radius)
    return out + np.where(
        paths.kind == PathKind.LINE_OF_SIGHT, k * reach[0] * reach[1] / paths.rx_radius, 0.0
    )


def straight_bound(paths: PathSet, waveform: Waveform) -> np.ndarray:
    """Return the bound (K,) of the phase error without acceleration, at the ends of the frame
    [rad]."""
    return np.pi * _highest(waveform) * np.abs(paths.delay_accel) * frame_reach(waveform) ** 2


def turning_bound(
    paths: PathSet, antennas: Antennas, waveform: Waveform, swarm: Swarm
) -> np.ndarray:
    r"""Return the bound (K,) of the phase error of constant directions, at the farthest elements
    and the ends of the frame [rad].

    For motion by v t of the source and of the UAV, the delay of an element at r changes by
    :math:`r\,v t/(R - v t - r)` at most against that of the centroid, R the radius of the
    wavefront. Rotation of the UAV moves its elements in addition. Scatterers without a point of a
    surface, such as rain, are drawn anew in each frame and have no direction to keep: 0."""
    t, k = frame_reach(waveform), 2 * np.pi * _highest(waveform) / SPEED_OF_LIGHT
    poses = swarm.poses(paths.epoch)
    flown_distance = {
        name: t * (float(np.linalg.norm(p.velocity)) + t * float(np.linalg.norm(p.acceleration)))
        for name, p in poses.items()
    }
    targets = np.array([*(flown_distance[name] for name in paths.target_names), 0.0])[paths.target]
    ends = (
        (paths.tx, paths.rx, antennas.tx_positions, paths.tx_radius),
        (paths.rx, paths.tx, antennas.rx_positions, paths.rx_radius),
    )
    out = np.zeros(len(paths))
    for end, far_end, positions, radius in ends:
        flight = swarm.trajectories[end]
        here = poses[end].to_world(positions)
        then = [flight.pose(paths.epoch + later).to_world(positions) for later in (-t, t)]
        r = float(np.linalg.norm(positions, axis=1).max())
        flown = flown_distance[end] + np.where(paths.target >= 0, targets, flown_distance[far_end])
        flown = np.where(paths.kind == PathKind.DIFFUSE, flown_distance[end], flown)
        rest = radius - flown - r
        # beside the UAV itself a direction may turn to the opposite one
        out += k * np.where(rest > flown / 2, r * flown / np.maximum(rest, flown / 2), 2 * r)
        out += k * max(float(np.linalg.norm(at - here, axis=1).max()) for at in then)
    drawn = (paths.kind == PathKind.DIFFUSE) & ~np.isfinite(paths.points).any(axis=(1, 2))
    return np.where(drawn | (paths.kind == PathKind.LEAKAGE), 0.0, out)


def flight_of_light(paths: PathSet, waveform: Waveform, speed: float) -> float:
    """Estimate the phase of motion during the flight of light for the longest path [rad].

    Parameters
    ----------
    speed : of the fastest UAV [m/s]"""
    k = 2 * np.pi * waveform.carrier_frequency / SPEED_OF_LIGHT
    return float((k * speed * paths.delay).max(initial=0.0))


def next_slot_delay(waveform: Waveform, blocks: Iterable[int]) -> float:
    """Return the least delay [s] at which a chirp of the last block passes the filter of the first
    block's chirp in the next slot, data delay included; synthesis omits such chirps.

    Parameters
    ----------
    blocks : first resource block of each transmitter
    """
    w, first = waveform, list(blocks)
    groups_between = max(first) + w.num_groups - 1 - min(first)
    data = w.num_delay_symbols * w.delay_step if w.carries_data else 0.0
    return w.slot_duration - groups_between * w.group_spacing - data - w.filter_transition / w.slope


def _highest(waveform: Waveform) -> float:
    """Return the highest frequency of the chirp [Hz]."""
    return waveform.carrier_frequency + waveform.bandwidth


def decisions(plan: Plan) -> dict[str, Any]:
    """Return the decisions before a run, as in `isac-rt plan` and summary.json."""
    everything = plan.preset == "everything"
    return {
        "preset": plan.preset,
        "max_phase_error_rad": None if np.isinf(plan.phase_share) else 2 * plan.phase_share,
        "weakest_path_db": None if everything else round(float(-10 * np.log10(plan.weakest)), 6),
        "max_untraced_m": plan.max_untraced,
        "reach_m": None if everything else round(plan.reach, 3),
        "synthesis": plan.synthesis(0).name,
        "synthesis_error": GRIDDED_ERROR,
        "below_noise_error_db": BELOW_NOISE_DB if plan.below_noise else None,
    }


def mechanisms(p: Propagation, c: Clutter) -> dict[str, Any]:
    """List the modelled mechanisms of propagation and clutter."""
    traced = p.model == "ray_traced"
    return {
        "propagation": p.model,
        "max_bounces": p.max_bounces if traced else 0,
        "ghosts": traced and p.ghosts,
        "leakage": traced and p.leakage.enabled,
        "clutter": c.model,
        "clutter_bounces": None if c.model != "field" else 2 if c.mirrors else 1,
        "rays": p.rays if traced else None,
    }


def extent(city: CityMesh, census: Census, clutter: Clutter) -> dict[str, Any]:
    """Return the parts of the city and of its clutter in the run, as in `isac-rt plan` and
    summary.json.

    Returns
    -------
    record : area of a scatterer over its distance [m] and its error of the mean power, None without
        a field; faces traced; faces beyond the reach of all links and frames (`Plan.mesh_radius`);
        scatterers visible from a transmitter, None without a field, out of cells of the whole mesh,
        and by link their number after merging below the noise; by terminal the mirrors of
        two-bounce clutter and the shares of power that they and all others reflect, None without
        mirrors; visible area that lies in two surfaces [m^2]
    """
    area = Density.of(clutter).per_metre if clutter.model == "field" else None
    return {
        "cell_area_per_metre_m": area,
        "clutter_error_db": None if area is None else round(error_for(area), 4),
        "city_faces": city.num_faces,
        "city_faces_beyond_reach": city.num_beyond,
        **asdict(census),
    }
