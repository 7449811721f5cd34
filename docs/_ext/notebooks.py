"""Fills the pages `notebooks/NAME.md` with the notebooks that `make notebooks` ran."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import nbformat
import plotly.io
from nbconvert import MarkdownExporter

PLOTLY = "application/vnd.plotly.v1+json"
ROOT = Path(__file__).parents[2]


def take_out_views(notebook: nbformat.NotebookNode, stem: str) -> dict[str, dict]:
    """Replace each plotly figure by a frame that shows a page; return the figures by page."""
    views = {}
    for k, cell in enumerate(notebook.cells):
        for output in cell.get("outputs", []):
            figure = output.get("data", {}).pop(PLOTLY, None)
            if figure is None:
                continue
            figure.pop("config", None)
            page = f"{stem}_{k}.html"
            views[page] = figure
            output.data.clear()
            output.data["text/markdown"] = (
                f'<iframe src="../_static/{page}" width="100%" height="520"></iframe>'
            )
    return views


def fill(app: Any, name: str, source: list[str]) -> None:
    """Put a notebook's Markdown in place of its page's text, with its pictures inside."""
    folder, _, stem = name.rpartition("/")
    if folder != "notebooks":
        return
    notebook = nbformat.read(ROOT / "notebooks" / f"{stem}.ipynb", as_version=4)
    take_out_views(notebook, stem)
    exporter = MarkdownExporter(exclude_input_prompt=True, exclude_output_prompt=True)
    text, resources = exporter.from_notebook_node(notebook, resources={"unique_key": stem})
    for picture, data in resources["outputs"].items():
        encoded = base64.b64encode(data).decode("ascii")
        text = text.replace(f"({picture})", f"(data:image/png;base64,{encoded})")
    source[0] = text


def write_views(app: Any, error: Exception | None) -> None:
    """Write the pages that the frames show into the site."""
    if error is not None or app.builder.format != "html":
        return
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        views = take_out_views(nbformat.read(path, as_version=4), path.stem)
        for page, figure in views.items():
            out = Path(app.outdir) / "_static" / page
            plotly.io.write_html(figure, out, include_plotlyjs="directory", validate=False)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("source-read", fill)
    app.connect("build-finished", write_views)
    return {"parallel_read_safe": True}
