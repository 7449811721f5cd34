"""Clutter of two bounces, a mirror before or after the scatterer: against Fermat, field vectors,
integrals, Sionna, and a separate sum."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize
from test_clutter_against_sionna import STREET
from test_clutter_field import (
    F_C,
    LAMBDA,
    METAL,
    C,
    flown,
    hemisphere,
    joined,
    lobe,
    rectangle,
    slab,
)
from truths.clutter import STREETS, Flight, sionna_power
from truths.truths import slab_reflection

from isac_rt import scenario
from isac_rt.extensions.city_receivers.expectation import MeshExpectation
from isac_rt.frame.antennas import Arrays, antennas_of
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.simulation.setup import propagation_in, swarm_of
from isac_rt.world.city import CityMesh, Material, load_city
from isac_rt.world.swarm import Pose

pytestmark = pytest.mark.sionna


def coefficients(material: Material, cos: float) -> np.ndarray:
    """Amplitude reflection of a slab, TE and TM, less what it scatters."""
    of = material.relative_permittivity, material.conductivity, material.thickness
    kept = np.sqrt(1 - material.scattering_coefficient**2)
    return kept * np.array(slab_reflection(*of, cos))


def reflected(
    field: np.ndarray, along: np.ndarray, normal: np.ndarray, material: Material
) -> tuple[np.ndarray, np.ndarray]:
    """Field vector and direction of a wave after a mirror: TE across the plane of incidence, TM in
    it."""
    n = -np.sign(along @ normal) * normal
    te, tm = coefficients(material, -along @ n)
    out = along + 2 * (-along @ n) * n
    s = np.cross(along, n) / np.linalg.norm(np.cross(along, n))
    return te * (field @ s) * s + tm * (field @ np.cross(s, along)) * np.cross(s, out), out


def upright(u: np.ndarray) -> np.ndarray:
    """Unit vector across u in its vertical plane, downwards."""
    t = u[2] * u - np.array([0, 0, 1.0])
    return t / np.linalg.norm(t)


def scattered(
    field: np.ndarray,
    u: np.ndarray,
    w: np.ndarray,
    normal: np.ndarray,
    material: Material,
    area: float,
) -> complex:
    """Upright amplitude along w, times distances, of a facet lit by a field along u; no lambda/(4
    pi)."""
    n = -np.sign(u @ normal) * normal
    returned, _ = reflected(field, u, n, replace(material, scattering_coefficient=0.0))
    gamma = np.linalg.norm(returned) / np.linalg.norm(field)
    turned = np.array([np.sqrt(1 - (u @ n) ** 2), u @ n, 0.0])
    pattern = lobe(material, u, w, n) / hemisphere(material, turned)
    return (
        material.scattering_coefficient
        * gamma
        * complex(field @ upright(u))
        * np.sqrt(pattern * (-u @ n) * area)
    )


def bounce_point(a: np.ndarray, b: np.ndarray, corner, along, across) -> tuple[np.ndarray, float]:
    """Where the shortest way from a to b by way of a rectangle's plane meets it, and its length; by
    minimisation (Fermat)."""
    p, e, f = (np.array(v, float) for v in (corner, along, across))

    def way(x):
        q = p + x[0] * e + x[1] * f
        return np.linalg.norm(a - q) + np.linalg.norm(b - q)

    best = minimize(
        way,
        [0.5, 0.5],
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-13, "maxiter": 2000},
    )
    return p + best.x[0] * e + best.x[1] * f, best.fun


WALL = ((-6.1, 12.0, -4.0), (11.0, 2.3, 0.7), (0.4, 3.1, 9.0))
GROUND = ((-30.0, -25.0, -5.1), (60.0, 1.3, 0.4), (-0.7, 60.0, 0.3))


@pytest.mark.parametrize("pattern", ["lambertian", "directive"])
def test_each_way_against_an_oracle(pattern):
    """Ways over a slanting wall by way of a sloping ground (and the reverse), one at a time: length
    by Fermat's principle, gain (complex) from vectors of the electric field, rate and acceleration
    from differences of the lengths over 1 ms, directions and points.

    Planted bugs: the image's velocity not mirrored; TE and TM of the mirror exchanged; the ground's
    scattered share not taken off.
    """
    facet, soil = (
        slab(scattering_pattern=pattern, pattern_exponent=5),
        slab(relative_permittivity=4.1, conductivity=2.3),
    )
    city = joined(rectangle(*WALL, facet), rectangle(*GROUND, soil))
    model, swarm = flown(
        city, (0.3, -1.1, 0.9), (-7.7, 1.4, 2.2), cell_area_per_metre_m=0.5, mirrors=2
    )
    still = swarm.poses(0.0)
    discs = {
        "A": replace(
            still["A"], velocity=np.array([3.1, -7.3, 1.9]), acceleration=np.array([0.7, 1.1, -2.3])
        ),
        "P": replace(
            still["P"], velocity=np.array([-5.2, 2.4, 0.6]), acceleration=np.array([-1.7, 0.2, 0.9])
        ),
    }
    level = np.cross(*(np.array(v) for v in GROUND[1:]))
    level /= np.linalg.norm(level)
    upward = np.cross(*(np.array(v) for v in WALL[1:]))
    upward /= np.linalg.norm(upward)

    def place(body: Pose, t: float) -> np.ndarray:
        return body.position + t * body.velocity + t**2 / 2 * body.acceleration

    def mirrored(x: np.ndarray) -> np.ndarray:
        return x - 2 * ((x - np.array(GROUND[0])) @ level) * level

    checked = {True: 0, False: 0}
    for tx, rx in (("A", "P"), ("A", "A")):
        start, end = discs[tx], discs[rx]
        sets = model.two_bounces.paths(LinkState(Link(tx, rx), 0.0, start, end), model._free.arrays)
        for part, paths in zip(
            model.two_bounces.seen(LinkState(Link(tx, rx), 0.0, start, end)), sets, strict=True
        ):
            if part.mirror.faces[0] < 2:  # the ground in the wall
                continue
            for i in range(0, len(part.seen.index), 7):
                cell = part.seen.index[i]
                point, area = model.field.cells.points[cell], model.field.cells.area[cell]
                body = start if part.before else end
                at, way = bounce_point(body.position, point, *GROUND)
                r = np.linalg.norm(point - (end if part.before else start).position)
                assert part.seen.length[i] == pytest.approx(way + r, rel=0, abs=1e-9)
                chain = [at, point] if part.before else [point, at]
                assert (
                    np.abs(paths.points[i] - chain).max() < 1e-3
                )  # Fermat's minimum is flat: the root of its tolerance
                stops = [start.position, *paths.points[i], end.position]
                segments = [(b - a) / np.linalg.norm(b - a) for a, b in pairwise(stops)]
                if part.before:
                    field, _ = reflected(upright(segments[0]), segments[0], level, soil)
                    gain = scattered(field, segments[1], segments[2], upward, facet, area)
                else:
                    passed, out = reflected(upright(segments[1]), segments[1], level, soil)
                    gain = scattered(
                        upright(segments[0]), segments[0], segments[1], upward, facet, area
                    ) * complex(passed @ upright(out))
                gain *= (
                    LAMBDA / (4 * np.pi) / (way * r) * complex(model.field.cells.amplitude[cell])
                )
                assert abs(paths.gain[i] / gain - 1) < 3e-4  # the slab's table, 4096 angles
                assert part.seen.departure[i] == pytest.approx(segments[0], abs=1e-12)
                assert part.seen.arrival[i] == pytest.approx(-segments[2], abs=1e-12)
                lengths = []
                for t in (-1e-3, 0.0, 1e-3):
                    a, b = place(start, t), place(end, t)
                    a, b = (mirrored(a), b) if part.before else (a, mirrored(b))
                    lengths.append(np.linalg.norm(point - a) + np.linalg.norm(point - b))
                assert abs(part.seen.length[i] - lengths[1]) * 2 * np.pi / LAMBDA < 1e-6
                assert part.seen.rate[i] == pytest.approx(
                    (lengths[2] - lengths[0]) / 2e-3, abs=1e-4
                )
                assert part.seen.accel[i] == pytest.approx(
                    (lengths[2] - 2 * lengths[1] + lengths[0]) / 1e-6, abs=1e-3
                )
                checked[part.before] += 1
    assert min(checked.values()) > 6


def power(part) -> float:
    return float((part.seen.magnitude.astype(float) ** 2).sum())


def test_mirrors_are_those_that_send_on_the_most():
    """Shares of three metal plates against the solid angle of a rectangle times (1 - S^2)/4 pi,
    within 5 % (cells of some degrees), and the order by share; of coplanar faces of two materials
    each is a mirror. Planted bug: the cosine left out."""
    plates = [
        rectangle((-8.0, 11.0, -6.0), (16.0, 0, 0), (0, 0, 12.0), METAL),
        rectangle((-20.0, -20.0, -7.0), (40.0, 0, 0), (0, 31.0, 0), METAL),
        rectangle(
            (8.0, 11.0, -6.0),
            (5.0, 0, 0),
            (0, 0, 12.0),
            slab(conductivity=1e7, scattering_coefficient=0.2),
        ),
    ]
    model, _ = flown(joined(*plates), (0.0, 0.0, 0.0), mirrors=8)

    def solid(x0, x1, y0, y1, d):
        def corner(x, y):
            return np.arctan(x * y / (d * np.sqrt(x * x + y * y + d * d)))

        return corner(x1, y1) - corner(x0, y1) - corner(x1, y0) + corner(x0, y0)

    expected = [
        (1 - 0.43**2) * solid(-8, 8, -6, 6, 11) / (4 * np.pi),
        (1 - 0.43**2) * solid(-20, 20, -20, 11, 7) / (4 * np.pi),
        (1 - 0.2**2) * solid(8, 13, -6, 6, 11) / (4 * np.pi),
    ]
    mirrors = model.two_bounces.mirrors["A"]
    assert [int(m.faces[0]) // 2 for m in mirrors] == [1, 0, 2]
    assert [m.share for m in mirrors] == [
        pytest.approx(expected[k], rel=0.05, abs=0) for k in (1, 0, 2)
    ]


def street(material: str):
    """A street of walls and ground of one material, two terminals in flight along it, every mirror
    taken."""
    s = scenario.Scenario.model_validate(
        {
            "frames": 40,
            "swarm": {
                "A": {
                    "role": "active",
                    "position_m": [2.4, -22.7, 12.3],
                    "velocity_mps": [-0.9, 7.7, 0.6],
                },
                "P": {
                    "role": "passive",
                    "position_m": [-1.3, 17.9, 13.1],
                    "velocity_mps": [0.7, -4.1, 0.3],
                },
            },
            "receiver_preset": "plain",
            "city": STREET
            | {f"{part}_material": material for part in ("wall", "roof", "ground")}
            | {"materials": {material: {"scattering_coefficient": 0.41}}},
            "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
            "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
            "clutter": {"model": "field", "cell_area_per_metre_m": 0.024, "mirrors": 12},
        }
    )
    city = load_city(s.city, ".", F_C, (0.4, -1.3, 12.0))
    return city, propagation_in(city, s), swarm_of(s)


@pytest.mark.parametrize(
    ("material", "rays"),
    [("concrete", 3_000_000), pytest.param("metal", 3_000_000, marks=pytest.mark.slow)],
)
def test_mean_power_by_way_of_mirrors_is_sionnas(material, rays):
    """A street with all its mirrors, monostatic and bistatic, by 4 m of range: median and total
    within 0.05 dB, 90th percentile of the cells that hold a thousandth of the power within 0.3 dB
    (of the rays, a tenth take such a way).

    Sionna keeps one path per plane of those that scatter first (the hash of a specular suffix does
    not know the point before it), so that order is compared with the reverse link's other order: on
    metal, where Gamma is 1 from every side. Planted bug: the mirror's loss squared.
    """
    city, model, swarm = street(material)
    poses = {n: replace(p, position=p.position - city.origin) for n, p in swarm.poses(0.13).items()}
    pairs = [("A", "A", True, "A", "A"), ("A", "P", True, "A", "P")] + [
        ("A", "P", False, "P", "A")
    ] * (material == "metal")
    for tx, rx, before, source, sink in pairs:
        edges = np.arange(0, 1500, 8 if tx == rx else 4)
        theirs = sionna_power(
            city, poses[source].position, poses[sink].position, edges, rays, by_mirror=True
        )
        ours = np.zeros(edges.size - 1)
        for part in model.two_bounces.seen(LinkState(Link(tx, rx), 0.13, poses[tx], poses[rx])):
            if part.before == before:
                ours += np.histogram(
                    part.seen.length, edges, weights=part.seen.magnitude.astype(float) ** 2
                )[0]
        filled = theirs > 1e-3 * theirs.sum()
        off = 10 * np.log10(ours[filled] / theirs[filled])
        print(
            f"{material} {tx}->{rx} before={before}: {filled.sum()} cells, median "
            f"{np.median(off):.3f}, 90th percentile "
            f"{np.quantile(np.abs(off), 0.9):.3f}, total "
            f"{10 * np.log10(ours.sum() / theirs.sum()):.3f} dB"
        )
        assert filled.sum() > 8
        assert abs(np.median(off)) < 0.05
        assert np.quantile(np.abs(off), 0.9) < 0.3
        assert abs(10 * np.log10(ours.sum() / theirs.sum())) < 0.05


def profile(length: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Coherent sum per range cell of 0.25 m; `length` there and back [m]."""
    wave, cell = gain * np.exp(-2j * np.pi * (length / LAMBDA % 1)), (length / 0.5).astype(int)
    return np.bincount(cell, wave.real, 1000) + 1j * np.bincount(cell, wave.imag, 1000)


def correlation(p: np.ndarray, q: np.ndarray) -> float:
    return float(abs(np.vdot(p, q)) / (np.linalg.norm(p) * np.linalg.norm(q)))


class Separate:
    """Two-bounce profiles of a terminal's own link from a list of scatterers, in code of its own:
    Lambert on metal, images of the scatterers (not of the terminal) in the planes of faces, shadows
    and mirrors by trimesh's ray caster."""

    def __init__(self, city: CityMesh, points, strength, normals, planes) -> None:
        self.points, self.strength, self.normals, self.planes, self.city = (
            points,
            strength,
            normals,
            planes,
            city,
        )
        self.caster = trimesh.ray.ray_triangle.RayMeshIntersector(
            trimesh.Trimesh(city.vertices, city.faces, process=False)
        )

    def _first(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """(K,) distance from `start` along the way to `end` of the first face, inf without one
        before the end."""
        where, ray, _ = self.caster.intersects_location(start, end - start, multiple_hits=True)
        away = np.linalg.norm(where - start[ray], axis=1)
        out = np.full(len(start), np.inf)
        np.minimum.at(
            out, ray, np.where(away < np.linalg.norm(end - start, axis=1)[ray] - 1e-6, away, np.inf)
        )
        return out

    def at(self, place: np.ndarray) -> np.ndarray:
        total = np.zeros(1000, complex)
        for faces in self.planes:
            n, d = self.city.normals[faces[0]], self.city.plane_offsets[faces[0]]
            above, up = n @ place - d, self.points @ n - d
            here = np.flatnonzero(above * up > 1e-2 * abs(above))
            image = self.points[here] - 2 * up[here, None] * n
            at = place + (above / (above + up[here]))[:, None] * (image - place)
            around = trimesh.triangles.points_to_barycentric
            on_wall = np.zeros(here.size, bool)
            for f in faces:
                on_wall |= (
                    around(np.broadcast_to(self.city.corners[f], (here.size, 3, 3)), at) >= 0
                ).all(axis=1)
            here, at, image = here[on_wall], at[on_wall], image[on_wall]
            side = (
                np.sign(((at - self.points[here]) * self.normals[here]).sum(1))[:, None]
                * self.normals[here]
            )
            lifted, before = self.points[here] + 3e-3 * side, at + 3e-3 * np.sign(above) * n
            free = np.isinf(self._first(lifted, before)) & np.isinf(
                self._first(before, np.broadcast_to(place, at.shape))
            )
            r1, r2 = (
                np.linalg.norm(image - place, axis=1),
                np.linalg.norm(self.points[here] - place, axis=1),
            )
            into = ((at - self.points[here]) * side).sum(1) / np.linalg.norm(
                at - self.points[here], axis=1
            )
            back = ((place - self.points[here]) * side).sum(1) / r2
            gain = (
                self.strength[here]
                * (free & (back > 0))
                * np.sqrt(np.maximum(into * back, 0))
                / (r1 * r2)
            )
            total += profile(r1 + r2, gain)
        return total


@pytest.mark.parametrize("street", [0, 2], ids=["along", "climbing"])
def test_ways_by_mirrors_are_coherent_with_a_separate_sum(street):
    """Correlation of the range profile of all two-bounce ways (mirror first) over the crossing's
    mirrors >= 0.99 after steps of 0.1 to 100 mm from three places of a flight, against a separate
    sum over the scatterers exported once; the field's strengths without the mirrors' polarisation
    are what both use, so that delays and sight are what is compared.

    The separate sum switches at the edges of mirrors too, of which there are more than shadow
    edges. Planted bug: the image at the last time sample in place of the pose.
    """
    way = Flight(STREETS[street], 1, cell_area_per_metre_m=4.0, smallest_cell_m2=0.8, mirrors=4)
    city, model = way.city, way.tracer
    cells = model.field.cells
    amplitude = np.asarray(cells.amplitude, complex)
    strength, walls = (
        amplitude * np.sqrt(cells.area),
        [m.faces for m in model.two_bounces.mirrors["A"]],
    )
    separate = Separate(city, cells.points, strength, city.normals[cells.face], walls)
    worst, count = 1.0, 0
    for time in (0.13, 0.97, 1.71):
        speed = np.linalg.norm(way.pose(time).velocity)
        for step in (1e-4, 1e-3, 1e-2, 1e-1):
            when = time + step / speed
            local = way.pose(when)
            total = np.zeros(1000, complex)
            shares = {
                id(m): np.zeros(len(cells), np.float32) for m in model.two_bounces.mirrors["A"]
            }
            for m, (index, share) in zip(
                model.two_bounces.mirrors["A"],
                model.two_bounces._share("A", local, when),
                strict=True,
            ):
                shares[id(m)][index] = share
            straight = model.field.visibility.share("A", local, when)
            for part in model.two_bounces.seen(LinkState(Link("A", "A"), when, local, local)):
                if part.before:
                    q, n = part.seen, city.normals[cells.face[part.seen.index]]
                    points, _ = model.two_bounces._chain(
                        part, LinkState(Link("A", "A"), when, local, local)
                    )
                    into = points[:, 0] - points[:, 1]
                    cosines = (
                        np.abs((into * n).sum(1))
                        / np.linalg.norm(into, axis=1)
                        * np.abs((q.arrival * n).sum(1))
                    )
                    sight = shares[id(part.mirror)][q.index] * straight[q.index]
                    gain = (
                        amplitude[q.index]
                        * np.sqrt(cells.area[q.index] * cosines)
                        * sight
                        / (q.tx_radius * q.rx_radius)
                    )
                    total += profile(q.length, gain)
                    count += len(q.index)
            worst = min(worst, correlation(total, separate.at(local.position)))
    assert count > 2000
    assert worst >= 0.99, worst


def test_what_a_terminal_expects_of_mirrors():
    """A terminal's copy of the mesh: the total power it expects by way of the mirrors within 0.2 dB
    of the field's (two draws of points of 5,000 cells), its delays by the distance from the
    image, and the directions in which both ways leave and come. Planted bugs: the straight way for
    that over the mirror; the departure taken for the arrival."""
    tree = {
        "frames": 40,
        "swarm": {"A": {"role": "active", "position_m": [0.3, -1.1, 0.9]}},
        "receiver_preset": "plain",
        "city": {"source": "canyon"},
        "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
        "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
        "clutter": {"model": "field", "cell_area_per_metre_m": 0.02, "mirrors": 2},
    }
    s = scenario.Scenario.model_validate(tree)
    w = waveform_of(s.radio, s.array)
    antennas, city = (
        antennas_of(s.array, w),
        joined(rectangle(*WALL, METAL), rectangle(*GROUND, METAL)),
    )
    model = propagation_in(city, s)
    swarm = swarm_of(s)
    copy = MeshExpectation(s.clutter, swarm, city, w, Arrays(antennas), s.seed)
    pose = swarm.poses(0.0)["A"]
    parts = copy._two_bounces.seen(LinkState(Link("A", "A"), 0.0, pose, pose))
    once = len(copy._own.seen(LinkState(Link("A", "A"), 0.0, pose, pose)).index)
    right = copy.clutter("A", pose, 0.0, 1.0)
    ours = sum(
        power(part) for part in model.two_bounces.seen(LinkState(Link("A", "A"), 0.0, pose, pose))
    )
    assert abs(10 * np.log10(right.power[once:].sum() / ours)) < 0.2
    begin = once
    for part in parts:
        n, place = part.mirror.normal, copy._field.cells.points[part.seen.index]
        image = pose.position - 2 * (n @ pose.position - part.mirror.offset) * n
        length = np.linalg.norm(place - image, axis=1) + np.linalg.norm(
            place - pose.position, axis=1
        )
        rows = slice(begin, begin + len(place))
        assert np.abs(C * right.delay[rows] - length).max() < 1e-7
        straight = (place - pose.position) / np.linalg.norm(place - pose.position, axis=1)[:, None]
        still = pose.position - 2 * (n @ pose.position - part.mirror.offset) * n
        bent = (place - still) / np.linalg.norm(place - still, axis=1)[:, None]
        bent = bent - 2 * (bent @ n)[:, None] * n  # from the terminal to where it meets the mirror
        ends = (bent, straight) if part.before else (straight, bent)
        for found, truth in zip((right.departure, right.arrival), ends, strict=True):
            assert np.abs(found[rows] - pose.to_body(truth)).max() < 1e-9
        begin = rows.stop
    assert begin == len(right)


def test_what_a_passive_terminal_expects_of_mirrors():
    """From where its transmitter is tracked to be, off both planned flights: the lengths of the
    ways over image points, directions, and the total power within 0.2 dB of the field's own with
    elements that send as on boresight. Planted bugs: the mirrors of one end alone; the own motion
    for the transmitter's; the element's gain towards the arrival left out."""
    tree = {
        "frames": 40,
        "swarm": {
            "A": {"role": "active", "position_m": [0.3, -1.1, 0.9]},
            "P": {"role": "passive", "position_m": [2.1, -3.4, 1.7], "boresight": [0, 1, 0]},
        },
        "receiver_preset": "plain",
        "city": {"source": "canyon"},
        "array": {"element_pattern": "cosine", "element_gain_dbi": 10 * float(np.log10(4))},
        "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
        "clutter": {"model": "field", "cell_area_per_metre_m": 0.02, "mirrors": 2},
    }
    s = scenario.Scenario.model_validate(tree)
    w = waveform_of(s.radio, s.array)
    antennas = antennas_of(s.array, w)
    city = joined(rectangle(*WALL, METAL), rectangle(*GROUND, METAL))
    swarm, link = swarm_of(s), Link("A", "P")
    copy = MeshExpectation(s.clutter, swarm, city, w, Arrays(antennas), s.seed)
    own = swarm.poses(0.0)["P"]
    sender = np.array([0.7, -1.3, 1.1, 3.1, -2.3, 0.7])
    start = replace(own, position=sender[:3], velocity=sender[3:])
    found = copy.between(link, 0.6, sender, own)
    state = LinkState(link, 0.0, start, own)
    straight = copy._field.from_places(state)
    once = int((own.to_body(straight.arrival)[:, 1] > 0).sum())  # nothing is heard from behind
    begin, lags = once, 1e-5
    for part in copy._two_bounces.from_places(state):
        ahead = own.to_body(part.seen.arrival)[:, 1] > 0
        place, m = copy._field.cells.points[part.seen.index[ahead]], part.mirror

        def imaged(point, m=m):
            return point - 2 * (point @ m.normal - m.offset) * m.normal

        scatter_paths = []
        for t in (-lags, 0.0, lags):
            ends = [sender[:3] + t * sender[3:], own.position + t * own.velocity]
            ends[0 if part.before else 1] = imaged(ends[0 if part.before else 1])
            scatter_paths.append(sum(np.linalg.norm(place - end, axis=1) for end in ends))
        rows = slice(begin, begin + len(place))
        assert np.abs(C * found.delay[rows] - scatter_paths[1]).max() < 1e-9
        assert (
            np.abs(
                C * found.delay_rate[rows] - (scatter_paths[2] - scatter_paths[0]) / (2 * lags)
            ).max()
            < 1e-4
        )
        target = (
            place if part.before else place - 2 * (place @ m.normal - m.offset)[:, None] * m.normal
        )
        towards = target - own.position
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        assert np.abs(found.arrival[rows] - own.to_body(towards)).max() < 1e-9
        begin = rows.stop
    assert begin == len(found)
    truth = propagation_in(city, s).two_bounces.seen(state)
    assert {part.before for part in truth} == {True, False}
    ours = sum(
        (
            antennas.gain
            * antennas.element_gain(own.to_body(part.seen.arrival))
            * (0.6 * part.seen.magnitude) ** 2
        ).sum()
        for part in truth
    )
    assert abs(10 * np.log10(found.power[once:].sum() / ours)) < 0.2
