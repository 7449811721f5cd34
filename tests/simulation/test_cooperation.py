"""Terminals that tell each other what they see, in whole runs in open space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import betaln
from talking import scenario
from test_resume import Stopped, assert_equal_results, stopping_at

from isac_rt.extensions.cooperation.swarm import CHANCE, Cooperation, Record
from isac_rt.frame.access import Access
from isac_rt.frame.link import Link
from isac_rt.frame.settings import Array, Noise
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections, no_detections
from isac_rt.results.dataset import fused_positions
from isac_rt.results.provenance import run_content
from isac_rt.results.swarm import SWARM
from isac_rt.scenario.file import load
from isac_rt.scenario.presets import ReceiverSet
from isac_rt.simulation import simulate
from isac_rt.simulation.resume import Resume
from isac_rt.simulation.setup import prepare
from isac_rt.simulation.stations import standard_terminal
from isac_rt.track.filter import Gaussian, measure
from isac_rt.track.fused import Fused, Key, Name
from isac_rt.track.settings import Tracking
from isac_rt.views.animate import animate
from isac_rt.views.scene import moving_scene
from isac_rt.views.tables import swarm_table
from isac_rt.world.city.mesh import CityMesh

SCENES = Path(__file__).parents[2] / "scenes"


@pytest.fixture(scope="module")
def talked():
    return simulate.run(scenario(), snapshots=2)


def test_nothing_else_of_a_run_depends_on_what_is_told(talked):
    """The same bits. Planted bug: a picture's track that updates a terminal's tracker."""
    alone = simulate.run(scenario(cooperation="none"), snapshots=2)
    for name, variable in alone.dataset.variables.items():
        kind = variable.dtype.kind == "f"
        assert np.array_equal(talked.dataset[name].values, variable.values, equal_nan=kind), name
    for key in ("terminals", "links", "paths"):
        assert talked.summary[key] == alone.summary[key]
    assert alone.summary["swarm"] is None


def one_body_in_all_pictures(d):
    """The last frame's rows (bool), in which every picture has the target once, of two terminals
    and under one name, and nothing else that is no terminal."""
    last = d.fused_frame.values == 8
    names = set()
    for p in range(d.sizes["owner"]):
        mine = last & (d.fused_owner.values == p)
        (k,) = np.flatnonzero(mine & (d.fused_uav.values == 2))
        assert d.fused_members.values[k] == 2
        names.add((int(d.fused_origin.values[k]), int(d.fused_number.values[k])))
        assert (mine & (d.fused_terminal.values < 0)).sum() == 1
    assert len(names) == 1
    return last


def test_who_hears_what_and_when(talked):
    """Three detections confirm a track, so frame 2 is the first after which there is something to
    tell; it leaves with frame 3 and is in the other's picture from there on, a frame old. The AT
    follows the PT and the target: 64 + 136 + 320 + 2 x (16 + 160) = 872 bits. A frame holds 3 (60 x
    7 + 57 x 3) = 1773 bits, half of them for messages. The feedback has 1000 bits a frame and one
    track to tell. Planted bugs: a message that arrives with the frame it is made after; a code that
    costs nothing."""
    d = talked.dataset
    for name, count in {"AT": 1, "PT": 2}.items():
        p = list(d.owner.values).index(name)
        assert d.fused_reports.values[:, p].tolist() == [0] * 3 + [count] * 6
        assert np.allclose(d.fused_age.values[3:, p], 0.02)


def test_the_target_is_one_body_of_two_tracks_and_the_terminals_are_none(talked):
    """In the last frame every picture has the target once, of both terminals' tracks, under one
    name, and the PT's echo at the AT is recognised by what the PT says of itself."""
    d = talked.dataset
    last = one_body_in_all_pictures(d)
    assert (d.fused_terminal.values[last] == 1).any()
    swarm = talked.summary["swarm"]
    assert swarm["targets"].keys() == {"U"}
    assert swarm["targets"]["U"]["switches"] == 0
    assert swarm["terminals"]["PT"]["messages_lost"] == 0


def test_a_slow_feedback_makes_the_picture_old():
    """1 kbit/s is 20 bits a frame: a message of a track and a terminal, 640 bits and more, takes
    over 31 frames, so that the AT hears nothing in nine, while the PT hears as before."""
    swarm = simulate.run(scenario(access=Access(feedback_rate_bps=1e3))).summary["swarm"]
    assert swarm["terminals"]["AT"]["messages"] == 0
    assert swarm["terminals"]["PT"]["messages"] > 3


def test_a_terminal_that_does_not_decode_hears_nothing():
    """The PT looks away: it acquires nobody. Its messages, and those to it, are lost: the AT's
    receiver never knows where the PT is. Planted bug: terminals' poses as if they were heard."""
    deaf = scenario().swarm["PT"].model_copy(update={"boresight": (0, 1, 0)})
    swarm = {**scenario().swarm, "PT": deaf}
    known: dict = {}
    results = simulate.run(scenario(swarm=swarm, frames=6), terminal=noting(known))
    received = results.summary["swarm"]["terminals"]
    for name in ("AT", "PT"):
        assert received[name]["messages"] == received[name]["messages_lost"] > 0
        assert received[name]["reports_per_frame"] == 0
    assert len(known["AT->AT"]) == 6
    assert not [b for by_frame in known.values() for uavs in by_frame for b in uavs if b.terminal]


def test_a_stopped_run_goes_on_to_the_same_pictures(tmp_path):
    """Also of a set that is compared. Planted bugs: the channels, the names or what fed the tracks
    not taken up."""
    other = {"other": ReceiverSet(receivers=Receivers(), tracking=Tracking(confirm_hits=2))}
    flight = scenario(frames=7, compare=other)
    whole = simulate.run(flight, snapshots=2)
    for stop in (3, 5, None):
        resume = Resume(tmp_path, run_content(flight, 2), every=0.0)
        try:
            again = simulate.run(flight, snapshots=2, resume=resume, progress=stopping_at(stop))
        except Stopped:
            continue
    assert_equal_results(again, whole)
    assert whole.summary["compared"]["other"]["swarm"] != whole.summary["swarm"]


def test_the_report_and_the_moving_picture_show_the_pictures(talked):
    table = swarm_table(talked.summary)
    assert [row[0] for row in table.rows] == ["Whole swarm", "AT", "PT"]
    assert table.rows[2][-1].startswith("0 of ")
    traffic = talked.summary["swarm"]["terminals"]["PT"]
    assert table.rows[2][-3] == str(traffic["left_out"]) == "0"
    assert traffic["bits"] < traffic["bits_capacity"] == 886 * 7
    d = talked.dataset
    corners, faces = np.eye(3), np.array([[0, 1, 2]])
    roof = CityMesh("roof", corners, faces, np.zeros(1, np.int16), (), np.zeros(3))
    scene = moving_scene(d, roof)
    for name in ("AT", "PT", SWARM):
        (found,) = fused_positions(d, 8, name)
        assert np.linalg.norm(found - d.uav_position.values[8, 2]) < 1.0
        uavs = {trace["name"]: trace for trace in scene["frames"][8]["data"]}
        shown = uavs["fused tracks of the swarm" if name == SWARM else f"fused tracks of {name}"]
        assert [shown[a] for a in "xyz"] == np.round(found, 2)[:, None].tolist()
    alone = d.drop_vars([name for name in d.variables if name == "owner"])
    assert fused_positions(alone, 8, SWARM).shape == (0, 3)
    figure, moving = animate(talked, 0)
    moving._func(1)
    marks = {line.get_label(): line.get_xdata() for line in figure.axes[0].lines}
    here = d.uav_position.values[int(d.snapshot_frame.values[1]), 2, 0]
    assert marks["fused tracks, swarm"] == pytest.approx([here], abs=1.0)
    assert marks["fused tracks"] == pytest.approx([here], abs=1.0)


@pytest.mark.parametrize(
    ("place", "expected", "change"),
    [
        ((9.0, 15.0, 51.0), True, {}),
        ((9.0, -15.0, 51.0), False, {}),  # behind the AT
        ((9.0, 15.0, 51.0), False, {"array": Array(rx_x=6, rx_z=6, field_of_view_deg=20.0)}),
        ((9.0, 15.0, 51.0), False, {"noise": Noise(model="snr", snr_db=-75)}),
    ],
)
def test_where_an_active_terminal_should_detect_a_uav(place, expected, change):
    """Where the AT looks, outside its view, or too weak for it. Bugs: the field of view left out;
    noise of any strength."""
    exchange = Cooperation(prepare(scenario(**change)))
    poses = exchange._setup.swarm.poses(0.05)
    found = exchange._detection_probability(Link("AT", "AT"), np.array(place), 3, poses)
    assert (found > 0.9) is expected and (found < 0.1) is not expected


def test_a_wall_hides_a_uav_from_an_active_terminal():
    """Before and behind a house of the AT's mesh. Bug: occlusion left out."""
    exchange = Cooperation(prepare(load(SCENES / "street_canyon.yaml", ["cooperation=tracks"])))
    poses = exchange._setup.swarm.poses(0.1)
    link = exchange._setup.timetable.links(3)[0]
    assert link.own
    for place, seen in (((-5.0, 5.0, 10.0), True), ((-15.0, 5.0, 10.0), False)):
        found = exchange._detection_probability(link, np.array(place), 3, poses)
        assert (found > 0.9) is seen


def test_odds_are_the_ratio_of_the_likelihoods_of_a_whole_record():
    """Two hits in twelve frames with a probability of detection of which all is possible alike:
    the Beta function B(3, 11), against `CHANCE` for each frame by itself. Planted bugs: the record
    after the frame in place of before; a miss without its share of chance."""
    record = Record()
    for frame in range(12):
        record = record.after(1.0, frame in (2, 5))
    chance = 2 * np.log(CHANCE) + 10 * np.log(1 - CHANCE)
    assert record.odds == pytest.approx(betaln(3, 11) - chance)
    missed = Record().after(0.5, False)
    assert missed.odds == pytest.approx(np.log(0.75 / (1 - CHANCE)))
    assert (record.hits, record.frames) == (2, 12)


def test_what_the_at_should_see_and_has_not_is_no_uav():
    """A UAV of the PT alone 6 m beside the target: the AT detects nothing there and it goes, until
    it is detected, also in a frame that the AT skips; with a track of the AT's, or as a terminal,
    it stays. Planted bugs: detections of the target beside it taken for its own; links of passive
    terminals asked; records forgotten in a frame without the AT's echoes."""
    exchange = Cooperation(prepare(scenario()))
    step = exchange._existing
    poses = exchange._setup.swarm.poses(0.05)
    of_pt, of_at = Key("AT->PT", 4), Key("AT->AT", 2)
    state = Gaussian(np.array([9.0, 19.0, 51.0, 0.0, 0, 0]), 0.01 * np.eye(6))
    alone = Fused(Name(0.0, *of_pt), state, (of_pt,))
    empty = SimpleNamespace(reception=SimpleNamespace(detections=no_detections()))
    frame = {Link("AT", "AT"): empty, Link("AT", "PT"): empty}
    assert step([alone], 3, poses, frame) == ()
    assert step([alone], 4, poses, {Link("AT", "PT"): empty}) == ()
    for kept in (replace(alone, members=(of_pt, of_at)), replace(alone, terminal="PT")):
        exchange.state.records.clear()
        assert step([kept], 3, poses, frame) == (kept,)
    z = measure(state.mean, exchange._setup.believed("AT", poses["AT"]))[None]
    one = Detections(
        range=z[:, 0],
        velocity=z[:, 1],
        direction=z[:, 2:],
        snr=np.array([99.0]),
        std=np.array([[0.1, 0.1, 0.01, 0.01]]),
        is_reference=np.zeros(1, bool),
        starts=np.ones(1, bool),
    )
    seen = SimpleNamespace(reception=SimpleNamespace(detections=one))
    exchange.state.records.clear()
    assert step([alone], 3, poses, {Link("AT", "AT"): seen}) == (alone,)
    sharper = Fused(Name(0.0, *of_at), state._replace(covariance=1e-4 * np.eye(6)), (of_at,))
    exchange.state.records.clear()
    assert step([alone, sharper], 3, poses, {Link("AT", "AT"): seen}) == (sharper,)


def test_what_no_active_terminal_lights_is_no_uav():
    """UAVs of the PT alone beside the target and behind the AT, in a frame that the AT skips: the
    second is none, unless the AT tracks it too or it is a terminal. Planted bugs: only links that
    received asked; tracks of the AT's asked; terminals asked."""
    exchange = Cooperation(prepare(scenario()))
    poses, skipped = exchange._setup.swarm.poses(0.05), {Link("AT", "PT"): SimpleNamespace()}
    of_pt, of_at = Key("AT->PT", 4), Key("AT->AT", 2)
    before, behind = (Gaussian(np.array([9.0, y, 51.0, 0, 0, 0]), np.eye(6)) for y in (19.0, -15.0))
    lit = Fused(Name(0.0, *of_pt), before, (of_pt,))
    unlit = replace(lit, state=behind)
    assert exchange._existing([lit, unlit], 3, poses, skipped) == (lit,)
    for kept in (replace(unlit, members=(of_pt, of_at)), replace(unlit, terminal="PT")):
        assert exchange._existing([kept], 3, poses, skipped) == (kept,)


@pytest.mark.parametrize(("spread", "kept"), [(0.2, False), (3.0, True)])
def test_what_may_be_before_a_wall_may_be_lit(spread, kept):
    """A UAV of the PT alone 5 m within a house of the street, known well or not. Planted bugs: its
    place without what it may be off; walls that hide nothing."""
    exchange = Cooperation(prepare(load(SCENES / "street_canyon.yaml", ["cooperation=tracks"])))
    of_pt = Key("AT->PT1", 4)
    inside = Gaussian(np.array([-15.0, 5.0, 10.0, 0, 0, 0]), spread**2 * np.eye(6))
    uav = Fused(Name(0.0, *of_pt), inside, (of_pt,))
    poses, skipped = exchange._setup.swarm.poses(0.1), {Link("AT", "PT1"): SimpleNamespace()}
    assert exchange._existing([uav], 3, poses, skipped) == ((uav,) if kept else ())


def test_a_terminal_does_not_report_its_own_tracks_to_itself():
    """UAVs by its own tracks, by another's and by both; one that is a terminal. Planted bug: what
    it tracks alone comes back as a report."""
    exchange = Cooperation(prepare(scenario()))
    of_pt, of_at = Key("AT->PT", 4), Key("AT->AT", 2)
    states = [Gaussian(np.full(6, float(k)), np.eye(6)) for k in range(4)]
    members = (of_pt,), (of_at,), (of_pt, of_at), (of_at,)
    fused = [Fused(Name(0.0, *m[0]), g, m) for m, g in zip(members, states, strict=True)]
    fused[3] = replace(fused[3], terminal="PT")
    for name, told in (("PT", [1.0, 2.0]), ("AT", [0.0, 2.0])):
        heard = exchange._reported_uavs(Link("AT", name), SimpleNamespace(fused=fused), 0.0)
        assert [uav.state.mean[0] for uav in heard] == told


def noting(reports):
    """Makes standard terminals that put down by link what they are told."""

    def terminal(setup, link):
        made = standard_terminal(setup, link)
        step = made.step

        def noted(*given, **options):
            reports.setdefault(str(link), []).append(options["reports"])
            return step(*given, **options)

        made.step = noted
        return made

    return terminal


def test_terminals_are_told_of_everybody_but_themselves_and_their_transmitter(tmp_path):
    """Each link's receiver knows the target within 3 cm where it is by then (it flies 6 cm in two
    frames), no body within 3 m of the link's own ends, and other terminals once each. A run that is
    stopped and taken up tells the same. Planted bugs: states not brought to the frame's time; what
    is known not taken up; a terminal that a picture knows told of twice."""
    flight = scenario(frames=7)
    whole, resumed = {}, {}
    simulate.run(flight, snapshots=0, terminal=noting(whole))
    swarm = simulate.prepare(flight).swarm
    for link, reports in whole.items():
        assert len(reports) == flight.frames and not reports[0]
        poses = swarm.poses((flight.frames - 1) * flight.frame_interval_s)
        away = {
            n: [np.linalg.norm(uav.state.mean[:3] - p.position) for uav in reports[-1]]
            for n, p in poses.items()
        }
        assert min(away["U"]) < 0.03
        ends = set(link.split("->"))
        assert all(min(away[name]) > 3 for name in ends)
        assert [b.terminal for b in reports[-1] if b.terminal] == sorted({"AT", "PT"} - ends)

    def kept():
        return Resume(tmp_path, run_content(flight, 0), every=0.0)

    with pytest.raises(Stopped):
        simulate.run(flight, snapshots=0, resume=kept(), progress=stopping_at(4))
    simulate.run(flight, snapshots=0, resume=kept(), terminal=noting(resumed))
    for link, reports in resumed.items():
        assert 0 < len(reports) < flight.frames
        for again, before in zip(reports[::-1], whole[link][::-1], strict=False):
            assert [uav.terminal for uav in again] == [uav.terminal for uav in before]
            for one, other in zip(again, before, strict=True):
                assert np.array_equal(one.state.mean, other.state.mean)
                assert np.array_equal(one.state.covariance, other.state.covariance)
