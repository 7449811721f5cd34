"""Echoes that stand still beside each other, by hand: a wall, a UAV that hovers, one that flies."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.city_receivers.static_clutter import MEMORY_S, StaticClutter
from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.receive.types import Detections
from isac_rt.track.filter import UNAMBIGUOUS, Gaussian
from isac_rt.track.parts import Own
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Track, Tracker
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose

PERIOD = 60.0
FLIGHT = np.array([3.0, 6.0, 0.5])


def own(time: float) -> Pose:
    """A terminal that looks north and flies to the north-east."""
    return Pose(FLIGHT * time, FLIGHT, np.zeros(3), np.eye(3))


def seen(time, places, velocities=None, starts=None) -> Detections:
    """What a radar at `own` measures of bodies: geometry by hand."""
    offset = np.array(places, float) - own(time).position
    distance = np.linalg.norm(offset, axis=1)
    e = offset / distance[:, None]
    moving = np.zeros_like(offset) if velocities is None else np.array(velocities, float)
    return Detections(
        range=distance,
        velocity=((moving - FLIGHT) * e).sum(axis=1),
        direction=e[:, [0, 2]],
        snr=np.full(len(e), 40.0),
        std=np.tile([0.01, 0.01, 2e-3, 2e-3], (len(e), 1)),
        is_reference=np.zeros(len(e), bool),
        starts=np.ones(len(e), bool) if starts is None else np.array(starts),
    )


WALL = [(-9.0 + 4 * k, 31.0, 5.0 + k) for k in range(5)]


def test_a_wall_is_a_crowd_and_who_flies_before_it_is_not():
    """Five places of a wall 4 m apart, a UAV among them that closes at 2 m/s more than they do, and
    another one that stands still 60 m away. Planted bugs: the rate not held against the flight; a
    crowd anywhere."""
    d = seen(
        0.0, [*WALL, (0.0, 28.0, 6.0), (10.0, 90.0, 5.0)], [(0, 0, 0)] * 5 + [(0, -2, 0), (0, 0, 0)]
    )
    assert (
        StaticClutter(1.71, None, PERIOD).update(d, own(0.0), 0.0).tolist()
        == [True] * 5 + [False] * 2
    )


def test_a_wall_beyond_the_view_is_seen_elsewhere_and_still_stands():
    """The same wall 25 m to the right and 8 m ahead, at u_x of 0.93 to 0.96: seen 1.71 to the left
    of it, where nothing at that rate would stand still. Planted bug: the directions as they are
    seen."""
    places = [(25.0 + 2 * k, 8.0 + k, 2.0) for k in range(5)]
    d = seen(0.0, places)
    seen_at = Detections(**{**vars(d), "direction": d.direction - [1.71, 0.0]})
    assert (d.direction[:, 0] > 0.9).all()
    assert StaticClutter(1.71, None, PERIOD).update(seen_at, own(0.0), 0.0).all()
    assert not StaticClutter(np.inf, None, PERIOD).update(seen_at, own(0.0), 0.0).any()


def test_a_wall_along_the_wings_is_one_whatever_the_error():
    """The same wall 29 m to the right and 1 to 3 m ahead, at u_x of 0.995 and more, measured 0.015
    too far out with a deviation of 0.01: farther from the boresight than anything can be. With a
    deviation of 0.002 the direction is none, and nothing stands there. Planted bug: only directions
    inside the unit circle are tried."""
    d = seen(0.0, [(29.0 + 2 * k, 1.0 + k / 2, 2.0) for k in range(5)])
    out = d.direction + np.array([0.015 - 1.71, 0.0])
    assert (np.linalg.norm(out + np.array([1.71, 0.0]), axis=1) > 1.007).all()
    for std, stands in ((0.01, True), (0.002, False)):
        seen_at = Detections(**{**vars(d), "direction": out, "std": np.full((5, 4), std)})
        assert (StaticClutter(1.71, None, PERIOD).update(seen_at, own(0.0), 0.0) == stands).all()


def test_velocities_are_folded():
    d = seen(0.0, WALL)
    folded = Detections(**{**vars(d), "velocity": d.velocity + PERIOD})
    assert StaticClutter(1.71, None, PERIOD).update(folded, own(0.0), 0.0).all()


def test_a_uav_that_hovers_alone_is_no_crowd():
    """Thirty frames with errors of 0.3 m on each axis. Planted bug: echoes of one place count."""
    rng, static_clutter = np.random.default_rng(4), StaticClutter(1.71, None, PERIOD)
    for frame in range(30):
        place = np.array([2.0, 25.0, 6.0]) + rng.normal(0, 0.3, 3)
        time = 0.05 * frame
        assert not static_clutter.update(seen(time, [place]), own(time), time).any()


def test_a_wall_that_shows_itself_piece_by_piece():
    """One place a frame: the fourth has three beside it. Long after, it is forgotten; kept by its
    memory it is not. Planted bugs: no memory; no end of it."""
    static_clutter = StaticClutter(1.71, None, PERIOD)
    found = [
        bool(static_clutter.update(seen(t := 0.1 * k, [WALL[k]]), own(t), t)[0]) for k in range(4)
    ]
    assert found == [False, False, False, True]
    again = StaticClutter(1.71, None, PERIOD)
    again.restore(static_clutter.memory())
    assert again.update(seen(0.4, [WALL[4]]), own(0.4), 0.4).all()
    late = 0.4 + MEMORY_S + 0.01
    assert not again.update(seen(late, [WALL[0]]), own(late), late).any()


def test_only_what_could_start_a_track_makes_a_crowd():
    """What the city explains is no surface that it lacks."""
    d = seen(0.0, WALL, starts=[False] * 5)
    assert not StaticClutter(1.71, None, PERIOD).update(d, own(0.0), 0.0).any()


@pytest.mark.parametrize(
    ("place", "velocity", "std", "expected"),
    [
        ((0.0, 30.0, 6.0), (0.2, -0.1, 0.0), 0.3, True),
        ((0.0, 30.0, 6.0), (4.0, 0.0, 0.0), 5.0, True),  # still, for all that is known
        ((0.0, 30.0, 6.0), (4.0, 0.0, 0.0), 0.3, False),
        ((0.0, 90.0, 6.0), (0.2, -0.1, 0.0), 0.3, False),
    ],
)
def test_a_track_that_stands_still_within_a_crowd(place, velocity, std, expected):
    """Planted bugs: the speed alone; the place alone."""
    static_clutter = StaticClutter(1.71, None, PERIOD)
    static_clutter.update(seen(0.0, WALL), own(0.0), 0.0)
    P = np.diag([0.01] * 3 + [std**2] * 3 + [9.0] * 3)
    track = Track(1, Gaussian(np.array([*place, *velocity, 0, 0, 0]), P), 10.0)
    assert static_clutter.holds(track) is expected


def test_a_wall_stands_still_for_a_passive_terminal():
    """Way lengths and their rates by hand, of a transmitter that flies elsewhere to a terminal at
    `own`, over the places of a wall and over a UAV among them that flies off at 5 m/s. Planted
    bugs: places at the length of the whole way; the transmitter's own motion left out."""
    sender = np.array([24.0, 12.0, 9.0, -2.0, 7.0, 1.0])
    places = np.array([*WALL, (0.0, 29.0, 6.0)])
    moving = np.array([(0.0, 0.0, 0.0)] * 5 + [(0.0, 5.0, 0.0)])
    back, there = places - own(0.0).position, places - sender[:3]
    far = np.linalg.norm(back, axis=1), np.linalg.norm(there, axis=1)
    rate = (back * (moving - FLIGHT)).sum(1) / far[0] + (there * (moving - sender[3:])).sum(
        1
    ) / far[1]
    d = seen(0.0, places)
    d = Detections(**{**vars(d), "range": far[0] + far[1], "velocity": rate})
    static_clutter = StaticClutter(np.inf, None, PERIOD)
    assert static_clutter.update(d, own(0.0), 0.0, sender).tolist() == [True] * 5 + [False]
    np.testing.assert_allclose(static_clutter.state.echoes[:, 1:4], WALL, atol=1e-9)


def test_a_young_track_that_an_echo_of_a_crowd_carries_on_is_none():
    """Of tracks that seem to fly, the new ones that such an echo carries on go, confirmed by it or
    not; one that was confirmed before, and those of another echo or of none, stay. Planted bugs:
    all of the crowd go; only what is confirmed goes."""

    def track(number: int, detection: int, confirmed: bool = True) -> Track:
        mean, flies = np.zeros(9), np.array([0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        return Track(
            number, Gaussian(mean + flies, np.eye(9)), 9.0, confirmed=confirmed, detection=detection
        )

    tracks = [track(1, 0), track(2, 0), track(3, 1), track(4, 0, confirmed=False), track(5, -1)]
    tracker = Tracker(Tracking(), UNAMBIGUOUS)
    tracker.state.tracks = tracks
    static_clutter = StaticClutter(1.71, None, PERIOD)
    static_clutter._crowd = np.array([True, False])
    static_clutter.prune(tracker, Own(own(0.0), 0.0, tentative=frozenset({1, 3, 4, 5})))
    assert [t.id for t in tracker.tracks] == [2, 3, 5]


def test_two_uavs_that_hover_near_each_other_are_no_crowd():
    """10 m apart, thirty frames: each is one place beside the other, however often it is seen.
    Planted bug: every echo counted."""
    static_clutter = StaticClutter(1.71, None, PERIOD)
    for frame in range(30):
        time = 0.03 * frame
        d = seen(time, [(8.0, 24.0, 4.0), (-1.7, 27.0, 6.0)])
        assert not static_clutter.update(d, own(time), time).any()


def above(d: Detections, snr: list[float]) -> Detections:
    return Detections(**{**vars(d), "snr": np.array(snr)})


@pytest.mark.parametrize(("snr", "crowd"), [(390.0, True), (410.0, False)])
def test_a_uav_that_stands_out_of_a_wall_by_ten_decibels_is_none_of_it(snr, crowd):
    """Hovering before five places of a wall at 40; the wall stays one, and a track at the UAV's
    place is held to the same. Planted bugs: strength ignored; the wall's echoes spared too."""
    place = (0.0, 28.0, 6.0)
    static_clutter = StaticClutter(1.71, None, PERIOD)
    found = static_clutter.update(
        above(seen(0.0, [*WALL, place]), [40.0] * 5 + [snr]), own(0.0), 0.0
    )
    assert found.tolist() == [True] * 5 + [crowd]
    state = Gaussian(np.array([*place, *np.zeros(6)]), np.diag([0.01] * 3 + [0.09] * 3 + [9.0] * 3))
    assert static_clutter.holds(Track(1, state, snr)) is crowd


@pytest.mark.parametrize(("snr", "crowd"), [(390.0, True), (410.0, False)])
def test_what_stands_out_by_ten_decibels_makes_no_crowd_of_the_weaker(snr, crowd):
    """A UAV at 40 that hovers beside two others' places and a body that outshines it: three places,
    of which the brightest is no part of a surface that the UAV could be of. Planted bug: the
    strength of those beside it ignored."""
    places = [(0.0, 28.0, 6.0), (-4.0, 29.0, 7.0), (3.0, 30.0, 9.0), (-2.0, 24.0, 4.0)]
    found = StaticClutter(1.71, None, PERIOD).update(
        above(seen(0.0, places), [40.0, 40.0, 40.0, snr]), own(0.0), 0.0
    )
    assert found[:3].tolist() == [crowd] * 3


@pytest.mark.parametrize(("height", "crowd"), [(1.4, True), (1.6, False)])
def test_what_touches_the_mesh_does_not_stand_out(height, crowd):
    """A bright echo before a wall that the mesh lacks, over the ground that it has. Planted bug:
    the mesh not asked."""
    corners = np.array([[-60.0, -9, 0], [60, -9, 0], [60, 90, 0], [-60, 90, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    ground = CityMesh("ground", corners, faces, np.zeros(2, np.int16), (), np.zeros(3))
    d = above(seen(0.0, [*WALL, (0.0, 28.0, height)]), [40.0] * 5 + [4000.0])
    found = StaticClutter(1.71, Walls(ground), PERIOD).update(d, own(0.0), 0.0)
    assert found.tolist() == [True] * 5 + [crowd]


def test_a_line_of_sight_is_no_echo():
    """Planted bug: a passive terminal's reference remembered."""
    static_clutter = StaticClutter(1.71, None, PERIOD)
    d = seen(0.0, WALL)
    static_clutter.update(
        Detections(**{**vars(d), "is_reference": np.ones(5, bool)}), own(0.0), 0.0
    )
    assert len(static_clutter.state.echoes) == 0


def ground() -> Walls:
    """A square of 50 m and more about the places of these tests, at height nothing."""
    corners = np.array([[-60.0, -9, 0], [60, -9, 0], [60, 90, 0], [-60, 90, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Walls(CityMesh("ground", corners, faces, np.zeros(2, np.int16), (), np.zeros(3)))


@pytest.mark.parametrize(
    ("height", "velocity", "std", "expected"),
    [
        (0.2, (0.0, 0.0, 0.0), 2e-3, True),
        (0.6, (0.0, 0.0, 0.0), 2e-3, False),
        (0.6, (0.0, 0.0, 0.0), 5e-3, True),  # three deviations at 30 m are 0.45 m, and 0.3 m
        (0.2, (0.0, 0.0, 0.0), 2e-2, False),  # known to 1.8 m, it may lie on any face
        (0.2, (0.0, 3.0, 0.0), 2e-3, False),
    ],
)
def test_what_stands_still_on_a_face_is_the_face(height, velocity, std, expected):
    """One echo alone, 30 m away; it is remembered as others are, for a wall that the mesh lacks
    stands beside. Planted bugs: the mesh not asked; deviations left out; any place taken for a
    face; the rate not held against the flight."""
    static_clutter = StaticClutter(1.71, ground(), PERIOD)
    d = seen(0.0, [(0.0, 30.0, height)], [velocity])
    d = Detections(**{**vars(d), "std": np.array([[0.01, 0.01, std, std]])})
    assert static_clutter.update(d, own(0.0), 0.0).tolist() == [expected]
    if expected:
        assert len(static_clutter.state.echoes) == 1


@pytest.mark.parametrize(
    ("height", "velocity", "std", "expected"),
    [
        (0.5, (0.2, -0.1, 0.0), 0.1, True),
        (0.7, (0.2, -0.1, 0.0), 0.1, False),
        (0.2, (0.0, 9.0, 0.0), 0.1, True),
        (0.4, (0.0, 9.0, 0.0), 0.1, False),
        (0.2, (0.0, 9.0, 0.0), 0.3, False),
    ],
)
def test_no_uav_flies_in_a_face(height, velocity, std, expected):
    """Tracks that stand still within 0.3 m and three deviations, and others surely within 0.5 m.
    Planted bugs: speed not asked; deviations added for those that fly."""
    P = np.diag([std**2] * 3 + [0.09] * 3 + [9.0] * 3)
    track = Track(1, Gaussian(np.array([0.0, 30.0, height, *velocity, 0, 0, 0]), P), 10.0)
    assert StaticClutter(1.71, ground(), PERIOD).holds(track) is expected
    assert not StaticClutter(1.71, None, PERIOD).holds(track)
