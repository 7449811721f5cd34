"""Goals over folders of scenes: numbers by hand, a flight from file to table, drawn scenes."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import yaml

from isac_rt.cli.cli import main
from isac_rt.propagation.pathset import PathKind
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import trace
from isac_rt.sweep.execute import run_job
from isac_rt.sweep.outcomes import Outcomes, pending
from reproduce import SCENES, flights, flights_drawn
from reproduce.city_flights import FlightJob
from reproduce.flights import GOALS, Goal


def block(role, found, tracked, bound=1.0, gospa=(1.0, 4.0)):
    of_gospa = dict(zip(("total_m", "no_tracks_m"), gospa, strict=True))
    counts = {"hit_rate": [round(40 * found), 40], "tracked_rate": [tracked, 40]}
    about = {"role": role, "counts": counts, "bounds": {flights.BOUND: bound}, "gospa": of_gospa}
    return {**about, "tracked_rate": tracked / 40, "false_tracks_per_frame": 0.1}


def test_goals_by_hand():
    """Scenes a, b with two seeds. Tracked over found: a 0.9, 1.0, b 0.5, 0.7: per seed 0.7, 0.85.
    Student's t of 1 degree of freedom: 12.706 s / sqrt(2). Planted bug: the interval over
    scenes instead of seeds."""
    tracked = {"a": (18, 20), "b": (10, 14)}
    found = {
        scene: [
            {"terminals": {"AT": block("active", 0.5, n), "PT": block(["passive"], 0.5, n, bound)}}
            for n in counts
        ]
        for bound, (scene, counts) in zip((0.5, 0.0), tracked.items(), strict=True)
    }
    goal = GOALS["at_tracked"]
    verdict = goal.verdict(goal.values(found))
    half = 12.7062 * np.std([0.7, 0.85], ddof=1) / np.sqrt(2)
    assert verdict.finding.startswith(f"mean of 2: 0.775 [{0.775 - half:.3g}, {0.775 + half:.3g}]")
    assert "worst 0.6 in b AT" in verdict.finding and "fails in b AT 0.6" in verdict.finding
    assert verdict.verdict == "does not hold"
    assert goal.worst(goal.values(found)).to_dict() == pytest.approx({"a": 0.95, "b": 0.6})
    passive = GOALS["pt_tracked"]
    assert passive.values(found).loc["a", "PT"].tolist() == [0.9, 1.0]
    assert passive.verdict(passive.values(found)).finding.startswith("median of 1: 0.95")
    alone = {"a": [{"terminals": {"AT": block("active", 0.5, 18)}, "swarm": None}]}
    assert not any(len(GOALS[name].values(alone)) for name in ("pt_gospa", "fused_gospa"))
    assert (GOALS["pt_gospa"].values(found) == 0.25).all(axis=None)


@pytest.mark.parametrize(
    ("values", "verdict"),
    [
        ([[0.1, 0.1], [0.2, 0.2]], "holds"),
        ([[0.1, 0.1], [0.0, 0.4]], "holds under a condition"),  # one flight fails, no scene
        ([[0.1, 0.1], [0.1, 0.7]], "does not hold"),  # a scene
        ([[0.3, 0.3], [0.3, 0.3]], "does not hold"),  # the mean
        ([[np.nan, np.nan]], "does not hold"),
    ],
)
def test_a_goal_asks_each_flight_and_all(values, verdict):
    goal = Goal("x", lambda o: o, 0.3, 0.25)
    rows = [[{"AT": v} for v in row] for row in values]
    assert goal.verdict(goal.values(dict(zip("ab", rows, strict=False)))).verdict == verdict


def test_misread_frames_by_hand():
    """Read and wrong in the delay, in the phase; wrong and not read; a pilot; half wrong. Planted
    bug: frames that were not read."""
    rows = [[3, 1, 60, 100, 0, 50, 1], [4, 1, 0, 100, 26, 50, 1], [5, 1, 100, 100, 50, 50, 0]]
    rows += [[12, 1, 0, 0, 0, 0, 1], [13, 1, 50, 100, 25, 50, 1]]
    outcome = {"by_frame": {"AT->PT1": rows, "AT->AT": []}}
    assert flights.misread(outcome) == {"AT->PT1": 2, "AT->AT": 0}


def test_a_folder_of_scenes_is_flown_once(tmp_path, monkeypatch, capsys):
    """Two seeds of one scene, which lies there twice; the second call flies nothing. Planted bug:
    equal scenes that count twice."""
    tree = yaml.safe_load((SCENES / "paper_swarm_consistent.yaml").read_text())
    tree["radio"] = {"samples_per_chirp": 256, "bandwidth_hz": 320e6, "chirps_per_frame": 24}
    for name in ("one", "same"):
        tree |= {"name": name, "cooperation": "tracks"}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(tree))
    flown = []

    def fly(plan, folder, progress):
        outcomes = Outcomes(folder)
        outcomes.begin({})
        for p in pending(plan, outcomes, True):
            flown.append(p.index)
            run_job(FlightJob(p.key, p.tree, p.ground, str(plan.base.folder), str(folder), 1))

    monkeypatch.setattr(flights, "fly", fly)
    out = tmp_path / "out"
    command = ["reproduce", "flights", "--quick", "--seeds", "2", "--out", str(out)]
    for _ in range(2):
        assert main([*command, "--scenes", str(tmp_path)]) == 0
    assert flown == [(0, 0), (1, 0)]
    about = json.loads((out / "flights.json").read_text())
    assert about["settings"]["scenes"] == ["one"] and len(about["verdicts"]) == len(GOALS)
    scenes = pd.read_csv(out / "flights.csv").set_index("scene")
    assert scenes.loc["one"].seconds > 0 and scenes.loc["one"].misread == 0
    assert main([*command, "--scenes", str(tmp_path / "none")]) == 2
    assert main(["reproduce", "city", "--scenes", str(tmp_path)]) == 2
    assert "--scenes" in capsys.readouterr().err


@pytest.mark.slow
def test_drawn_scenes_are_free_and_of_all_kinds(tmp_path, monkeypatch):
    """Twelve draws in the small street and the blocks: speeds, sizes, terminals that look at the
    targets, and rays that see half of these. Planted bug: boresights that are not turned with the
    site."""
    monkeypatch.setattr(flights_drawn, "CITIES", flights_drawn.CITIES[4:] * 3)
    flights_drawn.write_drawn(tmp_path, 12, 3)
    files = sorted(tmp_path.iterdir())
    trees = [yaml.safe_load(f.read_text()) for f in files]
    assert files[5].stem.startswith("look_010_") and files[6].stem.startswith("report_001_")
    assert flights_drawn.drawn(1, 3) == trees[6]
    for kind in (trees[:6], trees[6:]):
        assert {t["name"].split("_")[2] for t in kind} == set(flights_drawn.FORMATIONS)
        assert len({json.dumps(t["array"]) for t in kind}) == 3
    for tree in trees:
        uavs = tree["swarm"].values()
        assert 3 <= len(uavs) <= 12
        assert max(np.linalg.norm(u["velocity_mps"]) for u in uavs) <= flights_drawn.MOST_SPEED_MPS
        targets = [u["position_m"] for u in uavs if u["role"] == "target"]
        for uav in uavs:
            if "boresight" in uav:
                to = np.mean(targets, axis=0) - uav["position_m"]
                assert to @ uav["boresight"] > 0.5 * np.linalg.norm(to)
    paths = trace(Scenario.model_validate(trees[6]), 0)["AT", "AT"]
    seen = np.unique(paths.target[paths.kind == PathKind.TARGET])
    assert len(seen) >= sum(u["role"] == "target" for u in trees[6]["swarm"].values()) / 2
