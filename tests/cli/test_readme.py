"""Every command of the README and of the first guide runs, as it stands but for fewer frames and a
folder of its own; so do the scenario and the Python lines."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from isac_rt.cli.cli import main

ROOT = Path(__file__).parents[2]
PAGES = [(ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/start.md")]
BLOCKS = [re.findall(r"^```(\w+)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL) for page in PAGES]
COMMANDS = list(
    dict.fromkeys(
        line.split("#")[0].strip()
        for page in BLOCKS
        for language, block in page
        for line in block.splitlines()
        if language == "bash" and line.startswith("isac-rt ")
    )
)
LONG = ("sweep", "munich", "paper_swarm", "street_canyon.yaml", "validate")
"""Parts of commands that take more than seconds."""


def block(language: str) -> str:
    """The README's only block in a language."""
    (found,) = (text for of, text in BLOCKS[0] if of == language)
    return found


def shortened(command: str) -> list[str]:
    words = shlex.split(command)[1:]
    if words[0] == "run" and "--frames" not in words:
        words += ["--frames", "4"]
    return words


def test_the_pages_have_commands():
    assert len(COMMANDS) >= 12
    assert {"run", "view", "paths", "sweep", "reproduce", "doctor", "new", "animate"} <= {
        shlex.split(c)[1] for c in COMMANDS
    }


def test_the_readme_is_read_in_one_go():
    """Scenario and Python lines stay short. Planted bug: a scenario of thirty lines."""
    assert len(PAGES[0].split()) < 1100
    assert len(block("yaml").splitlines()) <= 17
    assert len(block("python").splitlines()) <= 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "scenes", place / "scenes")
    return place


@pytest.mark.slow
@pytest.mark.sionna
def test_the_quick_commands_run_in_their_order(folder, monkeypatch, capsys):
    """One after the other, since some need what others wrote. Planted bug: a renamed option."""
    monkeypatch.chdir(folder)
    for command in COMMANDS:
        if not any(part in command for part in LONG):
            assert main(shortened(command)) == 0, f"{command}\n{capsys.readouterr().err}"
    for file in ("mine.yaml", "runs/quarter/run.gif", "scene.html", "runs/quarter/report.html"):
        assert (folder / file).stat().st_size > 0, file


@pytest.mark.sionna
def test_the_scenario_runs(folder, monkeypatch, capsys):
    """Planted bug: a key that is no longer there."""
    monkeypatch.chdir(folder)
    (folder / "corner.yaml").write_text(block("yaml"), encoding="utf-8")
    assert main(["plan", "corner.yaml"]) == 0, capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.sionna
@pytest.mark.parametrize("command", [c for c in COMMANDS if any(part in c for part in LONG)])
def test_the_long_commands_run(command, folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert main(shortened(command)) == 0


@pytest.mark.sionna
def test_the_python_lines_run(monkeypatch):
    monkeypatch.chdir(ROOT)
    space: dict[str, object] = {}
    exec(block("python"), space)
    assert space["results"].summary["frames"] == 4
