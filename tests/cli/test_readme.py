"""Every command of the README runs, as it stands but for fewer frames and a folder of its own."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from isac_rt.cli.cli import main

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [
    line.split("#")[0].strip() for line in re.findall(r"^    (isac-rt .*)$", TEXT, re.MULTILINE)
]
LONG = ("sweep", "munich", "paper_swarm", "street_canyon.yaml", "validate")
"""Parts of commands that take more than seconds."""


def shortened(command: str) -> list[str]:
    words = shlex.split(command)[1:]
    if words[0] == "run" and "--frames" not in words:
        words += ["--frames", "5"]
    return words


def test_the_readme_has_commands():
    assert len(COMMANDS) >= 12
    assert {"run", "view", "paths", "sweep", "reproduce", "doctor", "new", "animate"} <= {
        shlex.split(c)[1] for c in COMMANDS
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "scenes", place / "scenes")
    return place


@pytest.mark.sionna
def test_the_quick_commands_run_in_their_order(folder, monkeypatch, capsys):
    """One after the other, since some need what others wrote. Planted bug: a renamed option."""
    monkeypatch.chdir(folder)
    for command in COMMANDS:
        if not any(part in command for part in LONG):
            assert main(shortened(command)) == 0, f"{command}\n{capsys.readouterr().err}"
    for file in ("mine.yaml", "runs/quarter/run.gif", "scene.html", "runs/quarter/report.html"):
        assert (folder / file).stat().st_size > 0, file


@pytest.mark.slow
@pytest.mark.sionna
@pytest.mark.parametrize("command", [c for c in COMMANDS if any(part in c for part in LONG)])
def test_the_long_commands_run(command, folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert main(shortened(command)) == 0


@pytest.mark.sionna
def test_the_python_lines_run(monkeypatch):
    monkeypatch.chdir(ROOT)
    block = TEXT.split("## From Python")[1].split("##")[0]
    space: dict[str, object] = {}
    exec("\n".join(line[4:] for line in block.splitlines() if line.startswith("    ")), space)
    assert space["results"].summary["frames"] == 4
