"""Pictures of the swarm held against truths made by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from isac_rt.frame.link import Link
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.pathset import PathKind
from isac_rt.results.dataset import read
from isac_rt.results.swarm import SWARM, SwarmScorer, Traffic, View, summary_of
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import timetable_of
from isac_rt.track.filter import Gaussian
from isac_rt.track.fused import Fused, Key, Name
from isac_rt.world.swarm import Pose

PLACES = {
    "AT": ("active", (0, 0, 50)),
    "PT": ("passive", (0, 60, 50)),
    "U1": ("target", (10, 30, 50)),
    "U2": ("target", (-10, 30, 50)),
    "U3": ("target", (0, -80, 50)),
}
SEEN = {
    Link("AT", "AT"): [0, 1, 1, 0, 0],
    Link("AT", "PT"): [1, 0, 0, 1, 0],
}
"""U1 by the AT, U2 by the PT, U3 by nobody; each other by both."""


SILENT = Traffic()


def scorer():
    swarm = {name: Uav(role=role, position_m=p) for name, (role, p) in PLACES.items()}
    scenario = Scenario(name="by_hand", frames=20, swarm=swarm)
    w = waveform_of(scenario.radio, scenario.array)
    schedule = conventional_schedule(w.num_groups, w.num_chirps, w.num_tx)
    return SwarmScorer(timetable_of(scenario, w, schedule))


def observers(fed):
    """Records of both links with tracks fed by (kind, target), by number."""
    out = {}
    for link, seen in SEEN.items():
        tracks = fed.get(str(link), {})
        table = np.array(list(tracks.values()), int).reshape(-1, 2)
        out[link] = SimpleNamespace(
            in_view=np.array(seen, bool),
            shadowed=np.zeros(5, bool),
            tracks=SimpleNamespace(
                id=np.array(list(tracks), int), kind=table[:, 0], target=table[:, 1]
            ),
        )
    return out


def body(number, place, terminal=None, origin="AT->AT"):
    mean = np.array([*place, 0.0, 0, 0], float)
    key = Key(origin, number)
    return Fused(
        Name(0.0, *key), Gaussian(mean, np.diag([0.04] * 3 + [0.25] * 3)), (key,), terminal
    )


def record(bodies, fed, ages=(), traffic=SILENT):
    poses = {name: Pose.at_rest(p) for name, (_, p) in PLACES.items()}
    found = scorer().record(
        0, {SWARM: View(0.1, tuple(bodies), ages, traffic)}, observers(fed), {SWARM: poses}
    )
    return found[SWARM]


ECHO = int(PathKind.TARGET)


def test_every_body_is_a_target_a_friend_hidden_or_false():
    """1 stands for U1, 0.6 m off; 2 is the PT, recognised, and 3 is it again, which is not; 4 is
    near U3, whom nobody sees; 5 is alone in the air: false. U2 is missed. GOSPA: 0.36 + 12.5 +
    12.5. Planted bugs: friends counted as found; the hidden one as false; the target of a link
    that did not see it left out."""
    bodies = [
        body(1, (10.6, 30, 50)),
        body(2, (0, 60, 50), terminal="PT"),
        body(3, (0, 61, 50)),
        body(4, (0, -79, 50)),
        body(5, (40, 40, 60)),
    ]
    r = record(bodies, {"AT->AT": {1: (ECHO, 2), 3: (ECHO, 1), 4: (ECHO, 4)}})
    assert r.seen.tolist() == [False, False, True, True, False]
    assert r.found.tolist() == [False, False, True, False, False]
    assert (r.false, r.hidden, r.unrecognised) == (1, 1, 1)
    assert r.gospa == pytest.approx([0.36, 12.5, 12.5])
    assert r.uav.tolist() == [2, -1, -1, -1, -1]
    assert r.terminal.tolist() == [-1, 1, -1, -1, -1]
    # 0.6 m with a deviation of 0.2 m on each of three axes: 9 / 3
    assert r.error[2] == pytest.approx([0.6, 0.0, 3.0])


def test_a_body_that_a_wall_feeds_is_not_found_where_it_lies_by_chance():
    """GOSPA has only places; found is by the path. Planted bug: the nearest body is the target."""
    r = record([body(1, (10.6, 30, 50))], {"AT->AT": {1: (int(PathKind.DIFFUSE), -1)}})
    assert not r.found.any()
    assert r.gospa == pytest.approx([0.36, 12.5, 0.0])


def test_what_a_link_saw_last_counts_until_it_receives_again():
    """The AT skips frame 1: U1 is still asked for, and its coasting track is no false one."""
    held, poses = scorer(), {n: Pose.at_rest(p) for n, (_, p) in PLACES.items()}
    every = observers({"AT->AT": {1: (ECHO, 2)}})
    view = {SWARM: View(0.1, (body(1, (10.6, 30, 50)),))}
    held.record(0, view, every, {SWARM: poses})
    again = scorer()
    again.restore(held.memory())
    for one in (held, again):
        r = one.record(1, view, {Link("AT", "PT"): every[Link("AT", "PT")]}, {SWARM: poses})[SWARM]
        assert r.found.tolist() == [False, False, True, False, False]
        assert r.false == 0


def test_figures_of_a_run_by_hand():
    """Three frames, U1 and U2 in view: both found, U1 alone under another name, none. Errors 0.6
    and 0.8 m, then 1.2 m."""
    fed = {"AT->AT": {1: (ECHO, 2), 7: (ECHO, 2)}, "AT->PT": {2: (ECHO, 3)}}
    frames = [
        record(
            [body(1, (10.6, 30, 50)), body(2, (-10, 30.8, 50), origin="AT->PT")],
            fed,
            (0.05, 0.15),
            Traffic(2, 1),
        ),
        record([body(7, (10, 30, 51.2)), body(8, (90, 0, 0))], fed, (0.4,), Traffic(1, 0)),
        record([], fed),
    ]
    tables = tuple(
        np.concatenate([read(kind, r, len(PLACES)) for r in frames])
        for kind in ("picture", "fused")
    )
    found = summary_of({SWARM: tables, "PT": tables}, list(PLACES))
    one = found["terminals"]["PT"]
    assert {k: v for k, v in found.items() if k != "terminals"} == one
    assert one["hit_rate"] == pytest.approx(3 / 6)
    assert one["rmse"]["position_m"] == pytest.approx(np.sqrt((0.36 + 0.64 + 1.44) / 3))
    assert one["nees"] == pytest.approx((0.36 + 0.64 + 1.44) / 0.04 / 3 / 3)
    parts = (0.36 + 0.64 + 1.44) / 3, 12.5 * 3 / 3, 12.5 / 3
    assert one["gospa"]["total_m"] == pytest.approx(np.sqrt(sum(parts)))
    assert one["gospa"]["missed"] == pytest.approx(1.0)
    assert one["gospa"]["false"] == pytest.approx(1 / 3) == one["false_tracks_per_frame"]
    assert one["gospa"]["empty_m"] == pytest.approx(5.0)
    assert one["age_s"] == pytest.approx(0.2)
    assert one["reports_per_frame"] == pytest.approx(1.0)
    assert (one["messages"], one["messages_lost"]) == (3, 1)
    assert one["targets"] == {
        "U1": {"in_view": 3, "found": 2, "switches": 1},
        "U2": {"in_view": 3, "found": 1, "switches": 0},
    }
    assert summary_of({}, list(PLACES)) is None
