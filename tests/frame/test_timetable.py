"""Roles, resource blocks, pilots, streams and the names of links."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from isac_rt.document import ScenarioWarning
from isac_rt.frame.link import Link
from isac_rt.frame.payload import demodulate_bits, random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.settings import Modulation, RoleChange
from isac_rt.frame.timetable import Timetable
from isac_rt.frame.waveform import Waveform, waveform_of
from isac_rt.receive.settings import Receivers
from isac_rt.scenario.file import load, to_yaml
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import timetable_of

AT, PT1, PT2 = (
    Uav(role=role, position_m=(3.1 * i, 7.7, 20.0))
    for i, role in enumerate(("active", "passive", "passive"))
)
SECOND = Uav(role="active", position_m=(-9.3, 1.2, 33.0))


def scenario_of(**changes) -> Scenario:
    """40 frames with a terminal AT and two that listen, changed by keywords."""
    return Scenario(**{"frames": 40, "swarm": {"AT": AT, "PT1": PT1, "PT2": PT2}} | changes)


def timetable(**changes) -> Timetable:
    """The frames of such a scenario."""
    scenario = scenario_of(**changes)
    w = waveform_of(scenario.radio, scenario.array)
    return timetable_of(
        scenario,
        w,
        pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, np.random.default_rng(5)),
    )


def test_one_transmitter_names_its_links_by_the_receiver():
    t = timetable()
    assert t.labels == {("AT", "AT"): "AT", ("AT", "PT1"): "PT1", ("AT", "PT2"): "PT2"}
    assert t.links(7) == [("AT", "AT"), ("AT", "PT1"), ("AT", "PT2")]
    assert t.roles_taken("PT1") == ["passive"]


def test_when_frames_begin():
    """Frame 7 of 0.05 s; the second transmitter 4 blocks of 2 T_d later, its middle half a frame
    after that. Planted bugs: blocks before the frame; the middle of the first block for all."""
    second = SECOND.model_copy(update={"resource_block": 4})
    swarm = {"AT": AT, "B": second, "PT1": PT1}
    t = timetable(swarm=swarm, frame_interval_s=0.05)
    later, half = 8 * t.waveform.max_delay, t.waveform.frame_duration / 2
    assert t.start_time(7) == t.start_time(7, "AT") == pytest.approx(0.35, abs=1e-15)
    assert t.start_time(7, "B") == pytest.approx(0.35 + later, abs=1e-15)
    assert t.epoch(7, "B") == pytest.approx(0.35 + later + half, abs=1e-15)
    assert t.epoch(7) == pytest.approx(0.35 + half, abs=1e-15)


def test_acquisition_frames_follow_the_beginning_and_each_change():
    """Three without data from frame 9 on, where a part of the run begins, and from the change in
    frame 20 on. Planted bugs: counted from frame 0; from the beginning where a change came
    after."""
    change = RoleChange(frame=20, from_uav="AT", to_uav="PT1")
    no_pilots = Modulation(pilot_every_frames=None)
    t = replace(timetable(role_changes=[change], modulation=no_pilots), begins=9)
    without = {9, 10, 11, 20, 21, 22}
    assert [t.modulated(f) for f in range(9, 40)] == [f not in without for f in range(9, 40)]


def test_snapshots_are_spread_from_the_first_to_the_last():
    """Of 12 frames of which every second is processed, 3 of them before the data: 4, 6, 8 and 10;
    halfway between 6 and 8 is rounded to even, the third of them.
    Planted bugs: the last left out; frames without data; more than asked for."""
    t = timetable(frames=12, receivers=Receivers(active_every_frames=2))
    chosen = {1: {4}, 2: {4, 10}, 3: {4, 8, 10}, 4: {4, 6, 8, 10}, 9: {4, 6, 8, 10}}
    assert {count: t.snapshots(count) for count in chosen} == chosen
    assert timetable(frames=12).snapshots(2) == {3, 11}


def test_a_change_of_roles():
    """From frame 17 on PT1 sends in the AT's blocks, first without data, and the AT listens.
    Planted bugs: the change one frame late; pilots counted from the start only."""
    t = timetable(
        role_changes=(RoleChange(frame=17, from_uav="AT", to_uav="PT1"),),
        modulation=Modulation(pilot_every_frames=25),
    )
    assert t.with_role("active", 16) == ["AT"] and t.with_role("active", 17) == ["PT1"]
    assert t.links(17) == [("PT1", "PT1"), ("PT1", "AT"), ("PT1", "PT2")]
    assert [f for f in range(40) if not t.modulated(f)] == [0, 1, 2, 17, 18, 19, 25]
    assert t.roles_taken("AT") == ["active", "passive"] and t.roles_taken("PT2") == ["passive"]
    assert t.first_block("PT1", 17) == t.first_block("AT", 16) == 0
    assert t.labels["PT1", "AT"] == "PT1->AT" and len(t.labels) == 6


def test_changes_streams_and_blocks_survive_a_file(tmp_path):
    """Planted bug: role_changes missing from the written file."""
    swarm = {"AT": AT.model_copy(update={"resource_block": 5}), "PT1": PT1}
    change = RoleChange(frame=17, from_uav="AT", to_uav="PT1")
    s = scenario_of(
        swarm=swarm, role_changes=(change,), modulation=Modulation(streams={"PT1": (2, 0)})
    )
    (tmp_path / "s.yaml").write_text(to_yaml(s))
    assert load(tmp_path / "s.yaml").model_dump() == s.model_dump()


def test_a_role_that_comes_back_is_the_same_link():
    changes = (
        RoleChange(frame=9, from_uav="AT", to_uav="PT1"),
        RoleChange(frame=23, from_uav="PT1", to_uav="AT"),
    )
    t = timetable(role_changes=changes)
    assert t.roles_taken("AT") == ["active", "passive", "active"]
    assert len(t.all_links) == 6


def test_resource_blocks_are_given_in_order_around_those_that_are_fixed():
    """Three groups each: 0..2 free, 4..6 taken by name, so the third goes to 7..9. Planted bug:
    only first blocks compared."""
    swarm = {
        "A": AT,
        "B": SECOND.model_copy(update={"resource_block": 4}),
        "C": Uav(role="active", position_m=(50.0, 0, 9)),
    }
    t = timetable(swarm=swarm | {"PT1": PT1})
    assert t.blocks == {"A": 0, "B": 4, "C": 7}
    assert t.links(0)[3:] == [("A", "PT1"), ("B", "PT1"), ("C", "PT1")]


def test_active_terminals_in_the_same_blocks_are_doubted(tmp_path):
    file = tmp_path / "s.yaml"
    file.write_text(
        "swarm:\n  A: {role: active, position_m: [0, 0, 9]}\n  B: {role: active, position_m: [9, "
        "0, 9], resource_block: 2}\n"
        "  C: {role: active, position_m: [19, 0, 9], resource_block: 4}\n"
    )
    with pytest.warns(ScenarioWarning, match="C and B send in the same resource blocks"):
        load(file)


def test_streams_hold_the_bits_of_their_groups():
    """Against the mapping of the symbols of these groups alone. Planted bug: the DPSK bits of all
    groups."""
    t = timetable(modulation=Modulation(streams={"PT1": (2, 0)}, dpsk_order=16))
    assert t.groups(Link("AT", "PT1")) == (0, 2)
    assert t.groups(Link("AT", "PT2")) is None and t.groups(Link("AT", "AT")) is None
    sent = t.payload("AT", 5)
    mine = [0, 2]
    assert np.array_equal(
        sent.bits_of(mine),
        demodulate_bits(sent.delay_symbols[mine], sent.transitions[mine], t.waveform, 16),
    )
    assert t.payload("AT", 1).bits_of(mine).size == 0


def test_payloads_differ_between_terminals_and_frames_and_repeat():
    t = timetable(swarm={"A": AT, "B": SECOND, "PT1": PT1})
    assert np.array_equal(t.payload("A", 7).bits, t.payload("A", 7).bits)
    assert not np.array_equal(t.payload("A", 7).bits, t.payload("B", 7).bits)
    assert not np.array_equal(t.payload("A", 7).bits, t.payload("A", 8).bits)


@pytest.mark.parametrize(("groups", "order"), [(1, 2), (2, 8), (3, 16)])
def test_all_groups_hold_all_bits(groups, order):
    w = Waveform(num_groups=groups)
    schedule = pseudo_random_schedule(groups, w.num_chirps, w.num_tx, np.random.default_rng(1))
    sent = random_payload(w, schedule, order, np.random.default_rng(2))
    assert np.array_equal(sent.bits_of(range(groups)), sent.bits)


def test_a_swarm_with_more_transmitters_than_blocks_is_refused():
    swarm = {f"A{i}": Uav(role="active", position_m=(11.0 * i, 0, 9)) for i in range(7)}
    with pytest.raises(
        ValueError, match="A6 would need the resource blocks 18 to 20; a slot has 19"
    ):
        Scenario(swarm=swarm, radio=Radio())
