"""Directive `picture`: draws what the scenario below it gives, and shows both.

The argument is `view`, or a method of `isac_rt.Plots` with its arguments: `range_doppler PT1`,
`paths AT doppler`. The content is a scenario, or `canyon.yaml`, the first one, with options.
"""

from __future__ import annotations

import hashlib
import re
import shlex
import tempfile
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

SCENES = Path(__file__).parents[2] / "scenes"
PAGE = Path(__file__).parents[1] / "gallery.md"
ENTRY = re.compile(r"^```\{picture\} (.+)\n((?:.*\n)*?)```", re.MULTILINE)
"""What is drawn, and the content, of a picture of the page."""
FIRST = "canyon.yaml"
SNAPSHOTS = 2


def scenario_of(text: str, folder: Path) -> Any:
    """Read the scenario of an entry by way of a file in a folder."""
    import isac_rt as irt

    words = shlex.split(text) if text.startswith(FIRST) else []
    first = ENTRY.search(PAGE.read_text(encoding="utf-8"))
    assert first is not None
    (folder / "data").symlink_to(SCENES / "data")
    (folder / "scene.yaml").write_text(first[2] if words else text)
    return irt.load(folder / "scene.yaml", words[2::2])


def draw(text: str, words: list[str], file: Path) -> None:
    """Simulate the scenario of an entry, whose files are those of `scenes/`, and draw it into
    `file`."""
    import matplotlib.pyplot as plt

    import isac_rt as irt
    from isac_rt.cli.cli import main

    with tempfile.TemporaryDirectory() as folder:
        scenario = scenario_of(text, Path(folder))
        what, *arguments = words
        if what == "view":
            assert main(["view", f"{folder}/scene.yaml", "--out", str(file)]) == 0, text
            return
        results = irt.run(scenario, snapshots=SNAPSHOTS, progress=False)
        axes = getattr(irt.Plots(results), what)(*arguments)
        axes.figure.savefig(file, dpi=110)
        plt.close(axes.figure)


class Picture(SphinxDirective):
    """Shows a scenario, and the picture of it unless `gallery_draws` is off."""

    has_content = True
    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        text = "\n".join(self.content) + "\n"
        shown = f"isac-rt run {text}" if text.startswith(FIRST) else text
        code = nodes.literal_block(shown, shown, language="sh" if shown != text else "yaml")
        if not self.config.gallery_draws:
            return [code]
        content = self.arguments[0] + text + PAGE.read_text(encoding="utf-8")
        mark = hashlib.sha256(content.encode()).hexdigest()[:16]
        folder = Path(self.env.app.outdir) / "_static" / "gallery"
        folder.mkdir(parents=True, exist_ok=True)
        if not (file := folder / f"{mark}.png").exists():
            draw(text, self.arguments[0].split(), file)
        shown = f'<img src="_static/gallery/{file.name}" alt="{self.arguments[0]}" width="100%">'
        return [nodes.raw(shown, shown, format="html"), code]


def setup(app: Any) -> dict[str, bool]:
    app.add_config_value("gallery_draws", True, "env")
    app.add_directive("picture", Picture)
    return {"parallel_read_safe": True}
