"""What the clutter field costs beside re-tracing, in one run: `pytest -m slow -s
tests/propagation/test_clutter_cost.py`."""

from __future__ import annotations

from dataclasses import replace
from time import process_time

import numpy as np
import pytest

from benchmarks.clutter import sionna_scene, traced_anew
from isac_rt import scenario
from isac_rt.frame.antennas import antennas_of
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.simulation.setup import propagation_in, swarm_of
from isac_rt.world.city import load_city

pytestmark = [pytest.mark.sionna, pytest.mark.slow]
FRAME = 7.7824e-3
FRAMES = 52  # 4 m of flight at 10 m/s
PATHS = 100_000


def tracer(city, **clutter):
    s = scenario.Scenario.model_validate(
        {
            "frames": 257,
            "swarm": {
                "A": {
                    "role": "active",
                    "position_m": [34, 54, 21],
                    "velocity_mps": [9.86, -1.6, 0.3],
                    "boresight": [1, -0.1, 0],
                }
            },
            "receiver_preset": "plain",
            "city": {"source": "builtin", "name": "munich"},
            "propagation": {"model": "ray_traced", "max_bounces": 0, "leakage": {"enabled": False}},
            "clutter": clutter,
        }
    )
    w = waveform_of(s.radio, s.array)
    return (
        propagation_in(city, s),
        swarm_of(s),
        antennas_of(s.array, w),
    )


def test_advancing_is_far_cheaper_than_tracing_anew():
    """1e5 scatterers in contiguous frames (gain, delay, rate, directions; tests of sight every half
    metre included) against Sionna's diffuse solution with as many paths, interleaved, by processor
    time: at least 15 times faster; at most 126 bytes a scatterer with one link; set-up within 30
    s."""
    city = load_city(scenario.City(source="builtin", name="munich"), ".", 77e9, (34.0, 54.0, 21.0))
    begin = process_time()
    model, swarm, antennas = tracer(city, model="field", cell_area_per_metre_m=0.0113)
    setup = process_time() - begin
    place = swarm.poses(0.0)["A"].position - city.origin
    scene = sionna_scene(city, 77e9, place)
    scatterers = len(model.field.cells)
    advance, whole, trace, found = [], [], [], []
    for block in range(4):
        seconds = np.zeros(2)
        for frame in range(FRAMES // 4):
            time = (
                100 * (block == 0) + FRAMES // 4 * block + frame + 0.5
            ) * FRAME  # the first block warms up elsewhere
            pose = swarm.poses(time)["A"]
            local = replace(pose, position=pose.position - city.origin)
            begin = process_time()
            seen = model.field.seen(LinkState(Link("A", "A"), time, local, local))
            gain = model.field.cells.amplitude[seen.index] * seen.magnitude
            middle = process_time()
            paths = model.field.paths(LinkState(Link("A", "A"), time, local, local), antennas)
            seconds += middle - begin, process_time() - middle
        advance.append(seconds[0] / (FRAMES // 4) / scatterers * PATHS)
        whole.append(seconds[1] / (FRAMES // 4) / scatterers * PATHS)
        for _ in range(2):
            begin = process_time()
            hits = traced_anew(scene, local.position, 160_000)
            trace.append((process_time() - begin) / len(hits) * PATHS)
            found.append(len(hits))
    size = (model.field.nbytes + seen.nbytes + gain.nbytes) / scatterers
    ratio = np.median(trace[2:]) / np.median(advance[1:])
    print(
        f"set-up {setup:.1f} s for {model.field.num_candidates} candidates, {scatterers} kept, "
        f"{len(paths)} seen"
    )
    print(
        f"per 1e5: advance {1e3 * np.median(advance[1:]):.1f} ms (its PathSet "
        f"{1e3 * np.median(whole[1:]):.1f} ms), "
        f"re-trace {1e3 * np.median(trace[2:]):.0f} ms ({found[-1]} paths), ratio {ratio:.1f}; "
        f"{size:.0f} B a scatterer"
    )
    assert scatterers == pytest.approx(PATHS, rel=0.3)
    assert ratio >= 15
    assert size <= 126
    assert setup <= 30
