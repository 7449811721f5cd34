"""Tables of the report: what they say of a made-up run, and that none is wider than the page."""

from __future__ import annotations

import base64
import copy
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from fake_run import fake_run

from isac_rt.propagation.pathset import PathKind
from isac_rt.views.report import wall_table, write_report
from isac_rt.views.tables import (
    bound_table,
    data_table,
    error_table,
    false_table,
    hit_table,
    legend,
    loss_table,
    rmse_table,
    target_table,
)
from isac_rt.world.city import load_city
from isac_rt.world.settings import City

OF_GROUPS = (hit_table, bound_table, rmse_table, target_table, error_table, loss_table)


@pytest.fixture(scope="module")
def summary():
    return fake_run().summary


def row(table, *names):
    (found,) = (r for r in table.rows if tuple(r[: len(names)]) == names)
    return dict(zip(table.columns, found, strict=True))


def test_who_saw_what(summary):
    """PT1 had U1 in view in six frames of seven and found it in all but frame 5, 6.37 cm off; the
    AT hears four. Planted bugs: found and tracked swapped; the median of another axis."""
    table = target_table(summary, "targets")
    at_pt = row(table, "AT to PT1", "U1")
    assert (at_pt["In view"], at_pt["Found"], at_pt["Tracked"]) == ("6", "5", "6")
    errors = row(error_table(summary, "targets"), "AT to PT1", "U1", "error")
    assert errors["Range [m]"] == "0.064 / 0.064"
    assert errors["Velocity [m/s]"] == "0.13 / 0.13"
    # a normal error of 4 mm: 0.674 and 1.645 of it
    bound = row(error_table(summary, "targets"), "AT to PT1", "U1", "bound")
    assert bound["Range [m]"] == "0.0027 / 0.0066"
    assert row(table, "AT to AT", "U1")["In view"] == "3"
    assert [r[1] for r in table.rows] == ["U1", "U1"]
    assert [r[1] for r in target_table(summary, "terminals").rows] == ["AT"]
    alone = copy.deepcopy(summary)
    for block in alone["links"].values():
        block["targets"].pop("U1")
    assert [r[1] for r in target_table(alone, "targets").rows] == ["AT"]


def test_a_sensor_has_no_data_and_no_legend_of_data(summary):
    """Planted bug: the active terminal's own link as one that carries data."""
    table = data_table(summary)
    assert [r[0] for r in table.rows] == ["AT to PT1"]
    assert "SER" in legend(table) and "Found" not in legend(table)
    name, own = next((n, s) for n, s in summary["links"].items() if s["ser_delay"] is None)
    alone = {"links": {name: own}}
    assert not data_table(alone).rows
    said = legend(data_table(alone), hit_table(alone, "targets"))
    assert "SER" not in said and "Found" in said


def test_targets_and_terminals_are_scored_apart_with_their_numbers(summary):
    """PT1 found U1 in five frames of its six in view, 6.37 cm off in range; the transmitter, which
    reports its position, has rows of its own. Planted bugs: all UAVs in both; the tracks' number
    for the detections."""
    for group, n in (("targets", "6"), ("terminals", "7")):
        assert row(hit_table(summary, group), "AT to PT1")["In view"] == n
        errors = row(rmse_table(summary, group), "AT to PT1, detections")
        assert (errors["n"], errors["Range [m]"]) == (n, "0.0637")
        assert row(bound_table(summary, group), "AT to PT1")["Noise only"] == "0.83"
    targets = row(hit_table(summary, "targets"), "AT to PT1")
    assert (targets["Found"], targets["Tracked"]) == ("0.833", "1")
    assert "GOSPA [m]" not in hit_table(summary, "terminals").columns


def test_fused_tracks_stand_under_those_of_the_links(summary):
    """Planted bug: a picture without a target in view."""
    own = summary["links"]["AT->AT"] | {"in_view": 9, "hit_rate": 0.25, "tracked_rate": 0.75}
    swarm = own | {"terminals": {"PT1": own | {"in_view": 0}}}
    rows = [r[:4] for r in hit_table(summary | {"swarm": swarm}, "targets").rows]
    assert [r[0] for r in rows] == ["AT to AT", "AT to PT1", "Whole swarm, fused"]
    assert rows[-1][1:] == ("9", "0.25", "0.75")


def test_walls_behind_what_was_seen():
    """Three detections off the facade of a canyon that faces east, at x = -11, one of them a ghost
    of the second UAV, one off the ground, one that nothing explains. Planted bugs: east and west;
    the middle without the city's origin; detections without a face counted."""
    node = City.model_validate({"source": "canyon", "street_width_m": 22, "block_size_m": 30})
    city = load_city(node, ".", 77e9, (3.0, 40.0, 10.0))
    middle = city.corners.mean(axis=1) + city.origin
    facade = np.flatnonzero((np.abs(middle[:, 0] + 11) < 0.1) & (city.normals[:, 0] > 0.9))
    level = np.flatnonzero((np.abs(middle[:, 2]) < 0.1) & (np.abs(city.normals[:, 2]) > 0.9))
    kinds = [PathKind.DIFFUSE, PathKind.GHOST, PathKind.DIFFUSE, PathKind.DIFFUSE, -1]
    d = xr.Dataset(
        {
            "det_face": ("detection", [facade[0], facade[0], facade[0], level[0], -1]),
            "det_kind": ("detection", np.array(kinds)),
            "det_target": ("detection", [-1, 1, -1, -1, -1]),
        },
        coords={"uav": ["A", "U7"]},
    )
    table = wall_table(d, city)
    first, second = (dict(zip(table.columns, r, strict=True)) for r in table.rows)
    assert first["Surface"].endswith("facing east") and second["Surface"].endswith("level")
    assert (first["Diffuse"], first["Ghosts"]) == ("2", "1") and "Mirror images" not in first
    assert first["Ghosts of"] == "U7" and second["Ghosts of"] == ""
    x, y, z = (float(v) for v in first["Middle [m]"].split(","))
    np.testing.assert_allclose([x, y, z], middle[facade[0]], atol=0.5)


def test_why_not(summary):
    """Causes that never were have no column."""
    table = loss_table(summary, "targets")
    assert table.columns == ("Link", "UAV", "Found", "Inaccurate")
    assert row(table, "AT to PT1", "U1") == {
        "Link": "AT to PT1",
        "UAV": "U1",
        "Found": "5",
        "Inaccurate": "1",
    }


def test_picture(summary):
    """In frame 4 the track of U1 is false."""
    hits, false = hit_table(summary, "targets"), false_table(summary)
    assert row(hits, "AT to PT1")["False tracks per frame"] == "0.143"
    assert row(false, "AT to PT1") == {
        "False tracks per frame": "AT to PT1",
        "All": "0.143",
        "Target": "0.143",
    }


def test_summaries_of_earlier_versions_have_none(summary):
    old = copy.deepcopy(summary)
    for block in old["links"].values():
        for key in ("in_view", "tracked_rate", "cooperative", "false_tracks", "targets"):
            del block[key]
    assert not false_table(old).rows
    for group in ("targets", "terminals"):
        for table in OF_GROUPS:
            assert not table(old, group).rows


def test_tables_fit_the_page(summary):
    """With every cause and every figure at its longest. A letter of the tables is 7.5 px wide at
    most on average, a cell has 22 px of padding; the page has 1200 px, 74 rem.
    Planted bug: one table of targets and causes."""
    full = copy.deepcopy(summary)
    for block in full["links"].values():
        block["false_tracks"] = dict.fromkeys(block["false_tracks"], 12.3456)
        for target in block["targets"].values():
            target["losses"] = dict.fromkeys(target["losses"], 1234)
            for key in ("median", "p90", "bound_median", "bound_p90"):
                target[key] = dict.fromkeys(target[key], 0.00012345)
    for table in (*OF_GROUPS, false_table):
        found = table(full, "targets") if table in OF_GROUPS else table(full)
        cells = zip(found.columns, *found.rows, strict=True)
        width = sum(max(map(len, column)) * 7.5 + 22 for column in cells)
        assert width < 1200, table.__name__


def test_the_report_shows_targets_first_and_maps_before_tables(tmp_path):
    """Every figure stands once, one of an unknown name at the end, and no heading stands without
    its part. Planted bugs: a figure of errors of terminals among those of targets; the heading of
    data in a run without them."""
    results = fake_run()
    pictures = []
    for name in ("scene", "range_doppler_0001", "errors", "errors_terminals", "decoding", "mine"):
        pictures.append(tmp_path / f"{name}.png")
        pictures[-1].write_bytes(name.encode())
    page = write_report(results, tmp_path, pictures).read_text()
    at = {p.stem: page.index(base64.b64encode(p.read_bytes()).decode() + '"') for p in pictures}
    assert all(page.count(base64.b64encode(p.read_bytes()).decode() + '"') == 1 for p in pictures)
    parts = [page.index(f"<h2>{t}</h2>") for t in ("Targets", "Range-Doppler maps", "Each target")]
    assert parts == sorted(parts) and parts[1] < at["range_doppler_0001"] < at["errors"] < parts[2]
    assert page.index("<h2>Terminals</h2>") < at["errors_terminals"] < at["decoding"] < at["mine"]
    for block in results.summary["links"].values():
        block["ser_delay"] = None
    assert "<h2>Data</h2>" not in write_report(results, tmp_path, pictures[:3]).read_text()


def test_without_plotly_the_report_says_what_to_install(monkeypatch, tmp_path):
    """Planted bug: the exception let through, after a run that took hours."""
    monkeypatch.setitem(sys.modules, "plotly", None)
    city = load_city(City(source="canyon"), Path(), 77e9, (0.0, 0.0, 0.0))
    page = write_report(fake_run(), tmp_path, [], city).read_text()
    assert "pip install &#39;isac_rt[views]&#39;" in page
    assert "Plotly.newPlot" not in page
