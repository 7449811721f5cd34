"""A pytest plugin for `mutation.py`: which tests call which function of the package, and how long
each test takes.

    RECORD=file.json pytest -p mutation_record tests/test_x.py

What runs compiled, or in another process, is not seen.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Generator
from pathlib import Path
from types import FrameType

import pytest

PACKAGE = f"{os.sep}isac_rt{os.sep}"
_called: dict[str, dict[str, None]] = {}
_seconds: dict[str, float] = {}
_now = ""


def _note(frame: FrameType, event: str, _: object) -> None:
    code = frame.f_code
    if PACKAGE in code.co_filename:
        name = code.co_qualname.partition(".<locals>")[0]
        _called.setdefault(f"{code.co_filename.rpartition(PACKAGE)[2]}:{name}", {})[_now] = None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Note the calls of a test, of its fixtures too."""
    global _now
    _now, begin = item.nodeid, time.monotonic()
    sys.settrace(_note)
    threading.settrace(_note)
    try:
        return (yield)
    finally:
        sys.settrace(None)
        threading.settrace(None)  # type: ignore[arg-type]  # None ends it
        _seconds[item.nodeid] = time.monotonic() - begin


def pytest_sessionfinish() -> None:
    """Write what was noted, beside what was noted before of other tests."""
    file = Path(os.environ["RECORD"])
    before = json.loads(file.read_text()) if file.exists() else {"called": {}, "seconds": {}}
    for place, tests in before["called"].items():
        _called.setdefault(place, {}).update(dict.fromkeys(t for t in tests if t not in _seconds))
    text = {
        "called": {place: list(tests) for place, tests in _called.items()},
        "seconds": before["seconds"] | _seconds,
    }
    file.write_text(json.dumps(text, indent=0) + "\n")
