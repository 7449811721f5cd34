"""Path geometry, cross-sections and free space against closed forms and long double."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.link import Link
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.rcs import CrossSection, large_uav_db
from isac_rt.propagation.segments.geometry import (
    edges_in_any_order,
    one_of_each_chain,
    plane_of_each_face,
)
from isac_rt.scenario.swarm import Uav
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.settings import Rcs
from isac_rt.world.swarm import Pose, attitude

C = 299_792_458.0
LAMBDA = C / 77e9
ROUNDING = 1e-13  # some tens of operations in float64, relative to metres over tens of metres


def near(value, rel: float):
    """Equal to a relative error alone: pytest's default adds 1e-12, which is more than most
    gains."""
    return pytest.approx(value, rel=rel, abs=0)


def pose(position, velocity=(0, 0, 0), acceleration=(0, 0, 0), boresight=(0.3, 1.0, 0.1)) -> Pose:
    return Pose(
        *(np.array(v, float) for v in (position, velocity, acceleration)),
        attitude(np.array(boresight, float)),
    )


TX = pose((1.37, -2.21, 11.3), (4.3, -7.1, 1.9), (0.7, 1.1, -2.3))
RX = pose((23.9, 17.3, 8.77), (-6.2, 2.9, 3.1), (-1.3, 0.4, 0.9))
BODY = pose((9.7, 31.1, 14.9), (3.7, 8.3, -2.2), (2.1, -0.6, 1.7), (0.2, -1.0, 0.3))


def at(p: Pose, t: float, dtype=float) -> np.ndarray:
    return (
        p.position.astype(dtype)
        + p.velocity.astype(dtype) * t
        + p.acceleration.astype(dtype) * t * t / 2
    )


def rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return q * np.sign(np.linalg.det(q))


def moved(p: Pose, turn: np.ndarray, shift: np.ndarray) -> Pose:
    return Pose(
        turn @ p.position + shift, turn @ p.velocity, turn @ p.acceleration, turn @ p.rotation
    )


def mirrors(*planes) -> tuple[np.ndarray, np.ndarray]:
    """One chain of planes given as (normal, point), as `unfold` wants it."""
    normals = np.array([np.array(n, float) / np.linalg.norm(n) for n, _ in planes])
    return normals[None], np.array(
        [[n @ np.array(p, float) for n, (_, p) in zip(normals, planes, strict=True)]]
    )


def chain_length(planes, start: np.ndarray, end: np.ndarray) -> np.longdouble:
    """Length over mirrors by Householder matrices in long double, without any of the package's
    code."""
    image = start
    for normal, point in planes:
        n = np.array(normal, np.longdouble)
        n = n / np.sqrt((n * n).sum())
        householder = np.eye(3, dtype=np.longdouble) - 2 * np.outer(n, n)
        image = householder @ (image - np.array(point, np.longdouble)) + np.array(
            point, np.longdouble
        )
    return np.sqrt(((end - image) ** 2).sum())


def derivatives(length) -> tuple[float, float]:
    """First and second derivative of length(t) at 0 by central differences of fourth order in long
    double."""
    h = np.longdouble("1e-3")
    f = {k: length(k * h) for k in (-2, -1, 0, 1, 2)}
    first = (8 * (f[1] - f[-1]) - (f[2] - f[-2])) / (12 * h)
    second = (16 * (f[1] + f[-1]) - (f[2] + f[-2]) - 30 * f[0]) / (12 * h * h)
    return float(first), float(second)


def test_all_triangles_of_a_wall_are_one_mirror():
    """A corner lifted by half of the tolerance: both triangles take the plane of the larger one, to
    the last bit. Seen failing with each face's own plane."""
    vertices = np.array(
        [(0, 0, 0), (9.1, 0, 0), (9.1, 5.3, 0), (0, 7.7, 5e-7), (0, 0, 3.0), (9.1, 0, 3.0)], float
    )
    faces = np.array([(0, 1, 2), (0, 2, 3), (0, 1, 5), (0, 5, 4)], np.int32)
    city = CityMesh("tilted", vertices, faces, np.zeros(4, np.int16), (), np.zeros(3))
    assert city.areas[1] > city.areas[0]
    normals, offsets = plane_of_each_face(city)
    assert np.array_equal(normals[0], city.normals[1])
    assert np.array_equal(normals[1], city.normals[1])
    assert offsets[0] == offsets[1] == city.plane_offsets[1]
    assert np.abs(normals[2:, 2]).max() < 1e-12
    empty = CityMesh(
        "none", np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.int16), (), np.zeros(3)
    )
    assert [a.shape for a in plane_of_each_face(empty)] == [(0, 3), (0,)]


def test_one_path_of_each_chain_of_planes():
    """By planes, not faces; of equals the one with the lowest faces, so that the order of discovery
    does not matter; never a bad one. Seen failing with the faces as the key."""
    faces = np.array([(5, 2), (4, 2), (2, 5), (1, 2), (4, 3), (0, 2)])
    planes = np.array([7, 7, 3, 3, 7, 7])[faces]
    good = np.array([True, True, True, True, True, False])
    kept = one_of_each_chain(planes, faces, good)
    assert kept.tolist() == [2, 3]
    order = np.array([3, 1, 5, 0, 4, 2])
    again = order[one_of_each_chain(planes[order], faces[order], good[order])]
    assert again.tolist() == [2, 3]
    none = np.zeros((3, 0), int)
    assert one_of_each_chain(none, none, np.array([False, True, True])).tolist() == [1]


def test_walls_that_meet_in_a_point_have_no_order():
    """Sorted where the points coincide, and nowhere else. Seen failing with all planes sorted, and
    with one pass only."""
    here, there = [1.0, 2.0, 3.0], [1.0, 2.0, 3.5]
    points = np.array(
        [[here, here, here], [there, here, here], [here, here, there], [here, there, here]]
    )
    planes = np.array([[9, 7, 4]] * 4)
    assert edges_in_any_order(planes, points).tolist() == [
        [4, 7, 9],
        [9, 4, 7],
        [7, 9, 4],
        [9, 7, 4],
    ]
    assert planes[0].tolist() == [9, 7, 4]


# ---- cross-sections


def directions(count: int, seed: int = 3) -> np.ndarray:
    u = np.random.default_rng(seed).standard_normal((count, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def test_a_constant_cross_section():
    u = directions(40)
    constant = CrossSection(Rcs(model="constant", value_dbsm=-7.3), "U", 1).square_metres(
        u, u[::-1]
    )
    assert constant == near(np.full(40, 10**-0.73), 1e-12)


def test_large_uav_at_its_lobes():
    """Peaks of the table at the lobes' centres, half of the power at half of the width, the floor
    between them. Seen failing with left and right exchanged for front and back."""
    forward, right, up = np.eye(3)[1], np.eye(3)[0], np.eye(3)[2]
    half = np.radians(14.19 / 2)
    off_front = np.cos(half) * forward + np.sin(half) * right
    between = (forward + right) / np.sqrt(2)
    seen = large_uav_db(
        np.array([forward, right, -right, -forward, up, -up, off_front, between]), np.zeros(8)
    )
    assert seen == pytest.approx([1.02, 7.43, 7.43, 3.99, 13.55, 13.55, 1.02 - 3, -6.87], abs=1e-6)


@pytest.mark.parametrize("std", [3.74, 6.3])
def test_fluctuation_keeps_the_mean_cross_section(std):
    """In power, over bodies and at a generic bistatic angle, whatever its spread. Planted bug: zero
    mean in decibels, which is 1.6 dB too much at 3.74 dB."""
    u = directions(30, 5)
    observed = directions(30, 6)
    of = [
        CrossSection(Rcs(model="constant", value_dbsm=-9.1, fluctuation_db=std), f"U{k}", 4)
        for k in range(3000)
    ]
    mean = np.mean([section.square_metres(u, observed) for section in of])
    scatter = np.sqrt(np.exp((np.log(10) / 10 * std) ** 2) - 1)  # of a log-normal power
    # statistical: 3000 bodies in some 10 independent aspects; 5 sigma
    assert mean / 10**-0.91 == pytest.approx(1.0, abs=5 * scatter / np.sqrt(30000))


def test_the_reports_uavs_fluctuate_unless_told_otherwise():
    """3.74 dB for the small UAV and 2.50 dB for the large, seen as spread over bodies."""
    u = directions(1, 3)
    for size, std in (("small", 3.74), ("large", 2.50)):
        db = [
            10 * np.log10(CrossSection(Rcs(size=size), f"U{k}", 4).square_metres(u, u)[0])
            for k in range(1000)
        ]
        assert np.std(db) == near(std, 0.11)  # statistical: 1000 bodies, 5 sigma
        still = Rcs(size=size, fluctuation_db=0)
        assert CrossSection(still, "a", 4).square_metres(u, u) == CrossSection(
            still, "b", 4
        ).square_metres(u, u)


def test_cross_section_belongs_to_the_body_alone():
    """Alike for both directions of a link, from call to call, and different for another name."""
    rcs, u = Rcs(fluctuation_db=4.0), directions(30)
    a = CrossSection(rcs, "U1", 4).square_metres(u, u[::-1])
    assert np.array_equal(a, CrossSection(rcs, "U1", 4).square_metres(u, u[::-1]))
    assert a == near(CrossSection(rcs, "U1", 4).square_metres(u[::-1], u), 1e-12)
    assert np.abs(a / CrossSection(rcs, "U2", 4).square_metres(u, u[::-1]) - 1).max() > 0.3


def test_fluctuation_fades_towards_forward_scattering():
    """Where the bisector has no direction, the section must not jump: two ways past the forward
    direction agree."""
    section = CrossSection(Rcs(model="constant", fluctuation_db=6.0), "U", 1)
    u, side = np.array([[0.6, 0.0, 0.8]]), np.array([[0.0, 1.0, 0.0]])
    angle = 1e-6
    left, right = (-(np.cos(angle) * u + s * np.sin(angle) * side) for s in (1, -1))
    assert section.square_metres(u, left) == near(section.square_metres(u, right), 1e-5)


@pytest.mark.sionna
@pytest.mark.parametrize("size", ["small", "large"])
def test_cross_sections_are_sionnas(size):
    """TR 38.901's means in Sionna RT's own words; its body has x forward, y left."""
    import mitsuba as mi
    from sionna.rt.rcs.tr38901.parameters import get_target_parameters
    from sionna.rt.rcs.tr38901.rcs import TR38901RCS

    p = get_target_parameters(f"uav-{size}-size", 1 if size == "small" else 2)
    theirs = TR38901RCS(p.lobes, p.k1, p.k2, p.sigma_m_db)
    centres = np.repeat(np.concatenate([np.eye(3), -np.eye(3)]), 300, axis=0)
    to_source = directions(1800, 1) * 0.15 + centres  # where the lobes are
    to_observer = directions(1800, 2) * np.repeat([0.1, 0.4, 1.5] * 600, 1)[:, None] + centres
    to_source, to_observer = (
        v / np.linalg.norm(v, axis=1, keepdims=True) for v in (to_source, to_observer)
    )

    def in_their_axes(v):
        return mi.Vector3f(*np.stack([v[:, 1], -v[:, 0], v[:, 2]]).astype(np.float32))

    expected = 10 * np.log10(
        np.asarray(theirs(in_their_axes(-to_source), in_their_axes(to_observer)), float)
    )
    ours = 10 * np.log10(
        CrossSection(Rcs(size=size, fluctuation_db=0), "U", 1).square_metres(to_source, to_observer)
    )
    assert ours.std() > (0.3 if size == "small" else 2)
    assert (
        np.abs(ours - expected).max() < 2e-3
    )  # float32 angles on slopes of up to 20 dB per degree


# ---- free space


def antennas(**changes) -> Antennas:
    keys = {
        "tx_x": 2,
        "tx_z": 2,
        "rx_x": 8,
        "rx_z": 8,
        "spacing": 0.5774 * LAMBDA,
        "gain": 3.7,
        "pattern": "cosine",
    }
    return Antennas(**keys | changes)


def facing(p: Pose, *others: Pose) -> Pose:
    """The pose turned so that all others lie somewhere ahead, none on boresight."""
    towards = sum(
        (o.position - p.position) / np.linalg.norm(o.position - p.position) for o in others
    )
    return Pose(
        p.position, p.velocity, p.acceleration, attitude(towards + np.array([0.1, -0.07, 0.05]))
    )


POSES = {"A": facing(TX, RX, BODY), "P": facing(RX, TX, BODY), "U": BODY}
UAVS = {
    "A": Uav(role="active", position_m=(0, 0, 0)),
    "P": Uav(role="passive", position_m=(0, 0, 0), rcs=Rcs(model="constant", value_dbsm=-3.3)),
    "U": Uav(role="target", position_m=(0, 0, 0), rcs=Rcs(model="constant", value_dbsm=-11.7)),
}


def free_space(uavs=UAVS, **changes) -> FreeSpace:
    return FreeSpace(uavs, Arrays(antennas(**changes)), LAMBDA, 1)


def element(p: Pose, towards: np.ndarray, gain=3.7) -> float:
    """G cos^q with q = G/2 - 1, from the definition."""
    u = (towards - p.position) / np.linalg.norm(towards - p.position)
    return gain * (u @ p.rotation[:, 1]) ** (gain / 2 - 1)


def test_line_of_sight_is_friis():
    """|gain|^2 = G G (lambda / 4 pi d)^2, phase zero. Seen failing with the receiver's element
    along the departure."""
    paths = free_space().trace(POSES, 0.5, [("A", "P")]).paths["A", "P"]
    (k,) = np.flatnonzero(paths.kind == PathKind.LINE_OF_SIGHT)
    d = np.linalg.norm(RX.position - TX.position)
    expected = (
        element(POSES["A"], RX.position)
        * element(POSES["P"], TX.position)
        * (LAMBDA / (4 * np.pi * d)) ** 2
    )
    assert paths.gain[k] == near(np.sqrt(expected), 1e-12)
    assert paths.delay[k] == near(d / C, 1e-15)
    assert (paths.tx_radius[k], paths.rx_radius[k]) == pytest.approx((d, d))
    assert paths.departure[k] == pytest.approx((RX.position - TX.position) / d)
    assert paths.arrival[k] == pytest.approx(-paths.departure[k])
    assert paths.epoch == 0.5
    assert paths.target[k] == -1


@pytest.mark.parametrize("rx", ["A", "P"])
def test_echo_is_the_radar_equation(rx):
    """P = G G lambda^2 sigma / ((4 pi)^3 r1^2 r2^2), monostatic and bistatic. Seen failing with (4
    pi)^2."""
    paths = free_space().trace(POSES, 0.0, [("A", rx)]).paths["A", rx]
    (k,) = np.flatnonzero((paths.kind == PathKind.TARGET) & (paths.target == 2))
    r1, r2 = (np.linalg.norm(BODY.position - POSES[end].position) for end in ("A", rx))
    gains = element(POSES["A"], BODY.position) * element(POSES[rx], BODY.position)
    expected = gains * LAMBDA**2 * 10**-1.17 / ((4 * np.pi) ** 3 * r1**2 * r2**2)
    assert paths.power[k] == near(expected, 1e-12)
    assert paths.delay[k] == near((r1 + r2) / C, 1e-15)
    assert (paths.tx_radius[k], paths.rx_radius[k]) == pytest.approx((r1, r2))
    assert paths.target_names[paths.target[k]] == "U"
    assert paths.points[k, 0] == pytest.approx(BODY.position)


def test_links_hold_the_right_paths():
    """The own link has every other UAV and no line of sight; a link to a PT has no echo of its two
    ends. An echo has one point, the body's, and it lies on no face. Planted bug: a face more than
    there are points."""
    found = free_space().trace(POSES, 0.0, [("A", "A"), ("A", "P")]).paths
    assert found["A", "A"].faces.tolist() == [[-1], [-1]]
    assert np.array_equal(found["A", "A"].points, [[POSES["P"].position], [POSES["U"].position]])
    assert found["A", "A"].kind.tolist() == [PathKind.TARGET] * 2
    assert found["A", "A"].target.tolist() == [1, 2]
    assert sorted(found["A", "P"].kind.tolist()) == [PathKind.LINE_OF_SIGHT, PathKind.TARGET]
    assert found["A", "P"].target.tolist() == [-1, 2]


def test_what_no_element_hears_is_left_out():
    """A sector that faces away, at either end. Seen failing with the receiver's gain left out."""
    away = POSES["P"].rotation[:, 1] * -1
    turned = POSES | {"P": Pose(RX.position, RX.velocity, RX.acceleration, attitude(away))}
    model = free_space(pattern="sector")
    assert len(model.trace(POSES, 0.0, [("A", "P")]).paths["A", "P"]) == 2
    assert len(model.trace(turned, 0.0, [("A", "P")]).paths["A", "P"]) == 0


@pytest.mark.parametrize(("rx", "reference"), [("P", "sight"), ("A", "echo")])
def test_relative_echo_stands_at_its_level(rx, reference):
    """20 dB and a bit under the reference path on boresight, whatever the geometry. Seen failing
    with 10^(level/10)."""
    uavs = UAVS | {
        "U": Uav(role="target", position_m=(0, 0, 0), rcs=Rcs(model="relative", level_db=-21.3))
    }
    paths = free_space(uavs).trace(POSES, 0.0, [("A", rx)]).paths["A", rx]
    (k,) = np.flatnonzero(paths.target == 2)
    d = np.linalg.norm(RX.position - TX.position)
    sight = 3.7**2 * (LAMBDA / (4 * np.pi * d)) ** 2
    echo = 3.7**2 * LAMBDA**2 * 10**-0.33 / ((4 * np.pi) ** 3 * d**4)
    expected = {"sight": sight, "echo": echo}[reference] * 10**-2.13
    assert paths.power[k] == near(expected, 1e-12)


def test_no_reference_is_an_error_that_says_so():
    uavs = {n: u.model_copy(update={"rcs": Rcs(model="relative")}) for n, u in UAVS.items()}
    with pytest.raises(ValueError, match="cross-section of its own"):
        free_space(uavs).reference_amplitude(POSES, Link("A", "A"))


def test_reference_is_the_strongest_echo_unoccluded_and_on_boresight():
    """The passive terminal is nearer and larger here, so it is the reference."""
    d = np.linalg.norm(RX.position - TX.position)
    expected = 3.7 * LAMBDA * np.sqrt(10**-0.33 / (4 * np.pi) ** 3) / d**2
    assert free_space().reference_amplitude(POSES, Link("A", "A")) == near(expected, 1e-12)
    assert free_space().strongest_target(POSES, "A") == "P"


def test_free_space_is_reciprocal_and_knows_no_place():
    """Exchanging the ends, and moving everything rigidly, change neither gain nor delay nor their
    rates."""
    names = ("gain", "delay", "delay_rate", "delay_accel")
    here, back = (
        free_space().trace(POSES, 0.0, [link]).paths[link] for link in (("A", "P"), ("P", "A"))
    )
    turn, shift = rotation(2), np.array([83.0, -47.0, 19.0])
    poses = {n: moved(p, turn, shift) for n, p in POSES.items()}
    there = free_space().trace(poses, 0.0, [("A", "P")]).paths["A", "P"]
    for other in (back, there):
        for name in names:
            assert getattr(other, name) == near(getattr(here, name), 1e-10)
    assert back.departure == pytest.approx(here.arrival, abs=1e-13)


def test_every_kind_of_path_has_its_own_number():
    """Of the results file, from 0 on in the order of their list. Planted bug: the number of another
    kind."""
    names = ["LINE_OF_SIGHT", "TARGET", "GHOST", "SPECULAR", "DIFFUSE", "LEAKAGE"]
    assert {name: int(kind) for name, kind in PathKind.__members__.items()} == {
        name: i for i, name in enumerate(names)
    }
