"""Progress that is shown unasked: on a terminal and in a notebook, nowhere else."""

from __future__ import annotations

from pathlib import Path

import pytest

import isac_rt as irt
from isac_rt.simulation import progress, simulate
from isac_rt.simulation.progress import followed


def test_a_terminal_shows_a_bar_that_goes(monkeypatch, capsys):
    """Planted bug: the bar on stdout, where it would be part of what a script prints."""
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich's word for a terminal
    monkeypatch.setenv("TERM", "xterm")
    with followed(True, 3) as report:
        report(2, 3)
    said = capsys.readouterr()
    assert "frames" in said.err and not said.out


@pytest.mark.parametrize("asked", [True, False, None])
def test_elsewhere_nothing_is_shown(asked, monkeypatch, capsys):
    """Planted bug: False taken for something that is called."""
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    with followed(asked, 3) as report:
        assert report is None
    assert capsys.readouterr() == ("", "")


def test_a_notebook_shows_a_bar_that_goes(monkeypatch):
    """As HTML, moved and emptied in place. Planted bug: a new output for every frame."""
    shown = []

    class Display:
        def __init__(self, *, display_id=None, **_: object) -> None:
            assert display_id

        def update(self, html) -> None:
            shown.append(html.data)

    ipython = pytest.importorskip("IPython.display")
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr(ipython, "display", lambda html, **said: Display(**said))
    with followed(True, 3) as report:
        report(2, 3)
    assert "value=2 max=3" in shown[0] and shown[1:] == [""]


def test_a_run_shows_its_progress_unless_told(monkeypatch, caplog):
    """The default of `irt.run`; steps go to the standard logger `isac_rt`. Planted bug: no bar
    unless one is handed over."""
    asked = []
    monkeypatch.setattr(
        simulate,
        "followed",
        lambda *said: asked.append(said) or progress.followed(None, 0),
    )
    scene = Path(__file__).parents[2] / "scenes" / "paper_swarm_consistent.yaml"
    scenario = irt.load(scene, frames=4)
    with caplog.at_level("INFO", "isac_rt"):
        irt.run(scenario)
    assert asked == [(True, 4)]
    assert any("first frame" in record.message for record in caplog.records)
