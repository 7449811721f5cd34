"""Shared by all tests: those that trace rays are skipped, with the reason, on a machine that
cannot."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from isac_rt.runtime import RuntimeProblem, choose_backend
from isac_rt.storage import CACHE_VARIABLE

os.environ[CACHE_VARIABLE] = ""  # tests prepare everything anew, in processes of their own too


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    traced = [item for item in items if item.get_closest_marker("sionna")]
    if not traced:
        return
    try:
        choose_backend()
    except RuntimeProblem as problem:
        for item in traced:
            item.add_marker(pytest.mark.skip(reason=str(problem)))


@pytest.fixture(scope="session", autouse=True)
def _backend(request: pytest.FixtureRequest) -> None:
    """Dr.Jit is told its back end before the first test that traces."""
    if any(
        item.get_closest_marker("sionna") and not item.get_closest_marker("skip")
        for item in request.session.items
    ):
        from isac_rt.runtime import activate

        activate()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Makes a file system of its own with room for so many kB; skips where none can be mounted."""
    disk = tmp_path / "disk"

    def mounted(kilobytes: int) -> Path:
        disk.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(disk)]
        if subprocess.run(command, check=False, capture_output=True).returncode:
            pytest.skip("no disk can be mounted here")
        return disk

    yield mounted
    if disk.is_mount():
        subprocess.run(["umount", "-l", str(disk)], check=True)
