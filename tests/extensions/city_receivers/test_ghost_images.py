"""Ghosts in a street corner of two walls that each end sees differently: images by hand, at both
ends, and which doubts the test takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from isac_rt.extensions.city_receivers.ghosts import Leeway, Paths, echoes, reflections, suspicion
from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.track.filter import Ambiguity, Gaussian
from isac_rt.track.tracker import Track, track_set
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose

ORIGIN = np.array([-83.1, 210.7, 35.3])
EAST, NORTH = 14.2, 47.9
"""Planes x = EAST and y = NORTH in local coordinates, of walls that both begin at the corner."""
OWN = Pose(ORIGIN + np.array([2.1, -3.7, 1.9]), np.array([0.6, 5.1, -0.2]), np.zeros(3), np.eye(3))
HERE = np.concatenate([OWN.position - ORIGIN, OWN.velocity])
BODY = np.array([5.3, 28.7, 4.1, -1.3, -2.2, 0.4])
SENDER = np.array([-22.9, 12.3, 2.6, 0.9, -5.7, 0.3])
RESOLUTION = np.array([0.25, 0.249, 0.108, 0.108])
PERIOD = 28.6


def rectangle(axis: int, at: float, along: tuple[float, float], up: tuple[float, float]):
    """Corners of an upright wall in the plane where one horizontal axis is constant."""
    corners = np.zeros((4, 3))
    corners[:, axis], corners[:, 1 - axis] = at, np.repeat(along, 2)
    corners[:, 2] = [*up, *up[::-1]]
    return corners


def mesh(*walls) -> Walls:
    """Walls of two triangles each; they are listed (0, 1), (2, 3) and so on."""
    faces = np.concatenate(
        [[[4 * i, 4 * i + 1, 4 * i + 2], [4 * i, 4 * i + 2, 4 * i + 3]] for i in range(len(walls))]
    )
    return Walls(
        CityMesh(
            "corner",
            np.concatenate(walls),
            faces.astype(np.int32),
            np.zeros(len(faces), np.int16),
            (),
            ORIGIN.copy(),
        )
    )


def corner(east=(8.0, 40.0), north=(-25.0, 12.0)) -> Walls:
    return mesh(rectangle(0, EAST, east, (-9.0, 15.0)), rectangle(1, NORTH, north, (-9.0, 15.0)))


def image(body: np.ndarray, wall: str) -> np.ndarray:
    """Mirrored at a plane: one coordinate is twice the plane's less its own, its rate turns
    round."""
    axis, at = {"east": (0, EAST), "north": (1, NORTH)}[wall]
    out = body.copy()
    out[axis], out[3 + axis] = 2 * at - body[axis], -body[3 + axis]
    return out


def seen(places: dict, at: np.ndarray = HERE) -> dict:
    """Length, its rate and cosines of arrival of ways that are sums of straight pieces: pairs of
    ends, of which the last piece is the one that arrives."""
    out = {}
    for name, pieces in places.items():
        spans = [(b[:3] - a[:3], b[3:] - a[3:]) for a, b in pieces]
        length = sum(np.linalg.norm(d) for d, _ in spans)
        rate = sum(d @ v / np.linalg.norm(d) for d, v in spans)
        last = pieces[-1][1][:3] - at[:3]
        out[name] = [length, rate, *(last / np.linalg.norm(last))[[0, 2]]]
    return out


def shows(wall: str, end: np.ndarray, body: np.ndarray, along: tuple[float, float]) -> bool:
    """Whether a wall shows a body to an end: where the straight way to the image crosses the plane,
    by the share of the way, lies between the wall's edges, and both stand before it."""
    axis, at = {"east": (0, EAST), "north": (1, NORTH)}[wall]
    there = image(body, wall)
    share = (at - end[axis]) / (there[axis] - end[axis])
    point = end[:3] + share * (there[:3] - end[:3])
    before = end[axis] < at and body[axis] < at
    return bool(before and along[0] < point[1 - axis] < along[1] and -9 < point[2] < 15)


SPANS = {
    "both see both": ((-2.0, 40.0), (-25.0, 12.0)),
    "east by the receiver alone": ((10.0, 20.0), (-25.0, 12.0)),
    "east by the sender alone": ((22.0, 40.0), (-25.0, 12.0)),
    "north by the receiver alone": ((-2.0, 40.0), (2.0, 12.0)),
    "north by the sender alone": ((-2.0, 40.0), (-20.0, -2.0)),
    "east by one and north by the other": ((22.0, 40.0), (2.0, 12.0)),
    "north by one and east by the other": ((10.0, 20.0), (-20.0, -2.0)),
    "none": ((41.0, 60.0), (13.0, 30.0)),
}


@pytest.mark.parametrize("name", SPANS)
def test_reflections_are_the_images_that_each_end_sees(name):
    """Every pair of walls on the way to the body and on the way from it, where the first shows the
    body to the sender and the last to the receiver: length, rate and arrival of the broken way made
    straight, number of bounces, and the first wall's face. Planted bugs: images for the receiver
    taken at the sender's end, and the other way round; the way from the sender as if it began here;
    the last wall named; a wall between the two taken for a mirror."""
    spans = dict(zip(("east", "north"), SPANS[name], strict=True))
    first = [w for w in spans if shows(w, SENDER, BODY, spans[w])]
    last = [w for w in spans if shows(w, HERE, BODY, spans[w])]
    told = {
        "both see both": (2, 2),
        "east by the receiver alone": (1, 2),
        "east by the sender alone": (2, 1),
        "north by the receiver alone": (1, 2),
        "north by the sender alone": (2, 1),
        "east by one and north by the other": (1, 1),
        "north by one and east by the other": (1, 1),
        "none": (0, 0),
    }
    assert (len(first), len(last)) == told[name]  # the scenes are what they are called
    ways = {}
    for a in [None, *first]:
        for b in [None, *last]:
            if a or b:
                start, end = (BODY if w is None else image(BODY, w) for w in (a, b))
                ways[a, b] = [(SENDER, start), (HERE, end)]
    found = reflections(BODY - HERE, SENDER - HERE, OWN, corner(*SPANS[name]))
    assert len(found.faces) == len(ways)
    planes = {0: "east", 1: "east", 2: "north", 3: "north"}
    each = zip(found.faces, found.orders, found.measured, strict=True)
    rows = sorted((planes[f], o, *np.round(e, 9).tolist()) for f, o, e in each)
    truth = sorted(
        (a or b, (a is not None) + (b is not None), *np.round(z, 9).tolist())
        for (a, b), z in seen(ways).items()
    )
    assert [r[:2] for r in rows] == [t[:2] for t in truth]
    np.testing.assert_allclose([r[2:] for r in rows], [t[2:] for t in truth], rtol=0, atol=1e-8)


def test_the_sender_over_a_wall_is_one_way():
    """The line of sight from the sender over each wall that shows it to the receiver."""
    spans = ((-2.0, 40.0), (-25.0, 12.0))
    found = reflections(SENDER - HERE, None, OWN, corner(*spans))
    ways = {w: [(HERE, image(SENDER, w))] for w in ("east", "north")}
    assert all(shows(w, HERE, SENDER, s) for w, s in zip(ways, spans, strict=True))
    assert found.orders.tolist() == [1, 1]
    np.testing.assert_allclose(found.measured, list(seen(ways).values()), rtol=0, atol=1e-10)


def test_an_active_terminal_sees_two_echoes_in_each_wall():
    """Over a wall on one way: mean of the body and of its image, out to the one and in from the
    other; on both ways: the image's. Planted bugs: the image's range on one way; both ends one."""
    found = echoes(BODY - HERE, OWN, corner())
    ways = {"body": [(HERE, BODY)]} | {w: [(HERE, image(BODY, w))] for w in ("east", "north")}
    at = {name: np.array(z) for name, z in seen(ways).items()}
    truth = []
    for wall in ("east", "north"):
        mirrored, both = at[wall], [at["body"][2:], at[wall][2:]]
        truth += [(1, *(at["body"] + mirrored) / 2, *np.ravel(both))]
        truth += [(2, *mirrored, *mirrored[2:], *mirrored[2:])]
    each = zip(found.orders, found.measured, found.ends, strict=True)
    rows = sorted((o, *z, *ends.ravel()) for o, z, ends in each)
    np.testing.assert_allclose(rows, sorted(truth), rtol=0, atol=1e-8)


@pytest.mark.parametrize("sender", [BODY * 0, SENDER - HERE, None], ids=["own", "other", "alone"])
def test_what_walls_show_is_as_uncertain_as_its_source(sender):
    """Slopes by differences over 2 mm and 2 mm/s (1e-6: third derivatives over the step, and the
    rounding of lengths), at both kinds of terminal; an error of all axes at once moves it as far as
    it moves. Planted bugs: motion not mirrored; the way to the body left out; one range for the
    mean; axes taken for independent."""

    def shown(state: np.ndarray) -> Paths:
        if sender is not None and not sender.any():
            return echoes(state, OWN, corner())
        return reflections(state, sender, OWN, corner())

    found = shown(BODY - HERE)
    assert found.faces.size >= 2
    for axis, step in enumerate(1e-3 * np.eye(6)):
        slope = (shown(BODY - HERE + step).measured - shown(BODY - HERE - step).measured) / 2e-3
        np.testing.assert_allclose(found.slopes[..., axis], slope, rtol=0, atol=1e-6)
    way = 1e-3 * np.array([0.3, -0.8, 0.5, 0.9, 0.2, -0.6])  # errors that are one: correlated
    off = (shown(BODY - HERE + way).measured - shown(BODY - HERE - way).measured) / 2
    np.testing.assert_allclose(found.std(np.outer(way, way)), np.abs(off), rtol=0, atol=1e-8)


def test_a_wall_between_two_is_no_mirror():
    """The end before the wall, the body behind it; where it is half a metre behind, the line to its
    image goes on to the wall. Planted bug: either side taken."""
    close = BODY.copy()
    close[0] = EAST + 0.5
    for behind in (image(BODY, "east"), close):
        assert not echoes(behind - HERE, OWN, corner(north=(-25.0, -20.0))).faces.size


def test_what_is_a_mirror():
    """A wall of two triangles of 0.98 m^2 together is none, of 1.02 m^2 it is, and so are two of
    0.88 and 0.96 m^2 in one plane, between which nothing reflects; the face that is named is the
    plane's largest. Planted bugs: the largest face's area asked; any wall
    taken; the plane endless; another plane behind taken for this one."""
    small = mesh(rectangle(0, EAST, (8.0, 8.49), (-1.0, 1.0)))
    assert small.mirrors[0].size == 0
    enough = mesh(rectangle(0, EAST, (8.0, 8.51), (-1.0, 1.0)))
    assert enough.mirrors[0].size == 1
    apart = [rectangle(0, EAST, y, (2.6, 2.76)) for y in ((5.0, 10.5), (17.0, 23.0))]
    assert mesh(*apart).mirrors[0].size == 1
    parts = [rectangle(0, EAST, y, (2.6, 3.8)) for y in ((5.0, 10.5), (17.0, 23.5))]
    two = mesh(*parts)
    faces, normals, offsets = two.mirrors
    assert faces.tolist() in ([2], [3])  # of 7.8 m^2, not of 6.6
    assert np.abs(normals[0]) == pytest.approx([1, 0, 0], abs=1e-12)
    assert offsets[0] * normals[0, 0] == pytest.approx(EAST + ORIGIN[0])
    deep = mesh(
        rectangle(0, EAST, (3.0, 10.5), (1.0, 4.0)),
        rectangle(0, EAST + 0.5, (17.0, 24.0), (1.0, 4.0)),
    )
    assert deep.mirrors[0].size == 2
    shown = set()
    for place in (33.7, 28.7, 20.1, 12.0, 9.5):
        body = np.array([5.3, place, 4.1, 0, 0, 0])
        # the mirror point by similar triangles, from 12.1 m and 8.9 m before the plane
        y, further = (HERE[1] + (place - HERE[1]) * (12.1 + d) / (21 + 2 * d) for d in (0.0, 0.5))
        of_two = 5 < y < 10.5 or 17 < y < 23.5
        assert bool(echoes(body - HERE, OWN, two).faces.size) is bool(of_two)
        count = bool(3 < y < 10.5) + bool(17 < further < 24)
        assert echoes(body - HERE, OWN, deep).faces.size == 2 * count
        shown.add((bool(of_two), count))
    assert shown >= {(True, 1), (False, 0)}


def track(number: int, state: np.ndarray, spread=(4e-4, 1e-2), confirmed=True) -> Track:
    P = np.diag([spread[0]] * 3 + [spread[1]] * 3)
    where = np.concatenate([state[:3] + ORIGIN, state[3:]])
    return Track(number, Gaussian(where, P), 50.0, confirmed=confirmed)


def asked(tracks, walls=None, reference=None):
    return suspicion(
        track_set(tracks, OWN, reference),
        OWN,
        walls or corner(north=(13.0, 30.0)),
        Leeway(RESOLUTION, Ambiguity(PERIOD)),
    )


def before_the_wall(z: np.ndarray) -> np.ndarray:
    """A state with what is measured of it: on its ray, moving along it."""
    e = np.array([z[2], np.sqrt(1 - z[2] ** 2 - z[3] ** 2), z[3]])
    return np.concatenate([HERE[:3] + z[0] * e, HERE[3:] + z[1] * e])


def half_echo() -> np.ndarray:
    """The echo over the east wall on one way, from the body's own direction."""
    at = {
        n: np.array(z)
        for n, z in seen({"b": [(HERE, BODY)], "i": [(HERE, image(BODY, "east"))]}).items()
    }
    return np.array([*((at["b"] + at["i"]) / 2)[:2], *at["b"][2:]])


def test_who_can_explain_a_ghost():
    """A confirmed track in sight that is nearer, and the first of two; not a tentative one, not one
    that hides behind a wall itself, not one that is farther, and a PT's reference is never a ghost.
    Planted bugs: each of these conditions left out; the row reported for the number."""
    ghost = track(9, before_the_wall(half_echo()))
    assert asked([track(4, BODY), ghost]).source.tolist() == [-1, 4]
    assert asked([ghost, track(4, BODY)]).source.tolist() == [4, -1]
    assert asked([track(4, BODY, confirmed=False), ghost]).source.tolist() == [-1, -1]
    assert asked([track(4, BODY), track(5, BODY + 0.01), ghost]).source.tolist() == [-1, -1, 4]
    # behind a wall that only shades the body: then it explains nothing
    shade = rectangle(1, 20.0, (2.0, 6.0), (-9.0, 15.0))
    walls = mesh(rectangle(0, EAST, (8.0, 40.0), (-9.0, 15.0)), shade)
    found = asked([track(4, BODY), ghost], walls)
    assert found.behind[0] >= 0 and found.source.tolist() == [-1, -1]
    # two bodies at the same rays in a wall to the north: the farther one explains no nearer one
    near = track(4, BODY - [0, 6.0, 0, 0, 0, 0])
    far = track(5, BODY)
    assert asked([far, near]).source.tolist() == [-1, -1]


def test_a_ghost_is_farther_than_its_source():
    """Doubts of 2 m on both: an echo 1.1 m beyond its source is explained by it, and the source not
    by the echo, whose own echoes lie within the doubts as well. Planted bug: either may explain."""
    place = np.array([EAST - 1.2, 24.0, 4.1, 0.0, 0.0, 0.0])
    wide = (4.0, 4.0)
    other = before_the_wall(
        np.array(seen({"i": [(HERE, image(place, "east"))]})["i"]) - [0, 0, 0.04, 0]
    )
    found = asked([track(4, place, wide), track(5, other, wide)])
    assert found.source.tolist() == [-1, 4]


@pytest.mark.parametrize("share", [0.5, 4.0])
def test_two_waves_in_phase_are_four_times_as_strong_as_one(share):
    """The echo over the wall on one way beside its body at 50 over the noise, on one antenna: about
    four times what a wave over one segment has that is longer by twice its range less the direct
    one. By so much more, by both aspects' 3.74 dB, it is that echo less probably. Planted bugs: one
    wave; the power not asked."""
    echo = track(9, before_the_wall(half_echo()))
    direct, over = np.linalg.norm(BODY[:3] - HERE[:3]), half_echo()[0]
    expected = 4 * 50.0 * (direct / (2 * over - direct)) ** 2
    weak, strong = (
        asked([track(4, BODY), replace(echo, snr=part * expected)]).ratio[1]
        for part in (1e-3, share)
    )
    tail = norm.cdf(-10 * np.log10(share) / (np.sqrt(2) * 3.74))
    assert strong == pytest.approx(weak / tail, rel=1e-3)


@pytest.mark.parametrize("component", range(4))
def test_how_far_off_an_echo_may_be(component):
    """Three deviations of both tracks together, the source's one and a half times, and half a
    resolution: of an echo over the wall on one way in range and rate, in direction of one on both
    ways; a whole period of velocity is no difference. Planted bugs: the source's deviation left
    out; deviations added; no resolution; velocities not folded."""
    source, spread = track(4, BODY, (0.01, 0.04)), (0.02, 0.09)
    z, shown = half_echo(), source
    if component >= 2:
        mirrored = image(BODY, "east")
        z, shown = np.array(seen({"i": [(HERE, mirrored)]})["i"]), track(4, mirrored, (0.01, 0.04))
    for periods in (0, 1) if component == 1 else (0,):
        answers = []
        for share in (0.97, 1.03):
            moved, limit = z.copy(), None
            for _ in range(3):  # the deviations move a little with the place
                trial = track(9, before_the_wall(moved), spread)
                both = track_set([shown, trial], OWN)
                limit = 3 * np.hypot(1.5 * both.std[0], both.std[1])[component]
                limit += 0.5 * RESOLUTION[component]
                moved = z.copy()
                moved[component] += share * limit
            moved[1] += periods * PERIOD
            answers.append(
                asked([source, track(9, before_the_wall(moved), spread)]).mirrored[1] >= 0
            )
        assert answers == [True, False]


def test_how_far_behind_a_wall_a_place_must_be():
    """Three deviations along the wall's normal and half a range resolution; doubt along the wall
    does not count. Planted bugs: the trace for the normal's variance; the resolution left out; the
    origin left out."""
    P = np.diag([0.04, 25.0, 25.0, 1, 1, 1])
    limit = 3 * 0.2 + 0.125
    for depth, suspect in ((0.97 * limit, False), (1.03 * limit, True)):
        place = np.array([EAST + depth + ORIGIN[0], 24.0 + ORIGIN[1], 4.0 + ORIGIN[2], 0, 0, 0])
        found = asked([Track(3, Gaussian(place, P), 50.0, confirmed=True)])
        assert bool(found.suspect[0]) is suspect


def test_a_reference_is_no_ghost_and_sees_for_itself():
    """Behind the wall's plane a PT's reference is not suspected; a reflector that stands before the
    wall for the receiver and behind it for that sender is. Planted bugs: the reference suspected;
    the sender's place taken for an offset."""
    sender = np.array([EAST + 9.0, 20.0, 3.0, 0, 0, 0])
    found = asked([track(3, BODY)], reference=track(1, sender))
    assert found.suspect.tolist() == [False, True] and found.mirrored.tolist() == [-1, -1]
    found = asked([track(3, BODY)], reference=track(1, SENDER))
    assert not found.suspect.any()
    # the reference where its own reflector's echo would be: it is not asked about
    echo = reflections(BODY - HERE, SENDER - HERE, OWN, corner(north=(13.0, 30.0))).measured[0]
    wide = track(1, SENDER, (400.0, 400.0))
    assert echo[0] > 0
    assert asked([track(3, BODY)], reference=wide).mirrored[0] == -1
