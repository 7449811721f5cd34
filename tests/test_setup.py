"""The Makefile's virtual environment, in a small project of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    alone = {name: text for name, text in os.environ.items() if not name.startswith("PIP_")}
    return subprocess.run(
        ["make", *arguments],
        cwd=folder,
        env=alone | {"PIP_NO_INDEX": "1"},
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("make"), reason="needs make")
def test_an_environment_that_works_stays_where_a_new_one_cannot_be_made(tmp_path):
    """Without a network, after `pyproject.toml` got a newer time. Planted bug: `.venv` cleared
    first."""
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "requirements.lock").write_text(f"numpy==2.0.0 --hash=sha256:{64 * '0'}\n")
    (tmp_path / "pyproject.toml").write_text("")
    (tmp_path / ".venv/bin").mkdir(parents=True)
    (tmp_path / ".venv/bin/isac-rt").write_text("works")
    done = make(tmp_path, "venv")
    assert done.returncode != 0
    assert "numpy" in done.stderr
    assert (tmp_path / ".venv/bin/isac-rt").read_text() == "works"
    assert not (tmp_path / ".venv/.setup-done").exists()
