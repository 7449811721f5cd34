"""Fills the page `licences.md` from the lock and the metadata of the installed packages."""

from __future__ import annotations

import importlib.metadata
import re
from pathlib import Path
from typing import Any

HEAD = """# Licences

isac_rt is under Apache-2.0. The packages of the lock, with the licences that they state:

| package | licence |
|---|---|
"""


def licence(name: str) -> str | None:
    """A package's licence in its own words; None where it is not installed (packages of other
    systems)."""
    try:
        data = importlib.metadata.metadata(name)
    except importlib.metadata.PackageNotFoundError:
        return None
    if data.get("License-Expression"):
        return str(data["License-Expression"])
    classes = [
        c.rsplit("::", 1)[-1].strip()
        for c in data.get_all("Classifier") or []
        if c.startswith("License")
    ]
    stated = [c for c in classes if c != "OSI Approved"]
    return "; ".join(stated) or str(data.get("License") or "not stated").splitlines()[0][:60]


def fill(app: Any, name: str, source: list[str]) -> None:
    """Put the table in place of the text of `licences.md`."""
    if name != "licences":
        return
    lock = (Path(app.srcdir).parent / "requirements.lock").read_text(encoding="utf-8")
    names = dict.fromkeys(re.findall(r"^([A-Za-z0-9_.-]+)==", lock, re.MULTILINE))
    rows = [f"| {name} | {found} |" for name in names if (found := licence(name)) is not None]
    source[0] = HEAD + "\n".join(rows) + "\n"


def setup(app: Any) -> dict[str, bool]:
    app.connect("source-read", fill)
    return {"parallel_read_safe": True}
