"""The examples in the docstrings are run."""

from __future__ import annotations

import doctest
from importlib import import_module
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "isac_rt"
NAMES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if "\n    >>> " in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", NAMES)
def test_examples_show_what_they_say(name, monkeypatch):
    """Planted bug: (1, 1) as the passes of the two links in frame/link.py."""
    monkeypatch.chdir(PACKAGE.parent)
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    found = doctest.testmod(import_module(name), optionflags=flags)
    assert found.attempted and not found.failed


def test_there_are_examples():
    assert "isac_rt.frame.link" in NAMES
