"""The scenes of the benchmarks: a town that is made on the spot, as large and as full as a
measurement asks."""

from __future__ import annotations

from typing import Any

import numpy as np

from isac_rt.scenario.tree import Scenario


def town(uavs: int = 3, blocks: int = 2, frames: int = 9, **changes: Any) -> Scenario:
    """A street between blocks of houses: an active terminal, a passive one, and `uavs` - 2 targets
    between them.

    Parameters
    ----------
    blocks : houses along each axis, 10 triangles or so each
    changes : of the scenario's tree
    """
    rng = np.random.default_rng(31)
    swarm: dict[str, Any] = {
        "AT": {
            "role": "active",
            "position_m": [0.3, -24.1, 9.2],
            "velocity_mps": [0.4, 5.3, 0.1],
            "boresight": [0, 1, 0],
        },
        "PT": {
            "role": "passive",
            "position_m": [1.7, 21.3, 10.4],
            "velocity_mps": [-0.3, -3.1, 0.2],
            "boresight": [0, -1, 0],
        },
    }
    for i in range(uavs - 2):
        place, velocity = rng.uniform([-6, -15, 6], [6, 15, 13]), rng.normal(0, [1, 4, 0.3])
        swarm[f"U{i}"] = {
            "role": "target",
            "position_m": place.tolist(),
            "velocity_mps": velocity.tolist(),
            "boresight": [0, 1, 0],
        }
    tree = {
        "name": "bench",
        "seed": 3,
        "frames": frames,
        "frame_interval_s": 0.03,
        "receiver_preset": "plain",
        "city": {
            "source": "blocks",
            "street_width_m": 19.0,
            "block_size_m": 16.0,
            "building_height_m": 14.0,
            "blocks_x": blocks + blocks % 2,
            "blocks_y": blocks,
        },
        "swarm": swarm,
        "propagation": {"model": "ray_traced", "max_bounces": 2, "rays": 20_000},
        "accuracy": {"max_untraced_m": 1e6},
    } | changes
    return Scenario.model_validate(tree)


def alone(**changes: Any) -> Scenario:
    """The active terminal of `town` with nothing else in the air."""
    s = town(2, **changes)
    tree = s.model_dump(mode="json", exclude_unset=True)
    return Scenario.model_validate(tree | {"swarm": {"AT": tree["swarm"]["AT"]}})
