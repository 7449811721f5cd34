"""Legs between traced instants: against tracing every frame, and against the geometry of a wall
that ends."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt import scenario
from isac_rt.propagation import PathKind, PathSet
from isac_rt.simulation.setup import propagation_in, swarm_of
from isac_rt.world.city import CityMesh, Material, load_city

pytestmark = pytest.mark.sionna
F_C = 77e9
TIMES = np.linspace(0.013, 0.913, 13)
AMPLITUDE = 2e-4  # Sionna's float32 through Fresnel's square roots
ASIDE = (
    1e-2  # of corners, to which the tracer measures 0.1 m beside the terminal, 14 m and more away
)
LINKS = [("A", "A"), ("A", "P")]


def swarm_over(a, p, u, **changes) -> scenario.Scenario:
    """Three bodies with start, velocity each; isotropic elements, mirror reflections only."""
    rcs = {"model": "constant", "value_dbsm": -11.7}
    roles = {"A": "active", "P": "passive", "U": "target"}
    uavs = {
        name: {
            "role": roles[name],
            "position_m": list(start),
            "velocity_mps": list(velocity),
            "rcs": rcs,
        }
        for name, (start, velocity) in {"A": a, "P": p, "U": u}.items()
    }
    tree = {
        "swarm": uavs,
        "city": {"source": "canyon"},
        "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
        "propagation": {"model": "ray_traced", "max_bounces": 2, "leakage": {"enabled": False}},
    } | changes
    return scenario.Scenario.model_validate(tree)


def tracer(s: scenario.Scenario, city: CityMesh, instants=()):

    return propagation_in(city, s, instants)


def test_sets_of_chains_are_padded_with_minus_one():
    """What `PathSet` promises of faces where there is none, and NaN for their points. Planted bug:
    padded with another number."""
    from isac_rt.propagation.legs.between import leg_set
    from isac_rt.propagation.legs.geometry import Legs

    def some(count: int, depth: int) -> tuple:
        legs = Legs(
            np.ones(count),
            np.ones(count),
            np.ones(count),
            np.ones((count, 3)),
            np.ones((count, 3)),
            np.ones((count, depth, 3)),
        )
        chain = 7 + np.arange(count * depth).reshape(count, depth)
        return np.ones(count, complex), legs, chain, 2 * chain

    joined = leg_set([some(2, 1), some(1, 3)], 3)
    assert joined.faces.tolist() == [[7, -1, -1], [8, -1, -1], [7, 8, 9]]
    assert joined.planes.tolist() == [[14, -1, -1], [16, -1, -1], [14, 16, 18]]
    assert joined.bounces.tolist() == [1, 1, 3]
    assert np.isnan(joined.legs.points[:2, 1:]).all() and (joined.legs.points[:, 0] == 1).all()


def keyed(paths: PathSet) -> dict[tuple, int]:
    """Paths by kind, target, number of bounces and length to a micrometre."""
    rows = zip(paths.kind, paths.target, paths.bounces, np.round(paths.delay * 3e14), strict=True)
    return {tuple(int(v) for v in row): i for i, row in enumerate(rows)}


@pytest.fixture(scope="module")
def streets():
    """Every frame traced, and only every sixth, past a crossing where paths come and go."""
    s = swarm_over(
        ((-3.1, -20.3, 9.2), (0.4, 6.3, 0.1)),
        ((4.2, 13.7, 11.4), (-0.3, -3.1, 0.2)),
        ((-1.3, -4.9, 10.1), (0.5, 9.7, 0.3)),
        city={
            "source": "blocks",
            "street_width_m": 19,
            "block_size_m": 16,
            "building_height_m": 14,
            "blocks_x": 2,
            "blocks_y": 3,
        },
    )
    city = load_city(s.city, ".", F_C, (0.0, 0.0, 9.0))
    swarm = swarm_of(s)
    full, between = tracer(s, city), tracer(s, city, TIMES[::6])
    frames = [
        (
            t,
            full.trace(swarm.poses(t), t, LINKS).paths,
            between.trace(swarm.poses(t), t, LINKS).paths,
        )
        for t in TIMES
    ]
    return frames, between, full


def test_between_traces_the_paths_are_those_of_a_trace(streets):
    """The same chains, delays to 1 um (the key), gains to Sionna's rounding. Planted bug: TE and TM
    coefficients swapped."""
    for t, full, got in streets[0]:
        for link in LINKS:
            a, b = keyed(full[link]), keyed(got[link])
            assert a.keys() == b.keys(), (t, link)
            one, other = full[link].gain[list(a.values())], got[link].gain[[b[k] for k in a]]
            corner = (link == ("A", "A")) & (full[link].bounces[list(a.values())] > 1)
            error = np.abs(other - one) / np.abs(one).max()
            assert (error < np.where(corner, ASIDE, AMPLITUDE)).all()


def test_births_and_deaths_happened_and_were_counted(streets):
    """Or the test above would not have tested them. Planted bug: the two counts swapped."""
    _, between, full = streets
    traced = [full._legs_on_the_way(t) for t in TIMES[::6]]
    chains = [
        {(pair, *row) for pair, legs in at.legs.items() for row in legs.planes.tolist()}
        for at in traced
    ]
    assert between.between.num_traced == 3
    assert between.between.changes == {
        i: (len(chains[i + 1] - chains[i]), len(chains[i] - chains[i + 1])) for i in (0, 1)
    }
    assert min(min(pair) for pair in between.between.changes.values()) > 0


def test_at_a_traced_instant_nothing_changes(streets):
    """Bit for bit what the tracer gives. Planted bug: the instants' poses taken without the city's
    origin."""
    for t, full, got in streets[0]:
        if t in TIMES[::6]:
            for link in LINKS:
                for name in ("gain", "delay", "delay_rate", "delay_accel", "departure", "arrival"):
                    assert np.array_equal(getattr(full[link], name), getattr(got[link], name)), name


def test_a_path_dies_where_its_wall_ends():
    """A wall x = 7, y from -40 to 3: the mirror point of a path from A to P lies, by similar
    triangles, at the mean of their y when both are as far from the wall, so the path dies when that
    passes 3 m. Planted bug: the test behind the wall left out (it lives on)."""
    corners = np.array([[7.0, -40, -20], [7, 3, -20], [7, 3, 40], [7, -40, 40]])
    material = Material("slab", 5.31, 1.9, 0.0, "lambertian", 1, 0.1, "test")
    city = CityMesh(
        "wall",
        corners,
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.zeros(2, np.int16),
        (material,),
        np.zeros(3),
    )
    s = swarm_over(
        ((0, -11.3, 8.7), (0, 10.3, 0)), ((0, 7.9, 10.1), (0, 9.1, 0)), ((-30, 1, 4), (0, 1, 0))
    )
    swarm = swarm_of(s)
    between = tracer(s, city, [TIMES[0], TIMES[-1]])
    for t in TIMES:
        poses = swarm.poses(t)
        mirror = (poses["A"].position[1] + poses["P"].position[1]) / 2
        found = between.trace(poses, t, LINKS).paths["A", "P"]
        specular = int((found.kind == PathKind.SPECULAR).sum())
        assert abs(mirror - 3) > 0.05  # the case is a sure one
        assert specular == (mirror < 3), t
    assert between.between.num_traced == 2


def test_a_wall_in_the_way_hides_a_path_until_it_is_passed():
    """The line of sight of A to P crosses the plane y = 0 at x_A + (x_P - x_A) |y_A|/(|y_A| + y_P);
    a screen there from x = 2 on hides it (then it bends round the screen's edge, or is gone).
    Planted bug: no ray tested at all."""
    corners = np.array([[2.0, 0, -20], [60, 0, -20], [60, 0, 40], [2, 0, 40]])
    material = Material("slab", 5.31, 1.9, 0.0, "lambertian", 1, 0.1, "test")
    city = CityMesh(
        "screen",
        corners,
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.zeros(2, np.int16),
        (material,),
        np.zeros(3),
    )
    s = swarm_over(
        ((-4.3, -13.1, 8.7), (9.7, 0, 0)),
        ((-1.2, 21.3, 10.1), (8.3, 0, 0)),
        ((-30, 1, 4), (0, 1, 0)),
    )
    swarm = swarm_of(s)
    between = tracer(s, city, [TIMES[0], TIMES[-1]])
    seen = []
    for t in TIMES:
        poses = swarm.poses(t)
        a, p = poses["A"].position, poses["P"].position
        crossing = a[0] + (p[0] - a[0]) * abs(a[1]) / (abs(a[1]) + p[1])
        found = between.trace(poses, t, LINKS).paths["A", "P"]
        seen.append(bool(((found.kind == PathKind.LINE_OF_SIGHT) & ~found.bent).any()))
        assert abs(crossing - 2) > 0.01
        assert seen[-1] == (crossing < 2), t
    assert True in seen
    assert False in seen
