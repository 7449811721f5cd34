"""Docstrings say `name : description`, where NumPy has the type: puts all of the description in its
place."""

from __future__ import annotations

import re
from typing import Any

ENTRIES = {
    **dict.fromkeys(("Parameters", "Attributes"), re.compile(r"^(\*{0,2}\w[\w, *]*) : (.*\S)$")),
    **dict.fromkeys(("Raises", "Warns"), re.compile(r"^([\w.]+)  (.*\S)$")),
}
"""An entry of a section: its name and its description."""
TYPE = re.compile(r"^[A-Z]\w*$")
"""A description of one capitalised word is the name of a type, and stays where it is."""


def rewrite(app: Any, kind: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Move descriptions from the place of the type to a line of their own."""
    pattern, out = None, []
    for number, line in enumerate(lines):
        underlined = number + 1 < len(lines) and set(lines[number + 1].strip()) == {"-"}
        if underlined:
            pattern = ENTRIES.get(line)
        entry = pattern.match(line) if pattern else None
        if entry and not TYPE.match(entry[2]):
            out += [entry[1], f"    {entry[2]}"]
        else:
            out.append(line)
    lines[:] = out


def setup(app: Any) -> dict[str, bool]:
    """Run before Napoleon, whose priority is 500."""
    app.connect("autodoc-process-docstring", rewrite, priority=400)
    return {"parallel_read_safe": True}
