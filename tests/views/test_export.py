"""A run for other programs: what they read is what the run holds."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from fake_run import fake_run

from isac_rt.cli.cli import main
from isac_rt.results.files import save
from isac_rt.views import export
from isac_rt.views.scene import moving_scene, page_part
from isac_rt.world.city.mesh import CityMesh


@pytest.fixture(scope="module")
def run():
    return fake_run()


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as opened:
        return list(csv.DictReader(opened))


def test_csv_holds_rows_by_name(run, tmp_path):
    """Read by the standard library: every column is explained, numbers are those of the run to the
    last bit, names stand in place of positions. Planted bugs: columns of the covariance taken row
    by row for those of its transpose's state; frames by position."""
    d = run.dataset.assign_coords(frame=run.dataset.frame + 100)
    files = {file.stem: rows_of(file) for file in export.write_csv(d, tmp_path)}
    assert set(files) == {*export.TABLES, "columns"}
    explained = {(row["table"], row["column"]) for row in files["columns"]}
    assert ("tracks", "track_covariance_x_v_y") in explained
    tracks = files["tracks"]
    assert len(tracks) == d.sizes["track"] and tracks[-1]["frame"] == str(
        100 + d.track_frame[-1].item()
    )
    assert {row["observer"] for row in tracks} == {"AT", "PT1"}
    values = d.track_covariance.sel(component="y", component_2="y").values
    assert [float(row["track_covariance_y_y"]) for row in tracks] == values.tolist()
    assert {row["track_target"] for row in tracks} == {"U1"}
    seen = [
        r for r in files["seen"] if (r["frame"], r["observer"], r["uav"]) == ("104", "PT1", "U1")
    ]
    assert float(seen[0]["truth_range"]) == d.truth_range.values[4, 1, 2]
    assert files["uavs"][5]["uav"] == "U1" and float(files["uavs"][5]["time"]) == d.time.values[1]
    known = {(t, c) for t, rows in files.items() if t != "columns" for c in rows[0]}
    places = {(t, c) for t in files for c in ("frame", "time", "observer", "uav")}
    assert known - places == explained


def test_matlab_reads_every_variable(run, tmp_path):
    """Scipy's reader: every variable, its values, unit and dimensions."""
    from scipy.io import loadmat

    export.write_mat(run.dataset, tmp_path / "run.mat")
    found = loadmat(tmp_path / "run.mat", squeeze_me=True, struct_as_record=False)
    assert found["units"].det_range == "m" and found["dimensions"].track_state == "track component"
    assert np.array_equal(found["track_covariance"], run.dataset.track_covariance.values)
    assert found["uav"].tolist() == ["AT", "PT1", "U1"]
    for name in run.dataset.variables:
        assert str(name)[: export.LONGEST_NAME] in found


def test_a_scene_stands_upright(run, tmp_path):
    """The file's own reader finds the flights where they were, with glTF's y up: east stays, up
    becomes y, north becomes -z. Planted bug: north not turned."""
    import trimesh

    corners = np.array([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [8.0, 5.0, 3.0]])
    city = CityMesh("roof", corners, np.array([[0, 1, 2]]), np.zeros(1, np.int16), (), np.zeros(3))
    export.write_glb(run.dataset, city, tmp_path / "run.glb")
    found = trimesh.load(tmp_path / "run.glb")
    assert {"city", "flight of U1", "tracks of PT1", "paths, target"} <= set(found.geometry)
    flight = np.repeat(run.dataset.uav_position.sel(uav="U1").values, 2, axis=0)[1:-1]  # pieces
    drawn = found.geometry["flight of U1"].vertices
    assert np.abs(drawn - flight[:, [0, 2, 1]] * [1, 1, -1]).max() < 1e-5  # float32 of the format
    assert found.geometry["city"].bounds.tolist() == [[0, 0, -5], [8, 3, 0]]


def test_a_moving_scene_is_where_the_run_was(run):
    """Read off the figure that the page holds: UAVs, tracks and paths of a frame against the run,
    to the centimetre that it keeps; of a flat roof and a wall under it the outlines are
    drawn and not their diagonals. Planted bugs: tracks of all frames at once; the edge of both left
    out; drawn twice."""
    corners = np.array([[0.0, -9, 3], [8, -9, 3], [8, 2, 3], [0, 2, 3], [0, -9, 0], [8, -9, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 4, 1], [4, 5, 1]])
    city = CityMesh("roof", corners, faces, np.zeros(4, np.int16), (), np.zeros(3))
    figure = json.loads(json.dumps(moving_scene(run.dataset, city)))
    d, frame = run.dataset, figure["frames"][4]
    assert [f["name"] for f in figure["frames"]] == [str(k) for k in range(7)]
    data = {trace["name"]: trace for trace in frame["data"]}

    def points(trace):
        found = np.array([trace[a] for a in "xyz"], float).T
        return found[np.isfinite(found).all(axis=1)]

    assert np.abs(points(data["UAVs"]) - d.uav_position.values[4]).max() <= 0.005 + 1e-9
    mine = (d.track_frame.values == 4) & (d.track_observer.values == 1)
    expected = d.uav_position.values[4, 1] + d.track_state.values[mine, :3]
    assert np.abs(points(data["tracks of PT1"]) - expected).max() <= 0.005 + 1e-9
    line = data["line of sight paths"]  # made up: it has points between its ends
    sight = np.array([[line[a][k] for a in "xyz"] for k in (0, line["x"].index(None) - 1)])
    assert np.abs(sight - d.uav_position.sel(uav=["AT", "PT1"]).values[2]).max() <= 0.005 + 1e-9
    edges = points(next(t for t in figure["data"] if t["name"] == "edges")).reshape(-1, 2, 3)
    lengths = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1)
    assert sorted(lengths.tolist()) == [3, 3, 8, 8, 8, 11, 11]  # of rectangles, without diagonals
    assert "</script><script" not in page_part(figure, "scene")[-2000:]


def test_stonesoup_loads_its_own(run, tmp_path):
    serialise = pytest.importorskip("stonesoup.serialise")
    export.write_stonesoup(run.dataset, tmp_path)
    back = serialise.YAML().load((tmp_path / "AT.yaml").read_text())
    mine = run.dataset.det_frame.values[run.dataset.det_observer.values == 0]
    assert [len(found) for found in back] == np.bincount(mine, minlength=7).tolist()


def test_the_command_says_what_it_wrote(run, tmp_path, capsys, monkeypatch):
    save(run, tmp_path / "run")
    assert main(["export", str(tmp_path / "run"), "--as", "csv"]) == 0
    assert (tmp_path / "run" / "export" / "tracks.csv").is_file()
    assert main(["export", str(tmp_path / "run"), "--as", "xls"]) == 2
    assert "xls: no such format; choose from csv" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "run"), "--as", "sigmf", "--link", "PT9"]) == 2
    monkeypatch.setitem(sys.modules, "stonesoup", None)
    for option in (["--frame", "1"], ["--link", "AT->PT1"]):
        assert main(["export", str(tmp_path / "run"), "--as", "csv", *option]) == 2
        assert "are of IF samples" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "run"), "--as", "stonesoup"]) == 2
    assert "pip install 'isac_rt[interchange]'" in capsys.readouterr().err
