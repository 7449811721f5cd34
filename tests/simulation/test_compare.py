"""Several sets of receivers on the same samples: each as in a run of its own, and none that
changes what the scenario's own receivers hear."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from test_fall_back import scenario as dense_scenario
from test_resume import SCENES, SMALL, Stopped, assert_equal_results, stopping_at

from isac_rt.results.losses import LOSSES
from isac_rt.results.provenance import run_content
from isac_rt.scenario.file import load
from isac_rt.simulation import simulate
from isac_rt.simulation.resume import Resume
from isac_rt.simulation.setup import prepare
from isac_rt.views.report import write_report
from isac_rt.views.tables import city_costs, side_by_side

SHORT = ["modulation.acquisition_frames=2", "receivers.active_every_frames=2", *SMALL]
SETS = [
    "compare.paper.preset=paper",
    "compare.beams={receivers: {symbol_decision: beams}, tracking: {confirm_hits: 2}}",
]


@pytest.fixture(scope="module")
def compared():
    return simulate.run(load(SCENES / "paper_swarm_consistent.yaml", SHORT + SETS, frames=5))


def test_the_own_receivers_hear_what_they_hear_alone(compared):
    """Rounding is none: the same bits. Planted bug: a listener's record in place of the own."""
    alone = simulate.run(load(SCENES / "paper_swarm_consistent.yaml", SHORT, frames=5))
    for name, variable in alone.dataset.variables.items():
        kind = variable.dtype.kind == "f"
        assert np.array_equal(compared.dataset[name].values, variable.values, equal_nan=kind), name
    for key in ("terminals", "links", "paths"):
        assert compared.summary[key] == alone.summary[key]
    assert alone.summary["compared"] == {}


def test_each_set_does_as_in_a_run_of_its_own(compared):
    """`paper` and `beams` by themselves give the same figures, which differ from the own ones.
    Planted bugs: a set with the own receivers' settings, one with the own trackers'."""
    scenario = compared.scenario
    for name, one in scenario.compare.items():
        own = {"receivers": one.receivers, "tracking": one.tracking, "compare": {}}
        alone = simulate.run(scenario.model_copy(update=own)).summary
        found = compared.summary["compared"][name]
        assert found == {key: alone[key] for key in ("terminals", "links", "swarm")}
        assert found["links"] != compared.summary["links"]


def test_every_frame_is_synthesised_once_for_all_sets(monkeypatch):
    scenario = load(SCENES / "paper_swarm_consistent.yaml", SHORT + SETS, frames=3)
    setup, heard = prepare(scenario), []
    frames = type(setup.frame(0))
    make = frames.received
    monkeypatch.setattr(
        frames, "received", lambda self, link: heard.append((self.number, link)) or make(self, link)
    )
    simulate.run(scenario, setup=setup)
    assert sorted(heard) == sorted((k, link) for k in range(3) for link in setup.timetable.links(k))


def test_listeners_give_no_advice():
    """By the union the own receivers judge no scene; those compared find it dense, and still the
    random schedule is sent. Planted bug: the advice of all sets is taken."""
    settings = {"receivers": {"velocity_method": "latin_union"}}
    omp = {"receivers": {"velocity_method": "omp"}}
    scenario = dense_scenario(frames=4, **settings, compare={"omp": omp})
    found = simulate.run(scenario)
    assert not found.dataset.fell_back.any() and (found.dataset.sparse == -1).all()
    advising = simulate.run(dense_scenario(frames=4, **omp))
    assert advising.dataset.fell_back.any()


def test_a_stopped_comparison_goes_on_to_the_same_bits(tmp_path):
    """Planted bugs: the listeners' terminals, scores or rows not taken up."""
    listeners = {"grid": {"receivers": {"refinement": "grid"}}}
    scenario = dense_scenario(frames=5, compare=listeners)
    whole = simulate.run(scenario, snapshots=1)
    content = run_content(scenario, 1)
    resume = Resume(tmp_path, content, every=0.0)
    with pytest.raises(Stopped):
        simulate.run(scenario, snapshots=1, progress=stopping_at(3), resume=resume)
    again = simulate.run(scenario, snapshots=1, resume=Resume(tmp_path, content, every=0.0))
    assert_equal_results(again, whole)


def test_the_report_shows_the_sets_side_by_side(compared, tmp_path):
    table = side_by_side(compared.summary)
    assert [row[:2] for row in table.rows[:4]] == [
        ("AT to AT", "own"),
        ("AT to AT", "paper"),
        ("AT to AT", "beams"),
        ("AT to PT1", "own"),
    ]
    page = write_report(compared, tmp_path, []).read_text()
    assert "Receivers on the same samples" in page
    costs = compared.summary["timing_s"]["by_set"]
    assert all(seconds > 0 for links in costs.values() for seconds in links.values())


def test_one_table_says_what_the_city_costs_each(compared, tmp_path):
    """By hand of a summary with numbers that are set: 30 of 40 found where noise alone would leave
    0.95; 0.2 + 0.1 + 0.4 false tracks of the city, those of noise not. Planted bugs: the own set's
    figures for all; the share of noise among the city's."""
    summary = json.loads(json.dumps(compared.summary))
    link = summary["compared"]["paper"]["links"]["AT->AT"]
    link["bounds"]["clutter_free"], link["hit_rate"], link["in_view"] = 0.95, 0.75, 40
    link["losses"] = dict.fromkeys(LOSSES, 1) | {"masked": 5, "clutter": 3}
    kinds = {"ghost": 0.2, "specular": 0.1, "diffuse": 0.4, "noise": 2.0}
    link["false_tracks"] = dict.fromkeys(link["false_tracks"], 0.0) | kinds
    table = city_costs(summary)
    row = next(r for r in table.rows if r[:2] == ("AT to AT", "paper"))
    found = dict(zip(table.columns, row, strict=True))
    assert (found["In view"], found["Found"], found["Noise only"]) == ("40", "0.75", "0.95")
    assert (found["City loss"], found["Masked"], found["Clutter"]) == ("0.2", "5", "3")
    assert found["False tracks of the city"] == "0.7"
    changed = dataclasses.replace(compared, summary=summary)
    assert "False tracks of the city" in write_report(changed, tmp_path, []).read_text()
    alone = {**compared.summary, "compared": {}, "timing_s": {"setup": 0.0}}
    assert not city_costs(alone).rows


def test_every_target_frame_in_view_has_one_cause(compared):
    """Causes add up to the target-frames in view and hits to those found: of every set, terminal,
    link and UAV, and frame by frame in the dataset. Planted bugs: a terminal's causes of its last
    link alone; a UAV behind a wall with a cause."""
    summary, d = compared.summary, compared.dataset
    for one in (summary, *summary["compared"].values()):
        for blocks in (one["terminals"], one["links"]):
            for b in blocks.values():
                found, in_view = b["counts"]["hit_rate"]
                assert sum(b["losses"].values()) == in_view
                assert b["losses"]["found"] == found
                of_uavs = b["targets"].values()
                for t in of_uavs:
                    assert sum(t["losses"].values()) == t["in_view"]
                    assert t["losses"]["found"] == t["found"]
                for cause in LOSSES:
                    assert sum(t["losses"][cause] for t in of_uavs) == b["losses"][cause]
    seen = d.in_view.values & ~d.occluded.values
    assert seen.any()
    assert ((d.loss.values >= 0) == seen).all()
    for i, link in enumerate(summary["links"].values()):
        counted = [int((d.loss.values[:, i] == k).sum()) for k in range(len(LOSSES))]
        assert counted == list(link["losses"].values())
