"""UAVs that hover in a street: one 3 m off a wall, one in open air."""

from __future__ import annotations

from pathlib import Path

import pytest

from isac_rt.scenario.file import load
from isac_rt.simulation import simulate

SCENE = Path(__file__).parents[2] / "scenes" / "street_canyon.yaml"
HOVERING = (
    "clutter={model: field}",
    "noise.tx_power_dbm=12",
    "swarm.U1={role: target, position_m: [8.0, -2.7, 9.6]}",
    "swarm.U4={role: target, position_m: [-1.7, 1.3, 11.9]}",
)


@pytest.mark.slow
@pytest.mark.sionna
def test_uavs_that_hover_are_found_and_followed():
    """Both terminals find and follow both: 14 and 14 of 16 frames at PT1, which needs two frames to
    acquire and three detections, 15 and 15 at the AT. That finds U1, in the cells of its wall, with
    both directions in 11; in the others the wall leaves one open. No track is false."""
    blocks = simulate.run(load(SCENE, HOVERING, frames=16), snapshots=0).summary["terminals"]
    targets = {name: block["targets"] for name, block in blocks.items()}
    assert [targets["PT1"][name]["found"] for name in ("U1", "U4")] == [16, 16]
    assert [targets["PT1"][name]["tracked"] >= 13 for name in ("U1", "U4")] == [True, True]
    assert targets["AT"]["U4"]["found"] == 16
    assert targets["AT"]["U1"]["found"] >= 11
    assert targets["AT"]["U4"]["tracked"] >= 14
    assert targets["AT"]["U1"]["tracked"] >= 13
    assert blocks["PT1"]["false_tracks_per_frame"] < 0.1
    assert blocks["AT"]["false_tracks_per_frame"] < 0.1
