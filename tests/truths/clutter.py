"""The clutter field in flight: coherent with sums made apart from it, without jumps, with the
speckle and the Doppler of its surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import trimesh
from scipy import ndimage, stats

from isac_rt.frame.link import Link
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import prepare, propagation_in, swarm_of
from isac_rt.world.city import CityMesh, load_city
from isac_rt.world.swarm import Pose
from truths import truths
from truths.case import Errors, traced
from truths.truths import WAVELENGTH

CELL = 0.25
SHARE = 0.4
"""Scattering coefficient S of metal here."""
CROSSING = {
    "source": "blocks",
    "street_width_m": 18.3,
    "building_height_m": 16.7,
    "block_size_m": 31.0,
    "blocks_x": 2,
    "blocks_y": 2,
    "wall_material": "metal",
    "roof_material": "metal",
    "ground_material": "metal",
    "materials": {"metal": {"scattering_coefficient": SHARE}},
}
# along a street past a corner, across it towards a wall, climbing beside a wall over a roof's edge
STREETS = (
    ((0.0, (-2.1, -26.0, 7.3)), (1.0, (-1.7, -14.1, 7.6)), (2.0, (-1.3, -2.2, 7.9))),
    ((0.0, (-5.9, 3.1, 9.2)), (1.0, (0.1, 4.7, 9.0)), (2.0, (6.2, 6.3, 8.8))),
    ((0.0, (4.3, -15.2, 9.9)), (1.0, (4.6, -15.9, 15.1)), (2.0, (4.9, -16.6, 20.3))),
)
ROUND_A_CORNER = (
    (0.0, (-2.1, -31.0, 7.3)),
    (1.4, (-1.7, -17.3, 7.6)),
    (2.6, (-0.4, -5.8, 7.9)),
    (3.5, (5.9, 0.2, 8.1)),
    (5.0, (20.6, 1.7, 8.3)),
)
FAINT: dict[str, Any] = {
    "seed": 8,
    "frames": 60,
    "frame_interval_s": 0.02,
    "swarm": {
        "A": {
            "role": "active",
            "position_m": (2.4, -22.7, 9.3),
            "velocity_mps": (-0.9, 7.7, 0.6),
        },
        "P": {
            "role": "passive",
            "position_m": (-1.3, 17.9, 11.1),
            "velocity_mps": (0.7, -4.1, 0.3),
        },
    },
    "receiver_preset": "plain",
    "city": {
        "source": "canyon",
        "street_width_m": 21.3,
        "street_length_m": 63.0,
        "building_height_m": 13.9,
    },
    "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
    "clutter": {"model": "field"},
    "noise": {"model": "link_budget", "tx_power_dbm": -4},
}
"""Two terminals in a street of faint clutter."""
STEPS = (1e-4, 1e-3, 1e-2, 1e-1)
FRAME = 7.7824e-3


class Flight:
    """One terminal (isotropic, 0 dBi) over a crossing of metal, and the field planned for it."""

    def __init__(
        self, waypoints: Sequence[tuple[float, Sequence[float]]], seed: int = 3, **clutter: float
    ) -> None:
        way = [{"time_s": t, "position_m": list(x)} for t, x in waypoints]
        tree: dict[str, Any] = {
            "seed": seed,
            "frames": max(round(waypoints[-1][0] / FRAME), 4),
            "swarm": {"A": {"role": "active", "waypoints": way}},
            "receiver_preset": "plain",
            "city": CROSSING,
            "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
            "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
            "clutter": {"model": "field", **clutter},
        }
        s = Scenario.model_validate(tree)
        self.city = crossing()
        self.tracer: Any = propagation_in(self.city, s)
        self.field = self.tracer.field
        self.way = swarm_of(s).trajectories["A"]

    def pose(self, time: float) -> Pose:
        """In local coordinates."""
        pose = self.way.pose(time)
        return replace(pose, position=pose.position - self.city.origin)

    def seen(self, time: float) -> Any:
        """What the terminal sees."""
        pose = self.pose(time)
        return self.field.seen(LinkState(Link("A", "A"), time, pose, pose))

    def waves(self, seen: Any) -> np.ndarray:
        """(K,) complex amplitude of each scatterer, carrier phase included."""
        return (
            self.field.cells.amplitude[seen.index]
            * seen.magnitude
            * np.exp(-2j * np.pi * np.mod(seen.length / WAVELENGTH, 1.0))
        )


@cache
def crossing() -> CityMesh:
    """Four blocks of metal about two streets."""
    s = Scenario.model_validate(
        {
            "swarm": {"A": {"role": "active", "position_m": [0, 0, 5]}},
            "receiver_preset": "plain",
            "city": CROSSING,
            "propagation": {"model": "ray_traced"},
        }
    )
    return load_city(s.city, ".", truths.CARRIER, (0.4, -0.3, 0.2))


def _sum(cell: np.ndarray, waves: np.ndarray, count: int = 1200) -> np.ndarray:
    return np.bincount(cell, waves.real, count) + 1j * np.bincount(cell, waves.imag, count)


@traced(
    "distance in long double",
    "1e-6 rad",
    "float64 delays of 100 m are good to 1e-10 rad; float32 ones to 1e-2 rad",
)
def phase_of_scatterers_in_flight() -> Errors:
    """Carrier phase of each scatterer in sight, up to 100 mm after a place of the flight."""
    flight = Flight(STREETS[2], cell_area_per_metre_m=8.0, smallest_cell_m2=2.0)
    for time in (0.13, 1.29):
        for step in STEPS:
            when = time + step / float(np.linalg.norm(flight.pose(time).velocity))
            seen, place = flight.seen(when), truths.wide(flight.pose(when).position)
            span = truths.wide(flight.field.cells.points[seen.index]) - place
            yield (
                np.abs(
                    2 * np.pi / WAVELENGTH * (seen.length - 2 * np.sqrt((span * span).sum(1)))
                ).max()
            )


def _separate(flight: Flight, caster: Any, place: np.ndarray) -> np.ndarray:
    """Range profile from the list of scatterers alone: Lambert on metal, float64, shadows by
    trimesh's ray caster."""
    cells = flight.field.cells
    normals, span = flight.city.normals[cells.face], place - cells.points
    r, up = np.linalg.norm(span, axis=1), (span * normals).sum(1)
    way = cells.points + 3e-3 * np.sign(up)[:, None] * normals - place
    where, ray, _ = caster.intersects_location(
        np.broadcast_to(place, way.shape), way, multiple_hits=True
    )
    before = np.linalg.norm(where - place, axis=1) < np.linalg.norm(way[ray], axis=1) - 1e-6
    free = np.bincount(ray[before], minlength=r.size) == 0
    size = (
        free
        * WAVELENGTH
        / (4 * np.pi)
        * SHARE
        * np.abs(up)
        / r
        * np.sqrt(cells.area / np.pi)
        / r**2
    )
    return _sum(
        (r / CELL).astype(int),
        cells.amplitude * size * np.exp(-2j * np.pi * np.mod(2 * r / WAVELENGTH, 1.0)),
    )


@traced(
    "float64 sum over the list of scatterers, sight by trimesh's ray caster at every place",
    "0.01 of one",
    "the separate sum switches at shadow edges, the field crosses them by the knife edge's factor",
)
def coherence_of_the_clutter_field() -> float:
    """What the correlation of range profiles lacks of one, after steps of 0.1 to 100 mm from 21
    places along, across and over a street."""
    worst = 1.0
    for street in STREETS:
        flight = Flight(street, cell_area_per_metre_m=4.0, smallest_cell_m2=0.8)
        caster = trimesh.ray.ray_triangle.RayMeshIntersector(
            trimesh.Trimesh(flight.city.vertices, flight.city.faces, process=False)
        )
        for time in np.linspace(0.13, 1.83, 7):
            for step in STEPS:
                when = time + step / float(np.linalg.norm(flight.pose(time).velocity))
                seen, truth = (
                    flight.seen(when),
                    _separate(flight, caster, flight.pose(when).position),
                )
                found = _sum((seen.length / 2 / CELL).astype(int), flight.waves(seen))
                worst = min(
                    worst,
                    float(
                        abs(np.vdot(found, truth)) / (np.linalg.norm(found) * np.linalg.norm(truth))
                    ),
                )
    return 1 - worst


@traced(
    "the same cell with the sight of one frame before, in a sum of its own; mean power over "
    "2 m and 15 frames",
    "0.15 of the local rms",
    "asked for; sight that switches changes a cell by all of its scatterer",
)
def sight_alone_changes_no_range_cell_at_once() -> float:
    """Largest change that births and deaths make in a range cell from frame to frame, on 50 m up a
    street and round its corner."""
    flight = Flight(ROUND_A_CORNER, cell_area_per_metre_m=0.15, smallest_cell_m2=0.05)
    cells, jumps, power = flight.field.cells, [], []
    before: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    for time in (np.arange(round(5.0 / FRAME)) + 0.5) * FRAME:
        pose, seen = flight.pose(time), flight.seen(time)
        share, waves, mean = (
            flight.field.visibility.share("A", pose, time),
            np.zeros(len(cells), complex),
            np.zeros(len(cells)),
        )
        waves[seen.index], mean[seen.index] = flight.waves(seen), seen.magnitude**2
        cell = (np.linalg.norm(cells.points - pose.position, axis=1) / CELL).astype(int)
        if before is not None:
            old, old_share, old_cell = before
            with np.errstate(divide="ignore", invalid="ignore"):
                change = np.where(old_share > 0, old * (share / old_share - 1), waves)
            jumps.append(_sum(np.where(old_share > 0, old_cell, cell), change, 800))
        power.append(np.bincount(cell, mean, 800))
        before = waves, share, cell
    smooth = ndimage.uniform_filter(np.array(power), (15, 8), mode="nearest")[1:]
    held = smooth > 1e-4 * np.array(power).sum(axis=1).mean()
    return (
        float((np.abs(np.array(jumps))[held] / np.sqrt(smooth[held])).max())
        if held.sum() > 10_000
        else np.inf
    )


@traced(
    "the exponential law of |sum|^2 over its mean (Kolmogorov and Smirnov), and its tail "
    "beyond 5 and 8 times the mean",
    "1 of the bounds",
    "sqrt(n) D up to 2.23 is a false-alarm rate of 1e-4; tails within four standard deviations",
)
def speckle_of_range_doppler_cells() -> float:
    """Amplitudes of every cell of range and Doppler that holds 1e-4 of the power, of 12 fields,
    seen in flight, are Rayleigh."""
    level = []
    for seed in range(12):
        flight = Flight(
            ((0.0, (-2.1, -9.7, 7.3)), (0.2, (-1.84, -7.88, 7.38))),
            seed,
            cell_area_per_metre_m=0.3,
            smallest_cell_m2=0.2,
        )
        seen = flight.seen(0.09)
        doppler = np.rint(-seen.rate / WAVELENGTH * 1.013e-4 * 64).astype(int)
        _, inverse = np.unique(
            (seen.length / 2 / CELL).astype(int) * 4096 + doppler + 2048, return_inverse=True
        )
        mean = np.bincount(inverse, seen.magnitude.astype(float) ** 2)
        filled = mean > 1e-4 * mean.sum()
        level.append(
            np.abs(_sum(inverse, flight.waves(seen), mean.size)[filled]) ** 2 / mean[filled]
        )
    sample = np.concatenate(level)
    tails = [(sample.size * np.exp(-b), (sample > b).sum()) for b in (5.0, 8.0)]
    worst = [float(np.sqrt(sample.size) * stats.kstest(sample, stats.expon.cdf).statistic / 2.23)]
    worst += [float(abs(found - expected) / (4 * np.sqrt(expected))) for expected, found in tails]
    return max(worst) if sample.size > 3_000 else np.inf


@traced(
    "2 v.u/lambda of the scatterers' places, two Doppler cells to either side",
    "0.02 of a cell's energy",
    "a Hann window's main lobe is four cells wide and holds all but 1e-4; speckle may leave "
    "little near the middle",
)
def doppler_of_range_cells() -> Errors:
    """Energy of a range cell's spectrum outside the Doppler of its surfaces; a terminal that
    hovers, cruises, climbs and turns."""
    flights = (
        ((0.0, (-2.1, -9.7, 7.3)), (0.2, (-2.1, -9.7, 7.3))),
        ((0.0, (-2.1, -9.7, 7.3)), (0.2, (-1.84, -7.88, 7.38))),
        ((0.0, (1.7, -12.2, 6.4)), (0.2, (1.76, -12.02, 7.94))),
        ((0.0, (-1.1, -6.2, 8.1)), (0.1, (-0.7, -5.3, 8.1)), (0.2, (0.3, -4.9, 8.2))),
    )
    for way in flights:
        yield from _outside(Flight(way, cell_area_per_metre_m=0.3, smallest_cell_m2=0.2))


def _outside(flight: Flight, pulse: float = 1.013e-4, pulses: int = 64) -> Errors:
    """Largest share of a range cell's energy outside its surfaces' Doppler."""
    first, start, rows = flight.seen(0.09), flight.pose(0.09), []
    points = flight.field.cells.points
    for time in 0.09 + pulse * (np.arange(pulses) - pulses / 2):
        seen = flight.seen(time)
        span = np.linalg.norm(
            points[seen.index] - start.position, axis=1
        )  # a scatterer stays in its range cell
        rows.append(_sum((span / CELL).astype(int), flight.waves(seen)))
    spectrum = (
        np.abs(np.fft.fft(np.array(rows) * np.hanning(pulses + 1)[:pulses, None], axis=0)) ** 2
    )
    towards = points[first.index] - start.position
    span = np.linalg.norm(towards, axis=1)
    expected = 2 / WAVELENGTH * (towards / span[:, None]) @ start.velocity * pulse * pulses
    cell, power = (span / CELL).astype(int), first.magnitude.astype(float) ** 2
    for i in np.flatnonzero(np.bincount(cell, power, 1200) > 1e-3 * power.sum()):
        off = (np.arange(pulses) - expected[cell == i][:, None] + pulses / 2) % pulses - pulses / 2
        inside = (np.abs(off) <= 2.0).any(axis=0)
        yield spectrum[~inside, i].sum() / spectrum[:, i].sum()


@traced(
    "all scatterers, each in the cell of its own length and rate",
    "0.2 dB",
    "asked for: what nine of ten cells keep to by default; cells and limits here are written apart",
)
def noise_and_merged_clutter() -> Errors:
    """Noise plus mean clutter of range-Doppler cells in a street, with scatterers merged under the
    noise of each of two links: the error that nine of ten cells keep to."""
    setup = prepare(Scenario.model_validate(FAINT))
    field, w = setup.propagation.field, setup.waveform  # type: ignore[attr-defined]  # a ray tracer
    for link in (Link("A", "A"), Link("A", "P")):
        for frame in (2, 31, 58):
            time = setup.timetable.epoch(frame)
            poses = setup.swarm.poses(time)
            start, end = (
                replace(poses[name], position=poses[name].position - setup.city.origin)
                for name in link
            )
            maps = []
            for some in (field.whole(), field):
                seen = some.seen(LinkState(link, time, start, end))
                gain = (
                    seen.magnitude**2
                    * setup.antennas.element_gain(start.to_body(seen.departure))
                    * setup.antennas.element_gain(end.to_body(seen.arrival))
                )
                heard = seen.length < setup.plan.reach * 2
                rows = np.round(seen.length / w.range_cell(1))[heard]
                columns = np.round(seen.rate / w.velocity_cell(1))[heard]
                edges = np.arange(0, 2000) - 0.5, np.arange(-200, 201) - 0.5
                maps.append(np.histogram2d(rows, columns, edges, weights=gain[heard])[0])
            level = setup.plan.amplitudes[link.tx] ** 2 * w.num_samples * w.num_chirps
            every, some = (m * level / setup.noise_power(poses, link) for m in maps)
            held = (every > 0) | (some > 0)
            off = np.abs(10 * np.log10((1 + some) / (1 + every)))[held]
            yield float(np.quantile(off, 0.9))


@traced(
    "Sionna RT's diffuse solution with 1e6 rays, over cells of 4 m that hold a thousandth of "
    "the power",
    "1 of the bounds",
    "asked for: 0.05 dB for the median and for each total, 0.2 dB for nine cells of ten",
)
def mean_power_of_a_street() -> float:
    """Mean power by range in a street of concrete, from two places of a flight to itself and to a
    second terminal."""
    way = {"A": ((2.4, -22.7, 12.3), (-0.9, 7.7, 0.6)), "P": ((-1.3, 17.9, 13.1), (0.7, -4.1, 0.3))}
    s = Scenario.model_validate(
        {
            "frames": 400,
            "swarm": {
                n: {"role": r, "position_m": way[n][0], "velocity_mps": way[n][1]}
                for n, r in (("A", "active"), ("P", "passive"))
            },
            "receiver_preset": "plain",
            "city": {
                "source": "canyon",
                "street_width_m": 29.3,
                "street_length_m": 87.0,
                "building_height_m": 23.4,
            },
            "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
            "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
            "clutter": {"model": "field", "cell_area_per_metre_m": 0.024},
        }
    )
    swarm = swarm_of(s)
    city = load_city(
        s.city, ".", truths.CARRIER, (np.array(way["A"][0]) + np.array(way["P"][0])) / 2
    )
    field = propagation_in(city, s).field  # type: ignore[attr-defined]  # a ray tracer
    cells, totals = [], []
    for time in (0.02, 400 * FRAME - 0.02):
        poses = {
            n: replace(p, position=p.position - city.origin) for n, p in swarm.poses(time).items()
        }
        for rx, step in (("A", 8.0), ("P", 4.0)):
            edges = np.arange(0, 4000, step)
            truth = sionna_power(city, poses["A"].position, poses[rx].position, edges)
            seen = field.seen(LinkState(Link("A", rx), time, poses["A"], poses[rx]))
            found = np.histogram(seen.length, edges, weights=seen.magnitude**2)[0]
            filled = truth > 1e-3 * truth.sum()
            cells.append(10 * np.log10(np.maximum(found[filled], 1e-30) / truth[filled]))
            totals.append(10 * np.log10(found.sum() / truth.sum()))
    off = np.concatenate(cells)
    return float(
        max(
            abs(np.median(off)) / 0.05,
            np.quantile(np.abs(off), 0.9) / 0.2,
            np.abs(totals).max() / 0.05,
        )
    )


def sionna_power(
    city: CityMesh,
    start: np.ndarray,
    end: np.ndarray,
    edges: np.ndarray,
    rays: int = 1_000_000,
    *,
    by_mirror: bool = False,
) -> np.ndarray:
    """Power gain of Sionna's diffuse paths between two isotropic, vertically polarised points, by
    cells of length [m]; `by_mirror`: of those that one mirror sends on to the scatterer."""
    import mitsuba as mi
    import sionna.rt as rt

    from isac_rt.world.city.scene import build_scene

    scene = build_scene(city, truths.CARRIER).scene
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )
    scene.add(rt.Transmitter("tx", mi.Point3f(*start.tolist())))
    scene.add(rt.Receiver("rx", mi.Point3f(*end.tolist())))
    options = {
        "los": False,
        "specular_reflection": by_mirror,
        "diffuse_reflection": True,
        "refraction": False,
    }
    depth = 2 if by_mirror else 1
    found = rt.PathSolver()(
        scene, max_depth=depth, samples_per_src=rays, max_num_paths_per_src=depth * rays, **options
    )
    real, imag = (np.asarray(x, np.float64).ravel() for x in found.a)
    length, power = 299_792_458.0 * np.asarray(found.tau, np.float64).ravel(), real**2 + imag**2
    if by_mirror:
        kind = np.asarray(found.interactions).reshape(2, -1)
        wanted = (kind[0] == rt.InteractionType.SPECULAR) & (kind[1] == rt.InteractionType.DIFFUSE)
        length, power = length[wanted], power[wanted]
    return np.histogram(length, edges, weights=power)[0]
