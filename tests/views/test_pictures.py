"""Moving pictures, scenes to turn about, scenarios to start from, and what objects print."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from test_interchange import flight

from isac_rt.cli.cli import main
from isac_rt.cli.starter import schema_text
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import Waveform
from isac_rt.results.files import ResultsError, save
from isac_rt.results.recorder import Results
from isac_rt.scenario.file import load
from isac_rt.simulation.setup import prepare, trace
from isac_rt.views.animate import animate, tracked_positions, write_animation

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def results() -> Results:
    return flight()


def test_tracks_lie_where_the_uavs_are(results):
    """The active terminal's track of P and P's reference, placed in the world, within 0.2 m of the
    truth (0.4 mrad of the cosines at 20 m, a tenth of a range cell). Planted bug: the terminal's
    own place left out."""
    d = results.dataset
    for observer, other in ((0, 1), (1, 0)):
        found = tracked_positions(d, 3, observer)
        near = np.linalg.norm(found - d.uav_position.values[3, other], axis=1)
        assert len(found) == 0 or near.min() < 0.2
    assert len(tracked_positions(d, 3, 1)) >= 1


def test_a_moving_picture_has_a_picture_per_map(results, tmp_path):
    from PIL import Image

    write_animation(results, tmp_path / "run.gif", observer=1)
    with Image.open(tmp_path / "run.gif") as picture:
        assert picture.n_frames == results.dataset.sizes["snapshot"] >= 2
        assert np.ptp(np.asarray(picture.convert("L"))) > 100  # ink
    assert [f.name for f in tmp_path.iterdir()] == ["run.gif"]


def test_what_cannot_move_is_refused(results, tmp_path, capsys):
    with pytest.raises(ResultsError, match=r"\.gif"):
        write_animation(results, tmp_path / "run.avi")
    one = Results(results.dataset.isel(snapshot=slice(0, 1)), results.summary, results.scenario)
    with pytest.raises(ResultsError, match="snapshots"):
        animate(one)
    save(results, tmp_path)
    assert main(["animate", str(tmp_path), "--observer", "nobody"]) == 2
    assert "choose from A, P" in capsys.readouterr().err


def test_a_scene_to_turn_about_is_one_page():
    """Every kind of path and every UAV is a trace; corners of a path lie on its points; the page
    asks for nothing from a network."""
    pytest.importorskip("plotly")
    from isac_rt.views.scene import scene_3d

    scenario = load(
        ROOT / "scenes" / "access_swarm.yaml",
        ["access.establish=false", "access.synchronisation=external"],
    )
    setup = prepare(scenario)
    paths = trace(scenario, 0, setup=setup)
    figure = scene_3d(
        setup.city, setup.swarm, np.linspace(0, 1, 5), setup.timetable.epoch(0), paths
    )
    names = [trace.name for trace in figure.data]
    for kind in ("line_of_sight", "target"):
        count = sum(p.counts()[kind] for p in paths.values())
        assert count > 1
        assert f"{kind.replace('_', ' ')} ({count})" in names
    assert all(f"{uav}, flight" in names for uav in scenario.swarm)
    sight = next(trace for trace in figure.data if trace.name.startswith("line of sight"))
    poses = setup.swarm.poses(setup.timetable.epoch(0))
    corners = np.column_stack([sight.x, sight.y, sight.z])[:2]
    ends = {name: pose.position for name, pose in poses.items()}
    assert any(
        np.allclose(corners, [ends[a], ends[b]], atol=0.006) for a in ends for b in ends if a != b
    )
    page = figure.to_html(include_plotlyjs=True)
    assert "<script src=" not in page


def test_new_writes_a_scenario_that_is_right(tmp_path, capsys):
    """It loads, names the schema beside it, has every marker filled in, and does not replace what
    is there."""
    file = tmp_path / "mine.yaml"
    assert main(["new", str(file)]) == 0
    scenario = load(file)
    assert scenario.name == "mine"
    assert scenario.clutter.model == "field"
    assert "@" not in file.read_text()
    assert file.read_text().startswith("# yaml-language-server: $schema=scenario.schema.json")
    assert json.loads((tmp_path / "scenario.schema.json").read_text())["title"] == "Scenario"
    assert main(["new", str(file)]) == 2
    assert "already" in capsys.readouterr().err


def test_every_scene_names_the_schema_and_the_schema_is_today_s():
    assert (ROOT / "scenes" / "scenario.schema.json").read_text() == schema_text(), (
        "isac-rt schema > scenes/scenario.schema.json"
    )
    for file in (ROOT / "scenes").glob("*.yaml"):
        assert file.read_text().startswith(
            "# yaml-language-server: $schema=scenario.schema.json\n"
        ), file.name


def test_objects_print_themselves_in_short(results):
    setup = prepare(results.scenario)
    paths = setup.frame(2).paths["A", "P"]
    assert repr(paths).startswith("<PathSet A -> P at 0.0030 s: 1 line of sight")
    assert "targets found" in repr(results)
    assert repr(setup.city) == "<CityMesh free space: 0 faces, 0 x 0 x 0 m, 0 materials>"
    w = Waveform(num_samples=16, num_chirps=6)
    cube = IFCube(
        samples=np.full((3, 2, 6, 16), 3 + 4j, np.complex64),
        waveform=w,
        schedule=np.zeros((3, 6), int),
        start_time=0.5,
    )
    assert (
        repr(cube)
        == "<IFCube 3 groups x 2 antennas x 6 chirps x 16 samples at 0.5000 s, RMS 5.00e+00 "
        "sqrt(W)>"
    )
