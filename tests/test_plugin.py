"""Parts of another package, `tests/plugin/`, are used without a change in this one."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
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


COMMANDS = (
    ("count-walls", "scenario.yaml"),
    ("--help",),
    ("dataset", "data.yaml", "--out", "data", "--workers", "1"),
    ("sweep", "sweep.yaml", "--out", "points", "--workers", "2"),
)
WEAK = ["propagation.model=free_space", "noise.snr_db=-25"]
OWN_PARTS = ("clutter_detector=far", "passive_detector=plain", "symbol_decision=late")
RUNS = {
    "attenuated": [],
    "free": ["propagation.model=free_space"],
    "own": WEAK,
    "theirs": [*WEAK, *(f"receivers.{part}" for part in OWN_PARTS)],
}
PROGRAM = """
import contextlib, io, json, sys
import isac_rt as irt
from isac_rt.cli.cli import main

def said(command):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        try:
            status = main(command)
        except SystemExit as end:
            status = end.code
    assert not status, command
    return out.getvalue()

def made(changes):
    run = irt.run(irt.load("scenario.yaml", changes))
    return run.summary | {"power": run.dataset.reference_power.values.tolist()}

if __name__ == "__main__":
    commands, runs = json.loads(sys.argv[1])
    print(json.dumps([[said(c) for c in commands], {n: made(c) for n, c in runs.items()}]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("plugin")
    (place / "scenario.yaml").write_text(SCENARIO)
    (place / "sweep.yaml").write_text(SWEEP)
    (place / "data.yaml").write_text(DATA)
    (place / "program.py").write_text(PROGRAM)
    return place


@pytest.fixture(scope="module")
def made(folder) -> tuple[list[str], dict[str, dict]]:
    """What the commands print and the runs return in a process where the example package is
    installed."""
    path = os.pathsep.join([str(HERE.parent), str(HERE / "plugin")])
    ended = subprocess.run(
        [sys.executable, "program.py", json.dumps([COMMANDS, RUNS])],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def test_a_command_of_another_package(made):
    """Planted bug: `list_commands` without those that are installed."""
    count, text, *_ = made[0]
    assert count == "2 faces\n" and "count-walls" in text


def test_a_city_and_a_propagation_model_of_another_package(made):
    """Planted bug: `make_propagation` takes free space for every model that is not its own."""
    power = [np.array(made[1][name]["power"]) for name in ("attenuated", "free")]
    both = (power[0] > 0) & (power[1] > 0)
    assert both.any()
    # noise alone changes the ratio; 10 dB SNR in some 10^6 samples
    assert power[0][both] / power[1][both] == pytest.approx(0.01, rel=0.02)
    assert made[1]["attenuated"]["city"]["name"] == "wall"


def test_detectors_and_a_symbol_reader_of_another_package(made):
    """A detector that finds nothing, and a reader that is always wrong. Planted bug: the tables of
    the chain asked first."""
    own, theirs = (made[1][name]["links"] for name in ("own", "theirs"))
    assert own["AT->PT1"]["ser_delay"] == 0 and theirs["AT->PT1"]["ser_delay"] == 1
    assert own["AT->AT"]["hit_rate"] == 1 and theirs["AT->AT"]["hit_rate"] == 0


@pytest.mark.usefixtures("made")
def test_a_data_set_and_a_sweep_over_parts_of_another_package(folder):
    """Planted bug: workers that are not given the client's path."""
    assert len(list((folder / "data").glob("*/*.tar"))) == 2
    points = (folder / "points/points").glob("*/*.json")
    assert [json.loads(file.read_text())["status"] for file in points] == ["done"] * 2


def test_names_that_nobody_registered_are_refused():
    """Planted bug: `_checked` returns every name."""
    with pytest.raises(ValueError, match="must be free_space or ray_traced"):
        registry.PROPAGATION_MODELS._checked("guess")
    with pytest.raises(UserError, match="no propagation_models guess; there are free_space"):
        registry.PROPAGATION_MODELS.load("guess")


def test_every_extension_is_there_and_asked_for():
    """Planted bug: `extensions.access.feedback:exchanged`; a line that nothing asks for."""
    assert all(callable(registry.extension(part)) for part in registry.EXTENSIONS)
    sources = "".join(file.read_text() for file in (HERE.parent / "isac_rt").rglob("*.py"))
    asked_for = re.findall(r'(?:\bextension|_map_reader)\("(\w+)"', sources)
    assert sorted(set(asked_for)) == sorted(registry.EXTENSIONS)
