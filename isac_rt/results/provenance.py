"""Where a result comes from: scenario, versions, commit, platform."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import warnings
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from isac_rt.document import ScenarioWarning
from isac_rt.scenario.file import to_yaml
from isac_rt.scenario.tree import Scenario
from isac_rt.storage import program_fingerprint, versions
from isac_rt.world.area import city_digest, file_digest


def versions_in_use() -> dict[str, str]:
    """The same, with what a loaded module says of itself where that is another version; each such
    difference is warned of once."""
    in_use = versions()
    for name, installed in in_use.items():
        stated = getattr(sys.modules.get(name.replace("-", ".")), "__version__", installed)
        if stated != installed:
            in_use[name] = f"{installed} (in use: {stated})"
            _warn_of(name, in_use[name])
    return in_use


@lru_cache
def _warn_of(name: str, version: str) -> None:
    message = (
        f"{name} {version}: another copy than the installed one is loaded; look at PYTHONPATH, "
        "and start anew after an upgrade"
    )
    warnings.warn(ScenarioWarning(message), stacklevel=2)


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


UNSEEN_BY_PATHS = (
    "name",
    "access",
    "modulation",
    "noise",
    "receiver_preset",
    "receivers",
    "tracking",
    "belief",
    "cooperation",
    "compare",
    "weather",
    "emitters",
)
"""Parts of a scenario on which its paths do not depend: runs that differ in nothing else share
them. What they say of the links and of the city's reach is in the key of stored paths besides."""


def path_content(tree: Mapping[str, Any], city: str) -> str:
    """All that paths depend on, but the instant, as text.

    Parameters
    ----------
    tree : the scenario as plain values
    city : digest of the city's files
    """
    seen = {key: value for key, value in tree.items() if key not in UNSEEN_BY_PATHS}
    seen["radio"] = _without_front_end(seen["radio"])
    seen["swarm"] = {name: _without_front_end(uav) for name, uav in seen["swarm"].items()}
    return json.dumps([seen, city, program_fingerprint(), versions()], sort_keys=True)


def _without_front_end(node: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out hardware, calibration and rotors, which show in the samples, not in the paths."""
    unseen = ("front_end", "calibration", "rotors")
    return {key: value for key, value in node.items() if key not in unseen}


def run_content(scenario: Scenario, snapshots: int, city: str | None = None) -> str:
    """All that the results of a run depend on, as text; `city`: `city_digest`, where it is known
    already."""
    city = city_digest(scenario.city, scenario.folder) if city is None else city
    files = [city]
    for radio in (scenario.radio, *(u.radio for u in scenario.swarm.values() if u.radio)):
        board = radio.calibration
        files.append("" if board is None else file_digest(scenario.folder / board))
    return json.dumps(
        [scenario.model_dump(mode="json"), *files, program_fingerprint(), versions(), snapshots],
        sort_keys=True,
    )


def provenance(scenario: Scenario) -> dict[str, str | int]:
    """Attributes that say where a file comes from: scenario, seed, versions, commit, platform."""
    return {
        "title": f"isac_rt: {scenario.name}",
        "scenario": to_yaml(scenario),
        "seed": scenario.seed,
        "versions": json.dumps(versions_in_use()),
        "commit": commit(),
        "platform": f"{platform.system()} {platform.machine()}",
        "Conventions": "CF-1.11",
    }
