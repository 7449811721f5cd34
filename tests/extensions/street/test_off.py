"""What of the street takes part in a run that asks for none of it."""

from __future__ import annotations

import os
import subprocess
import sys

PROGRAM = """
import sys
import isac_rt as irt
from isac_rt.simulation.audit import make_plan
uavs = {"U": {"role": "target", "position_m": [1, 9, 2]}}
uavs["radar"] = {"role": "active", "position_m": [0, 0, 1], "boresight": [0, 1, 0]}
sensor = {"sensor": "awr1843", "receiver_preset": "plain", "radio": {"chirps_per_frame": 24}}
scenario = irt.load({"frames": 2, "swarm": uavs, **sensor})
assert len(irt.run(scenario, progress=False).dataset.frame) == 2
make_plan(irt.prepare(scenario))
print(sorted(m for m in sys.modules if m.startswith("isac_rt.extensions.street")))
"""


def test_a_run_without_the_street_runs_none_of_its_code():
    """So its bits are those of a program without it: no module of the folder is imported. Planted
    bug: `moving_centres` of a swarm without rotors and extent."""
    command = [sys.executable, "-W", "ignore", "-c", PROGRAM]
    run = subprocess.run(command, env=os.environ, capture_output=True, text=True, check=True)
    assert run.stdout.split("\n")[-2] == "[]"
