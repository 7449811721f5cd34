"""The city about a scenario's flight, and what a scenario's paths depend on."""

from __future__ import annotations

import json

from isac_rt.results.provenance import program_fingerprint, versions
from isac_rt.scenario.tree import Scenario
from isac_rt.world.area import city_digest, file_digest

UNSEEN_BY_PATHS = ("name", "access", "modulation", "noise", "receivers", "tracking")
"""Parts of a scenario on which its paths do not depend."""


def path_content(scenario: Scenario) -> str:
    """All that a scenario's paths depend on, but the instant, as text; the city's file by its
    content."""
    tree = {
        key: value
        for key, value in scenario.model_dump(mode="json").items()
        if key not in UNSEEN_BY_PATHS
    }
    return json.dumps(
        [tree, city_digest(scenario.city, scenario.folder), program_fingerprint()], sort_keys=True
    )


def run_content(scenario: Scenario, snapshots: int) -> str:
    """All that the results of a run depend on, as text."""
    costs = scenario.cost_model_path()
    files = [
        city_digest(scenario.city, scenario.folder),
        "" if costs is None else file_digest(costs),
    ]
    return json.dumps(
        [scenario.model_dump(mode="json"), *files, program_fingerprint(), versions(), snapshots],
        sort_keys=True,
    )
