"""A terminal's own images over walls by closed forms, and what they keep from becoming a track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from isac_rt.extensions.city_receivers.images import Images, Ways, _images
from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.types import Detections
from isac_rt.track.filter import Ambiguity, Gaussian, measure
from isac_rt.track.parts import Ownship
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Track, Tracker
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose, attitude

ORIGIN = np.array([310.7, -120.3, 41.9])
VELOCITY = np.array([0.6, 5.1, -0.2])
W = Waveform()
ANTENNAS = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * W.wavelength)


def city(*quads: list[list[float]]) -> Walls:
    """Walls of four corners each, local coordinates."""
    faces = [
        [4 * k + i for i in three] for k in range(len(quads)) for three in ((0, 1, 2), (0, 2, 3))
    ]
    corners = np.array(quads, float).reshape(-1, 3)
    zeros = np.zeros(len(faces), np.int16)
    return Walls(CityMesh("walls", corners, np.array(faces, np.int32), zeros, (), ORIGIN.copy()))


def pose(place: list[float], forward: list[float]) -> Pose:
    return Pose(ORIGIN + place, VELOCITY, np.zeros(3), attitude(np.array(forward)))


WALL = [[11.3, -20.0, -6.0], [11.3, 40.0, -6.0], [11.3, 40.0, 13.0], [11.3, -20.0, 13.0]]
GROUND = [[-30.0, -20.0, -6.0], [11.3, -20.0, -6.0], [11.3, 40.0, -6.0], [-30.0, 40.0, -6.0]]
OWN = pose([1.7, -3.1, 4.2], [1.0, 0.0, 0.0])


def own_images(own: Pose, walls: Walls, reach: float) -> np.ndarray:
    return Ways.of_own(own, walls, reach).seen[:, :2]


def sender_images(sender: np.ndarray, own: Pose, walls: Walls, reach: float) -> np.ndarray:
    return Ways.of_sender(sender, own, walls, reach).seen


def unique(found: np.ndarray) -> np.ndarray:
    return np.unique(np.round(found, 9), axis=0)


def test_wall_ground_and_their_corner_show_the_terminal():
    """9.6 m to the wall, 10.2 m to the ground, and straight back from the edge between them,
    sqrt(9.6^2 + 10.2^2) m. Rates by the velocity's components. Rounding. Planted bugs:
    the whole way instead of half; the velocity's image turned in one wall only."""
    d, h, far = 9.6, 10.2, np.hypot(9.6, 10.2)
    expected = [[d, -0.6], [h, -0.2], [far, (d * -0.6 + h * -0.2) / far]]
    found = unique(own_images(OWN, city(WALL, GROUND), 100.0))
    np.testing.assert_allclose(found, unique(np.array(expected)), rtol=0, atol=1e-8)


def test_walls_show_a_passive_terminal_its_transmitter():
    """The transmitter 9.6 m before the wall and 10.2 m over the ground shows there, and by both
    planes, where its images stand: lengths of straight ways from (20.9, -3.1, 4.2), (1.7, -3.1,
    -16.2) and (20.9, -3.1, -16.2), either order alike. Rates by the images' motion: components
    turned in the plane or planes. A receiver behind the wall is shown nothing over it. Planted
    bugs: the receiver's motion left out; the image turned in the last plane alone; the reach of
    ways over two planes half as far again."""
    sender = np.append(OWN.position, [1.3, -0.4, 2.2])
    own = pose([3.7, 8.9, 2.2], [1.0, 0.0, 0.0])
    images = [
        ([20.9, -3.1, 4.2], [-1.3, -0.4, 2.2]),
        ([1.7, -3.1, -16.2], [1.3, -0.4, -2.2]),
        ([20.9, -3.1, -16.2], [-1.3, -0.4, -2.2]),
    ]
    expected = []
    for place, motion in images:
        span = np.array([3.7, 8.9, 2.2]) - place
        far = np.linalg.norm(span)
        seen = own.to_body(-span / far)
        expected.append([far, span @ (VELOCITY - motion) / far, seen[0], seen[2]])
    found = unique(sender_images(sender, own, city(WALL, GROUND), 100.0))
    np.testing.assert_allclose(found, unique(np.array(expected)), rtol=0, atol=1e-8)
    for beyond in (-1e-6, 1e-6):
        some = unique(sender_images(sender, own, city(WALL, GROUND), found[-1, 0] + beyond))
        assert len(some) == (2 if beyond < 0 else 3)
    behind = pose([14.0, 8.9, 2.2], [-1.0, 0.0, 0.0])
    assert not len(sender_images(sender, behind, city(WALL), 100.0))


def test_what_is_not_there_shows_nothing():
    """Without ground there is the wall alone; a wall 1 m away from the foot of the perpendicular
    shows nothing, nor one behind, nor one beyond the reach. Planted bug: planes without ends."""
    assert len(unique(own_images(OWN, city(WALL), 100.0))) == 1
    short = [[x, max(y, -2.1), z] for x, y, z in WALL]
    assert not len(own_images(OWN, city(short), 100.0))
    assert not len(own_images(pose([1.7, -3.1, 4.2], [-1.0, 0.0, 0.0]), city(WALL), 100.0))
    assert not len(own_images(OWN, city(WALL), 9.0))


def test_the_corner_of_a_house_sends_nothing_back():
    """Its walls end at the edge that the terminal looks at, and go on behind each other; a third of
    a metre between walls that meet in front hides no corner, nor does a wall that ends a hand above
    its roof. Planted bugs: any edge a corner; normals as the mesh has them; planes that have to go
    on for 0.6 m."""

    def upright(x0: float, y0: float, x1: float, y1: float) -> list[list[float]]:
        return [[x0, y0, -6.0], [x1, y1, -6.0], [x1, y1, 13.0], [x0, y0, 13.0]]

    house = city(upright(11.3, 2.0, 11.3, 40.0), upright(11.3, 2.0, 40.0, 2.0))
    assert not len(own_images(OWN, house, 100.0))
    yard = city(upright(11.3, -20.0, 11.3, 2.0), upright(-18.0, 2.0, 11.1, 2.0))
    expected = np.sort([9.6, 5.1, np.hypot(9.6, 5.1)])
    np.testing.assert_allclose(unique(own_images(OWN, yard, 100.0))[:, 0], expected, atol=1e-8)
    parapet = [[11.3, -20.0, -6.0], [11.3, 20.0, -6.0], [11.3, 20.0, 2.2], [11.3, -20.0, 2.2]]
    roof = [[-20.0, -20.0, 2.0], [11.3, -20.0, 2.0], [11.3, 20.0, 2.0], [-20.0, 20.0, 2.0]]
    expected = [2.2, np.hypot(9.6, 2.2)]
    terrace = unique(own_images(OWN, city(parapet, roof), 100.0))[:, 0]
    np.testing.assert_allclose(terrace, expected, atol=1e-8)


@pytest.mark.parametrize(("side", "corner"), [(0.2, True), (0.4, False)])
def test_a_corner_that_ends_beside_sends_back(side, corner):
    """Wall and ground whose edge ends a hand before the place that sends back: a part of the
    Fresnel zone meets both. Planted bug: the planes without what they may end short."""
    ends = [[x, max(y, -3.1 + side), z] for x, y, z in WALL]
    found = unique(own_images(OWN, city(ends, GROUND), 100.0))[:, 0]
    assert np.isclose(found, np.hypot(9.6, 10.2)).any() == corner


@pytest.mark.parametrize(("over", "hidden"), [(0.2, False), (0.4, True)])
@pytest.mark.parametrize("deep", [0.0, 0.3])
@pytest.mark.parametrize("slope", np.radians([0, 30, 45, 90]))
def test_waves_bend_round_an_edge(over, hidden, deep, slope):
    """A screen, and a house, half way to the wall whose edge of any slope is 0.2 or 0.4 m beside
    the way: round by 0.3 m leads past the one. Planted bugs: straight ways alone; ways round some
    edges alone."""
    along, off = np.array([[np.cos(slope), np.sin(slope)], [-np.sin(slope), np.cos(slope)]])
    sides = ((-9, -5), (6, -5), (6, over), (-9, over))
    flat = [np.array([-3.1, 4.2]) + s * along + t * off for s, t in sides]
    at = [[6.0 + d, *yz] for d in (0.0, deep) for yz in flat]
    walls = city(WALL, at[:4], *([at[4:]] if deep else []))
    line = np.array([[1.7, -3.1, 4.2], [11.3, -3.1, 4.2], [1.7, -3.1, 4.2]]) + ORIGIN
    assert walls.block(line, 0.0) and walls.block(line, 0.3) == hidden


@pytest.mark.parametrize(("before", "hidden"), [(0.2, False), (0.4, True)])
def test_what_touches_a_mirror_hides_nothing_of_it(before, hidden):
    """A plate of 4 m before the place where the wave meets the wall. Planted bug: the way
    is followed to its end."""
    plate = [[11.3 - before, -3.1 + y, 4.2 + z] for y, z in ((-2, -2), (2, -2), (2, 2), (-2, 2))]
    line = np.array([[1.7, -3.1, 4.2], [11.3, -3.1, 4.2], [1.7, -3.1, 4.2]]) + ORIGIN
    assert city(WALL, plate).block(line, 0.3) == hidden


@pytest.mark.parametrize(("width", "corner"), [(2.0, True), (0.9, False)])
def test_a_car_and_the_ground_are_a_corner(width, corner):
    """A plate of 1.4 m^2 that stands on the ground sends back, one of 0.6 m^2 is no mirror. Planted
    bug: only planes of 8 m^2 and more."""
    y = -3.1 + width / 2 * np.array([-1, 1])
    plate = [[8.0, y[0], 0.0], [8.0, y[1], 0.0], [8.0, y[1], 0.7], [8.0, y[0], 0.7]]
    ground = [[-40.0, -40.0, 0.0], [40.0, -40.0, 0.0], [40.0, 40.0, 0.0], [-40.0, 40.0, 0.0]]
    found = unique(own_images(OWN, city(plate, ground), 100.0))[:, 0]
    np.testing.assert_allclose(found, [4.2, np.hypot(6.3, 4.2)][: 1 + corner], atol=1e-8)


def within_a_face(walls: Walls, mirror: int, point: np.ndarray) -> bool:
    """Whether a place in a mirror's plane is off a face's sides by 0.3 m at most, by barycentric
    coordinates and the altitudes that they are shares of."""
    mesh = walls.city
    for face in np.flatnonzero(mesh.plane_of_face == mesh.plane_of_face[walls.mirrors[0][mirror]]):
        corners = mesh.corners[face] + ORIGIN
        shares = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.append(point, 1.0))[0]
        sides = np.linalg.norm(np.roll(corners, 1, axis=0) - np.roll(corners, -1, axis=0), axis=1)
        if (shares * 2 * mesh.areas[face] / sides >= -0.3).all():
            return True
    return False


def length_over(walls: Walls, mirrors: list[int], start: np.ndarray, end: np.ndarray):
    """Length of the way over mirrors by unfolding, None where there is none."""
    _, normals, offsets = walls.mirrors
    images = [start]
    for k in mirrors:
        turn = np.eye(3) - 2 * np.outer(normals[k], normals[k])
        images.append(turn @ images[-1] + 2 * offsets[k] * normals[k])
    to = end
    for k, image, before in zip(mirrors[::-1], images[:0:-1], images[-2::-1], strict=True):
        beyond, ahead = offsets[k] - normals[k] @ image, normals[k] @ to - offsets[k]
        met = image + (to - image) * beyond / (beyond + ahead)
        margin = 0.3 * (k == mirrors[0]) * (len(mirrors) == 2)  # the other plane may end short
        side = ahead * np.sign(normals[k] @ before - offsets[k])
        if side <= -margin or not within_a_face(walls, k, met):
            return None
        to = met
    return np.linalg.norm(images[-1] - end)


def test_all_ways_over_one_and_two_planes_are_found():
    """Against each mirror and each pair by itself, among thirty walls at random; rates by the
    lengths 2e-4 s apart. Planted bugs: a mirror's faces but the first left out; pairs of mirrors in
    one order alone; more than 64 pairs forgotten."""
    rng = np.random.default_rng(11)
    quads = []
    for _ in range(30):
        middle, along = rng.uniform(-40, 40, 3), rng.standard_normal(3) * [1, 1, 0.2]
        up = np.cross(np.cross(along, [0, 0, 1.0] + 0.2 * rng.standard_normal(3)), along)
        a, b = (25 * v / np.linalg.norm(v) for v in (along, up))
        quads.append([middle - a - b, middle + a - b, middle + a + b, middle - a + b])
    walls = city(*np.array(quads).tolist())
    own = pose([3.7, -2.9, 4.2], [1.0, 0.3, 0.0])
    sender = np.append(ORIGIN + np.array([-7.1, 12.3, 8.4]), [4.3, -3.4, 2.2])
    here, near = np.append(own.position, own.velocity), np.arange(len(walls.mirrors[0]))
    expected = []
    chains = [[i] for i in near] + [[i, j] for i in near for j in near if i != j]
    for chain in chains:
        far = [
            length_over(walls, chain, *(x[:3] + t * x[3:] for x in (sender, here)))
            for t in (0.0, -1e-4, 1e-4)
        ]
        if far[0] is not None:
            expected.append([far[0], (far[2] - far[1]) / 2e-4])
    found = measure(_images(sender, here, walls, (near, near), 500.0)[0], own)[:, :2]
    assert len(found) > 40
    np.testing.assert_allclose(unique(found), unique(np.array(expected)), rtol=0, atol=1e-6)


def test_a_sharp_corner_sends_back_the_chord_of_twice_its_angle():
    """Two walls at 70 degrees, 12 m from their edge: the image by both is turned by 140 degrees
    about the edge, half the chord away, 12 sin(70) m; its rate is that of the distance to the edge
    times sin(70). Rounding. Planted bug: planes at right angles alone."""
    angle, r, mine = np.deg2rad(70.0), 12.0, np.deg2rad(30.0)
    across = [40 * np.cos(angle), 40 * np.sin(angle)]
    first = [[0.0, 0.0, -5.0], [40.0, 0.0, -5.0], [40.0, 0.0, 5.0], [0.0, 0.0, 5.0]]
    second = [[0.0, 0.0, -5.0], [*across, -5.0], [*across, 5.0], [0.0, 0.0, 5.0]]
    u = np.array([np.cos(mine), np.sin(mine), 0.0])
    own = pose((r * u + [0, 0, 0.3]).tolist(), (-u).tolist())
    found = unique(own_images(own, city(first, second), 100.0))
    np.testing.assert_allclose(
        found[:, 0], np.sort(r * np.sin([mine, angle - mine, angle])), rtol=0, atol=1e-8
    )
    assert found[-1, 1] == pytest.approx(VELOCITY @ u * np.sin(angle), abs=1e-8)


def detections(range_: list[float], velocity: list[float], u_x: list[float]) -> Detections:
    count = len(range_)
    return Detections(
        range=np.array(range_),
        velocity=np.array(velocity),
        direction=np.column_stack([u_x, np.full(count, 0.1)]),
        snr=np.full(count, 40.0),
        std=np.tile([0.01, 0.01, 2e-3, 2e-3], (count, 1)),
        is_reference=np.zeros(count, bool),
        starts=np.ones(count, bool),
    )


def test_images_and_aliases_start_no_track():
    """One cell of range off the wall's image and at its rate, also one period of velocities off;
    2.1 cells off; at the edge of the view. Planted bugs: range alone decides; velocities not
    folded."""
    cell, period = W.range_cell(2), 2 * W.max_velocity(2)
    found = Images(city(WALL), ANTENNAS, W, 2).candidates(
        detections(
            [9.6 + cell, 9.6, 9.6 + 2.1 * cell, 9.6, 30.0],
            [-0.6, -0.6 + period, -0.6, 1.2, 3.0],
            [0.2, 0.2, 0.2, 0.2, 0.85],
        ),
        Ownship(OWN, 0.0),
    )
    assert found.starts.tolist() == [False, False, True, True, False]


@pytest.mark.parametrize("hidden", [False, True])
def test_images_that_nothing_shows_start_tracks(hidden):
    """The ground's image is straight below, where elements neither send nor receive; that of the
    wall may be hidden by a screen too small to be a mirror. Planted bugs: occlusion not asked; the
    elements' pattern not asked."""
    screen = [[6.0, -4.0, 3.0], [6.0, -2.0, 3.0], [6.0, -2.0, 6.0], [6.0, -4.0, 6.0]]
    walls = city(WALL, GROUND, *([screen] if hidden else []))
    found = Images(walls, replace(ANTENNAS, gain=10**0.5, pattern="cosine"), W, 2).candidates(
        detections([9.6, 10.2], [-0.6, -0.2], [0.2, 0.2]), Ownship(OWN, 0.0)
    )
    assert found.starts.tolist() == [hidden, True]


def test_images_of_the_transmitter_start_no_track_where_they_stand():
    """Off the transmitter's image in a wall by nothing; by 2.1 cells of length; by 2.1 of rate; and
    from elsewhere. Planted bugs: the direction left out; the receiver's own image instead."""
    sender = np.append(OWN.position, [1.3, -0.4, 2.2])
    own = pose([3.7, 8.9, 2.2], [1.0, 0.0, 0.0])
    z = sender_images(sender, own, city(WALL), 100.0)[0]
    known = Track.of_state(Gaussian(sender, 1e-4 * np.eye(6)))
    d = detections(
        [z[0], z[0] + 2.1 * W.range_cell(1), z[0], z[0]],
        [z[1], z[1], z[1] + 2.1 * W.velocity_cell(1), z[1]],
        [z[2], z[2], z[2], z[2] - 0.5],
    )
    d = replace(d, direction=np.column_stack([d.direction[:, 0], np.full(4, z[3])]))
    found = Images(city(WALL), ANTENNAS, W, 1).candidates(d, Ownship(own, 0.0, reference=known))
    assert found.starts.tolist() == [False, True, True, True]


def test_an_image_beyond_the_view_starts_no_track_in_its_alias():
    """The transmitter's image 75 degrees off the boresight shows where phases between antennas
    0.577 wavelengths apart differ by a whole turn, 1 / 0.577 of a cosine on; half of that is no
    alias. Planted bug: directions compared as they are."""
    sender = np.append(OWN.position, [1.3, -0.4, 2.2])
    off = np.deg2rad(75.0)
    toward = np.array([17.2, -12.0, 2.0])  # from the receiver to the image behind the wall
    right = np.array([toward[1], -toward[0], 0.0]) / np.hypot(*toward[:2])
    ahead = np.array([*toward[:2], 0.0]) / np.hypot(*toward[:2])
    own = pose([3.7, 8.9, 2.2], (np.cos(off) * ahead - np.sin(off) * right).tolist())
    z = sender_images(sender, own, city(WALL), 100.0)[0]
    assert z[2] > 0.9
    known = Track.of_state(Gaussian(sender, 1e-4 * np.eye(6)))
    d = detections([z[0], z[0]], [z[1], z[1]], [z[2] - 1 / 0.5774, z[2] - 0.5 / 0.5774])
    d = replace(d, direction=np.column_stack([d.direction[:, 0], np.full(2, z[3])]))
    found = Images(city(WALL), ANTENNAS, W, 1).candidates(d, Ownship(own, 0.0, reference=known))
    assert found.starts.tolist() == [False, True]


@pytest.mark.parametrize(("seen", "gone"), [(4, 6), (2, 3)])
def test_what_may_not_start_a_track_carries_one_on(seen, gone):
    """Two detections, of which one may start a track; in the next frames none may, and the track is
    carried on. Without further ones it ends when 0.2 s have passed, at the third frame of 0.07 s;
    if it was seen in two frames alone, after two of them. Planted bugs: tracks start on all; frames
    counted instead of the time; young tracks as old ones."""
    settings = Tracking(confirm_hits=1, confirm_window=1, drop_after_s=0.2, drop_misses=90)
    tracker, rest = Tracker(settings, Ambiguity(60.0)), Pose(*np.zeros((3, 3)), np.eye(3))
    for k in range(8):
        tracker.predict(0.07 * k)
        both = detections([20.0 + 0.07 * k, 33.0], [1.0, 2.0], [0.1, -0.3])
        some = both.select(np.arange(2) < (2 if k < seen else 0))
        starts = np.array([k == 0, False])[: len(some)]
        tracker.update(Detections(**{**vars(some), "starts": starts}), rest)
        assert len(tracker.tracks) == (1 if k < gone else 0)
