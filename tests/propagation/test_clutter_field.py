"""The clutter field: scatterers as functions of the mesh, their power against integrals, their
motion against closed forms."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles import splitmix64
from scipy import stats
from scipy.integrate import dblquad
from truths.stage import rectangle
from truths.truths import lambertian_wall, slab_reflection

from isac_rt import scenario
from isac_rt.extensions.city_receivers.covariance import Bucketed
from isac_rt.extensions.city_receivers.power import TAPER, Taper, expected_power
from isac_rt.frame.antennas import Arrays, antennas_of
from isac_rt.frame.link import Link
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.clutter import cells as clutter_cells
from isac_rt.propagation.clutter.cells import Density, cut
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.receive.directions import channel_search
from isac_rt.receive.known import Known
from isac_rt.receive.types import ExpectedClutter
from isac_rt.simulation.setup import propagation_in, swarm_of
from isac_rt.world.city import CityError, CityMesh, Material, load_city
from isac_rt.world.swarm import Pose

C, F_C, EPS_0 = 299_792_458.0, 77e9, 8.8541878128e-12
LAMBDA = C / F_C
CANYON = scenario.City(
    source="canyon", street_width_m=21.3, street_length_m=83.0, building_height_m=17.9
)
PLACES = np.array([[0.7, -5.1, 8.3], [1.9, 6.2, 8.9]])
DENSITY = Density(0.05, 0.07)


def joined(*parts: CityMesh) -> CityMesh:
    """Several meshes in one, each with its own material."""
    shift = np.cumsum([0] + [len(p.vertices) for p in parts])
    faces = np.concatenate([p.faces + s for p, s in zip(parts, shift, strict=False)]).astype(
        np.int32
    )
    material = np.repeat(np.arange(len(parts)), [p.num_faces for p in parts]).astype(np.int16)
    return CityMesh(
        "several",
        np.concatenate([p.vertices for p in parts]),
        faces,
        material,
        tuple(p.materials[0] for p in parts),
        np.zeros(3),
    )


def canyon(centre=(0.31, -0.17, 0.9)) -> CityMesh:
    return load_city(CANYON, ".", F_C, centre)


def all_cells(city: CityMesh, seed: int = 3, places=PLACES):
    return cut(city, np.ones(city.num_faces, bool), places - city.origin, DENSITY, seed)


def permuted(city: CityMesh, seed: int) -> CityMesh:
    """The same triangles in another order, each begun at another corner and some turned over."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(city.num_faces)
    corners = np.array([rng.permutation(3) for _ in order])
    return replace(
        city,
        faces=np.take_along_axis(city.faces[order], corners, axis=1),
        face_material=city.face_material[order],
    )


def digest(cells) -> str:
    return hashlib.sha256(
        b"".join(
            np.ascontiguousarray(a).tobytes() for a in (cells.points, cells.area, cells.amplitude)
        )
    ).hexdigest()


# ---- the cells


def test_cells_tile_the_faces_and_are_as_fine_as_asked():
    """Areas add up face by face, no cell is larger than its distance allows, and each point lies in
    its face. Planted bug: the halves keep the whole area."""
    city = canyon()
    cells = all_cells(city)
    assert np.bincount(cells.face, cells.area, city.num_faces) == pytest.approx(
        city.areas, rel=1e-7, abs=0
    )  # areas are float32
    distance = np.linalg.norm(cells.points[:, None] + city.origin - PLACES, axis=2).min(axis=1)
    limit = np.maximum(DENSITY.smallest, DENSITY.per_metre * distance)
    assert (
        cells.area < limit
    ).all()  # the rule's distance is a bound below that of any point of the cell
    assert (
        np.median(cells.area / limit) > 0.3
    )  # halving leaves between half and all of it, less where the cell is wide
    n, d = city.normals[cells.face], city.plane_offsets[cells.face]
    assert (n * cells.points).sum(1) == pytest.approx(d, abs=1e-12)
    a, b, c = np.moveaxis(city.corners[cells.face], 1, 0)
    for p, q in ((a, b), (b, c), (c, a)):
        assert ((np.cross(q - p, cells.points - p) * n).sum(1) > -1e-9).all()


def halved(
    corners: np.ndarray, places: np.ndarray, density: Density, code: int = 1
) -> list[tuple[int, float]]:
    """(code, area) of the cells of one triangle, by recursion, against every place."""
    a, b, c = corners
    area = np.linalg.norm(np.cross(b - a, c - a)) / 2
    middle = corners.mean(axis=0)
    reach = np.linalg.norm(corners - middle, axis=1).max()
    distance = max(np.linalg.norm(places - middle, axis=1).min() - reach, 0.0)
    finer = 4 if distance < density.near else 1
    if area <= max(density.smallest, density.per_metre * distance) / finer:
        return [(code, area)]
    edges = [np.linalg.norm(corners[(k + 1) % 3] - corners[k]) for k in range(3)]
    k = next(k for k in range(3) if edges[k] > max(edges) * (1 - 1e-9))
    p, q, r = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
    one = halved(np.array([p, (p + q) / 2, r]), places, density, 2 * code)
    return one + halved(np.array([(p + q) / 2, q, r]), places, density, 2 * code + 1)


def test_cells_are_those_of_a_recursion():
    """Sequences of halvings and areas, face by face, with finer cells near the flight and one
    triangle of equal sides. Planted bugs: the second of equally long edges halved; a cell's radius
    left out of its distance."""
    rng = np.random.default_rng(12)
    corners = rng.uniform(-60, 60, (40, 1, 3)) + rng.uniform(-20, 20, (40, 3, 3))
    corners[0] = 48.7 * np.sqrt([[0, 0, 0], [1, 0, 0], [0.25, 0.75, 0]])
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    places = np.linspace([-30.3, 5.1, 12.2], [44.1, -3.7, 15.9], 83)
    density = Density(0.13, 0.21, 7.3)
    expected = [
        (row, *cell) for row in range(40) for cell in sorted(halved(corners[row], places, density))
    ]
    faces = corners, area, np.arange(40, dtype=np.uint64)
    of = (density.per_metre, density.smallest, density.near, np.inf)
    count, rows, codes, areas, _, _ = clutter_cells.leaves(faces, places, of, 100_000)
    assert count == len(expected) > 1_000
    assert [*zip(rows.tolist(), codes.tolist(), strict=True)] == [cell[:2] for cell in expected]
    assert areas == pytest.approx([cell[2] for cell in expected], rel=1e-9)


def test_one_cell_too_many_is_refused(monkeypatch):
    """As many as allowed are cut, and one more is refused. Planted bug: what waits is counted
    twice."""
    count = len(all_cells(canyon()))
    monkeypatch.setattr(clutter_cells, "MOST_CELLS", count)
    assert len(all_cells(canyon())) == count
    monkeypatch.setattr(clutter_cells, "MOST_CELLS", count - 1)
    with pytest.raises(CityError, match=f"more than {count - 1} cells"):
        all_cells(canyon())


def test_faces_are_cut_to_the_reach():
    """A ground of 40 km under a canyon has cells as far as the city matters and no farther; it
    broke the clutter. Nearer ones are what they are without a reach. Planted bug: a cell on the far
    side of the origin stays."""
    ground = 2e4 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    wide = CityMesh("wide", ground, faces, np.zeros(2, np.int16), (), np.zeros(3)).within(312.7)
    cells = cut(wide, np.ones(2, bool), PLACES, DENSITY, 3)
    assert cells.area.sum() == pytest.approx((2 * 312.7) ** 2, rel=0.05)
    assert np.abs(cells.points).max() < 312.7 + 10
    city = canyon()
    near = cut(replace(city, reach=30.3), np.ones(city.num_faces, bool), PLACES, DENSITY, 3)
    every = cut(city, np.ones(city.num_faces, bool), PLACES, DENSITY, 3)
    inside = np.abs(every.points).max(axis=1) < 30.3
    assert set(every.code[inside]) <= set(near.code)
    assert 0 < len(near) < len(every)


@pytest.mark.parametrize("seed", [5, 6])
def test_cells_do_not_know_the_order_of_faces(seed):
    """Bit-identical for any order of faces and corners. Planted bug: faces are left in the order of
    the mesh."""
    city = canyon()
    assert digest(all_cells(permuted(city, seed))) == digest(all_cells(city))


@pytest.mark.slow
def test_cells_are_the_same_in_every_process():
    """Planted bug: Python's own hash(), which is salted, in the seed."""
    program = (
        "import sys; sys.path[:0] = ['tests', 'tests/propagation']; "
        "import test_clutter_field as t; "
        "print(t.digest(t.all_cells(t.canyon())))"
    )
    root = Path(__file__).parents[2]
    env = {"PYTHONHASHSEED": "9", "PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        cwd=root,
        env=env,
    )
    assert done.stdout.strip() == digest(all_cells(canyon()))


def test_points_are_hashed_from_the_state_of_their_face_and_the_code_of_their_cell():
    """In whole numbers of Python, uniform in the triangle to which the code leads; of cells that
    are wanted the same as of all. Planted bugs: the root taken twice, a shift by another
    number, faces in another order than points."""
    city = canyon()
    every = all_cells(city)
    chosen = np.random.default_rng(4).random(len(every)) < 0.02
    args = city, np.ones(city.num_faces, bool), PLACES - city.origin, DENSITY, 3
    cells = cut(*args, wanted=lambda points, face: chosen & (points[:, 2] > 0.1))
    kept = every.select(np.flatnonzero(chosen & (every.points[:, 2] > 0.1)))
    assert all(
        np.array_equal(a, b) for a, b in zip(vars(cells).values(), vars(kept).values(), strict=True)
    )
    assert 0 < len(cells) < chosen.sum()
    for face, code, point in zip(cells.face, cells.code, cells.points, strict=True):
        corners = city.corners[face][np.lexsort(city.corners[face].T[::-1])]
        start = clutter_cells._face_state(corners[None] + city.origin, 3)[0]
        for bit in f"{int(code):b}"[1:]:
            edges = [np.linalg.norm(corners[(k + 1) % 3] - corners[k]) for k in range(3)]
            k = next(k for k in range(3) if edges[k] > max(edges) * (1 - 1e-9))
            p, q, r = (corners[(k + n) % 3] for n in range(3))
            corners = np.array([p, (p + q) / 2, r] if bit == "0" else [(p + q) / 2, q, r])
        state = splitmix64(int(start), int(code))
        one, share = (((splitmix64(state, k) >> 11) + 0.5) / 2**53 for k in range(2))
        a, b, c = corners
        expected = a + np.sqrt(one) * (b - a + share * (c - b))
        assert point == pytest.approx(expected, abs=1e-12)


def test_cells_do_not_know_where_the_city_was_recentred():
    """Another origin of the local coordinates moves nothing by more than rounding and changes no
    amplitude. Planted bug: local coordinates are hashed."""
    first, second = canyon(), canyon((17.3, -11.7, 5.1))
    a, b = all_cells(first), all_cells(second)
    assert np.array_equal(a.amplitude, b.amplitude)
    assert a.points + first.origin == pytest.approx(b.points + second.origin, abs=1e-11)


def test_amplitudes_are_complex_gaussian_and_another_seed_gives_others():
    """Kolmogorov-Smirnov against the Rayleigh law, tail included (level 1e-4); no correlation of
    neighbours or with another seed. Planted bug: the root of the logarithm left out."""
    cells, other = all_cells(canyon()), all_cells(canyon(), seed=4)
    a, n = cells.amplitude.astype(complex), len(cells)
    assert stats.kstest(np.abs(a), stats.rayleigh(scale=np.sqrt(0.5)).cdf).pvalue > 1e-4
    assert stats.kstest(np.angle(a), stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-4
    expected = n * np.exp(-6.0)
    assert abs((np.abs(a) ** 2 > 6.0).sum() - expected) < 4 * np.sqrt(expected)
    for b in (np.roll(a, 1), other.amplitude):
        assert abs((a * b.conj()).mean()) < 4 / np.sqrt(n)  # statistical: 4 sigma
    assert not np.array_equal(cells.points, other.points)


# ---- the field in a scene


def slab(**changes) -> Material:
    return replace(Material("slab", 5.31, 1.9, 0.43, "lambertian", 1, 0.1, "test"), **changes)


METAL = slab(conductivity=1e7)


def flown(
    city: CityMesh,
    a=(0.0, 0.0, 0.0),
    p=(1.0, 0.0, 0.0),
    speed_a=(0.0, 0.0, 0.0),
    speed_p=(0.0, 0.0, 0.0),
    frames=40,
    **clutter,
):
    """A tracer of two terminals with isotropic elements of 0 dBi in a mesh, its field planned for
    their flights, and the swarm."""
    tree = {
        "frames": frames,
        "swarm": {
            "A": {
                "role": "active",
                "position_m": list(a),
                "velocity_mps": list(speed_a),
                "boresight": [0, 1, 0],
            },
            "P": {
                "role": "passive",
                "position_m": list(p),
                "velocity_mps": list(speed_p),
                "boresight": [0, 1, 0],
            },
        },
        "receiver_preset": "plain",
        "city": {"source": "canyon"},
        "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
        "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
        "clutter": {"model": "field", **clutter},
    }
    s = scenario.Scenario.model_validate(tree)
    return propagation_in(city, s), swarm_of(s)


def mean_power(model, tx: str, rx: str, poses: dict[str, Pose]) -> float:
    seen = model.field.seen(LinkState(Link(tx, rx), 0.0, poses[tx], poses[rx]))
    return float((seen.magnitude**2).sum())


def lobe(material: Material, into: np.ndarray, out: np.ndarray, normal: np.ndarray) -> float:
    """Unnormalised pattern; `into` towards the facet, `out` away from it."""
    if material.scattering_pattern == "lambertian":
        return float(out @ normal)
    mirror = into - 2 * (into @ normal) * normal
    alpha = material.pattern_exponent
    forward, backward = ((1 + mirror @ out) / 2) ** alpha, ((1 - into @ out) / 2) ** alpha
    return forward if material.scattering_pattern == "directive" else (forward + backward) / 2


def hemisphere(material: Material, into: np.ndarray) -> float:
    """Integral of the pattern over the half-space of +y."""
    up = np.array([0.0, 1.0, 0.0])

    def density(mu, phi):
        r = np.sqrt(1 - mu**2)
        return lobe(material, into, np.array([r * np.cos(phi), mu, r * np.sin(phi)]), up)

    return dblquad(density, 0, 2 * np.pi, 0, 1, epsrel=1e-9)[0]


PATTERNS = {
    "lambertian": slab(),
    "directive": slab(scattering_pattern="directive", pattern_exponent=5),
    "backscattering": slab(scattering_pattern="backscattering", pattern_exponent=4),
    "pane": slab(relative_permittivity=6.31, conductivity=1.21, thickness=0.012),
}


@pytest.mark.sionna
@pytest.mark.parametrize("name", PATTERNS)
def test_each_scatterer_against_an_oracle(name):
    """Gain, directions and motion of scatterers of a slanting wall, one at a time, from vectors of
    the electric field.

    Delay to 1e-6 rad of the carrier, its rate and acceleration against central differences over 1
    ms, power to 1e-4 (a table of 4096 angles with straight lines). Planted bugs: TE and TM
    exchanged; the mirror direction taken from the way out.
    """
    material = PATTERNS[name]
    along, across = np.array([11.0, 2.3, 0.7]), np.array([0.4, 3.1, 9.0])
    city = rectangle((-6.1, 12.0, -4.0), along, across, material)
    normal = np.cross(along, across)
    normal /= np.linalg.norm(normal)
    model, swarm = flown(city, (0.3, -1.1, 0.9), (-7.7, 1.4, 2.2), cell_area_per_metre_m=0.5)
    still = swarm.poses(0.0)
    discs = {
        "A": replace(
            still["A"], velocity=np.array([3.1, -7.3, 1.9]), acceleration=np.array([0.7, 1.1, -2.3])
        ),
        "P": replace(
            still["P"], velocity=np.array([-5.2, 2.4, 0.6]), acceleration=np.array([-1.7, 0.2, 0.9])
        ),
    }
    step = 1e-3

    def place(body: Pose, t: float) -> np.ndarray:
        return body.position + t * body.velocity + t**2 / 2 * body.acceleration

    for tx, rx in (("A", "P"), ("A", "A")):
        start, end = discs[tx], discs[rx]
        seen = model.field.seen(LinkState(Link(tx, rx), 0.0, start, end))
        assert len(seen.index) > 20
        for i in range(0, len(seen.index), 7):
            cell = seen.index[i]
            point, area = model.field.cells.points[cell], model.field.cells.area[cell]
            u, v = point - start.position, point - end.position
            r1, r2 = np.linalg.norm(u), np.linalg.norm(v)
            u, v = u / r1, v / r2
            n = -np.sign(u @ normal) * normal
            field = np.array([0, 0, 1.0]) - u[2] * u
            field /= np.linalg.norm(field)
            te_axis = np.cross(u, n) / np.linalg.norm(np.cross(u, n))
            of = material.relative_permittivity, material.conductivity, material.thickness
            te, tm = np.abs(slab_reflection(*of, -u @ n)) ** 2
            reflected = te * (field @ te_axis) ** 2 + tm * (1 - (field @ te_axis) ** 2)
            turned = np.array(
                [np.sqrt(1 - (u @ n) ** 2), u @ n, 0.0]
            )  # the way in with the normal along y
            pattern = lobe(material, u, -v, n) / hemisphere(material, turned)
            power = (
                (LAMBDA / (4 * np.pi)) ** 2
                * 0.43**2
                * reflected
                * pattern
                * (-u @ n)
                * area
                / (r1 * r2) ** 2
            )
            assert seen.magnitude[i] ** 2 == pytest.approx(power, rel=2e-4, abs=0)
            lengths = [
                np.linalg.norm(point - place(start, t)) + np.linalg.norm(point - place(end, t))
                for t in (-step, 0.0, step)
            ]
            assert abs(seen.length[i] - lengths[1]) * 2 * np.pi / LAMBDA < 1e-6
            assert seen.rate[i] == pytest.approx(
                (lengths[2] - lengths[0]) / (2 * step), abs=1e-4
            )  # v^3/r^2 h^2/6
            assert seen.accel[i] == pytest.approx(
                (lengths[2] - 2 * lengths[1] + lengths[0]) / step**2, abs=1e-3
            )
            assert seen.departure[i] == pytest.approx(u, abs=1e-14)
            assert seen.arrival[i] == pytest.approx(v, abs=1e-14)
            assert (seen.tx_radius[i], seen.rx_radius[i]) == (
                pytest.approx(r1, rel=1e-14, abs=0),
                pytest.approx(r2, rel=1e-14, abs=0),
            )


# ---- what a terminal expects of it


def expectation(
    city: CityMesh,
    speed=(0.0, 0.0, 0.0),
    at=(0.0, 0.0, 0.0),
    pattern="isotropic",
    gain_dbi=0.0,
    level_db=0.0,
):
    """A terminal's own copy of the mesh and its pose."""
    from isac_rt.extensions.city_receivers.expectation import MeshExpectation

    tree = {
        "frames": 40,
        "swarm": {
            "A": {
                "role": "active",
                "position_m": list(at),
                "velocity_mps": list(speed),
                "boresight": [0.6, 0.8, 0],
            }
        },
        "receiver_preset": "plain",
        "city": {"source": "canyon"},
        "array": {"element_pattern": pattern, "element_gain_dbi": gain_dbi},
        "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
        "clutter": {"model": "field"},
    }
    s = scenario.Scenario.model_validate(tree)
    w = waveform_of(s.radio, s.array)
    swarm, antennas = swarm_of(s), antennas_of(s.array, w)
    copy = MeshExpectation(s.clutter, swarm, city, w, Arrays(antennas), s.seed, None, level_db)
    return copy, swarm.poses(0.0)["A"]


@pytest.mark.sionna
def test_what_a_terminal_expects_of_a_wall_whitens_any_other_draw_of_it():
    """A wall beside the flight, 17 to 27 dB over the noise in 440 cells of range and Doppler, as a
    lattice of 80,000 points by Lambert's law: whitened by the terminal's own scatterers, no
    direction keeps 1.7 times the noise, and the loudest of each cell 1.12 in the mean (1.34 and
    1.05; noise alone is 1). Planted bug: scatterers as sparse as the field's (4.2 and 1.39)."""
    at, speed = np.array([1.3, -0.7, 2.1]), np.array([5.7, 1.1, -0.4])
    copy, pose = expectation(
        rectangle((-5.0, 11.0, -8.0), (50.0, 0, 0), (0, 0, 16.0), METAL), speed, at
    )
    thought = copy.clutter("A", pose, 0.0, 1.0)
    x, z = np.meshgrid(np.arange(-4.95, 45, 0.1), np.arange(-7.95, 8, 0.1))
    towards = np.stack([x.ravel(), np.full(x.size, 11.0), z.ravel()], axis=1) - at
    r = np.linalg.norm(towards, axis=1)
    towards = towards / r[:, None]
    power = towards[:, 1] ** 2 / r**4
    power *= thought.power.sum() / power.sum()
    body = pose.to_body(towards)
    truth = ExpectedClutter(2 * r / C, -2 * towards @ speed / C, power, body, body)
    w = waveform_of(scenario.Radio(), scenario.Array())
    antennas = antennas_of(scenario.Array(), w)
    turns = conventional_schedule(antennas.num_tx, w.num_chirps, antennas.num_tx)
    known = Known.unmodulated(w, turns, antennas, 2)
    search = channel_search(antennas, known.wavenumber)
    held = np.fft.ifftshift(expected_power(truth, known, 120), axes=1)
    noise = held.max() / 10**2.7
    cells = [part[:440] for part in np.nonzero(held > 50 * noise)]
    R = Bucketed.of(truth, known, search, noise, Taper(0, 0, 0)).covariances(*cells)
    inverse = np.linalg.inv(Bucketed.of(thought, known, search, noise, TAPER).covariances(*cells))
    u = np.stack(np.meshgrid(*search.cosines, indexing="ij"), axis=-1)
    a = search.steering(u[search.inside])
    left = []
    for true, white in zip(R, inverse, strict=True):
        y = a.conj() @ white
        kept = ((y @ true) * y.conj()).sum(axis=1).real
        left.append((kept / (y * a).sum(axis=1).real).max())
    assert max(left) < 1.7 and np.mean(left) < 1.12


@pytest.mark.sionna
def test_expected_clutter_is_the_walls_integral():
    """Power as the field's own test takes it, times the transmit power; rates of points at rest;
    a wrong level. Planted bugs: amplitude for power; a level in amplitudes' decibels; elements left
    out; the mesh's origin left out."""
    city = rectangle((-60.0, 50.0, -30.0), (120.0, 0, 0), (0, 0, 60.0), METAL)
    city = replace(city, origin=np.array([310.7, -120.3, 41.9]))
    at, speed, amplitude = np.array([1.3, 28.3, 2.1]), np.array([3.7, -8.1, 1.9]), 0.37
    copy, pose = expectation(city, speed, at + city.origin)
    plain = copy.clutter("A", pose, 0.0, amplitude)
    truth = amplitude**2 * lambertian_wall(at, at, 0.43, 50.0, (60.0, 30.0))
    assert abs(10 * np.log10(plain.power.sum() / truth)) < 0.02  # as for the field
    length = C / 2 * plain.delay
    towards = pose.to_world(plain.departure)
    points = at + length[:, None] * towards
    assert points[:, 1] == pytest.approx(50.0, abs=1e-9) and np.array_equal(
        plain.departure, plain.arrival
    )
    assert plain.delay_rate * C == pytest.approx(-2 * towards @ speed, rel=0, abs=1e-9)
    directive, _ = expectation(city, speed, at + city.origin, "cosine", 10 * np.log10(4))
    cosines = 4 * plain.departure[:, 1]  # 4 cos(angle) of an element of 6 dBi, there and back
    received, ahead = directive.clutter("A", pose, 0.0, amplitude), cosines > 0
    assert received.power == pytest.approx((cosines**2 * plain.power)[ahead], rel=1e-6, abs=0)
    wrong, _ = expectation(city, speed, at + city.origin, level_db=3.1)
    louder = wrong.clutter("A", pose, 0.0, amplitude)
    assert louder.power == pytest.approx(10**0.31 * plain.power, rel=1e-6, abs=0)


@pytest.mark.sionna
def test_knots_of_a_flight_and_their_blend():
    """A straight flight has its time samples evenly along it, ends included, and a B-spline
    reproduces a straight line: the weighted time samples are the place. Planted bugs: the last
    piece of the way left out; time samples counted from the one behind."""
    from isac_rt.propagation.clutter.visibility import SAMPLE_SPACING, Flight

    start, speed, duration, origin = (
        np.array([1.7, -3.1, 8.9]),
        np.array([3.3, 7.1, -0.7]),
        1.83,
        np.array([0.4, 0.2, -0.3]),
    )
    tree = {
        "swarm": {"A": {"role": "active", "position_m": list(start), "velocity_mps": list(speed)}}
    }
    flight = Flight(
        swarm_of(scenario.Scenario.model_validate(tree)).trajectories["A"],
        duration,
        origin,
    )
    way = np.linalg.norm(speed) * duration
    count = int(np.ceil(way / SAMPLE_SPACING))
    even = start - origin + np.linspace(0, duration, count + 1)[:, None] * speed
    assert flight.time_samples.shape == even.shape
    assert flight.time_samples == pytest.approx(even, abs=1e-9)  # rounding
    for time in np.linspace(0, duration, 38):
        weights = flight.blend(time)
        assert sum(weights.values()) == pytest.approx(1, abs=1e-12)
        inside = 3.1 * way / count < time * np.linalg.norm(speed) < way - 3.1 * way / count
        if inside:
            place = sum(g * flight.time_samples[k] for k, g in weights.items())
            assert place == pytest.approx(start - origin + time * speed, abs=1e-9)
        away = [
            np.linalg.norm(flight.time_samples[k] - (start - origin + time * speed))
            for k, g in weights.items()
            if g > 0
        ]
        assert max(away) < 3.01 * way / count


@pytest.mark.sionna
def test_both_ends_on_one_side():
    """A wall between two terminals scatters back to each and nothing across. Planted bug: both
    cosines taken absolute."""
    city = rectangle((-20.0, 5.0, -9.0), (40.0, 0, 0), (0, 0, 22.0), slab())
    model, swarm = flown(city, (0.3, -1.1, 0.9), (-2.7, 13.4, 2.2))
    poses = swarm.poses(0.0)
    assert mean_power(model, "A", "A", poses) > 0
    assert mean_power(model, "A", "P", poses) == 0


@pytest.mark.sionna
def test_all_links_see_one_field_and_a_frame_is_the_same_alone():
    """Scatterers seen over two links have one amplitude and one place; a frame computed first
    equals the one computed last, from a mesh in another order as well. Planted bug: sight
    remembered from the frame before."""
    flights = dict(
        a=(-3.1, -20.3, 9.2),
        p=(4.2, 13.7, 11.4),
        speed_a=(0.4, 9.0, 0.1),
        speed_p=(-0.3, -7.1, 0.2),
        frames=60,
    )
    links = [("A", "A"), ("A", "P"), ("P", "A")]
    model, swarm = flown(canyon(), **flights, cell_area_per_metre_m=0.3)
    times = [0.004, 0.21, 0.43]
    runs = [[model.trace(swarm.poses(t), t, links).paths for t in times]]
    other, _ = flown(permuted(canyon(), 8), **flights, cell_area_per_metre_m=0.3)
    runs.append([other.trace(swarm.poses(t), t, links).paths for t in times[::-1]][::-1])
    for one, two in zip(*runs, strict=True):
        for link in links:
            a, b = (p[link].select(p[link].kind == PathKind.DIFFUSE) for p in (one, two))
            assert len(a) > 300
            for name in ("gain", "delay", "delay_rate", "delay_accel", "departure", "arrival"):
                assert np.array_equal(getattr(a, name), getattr(b, name)), name
            assert np.array_equal(a.points[:, 0], b.points[:, 0])
        a, b = (one[link].select(one[link].kind == PathKind.DIFFUSE) for link in links[:2])
        place = {tuple(q): i for i, q in enumerate(a.points[:, 0])}
        pairs = np.array(
            [(place[tuple(q)], i) for i, q in enumerate(b.points[:, 0]) if tuple(q) in place]
        )
        assert len(pairs) > 300
        assert np.abs(np.angle(a.gain[pairs[:, 0]] * b.gain[pairs[:, 1]].conj())).max() < 1e-12


def test_points_ever_seen_are_those_seen_from_any_place():
    """In one kernel as place by place, points beyond corners and on roofs among them. Planted bugs:
    the last place is not looked from; a point once in the dark stays there."""
    city = load_city(scenario.City(source="blocks"), ".", F_C, np.zeros(3))
    model, _ = flown(city, (2.0, 3.0, 19.0), (9.0, 40.0, 25.0), cell_area_per_metre_m=9.0)
    shadows, cells = model.field.visibility.los, all_cells(city)
    places = np.array([[2.0, 3.0, 19.0], [-31.0, 8.0, 44.0], [77.0, -60.0, 31.0]])
    normals = city.normals[cells.face]
    each = np.array([shadows.sees(place, cells.points, normals) for place in places])
    assert np.array_equal(shadows.ever_sees(places, cells.points, normals), each.any(axis=0))
    assert (each.any(axis=0) & ~each[0]).sum() > 100
    assert (each[2] & ~each[0] & ~each[1]).sum() > 100
    assert (~each.any(axis=0)).sum() > 100


@pytest.mark.sionna
def test_expected_bistatic_clutter_is_that_of_the_field_between_two_terminals():
    """Two places before a wall: delays and rates by the points' distances to both, found from the
    directions of arrival alone; power as the field's own integral of the bistatic Lambert law over
    a fine grid. Planted bugs: the transmitter's motion left out; the receiver's place for the
    transmitter's; amplitude for power."""
    city = rectangle((-60.0, 50.0, -30.0), (120.0, 0, 0), (0, 0, 60.0), METAL)
    city = replace(city, origin=np.array([310.7, -120.3, 41.9]))
    at, speed, amplitude = np.array([1.3, 28.3, 2.1]), np.array([3.7, -8.1, 1.9]), 0.37
    there, motion = np.array([-9.7, 21.5, 5.3]), np.array([-2.2, 4.0, 0.6])
    copy, pose = expectation(city, speed, at + city.origin)
    sender = np.concatenate([there + city.origin, motion])
    found = copy.between(Link("A", "B"), amplitude, sender, pose)
    back = pose.to_world(found.arrival)
    points = at + ((50.0 - at[1]) / back[:, 1])[:, None] * back
    out, home = points - there, points - at
    far = np.linalg.norm(out, axis=1), np.linalg.norm(home, axis=1)
    assert found.delay * C == pytest.approx(sum(far), rel=1e-12, abs=0)
    rate = -(out @ motion) / far[0] - (home @ speed) / far[1]
    assert found.delay_rate * C == pytest.approx(rate, rel=0, abs=1e-9)
    truth = amplitude**2 * lambertian_wall(there, at, 0.43, 50.0, (60.0, 30.0))
    assert abs(10 * np.log10(found.power.sum() / truth)) < 0.05
    wrong, _ = expectation(city, speed, at + city.origin, level_db=3.0)
    louder = wrong.between(Link("A", "B"), amplitude, sender, pose)
    assert louder.power == pytest.approx(10**0.3 * found.power)
