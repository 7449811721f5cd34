"""Chains of walls that rays find from time samples, and the paths that images make of them: against
Sionna's own solver, image lattices, and the geometry of walls that end."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from isac_rt import scenario
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.simulation.setup import propagation_in, swarm_of
from isac_rt.world.city import CityMesh, Material, load_city

pytestmark = pytest.mark.sionna
C, F_C = 299_792_458.0, 77e9
TIMES = np.linspace(0.013, 0.913, 13)
AMPLITUDE = 2e-4  # Sionna's float32 through Fresnel's square roots
PROBES_M = (
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
        "receiver_preset": "plain",
        "city": {"source": "canyon"},
        "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
        "propagation": {
            "model": "ray_traced",
            "max_bounces": 2,
            "rays": 20_000,
            "leakage": {"enabled": False},
        },
    } | changes
    return scenario.Scenario.model_validate(tree)


def tracer(s: scenario.Scenario, city: CityMesh, sample_spacing: float = 1e6):
    return propagation_in(city, s, sample_spacing)


def mesh(quads, materials=None, of=None) -> CityMesh:
    """Rectangles of four corners each; `of` (Q,) says their materials."""
    corners = np.array(quads, float).reshape(-1, 3)
    faces = [
        (4 * q + np.array(f)).tolist() for q in range(len(quads)) for f in ((0, 1, 2), (0, 2, 3))
    ]
    material = np.repeat(np.zeros(len(quads)) if of is None else of, 2).astype(np.int16)
    slab = Material("slab", 5.31, 1.9, 0.0, "lambertian", 1, 0.1, "test")
    return CityMesh(
        "quads", corners, np.array(faces, np.int32), material, materials or (slab,), np.zeros(3)
    )


def test_sets_of_chains_are_padded_with_minus_one():
    """What `PathSet` promises of faces where there is none, and NaN for their points. Planted bug:
    padded with another number."""
    from isac_rt.propagation.segments.geometry import Segments
    from isac_rt.propagation.segments.segment_set import segment_set

    def some(count: int, depth: int) -> tuple:
        segments = Segments(
            np.ones(count),
            np.ones(count),
            np.ones(count),
            np.ones((count, 3)),
            np.ones((count, 3)),
            np.ones((count, depth, 3)),
        )
        chain = 7 + np.arange(count * depth).reshape(count, depth)
        return np.ones(count, complex), segments, chain, 2 * chain

    joined = segment_set([some(2, 1), some(1, 3)], 3)
    assert joined.faces.tolist() == [[7, -1, -1], [8, -1, -1], [7, 8, 9]]
    assert joined.planes.tolist() == [[14, -1, -1], [16, -1, -1], [14, 16, 18]]
    assert joined.bounces.tolist() == [1, 1, 3]
    assert (
        np.isnan(joined.segments.points[:2, 1:]).all() and (joined.segments.points[:, 0] == 1).all()
    )


def keyed(paths: PathSet) -> dict[tuple, int]:
    """Paths by kind, target, number of bounces and length to a micrometre."""
    rows = zip(paths.kind, paths.target, paths.bounces, np.round(paths.delay * 3e14), strict=True)
    return {tuple(int(v) for v in row): i for i, row in enumerate(rows)}


@pytest.fixture(scope="module")
def streets():
    """A swarm past a crossing where paths come and go, by images and by Sionna's solver."""
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
        frames=14,
        frame_interval_s=0.075,
    )
    city = load_city(s.city, ".", F_C, (0.0, 0.0, 9.0))
    swarm, model = swarm_of(s), tracer(s, city, 2.0)
    solver = model.by_sionna(100_000)
    frames = [
        (t, *(m.trace(swarm.poses(t), t, LINKS).paths for m in (solver, model))) for t in TIMES[::2]
    ]
    return frames, s, city


def test_the_paths_are_those_of_sionnas_solver(streets):
    """The same chains, delays to 1 um (the key), gains to Sionna's rounding, while paths come and
    go. Planted bug: TE and TM coefficients swapped."""
    keys = []
    for t, full, got in streets[0]:
        for link in LINKS:
            a, b = keyed(full[link]), keyed(got[link])
            assert a.keys() == b.keys(), (t, link)
            one, other = full[link].gain[list(a.values())], got[link].gain[[b[k] for k in a]]
            corner = (link == ("A", "A")) & (full[link].bounces[list(a.values())] > 1)
            error = np.abs(other - one) / np.abs(one).max()
            assert (error < np.where(corner, PROBES_M, AMPLITUDE)).all()
        keys.append({tuple(row) for row in got["A", "P"].faces.tolist()})
    assert len(set.union(*keys)) > len(keys[0]) != len(keys[-1])  # they do come and go


def test_a_frame_is_a_function_of_itself(streets):
    """Bit for bit the same whether the frames before it were traced, in another order, or none.
    Planted bug: chains of all time samples so far are pooled."""
    frames, s, city = streets
    swarm, backwards = swarm_of(s), tracer(s, city, 2.0)
    for t, _, got in frames[::-3]:
        alone = tracer(s, city, 2.0)
        for model in (backwards, alone):
            found = model.trace(swarm.poses(t), t, LINKS).paths
            for link in LINKS:
                for name in ("gain", "delay", "delay_rate", "delay_accel", "departure", "faces"):
                    assert np.array_equal(
                        getattr(found[link], name), getattr(got[link], name), equal_nan=True
                    ), name


def test_halves_of_the_knots_know_nothing_of_each_other(streets):
    """Even and odd time samples share neither a place nor a direction, and their chains together
    are the pool. Planted bug: both halves are the even time samples."""
    from isac_rt.propagation.segments.chains import directions

    frames, s, city = streets
    few = s.model_copy(update={"propagation": s.propagation.model_copy(update={"rays": 500})})
    model, t = tracer(few, city, 2.0), frames[4][0]
    pose = model._local(swarm_of(s).poses(t))["A"]

    def rows(search) -> set[tuple[int, ...]]:
        chains = search.chains("A", pose, t)
        out: list[tuple[int, ...]] = []
        for parent, plane in zip(chains.parent, chains.plane, strict=True):
            out.append((*(out[parent] if parent >= 0 else ()), int(plane)))
        assert len(set(out)) == len(out)
        return set(out)

    even, odd, every = (rows(m._search) for m in (model.by_half(0), model.by_half(1), model))
    assert even | odd == every and even != odd
    a, b = (directions(500, n) for n in (3, 4))
    assert np.linalg.norm(a, axis=1) == pytest.approx(1, abs=1e-12)
    assert np.linalg.norm(a[:, None] - b, axis=2).min() > 1e-4
    assert np.abs(a.mean(axis=0)).max() < 1e-2


def test_a_room_has_the_whole_lattice_of_images():
    """A closed room, up to four bounces: 4 n^2 + 2 images of n bounces, at the lattice's places.
    Planted bug: the first plane of a chain for all."""
    low, high = np.array([-7.3, -5.1, 0.4]), np.array([6.1, 8.7, 5.9])
    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for at in (low, high):
            quad = np.tile(low, (4, 1))
            quad[:, axis] = at[axis]
            quad[1:3, u], quad[2:4, v] = high[u], high[v]
            quads.append(quad)
    a, p = np.array([-3.13, 2.41, 1.97]), np.array([2.71, -1.77, 4.13])
    s = swarm_over((a, (0, 0, 0)), (p, (0, 0, 0)), ((1, 1, 3), (0, 0, 0)))
    s = s.model_copy(update={"propagation": s.propagation.model_copy(update={"max_bounces": 4})})
    paths = tracer(s, mesh(quads)).trace(swarm_of(s).poses(0.0), 0.0, LINKS).paths["A", "P"]
    paths = paths.select((paths.kind == PathKind.SPECULAR) & (paths.target < 0))
    expected = []
    for cell in itertools.product(range(-4, 5), repeat=3):
        n = int(np.abs(cell).sum())
        if 0 < n <= 4:
            i = np.array(cell)
            odd = low + high - a + i * (high - low)
            image = np.where(i % 2 == 0, a + i * (high - low), odd)
            expected.append((n, float(np.linalg.norm(p - image))))
    found = sorted(zip(paths.bounces.tolist(), (C * paths.delay).tolist(), strict=True))
    assert np.bincount(paths.bounces).tolist() == [0, 6, 18, 38, 66]
    # rounding: float64 over lengths of 50 m
    assert np.array(found) == pytest.approx(np.array(sorted(expected)), abs=1e-12 * 50)


@pytest.mark.parametrize("x", [-4.0, 4.0])
def test_the_face_that_holds_the_point_says_the_material(x):
    """A ground of two materials in one plane, beneath A and P: Fresnel's coefficient of the half
    where the point lies. Planted bug: the first face of the plane."""
    grounds = [
        Material("one", 5.31, 1.9, 0.0, "lambertian", 1, 0.1, "test"),
        Material("other", 2.3, 0.4, 0.0, "lambertian", 1, 0.1, "test"),
    ]
    quads = [[(w, -50, 0), (w + 50, -50, 0), (w + 50, 50, 0), (w, 50, 0)] for w in (-50.0, 0.0)]
    a, p = np.array([x - 2.1, -6.3, 3.7]), np.array([x + 2.1, 7.1, 3.7])
    s = swarm_over((a, (0, 0, 0)), (p, (0, 0, 0)), ((1, 40, 9), (0, 0, 0)))
    city = mesh(quads, tuple(grounds), [0, 1])
    paths = tracer(s, city).trace(swarm_of(s).poses(0.0), 0.0, LINKS).paths["A", "P"]
    (gain,) = paths.gain[paths.kind == PathKind.SPECULAR]
    length = np.hypot(np.linalg.norm(p[:2] - a[:2]), 7.4)
    material = grounds[int(x > 0)]
    omega, k = 2 * np.pi * F_C, 2 * np.pi * F_C / C
    eta = material.relative_permittivity - 1j * material.conductivity / (omega * 8.8541878128e-12)
    cosine = 7.4 / length
    root = np.sqrt(eta - 1 + cosine**2)
    r, turn = (eta * cosine - root) / (eta * cosine + root), np.exp(-2j * k * 0.1 * root)
    expected = r * (1 - turn) / (1 - r**2 * turn) / (2 * k * length)
    assert abs(gain / expected - 1) < 1e-9  # constants of nature to as many digits


def test_a_path_dies_where_its_wall_ends():
    """A wall x = 7, y from -40 to 3: the mirror point of a path from A to P lies, by similar
    triangles, at the mean of their y when both are as far from the wall, so the path dies when that
    passes 3 m. Planted bug: the test behind the wall left out (it lives on)."""
    city = mesh([[(7.0, -40, -20), (7, 3, -20), (7, 3, 40), (7, -40, 40)]])
    s = swarm_over(
        ((0, -11.3, 8.7), (0, 10.3, 0)), ((0, 7.9, 10.1), (0, 9.1, 0)), ((-30, 1, 4), (0, 1, 0))
    )
    swarm = swarm_of(s)
    model = tracer(s, city)
    for t in TIMES:
        poses = swarm.poses(t)
        mirror = (poses["A"].position[1] + poses["P"].position[1]) / 2
        found = model.trace(poses, t, LINKS).paths["A", "P"]
        specular = int((found.kind == PathKind.SPECULAR).sum())
        assert abs(mirror - 3) > 0.05  # the case is a sure one
        assert specular == (mirror < 3), t


def test_a_wall_in_the_way_hides_a_path_until_it_is_passed():
    """The line of sight of A to P crosses the plane y = 0 at x_A + (x_P - x_A) |y_A|/(|y_A| + y_P);
    a screen there from x = 2 on hides it (then it bends round the screen's edge, or is gone).
    Planted bug: no ray tested at all."""
    city = mesh([[(2.0, 0, -20), (60, 0, -20), (60, 0, 40), (2, 0, 40)]])
    s = swarm_over(
        ((-4.3, -13.1, 8.7), (9.7, 0, 0)),
        ((-1.2, 21.3, 10.1), (8.3, 0, 0)),
        ((-30, 1, 4), (0, 1, 0)),
    )
    swarm = swarm_of(s)
    model = tracer(s, city)
    seen = []
    for t in TIMES:
        poses = swarm.poses(t)
        a, p = poses["A"].position, poses["P"].position
        crossing = a[0] + (p[0] - a[0]) * abs(a[1]) / (abs(a[1]) + p[1])
        found = model.trace(poses, t, LINKS).paths["A", "P"]
        seen.append(bool(((found.kind == PathKind.LINE_OF_SIGHT) & ~found.bent).any()))
        assert abs(crossing - 2) > 0.01
        assert seen[-1] == (crossing < 2), t
    assert True in seen
    assert False in seen


def test_chains_are_found_again_and_only_where_nothing_changed(streets, tmp_path, monkeypatch):
    """A second tracer of the same flight and city sends no ray, has no need of Sionna's scene and
    has the same chains; other rays, another flight and another mesh are searched anew. Planted bug:
    a key without the places."""
    from isac_rt.propagation.segments.chains import Search
    from isac_rt.storage import CACHE_VARIABLE
    from isac_rt.world.city import scene as scenes

    frames, s, city = streets
    few = s.model_copy(update={"propagation": s.propagation.model_copy(update={"rays": 500})})
    times, sent, search = [frames[k][0] for k in (0, 3, 6)], [], Search._sent

    def chains(scene, mesh, spacing=2.0) -> list[np.ndarray]:
        sent.clear()
        model, swarm = tracer(scene, mesh, spacing), swarm_of(scene)
        found = []
        for t in times:
            pose = model._local(swarm.poses(t))["A"]
            found += [*model._search.chains("A", pose, t)]
        return found

    plain = chains(few, city)
    monkeypatch.setattr(Search, "_sent", lambda *at: sent.append(at) or search(*at))
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    for again in (False, True):
        monkeypatch.setattr(scenes, "_latest", None)
        found = chains(few, city)
        assert all(map(np.array_equal, found, plain))
        assert bool(sent) is not again
        assert ("solved" in vars(scenes._latest)) is not again
    more = s.model_copy(update={"propagation": s.propagation.model_copy(update={"rays": 600})})
    taller = s.city.model_copy(update={"building_height_m": 14.5})
    other = load_city(taller, ".", F_C, (0.0, 0.0, 9.0))
    uav = few.swarm["A"].model_copy(update={"position_m": (-3.1, -20.3, 9.25)})
    aside = few.model_copy(update={"swarm": {**few.swarm, "A": uav}})
    for change in ((more, city), (aside, city), (few, other)):
        chains(*change)
        assert sent
