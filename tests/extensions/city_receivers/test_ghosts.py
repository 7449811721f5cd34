"""The geometric ghost test: echoes over walls against shortest ways, places behind walls against
trimesh, tracks by what explains them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import trimesh
from scipy import special

from isac_rt.extensions.city_receivers.ghosts import (
    Ghosts,
    Leeway,
    echoes,
    reflections,
    suspicion,
)
from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.track import existence
from isac_rt.track.filter import Ambiguity, Gaussian
from isac_rt.track.parts import Ownship, ReportedUav
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Track, Tracker, TrackSet, track_set
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose
from reproduce.ghosts import explained_tracks, run, verdicts, whole_tracks

ORIGIN = np.array([310.7, -120.3, 41.9])
RESOLUTION = np.array([0.25, 0.249, 0.108, 0.108])
PERIOD = 28.6
WALL_X = 11.3
"""The wall's plane x = 11.3 m in local coordinates; it stands from y = 2 to 40 and z = -6 to 13."""
OWN = Pose(ORIGIN + np.array([1.7, -3.1, 4.2]), np.array([0.6, 5.1, -0.2]), np.zeros(3), np.eye(3))
BODY = np.array([4.6, 24.7, 6.9, -1.3, -2.2, 0.4])
"""Local position and velocity of a body before the wall."""


def wall() -> CityMesh:
    corners = np.array(
        [[WALL_X, 2.0, -6.0], [WALL_X, 40.0, -6.0], [WALL_X, 40.0, 13.0], [WALL_X, 2.0, 13.0]]
    )
    return CityMesh(
        "wall",
        corners,
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.zeros(2, np.int16),
        (),
        ORIGIN.copy(),
    )


TURNED = np.array([-1, 1, 1])
"""What the wall makes of a velocity."""


def image_of(place: np.ndarray) -> np.ndarray:
    """The image of a local place in the wall."""
    return place * TURNED + [2 * WALL_X, 0, 0]


def track(number: int, place: np.ndarray, velocity: np.ndarray) -> Track:
    """A confirmed track at a local place, known to a few centimetres and decimetres per second."""
    state = Gaussian(np.concatenate([place + ORIGIN, velocity]), np.diag([4e-4] * 3 + [1e-2] * 3))
    return Track(number, state, 50.0, confirmed=True)


def length(start: np.ndarray, end: np.ndarray, over_wall: bool) -> float:
    """Way between two points, local; over the wall by least time: the shortest of all ways that
    touch its plane, found numerically."""
    if not over_wall:
        return float(np.linalg.norm(end - start))
    from scipy.optimize import minimize

    def way(yz: np.ndarray) -> float:
        touch = np.array([WALL_X, *yz])
        return float(np.linalg.norm(touch - start) + np.linalg.norm(end - touch))

    return float(
        minimize(
            way,
            (start[1:] + end[1:]) / 2,
            method="Nelder-Mead",
            options={"xatol": 1e-9, "fatol": 1e-13, "maxiter": 4000},
        ).fun
    )


def square() -> Leeway:
    """Of 16 receivers in four rows, and three transmitters that make eight of them."""
    w = Waveform()
    half = w.wavelength / 2
    rx = [(x * half, z * half) for x in range(4) for z in range(4)]
    board = Antennas.placed([(0, 0), (4 * half, 0), (0, 4 * half)], rx)
    return replace(Leeway.of(w, board, 2), resolution=RESOLUTION, ambiguity=Ambiguity(PERIOD))


def test_echoes_over_a_wall_are_the_shortest_ways_that_touch_it():
    """Range and rate of orders 1 and 2 against ways found by minimising their length (1e-8 m: the
    minimiser's), rates by differences over 1 ms (1e-3 m/s: curvature and minimiser over the step).
    Planted bugs: the image's velocity not mirrored; the origin left out of the plane."""
    state = BODY - np.concatenate([OWN.position - ORIGIN, OWN.velocity])
    found = echoes(state, OWN, Walls(wall()))
    assert found.orders.tolist() == [1, 2]
    h = 1e-3

    def ranges(t: float) -> dict[int, float]:
        own, body = OWN.position - ORIGIN + t * OWN.velocity, BODY[:3] + t * BODY[3:]
        over, straight = length(own, body, True), length(own, body, False)
        return {1: (over + straight) / 2, 2: over}

    now, before, after = ranges(0.0), ranges(-h), ranges(h)
    for order, echo in zip(found.orders, found.measured, strict=True):
        assert echo[0] == pytest.approx(now[order], abs=1e-8)
        assert echo[1] == pytest.approx((after[order] - before[order]) / (2 * h), abs=1e-3)


def test_no_echo_where_the_wall_ends_or_stands_between():
    """The mirror point of a body at y = -20 lies at y < 2, off the wall; a body behind the wall has
    no echo over it. Planted bug: the plane taken for endless."""
    own = np.concatenate([OWN.position - ORIGIN, OWN.velocity])
    for place in ([4.6, -20.0, 6.9, 0, 0, 0], [15.0, 24.7, 6.9, 0, 0, 0]):
        assert not echoes(np.array(place) - own, OWN, Walls(wall())).faces.size


def test_blocked_segments_are_those_of_trimesh():
    """300 random segments against trimesh's ray caster. Planted bug: the segment taken for an
    endless ray."""
    city, rng = wall(), np.random.default_rng(7)
    mesh = trimesh.Trimesh(city.vertices, city.faces, process=False)
    starts, ends = rng.uniform([-5, -10, -10], [20, 50, 20], (2, 300, 3))
    for a, b in zip(starts, ends, strict=True):
        places, _, _ = mesh.ray.intersects_location([a], [b - a])
        expected = any(np.linalg.norm(p - a) < np.linalg.norm(b - a) for p in places)
        assert bool(Walls(city).blocking(a + ORIGIN, b + ORIGIN).size) is expected


def test_ghosts_are_suspected_and_bodies_are_not():
    """A body, its image behind the wall, an echo over one way seen in the body's own direction (so
    before the wall), and another body of the same range and rate as that echo but where the array
    receives nothing of it.
    Planted bugs: the response of the array left out; only the image looked for."""
    body, own = BODY[:3], OWN.position - ORIGIN
    image = image_of(body)
    image_velocity = BODY[3:] * TURNED
    mean = (np.linalg.norm(body - own) + np.linalg.norm(image - own)) / 2
    ahead = (body - own) / np.linalg.norm(body - own)
    half = own + mean * ahead
    rates = [
        float((p - own) / np.linalg.norm(p - own) @ (v - OWN.velocity))
        for p, v in ((body, BODY[3:]), (image, image_velocity))
    ]
    half_velocity = OWN.velocity + ahead * np.mean(rates)
    ends = np.array([[(p - own)[[0, 2]] / np.linalg.norm(p - own) for p in (body, image)]])
    grid = np.stack([np.linspace(-0.7, -0.5, 99), np.zeros(99)], axis=1)
    u = grid[square().waves(grid, ends)[0][:, 0].argmin(), 0]
    aside = np.array([u, np.sqrt(1 - u**2), 0.0])
    beside, beside_velocity = own + mean * aside, OWN.velocity + aside * np.mean(rates)
    tracks = [
        track(3, body, BODY[3:]),
        track(5, image, image_velocity),
        track(6, half, half_velocity),
        track(8, beside, beside_velocity),
    ]
    found = suspicion(track_set(tracks, OWN), OWN, Walls(wall()), square())
    assert found.suspect.tolist() == [False, True, True, False]
    assert found.order.tolist() == [0, 2, 1, 0] and found.source.tolist() == [-1, 3, 3, -1]
    assert (found.behind >= 0).tolist() == [False, True, False, False]
    assert not suspicion(track_set(tracks[2:], OWN), OWN, Walls(wall()), square()).suspect.any()


@pytest.mark.parametrize("share", [0.7, 3.0, 30.0, 50.0])
def test_an_echo_over_a_wall_is_weaker_than_its_source(share):
    """The image of a UAV at 50 over the noise is about as bright as a wave over one segment that is
    longer by twice its range less the direct one, but for what both aspects return: two draws of
    3.74 dB (TR 38.901). An image as bright or brighter is that echo by the tail of a normal, and
    beyond three deviations it is not, though another terminal reports the UAV, whose power it does
    not tell. Planted bugs: the power not asked; the fourth power of the direct segment; one draw;
    reports of UAVs that are tracked."""
    body, own = BODY[:3], OWN.position - ORIGIN
    image = image_of(body)
    near, far = (float(np.linalg.norm(p - own)) for p in (body, image))
    seen = track(5, image, BODY[3:] * TURNED)
    at = Gaussian(np.concatenate([body + ORIGIN, BODY[3:]]), np.eye(6) * 1e-4)
    told = track_set([Track.of_state(at)], OWN)

    def ratio(share: float, reported: TrackSet | None) -> float:
        one = replace(seen, snr=share * 50.0 * (near / (2 * far - near)) ** 2)
        tracks = track_set([track(3, body, BODY[3:]), one], OWN)
        leeway, nobody = Leeway(RESOLUTION, Ambiguity(PERIOD)), np.zeros(2, bool)
        return float(suspicion(tracks, OWN, Walls(wall()), leeway, reported, nobody).ratio[1])

    tail = 1 - special.ndtr(10 * np.log10(share) / (np.sqrt(2) * 3.74))
    weak = ratio(1e-3, None)
    expected = weak / tail if share < 10 ** (3 * np.sqrt(2) * 0.374) else np.inf
    for reported in (None, told):
        assert ratio(share, reported) == pytest.approx(expected, rel=1e-3)


def test_bodies_that_others_know_of_explain_echoes():
    """The body is masked: its image alone is tracked, and another terminal says where the body is.
    Told 2 m of doubt it explains nothing, and a track of the body is no echo of it though one more
    body is told beside it. Planted bugs: any told body counts; the body's own track among the
    suspected."""
    image = track(5, image_of(BODY[:3]), BODY[3:] * TURNED)
    tracks = track_set([image], OWN)
    nobody = np.zeros(1, bool)
    for spread, expected in ((1e-3, 2), (4.0, 0)):
        body = Gaussian(np.concatenate([BODY[:3] + ORIGIN, BODY[3:]]), np.eye(6) * spread)
        reported = track_set([Track.of_state(body)], OWN)
        leeway = Leeway(RESOLUTION, Ambiguity(PERIOD))
        found = suspicion(tracks, OWN, Walls(wall()), leeway, reported, nobody)
        assert found.order.tolist() == [expected] and found.source.tolist() == [-1]
    beside = track(8, BODY[:3] + np.array([0.03, 0.2, 0.05]), BODY[3:])
    sure = track_set([Track.of_state(Gaussian(body.mean, np.eye(6) * 1e-3))], OWN)
    wide = Leeway(RESOLUTION * 40, Ambiguity(PERIOD))
    assert not suspicion(track_set([beside], OWN), OWN, Walls(wall()), wide, sure, nobody).suspect


@pytest.mark.parametrize("period", [0.7, np.inf])
def test_a_target_may_be_anywhere(period):
    """The image alone is tracked, and its body told: nothing else is near, so that one target in
    all ranges up to it, rates and directions of the array is held against the echo, by hand.
    Planted bugs: none anywhere; directions beyond the array's; the body itself a target there."""
    place = np.array([WALL_X - 0.3, *BODY[1:3]])
    image = track(5, image_of(place), BODY[3:] * TURNED)
    tracks = track_set([image], OWN)
    body = Gaussian(np.concatenate([place + ORIGIN, BODY[3:]]), np.diag([0.04] * 3 + [0.01] * 3))
    told = track_set([Track.of_state(body)], OWN)
    leeway = Leeway(RESOLUTION, Ambiguity(PERIOD), period)
    found = suspicion(tracks, OWN, Walls(wall()), leeway, told, np.zeros(1, bool))
    std, pull = np.hypot(1.5 * told.std[0], tracks.std[0]), RESOLUTION / 2
    of_echo = (special.erf(pull / std / np.sqrt(2)) / (2 * pull)).prod()
    anywhere = 1 / (tracks.range[0] * PERIOD * min(2.0, period) ** 2)
    assert found.ratio[0] == pytest.approx(anywhere / (0.3 * of_echo), rel=0.02)


GROUND = CityMesh(
    "ground",
    np.array([[-90.0, -90.0, 0.0], [90.0, -90.0, 0.0], [90.0, 90.0, 0.0], [-90.0, 90.0, 0.0]]),
    np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    np.zeros(2, np.int16),
    (),
    ORIGIN.copy(),
)


LEVEL = np.array([4.6, 24.7, 4.2, -1.3, -2.2, 0.4])
"""A body at the terminal's height."""


def over_the_ground(climb: float) -> Track:
    """Track of the level body's echo over the ground on one way, if it climbs by more [m/s], in the
    middle of both directions: path length and rate by hand."""
    own, below = OWN.position - ORIGIN, np.array([1, 1, -1])
    velocity = LEVEL[3:] + np.array([0.0, 0.0, climb])
    e, rates, ranges = [], [], []
    for place, v in (
        (LEVEL[:3], velocity),
        (LEVEL[:3] * below, velocity * below),
    ):
        ranges.append(float(np.linalg.norm(place - own)))
        e.append((place - own) / ranges[-1])
        rates.append(float(e[-1] @ (v - OWN.velocity)))
    ahead = e[0] + e[1]
    ahead /= np.linalg.norm(ahead)
    return track(6, own + np.mean(ranges) * ahead, OWN.velocity + ahead * np.mean(rates))


@pytest.mark.parametrize(("climb", "std", "expected"), [(0, 0.1, 1), (5, 0.1, 0), (5, 2.0, 1)])
def test_what_the_ground_shows_is_as_uncertain_as_the_climb(climb, std, expected):
    """An array of few rows knows a UAV's climb to metres a second, and its range rate to a
    decimetre: the ground's rate is off by what the climb is. Planted bug: the deviation of the
    direct echo's rate."""
    body = track(3, LEVEL[:3], LEVEL[3:])
    body.state.covariance[5, 5] = std**2
    flat = np.array([0.25, 0.249, 0.25, 1.0])
    tracks = track_set([body, over_the_ground(climb)], OWN)
    nobody = np.zeros(2, bool)
    leeway = Leeway(flat, Ambiguity(PERIOD))
    found = suspicion(tracks, OWN, Walls(GROUND), leeway, asked=nobody)
    assert found.order.tolist() == [0, expected]


def seen_at(u: np.ndarray) -> Track:
    """Track of the level body's echo over the ground on one way as if it came from direction
    cosines `u`."""
    z = track_set([over_the_ground(0.0)], OWN)
    e = np.array([u[0], np.sqrt(1 - u @ u), u[1]])
    still = OWN.velocity + z.velocity * e
    return track(6, OWN.position - ORIGIN + z.range * e, still)


def test_what_a_board_makes_of_two_waves_is_their_echo():
    """The body's echo over the ground, out from one of two directions and in from the other, as
    sums over the channels one by one. Where those add up to a maximum it is explained, sidelobes of
    a quarter too; where they cancel each other it is not. Planted bugs: both ways from one
    direction; transmitters and receivers exchanged for one wave; amplitude for power."""
    body, board = track(3, LEVEL[:3], LEVEL[3:]), square()
    here, below = OWN.position - ORIGIN, np.array([1, 1, -1])
    ends = [(p - here) / np.linalg.norm(p - here) for p in (LEVEL[:3], LEVEL[:3] * below)]
    (out, back), wave = [e[[0, 2]] for e in ends], np.zeros((3, 16), complex)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.7, 0.7, 41)] * 2), axis=-1).reshape(-1, 2)
    received = np.zeros(len(grid), complex)
    for t, tx in enumerate(board.tx):
        for r, rx in enumerate(board.rx):
            for first, last in ((out, back), (back, out)):
                wave[t, r] += np.exp(2j * np.pi * (tx @ first + rx @ last))
            received += wave[t, r] * np.exp(-2j * np.pi * grid @ (tx + rx)) / 48
    power = np.abs(received) ** 2
    found = board.waves(grid, np.array([[out, back]]))[0][:, 0]
    assert found == pytest.approx(power, abs=1e-9)

    def order(u: np.ndarray) -> int:
        tracks = track_set([body, seen_at(u)], OWN)
        return int(suspicion(tracks, OWN, Walls(GROUND), board, asked=np.zeros(2, bool)).order[1])

    assert order(grid[power.argmax()]) == 1
    assert order(grid[np.abs(power - power.max() / 4).argmin()]) == 1
    assert order(grid[power.argmin()]) == 0


@pytest.mark.parametrize("u", [(0.15, -0.1), (0.1, 0.35)])
def test_what_two_waves_may_be_besides(u):
    """The likelihoods of the echo over the ground on one way where the array sees it, too weak to
    tell by its power, by hand: targets are measured as ever, and spread over the directions as
    they are, whatever the array makes of two waves. Planted bug: targets as wide as the echo."""
    body, board = track(3, LEVEL[:3], LEVEL[3:]), square()
    seen = replace(seen_at(np.array(u)), snr=1e-4)
    tracks = track_set([body, seen], OWN)
    here, below = OWN.position - ORIGIN, np.array([1, 1, -1])
    ends = [(p - here) / np.linalg.norm(p - here) for p in (LEVEL[:3], LEVEL[:3] * below)]
    beam = board.waves(np.array(u), np.array([[e[[0, 2]] for e in ends]]))[1][0]
    found = suspicion(tracks, OWN, Walls(GROUND), board, asked=np.zeros(2, bool))
    assert found.order[1] == 1
    pull, state = RESOLUTION / 2, body.state.mean[:6] - np.append(OWN.position, OWN.velocity)
    shown = echoes(state, OWN, Walls(GROUND))
    std = np.maximum(tracks.std[0], 1.5 * shown.std(body.state.covariance[:6, :6])[0])
    std = np.hypot(std, tracks.std[1])
    of_echo = (special.erf(pull / std / np.sqrt(2)) / (2 * pull))[:2].prod() / (2 * beam) ** 2
    blurred = np.sqrt(np.array([3, 1, 0.1, 0.1]) ** 2 + tracks.std[1] ** 2 + pull**2 / 3)
    d2 = (((tracks.measured[1] - tracks.measured[0]) / blurred) ** 2).sum()
    of_target = np.exp(-d2 / 2) / (np.sqrt(2 * np.pi) * blurred).prod()
    of_target += 1 / (tracks.range.max() * PERIOD * 4)
    assert found.ratio[1] == pytest.approx(of_target / (0.3 * of_echo), rel=0.02)


@pytest.mark.parametrize("spacing", [0.5, 0.8])
@pytest.mark.parametrize("end", [(0.52, 0.41), (0.14, -0.26)])
def test_detections_are_somewhere(spacing, end):
    """Squares of twice their side over a period of both cosines: the density of what two waves are
    detected at adds up to 1, whether these come from far apart or nearly from one direction.
    Numerically, as of a sum of harmonics. Planted bugs: a mean power of 2; a period of 2."""
    w = Waveform()
    rx = [
        (x * spacing * w.wavelength, z * spacing * w.wavelength) for x in range(4) for z in (0, 1)
    ]
    board = Leeway.of(w, Antennas.placed([(0, 0), (4 * rx[2][0], 0)], rx), 2)
    u = np.arange(64) / 64 / spacing
    grid = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    side = 2 * board.waves(grid, np.array([[(0.13, -0.3), end]]))[1][:, 0]
    assert (1 / side**2).mean() / spacing**2 == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(("age", "expected"), [(0, True), (8, False)])
def test_a_track_averages_what_pulls_it(age, expected):
    """The image 0.19 m too far, where half a cell is 0.125 m and three deviations 0.11 m: the pull
    of one frame, not the mean of nine. Planted bugs: the age left out; deviations averaged too."""
    body = BODY[:3]
    image = image_of(body)
    own = OWN.position - ORIGIN
    far = image + 0.19 * (image - own) / np.linalg.norm(image - own)
    seen = track(5, far, BODY[3:] * TURNED)
    seen.age = age
    tracks = track_set([track(3, body, BODY[3:]), seen], OWN)
    leeway = Leeway(RESOLUTION, Ambiguity(PERIOD))
    found = suspicion(tracks, OWN, Walls(wall()), leeway, asked=np.zeros(2, bool))
    assert (found.mirrored[1] >= 0) == expected


def as_strong(tracks: TrackSet) -> float:
    """Probability that the second track is an echo of the first by its power, by hand."""
    near, far = tracks.range[:2]
    brighter = tracks.snr[1] / tracks.snr[0] * ((2 * far - near) / near) ** 2
    return float(special.ndtr(-10 * np.log10(brighter) / (np.sqrt(2) * 3.74)))


def row_of_sixteen() -> Leeway:
    w = Waveform()
    row = Antennas.placed([(0.0, 0.0)], [(k * w.wavelength / 4, 0.0) for k in range(16)])
    return Leeway.of(w, row, 2)


@pytest.mark.parametrize("board", [False, True])
def test_a_target_among_others_is_likelier_than_an_echo(board):
    """The density of targets where an image of the body is seen, over that of the echo's measures,
    by hand: of the body and of a target 2 m before the image, both as blurred as the track is, and
    of one anywhere. The image does not count, nor a track behind the wall or not reported. A height
    that an array does not observe says next to nothing. Three of ten echoes are found, and the
    body's deviations are 1.5 times as large. Planted bugs: a track counts for itself; tracks behind
    walls, or tentative, are targets; no blur; pull taken for a deviation; none anywhere."""
    body, image = BODY[:3], image_of(BODY[:3])
    own, back = OWN.position - ORIGIN, BODY[3:] * TURNED
    along = (image - own) / np.linalg.norm(image - own)
    everyone = [
        track(3, body, BODY[3:]),
        track(5, image, back),
        track(7, image - 2 * along, back),
        track(8, image - 1 * along, back),
        track(9, image - 1.5 * along, back),
    ]
    everyone[4].confirmed = False
    tracks = track_set(everyone, OWN)
    leeway = row_of_sixteen() if board else Leeway(RESOLUTION, Ambiguity(PERIOD))
    asked = np.array([False, False, False, True, False])
    found = suspicion(tracks, OWN, Walls(wall()), leeway, asked=asked)
    z, apart = tracks.measured, np.array([3.0, 1.0, 0.1, 0.1])
    std, pull = np.hypot(1.5 * tracks.std[0], tracks.std[1]), leeway.resolution / 2
    blurred = np.sqrt(apart**2 + tracks.std[1] ** 2 + pull**2 / 3)
    axes = slice(3) if board else slice(4)
    d2 = (((z[1] - z[[0, 2]]) / blurred) ** 2)[:, axes].sum(axis=1)
    of_targets = np.exp(-d2 / 2).sum() / (np.sqrt(2 * np.pi) * blurred)[axes].prod()
    of_echo = (special.erf(pull / std / np.sqrt(2)) / (2 * pull))[axes].prod() * as_strong(tracks)
    flat = np.sqrt(6 / np.pi) if board else 1.0  # a normal's peak over a flat density as wide
    anywhere = 1 / (tracks.range.max() * leeway.ambiguity.period * 2 * (1 if board else 2))
    expected = (flat * of_targets + anywhere) / (0.3 * of_echo)
    assert found.ratio[1] == pytest.approx(expected, rel=0.02)
    assert np.isinf(found.ratio[0]) and found.ratio[3] == 0
    assert found.suspect.tolist() == [False, True, False, True, False]


@pytest.mark.parametrize("spread", [0.05, 0.4])
def test_what_others_report_is_a_target(spread):
    """A report of a UAV where the body's image is: its density is added, by hand, as wide as report
    and track are; one of 3 m beside adds nothing, nor one of the body, however wide. Planted bugs:
    reports left out; as wide as neighbours or as what walls show; a report counts for all."""
    body, image = BODY[:3], image_of(BODY[:3])
    tracks = track_set([track(3, body, BODY[3:]), track(5, image, BODY[3:] * TURNED)], OWN)
    leeway, none = Leeway(RESOLUTION, Ambiguity(PERIOD)), np.zeros(2, bool)

    def reported(place: np.ndarray, spread: float = spread) -> TrackSet:
        state = np.concatenate([place + ORIGIN, BODY[3:] * TURNED])
        return track_set([Track.of_state(Gaussian(state, spread**2 * np.eye(6)))], OWN)

    def ratio(place: np.ndarray) -> float:
        told = reported(place)
        return float(suspicion(tracks, OWN, Walls(wall()), leeway, told, none).ratio[1])

    alone = suspicion(tracks, OWN, Walls(wall()), leeway, asked=none).ratio[1]
    std, pull = np.hypot(1.5 * tracks.std[0], tracks.std[1]), leeway.resolution / 2
    blurred = np.sqrt(reported(image).std[0] ** 2 + tracks.std[1] ** 2 + pull**2 / 3)
    of_echo = (special.erf(pull / std / np.sqrt(2)) / (2 * pull)).prod() * as_strong(tracks)
    more = 1 / (np.sqrt(2 * np.pi) * blurred).prod() / (0.3 * of_echo)
    assert ratio(image) - alone == pytest.approx(more, rel=0.02)
    assert ratio(image + np.array([0.0, 3.0, 0.0])) == pytest.approx(alone, rel=0.02)
    wide = suspicion(tracks, OWN, Walls(wall()), leeway, reported(body, 3.0), none).ratio[1]
    assert wide == pytest.approx(alone, rel=1e-9)


def test_a_doubtful_track_explains_as_far_as_it_exists():
    """The body's track is not reported yet: its image is the likelier an echo, the more probably
    the body's track follows one; below a fifth it explains nothing. Planted bugs: confirmed ones
    alone; each alike."""
    body = replace(track(3, BODY[:3], BODY[3:]), confirmed=False)
    tracks = track_set([body, track(5, image_of(BODY[:3]), BODY[3:] * TURNED)], OWN)
    leeway, none = Leeway(RESOLUTION, Ambiguity(PERIOD)), np.zeros(2, bool)

    def ratio(exists: float) -> float:
        exist = np.array([exists, 1.0])
        return float(suspicion(tracks, OWN, Walls(wall()), leeway, None, none, exist).ratio[1])

    assert ratio(0.4) == pytest.approx(ratio(0.8) * 2, rel=1e-9)
    assert np.isinf(ratio(0.19))


def test_images_of_a_formation_are_no_targets():
    """Five UAVs and all of their images on a row of antennas: each image stands beside the others,
    none behind a wall that it is asked of. Planted bug: what is explained counts."""
    step = np.array([0.9, 2.0, 0.3, 0, 0, 0])
    rows = [BODY + k * step for k in range(-2, 3)]
    there = [track(k, b[:3], b[3:]) for k, b in enumerate(rows)]
    images = [np.append(image_of(b[:3]), b[3:] * TURNED) for b in rows]
    seen = [replace(track(10 + k, b[:3], b[3:]), snr=10.0) for k, b in enumerate(images)]
    tracks = track_set(there + seen, OWN)
    nobody = np.zeros(10, bool)
    found = suspicion(tracks, OWN, Walls(wall()), row_of_sixteen(), asked=nobody)
    assert (found.ratio[5:] < 0.02).all() and np.isinf(found.ratio[:5]).all()


def test_the_likeliest_source_counts():
    """Of two that explain an echo, the one that it fits. Planted bug: the first."""
    body, image = BODY[:3], image_of(BODY[:3])
    off = body + np.array([0.0, 0.1, 0.0])
    tracks = [track(3, off, BODY[3:]), track(4, body, BODY[3:])]
    tracks.append(track(5, image, BODY[3:] * TURNED))
    for order in ([0, 1, 2], [1, 0, 2]):
        some = track_set([tracks[k] for k in order], OWN)
        leeway = Leeway(RESOLUTION, Ambiguity(PERIOD))
        assert suspicion(some, OWN, Walls(wall()), leeway).source[2] == 4


def followed(tracker: Tracker, ghosts: Ghosts, reports: Sequence[Gaussian]) -> bool:
    """A frame shows the one track of a tracker; return whether it is reported after it."""
    (one,) = tracker.tracks
    before = frozenset() if one.credible else frozenset({one.id})
    one.odds = existence.updated(one.odds, True, one.hits, one.age + 1)
    one.age, one.hits, one.detection = one.age + 1, one.hits + 1, 0
    known = [ReportedUav("", body) for body in reports]
    ghosts.prune(tracker, Ownship(OWN, 0.0, reports=known, tentative=before))
    return one.credible


def test_an_echo_is_doubted_once_its_body_is_known():
    """An image that was reported before anybody knew of the body ends to be reported in the
    second frame that knows of it, nor is it later without: it lies behind the wall. A frame that
    does not show it says nothing. Planted bugs: only new tracks asked; doubted without a
    detection."""
    image = image_of(BODY[:3])
    w = Waveform()
    antennas = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * w.wavelength)
    body = [Gaussian(np.concatenate([BODY[:3] + ORIGIN, BODY[3:]]), np.eye(6) * 1e-4)]
    tracker = Tracker(Tracking(), Ambiguity(PERIOD))
    one = track(5, image, BODY[3:] * TURNED)
    one.odds, one.age, one.hits = existence.SURE, 20, 20
    tracker.state.tracks = [one]
    ghosts = Ghosts(Walls(wall()), Leeway.of(w, antennas, 2))
    said = [followed(tracker, ghosts, known) for known in (body, body, body, body, [], [], [])]
    assert said == [True, *[False] * 6]
    before, one.detection = one.odds, -1
    ghosts.prune(tracker, Ownship(OWN, 0.0, reports=[ReportedUav("", b) for b in body]))
    assert one.odds == before


@pytest.mark.parametrize(
    ("depth", "std", "frame"),
    [(0.6, 0.05, 2), (0.6, 0.3, None), (-0.6, 0.05, None), (3.5, 0.05, 2)],
)
def test_a_track_that_goes_behind_a_wall_is_doubted(depth, std, frame):
    """Its place is known well enough only after it was reported. What lies before the wall, or
    perhaps, stays. Planted bugs: only new tracks asked; deviations left out; it ends at once."""
    w = Waveform()
    antennas = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * w.wavelength)
    ghosts, tracker = (
        Ghosts(Walls(wall()), Leeway.of(w, antennas, 2)),
        Tracker(Tracking(), Ambiguity(PERIOD)),
    )
    one = track(5, np.array([WALL_X + depth, 24.0, 5.0]), np.array([0.0, 9.0, 0.0]))
    one.state = Gaussian(one.state.mean, np.diag([std**2] * 3 + [1e-2] * 3))
    one.odds, one.age, one.hits = existence.SURE, 20, 20
    tracker.state.tracks = [one]
    said = [followed(tracker, ghosts, []) for _ in range(5)]
    assert (said.index(False) + 1 if False in said else None) == frame


@pytest.mark.parametrize("passes", [1, 2])
def test_directions_turn_by_what_the_array_tells_apart_whatever_the_view(passes):
    """Every channel hears two directions one turn apart alike, and two half as far apart not, where
    the view is narrower than that. Planted bug: the turn from the view."""
    w = Waveform()
    antennas = Antennas(
        tx_x=2, tx_z=2, rx_x=4, rx_z=4, spacing=0.5 * w.wavelength, half_view=np.radians(40)
    )
    turns = Leeway.of(w, antennas, passes).cosine_period
    places = antennas.virtual_positions if passes == 2 else antennas.rx_positions
    places = (places - places[0]) / w.wavelength
    for turn, axis in zip(turns, (0, 2), strict=True):
        assert np.exp(2j * np.pi * turn * places[:, axis]) == pytest.approx(1, abs=1e-9)
        assert np.abs(np.exp(1j * np.pi * turn * places[:, axis]) - 1).max() > 1


def test_an_image_beyond_the_view_is_heard_from_the_other_side():
    """The wall's echo comes from u_x of 0.59 to an array that tells 1.1 apart: it is detected at
    -0.51. Planted bug: directions are not folded."""
    tracks = [track(3, BODY[:3], BODY[3:])]
    image = echoes(
        tracks[0].state.mean[:6] - np.concatenate([OWN.position, OWN.velocity]), OWN, Walls(wall())
    ).measured[-1]
    u = np.array([image[2] - 1.1, 0.0, image[3]])
    u[1] = np.sqrt(1 - u @ u)
    own = OWN.position - ORIGIN
    seen = track(5, own + image[0] * u, OWN.velocity + image[1] * u)
    for turn, order in ((1.1, 2), (np.inf, 0)):
        leeway = Leeway(RESOLUTION, Ambiguity(PERIOD), turn)
        found = suspicion(track_set([*tracks, seen], OWN), OWN, Walls(wall()), leeway)
        assert found.order.tolist() == [0, order]


def test_a_place_just_behind_a_wall_is_in_doubt_as_far_as_it_is_unsure():
    """0.4 m behind the wall with 2 cm of deviation: suspect; with 30 cm, not. Planted bug: the
    deviation left out."""
    behind = track(1, np.array([WALL_X + 0.4, 24.0, 5.0]), np.zeros(3))
    unsure = replace(behind, state=Gaussian(behind.state.mean, np.diag([0.09] * 3 + [1e-2] * 3)))
    for one, expected in ((behind, True), (unsure, False)):
        assert suspicion(
            track_set([one], OWN), OWN, Walls(wall()), Leeway(RESOLUTION, Ambiguity(PERIOD))
        ).suspect.tolist() == [expected]


SENDER = np.array([3.9, 34.2, 2.6, 0.9, -5.7, 0.3])
"""Local position and velocity of an active terminal that `OWN` listens to."""


def touch(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Where the shortest way over the wall touches it, by similar triangles: the heights over the
    plane divide the way."""
    a, b = WALL_X - start[0], WALL_X - end[0]
    return start + (end - start) * a / (a + b) + np.array([2 * a * b / (a + b), 0, 0])


def test_reflections_at_a_passive_terminal_are_the_shortest_ways():
    """Path length and rate over the wall before the body, behind it and both, and of the sender
    itself, against lengths found by minimising; the direction is that of the point where the last
    way touches the wall. Tolerances as for the echoes. Planted bugs: arrival from the body where
    the last way is over the wall; the rate of one way only."""
    here = np.concatenate([OWN.position - ORIGIN, OWN.velocity])
    shown = reflections(BODY - here, SENDER - here, OWN, Walls(wall()))
    assert shown.orders.tolist() == [1, 1, 2]
    found = dict(zip(("back", "out", "both"), shown.measured, strict=True))
    of_sender = reflections(SENDER - here, None, OWN, Walls(wall()))
    assert of_sender.orders.tolist() == [1]
    found["sender"] = of_sender.measured[0]
    h = 1e-3

    def lengths(t: float) -> dict[str, float]:
        own, body, sender = (x[:3] + t * x[3:] for x in (here, BODY, SENDER))
        return {
            "out": length(sender, body, True) + length(body, own, False),
            "back": length(sender, body, False) + length(body, own, True),
            "both": length(sender, body, True) + length(body, own, True),
            "sender": length(sender, own, True),
        }

    now, before, after = lengths(0.0), lengths(-h), lengths(h)
    ends = {
        "out": BODY[:3],
        "back": touch(BODY[:3], here[:3]),
        "both": touch(BODY[:3], here[:3]),
        "sender": touch(SENDER[:3], here[:3]),
    }
    for name, echo in found.items():
        assert echo[0] == pytest.approx(now[name], abs=1e-7)
        assert echo[1] == pytest.approx((after[name] - before[name]) / (2 * h), abs=1e-3)
        towards = (ends[name] - here[:3]) / np.linalg.norm(ends[name] - here[:3])
        np.testing.assert_allclose(echo[2:], towards[[0, 2]], rtol=0, atol=1e-12)


def received(number: int, path: float, rate: float, towards: np.ndarray) -> Track:
    """A track whose path from `SENDER` by way of a point towards a direction has this length and
    rate."""
    from scipy.optimize import brentq

    own = OWN.position - ORIGIN
    rho = brentq(lambda r: r + np.linalg.norm(own + r * towards - SENDER[:3]) - path, 1e-3, path)
    place = own + rho * towards
    leaving = (place - SENDER[:3]) / np.linalg.norm(place - SENDER[:3])
    both = towards + leaving
    still = -towards @ OWN.velocity - leaving @ SENDER[3:]
    return track(number, place, both * (rate - still) / (both @ both))


def test_a_passive_terminal_suspects_its_ghosts():
    """Its reference; a body; an echo over the wall on the way to the body, one on the way from it,
    the reference over the wall; and a body elsewhere with the first echo's length and rate. Planted
    bugs: the reference's own reflection not asked for; the active terminal's ranges taken."""
    own = OWN.position - ORIGIN
    here = np.concatenate([own, OWN.velocity])
    back, out, _ = reflections(BODY - here, SENDER - here, OWN, Walls(wall())).measured
    (mirrored,) = reflections(SENDER - here, None, OWN, Walls(wall())).measured

    def ahead(u: np.ndarray) -> np.ndarray:
        return np.array([u[0], np.sqrt(1 - u[0] ** 2 - u[1] ** 2), u[1]])

    aside = np.array([-0.6, 0.8, 0.0])
    tracks = [
        track(3, BODY[:3], BODY[3:]),
        received(5, *out[:2], ahead(out[2:])),
        received(6, *back[:2], ahead(back[2:])),
        received(7, *mirrored[:2], ahead(mirrored[2:])),
        received(8, *out[:2], aside),
    ]
    everyone = track_set(tracks, OWN, track(1, SENDER[:3], SENDER[3:]))
    one_pass = RESOLUTION * [2, 2, 3, 3]
    found = suspicion(everyone, OWN, Walls(wall()), Leeway(one_pass, Ambiguity(2 * PERIOD)))
    assert found.suspect.tolist() == [False, False, True, True, True, False]
    assert found.source.tolist() == [-1, -1, 3, 3, 1, -1]
    assert found.order.tolist() == [0, 0, 1, 1, 1, 0]


def test_a_place_that_the_sender_cannot_see_is_suspect_at_a_passive_terminal():
    """The sender behind the wall's plane, the place in sight of the own pose alone. Planted bug:
    only the own line of sight asked."""
    hidden = SENDER + np.array([2 * (WALL_X - SENDER[0]), 0, 0, 0, 0, 0])
    found = suspicion(
        track_set([track(3, BODY[:3], BODY[3:])], OWN, track(1, hidden[:3], hidden[3:])),
        OWN,
        Walls(wall()),
        Leeway(RESOLUTION, Ambiguity(PERIOD)),
    )
    assert (found.behind >= 0).tolist() == [False, True]


def test_tracks_are_counted_by_what_explains_them():
    """A UAV's track, two ghosts of which the test sees one, and one of a wall: 2 of 4 without the
    test, 1 of 3 with it. Planted bug: the rate with the test over all tracks."""
    rows = []
    for number, (uav, kind, order, suspect) in enumerate(
        [(2, 1, 0, False), (-1, 2, 1, True), (-1, 2, 2, False), (-1, 3, 1, False)]
    ):
        rows += [
            (f, "active", number, uav, kind, order, 7 + number, kind == 2, suspect)
            for f in range(4)
        ]
    rows.append((4, "active", 1, -1, -1, -1, -1, False, False))
    tracks = whole_tracks(
        pd.DataFrame(
            rows,
            columns=["frame", "terminal", "id", "uav", "kind", "order", "face", "ghost", "suspect"],
        )
    )
    assert tracks.what.tolist() == ["uav", "ghost", "ghost", "other"]
    assert tracks.order.tolist() == [-1, 1, 2, -1] and tracks.face.tolist() == [-1, 8, 9, -1]
    said = verdicts(tracks)[1].finding
    assert "(2 of 4)" in said and "(1 of 3)" in said and "(0 of 1)" in said


def test_a_track_has_its_own_detections_explanation():
    """The fake run's track lies on the first detection of PT1 and of the AT, a UAV's echo. Planted
    bug: detections of another observer."""
    from fake_run import fake_run

    d = fake_run().dataset
    parts = [
        explained_tracks(d, o, np.array([40.0, 40.0, 1, 1]), 1e6, o > 0)
        for o in range(d.observer.size)
    ]
    rows = pd.concat(parts).sort_values(["frame", "observer", "id"], ignore_index=True)
    assert len(rows) == d.track_id.size
    for row in rows.itertuples():
        mine = (d.det_frame.values == row.frame) & (d.det_observer.values == row.observer)
        off = np.hypot(
            d.det_range.values[mine] - d.track_range.values[row.Index],
            d.det_velocity.values[mine] - d.track_velocity.values[row.Index],
        )
        assert row.kind == d.det_kind.values[mine][np.argmin(off)]


@pytest.mark.slow
def test_the_street_has_ghosts_and_the_test_finds_them():
    """Three flights: every ghost track has a wall and an order, that of the active terminal is
    suspect, so are those of a passive one whose source it tracks (in the second flight it tracks no
    UAV), and no UAV's track is lost. Planted bug: no track is asked."""
    tracks = run(True, 20260, lambda _done, _all: None).tables["tracks"]
    ghosts = tracks[tracks.what == "ghost"]
    assert len(ghosts) and (ghosts.order > 0).all() and (ghosts.face >= 0).all()
    assert ghosts[ghosts.terminal == "active"].suspect.tolist() == [True]
    assert ghosts[ghosts.terminal == "passive"].groupby("scene").suspect.sum().tolist() == [2, 0, 1]
    assert not tracks[tracks.what == "uav"].suspect.any()


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((WALL_X - 1.4, 20.0, 3.0), True),
        ((WALL_X + 1.4, 20.0, 3.0), True),
        ((WALL_X - 1.6, 20.0, 3.0), False),
        ((WALL_X - 0.5, 45.0, 3.0), False),  # in the plane's reach, beside its faces
    ],
)
def test_a_place_within_reach_of_a_wall(place, expected):
    """The wall ends at y = 40. Planted bugs: the plane without its end; the origin left out."""
    assert Walls(wall()).within(np.array(place) + ORIGIN, 1.5) is expected


def test_a_place_beside_a_face_within_its_box_is_not_within_reach():
    """Half of the wall, cut along its diagonal. Planted bug: the box about the faces."""
    half = replace(
        wall(), faces=np.array([[0, 1, 2]], np.int32), face_material=np.zeros(1, np.int16)
    )
    for place, expected in (((WALL_X, 5.0, 11.0), False), ((WALL_X, 35.0, 0.0), True)):
        assert Walls(half).within(np.array(place) + ORIGIN, 1.5) is expected
