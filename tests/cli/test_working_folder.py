"""Files of a stranger's folder that libraries look for in the working folder: none is obeyed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCENES = Path(__file__).parents[2] / "scenes"
PLUGINS = ("scene", "sphere", "diffuse", "uniform", "independent")
"""Parts of the ray tracer that Mitsuba looks for in `plugins/` of the working folder."""
SMALL = """\
city: {source: canyon}
frames: 4
radio: {samples_per_chirp: 64, chirps_per_frame: 12}
swarm:
  A: {role: active, position_m: [0, 0, 12]}
  T: {role: target, position_m: [5, 9, 10]}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with everything that a library might take its settings or its code from."""
    (tmp_path / "plugins").mkdir()
    for name in PLUGINS:
        (tmp_path / "plugins" / f"{name}.so").write_text("x")
    for name in ("dask.yaml", "distributed.yaml", ".netrc", "sitecustomize.py", "usercustomize.py"):
        (tmp_path / name).write_text("raise: SystemExit")
    for name in ("proj.db", "pyproj.ini", ".drjit", "fonts.conf", "setup.cfg", ".env"):
        (tmp_path / name).write_text("raise: SystemExit")
    (tmp_path / "matplotlibrc").write_text("animation.ffmpeg_path: ./evil\nbackend: module://evil")
    (tmp_path / "s.yaml").write_text(SMALL)
    return tmp_path


def command(*arguments: str, folder: Path, before: tuple[str, ...] = ()) -> subprocess.Popen:
    program = "import sys; from isac_rt.cli.cli import main; sys.exit(main())"
    python = [sys.executable, "-P", "-c", program]  # as the command: without the folder itself
    return subprocess.run(
        [*before, *python, *arguments], cwd=folder, capture_output=True, text=True
    )


def test_settings_of_figures_are_not_those_of_the_folder(folder):
    code = (
        "from isac_rt.runtime import shut_out_working_folder; shut_out_working_folder()\n"
        "import matplotlib; print(matplotlib.rcParams['animation.ffmpeg_path'])"
    )
    asked = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=folder, capture_output=True, text=True
    )
    assert asked.stdout == "ffmpeg\n"


def test_a_compiler_set_up_by_the_folder_is_one_message(folder):
    """Planted bug: looked for after numba is imported."""
    (folder / ".numba_config.yaml").write_text("CACHE_DIR: cache\nDISABLE_JIT: 1\n")
    done = command("run", "s.yaml", "--out", "out", folder=folder)
    assert done.returncode == 2
    assert re.fullmatch(r"\.numba_config\.yaml in the working folder .*\n", done.stderr)


def test_the_ray_tracer_takes_no_library_of_the_folder(folder):
    """Planted bug: activate() leaves Mitsuba the working folder to look in."""
    code = (
        "from isac_rt.runtime import activate; activate()\n"
        "import mitsuba as mi; mi.load_dict({'type': 'scene', 's': {'type': 'sphere'}})\n"
        "print('loaded')"
    )
    asked = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=folder, capture_output=True, text=True
    )
    assert asked.stdout == "loaded\n", asked.stderr


@pytest.mark.skipif(not shutil.which("strace"), reason="needs strace")
def test_a_run_opens_nothing_but_the_scenario(folder):
    """Planted bug: matplotlib is imported in the working folder."""
    trace = folder.parent / "trace"
    calls = "trace=open,openat,execve,chdir"
    strace = ("strace", "-f", "-qq", "-e", calls, "-o", str(trace))
    done = command("run", "s.yaml", "--out", "out", folder=folder, before=strace)
    assert done.returncode == 0, done.stderr
    lines = [line.split(maxsplit=1) for line in trace.read_text().splitlines()]
    moved = re.compile(rf'chdir\("(?!/"|{re.escape(str(folder))}")')
    elsewhere = {pid for pid, call in lines if moved.match(call)}  # git, in the program's folder
    named = re.compile(rf'AT_FDCWD, "({re.escape(str(folder))}/|(?=[^/"]))([^"]+)", O_RD')
    opened = {
        found[2] for pid, call in lines if pid not in elsewhere and (found := named.search(call))
    }
    inside = {(folder / name).resolve() for name in opened}  # numba opens the program's by ../
    inside = {place for place in inside if place.is_relative_to(folder)}
    names = {str(place.relative_to(folder)) for place in inside}
    assert {name for name in names - {"."} if not name.startswith("out")} == {"s.yaml"}
