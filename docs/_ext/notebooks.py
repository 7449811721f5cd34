"""The notebooks as pages: what `make notebooks` wrote, with its pictures and its views to turn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import plotly.io
from nbconvert import MarkdownExporter

PLOTLY = "application/vnd.plotly.v1+json"
ROOT = Path(__file__).parents[2]


def with_frames(notebook: nbformat.NotebookNode, stem: str, views: Path) -> None:
    """Put a page of its own into ``views`` for each plotly figure, and a frame in its place."""
    for k, cell in enumerate(notebook.cells):
        for output in cell.get("outputs", []):
            figure = output.get("data", {}).pop(PLOTLY, None)
            if figure is None:
                continue
            figure.pop("config", None)
            page = views / f"{stem}_{k}.html"
            plotly.io.write_html(figure, page, include_plotlyjs="directory", validate=False)
            output.data.clear()
            output.data["text/markdown"] = (
                f'<iframe src="../../_static/{page.name}" width="100%" height="520"></iframe>'
            )


def write(app: Any) -> None:
    """Write ``generated/notebooks/NAME.md``, its pictures, and ``generated/views``."""
    folder = Path(app.srcdir) / "generated" / "notebooks"
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        with_frames(notebook, path.stem, Path(app.srcdir) / "generated" / "views")
        exporter = MarkdownExporter(exclude_input_prompt=True, exclude_output_prompt=True)
        text, resources = exporter.from_notebook_node(notebook, resources={"unique_key": path.stem})
        (folder / f"{path.stem}.md").write_text(text, encoding="utf-8")
        for name, data in resources["outputs"].items():
            (folder / name).write_bytes(data)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    (Path(app.srcdir) / "generated" / "views").mkdir(parents=True, exist_ok=True)
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True}
