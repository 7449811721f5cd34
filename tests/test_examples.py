"""The examples in the docstrings are run."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path

import pytest

from isac_rt.scenario.file import load
from isac_rt.simulation.simulate import run

PACKAGE = Path(__file__).parents[1] / "isac_rt"
NAMES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if "\n    >>> " in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", NAMES)
def test_examples_show_what_they_say(name, monkeypatch):
    """Planted bug: (1, 1) as the passes of the two links in frame/link.py."""
    monkeypatch.chdir(PACKAGE.parent)
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    found = doctest.testmod(import_module(name), optionflags=flags)
    assert found.attempted and not found.failed


def test_there_are_examples():
    assert "isac_rt.frame.link" in NAMES


def test_the_own_sensor_of_the_docs_sees_its_targets():
    """scenes/fmcw_sensor.yaml as docs/radar.md has it, without its clutter."""
    scene = PACKAGE.parent / "scenes" / "fmcw_sensor.yaml"
    scenario = load(scene, ["clutter.model=none", "noise.noise_figure_db=8"], frames=4)
    radar = run(scenario, threads=1).summary["terminals"]["radar"]
    assert radar["ser_dpsk"] is None and radar["hit_rate"] >= 0.75
    assert radar["rmse"]["range_m"] < 0.1 and radar["rmse"]["velocity_mps"] < 0.1
