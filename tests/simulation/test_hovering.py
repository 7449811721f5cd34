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
    """The passive terminal finds and follows both, the active one that in open air; nothing false
    is confirmed. Tracked were 13 and 13 of 16 frames at PT1 and 14 at the AT: a track is confirmed
    by its third detection, and PT1 needs two frames to acquire. The AT finds U1, in the cells of
    its wall, in 14 of them, and starts no track there: echoes stand still beside it."""
    blocks = simulate.run(load(SCENE, HOVERING, frames=16), snapshots=0).summary["terminals"]
    targets = {name: block["targets"] for name, block in blocks.items()}
    assert [targets["PT1"][name]["found"] for name in ("U1", "U4")] == [16, 16]
    assert [targets["PT1"][name]["tracked"] >= 12 for name in ("U1", "U4")] == [True, True]
    assert targets["AT"]["U4"]["found"] == 16
    assert targets["AT"]["U1"]["found"] >= 12
    assert targets["AT"]["U4"]["tracked"] >= 13
    assert all(block["false_tracks_per_frame"] < 0.1 for block in blocks.values())
