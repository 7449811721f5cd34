"""An installed wheel in an empty folder: it runs, and says where the studies are."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    """`isac-rt` from a wheel, in a virtual environment that sees the locked packages."""
    folder = tmp_path_factory.mktemp("wheel")
    venv = folder / "venv"
    build = f"from flit_core import buildapi; print(buildapi.build_wheel({str(folder)!r}))"

    def run(*command: str | Path, cwd: Path = folder) -> str:
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()[-1] if done.stdout.strip() else ""

    wheel = run(sys.executable, "-c", build, cwd=ROOT)
    run(sys.executable, "-m", "venv", "--without-pip", venv)
    python = venv / "bin" / "python"
    options = ("--quiet", "--no-deps", "--no-index", "--disable-pip-version-check")
    run(sys.executable, "-m", "pip", "--python", python, "install", *options, folder / wheel)
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    locked = sysconfig.get_path("purelib")
    (Path(run(python, "-c", where)) / "locked.pth").write_text(locked + "\n")
    return venv / "bin" / "isac-rt"


@pytest.mark.parametrize("command", ["reproduce", "validate", "bench"])
def test_studies_from_a_wheel_say_where_they_are(program, tmp_path, command):
    """Planted bug: the working folder taken for the checkout."""
    for name in ("reproduce", "tests", "benchmarks"):
        (tmp_path / name).mkdir()
    (tmp_path / "pyproject.toml").write_text("[project]\nname = 'isac_rt'\n")
    free = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [program, command], cwd=tmp_path, capture_output=True, text=True, env=free
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and "source distribution" in done.stderr
