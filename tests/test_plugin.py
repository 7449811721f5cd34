"""Parts of another package, `tests/plugin/`, are used without a change in this one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from isac_rt import registry
from isac_rt.runtime import UserError

HERE = Path(__file__).parent
SCENARIO = """\
frames: 6
city: {source: wall}
propagation: {model: attenuated}
receiver_preset: plain
modulation: {acquisition_frames: 2}
noise: {model: snr}
swarm:
  AT: {role: active, position_m: [0, 0, 10]}
  PT1: {role: passive, position_m: [0, 8.3, 10], boresight: [0, -1, 0]}
"""
SWEEP = """\
name: s
scenario: scenario.yaml
axes: {snr_db: {key: noise.snr_db, values: [3, 13]}}
"""
DATA = """\
name: d
scenario: scenario.yaml
scenes: 2
seed: 3
keep: [tracks]
"""


@pytest.fixture
def isac_rt(tmp_path):
    """Run the command line where the example package is installed."""
    (tmp_path / "scenario.yaml").write_text(SCENARIO)
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    (tmp_path / "data.yaml").write_text(DATA)
    path = os.pathsep.join([str(HERE.parent), str(HERE / "plugin")])

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "isac_rt.cli.cli", *arguments],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": path},
        )

    return run


def test_a_command_of_another_package(isac_rt):
    """Planted bug: `list_commands` without those that are installed."""
    assert isac_rt("count-walls", "scenario.yaml").stdout == "2 faces\n"
    assert "count-walls" in isac_rt("--help").stdout


def test_a_city_and_a_propagation_model_of_another_package(isac_rt, tmp_path):
    """Planted bug: `make_propagation` takes free space for every model that is not its own."""
    done = isac_rt("run", "scenario.yaml", "--out", "out")
    assert done.returncode == 0, done.stderr
    done = isac_rt("run", "scenario.yaml", "--out", "free", "--set", "propagation.model=free_space")
    assert done.returncode == 0, done.stderr
    import xarray as xr

    power = [
        xr.open_dataset(tmp_path / name / "results.nc", engine="h5netcdf").reference_power.values
        for name in ("out", "free")
    ]
    assert power[0].size and (power[0] > 0).any()
    both = (power[0] > 0) & (power[1] > 0)
    assert both.any()
    # noise alone changes the ratio; 10 dB SNR in some 10^6 samples
    assert power[0][both] / power[1][both] == pytest.approx(0.01, rel=0.02)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["city"]["name"] == "wall"


def test_detectors_and_a_symbol_reader_of_another_package(isac_rt, tmp_path):
    """A detector that finds nothing, and a reader that is always wrong. Planted bug: the tables of
    the chain asked first."""
    parts = ("clutter_detector=far", "passive_detector=plain", "symbol_decision=late")
    for name, changes in (("own", ()), ("theirs", parts)):
        options = [word for change in changes for word in ("--set", f"receivers.{change}")]
        power = ("--set", "propagation.model=free_space", "--set", "noise.snr_db=-25")
        done = isac_rt("run", "scenario.yaml", "--out", name, *power, *options)
        assert done.returncode == 0, done.stderr
    links = [
        json.loads((tmp_path / name / "summary.json").read_text())["links"]
        for name in ("own", "theirs")
    ]
    assert links[0]["AT->PT1"]["ser_delay"] == 0 and links[1]["AT->PT1"]["ser_delay"] == 1
    assert links[0]["AT->AT"]["hit_rate"] == 1 and links[1]["AT->AT"]["hit_rate"] == 0


def test_a_data_set_over_parts_of_another_package(isac_rt):
    """Planted bug: as for sweeps."""
    done = isac_rt("dataset", "data.yaml", "--out", "data", "--workers", "2")
    assert done.returncode == 0, done.stderr


def test_a_sweep_over_parts_of_another_package(isac_rt):
    """Planted bug: workers that are not given the client's path."""
    done = isac_rt("sweep", "sweep.yaml", "--out", "points", "--workers", "2")
    assert done.returncode == 0, done.stderr


def test_names_that_nobody_registered_are_refused():
    """Planted bug: `_checked` returns every name."""
    with pytest.raises(ValueError, match="must be free_space or ray_traced"):
        registry.PROPAGATION_MODELS._checked("guess")
    with pytest.raises(UserError, match="no propagation_models guess; there are free_space"):
        registry.PROPAGATION_MODELS.load("guess")
