"""Static echoes beside each other, by hand: a wall that shows other spots of itself in each frame,
UAVs that hover, one that flies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from isac_rt.extensions.city_receivers.static_clutter import MEMORY_S, StaticClutter
from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.receive.types import Detections
from isac_rt.track.filter import UNAMBIGUOUS, Ambiguity, Gaussian
from isac_rt.track.parts import Ownship, follow
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


INTERVAL = 0.05


def wall(frame: int, x: float = -9.0, y: float = 31.0) -> list[tuple[float, float, float]]:
    """Five spots of a wall 4 m apart, in each frame others, 2 m higher."""
    return [(x + 4 * k, y, 1.0 + k + 2 * frame) for k in range(5)]


def after(frames: int, static: StaticClutter, seen_at=lambda d: d, place=wall) -> StaticClutter:
    """What the frames of a wall have made of it."""
    for frame in range(frames):
        time = INTERVAL * frame
        static.update(seen_at(seen(time, place(frame))), own(time), time)
    return static


def test_a_wall_is_a_surface_and_who_flies_before_it_is_not():
    """Third frame of a wall, a UAV among its spots that closes at 2 m/s more than they do, and one
    that is static 60 m away. Planted bugs: the rate not held against the flight; a crowd
    anywhere."""
    time, static = 2 * INTERVAL, after(2, StaticClutter(1.71, None, PERIOD))
    d = seen(
        time,
        [*wall(2), (0.0, 28.0, 6.0), (10.0, 90.0, 5.0)],
        [(0, 0, 0)] * 5 + [(0, -2, 0), (0, 0, 0)],
    )
    assert static.update(d, own(time), time).tolist() == [True] * 5 + [False] * 2


@pytest.mark.parametrize("frames", [3, 20])
@pytest.mark.parametrize("speed", [0.0, 9.0])
def test_a_swarm_that_hovers_or_crosses_is_no_surface(frames, speed):
    """Six UAVs 4 m apart, found in three of four frames, that hover or fly across, so that they
    have the range rate of a wall: none is part of a surface in any frame. Planted bugs: spots
    counted that are found again; a spot kept where it was found first."""
    rng, static = np.random.default_rng(3), StaticClutter(1.71, None, PERIOD)
    for frame in range(frames):
        time = INTERVAL * frame
        places = np.array([(-10.0 + 4 * k + speed * time, 40.0, 5.0 + k) for k in range(6)])
        places += rng.normal(0, 0.1, (6, 3))
        found = np.arange(6) % 4 != frame % 4
        assert not static.update(seen(time, places[found]), own(time), time).any()


def test_a_wall_beyond_the_view_is_seen_elsewhere_and_is_static():
    """The same wall 25 m to the right and 8 m ahead, at u_x of 0.93 to 0.96: seen 1.71 to the left
    of it, where nothing at that rate would be static. Planted bug: the directions as they are
    seen."""

    def place(frame: int) -> list[tuple[float, float, float]]:
        return [(25.0 + 2 * k, 8.0 + k, 2.0 * frame) for k in range(5)]

    def aside(d: Detections) -> Detections:
        return Detections(**{**vars(d), "direction": d.direction - [1.71, 0.0]})

    time = 2 * INTERVAL
    last = aside(seen(time, place(2)))
    for turn, crowd in ((1.71, True), (np.inf, False)):
        static = after(2, StaticClutter(turn, None, PERIOD), aside, place)
        assert (static.update(last, own(time), time) == crowd).all()


def test_a_wall_along_the_wings_is_one_whatever_the_error():
    """The same wall 29 m to the right and 1 to 3 m ahead, at u_x of 0.995 and more, measured 0.015
    too far out with a deviation of 0.01: farther from the boresight than anything can be. With a
    deviation of 0.002 the direction is none, and nothing is static there. Planted bug: only
    directions inside the unit circle are tried."""

    def place(frame: int) -> list[tuple[float, float, float]]:
        return [(29.0 + 2 * k, 1.0 + k / 2, 2.0 * frame) for k in range(5)]

    for std, crowd in ((0.01, True), (0.002, False)):

        def aside(d: Detections, std: float = std) -> Detections:
            out = d.direction + np.array([0.015 - 1.71, 0.0])
            return Detections(**{**vars(d), "direction": out, "std": np.full((5, 4), std)})

        time, static = 2 * INTERVAL, after(2, StaticClutter(1.71, None, PERIOD), aside, place)
        assert (static.update(aside(seen(time, place(2))), own(time), time) == crowd).all()


def test_velocities_are_folded():
    def folded(d: Detections) -> Detections:
        return Detections(**{**vars(d), "velocity": d.velocity + PERIOD})

    time, static = 2 * INTERVAL, after(2, StaticClutter(1.71, None, PERIOD), folded)
    assert static.update(folded(seen(time, wall(2))), own(time), time).all()


def test_a_uav_that_hovers_alone_is_no_surface():
    """Thirty frames with errors of 0.3 m on each axis. Planted bug: echoes of one place count."""
    rng, static = np.random.default_rng(4), StaticClutter(1.71, None, PERIOD)
    for frame in range(30):
        place = np.array([2.0, 25.0, 6.0]) + rng.normal(0, 0.3, 3)
        time = INTERVAL * frame
        assert not static.update(seen(time, [place]), own(time), time).any()


def of_a_board(time, places, std=0.08) -> Detections:
    d = seen(time, places)
    return replace(d, std=np.tile([0.01, 0.01, 2e-3, std], (len(d), 1)))


def test_uavs_that_hover_are_no_surface_of_a_board():
    """Five of them 5 m apart, over thirty frames with errors in elevation of 2.4 m, the deviation
    that is stated. Planted bug: found again within a metre and a half alone."""
    places = np.array([(-8.0 + 4 * k, 28.0 + 3 * (k % 2), 4.0) for k in range(5)])
    rng, refused = np.random.default_rng(11), 0
    static = StaticClutter(1.71, None, PERIOD)
    for frame in range(30):
        time = INTERVAL * frame
        d = of_a_board(time, places + rng.normal(0, 1, (5, 1)) * [0, 0, 2.4])
        refused += static.update(d, own(time), time).sum()
    assert refused == 0


def test_a_surface_is_one_of_a_board_too():
    """Six spots anywhere on 20 m by 14 m of a wall in each frame: from the fourth on most are
    within it. Planted bug: found again within the elevation's deviation on every axis."""
    rng, static, found = np.random.default_rng(5), StaticClutter(np.inf, None, PERIOD), 0
    for frame in range(8):
        time, spots = INTERVAL * frame, rng.uniform([-9, 31, 0], [11, 31.01, 14], (6, 3))
        crowd = static.update(of_a_board(time, spots), own(time), time)
        found += int(crowd.sum()) if frame > 2 else 0
    assert found > 20


def test_nothing_is_confirmed_while_the_clutter_is_unknown():
    """A passive terminal's three frames that show a spot, and one that shows it or not with the
    clutter known; a track that was reported before stays. Planted bugs: none held back; the old one
    too; confirmed in a frame that does not show it."""
    sender = Gaussian(np.array([24.0, 12.0, 9.0, -2.0, 7.0, 1.0]), np.eye(6) * 1e-4)
    reference = Track(-2, Gaussian(np.append(sender.mean, [0, 0, 0]), np.eye(9) * 1e-4), 1e3)
    place = np.array([(3.0, 28.0, 5.0)])
    for last in (1, 0):
        static = StaticClutter(np.inf, None, PERIOD)
        tracker = Tracker(Tracking(initiation="unexplained"), Ambiguity(PERIOD))

        def frame(number: int, known: bool, shown: int = 1, static=static, tracker=tracker) -> bool:
            time, there = INTERVAL * number, place - sender.mean[:3]
            d = seen(time, place)
            out, e = np.linalg.norm(there), there / np.linalg.norm(there)
            d = replace(d, range=d.range + out, velocity=d.velocity - e @ sender.mean[3:])
            tracker.predict(time)
            about = Ownship(own(time), time, reference=reference, clutter_known=known)
            follow(tracker, [static], d.select(np.arange(shown)), about)
            return any(t.credible for t in tracker.tracks)

        assert [frame(k, False) for k in range(3)] == [False] * 3
        assert frame(3, True, last) is bool(last)
        assert frame(4, True) and frame(5, False)


def test_a_wall_is_remembered_for_a_while():
    """Long after, it is forgotten; kept by its memory it is not. Planted bugs: no memory; no end
    of it."""
    static, again = after(2, StaticClutter(1.71, None, PERIOD)), StaticClutter(1.71, None, PERIOD)
    again.restore(static.memory())
    late = INTERVAL + MEMORY_S + 0.01
    assert again.update(seen(2 * INTERVAL, wall(2)), own(2 * INTERVAL), 2 * INTERVAL).all()
    assert not static.update(seen(late, wall(2)), own(late), late).any()


def test_only_what_could_start_a_track_makes_a_surface():
    """What the city explains is no surface that it lacks."""

    def explained(d: Detections) -> Detections:
        return Detections(**{**vars(d), "starts": np.zeros(5, bool)})

    assert len(after(3, StaticClutter(1.71, None, PERIOD), explained).state.spots) == 0


@pytest.mark.parametrize(
    ("place", "velocity", "std", "expected"),
    [
        ((0.0, 30.0, 6.0), (0.2, -0.1, 0.0), 0.3, True),
        ((0.0, 30.0, 6.0), (0.2, -0.1, 0.0), 9.0, False),  # nothing is known of its motion
        ((0.0, 30.0, 6.0), (4.0, 0.0, 0.0), 0.3, False),
        ((0.0, 90.0, 6.0), (0.2, -0.1, 0.0), 0.3, False),
    ],
)
def test_a_track_that_is_static_within_a_surface(place, velocity, std, expected):
    """One that was found again and again is none. Planted bugs: the speed alone; the place alone;
    a track counts as found again though it was missed."""
    static = after(3, StaticClutter(1.71, None, PERIOD))
    P = np.diag([0.01] * 3 + [std**2] * 3 + [9.0] * 3)
    track = Track(1, Gaussian(np.array([*place, *velocity, 0, 0, 0]), P), 40.0)
    assert static.holds(track) is expected
    track.confirmed, track.age, track.recent = True, 5, [True] * 5
    assert not static.holds(track)
    track.recent = [True] * 4 + [False]
    assert static.holds(track) is expected


def test_a_wall_is_static_for_a_passive_terminal():
    """Path lengths and their rates by hand, of a transmitter that flies elsewhere to a terminal at
    `own`, over the places of a wall and over a UAV among them that flies off at 5 m/s: the spots
    lie at the wall, but for the UAV's. Planted bugs: places at the length of the whole path; the
    transmitter's own motion left out."""
    sender = np.array([24.0, 12.0, 9.0, -2.0, 7.0, 1.0])
    places = np.array([*wall(0), (0.0, 29.0, 6.0)])
    moving = np.array([(0.0, 0.0, 0.0)] * 5 + [(0.0, 5.0, 0.0)])
    back, there = places - own(0.0).position, places - sender[:3]
    far = np.linalg.norm(back, axis=1), np.linalg.norm(there, axis=1)
    rate = (back * (moving - FLIGHT)).sum(1) / far[0] + (there * (moving - sender[3:])).sum(
        1
    ) / far[1]
    d = seen(0.0, places)
    d = Detections(**{**vars(d), "range": far[0] + far[1], "velocity": rate})
    static = StaticClutter(np.inf, None, PERIOD)
    static.update(d, own(0.0), 0.0, sender)
    np.testing.assert_allclose(static.state.spots[:, :3], wall(0), atol=1e-9)


def test_a_young_track_that_an_echo_of_a_crowd_carries_on_is_none():
    """Of tracks that seem to fly, the new ones that such an echo carries on go, confirmed by it or
    not; those that were confirmed before, and those of another echo or of none, stay. Of the former
    one with gaps is doubted, for a tenth of the frames show an artefact. Planted bugs: all of the
    crowd go; only what is confirmed goes; all are doubted; what another echo carries on is."""

    def track(number: int, detection: int, confirmed: bool = True, gap: bool = False) -> Track:
        flies = Gaussian(np.array([0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.eye(9))
        of = {"recent": [True, not gap, True], "odds": 3.0, "detection": detection}
        return Track(number, flies, 9.0, confirmed=confirmed, **of)

    tracks = [track(1, 0), track(2, 0), track(3, 1), track(4, 0, confirmed=False), track(5, -1)]
    tracks += [track(6, 0, gap=True), track(7, 1, gap=True)]
    tracker = Tracker(Tracking(), UNAMBIGUOUS)
    tracker.state.tracks = tracks
    static_clutter = StaticClutter(1.71, None, PERIOD)
    static_clutter._crowd = np.array([True, False])
    static_clutter.prune(tracker, Ownship(own(0.0), 0.0, tentative=frozenset({1, 3, 4, 5})))
    odds = {t.id: t.odds for t in tracker.tracks}
    assert odds == pytest.approx({2: 3.0, 3: 3.0, 5: 3.0, 6: 3.0 - np.log(10), 7: 3.0})


def above(d: Detections, snr: list[float]) -> Detections:
    return Detections(**{**vars(d), "snr": np.array(snr)})


@pytest.mark.parametrize(("snr", "crowd"), [(390.0, True), (410.0, False)])
def test_a_uav_that_stands_out_of_a_wall_by_ten_decibels_is_none_of_it(snr, crowd):
    """Hovering before a wall's spots at 40; the wall stays one, and a track at the UAV's place is
    held to the same. Planted bugs: strength ignored; the wall's echoes spared too."""
    place, time = (0.0, 28.0, 6.0), 2 * INTERVAL
    static = after(2, StaticClutter(1.71, None, PERIOD))
    d = above(seen(time, [*wall(2), place]), [40.0] * 5 + [snr])
    assert static.update(d, own(time), time).tolist() == [True] * 5 + [crowd]
    state = Gaussian(np.array([*place, *np.zeros(6)]), np.diag([0.01] * 3 + [0.09] * 3 + [9.0] * 3))
    assert static.holds(Track(1, state, snr)) is crowd


@pytest.mark.parametrize(("snr", "crowd"), [(39.0, False), (41.0, True)])
def test_what_is_ten_decibels_over_a_uav_makes_no_surface_of_it(snr, crowd):
    """A UAV that hovers before a wall at 400. Planted bug: the strength of those beside it
    ignored."""

    def bright(d: Detections) -> Detections:
        return above(d, [400.0] * 5)

    time, static = 2 * INTERVAL, after(2, StaticClutter(1.71, None, PERIOD), bright)
    d = above(seen(time, [(0.0, 28.0, 6.0)]), [snr])
    assert static.update(d, own(time), time).tolist() == [crowd]


@pytest.mark.parametrize(("height", "crowd"), [(1.4, True), (1.6, False)])
def test_what_touches_the_mesh_does_not_stand_out(height, crowd):
    """A bright echo before a wall that the mesh lacks, over the ground that it has. Planted bug:
    the mesh not asked."""
    time, static = 2 * INTERVAL, after(2, StaticClutter(1.71, ground(), PERIOD))
    d = above(seen(time, [*wall(2), (0.0, 28.0, height)]), [40.0] * 5 + [4000.0])
    assert static.update(d, own(time), time).tolist() == [True] * 5 + [crowd]


def test_a_line_of_sight_is_no_echo():
    """Planted bug: a passive terminal's reference remembered."""
    static = StaticClutter(1.71, None, PERIOD)
    d = seen(0.0, wall(0))
    static.update(Detections(**{**vars(d), "is_reference": np.ones(5, bool)}), own(0.0), 0.0)
    assert len(static.state.spots) == 0


def ground() -> Walls:
    """A square of 50 m and more about the places of these tests, at height nothing."""
    corners = np.array([[-60.0, -9, 0], [60, -9, 0], [60, 90, 0], [-60, 90, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Walls(CityMesh("ground", corners, faces, np.zeros(2, np.int16), (), np.zeros(3)))


@pytest.mark.parametrize(
    ("height", "velocity", "std", "expected"),
    [
        (0.2, (0.2, -0.1, 0.0), 0.1, True),
        (0.2, (0.0, 9.0, 0.0), 0.1, True),
        (0.4, (0.0, 9.0, 0.0), 0.1, False),
        (0.2, (0.0, 9.0, 0.0), 0.3, False),
    ],
)
def test_no_uav_flies_in_a_face(height, velocity, std, expected):
    """Tracks that are surely within 0.5 m of one, at rest or not: a house's corner is found in each
    frame. Planted bugs: those at rest spared; deviations added."""
    P = np.diag([std**2] * 3 + [0.09] * 3 + [9.0] * 3)
    track = Track(1, Gaussian(np.array([0.0, 30.0, height, *velocity, 0, 0, 0]), P), 10.0)
    assert StaticClutter(1.71, ground(), PERIOD).holds(track) is expected
    assert not StaticClutter(1.71, None, PERIOD).holds(track)
