"""Studies of the program: the paper reproduced, baselines, validation and benchmarks."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def scene_file(name: str) -> Path:
    """A scene that studies run: a link to `scenes/` in a checkout, a copy in an installed wheel."""
    return Path(str(files("isac_rt.studies"))) / "scenes" / name
