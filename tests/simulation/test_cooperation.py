"""Terminals that tell each other what they see, in whole runs in open space."""

from __future__ import annotations

import numpy as np
import pytest
from talking import scenario
from test_resume import Stopped, assert_equal_results, stopping_at

from isac_rt.extensions.cooperation.swarm import scan_of
from isac_rt.frame.access import Access
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections, Reception
from isac_rt.results.dataset import fused_positions
from isac_rt.results.provenance import run_content
from isac_rt.results.scoring import LinkResult
from isac_rt.results.swarm import SWARM
from isac_rt.scenario.presets import ReceiverSet
from isac_rt.simulation import simulate
from isac_rt.simulation.resume import Resume
from isac_rt.simulation.stations import standard_terminal
from isac_rt.track.filter import Gaussian, measure
from isac_rt.track.settings import Tracking
from isac_rt.track.tracker import Track, track_set
from isac_rt.views.animate import animate
from isac_rt.views.scene import moving_scene
from isac_rt.views.tables import swarm_table
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose


@pytest.fixture(scope="module")
def talked():
    return simulate.run(scenario(), snapshots=2)


@pytest.fixture(scope="module")
def pooled():
    return simulate.run(scenario(cooperation="detections"), snapshots=2)


def test_nothing_else_of_a_run_depends_on_what_is_told(talked, pooled):
    """The same bits. Planted bug: a picture's track that updates a terminal's tracker."""
    alone = simulate.run(scenario(cooperation="none"), snapshots=2)
    for talking in (talked, pooled):
        for name, variable in alone.dataset.variables.items():
            kind = variable.dtype.kind == "f"
            assert np.array_equal(talking.dataset[name].values, variable.values, equal_nan=kind), (
                name
            )
        for key in ("terminals", "links", "paths"):
            assert talking.summary[key] == alone.summary[key]
    assert alone.summary["swarm"] is None


def test_detections_are_heard_as_the_links_carry_them(pooled):
    """The AT sends what its tentative tracks took from the first data frame on: those of frame 1
    leave with frame 2. A data frame has 886 bits: 64 + 136 for itself, 208, and for each of its two
    tracks 16 and 165; the newest frame's fit and no other's. The feedback has 1000. Planted
    bugs: what a pilot carries; bits of lost messages left out."""
    d, p = pooled.dataset, pooled.summary["swarm"]["terminals"]
    k = list(d.owner.values).index("PT")
    assert d.fused_capacity.values[:, k].tolist() == [0, 0] + [886] * 7
    assert d.fused_reports.values[:3, k].tolist()[:2] == [0, 0]
    assert (d.fused_reports.values[3:, k] > 0).all()
    assert (d.fused_bits.values[:, k] <= 886).all()
    assert p["PT"]["bits"] == d.fused_bits.values[:, k].sum()
    assert p["PT"]["bits_capacity"] == 886 * 7
    whole = d.fused_bits.values[3:, k] == 64 + 136 + 208 + 2 * (16 + 165)
    assert whole.sum() >= 4
    assert p["PT"]["left_out"] == d.fused_left_out.values[:, k].sum()


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


def test_the_target_is_one_body_in_all_pooled_pictures(pooled):
    """Of both terminals' detections, under one name, and nearer to the truth than the deviations
    stated allow for; the terminals are recognised."""
    one_body_in_all_pictures(pooled.dataset)
    swarm = pooled.summary["swarm"]
    assert swarm["targets"]["U"]["switches"] == 0
    assert swarm["rmse"]["position_m"] < 0.1 and swarm["nees"] < 1.5
    assert swarm["false_tracks_per_frame"] == 0


def test_who_hears_what_and_when(talked):
    """Three detections confirm a track, so frame 2 is the first after which there is something to
    tell; it leaves with frame 3 and is in the other's picture from there on, a frame old. The AT
    follows the PT and the target: 64 + 136 + 2 x 16 bits and 424 for each track. A frame holds
    3 (60 x 7 + 57 x 3) = 1773 bits, half of them for messages: one track, so that the two take
    turns, and their mean age is a frame and a half. The feedback has 1000 bits a frame and one
    track to tell. Planted bugs: a message that arrives with the frame it is made after; a code
    that costs nothing."""
    d = talked.dataset
    received = {"AT": ([1] * 6, [0.02] * 6), "PT": ([1, 2, 2, 2, 2, 2], [0.02] + [0.03] * 5)}
    for name, (count, age) in received.items():
        p = list(d.owner.values).index(name)
        assert d.fused_reports.values[:, p].tolist() == [0] * 3 + count
        assert np.allclose(d.fused_age.values[3:, p], age)


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


@pytest.mark.parametrize("cooperation", ["tracks", "detections"])
def test_a_stopped_run_goes_on_to_the_same_pictures(cooperation, tmp_path):
    """Also of a set that is compared. Planted bugs: the channels, the names or what fed the tracks
    not taken up."""
    other = {"other": ReceiverSet(receivers=Receivers(), tracking=Tracking(confirm_hits=2))}
    flight = scenario(frames=7, compare=other, cooperation=cooperation)
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
    assert table.rows[2][-3] == str(traffic["left_out"]) and traffic["left_out"] > 0
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


def test_a_reference_is_not_told_as_a_detection():
    """Of two tracks that a frame has fed, one is the transmitter's, which says itself where it is.
    Planted bug: all tracks are told."""
    own = Pose.at_rest((0.0, 0.0, 20.0), (0, 1, 0))
    states = [np.array([1.0, 20, 22, 0, 3, 0, 0, 0, 0]), np.array([9.0, 31, 24, 1, 2, 0, 0, 0, 0])]
    tracks = [
        Track(k, Gaussian(mean, np.eye(9)), 50.0, confirmed=True, detection=1 - k)
        for k, mean in enumerate(states)
    ]
    z = np.array([measure(mean, own) for mean in states[::-1]])
    found = Detections(
        range=z[:, 0],
        velocity=z[:, 1],
        direction=z[:, 2:],
        snr=np.full(2, 80.0),
        std=np.full((2, 4), 0.01),
        is_reference=np.zeros(2, bool),
        starts=np.ones(2, bool),
    )
    waveform = Waveform(num_samples=256)
    received = LinkResult(
        Reception.undecoded(waveform, found), track_set(tracks[:1], own, tracks[1]), 1
    )
    scan = scan_of(Link("AT", "PT1"), 3, 0.15, own, received, 0.0)
    assert scan.numbers.tolist() == [0] and scan.kept == (0,)
    np.testing.assert_allclose(scan.z, z[1:])


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
