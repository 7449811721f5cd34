"""Figures of a picture from rows made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.propagation.pathset import PathKind
from isac_rt.results.columns import MEASURES
from isac_rt.results.losses import LOSSES, Loss
from isac_rt.results.sensing import FALSE_CAUSES, Sensing, summary_block

GOSPA = {f"gospa_{part}": 0.0 for part in ("localisation", "missed", "false")}


def row(seen=(1, 1), errors=(None, None), tracks=(), **more):
    """One frame of two UAVs, targets: errors of detections (range, velocity, azimuth, elevation)
    [SI, rad], tracks of (id, 1 if false and 2 if of an object, kind, target, followed UAV)."""
    seen = np.array(seen, bool)
    out = {"in_view": seen, "occluded": np.zeros(2, bool), "hit": np.zeros(2, bool)}
    out |= {"loss": np.where(seen, Loss.OTHER, -1), "num_false": 0, "num_clutter": 0, **GOSPA}
    out |= {"cooperative": np.array([False, False])}
    out |= {
        "genie": np.where(seen, [0.9, 0.4], np.nan),
        "clutter_free": np.where(seen, 0.7, np.nan),
        "whitened": np.where(seen, 0.6, np.nan),
        "target_snr": np.where(seen, 100.0, np.nan),
        "target_cell_snr": np.where(seen, 40.0, np.nan),
        "target_straddling": np.where(seen, 0.8, np.nan),
        "target_whitened_snr": np.where(seen, [20.0, 40.0], np.nan),
    }
    table = np.array(tracks, int).reshape(-1, 5)
    out["track"] = dict(zip(("id", "false", "kind", "target", "uav"), table.T, strict=True))
    out["track"] |= {"false": table[:, 1] == 1, "object": table[:, 1] == 2}
    for k, name in enumerate(MEASURES):
        truth = np.array([17.3, -2.9])
        out[f"truth_{name}"] = truth
        off = np.array([np.nan if e is None else e[k] for e in errors])
        out[f"detected_{name}"] = truth + off
        follows = np.isin([0, 1], table[:, 4])
        out[f"bound_{name}"] = np.where(seen, 0.001 * (k + 1), np.nan)
        out[f"tracked_{name}"] = np.where(follows, truth + 0.01 * (k + 1), np.nan)
    return out | more


def sensing(rows):
    """What frames show, their tracks one after the other."""
    values = {name: np.array([r[name] for r in rows]) for name in rows[0] if name != "track"}
    tracks = {name: np.concatenate([r["track"][name] for r in rows]) for name in rows[0]["track"]}
    counts = [len(r["track"]["id"]) for r in rows]
    return Sensing.of(values, tracks, np.repeat(np.arange(len(rows)), counts))


def test_errors_of_each_uav_and_of_all():
    """Of UAV 0 errors of 1, -3, 2 and 10 cm and one without a direction, of UAV 1 one of 7 m/s;
    what is out of view counts nowhere. Planted bugs: the median of signed errors; angles in
    radians; all UAVs pooled."""
    cm = [(0.01 * x, 0.0, np.deg2rad(x), 0.0) for x in (1, -3, 2, 10)]
    rows = [row(errors=(e, None)) for e in cm]
    rows += [row(errors=((0.02, 0.1, np.nan, np.nan), (0.0, 7.0, 0.0, 0.0)))]
    rows += [row(seen=(0, 0), errors=((9.0, 9.0, 1.0, 1.0), None))]
    s = sensing(rows)
    one, two = s.targets(["U1", "U2"]).values()
    assert one["in_view"] == 5
    assert one["median"]["range_m"] == pytest.approx(0.02)
    # linear between the order statistics 1, 2, 2, 3, 10 cm: 3 + 0.6 (10 - 3)
    assert one["p90"]["range_m"] == pytest.approx(0.072)
    assert one["median"]["azimuth_deg"] == pytest.approx(2.5)
    assert two["median"]["velocity_mps"] == pytest.approx(7.0)
    block = s.block()
    squares = [1e-4, 9e-4, 4e-4, 1e-2, 4e-4, 0.0]
    assert block["rmse"]["range_m"] == pytest.approx(np.sqrt(np.mean(squares)))
    assert block["matched"] == pytest.approx(6 / 10)


def test_the_bound_is_of_the_frames_with_an_estimate():
    """Five frames with a detection whose errors are normal with 1 mm and five with 4 mm: a
    simulated mixture has the same median and 90 %. Frames without a detection, in which the bound
    is 9 m, count nowhere; angles in degrees. Planted bugs: the mean of the deviations for the
    mixture's; all frames in view."""
    e = (0.0, 0.0, 0.0, 0.0)
    rows = [
        row(errors=(e, None), bound_range=np.array([s, 9.0])) for s in [0.001] * 5 + [0.004] * 5
    ]
    rows += [row(errors=(None, None), bound_range=np.array([9.0, 9.0]))]
    one, two = sensing(rows).targets(["U1", "U2"]).values()
    drawn = np.abs(np.random.default_rng(3).normal(size=(2, 200_000)) * [[0.001], [0.004]])
    assert one["bound_median"]["range_m"] == pytest.approx(np.median(drawn), rel=0.01)
    assert one["bound_p90"]["range_m"] == pytest.approx(np.percentile(drawn, 90), rel=0.01)
    assert one["bound_median"]["azimuth_deg"] == pytest.approx(0.6745 * np.degrees(0.003), rel=1e-3)
    assert set(two["bound_p90"].values()) == {None}


def test_counts_add_up():
    """Hits of the losses, by UAV and together; false detections and clutter by frame."""
    kinds = [(Loss.FOUND, Loss.MASKED), (Loss.FOUND, -1), (Loss.NOISE, Loss.CLUTTER)]
    rows = [
        row(seen=(1, b >= 0), loss=np.array([a, b]), hit=np.array([a == 0, b == 0]), num_false=k)
        for k, (a, b) in enumerate(kinds)
    ]
    s = sensing(rows)
    block, targets = s.block(), s.targets(["U1", "U2"])
    assert block["losses"] == dict.fromkeys(LOSSES, 0) | {
        "found": 2,
        "masked": 1,
        "noise": 1,
        "clutter": 1,
    }
    assert block["hit_rate"] == pytest.approx(2 / 5)
    assert sum(block["losses"].values()) == sum(t["in_view"] for t in targets.values()) == 5
    assert [sum(t["losses"].values()) for t in targets.values()] == [3, 2]
    assert block["false_per_frame"] == pytest.approx(1.0)


def test_occluded_is_not_in_view():
    """In the field of view but behind the city."""
    rows = [row(occluded=np.array([True, False])), row()]
    one, two = sensing(rows).targets(["U1", "U2"]).values()
    assert (one["in_view"], one["occluded"], two["in_view"], two["occluded"]) == (1, 1, 2, 0)


def test_gospa_is_the_root_of_its_parts():
    """Frame 1: localisation 0.5 m^2, one missed; frame 2: two false ones. c = 5 m. Planted bug:
    missed and false swapped."""
    rows = [
        row(gospa_localisation=0.5, gospa_missed=12.5),
        row(seen=(0, 0), gospa_false=25.0),
    ]
    found = sensing(rows).block()["gospa"]
    assert found["missed"] == pytest.approx(0.5)
    assert found["false"] == pytest.approx(1.0)
    assert found["localisation_m"] == pytest.approx(0.5)
    assert found["total_m"] == pytest.approx(np.sqrt((13.0 + 25.0) / 2))
    parts = found["localisation_m"] ** 2 + 12.5 * (found["missed"] + found["false"])
    assert found["total_m"] ** 2 == pytest.approx(parts)
    assert found["no_tracks_m"] == pytest.approx(np.sqrt((2 * 12.5 + 0) / 2))
    five = sensing([row(), row(seen=(1, 0)), row()]).block()["gospa"]
    assert five["no_tracks_m"] == pytest.approx(np.sqrt(5 * 12.5 / 3))


def test_false_tracks_by_cause():
    """A wall's, one of noise and two ghosts of UAV 1 are far from every UAV; a second track of UAV
    0 is near it, and a car has one. Planted bug: all that follow nobody count."""
    ghost, target = int(PathKind.GHOST), int(PathKind.TARGET)
    tracks = [
        (1, 0, target, 0, 0),
        (2, 1, int(PathKind.DIFFUSE), -1, -1),
        (4, 1, -1, -1, -1),
        (5, 1, ghost, 1, -1),
        (6, 1, ghost, 1, -1),
        (7, 0, target, 0, -1),
        (8, 2, target, 1, -1),
    ]
    s = sensing([row(tracks=tracks), row()])
    block = s.block()
    expected = {"diffuse": 0.5, "noise": 0.5, "ghost": 1.0}
    assert block["false_tracks"] == dict.fromkeys(FALSE_CAUSES, 0.0) | expected
    assert block["false_tracks_per_frame"] == pytest.approx(2.0)
    assert block["object_tracks_per_frame"] == 0.5
    assert [t["ghost_tracks"] for t in s.targets(["U1", "U2"]).values()] == [0, 2]


def test_switches_and_interruptions():
    """UAV 0 by track 5, out of view for a frame, by 5, lost for two frames, by 5, by 8 beside which
    5 goes on, by 5. Planted bugs: a pause out of view is an interruption; a new track's first frame
    is a switch."""
    follow = [5, None, 5, 0, 0, 5, 8, 5]
    rows = [
        row(seen=(k is not None, 1), tracks=[(k, 0, 1, 0, 0)] if k else [(5, 0, 1, 0, -1)])
        for k in follow
    ]
    one, two = sensing(rows).targets(["U1", "U2"]).values()
    assert (one["switches"], one["interruptions"], one["tracked"]) == (2, 1, 5)
    assert (two["switches"], two["interruptions"], two["tracked"]) == (0, 0, 0)


def test_links_pool_frame_by_frame():
    """Rates over the frames of both; a switch is counted within its link only."""
    one = sensing([row(tracks=[(5, 0, 1, 0, 0)], num_clutter=4)])
    two = sensing([row(tracks=[(6, 0, 1, 0, 0)])] * 3)
    both = Sensing.pooled([one, two])
    assert both.block()["clutter_per_frame"] == pytest.approx(1.0)
    assert both.block()["tracked_rate"] == pytest.approx(4 / 8)
    assert both.targets(["U1", "U2"])["U1"]["switches"] == 0


def test_nothing_is_null():
    """No frame at all: shares and errors are null, counts are zero."""
    block = summary_block("active", Sensing.of_nothing(2), None, 1.0)
    for key in ("hit_rate", "matched", "false_per_frame", "false_tracks_per_frame", "ser_dpsk"):
        assert block[key] is None
    assert block["gospa"] == dict.fromkeys(block["gospa"])
    assert block["losses"] == dict.fromkeys(LOSSES, 0)


def test_targets_alone_are_scored_and_terminals_stand_beside():
    """Of three frames UAV 0, a target, is in view in two, found in one and tracked in two; UAV 1, a
    terminal, is in view in three and found in all. Planted bugs: all UAVs in either part; the empty
    picture of all."""
    hits = [(True, True), (False, True), (False, True)]
    rows = [
        row(
            seen=(k > 0, 1),
            hit=np.array(hit) & (k > 0, True),
            tracks=[(5, 0, 1, 0, 0)] * (k > 0),
            gospa_missed=12.5 * (k == 1),
            cooperative=np.array([False, True]),
        )
        for k, hit in zip((1, 2, 0), hits, strict=True)
    ]
    block = summary_block("active", sensing(rows), None, 1.0)
    terminals = block["cooperative"]
    assert (block["in_view"], block["hit_rate"], block["tracked_rate"]) == (2, 0.5, 1.0)
    assert block["counts"]["hit_rate"] == [1, 2] and block["counts"]["tracked_rate"] == [2, 2]
    assert (terminals["in_view"], terminals["hit_rate"]) == (3, 1.0)
    assert terminals["tracked_rate"] == 0.0
    assert block["bounds"] == pytest.approx({"genie": 0.9, "clutter_free": 0.7, "whitened": 0.6})
    assert terminals["bounds"]["genie"] == pytest.approx(0.4)
    levels = {"matched": 20, "windows": 3.01, "straddling": 0.97, "clutter": 3.01}
    assert block["snr_db"] == pytest.approx(levels, abs=0.005)
    assert terminals["snr_db"] == pytest.approx(levels | {"clutter": 0}, abs=0.005)
    assert block["gospa"]["total_m"] == pytest.approx(np.sqrt(12.5 / 3))
    assert block["gospa"]["no_tracks_m"] == pytest.approx(np.sqrt(12.5 * 2 / 3))
    # errors of 1 and 3 cm of the target, of 5 cm of the terminal where both are in view
    told = {"cooperative": np.array([False, True])}
    off = [row(errors=((0.01, 0, 0, 0), (0.05, 0, 0, 0)), **told)]
    off += [row(errors=((0.03, 0, 0, 0), None), **told)]
    block = sensing(off).block()
    assert (block["matched"], block["cooperative"]["matched"]) == (1.0, 0.5)
    assert block["rmse"]["range_m"] == pytest.approx(np.sqrt(5e-4))
    assert block["cooperative"]["rmse"]["range_m"] == pytest.approx(0.05)
    assert sum(block["losses"].values()) == 2
