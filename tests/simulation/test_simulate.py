"""Whole runs: the paper's swarm in free space, the street canyon ray traced, and what must not
change a result."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import captures
import numpy as np
import pytest
from captures import Step, flat, save_capture
from threadpoolctl import threadpool_limits

from isac_rt import runtime
from isac_rt.propagation.pathset import PathKind
from isac_rt.scenario.file import load
from isac_rt.simulation import simulate
from isac_rt.simulation.setup import prepare
from isac_rt.track.terminal import PassiveTerminal

SCENES = Path(__file__).parents[2] / "scenes"
FRAMES = {"frames": 6}


@pytest.fixture(scope="module")
def paper():
    return simulate.run(
        load(SCENES / "paper_swarm_consistent.yaml", ["modulation.pilot_every_frames=4"], **FRAMES)
    )


def test_the_papers_swarm_acquires_decodes_and_tracks(paper):
    """Bounds asked for over the whole flight (0.002 m, 0.05 m/s, 0.02 degrees at PT1 after the
    filter; no symbol errors), here on its first frames after acquisition. Planted bug: DPSK removal
    with the index of the symbol instead of the transition."""
    block = paper.summary["terminals"]["PT1"]
    assert block["ser_delay"] == 0
    assert block["ser_dpsk"] == 0
    assert block["erased"] == 0
    d = paper.dataset.sel(observer="PT1", uav="AT")
    for name, bound in (("range", 0.002), ("velocity", 0.05), ("azimuth", np.deg2rad(0.02))):
        error = (d[f"tracked_{name}"] - d[f"truth_{name}"]).values[3:]
        assert np.abs(error).max() < bound, name


def test_a_terminal_that_sees_nothing_says_so(paper):
    """PT2 has the AT behind it: no detection is acquired, nothing decoded, every symbol erased."""
    d = paper.dataset.sel(observer="PT2")
    assert not d.decoded.any()
    assert (d.state == 0).all()
    assert paper.summary["terminals"]["PT2"]["erased"] == 1


def test_receivers_use_no_truth(tmp_path):
    """Samples of a run and public parameters in a file, PT1 run on it in a fresh process:
    bit-identical to PT1 in this one, with one thread of linear algebra in both as in a run: sums
    of two are split."""
    scenario = load(
        SCENES / "paper_swarm_consistent.yaml", ["modulation.acquisition_frames=1"], frames=3
    )
    setup = prepare(scenario)
    live = PassiveTerminal(
        setup.waveform, setup.antennas, scenario.receivers, scenario.tracking, 8, 1.0
    )
    steps, expected = [], {}
    for frame in range(3):
        now = setup.frame(frame)
        steps.append(
            Step(
                now.samples(("AT", "PT1")),
                now.poses["PT1"],
                setup.timetable.epoch(frame),
                setup.timetable.modulated(frame),
            )
        )
        with threadpool_limits(limits=1):
            expected |= flat(frame, *live.step(*steps[-1][:4]))
    file, out = tmp_path / "capture.npz", tmp_path / "out.npz"
    save_capture(file, steps, setup.antennas, scenario.receivers, scenario.tracking)
    command = [sys.executable, captures.__file__, file, out]
    environment = os.environ | dict([runtime.LINEAR_ALGEBRA])
    subprocess.run(command, check=True, timeout=300, env=environment)
    with np.load(out) as found:
        assert expected["2/bits"].size
        for name, value in expected.items():
            assert np.array_equal(found[name], value, equal_nan=value.dtype.kind == "f"), name


@pytest.mark.sionna
def test_street_canyon_end_to_end():
    """Every kind of path is in the ledger, PT1 decodes all data frames, the AT finds U1 and both
    agree with the truth."""
    results = simulate.run(load(SCENES / "street_canyon.yaml", frames=6))
    counts = results.summary["paths"]
    assert all(counts[kind.name.lower()] > 0 for kind in PathKind)
    block = results.summary["terminals"]["PT1"]
    assert block["ser_delay"] == 0
    assert block["ser_dpsk"] < 0.01
    d = results.dataset.sel(observer="AT", uav="U1")
    error = (d.detected_range - d.truth_range).values
    assert np.isfinite(error).sum() >= 3
    assert (
        np.nanmax(np.abs(error)) < 0.25
    )  # one range cell: clutter in the same cell pulls the estimate
    assert results.summary["fidelity"]["paths_contradicted"] == 0
