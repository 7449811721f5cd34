"""The notebooks run, cell after cell, as they stand. Small as they are they take half a minute."""

from __future__ import annotations

from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "notebooks"
SOURCES = sorted(FOLDER.glob("*.py"))
LONG = ("6_own_receiver", "7_sweep", "9_learned_detector", "10_learned_labels")
"""Left to the slow tests, which run each in a kernel."""
QUICK = [
    pytest.param(source, marks=pytest.mark.slow if source.stem in LONG else ())
    for source in SOURCES
]


def test_there_are_notebooks():
    assert len(SOURCES) >= 7


@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.stem)
def test_what_jupyter_opens_is_in_step(source):
    """The .ipynb file has the cells of its source, every one run without an error (`make
    notebooks`). Planted bug: a cell changed in one of them."""
    jupytext = pytest.importorskip("jupytext")
    expected, found = jupytext.read(source), jupytext.read(source.with_suffix(".ipynb"))
    for one, other in zip(expected.cells, found.cells, strict=True):
        assert (one.cell_type, one.source) == (other.cell_type, other.source)
        if other.cell_type == "code":
            assert other.execution_count is not None
            assert all(output.output_type != "error" for output in other.outputs)


@pytest.mark.sionna
@pytest.mark.parametrize("source", QUICK, ids=lambda p: p.stem)
def test_a_notebook_runs(source, monkeypatch):
    """Every code cell in one name space, as a kernel would; figures are drawn to nowhere."""
    jupytext = pytest.importorskip("jupytext")
    import matplotlib

    matplotlib.use("Agg", force=True)
    monkeypatch.chdir(FOLDER)
    notebook = jupytext.read(source)
    assert notebook.cells[0].cell_type == "markdown"
    assert sum(cell.cell_type == "markdown" for cell in notebook.cells) >= 3
    space: dict[str, object] = {"__name__": "__main__"}
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type == "code":
            exec(compile(cell.source, f"{source.name}[{number}]", "exec"), space)


@pytest.mark.slow
@pytest.mark.sionna
@pytest.mark.parametrize("source", SOURCES, ids=lambda p: p.stem)
def test_a_notebook_runs_in_a_kernel(source):
    """The same in Jupyter's own kernel."""
    jupytext, nbclient = pytest.importorskip("jupytext"), pytest.importorskip("nbclient")
    nbclient.NotebookClient(
        jupytext.read(source),
        timeout=600,
        kernel_name="python3",
        resources={"metadata": {"path": str(FOLDER)}},
    ).execute()
