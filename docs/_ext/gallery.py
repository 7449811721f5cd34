"""Directive `picture`: draws what the scenario below it gives, and shows both.

The argument is `view`, or a method of `isac_rt.Plots` with its arguments: `range_doppler PT1`,
`paths AT doppler`.
"""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

SCENES = Path(__file__).parents[2] / "scenes"
SNAPSHOTS = 2


def draw(text: str, words: list[str], file: Path) -> None:
    """Simulate the scenario `text`, whose files are those of `scenes/`, and draw it into `file`."""
    import matplotlib.pyplot as plt

    import isac_rt as irt
    from isac_rt.cli.cli import main

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "data").symlink_to(SCENES / "data")
        (Path(folder) / "scene.yaml").write_text(text)
        what, *arguments = words
        if what == "view":
            assert main(["view", f"{folder}/scene.yaml", "--out", str(file)]) == 0, text
            return
        scenario = irt.load(Path(folder) / "scene.yaml")
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
        code = nodes.literal_block(text, text, language="yaml")
        if not self.config.gallery_draws:
            return [code]
        mark = hashlib.sha256((self.arguments[0] + text).encode()).hexdigest()[:16]
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
