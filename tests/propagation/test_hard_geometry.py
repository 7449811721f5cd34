"""Geometry at its edges: each case gives the right number within a bound, or says clearly that it
does not."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from truths import stage
from truths.truths import WAVELENGTH, chain_length

from isac_rt import scenario as tree
from isac_rt.document import ScenarioError, ScenarioWarning
from isac_rt.frame.antennas import Arrays, antennas_of
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.segments.clearance import CLEARANCE, ClearanceWarning
from isac_rt.propagation.segments.geometry import unfold
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.methods import Auto
from isac_rt.simulation.preflight import check_flights, warn_of_aliases
from isac_rt.simulation.setup import prepare, swarm_of, timetable_of
from isac_rt.world.city import CityMesh, load_city
from isac_rt.world.city.materials import MaterialUse
from isac_rt.world.city.mesh import Surface, clean

C = 299_792_458.0
NANOMETRE = 1e-9  # rounding of float64 over a kilometre is a thousandth of it
FAR = (60.0, 44.0, 33.0)
CONCRETE = stage.material()


def found(
    mesh: CityMesh, a, p, u=FAR, bounces: int = 1, link=("A", "P"), moving: bool = False
) -> PathSet:
    return stage.tracer(mesh, bounces).trace(stage.swarm(a, p, u, moving), 0.0, [link]).paths[link]


def wall(material=CONCRETE) -> CityMesh:
    """A wall at x = 11.3, 40 m wide, from the ground to 30 m."""
    return stage.rectangle((11.3, -20, 0), (0, 40, 0), (0, 0, 30), material)


GROUND = stage.rectangle((-400, -400, 0), (800, 0, 0), (0, 800, 0), CONCRETE)


def specular(paths: PathSet) -> PathSet:
    return paths.select(paths.kind == PathKind.SPECULAR)


@pytest.mark.sionna
@pytest.mark.parametrize("height", [1e-3, 0.02, 0.3])
def test_grazing_rays(height):
    """Two terminals just over the ground, 200 m apart: one reflection, its length to a nanometre;
    below a centimetre a warning. Written against: an image a thousandth short of its place."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        paths = specular(found(GROUND, (0, 0, height), (200.3, 0, 1.3 * height)))
    assert any(issubclass(w.category, ClearanceWarning) for w in said) == (height < CLEARANCE)
    if len(paths) or height > CLEARANCE:
        assert len(paths) == 1
        assert C * paths.delay[0] == pytest.approx(np.hypot(200.3, 2.3 * height), abs=NANOMETRE)


@pytest.mark.sionna
@pytest.mark.parametrize("gap", [0.0, 1e-3, 0.011, 0.05])
def test_a_transmitter_close_to_a_wall_or_on_it(gap):
    """Sionna loses the reflection within a millimetre of a wall and sees through it on the wall
    itself. That is said, once, by name and distance; from the clearance on all paths are there.
    Written against: no check, or one against the planes' infinite extent."""
    model = stage.tracer(wall(), 1)
    poses = stage.swarm((11.3 - gap, 2.1, 9.7), (-3.3, 7.9, 8.8), FAR, moving=False)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for epoch in (0.0, 0.1):
            paths = model.trace(poses, epoch, [("A", "P")]).paths["A", "P"]
    said = [str(w.message) for w in said if issubclass(w.category, ClearanceWarning)]
    assert len(said) == (gap < CLEARANCE)
    if said:
        assert said[0].startswith("A is") and "reflections" in said[0]
    else:
        truth = chain_length((((1, 0, 0), (11.3, 0, 0)),), poses["A"].position, poses["P"].position)
        assert C * specular(paths).delay == pytest.approx([float(truth)], abs=NANOMETRE)
    half = wall().of(np.array([True, False]))
    # in the wall's plane, beside the wall; and beyond the long side of half of it
    for city, place in ((wall(), (11.3, 33.0, 9.7)), (half, (11.3, -10.0, 25.0))):
        beyond = stage.swarm(place, (-3.3, 7.9, 8.8), FAR, moving=False)
        with warnings.catch_warnings():
            warnings.simplefilter("error", ClearanceWarning)
            stage.tracer(city, 1).trace(beyond, 0.0, [("A", "P")])


@pytest.mark.sionna
def test_inside_a_closed_building_nothing_gets_in_or_out():
    """Sionna is held to it."""
    city = load_city(tree.City(source="blocks", blocks_x=1, blocks_y=1), ".", 77e9, (0.0, 0.0, 5.0))
    inside, outside = (1.3, 2.1, 7.7), (33.1, 4.2, 8.8)
    assert len(found(city, inside, outside)) == 0
    assert len(found(city, outside, inside)) == 0
    both = found(city, inside, (-3.3, -4.1, 6.1), (7.7, 3.1, 9.9))
    assert both.counts()["line_of_sight"] == 1 and both.counts()["specular"] == 6


@pytest.mark.sionna
def test_a_wall_seen_edge_on_and_slivers():
    """From within its own plane a wall neither reflects nor shadows; triangles without area are
    taken out and counted. Written against: the area's limit taken to the first power of the
    length."""
    edge_on = stage.rectangle((5.0, -20, 0), (0.0, 15, 0), (0, 0, 30), CONCRETE)
    paths = found(edge_on, (5.0, -31.0, 9.7), (5.0, 17.0, 8.8))
    assert paths.counts()["specular"] == 0
    flat = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 3, 0], [1, 1e-13, 0]], float)
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 0, 3]])
    _, kept, _, notes, _ = clean(
        [Surface(flat, faces, MaterialUse("concrete"))], "slivers", np.zeros(3), None
    )
    assert len(kept) == 1 and "3 faces without area removed" in notes


@pytest.mark.sionna
@pytest.mark.parametrize("apart", [0.0, 5e-8, 5e-4])
def test_coincident_walls_reflect_once_or_twice_but_never_more(apart):
    """Two sheets of different triangles in one place are one mirror; half a millimetre apart the
    nearer one is what is seen."""
    one = wall()
    other = np.array(
        [[11.3, -20, 0], [11.3, 20, 0], [11.3, 20, 30], [11.3, -20, 30], [11.3, 1, 14]]
    ) + np.array([apart, 0, 0])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], np.int32)
    mesh = CityMesh(
        "twice",
        np.concatenate([one.vertices, other]),
        np.concatenate([one.faces, faces + 4]).astype(np.int32),
        np.zeros(6, np.int16),
        (CONCRETE,),
        np.zeros(3),
    )
    a, p = (-4.4, 2.1, 9.7), (-3.3, 7.9, 8.8)
    paths = specular(found(mesh, a, p))
    truth = float(chain_length((((1, 0, 0), (11.3, 0, 0)),), np.array(a), np.array(p)))
    assert len(paths) == 1
    assert C * paths.delay[0] == pytest.approx(
        truth, abs=1e-7 if apart < 1e-6 else 2 * apart + NANOMETRE
    )


@pytest.mark.sionna
def test_sheets_that_share_an_edge():
    """A non-manifold mesh: three walls in one edge. Each one that is seen reflects once."""
    points = np.array(
        [
            [8, 0, 0],
            [8, 0, 30],
            [8, 25, 0],
            [8, 25, 30],
            [30, 0, 0],
            [30, 0, 30],
            [8, -25, 0],
            [8, -25, 30],
        ],
        float,
    )
    faces = np.array([[0, 1, 2], [1, 3, 2], [0, 4, 1], [1, 4, 5], [0, 6, 1], [1, 6, 7]], np.int32)
    mesh = CityMesh("fan", points, faces, np.zeros(6, np.int16), (CONCRETE,), np.zeros(3))
    a, p = (-4.4, 2.1, 9.7), (-3.3, 7.9, 8.8)
    paths = specular(found(mesh, a, p))
    assert C * paths.delay == pytest.approx(
        [float(chain_length((((1, 0, 0), (8, 0, 0)),), np.array(a), np.array(p)))], abs=NANOMETRE
    )


@pytest.mark.sionna
def test_a_target_on_the_ground():
    """On the ground itself there is a warning; two centimetres over it the echo and the one ghost
    per segment, to a nanometre."""
    a, p, u = (0.3, 1.1, 9.3), (21.7, 7.4, 8.1), (11.3, -2.2, 0.02)
    paths = found(GROUND, a, p, u, bounces=1)
    paths = paths.select(paths.target == 2)
    below = np.array(u) * [1, 1, -1]
    truth = sorted(
        [
            np.linalg.norm(np.subtract(a, x)) + np.linalg.norm(np.subtract(p, y))
            for x, y in ((u, u), (below, u), (u, below))
        ]
    )
    assert np.sort(C * paths.delay) == pytest.approx(truth, abs=NANOMETRE)
    with pytest.warns(ClearanceWarning, match="U is 0.000 m"):
        found(GROUND, a, p, (11.3, -2.2, 0.0))


@pytest.mark.sionna
def test_a_target_behind_another_and_a_body_in_the_way():
    """Both echoes are there, and the line of sight too, weakened by the Fresnel shadow of the body
    in its way; a body without a radius is transparent."""
    a, behind = np.array([0.3, 1.1, 9.3]), np.array([21.7, 7.4, 8.1])
    paths = found(GROUND, a, behind, a + 0.4 * (behind - a), bounces=0)
    assert paths.counts()["line_of_sight"] == 1 and paths.counts()["target"] == 1
    sight = (
        np.abs(paths.gain[paths.kind == PathKind.LINE_OF_SIGHT])[0]
        * 4
        * np.pi
        * np.linalg.norm(behind - a)
        / WAVELENGTH
    )
    assert 0.0 < sight < 1.1
    clear = {"swarm": {"U": {"role": "target", "position_m": [2, 0, 0], "body_radius_m": 0.0}}}
    through = (
        stage.tracer(GROUND, 0, **clear)
        .trace(stage.swarm(a, behind, a + 0.4 * (behind - a), False), 0.0, [("A", "P")])
        .paths["A", "P"]
    )
    sight = np.abs(through.gain[through.kind == PathKind.LINE_OF_SIGHT])
    assert sight == pytest.approx(
        [WAVELENGTH / (4 * np.pi * np.linalg.norm(behind - a))], rel=1e-6, abs=0
    )
    own = found(
        GROUND, a, a + 0.8 * (behind - a), a + 0.4 * (behind - a), bounces=0, link=("A", "A")
    )
    assert own.counts()["target"] == 2


@pytest.mark.sionna
def test_a_target_inside_the_radars_own_body():
    """7 cm from the radar, whose body reaches to 20 cm: the echo of the radar equation and its two
    ghosts under the ground, to a nanometre, for a radar does not shadow itself. Sionna loses
    everything inside such a body, and what is nearer than a centimetre. Written against: segments
    of less than a decimetre dropped."""
    a, u = np.array([0.3, 1.1, 9.3]), np.array([0.34, 1.15, 9.27])
    paths = found(GROUND, a, (21.7, 7.4, 8.1), u, link=("A", "A"))
    echoes = paths.select(paths.target == 2)
    straight, below = np.linalg.norm(u - a), np.linalg.norm(u * [1, 1, -1] - a)
    order = np.argsort(echoes.delay)
    assert C * echoes.delay[order] == pytest.approx(
        [2 * straight, straight + below, straight + below], abs=NANOMETRE
    )
    section = 10 ** (-11.7 / 10)
    level = WAVELENGTH * np.sqrt(section) / ((4 * np.pi) ** 1.5 * straight**2)
    assert abs(echoes.gain[order[0]]) == pytest.approx(
        level, rel=1e-5, abs=0
    )  # Sionna's amplitudes are float32


def flight(**places) -> Scenario:
    roles = {"A": "active", "P": "passive", "U": "target"}
    swarm = {
        n: {"role": roles[n], "position_m": list(p), "velocity_mps": list(v)}
        for n, (p, v) in places.items()
    }
    return Scenario.model_validate({"swarm": swarm, "frames": 50, "frame_interval_s": 0.1})


def test_two_bodies_at_one_point_are_refused_before_the_run():
    """At the start by the scenario, later on by the check of the flights, with the time and the
    frame. Written against: only the start."""
    with pytest.raises(ValueError, match=r"at least 0\.05 m are needed"):
        flight(A=((0, 0, 9), (0, 0, 0)), U=((0, 0.01, 9), (0, 0, 0)))
    meeting = flight(A=((0, 0, 9), (0, 0, 0)), U=((0, 20, 9), (0, -10.0, 0)))
    with pytest.raises(ScenarioError, match=r"swarm\.U: .* from A at 2\.\d* s \(frame (19|20)\)"):
        prepare(meeting)
    passing = flight(A=((0, 0, 9), (0, 0, 0)), U=((0.3, 20, 9), (0, -10.0, 0)))
    w = waveform_of(passing.radio, passing.array)
    check_flights(swarm_of(passing), timetable_of(passing, w, np.zeros((3, 120), int)))


def aliases(s):
    """What is said of a scenario's velocities."""
    w = waveform_of(s.radio, s.array)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_aliases(
            swarm_of(s),
            timetable_of(s, w, np.zeros((3, 120), int)),
            Arrays(antennas_of(s.array, w)),
            s.receivers.velocity_method,
            s.array.schedule,
        )
    return [str(one.message) for one in said]


def test_velocities_that_alias_are_warned_of_before_the_run():
    """An echo at 17 m/s is shown at 17 less the period; as a line of sight it is below the limit of
    one way, and out of view nothing is said. Planted bugs: the limit of one way for echoes; the
    field of view left out."""
    for v, way, expected in (
        (17.0, 1, ["the echo of U at A"]),
        (31.0, 1, ["the echo of U at A"]),
        (17.0, -1, []),
        (14.0, 1, []),
    ):
        s = flight(A=((0, 0, 9), (0, 0, 0)), U=((0, way * 20, 9), (0, way * v, 0)))
        w, said = waveform_of(s.radio, s.array), aliases(s)
        assert [text.split(" moves")[0] for text in said] == expected
        if expected:
            shown = (v + w.max_velocity(2)) % (2 * w.max_velocity(2)) - w.max_velocity(2)
            assert f"moves at {v:g} m/s" in said[0] and f"about {shown:.3g} m/s" in said[0]
    s = flight(A=((0, 0, 9), (0, 0, 0)), U=((0, 20, 9), (0, 17.0, 0)))
    with pytest.warns(ScenarioWarning, match="unambiguous"):
        prepare(s)


def test_a_flight_beyond_all_bounds_is_refused():
    lost = flight(A=((0, 0, 9), (0, 0, 0)), U=((0, 2e13, 9), (0, 7.0, 0)))
    with pytest.raises(ScenarioError, match="beyond all bounds"):
        prepare(lost)


def test_a_path_without_length_is_not_a_number_and_refused():
    """Zero-length segments reach no signal: a path set with a NaN cannot be made."""
    here = stage.pose((1.0, 2.0, 3.0))
    with np.errstate(all="ignore"):
        segments = unfold(np.zeros((1, 0, 3)), np.zeros((1, 0)), here, here)
    assert segments.length[0] == 0 and not np.isfinite(segments.rate).all()
    from isac_rt.propagation.pathset import make_paths

    with pytest.raises(ValueError, match="not finite"):
        make_paths(
            gain=np.array([np.inf]),
            delay=np.zeros(1),
            delay_rate=segments.rate,
            departure=segments.departure,
            arrival=segments.arrival,
            kind=PathKind.LINE_OF_SIGHT,
            epoch=0.0,
            tx="A",
            rx="P",
        )


@pytest.mark.sionna
def test_a_vertical_link_with_vertical_polarisation():
    """Exactly upright Sionna's line of sight has the opposite sign, at the pole of its
    polarisation; ours has not. Written against: the amplitude taken as Sionna gives it."""
    for x in (0.0, 0.013):
        paths = found(GROUND, (0, 0, 9.1), (x, 0, 31.3), bounces=0)
        gain = paths.gain[paths.kind == PathKind.LINE_OF_SIGHT]
        assert gain == pytest.approx(
            [WAVELENGTH / (4 * np.pi * np.hypot(22.2, x))], rel=1e-6, abs=0
        )


@pytest.mark.sionna
def test_no_path_at_all():
    """Two terminals in two closed rooms: an empty set, an empty cube, and an empty reception."""
    city = load_city(tree.City(source="blocks", blocks_x=2, blocks_y=1), ".", 77e9, (0.0, 0.0, 5.0))
    paths = found(city, (-30.0, 1.0, 7.7), (30.0, 1.0, 7.7), (30.0, 30.0, 50.0), bounces=2)
    assert len(paths) == 0
    w = stage.SMALL
    sender = stage.sender(w, np.random.default_rng(1))
    paths = replace(paths, epoch=w.frame_duration / 2)
    samples = stage.synthesise(
        w, [(sender, paths)], stage.pose((0, 0, 0)), Auto(), 0.0, stage.arrays(w)
    )
    assert samples.shape[0] == 3 and not samples.any()


def crossing() -> Scenario:
    """P comes out of the shadow of the left row of a street canyon into the street."""
    return Scenario.model_validate(
        {
            "frames": 60,
            "frame_interval_s": 0.02,
            "receiver_preset": "plain",
            "city": {
                "source": "canyon",
                "street_width_m": 22,
                "street_length_m": 60,
                "building_height_m": 18,
                "block_size_m": 60,
            },
            "swarm": {
                "A": {"role": "active", "position_m": [0.4, -3.0, 9.0], "boresight": [0, 1, 0]},
                "P": {
                    "role": "passive",
                    "position_m": [-16.3, 41.1, 9.4],
                    "velocity_mps": [11.3, 0.0, 0.0],
                    "boresight": [0, -1, 0],
                },
                "U": {"role": "target", "position_m": [2.0, 12.0, 8.0]},
            },
            "array": {"element_pattern": "isotropic", "element_gain_dbi": 0.0},
            "propagation": {"model": "ray_traced", "max_bounces": 1, "leakage": {"enabled": False}},
        }
    )


@pytest.mark.sionna
def test_a_shadow_edge_is_crossed_within_a_frame():
    """The line of sight fades in round the edge of a row of houses: a knife edge leaves half of the
    amplitude on the edge itself, less in its shadow and more in the light, whichever frame is
    computed. The state at the middle of a frame stands for the whole frame."""
    s = crossing()
    setup = prepare(s)
    corner = np.array([-11.0, 30.0])  # of the left row of buildings
    levels: list[float] = []
    for frame in range(1, 14):
        sent = setup.frame(frame)
        poses, paths = sent.poses, sent.paths
        a, p = poses["A"].position, poses["P"].position
        lit = bool(np.cross([*(corner - a[:2]), 0], [*(p[:2] - a[:2]), 0])[2] < 0)
        direct = paths["A", "P"].select(paths["A", "P"].kind == PathKind.LINE_OF_SIGHT)
        share = np.abs(direct.gain).sum() * 4 * np.pi * np.linalg.norm(p - a) / WAVELENGTH
        assert (share > 0.5) == lit, (frame, share)
        levels.append(share)
        assert np.isinf(paths["A", "P"].begin).all()
    assert levels[0] < 0.1 and abs(levels[-1] - 1) < 0.3 and (np.diff(levels[:6]) > 0).all()


@pytest.mark.sionna
def test_reflections_are_born_and_die_between_traces():
    """P flies out of a street: the reflections of its two walls last as long as their mirror points
    lie on the walls, by hand, at the middle of each frame; no frame knows which ones were computed
    before it. Written against: the paths of the frame before."""
    s = crossing()
    swarm = {
        "P": s.swarm["P"].model_copy(
            update={"position_m": (-2.7, 47.3, 9.4), "velocity_mps": (0.0, 13.1, 0.0)}
        )
    }
    s = s.model_copy(
        update={"swarm": {**s.swarm, **swarm}, "frame_interval_s": 0.2887, "frames": 9}
    )
    setup, kept = prepare(s), {}
    for frame in range(9):
        sent = setup.frame(frame)
        poses, paths = sent.poses, sent.paths
        a, p = poses["A"].position, poses["P"].position
        truth = [np.hypot(np.linalg.norm((p - a)[:2]), p[2] + a[2])]  # off the ground
        for wall in (-11.0, 11.0):
            there = abs(wall - a[0]) / (abs(wall - a[0]) + abs(wall - p[0]))
            if a[1] + there * (p[1] - a[1]) < 30.0:
                truth.append(np.linalg.norm([2 * wall - a[0] - p[0], *(p - a)[1:]]))
        kept[frame] = np.sort(C * specular(paths["A", "P"]).delay)
        assert kept[frame] == pytest.approx(np.sort(truth), abs=NANOMETRE), frame
    assert {len(lengths) for lengths in kept.values()} == {1, 2, 3}
    assert np.array_equal(np.sort(C * specular(prepare(s).frame(2).paths["A", "P"]).delay), kept[2])


@pytest.mark.sionna
@pytest.mark.parametrize("far", [1e5, 1e6])
def test_far_from_the_origin(far):
    """A wall and a swarm 1e5 m and 1e6 m away have the paths of the same scene at the origin, as
    well as float64 holds such places."""
    shift = far * np.array([0.71, -0.69, 0.0])
    here = [np.array(v) for v in ((0.3, 1.1, 9.3), (1.7, 7.4, 8.1), (-3.3, -2.2, 7.9))]
    lengths = []
    for origin in (np.zeros(3), shift):
        city = stage.rectangle(
            origin + np.array([11.3, -20, 0]), (0, 40, 0), (0, 0, 30), CONCRETE, origin
        )
        paths = found(city, *(v + origin for v in here), bounces=1)
        lengths.append(C * np.sort(paths.delay))
    assert lengths[0].size > 3
    assert lengths[1] == pytest.approx(lengths[0], abs=30 * np.spacing(far))
