"""The public face: what `import isac_rt` offers to people, editors and type checkers."""

from __future__ import annotations

import ast
import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

import isac_rt

ROOT = Path(__file__).parent.parent


def test_editors_see_the_names_that_are_there_at_run_time():
    """Planted bug: a name in the table and not among the imports, or from another module."""
    tree = ast.parse((ROOT / "isac_rt" / "__init__.py").read_text())
    imported = {
        alias.asname: node.module.removeprefix("isac_rt.")
        for block in tree.body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.name == alias.asname
    }
    assert imported == isac_rt._HOME
    for name in imported:
        assert getattr(isac_rt, name) is not None


def test_names_complete_and_misspelt_ones_are_refused():
    assert {"load", "run", "PathSet", "__version__"} <= set(dir(isac_rt))
    assert dir(isac_rt) == isac_rt.__all__
    with pytest.raises(AttributeError, match="'isac_rt' has no attribute 'lod'"):
        _ = isac_rt.lod


def test_the_version_is_that_of_the_package():
    assert isac_rt.__version__ == importlib.metadata.version("isac_rt")


def test_import_loads_nothing_heavy():
    """Planted bug: `import numpy` in isac_rt/__init__.py."""
    heavy = ("numpy", "xarray", "matplotlib", "pydantic", "mitsuba", "numba")
    code = f"import sys, isac_rt; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_type_checkers_see_types(tmp_path):
    """Planted bug: the names without their TYPE_CHECKING imports (each is then `Any`)."""
    file = tmp_path / "used.py"
    file.write_text(
        "import isac_rt as irt\n"
        "reveal_type(irt.load('s.yaml'))\n"
        "reveal_type(irt.run)\n"
        "irt.lod('s.yaml')\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--follow-imports=silent", str(file)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert 'Revealed type is "isac_rt.scenario.tree.Scenario"' in done.stdout, done.stdout
    assert "-> isac_rt.results.recorder.Results" in done.stdout, done.stdout
    assert 'Module has no attribute "lod"' in done.stdout, done.stdout


def test_wrong_calls_say_what_to_give():
    """Planted bugs: a frame that the run has not is traced; names to keep that do nothing; an
    attribute error for a path; an override's letters taken for overrides."""
    target = {"role": "target", "position_m": [0, 20, 9]}
    tree = {
        "sensor": "awr1843",
        "swarm": {"A": {"role": "active", "position_m": [0, 0, 9]}, "T": target},
    }
    scenario = isac_rt.load(tree, "frames=2")
    setup = isac_rt.prepare(scenario)
    for number in (-1, 2):
        with pytest.raises(ValueError, match=f"frame {number}: there are 0 to 1"):
            setup.frame(number)
    assert repr(setup.frame(1)) == "<Frame 1: A->A>"
    with pytest.raises(ValueError, match="keep: sample: there is samples alone"):
        isac_rt.run(scenario, setup=setup, keep=["sample"])
    with pytest.raises(TypeError, match=r"irt\.load"):
        isac_rt.run("scene.yaml")
