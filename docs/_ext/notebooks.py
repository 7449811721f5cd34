"""The notebooks as pages: what `make notebooks` wrote, with its pictures."""

from __future__ import annotations

from pathlib import Path

from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[2]


def write(app) -> None:
    """Write ``generated/notebooks/NAME.md`` and its pictures."""
    folder = Path(app.srcdir) / "generated" / "notebooks"
    folder.mkdir(parents=True, exist_ok=True)
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        exporter = MarkdownExporter(exclude_input_prompt=True, exclude_output_prompt=True)
        text, resources = exporter.from_filename(
            str(notebook), resources={"unique_key": notebook.stem}
        )
        (folder / f"{notebook.stem}.md").write_text(text, encoding="utf-8")
        for name, data in resources["outputs"].items():
            (folder / name).write_bytes(data)


def setup(app) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", write)
    return {"parallel_read_safe": True}
