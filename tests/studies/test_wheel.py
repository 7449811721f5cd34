"""An installed wheel in an empty folder: the studies find their scenes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from isac_rt.studies import scene_file

ROOT = Path(__file__).parents[2]


def test_links_to_scenes_lead_to_the_scenes():
    """Planted bug: a link to a scene that was renamed."""
    links = list((ROOT / "isac_rt" / "studies" / "scenes").iterdir())
    assert links and scene_file(links[0].name).parent == links[0].parent
    for link in links:
        assert link.read_text() == (ROOT / "scenes" / link.name).read_text()


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


def ran(program: Path, folder: Path, *words: str) -> str:
    free = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run([program, *words], cwd=folder, capture_output=True, text=True, env=free)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_reproduce_from_a_wheel(program, tmp_path):
    """Planted bug: scenes looked for beside the package."""
    ran(program, tmp_path, "reproduce", "table1", "table2", "--quick")
    written = tmp_path / "runs" / "reproduction" / "table2" / "table2.json"
    assert json.loads(written.read_text())["settings"]["frames"] == 500


@pytest.mark.slow
@pytest.mark.sionna
def test_bench_from_a_wheel(program, tmp_path):
    ran(program, tmp_path, "bench", "end-to-end", "--quick", "--json", "rows.json")
    assert {row["kind"] for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}
