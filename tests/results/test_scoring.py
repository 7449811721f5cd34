"""Whole frames held against the truth: paths, detections and tracks by hand, each cause known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from isac_rt.frame.antennas import Arrays, antennas_of
from isac_rt.frame.cube import Transmission
from isac_rt.frame.link import Link
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, waveform_of
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections, Reception
from isac_rt.results.columns import OBSERVERS
from isac_rt.results.losses import Loss
from isac_rt.results.scoring import LinkResult, Scorer
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import swarm_of, timetable_of
from isac_rt.track.tracker import TrackSet

UAVS = {
    "U1": Uav(role="target", position_m=(-1.3, 4.9, 10.1), velocity_mps=(0.5, 9.7, 0.3)),
    "AT": Uav(role="active", position_m=(1.3, -20.7, 9.1), velocity_mps=(0.4, 6.1, 0.1)),
    "PT1": Uav(
        role="passive",
        position_m=(4.2, 23.7, 11.4),
        velocity_mps=(-0.3, -3.1, 0.2),
        boresight=(0, -1, 0),
    ),
    "U2": Uav(role="target", position_m=(6.3, 1.9, 12.3), velocity_mps=(-2.1, 1.7, -0.2)),
}
NAMES = list(UAVS)
SCENARIO = Scenario(name="by_hand", seed=3, frames=9, swarm=UAVS)
W = waveform_of(SCENARIO.radio, SCENARIO.array)
ANTENNAS = antennas_of(SCENARIO.array, W)
SWARM = swarm_of(SCENARIO)
TIMETABLE = timetable_of(
    SCENARIO, W, conventional_schedule(W.num_groups, W.num_chirps, ANTENNAS.num_tx)
)
DATA = next(f for f in range(9) if TIMETABLE.modulated(f))
NOISE = 1.0
MATCHED = W.num_samples * W.num_chirps * W.num_groups * ANTENNAS.num_rx
"""SNR of the coherent matched filter of a path of unit power."""
FAINT = np.sqrt(10**1.25 / MATCHED)
"""Gain of a path of 12.5 dB behind it."""


def seen_by(receiver: str, uav: str, frame: int) -> np.ndarray:
    """Range, velocity and direction cosines of a UAV as a receiver of the AT should see them, by
    differences of lengths and by projection."""
    poses = SWARM.poses(TIMETABLE.epoch(frame))
    moved = {n: p.position + 1e-6 * p.velocity for n, p in poses.items()}
    placed = {n: p.position for n, p in poses.items()}

    def length(at: dict[str, np.ndarray]) -> float:
        last = float(np.linalg.norm(at[uav] - at[receiver]))
        there = 0.0 if uav == "AT" or receiver == "AT" else np.linalg.norm(at[uav] - at["AT"])
        return last + float(there)

    towards = placed[uav] - placed[receiver]
    body = poses[receiver].rotation.T @ towards / np.linalg.norm(towards)
    rate = (length(moved) - length(placed)) / 1e-6
    return np.array([length(placed), rate, body[0], body[2]])


def path_of(receiver: str, uav: str, frame: int, gain: float, kind=None, off=(0.0, 0.0)) -> dict:
    """A path at a UAV's place, `off` cells of range and velocity beside it; by default its own."""
    passes = 2 if receiver == "AT" else 1
    r, v = seen_by(receiver, uav, frame)[:2]
    r, v = r + off[0] * W.range_cell(passes), v + off[1] * W.velocity_cell(passes)
    own = PathKind.LINE_OF_SIGHT if uav == "AT" else PathKind.TARGET
    target = NAMES.index(uav) if kind is None and uav != "AT" else -1
    delay = np.array([r, v]) * passes / SPEED_OF_LIGHT
    return {"gain": gain, "delay": delay, "kind": own if kind is None else kind, "target": target}


def pathset(receiver: str, rows: list[dict], points=None):
    delay = np.array([row["delay"] for row in rows]).reshape(-1, 2)
    ahead = np.tile([0.0, 1.0, 0.0], (len(rows), 1))
    return make_paths(
        gain=np.array([row["gain"] for row in rows], complex),
        delay=delay[:, 0],
        delay_rate=delay[:, 1],
        departure=ahead,
        arrival=ahead,
        kind=np.array([row["kind"] for row in rows]),
        # in another order than the swarm's
        target=np.array([3 - row["target"] if row["target"] >= 0 else -1 for row in rows]),
        epoch=0.0,
        tx="AT",
        rx=receiver,
        target_names=tuple(NAMES[::-1]),
        points=None if points is None else np.array(points, float),
    )


def detections(points) -> Detections:
    z = np.array(points, float).reshape(-1, 4)
    return Detections(
        range=z[:, 0].copy(),
        velocity=z[:, 1].copy(),
        direction=z[:, 2:].copy(),
        snr=np.full(len(z), 50.0),
        std=np.full((len(z), 4), 0.1),
        is_reference=np.zeros(len(z), bool),
        starts=np.ones(len(z), bool),
    )


def track_set(receiver: str, frame: int, rows) -> TrackSet:
    """Tracks of (id, confirmed, row of the detection, UAV at whose place, metres east of it)."""
    poses, count = SWARM.poses(TIMETABLE.epoch(frame)), len(rows)
    z = np.array([seen_by(receiver, uav, frame) for *_, uav, _ in rows]).reshape(-1, 4)
    mean = np.zeros((count, 6))
    for k, (*_, uav, east) in enumerate(rows):
        mean[k, :3] = poses[uav].position - poses[receiver].position + [east, 0, 0]
    return TrackSet(
        ids=np.array([row[0] for row in rows], int),
        mean=mean,
        covariance=np.zeros((count, 6, 6)),
        range=z[:, 0],
        velocity=z[:, 1],
        direction=z[:, 2:],
        std=np.ones((count, 4)),
        age=np.zeros(count, int),
        confirmed=np.array([row[1] for row in rows], bool),
        is_reference=np.zeros(count, bool),
        detection=np.array([row[2] for row in rows], int),
        snr=np.ones(count),
    )


def scored(scorer, frame, paths, points=(), tracks=(), **reception):
    receiver = scorer.link.rx
    pose = SWARM.poses(TIMETABLE.epoch(frame))["AT"]
    payload = TIMETABLE.payload("AT", frame)
    sent = Transmission(
        name="AT", pose=pose, antennas=ANTENNAS, schedule=TIMETABLE.schedule, payload=payload
    )
    received = replace(Reception.undecoded(W, detections(points)), **reception)
    heard = LinkResult(received, track_set(receiver, frame, tracks), 1)
    return scorer.record(frame, pathset(receiver, paths), sent, heard, NOISE)


def scorer(receiver: str) -> Scorer:
    return Scorer(Link("AT", receiver), Arrays(ANTENNAS), SWARM, TIMETABLE, Receivers())


def read(frame: int, wrong: float = 0.0) -> dict:
    """A reception that read its data, a share of the delay symbols a cell off."""
    payload = TIMETABLE.payload("AT", frame)
    delay = payload.delay_symbols.copy()
    off = np.arange(delay.size).reshape(delay.shape) < wrong * delay.size
    delay[off] = (delay[off] + 1) % W.num_delay_symbols
    return {
        "decoded": True,
        "line_of_sight": True,
        "delay_symbols": delay,
        "transitions": payload.transitions,
        "bits": payload.bits,
    }


OWN, BESIDE = (0.0, 0.0, 0.0, 0.0), (0.3, 0.2, 0.02, 0.01)


def point(receiver, uav, frame, off=BESIDE):
    """A detection beside a UAV by cells of range and velocity, and by direction cosines."""
    passes = 2 if receiver == "AT" else 1
    cells = np.array([W.range_cell(passes), W.velocity_cell(passes), 1, 1])
    return seen_by(receiver, uav, frame) + np.array(off) * cells


WALL = [(0.03, PathKind.DIFFUSE, (0.2, 0.1))] * 5
MIRROR, SKIRT = (1.0, PathKind.SPECULAR, (0.4, 0)), (30.0, PathKind.LEAKAGE, (4.2, 0))
CASES = {
    # gain of U1's echo, other paths at its place (gain, kind, cells off), detections, loss
    "found": (30, [], [BESIDE], Loss.FOUND),
    "missed for no reason": (30, [], [], Loss.OTHER),
    "nobody could": (FAINT, [], [], Loss.TOO_WEAK),
    "only coherently": (1.5 * FAINT, [], [], Loss.NOISE),
    "at the threshold": (2.3 * FAINT, [], [], Loss.THRESHOLD),
    "a wall two cells away": (30, [(90, PathKind.DIFFUSE, (2.2, 0))], [(2.2, 0, 0, 0)], Loss.OTHER),
    "its own sidelobe": (300, [], [(2.6, 0, 0, 0)], Loss.OTHER),
    "beside a wall": (0.05, WALL, [], Loss.CLUTTER),
    "taken for the wall": (0.05, WALL, [BESIDE], Loss.CLUTTER),
    "a mirror image in its cell": (0.05, [MIRROR], [BESIDE], Loss.MASKED),
    "in the skirt of the leakage": (0.05, [SKIRT], [], Loss.MASKED),
    "its detection points elsewhere": (30, [], [(0.1, 0.1, 0.3, 0)], Loss.INACCURATE),
    "its detection has no direction": (30, [], [(0.1, 0.1, np.nan, 0)], Loss.INACCURATE),
}
"""What the matched filter has at 17.6 dB is 0.57 of the noise in a map of 45 looks, which finds one
in ten; at 20 dB it is 1 of the noise, and seven in ten."""


@pytest.mark.parametrize("name", CASES)
def test_what_became_of_a_uav_at_the_active_terminal(name):
    """Planted bugs: a detection within the gate counts whatever explains it; the first cause is
    asked last."""
    gain, others, points, expected = CASES[name]
    own = [path_of("AT", "U1", DATA, gain)]
    own += [path_of("AT", "U1", DATA, g, kind, off) for g, kind, off in others]
    record = scored(scorer("AT"), DATA, own, [point("AT", "U1", DATA, off) for off in points])
    assert Loss(record.uavs.loss[0]) is expected
    assert record.uavs.loss.tolist() == [expected, -1, -1, -1]
    assert record.uavs.hit.tolist() == [expected is Loss.FOUND, False, False, False]
    assert record.uavs.target_snr[0] == pytest.approx(MATCHED * gain**2)
    assert np.isnan(record.uavs.target_snr[1:]).all()
    assert (record.uavs.target_clutter[0] > 1) == (others is WALL)
    # errors are of detections by the own path within three resolutions
    seen = expected is Loss.FOUND or name == "its detection has no direction"
    seen |= name == "its detection points elsewhere"
    assert np.isfinite(record.uavs.detected.range[0]) == seen


@pytest.mark.parametrize(
    ("points", "reception", "expected"),
    [
        ([BESIDE], {}, Loss.FOUND),
        ([], {}, Loss.ERASED),
        ([], read(DATA), Loss.OTHER),
        ([], read(DATA) | {"placed": False}, Loss.ERASED),
        ([], read(DATA, 0.6), Loss.ERASED),
        ([], read(DATA, 0.4), Loss.OTHER),
        ([BESIDE], read(DATA, 0.6), Loss.FOUND),
    ],
)
def test_what_became_of_the_transmitter_at_a_passive_one(points, reception, expected):
    """Its line of sight is its own path. Planted bug: a terminal that read nothing counts as one
    that looked."""
    sight = [path_of("PT1", "AT", DATA, 3.0)]
    found = [point("PT1", "AT", DATA, off) for off in points]
    record = scored(scorer("PT1"), DATA, sight, found, **reception)
    assert record.uavs.loss.tolist() == [-1, expected, -1, -1]
    assert record.uavs.hit.tolist() == [False, expected is Loss.FOUND, False, False]


def test_a_pilot_needs_no_reading():
    record = scored(scorer("PT1"), 0, [path_of("PT1", "AT", 0, 3.0)])
    assert not TIMETABLE.modulated(0)
    assert record.uavs.loss[1] == Loss.OTHER


def test_two_uavs_are_told_apart_by_their_paths():
    """Both in view, U1's echo seen, a detection of U1 beside U2's place by the bistatic path: U2 is
    not found by it. Ghosts and walls beside them are clutter; indices are the swarm's."""
    rows = [path_of("PT1", "U1", DATA, 3.0), path_of("PT1", "U2", DATA, 2.0)]
    rows += [path_of("PT1", "AT", DATA, 1.0)]
    ghost = path_of("PT1", "U2", DATA, 2.0, PathKind.GHOST, (12.0, 9.0)) | {"target": 3}
    points = [point("PT1", "U1", DATA), point("PT1", "U2", DATA, (12.1, 9.1, 0.0, 0.0))]
    points += [seen_by("PT1", "U1", DATA) + np.array([40.0, 7.0, 0, 0])]
    record = scored(scorer("PT1"), DATA, [*rows, ghost], points, **read(DATA))
    assert record.uavs.hit.tolist() == [True, False, False, False]
    assert record.uavs.loss.tolist()[::2] == [Loss.FOUND, -1]
    assert record.labels.kind.tolist() == [PathKind.TARGET, PathKind.GHOST, -1]
    assert record.labels.target.tolist() == [0, 3, -1]
    assert [OBSERVERS[name].read(record) for name in ("num_false", "num_clutter")] == [1, 1]


def test_occluded_or_behind_is_not_in_view():
    """U1 without a path is in view and occluded; PT1, behind nobody, has none at the AT either."""
    record = scored(scorer("AT"), DATA, [path_of("AT", "U2", DATA, 3.0)])
    assert record.uavs.in_view.tolist() == [True, False, True, True]
    assert record.uavs.occluded.tolist() == [True, False, True, False]
    assert record.uavs.loss.tolist() == [-1, -1, -1, Loss.OTHER]


def test_a_uav_is_tracked_by_place_and_errors_are_of_its_own_path():
    """Over four frames: a tentative track at U1's place, one that a wall feeds, one of U1's echo
    0.9 m off. The wall's started first and follows U1, but its errors count only from the frame on
    in which the echo feeds it, also while it coasts. Planted bugs: tentative tracks follow; the
    label of the frame's first detection; the label of a coasting track forgotten; errors of every
    track that follows."""
    judge = scorer("AT")

    def step(frame, fed, labels):
        """`fed`: row of each track's detection; `labels`: kinds of the paths behind the rows."""
        rows = [path_of("AT", "U1", frame, 30.0)]
        rows += [path_of("AT", "U1", frame, 60.0, PathKind.DIFFUSE, (7.0, 5.0))]
        places = {"echo": OWN, "wall": (7.0, 5.0, 0.0, 0.0)}
        points = [point("AT", "U1", frame, places[label]) for label in labels]
        tracks = [(11, False, fed[1], "U1", 0.0)] * (frame == DATA)
        tracks += [(4, True, fed[0], "U1", 0.1), (9, True, fed[1], "U1", 0.9)]
        record = scored(judge, frame, rows, points, tracks)
        assert not record.tracks.false.any()
        return record.tracks, bool(np.isfinite(record.uavs.tracked.range[0]))

    first, known = step(DATA, (1, 0), ["echo", "wall"])
    assert (first.uav.tolist(), known) == ([-1, 0, -1], False)
    assert first.kind.tolist() == [PathKind.TARGET, PathKind.DIFFUSE, PathKind.TARGET]
    assert first.target.tolist() == [0, -1, 0]
    second, known = step(DATA + 1, (-1, -1), [])
    assert second.kind.tolist() == [PathKind.DIFFUSE, PathKind.TARGET] and not known
    assert list(judge.state.labels) == [4, 9]
    again = scorer("AT")
    again.restore(judge.memory())
    judge = again
    for frame, fed, labels in ((DATA + 2, (0, -1), ["echo"]), (DATA + 3, (-1, -1), [])):
        tracks, known = step(frame, fed, labels)
        assert (tracks.uav.tolist(), known) == ([0, -1], True)


def test_gospa_is_of_confirmed_tracks_and_targets_in_view():
    """U1 with a track 0.3 m off, U2 in view without one, PT1 occluded with one, a tentative track,
    one 40 m from U1: localisation 0.09, one missed, one false. Planted bugs: tentative tracks
    count; the terminal's track is false; positions in world coordinates."""
    rows = [path_of("AT", "U1", DATA, 3.0), path_of("AT", "U2", DATA, 3.0)]
    tracks = [(1, True, -1, "U1", 0.3), (2, True, -1, "PT1", 0.0), (3, False, -1, "U2", 0.0)]
    tracks += [(4, True, -1, "U1", 40.0)]
    record = scored(scorer("AT"), DATA, rows, [], tracks)
    assert record.gospa[1:] == pytest.approx((0.09, 12.5, 12.5))
    assert record.tracks.false.tolist() == [False, False, False, True]
    table = record.tracks  # of tracks that no detection has fed yet nothing is said
    assert {*table.kind, *table.target} == {-1}


def test_targets_are_scored_without_the_terminals():
    """U1 with a track 0.3 m off, PT1 with one 2 m off, and a wall's track at U2, who is not in
    view: neither PT1's nor U2's is found or false. The bounds are those of 20 dB and more. Where
    all are terminals, they are the targets: PT1's track counts. Planted bugs: the terminal's track
    counts as false; a swarm of terminals without targets."""
    rows = [path_of("AT", "U1", DATA, 3.0), path_of("AT", "PT1", DATA, 3.0)]
    rows += [path_of("AT", "U2", DATA, 3.0, PathKind.DIFFUSE)]
    names = zip((4, 5, 6), ("U1", "PT1", "U2"), (0.3, 2.0, 0.0), strict=True)
    tracks = [(number, True, -1, name, east) for number, name, east in names]
    record = scored(scorer("AT"), DATA, rows, [], tracks)
    assert record.uavs.cooperative.tolist() == [False, True, True, False]
    assert record.gospa[1:] == pytest.approx((0.09, 0.0, 0.0))
    assert (record.uavs.genie[[0, 2]] > 0.99).all() and np.isnan(record.uavs.genie[[1, 3]]).all()
    assert (record.uavs.clutter_free[[0, 2]] > 0.99).all()
    roles = TIMETABLE.first_roles
    alone = replace(TIMETABLE, first_roles=roles | {"U1": "passive", "U2": "passive"})
    judge = Scorer(Link("AT", "AT"), Arrays(ANTENNAS), SWARM, alone, Receivers())
    record = scored(judge, DATA, rows, [], tracks)
    assert not record.uavs.cooperative.any()
    assert record.gospa[1:] == pytest.approx((4.09, 0.0, 0.0))


def test_tracks_of_objects_are_named_and_not_false():
    """U2 is a car: a track at its end, one 30 m off that its flash feeds, one as far that a wall
    feeds, U1's own; it is no target in view. Planted bugs: the flash's track is false in GOSPA; all
    tracks far from UAVs are the car's."""
    roles = TIMETABLE.first_roles | {"U2": "object"}
    street = replace(TIMETABLE, first_roles=roles)
    judge = Scorer(Link("AT", "AT"), Arrays(ANTENNAS), SWARM, street, Receivers())
    flash = path_of("AT", "U2", DATA, 3.0, PathKind.SPECULAR, (40.0, 0.0))
    wall = path_of("AT", "U2", DATA, 3.0, PathKind.SPECULAR, (80.0, 0.0))
    rows = [path_of("AT", "U1", DATA, 3.0), path_of("AT", "U2", DATA, 3.0), wall]
    rows += [flash | {"target": NAMES.index("U2")}]
    cells = np.array([W.range_cell(2), 0, 0, 0])
    points = [seen_by("AT", "U2", DATA) + n * cells for n in (40, 80)]
    tracks = [(1, True, -1, "U1", 0.3), (2, True, -1, "U2", 4.0)]
    tracks += [(3, True, 0, "U2", 30.0), (4, True, 1, "U2", 31.0)]
    record = scored(judge, DATA, rows, points, tracks)
    assert record.tracks.object.tolist() == [False, True, True, False]
    assert record.tracks.false.tolist() == [False, False, False, True]
    assert record.gospa[1:] == pytest.approx((0.09, 0.0, 12.5))
    assert record.uavs.in_view.tolist() == [True, False, True, False]


def test_an_alias_or_a_drifted_track_does_not_stand_for_a_uav():
    """The own path explains them, more than three resolutions off: a velocity a period off, and a
    track that went astray; one in the gate is 6 m off across. Planted bugs: no gate; no cutoff."""
    far = point("AT", "U1", DATA) + np.array([0, 2 * W.max_velocity(2), 0, 0])
    record = scored(scorer("AT"), DATA, [path_of("AT", "U1", DATA, 30.0)], [far])
    assert record.labels.kind.tolist() == [PathKind.TARGET]
    assert np.isnan(record.uavs.detected.range).all()
    assert record.uavs.loss[0] == Loss.INACCURATE
    judge = scorer("AT")
    tracks = [(1, True, 0, "U2", 0.0)]
    rows = [path_of("AT", "U1", DATA, 30.0)]
    record = scored(judge, DATA, rows, [point("AT", "U1", DATA)], tracks)
    assert record.tracks.kind.tolist() == [PathKind.TARGET]
    assert record.tracks.uav.tolist() == [-1]
    record = scored(judge, DATA, rows, [], [(2, True, -1, "U1", -6.0)])
    assert (record.tracks.uav.tolist(), record.tracks.false.tolist()) == ([-1], [True])


def test_of_two_tracks_the_one_that_followed_goes_on():
    """Another track of U1 that is nearer does not take over while the first one lives."""
    judge = scorer("AT")
    rows = {f: [path_of("AT", "U1", f, 30.0)] for f in (DATA, DATA + 1)}
    found = {f: [point("AT", "U1", f)] * 2 for f in rows}
    scored(judge, DATA, rows[DATA], found[DATA], [(7, True, 0, "U1", 0.0)])
    tracks = [(3, True, 0, "U1", 0.0), (7, True, 1, "U1", 0.0)]
    record = scored(judge, DATA + 1, rows[DATA + 1], found[DATA + 1], tracks)
    assert record.tracks.uav.tolist() == [-1, 0]
    assert record.uavs.tracked.range[0] == record.tracks.range[1]
    assert np.isnan(record.uavs.tracked.range[1:]).all()
    again = scorer("AT")
    scored(again, DATA, rows[DATA], found[DATA], [(7, True, 0, "U1", 0.0)])
    resumed = scorer("AT")
    resumed.restore(again.memory())
    record = scored(resumed, DATA + 1, rows[DATA + 1], found[DATA + 1], tracks)
    assert record.tracks.uav.tolist() == [-1, 0]


def test_a_neighbour_uav_is_not_the_uav():
    """U2's echo 1.6 cells beside U1's, stronger: the detection there is none of U1, although it
    lies within three resolutions. Planted bug: any UAV's path will do."""
    other = path_of("AT", "U1", DATA, 60.0, PathKind.TARGET, (1.6, 0.0)) | {"target": 3}
    rows = [path_of("AT", "U1", DATA, 3.0), other]
    record = scored(scorer("AT"), DATA, rows, [point("AT", "U1", DATA, (1.6, 0, 0, 0))])
    assert record.labels.target.tolist() == [3]
    assert np.isnan(record.uavs.detected.range[0])
    assert record.uavs.loss[0] == Loss.MASKED


def test_what_is_outside_the_view_or_bent_is_not_asked_for():
    """U1 stands 0.1 rad to the side; a path round an edge is none of its own. Planted bugs: a UAV
    with a path counts wherever it is; bent paths count."""
    rows = [path_of("AT", "U1", DATA, 30.0)]
    narrow = replace(ANTENNAS, half_view=0.05)
    judge = Scorer(Link("AT", "AT"), Arrays(narrow), SWARM, TIMETABLE, Receivers())
    record = scored(judge, DATA, rows)
    assert (record.uavs.in_view[0], record.uavs.occluded[0], record.uavs.loss[0]) == (
        False,
        False,
        -1,
    )
    pose = SWARM.poses(TIMETABLE.epoch(DATA))["AT"]
    sent = Transmission(
        name="AT",
        pose=pose,
        antennas=ANTENNAS,
        schedule=TIMETABLE.schedule,
        payload=TIMETABLE.payload("AT", DATA),
    )
    heard = LinkResult(Reception.undecoded(W, detections([])), track_set("AT", DATA, []), 1)
    bent = pathset("AT", rows, np.ones((1, 2, 3)))
    record = scorer("AT").record(DATA, bent, sent, heard, NOISE)
    assert (record.uavs.in_view[0], record.uavs.occluded[0], record.uavs.loss[0]) == (
        True,
        True,
        -1,
    )


def test_the_strongest_of_its_paths_is_asked():
    """A path in two pieces of which one is weak."""
    rows = [path_of("AT", "U1", DATA, 0.1), path_of("AT", "U1", DATA, 3.0)]
    record = scored(scorer("AT"), DATA, rows)
    assert record.uavs.target_snr[0] == pytest.approx(9 * MATCHED)


def test_streams_and_blocks():
    """PT1 is sent one group of three: in data frames a third of the energy, in pilots all of it.
    The truth is that of the AT's own chirps, three blocks later. Planted bugs: all groups always;
    the group's share in pilots; the first block's time."""
    uavs = UAVS | {"AT": UAVS["AT"].model_copy(update={"resource_block": 3})}
    streams = SCENARIO.modulation.model_copy(update={"streams": {"PT1": (1,)}})
    table = timetable_of(
        SCENARIO.model_copy(update={"swarm": uavs, "modulation": streams}), W, TIMETABLE.schedule
    )
    judge = Scorer(Link("AT", "PT1"), Arrays(ANTENNAS), SWARM, table, Receivers())
    sight = {f: [path_of("PT1", "AT", f, 3.0)] for f in (0, DATA)}
    found = {f: scored(judge, f, paths) for f, paths in sight.items()}
    assert found[0].uavs.target_snr[1] == pytest.approx(9 * MATCHED)
    assert found[DATA].uavs.target_snr[1] == pytest.approx(3 * MATCHED)
    later = SWARM.poses(TIMETABLE.epoch(DATA) + 3 * 2 * W.max_delay)
    length = np.linalg.norm(later["AT"].position - later["PT1"].position)
    # rounding: 45 m in float64; a block later it is 2e-5 m shorter
    assert found[DATA].uavs.truth.range[1] == pytest.approx(length, abs=1e-9)
