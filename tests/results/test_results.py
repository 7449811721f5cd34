"""Results: what was handed over is what is read back; files appear whole or not at all; the summary
by hand."""

from __future__ import annotations

import json
import os
from pathlib import Path

import fake_run as fake
import numpy as np
import pytest
import xarray as xr
from fake_run import TIMING, fake_records, fake_run, fake_scenario

from isac_rt import storage
from isac_rt.results import provenance
from isac_rt.results.dataset import errors_of, read
from isac_rt.results.files import (
    RENAMED,
    ResultsError,
    check_folder,
    new_variables,
    open_results,
    save,
    with_new_names,
)
from isac_rt.results.recorder import kept_of_paths
from isac_rt.results.records import KINDS, Use
from isac_rt.runtime import UserError
from isac_rt.scenario.file import load, to_yaml
from isac_rt.simulation import simulate
from isac_rt.storage import StorageError
from isac_rt.views.interchange import write_ledger
from isac_rt.views.report import write_report

CANYON = Path(__file__).parents[2] / "scenes" / "street_canyon.yaml"
ROUNDING = 1e-12
"""Differences of numbers around 30 in float64, a few operations each."""


@pytest.fixture(scope="module")
def run():
    return fake_run()


def _same(a: xr.Dataset, b: xr.Dataset) -> None:
    assert set(a.variables) == set(b.variables)
    for name in a.variables:
        x, y = a[name].values, b[name].values
        assert x.shape == y.shape, name
        text = x.dtype.kind in "OUT"  # numpy and pandas have several array types for text
        assert (
            x.tolist() == y.tolist() if text else x.dtype == y.dtype and x.tobytes() == y.tobytes()
        ), name
        assert a[name].attrs["units"] == b[name].attrs["units"] and a[name].attrs["long_name"]


@pytest.mark.parametrize("detections", [3, 0])
def test_round_trip_is_bit_exact(tmp_path, detections):
    """Exact. Seen to fail with float32 in `write_dataset`; 0 detections is the empty
    ragged dimension."""
    made = fake_run(detections=detections)
    save(made, tmp_path / "a" / "b")
    back = open_results(tmp_path / "a" / "b")
    _same(made.dataset, back.dataset)
    assert back.summary == json.loads(json.dumps(made.summary)) and to_yaml(
        back.scenario
    ) == to_yaml(made.scenario)
    assert back.dataset.attrs["scenario"] == made.dataset.attrs["scenario"]
    save(back, tmp_path / "again")
    _same(made.dataset, open_results(tmp_path / "again").dataset)


def test_two_runs_are_bit_identical(run, monkeypatch):
    """Exact, for other timings too: nothing of the clock is in the dataset. Seen to fail with
    time.time() as an attribute."""
    monkeypatch.setattr(fake, "TIMING", TIMING | {"total": 9 * TIMING["total"]})
    other = fake_run(run.scenario)
    assert other.summary["timing_s"]["total"] == 9 * run.summary["timing_s"]["total"]
    _same(run.dataset, other.dataset)
    assert run.dataset.attrs == other.dataset.attrs


def test_what_was_recorded_is_found_by_name(run):
    """Every value against the record it came from. Seen to fail with the observers' order reversed
    in `over`."""
    d, records = run.dataset, fake_records(run.scenario)
    o = records[4].observers["PT1"]
    here = {"observer": list(d.observer.values).index("PT1"), "frame": 4}
    assert np.array_equal(d.truth_range.isel(here).values, o.uavs.truth.range)
    assert np.array_equal(
        d.tracked_azimuth.isel(here).values, o.uavs.tracked.azimuth, equal_nan=True
    )
    assert np.isnan(d.truth_range.isel(frame=3, observer=0)).all() and not d.processed.values[3, 0]
    assert np.array_equal(
        d.uav_position.sel(uav="U1").values, [r.poses["U1"].position for r in records]
    )
    of = (d.det_frame.values == 4) & (d.det_observer.values == here["observer"])
    assert np.array_equal(d.det_velocity.values[of], o.reception.detections.velocity)
    assert np.array_equal(d.det_range.values[of], o.reception.detections.range)
    assert (
        d.symbol_errors.values[3, here["observer"]].tolist() == [30, 90, 180]
        and d.symbol_erased.values[3, here["observer"], 1] == 45
    )
    assert d.det_kind.values[of].tolist() == [1, 3, -1]
    assert d.det_order.values[of].tolist() == [0, 1, -1] and d.det_face.values[of].tolist() == [
        -1,
        70123,
        -1,
    ]
    for k, kind in enumerate(KINDS):
        assert d.path_count.sel(kind=kind).values[4, here["observer"]] == (o.paths.kind == k).sum()
    tracks = (d.track_frame.values == 4) & (d.track_observer.values == here["observer"])
    assert np.array_equal(d.track_covariance.values[tracks], o.tracks.covariance)
    away = records[4].poses["U1"].position - records[4].poses["PT1"].position
    assert np.abs(d.track_state.sel(component=["x", "y", "z"])[tracks] - away).max() < 0.0214
    assert set(d.path_frame.values) == {2}
    rows = d.path_observer.values == here["observer"]
    ledger = records[2].observers["PT1"].paths
    assert np.array_equal((d.path_gain_re + 1j * d.path_gain_im).values[rows], ledger.gain)
    assert np.array_equal(
        d.map_power.values[0, 1],
        records[2].observers["PT1"].reception.maps.range_doppler.astype(np.float32),
    )


def test_every_variable_has_units_and_a_meaning(run, tmp_path):
    write_ledger(
        {("AT", "PT1"): fake_records(run.scenario)[0].observers["PT1"].paths},
        tmp_path / "l.nc",
        {"AT": 77e9},
        provenance.provenance(run.scenario),
    )
    with xr.open_dataset(tmp_path / "l.nc", engine="h5netcdf") as ledger:
        for d in (run.dataset, ledger):
            assert all(
                v.attrs.get("units") and v.attrs.get("long_name") for v in d.variables.values()
            )
            assert {"scenario", "seed", "versions", "commit", "platform"} <= set(d.attrs)


def test_summary_numbers_by_hand(run):
    """6 data frames to PT1, of which one lost 30 of 360, 90 of 351 and 180 of 4293. Seen to fail
    with erased symbols taken off."""
    pt, at = run.summary["terminals"]["PT1"], run.summary["terminals"]["AT"]
    assert (pt["ser_delay"], pt["ser_dpsk"], pt["ber"]) == (30 / 2160, 90 / 2106, 180 / 25758)
    assert pt["erased"] == (30 + 45) / (2160 + 2106) and pt["bits"] == 25758
    assert abs(pt["bit_rate_bps"] - 25758 / (6 * 0.043 + 0.0077824)) < 1e-5
    assert (
        at["ser_delay"] is None
        and at["bits"] is None
        and at["bit_rate_bps"] is None
        and at["role"] == "active"
    )
    assert pt["false_per_frame"] is not None and pt["role"] == "passive"


def test_errors_of_angles_wrap(run):
    """2 pi more is no error. Seen to fail without the wrap."""
    turned = run.dataset.copy()
    turned["detected_azimuth"] = turned.detected_azimuth + 2 * np.pi
    e, plain = (
        errors_of(turned, "detected", "azimuth"),
        errors_of(run.dataset, "detected", "azimuth"),
    )
    assert (
        np.isfinite(plain).any()
        and np.nanmax(np.abs(e - plain)) < ROUNDING
        and abs(e[0, 0, 2] - 0.00637) < ROUNDING
    )


def test_failure_while_writing_leaves_the_old_file_and_no_rest(tmp_path, run, monkeypatch):
    """Seen to fail with a writer that writes in place."""
    save(run, tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def full(_):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(storage.os, "fsync", full)
    with pytest.raises(StorageError, match="No space left"):
        save(run, tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    monkeypatch.setattr(storage, "_sync", lambda _: None)
    with pytest.raises(StorageError):
        save(run, tmp_path / "new")
    assert not list((tmp_path / "new").iterdir())


def test_bad_folders_get_one_message(tmp_path, run):
    (tmp_path / "file").write_text("x")
    for call in (
        lambda: save(run, tmp_path / "file"),
        lambda: check_folder(tmp_path / "file" / "deeper"),
        lambda: open_results(tmp_path / "none"),
    ):
        with pytest.raises(UserError) as caught:
            call()
        assert "\n" not in str(caught.value)
    (tmp_path / "results.nc").write_text("not a NetCDF file")
    with pytest.raises(ResultsError):
        open_results(tmp_path)
    check_folder(tmp_path / "fine")
    assert not list((tmp_path / "fine").iterdir())


def test_ledger_holds_every_path_of_every_link(tmp_path, run):
    """Exact; Doppler from the closed form. Seen to fail with the opposite sign of doppler."""
    records = fake_records(fake_scenario())[0].observers
    links = {("AT", name): o.paths for name, o in records.items()}
    about = provenance.provenance(run.scenario)
    write_ledger(links, tmp_path / "ledger.nc", {"AT": 77e9}, about)
    with xr.open_dataset(tmp_path / "ledger.nc", engine="h5netcdf") as opened:
        d = opened.load()
    p = records["PT1"].paths
    mine = d.isel(path=d.receiver.values == "PT1")
    assert d.sizes["path"] == 46 and np.array_equal(mine.gain_re + 1j * mine.gain_im, p.gain)
    assert np.array_equal(mine.points, p.points) and np.array_equal(mine.faces, p.faces)
    assert np.allclose(mine.doppler, -77e9 * p.delay_rate, rtol=1e-15)
    assert np.array_equal(
        mine.target_name.values[mine.target.values[mine.target.values >= 0]], ["U1"]
    )
    write_ledger({}, tmp_path / "empty.nc", {}, {})


@pytest.mark.sionna
def test_points_of_paths_make_their_lengths():
    """Transmitter, points, receiver: the segments' sum over the speed of light is the delay, to
    1e-9 m. Planted bug: points of one link under the rows of another."""
    made = simulate.run(load(CANYON, ["receiver_preset=plain"], frames=4), snapshots=1).dataset
    names, spot = list(made.uav.values), made.uav_position.values
    for k in range(0, made.sizes["path"], 37):
        frame, observer = int(made.path_frame[k]), int(made.path_observer[k])
        if made.path_bounces[k] == 0 and made.path_target[k] < 0:
            continue  # a line of sight, or leakage, which has no length
        ends = (
            spot[frame, names.index(made[end].values[observer])]
            for end in ("transmitter", "receiver")
        )
        points = made.path_points.values[k]
        start, stop = ends
        way = np.vstack([start, points[np.isfinite(points).all(axis=1)], stop])
        length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
        assert abs(length - 299792458.0 * float(made.path_delay[k])) < 1e-9
    assert (made.path_bounces.values > 0).sum() > 1000


def test_commit_is_of_the_package_not_of_the_current_folder(tmp_path, monkeypatch):
    here = provenance.commit()
    monkeypatch.chdir(tmp_path)
    assert provenance.commit() == here


GIVEN_UP = [
    "summary.fidelity.clutter_rays",
    "summary.fidelity.traced_frames",
    "summary.fidelity.cost_model",
]
"""Keys that no longer say anything: walls are found from all of the flight, not frame by frame;
there are no rays of clutter and no cost model any more."""
EARLIER = Path(__file__).parent / "earlier"
"""A run of an earlier version: its summary, its scenario and the layout of its dataset."""


def test_runs_of_earlier_versions_are_opened(tmp_path):
    """What they held is still there under its present name, over the same dimensions, in the same
    unit; and they are opened, drawn and reported. Planted bugs: `state` called `status`;
    `shadowed` left out of `RENAMED`."""
    layout = json.loads((EARLIER / "layout.json").read_text())
    fill = {"object": "A", "bool": False}
    variables = {
        name: (
            dims,
            np.full([layout["sizes"][d] for d in dims], fill.get(dtype, 0), dtype),
            {"units": units},
        )
        for name, (dims, dtype, units) in layout["variables"].items()
    }
    (tmp_path / "run").mkdir()
    xr.Dataset(variables, attrs=layout["attributes"]).to_netcdf(
        tmp_path / "run" / "results.nc", engine="h5netcdf"
    )
    for name in ("summary.json", "scenario.yaml"):
        (tmp_path / "run" / name).write_text((EARLIER / name).read_text())
    old = open_results(tmp_path / "run")
    assert write_report(old, tmp_path, []).is_file()
    new = simulate.run(old.scenario, snapshots=1)
    for name, (dims, dtype, units) in layout["variables"].items():
        now = RENAMED.get(name, name)
        variable = new.dataset[now]
        assert now in old.dataset and list(variable.dims) == dims, name
        assert (str(variable.dtype), variable.attrs["units"]) == (dtype, units), name
    assert set(layout["attributes"]) <= set(new.dataset.attrs)
    assert missing(old.summary, new.summary) == GIVEN_UP


def test_names_of_earlier_versions_are_replaced():
    """UAVs keep their names. Planted bugs: a mapping's key replaced; `picture` left out."""
    summary = {"hidden": {"hidden": 3, "losses": {"not_read": 1}}, "gospa": {"empty_m": None}}
    new = {"hidden": {"occluded": 3, "losses": {"erased": 1}}, "gospa": {"no_tracks_m": None}}
    assert with_new_names(summary) == new
    old = xr.Dataset(
        {
            "picture_gospa": (("frame", "picture"), np.zeros((3, 2))),
            "picture_room": (("frame", "picture"), np.ones((3, 2))),
            "fused_picture": ("fused", [0, 1, 1]),
            "loss": ((), 2, {"flag_meanings": "found not_read"}),
        },
        {"picture": ["swarm", "A"]},
    )
    found = new_variables(old)
    assert found.fused_gospa.dims == ("frame", "owner")
    assert {*found.variables} == {"owner", "fused_gospa", "fused_capacity", "fused_owner", "loss"}
    assert found.loss.flag_meanings.split()[:3] == ["found", "too_weak", "erased"]


def missing(old, new, at="summary"):
    """Keys of a summary that another one lacks."""
    if not isinstance(old, dict):
        return []
    lost = [f"{at}.{key}" for key in old if key not in new]
    return lost + [m for k in old.keys() & new.keys() for m in missing(old[k], new[k], f"{at}.{k}")]


def test_what_was_kept_of_the_paths_is_means_and_the_worst():
    """Three frames of one link and one of another, generic numbers. Planted bugs: the kinds left
    out; one that a frame has none of left out of the mean; the last frame's bounds; the kinds not
    as they come up."""

    def use(found, kept, bounces, left_out, error):
        worst = dict.fromkeys(("plane_error", "straight_error", "turning_error"), error)
        counts = dict.fromkeys(("filtered", "weak", "plane", "straight"), 2 * found)
        own = {"found": found, "kept": kept, "bounces": bounces, "left_out": left_out}
        return read("use", Use(**counts, **worst, **own), 3)

    found = kept_of_paths(
        np.concatenate(
            [
                use(3, {"target": 2, "ghost": 1}, 1, 0.02, 0.3),
                use(5, {"target": 4}, 2, 0.5, 0.1),
                use(6, {"target": 5, "diffuse": 3}, 0, 0.1, 0.2),
            ]
        )
    )
    assert found["frames"] == 3
    assert (found["found_per_frame"], found["weak_per_frame"]) == (4.67, 9.33)
    kept = {"target": 3.67, "ghost": 0.33, "diffuse": 1.0}
    assert found["kept_per_frame"] == kept and list(found["kept_per_frame"]) == list(kept)
    assert (found["bounces"], found["left_out_db"]) == (2, -3.01)
    assert found["plane_error_rad"] == 0.3
    other = kept_of_paths(use(1, {}, 0, 0, 0.1))
    assert other["left_out_db"] is None and other["kept_per_frame"] == {}
