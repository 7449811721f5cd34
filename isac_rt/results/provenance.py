"""Where a result comes from: scenario, versions, commit, platform."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import subprocess
from functools import lru_cache
from pathlib import Path

from isac_rt.scenario.file import to_yaml
from isac_rt.scenario.tree import Scenario

PACKAGES = (
    "isac_rt",
    "numpy",
    "scipy",
    "numba",
    "llvmlite",
    "drjit",
    "mitsuba",
    "sionna-rt",
    "trimesh",
    "shapely",
    "pyproj",
    "mapbox_earcut",
    "xarray",
    "h5netcdf",
    "h5py",
    "pydantic",
)
"""What a number of a result, or the file that holds it, can depend on."""


@lru_cache(maxsize=1)
def program_fingerprint() -> str:
    """Version of this package and a digest of its source and tables: two runs with the same one
    were made by the same program."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parents[1]
    for file in sorted(
        file for file in package.rglob("*") if file.suffix in (".py", ".json")
    ):  # JSON: costs decide between methods
        digest.update(f"{file.relative_to(package)}\0".encode() + file.read_bytes() + b"\0")
    return f"{importlib.metadata.version('isac_rt')}+{digest.hexdigest()[:16]}"


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def versions() -> dict[str, str]:
    """Python's version and that of every package that a result depends on."""
    return dict(_versions())


@lru_cache(maxsize=1)
def commit() -> str:
    """Commit of the checkout that this package lies in, with ``+changes`` where it was edited; ""
    outside a checkout."""
    folder = Path(__file__).resolve().parents[1]

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        ).stdout.strip()

    try:
        git(
            "ls-files", "--error-unmatch", "__init__.py"
        )  # an installed copy may lie inside somebody else's checkout
        return git("rev-parse", "HEAD") + (
            "+changes" if git("status", "--porcelain", "--", ".") else ""
        )
    except (OSError, subprocess.SubprocessError):
        return ""


def provenance(scenario: Scenario) -> dict[str, str | int]:
    """Attributes that say where a file comes from: scenario, seed, versions, commit, platform."""
    return {
        "title": f"isac_rt: {scenario.name}",
        "scenario": to_yaml(scenario),
        "seed": scenario.seed,
        "versions": json.dumps(versions()),
        "commit": commit(),
        "platform": f"{platform.system()} {platform.machine()}",
        "Conventions": "CF-1.11",
    }
