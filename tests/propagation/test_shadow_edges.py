"""Line of sight and echoes across shadow edges of a city, and past the swarm's own bodies, in
traced scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special
from test_clutter_field import METAL, flown, rectangle
from test_diffraction import chopped
from truths.clutter import crossing

from isac_rt import scenario
from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.segments import edges as edges_of_cities
from isac_rt.propagation.segments.direct import direct_segments
from isac_rt.propagation.segments.discs import UavDiscs
from isac_rt.propagation.segments.edges import MOST_TRIED, Edges, near
from isac_rt.simulation.setup import propagation_in
from isac_rt.world.city import CityMesh
from isac_rt.world.city.mesh import empty_city
from isac_rt.world.swarm import Pose

pytestmark = pytest.mark.sionna
C, F_C = 299_792_458.0, 77e9
LAMBDA = C / F_C


def tracer(city: CityMesh, **radii):
    """A tracer for A (active), P (passive) and the target U, isotropic elements of 0 dBi, no mirror
    reflections."""
    uavs = {
        "A": {"role": "active", "position_m": [0, 0, 0]},
        "P": {"role": "passive", "position_m": [1, 0, 0]},
        "U": {
            "role": "target",
            "position_m": [2, 0, 0],
            "rcs": {"model": "constant", "value_dbsm": -11.3},
        },
    }
    for name in uavs:
        uavs[name]["body_radius_m"] = radii.get(name, 0.0)
    s = scenario.Scenario.model_validate(
        {
            "swarm": uavs,
            "receiver_preset": "plain",
            "city": {"source": "canyon"},
            "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
            "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
        }
    )
    return propagation_in(city, s)


def pose(position, velocity=(0.0, 0.0, 0.0)) -> Pose:
    return Pose(np.array(position, float), np.array(velocity, float), np.zeros(3), np.eye(3))


def one(paths, kind: PathKind):
    """The only path of a kind (by way of U, if by way of a body), or None."""
    found = np.flatnonzero((paths.kind == kind) & ((paths.target < 0) | (paths.target == 2)))
    assert found.size <= 1
    return paths.select(found) if found.size else None


def field(path) -> complex:
    """What arrives, carrier phase included."""
    return (
        0j
        if path is None
        else complex(path.gain[0] * np.exp(-2j * np.pi * np.mod(F_C * path.delay[0], 1.0)))
    )


def wave(distance: float) -> complex:
    return complex(np.exp(-2j * np.pi * np.mod(distance / LAMBDA, 1.0)))


def fresnel(nu: float) -> complex:
    return complex(special.erfc(nu * np.sqrt(0.5j * np.pi)) / 2)


WALL = rectangle((-70.3, 31.0, -90.0), (141.0, 0, 0), (0, 0, 90.0), METAL)
"""A half-plane whose upper edge is the line y = 31, z = 0; local coordinates are the world's."""


def test_line_of_sight_and_echo_of_a_half_plane():
    """P and U rise out of the shadow of a wall, 31 + 47 m from A: the line of sight follows the
    Fresnel integral of nu = h sqrt(2 (d1 + d2)/(lambda d1 d2)), amplitude and phase, the echo (both
    ways) its square.

    Within 3e-3 of the unoccluded field over -2.8 < nu < 8: between the small-angle nu and the true
    detour lies (h/d)^2/4 of the phase pi nu^2/2, 2e-4 of 100 rad. Planted bug: the detour's phase
    both in the gain and in the delay.
    """
    model, a = tracer(WALL), pose((-8.3, 0.0, -1.1))
    worst, dark = 0.0, 0
    for h in np.linspace(-0.55, 1.6, 16):  # of the edge over the path
        top = (
            (-1.1 * 47 / 78 + h) * 78 / 31
        )  # z = -top lies so that the path passes h under the edge
        end = pose((9.1, 78.0, -top))
        d = np.linalg.norm(end.position - a.position)
        at = a.position + 31 / 78 * (end.position - a.position)
        assert at[2] == pytest.approx(-h, abs=1e-12)
        # the edge is not square to the path: what counts is the height across both
        normal = np.cross([1.0, 0, 0], (end.position - a.position) / d)
        clearance = abs(h * normal[2]) / np.linalg.norm(normal) * np.sign(h)
        d1, d2 = d * 31 / 78, d * 47 / 78
        nu = clearance * np.sqrt(2 * (d1 + d2) / (LAMBDA * d1 * d2))
        poses = {"A": a, "P": end, "U": pose((60.0, -40.0, 3.0))}
        los = one(model.trace(poses, 0.0, [("A", "P")]).paths["A", "P"], PathKind.LINE_OF_SIGHT)
        expected = fresnel(nu) * wave(d)
        worst = max(worst, abs(field(los) / (LAMBDA / (4 * np.pi * d)) - expected))
        echo = one(
            model.trace(poses | {"U": end, "P": pose((60.0, -40.0, 3.0))}, 0.0, [("A", "A")]).paths[
                "A", "A"
            ],
            PathKind.TARGET,
        )
        whole = np.sqrt(10**-1.13 * LAMBDA**2 / (4 * np.pi) ** 3) / d**2
        worst = max(worst, abs(field(echo) / whole - expected**2))
        dark += nu > 0
        assert los.bent[0] == echo.bent[0] == (nu > 0)
    assert 8 < dark < 15
    assert worst < 3e-3, worst


def test_delay_rate_of_a_bent_path_is_its_delays():
    """In the shadow of the same wall, both ends in flight: delay_rate against central differences
    over 1 ms, 1e-13 (that is 0.01 Hz). Planted bug: the rate of the straight line."""
    model = tracer(WALL)
    step = 5e-4

    def at(t: float):
        a, p = pose((-8.3, 0.0, -1.1), (3.1, 1.7, -4.3)), pose((9.1, 78.0, -4.9), (-2.2, 5.9, 7.7))
        moved = {
            n: replace(q, position=q.position + t * q.velocity) for n, q in {"A": a, "P": p}.items()
        }
        return one(
            model.trace(moved | {"U": pose((60.0, -40.0, 3.0))}, 0.0, [("A", "P")]).paths["A", "P"],
            PathKind.LINE_OF_SIGHT,
        )

    before, now, after = at(-step), at(0.0), at(step)
    assert now.bent.all()
    assert now.delay_rate[0] == pytest.approx(
        (after.delay[0] - before.delay[0]) / (2 * step), rel=0, abs=1e-13
    )
    assert (
        np.linalg.norm(
            now.departure[0]
            - (np.array([9.1, 78.0, -4.9]) - [-8.3, 0.0, -1.1]) / np.linalg.norm([17.4, 78.0, -3.8])
        )
        > 0.01
    )


def test_nothing_is_switched_when_flying_round_a_corner():
    """P flies across the crossing's streets and over a roof's edge, in steps of 5 mm, in and out of
    A's sight: its line of sight (over Friis, carrier phase taken along the straight line out)
    changes by at most 0.09 from step to step. Its slope is at most 1/sqrt(2) per Fresnel unit (0.08
    m and more here) over the lever of the step. Planted bug: lit paths left at 1."""
    edges, worst, states = tracer(crossing())._edges, 0.0, set()
    a = pose((-2.1, -26.0, 7.3))
    for start, ahead in (
        ((24.0, 1.3, 8.9), (-1.0, 0.05, 0.0)),
        ((-21.3, 6.0, 9.0), (0.1, -0.2, 1.0)),
    ):
        places = np.array(start) + np.arange(0.0, 28.0, 0.005)[:, None] * np.array(ahead)
        poses = {"A": a} | {str(i): pose(q) for i, q in enumerate(places)}
        segments = direct_segments(
            poses, [("A", str(i)) for i in range(len(places))], edges, UavDiscs.of({}, {}), LAMBDA
        )
        distance = np.linalg.norm(places - a.position, axis=1)
        now = np.zeros(len(places), complex)
        for i, d in enumerate(distance):
            found = segments.get(("A", str(i)))
            states.add(None if found is None else bool(np.isfinite(found[1].points).all()))
            if found is not None:
                now[i] = found[0][0] * wave(found[1].length[0]) * 4 * np.pi * d / LAMBDA / wave(d)
        assert np.abs(now).min() < 0.02 and np.abs(now).max() > 1.1
        worst = max(worst, np.abs(np.diff(now)).max())
    assert states == {None, True, False}
    assert worst < 0.09, worst
    assert worst > 0.005


def test_bodies_shadow_what_is_behind_them_and_not_themselves():
    """U near the straight path from A to P, and P near that from A to U: the line of sight and the
    echo take a disc's factor, by strips, of the body in between; the bodies at the ends of a
    segment, and those of radius 0, none. Planted bug: the Fresnel unit of the near end alone.
    """
    a, p, u = pose((0.4, -0.7, 0.3)), pose((3.1, 41.3, 1.9)), pose((1.77, 17.9, 1.15))
    d = np.linalg.norm(p.position - a.position)
    e = (p.position - a.position) / d
    w = u.position - a.position
    along = w @ e
    unit = np.sqrt(LAMBDA * along * (d - along) / (2 * d))
    nu = np.linalg.norm(w - along * e) / unit
    links = [("A", "P"), ("A", "A"), ("P", "P")]
    bare = tracer(empty_city("none", np.zeros(3))).trace({"A": a, "P": p, "U": u}, 0.0, links).paths
    for radius in (0.0, 0.17, 0.43):
        paths = (
            tracer(empty_city("none", np.zeros(3)), A=0.31, P=0.23, U=radius)
            .trace({"A": a, "P": p, "U": u}, 0.0, links)
            .paths
        )
        factor = chopped(nu, radius / unit) if radius else 1.0
        assert abs(factor - 1) > 0.05 or not radius
        los, free = (one(x["A", "P"], PathKind.LINE_OF_SIGHT) for x in (paths, bare))
        assert abs(field(los) / field(free) - factor) < 1e-6
        by_way_of_u = [x["A", "A"].select(x["A", "A"].target == 2) for x in (paths, bare)]
        assert abs(by_way_of_u[0].gain[0] / by_way_of_u[1].gain[0] - 1) < 1e-12
        by_way_of_p = [x["A", "A"].select(x["A", "A"].target == 1) for x in (paths, bare)]
        assert abs(by_way_of_p[0].gain[0] / by_way_of_p[1].gain[0] - factor**2) < 1e-6


def test_clutter_behind_a_body_is_in_its_shadow():
    """A body 8.3 m in front of A: each scatterer of a wall takes the disc's modulus on the way
    there and on the way back, by strips; the terminal's own body none. Planted bug: one way
    only."""
    city = rectangle((-20.0, 25.0, -9.0), (40.0, 0, 0), (0, 0, 22.0), METAL)
    model, _ = flown(
        city,
        (0.3, -1.1, 0.9),
        (-9.0, -7.0, 2.2),
        cell_area_per_metre_m=0.008,
        smallest_cell_m2=0.05,
    )
    a, body = pose((0.3, -1.1, 0.9)), np.array([0.9, 7.1, 1.3])
    bare = model.field.seen(LinkState(Link("A", "A"), 0.0, a, a))
    for names in (("U",), ("A", "U")):
        discs = UavDiscs(names, np.array([body, body])[: len(names)], np.full(len(names), 0.23))
        if "A" in names:
            discs = UavDiscs(names, np.array([a.position, body]), discs.radii)
        seen = model.field.seen(LinkState(Link("A", "A"), 0.0, a, a), discs)
        ratio, checked = seen.magnitude / bare.magnitude, 0
        for i, point in enumerate(model.field.cells.points[bare.index]):
            r = np.linalg.norm(point - a.position)
            along = (body - a.position) @ (point - a.position) / r
            off = np.sqrt(max(((body - a.position) ** 2).sum() - along**2, 0.0))
            unit = np.sqrt(LAMBDA * along * (r - along) / (2 * r))
            if off > 0.23 + 7 * unit:
                assert ratio[i] == pytest.approx(1.0, rel=1e-6, abs=0)  # float32
            elif off < 0.23 + 2.9 * unit:
                assert ratio[i] == pytest.approx(
                    abs(chopped(off / unit, 0.23 / unit)) ** 2, rel=0, abs=1e-5
                )
                checked += 1
        assert checked > 10
        assert ratio.min() < 0.2


@pytest.mark.parametrize("together", [2, 32])
def test_no_edge_near_a_path_is_passed_over(together, monkeypatch):
    """Triangles strewn over 200 m, edges of 1 to 60 m: the shortest detours of paths against a
    search along every edge, by thirds. Planted bugs: balls about blocks that hold the middles of
    their edges alone; a last block without its edges."""
    monkeypatch.setattr(edges_of_cities, "EDGES_PER_BLOCK", together)
    rng = np.random.default_rng(5)
    size = 10 ** rng.uniform(0, 1.5, (333, 1, 1))
    corners = rng.uniform(-100, 100, (333, 1, 3)) + size * rng.uniform(-1, 1, (333, 3, 3))
    vertices, faces = corners.reshape(-1, 3), np.arange(999, dtype=np.int32).reshape(-1, 3)
    origin = np.zeros(3)
    city = CityMesh("strewn", vertices, faces, np.zeros(333, np.int16), (METAL,), origin)
    edges, found = Edges.of(city), 0
    a, b = corners, np.roll(corners, -1, axis=1)
    sources, sinks = rng.uniform(-100, 100, (2, 100, 3))
    reach = 10 ** rng.uniform(-1, 0.5, 100)
    path, detours, _, _ = near(edges, sources, sinks, reach)
    for k, ends in enumerate(zip(sources, sinks, strict=True)):
        low, high = np.zeros((333, 3, 1)), np.ones((333, 3, 1))

        def detour(share, ends=ends):
            at = a + share * (b - a)
            scatter_paths = [np.linalg.norm(at - end, axis=2, keepdims=True) for end in ends]
            return scatter_paths[0] + scatter_paths[1] - np.linalg.norm(ends[0] - ends[1])

        for _ in range(60):
            one, other = low + (high - low) / 3, high - (high - low) / 3
            left = detour(one) < detour(other)
            low, high = np.where(left, low, one), np.where(left, other, high)
        every = np.sort(detour(low).ravel())
        every = every[every < reach[k]][:MOST_TRIED]
        assert detours[path == k] == pytest.approx(every, abs=1e-9)
        found += every.size
    assert found > 300
