"""Frames that are read after others have come: their records, what a run says of them, and that a
run that was stopped in between goes on to the same bits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_resume import Stopped, assert_equal_results, stopping_at

import isac_rt as irt
from isac_rt.results.provenance import run_content
from isac_rt.simulation import simulate
from isac_rt.simulation.resume import Resume
from isac_rt.views.tables import data_table

SCENES = Path(__file__).parents[2] / "scenes"
SHIFT = 1.0
"""The AT comes into PT2's view 1.0226 s after the scene's start; the run begins this much later."""


def scenario(acquisition="blind"):
    """A flight of small frames, 5.1 ms apart: PT2 behind the edge of its view at first, one pilot,
    sent before it sees the AT."""
    return irt.load(
        SCENES / "paper_swarm_consistent.yaml",
        [
            f"swarm.AT.position_m=[0, {10 * SHIFT}, 300]",
            f"swarm.PT1.position_m=[-8, {8 + 15 * SHIFT}, 300]",
            f"swarm.PT2.position_m=[4, {-8 + 20 * SHIFT}, 300]",
            "radio.samples_per_chirp=256",
            "radio.chirps_per_frame=48",
            "frame_interval_s=0.0051",
            "modulation.acquisition_frames=1",
            "modulation.pilot_every_frames=null",
            f"receivers={{link_acquisition: {acquisition}, symbol_decision: beams}}",
            "cooperation=tracks",
            "compare={pilots: {receivers: {link_acquisition: pilots}}}",
        ],
        frames=14,
    )


@pytest.fixture(scope="module")
def whole():
    return simulate.run(scenario(), snapshots=2)


def test_late_frames_are_amended(whole):
    """PT2 sees the AT from frame 4 or 5 on. Every data frame from then on is read, some of them
    late, each symbol right; with pilots alone none is, and PT1 reads all of its frames at once
    with either. Planted bugs: the record of another frame amended, the symbols of the frame that
    read it counted, the late frame left as erased in the dataset or in the summary."""
    d = whole.dataset.sel(observer="PT2")
    seen = d.in_view.sel(uav="AT").values & d.modulated.values
    first = int(np.flatnonzero(seen)[0])
    assert 2 <= first <= 6
    waits = d.latency_frames.values
    assert (waits[seen] >= 0).all() and (waits[~seen] == -1).all() and waits.max() >= 1
    assert np.array_equal(d.decoded.values, seen)
    total = d.symbol_total.values
    assert (total[seen] > 0).all()
    assert not d.symbol_errors.values[seen].any() and not d.symbol_erased.values[seen].any()
    assert np.array_equal(d.symbol_errors.values[~seen], total[~seen])
    block = whole.summary["terminals"]["PT2"]
    late = waits[seen]
    assert block["latency_frames"] == {
        "sent": 13,
        "read": int(seen.sum()),
        "erased": int((~seen & d.modulated.values).sum()),
        "misread": 0,
        "late": int((late > 0).sum()),
        "mean": float(late.mean()),
        "most": int(late.max()),
    }
    assert block["ser_delay"] == pytest.approx(1 - seen.sum() / 13)
    assert whole.summary["terminals"]["PT1"]["latency_frames"]["read"] == 13
    assert whole.summary["links"]["AT->AT"]["latency_frames"] is None
    pilots = whole.summary["compared"]["pilots"]["terminals"]
    assert pilots["PT2"]["latency_frames"]["read"] == 0
    assert pilots["PT1"]["latency_frames"]["read"] == 13
    row = next(r for r in data_table(whole.summary).rows if r[0] == "AT to PT2")
    assert list(row[-3:]) == [str(seen.sum()), str((late > 0).sum()), str(late.max())]


def test_messages_on_late_frames_come_late(whole):
    """What the AT tells PT2 takes two frames; the message that ends after the first frame that PT2
    reads comes with the one that is read late, those before are lost. Planted bugs: late frames not
    carried; counted as lost for good."""
    d = whole.dataset.sel(owner="PT2")
    lost, late = d.fused_lost.values, d.fused_late.values
    waits = whole.dataset.latency_frames.sel(observer="PT2").values
    first = int(np.flatnonzero(waits >= 0)[0])
    assert late.sum() >= 1 and not late[: first + 1].any()
    told = whole.summary["swarm"]["terminals"]["PT2"]
    assert told["messages_late"] == late.sum()
    assert told["messages_lost"] == lost[: first + 1].sum() == lost.sum() - late.sum()


def test_a_run_stopped_before_a_frame_is_read_goes_on(whole, tmp_path):
    """Stopped with frames that wait, and after they were read: rows that an earlier entry holds
    change. Planted bugs: changed rows not kept, or not taken up."""
    one = scenario()
    waits = whole.dataset.latency_frames.sel(observer="PT2").values
    late = int(np.flatnonzero(waits > 0)[0])
    for stop in (late + 1, late + int(waits[late]) + 2, None):
        resume = Resume(tmp_path, run_content(one, 2), every=0.0)
        try:
            again = simulate.run(one, snapshots=2, resume=resume, progress=stopping_at(stop))
        except Stopped:
            assert stop is not None
    assert_equal_results(again, whole)
