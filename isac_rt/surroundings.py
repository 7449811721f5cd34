"""The city about a scenario's flight, and what a scenario's paths depend on."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from isac_rt.city import City, load_city
from isac_rt.provenance import file_digest, program_fingerprint, versions
from isac_rt.scenario import City as CityTree
from isac_rt.scenario import Scenario
from isac_rt.scenario_file import plain_tree
from isac_rt.swarm import Swarm
from isac_rt.waveform import waveform_of


def city_of(scenario: Scenario, radius: float = np.inf) -> City:
    """The scenario's city about the middle of the flight, as far as `radius` [m]; the same object again for like scenarios."""
    centre, carrier = tuple(flight_centre(scenario).tolist()), waveform_of(scenario).carrier_frequency
    text = "" if scenario.city is None else json.dumps(plain_tree(scenario.city), sort_keys=True)
    return _near_city(radius, text, scenario.folder, city_digest(scenario), carrier, centre)


@lru_cache(maxsize=2)
def _near_city(radius: float, *of: Any) -> City:
    return _loaded_city(*of).within(radius)


def flight_centre(scenario: Scenario) -> np.ndarray:
    """(3,) mean position of the swarm over the whole flight [m]."""
    return Swarm.from_scenario(scenario).middle(scenario.frames * (scenario.frame_interval_s or waveform_of(scenario).frame_duration))


@lru_cache(maxsize=2)
def _loaded_city(text: str, folder: Path, digest: str, carrier: float, centre: tuple[float, ...]) -> City:
    tree = CityTree.model_validate(json.loads(text)) if text else None
    return load_city(tree, folder, carrier, centre)


def city_digest(scenario: Scenario) -> str:
    """Of the city's file, "" without one."""
    return "" if scenario.city is None or scenario.city.file is None else file_digest(scenario.city_path())


UNSEEN_BY_PATHS = ("name", "access", "modulation", "noise", "receivers", "tracking")
"""Parts of a scenario on which its paths do not depend."""


def path_content(scenario: Scenario) -> str:
    """All that a scenario's paths depend on, but the instant, as text; the city's file by its content."""
    tree = {key: value for key, value in scenario.model_dump(mode="json").items() if key not in UNSEEN_BY_PATHS}
    return json.dumps([tree, city_digest(scenario), program_fingerprint()], sort_keys=True)


def run_content(scenario: Scenario, snapshots: int) -> str:
    """All that the results of a run depend on, as text."""
    costs = scenario.cost_model_path()
    files = [city_digest(scenario), "" if costs is None else file_digest(costs)]
    return json.dumps([scenario.model_dump(mode="json"), *files, program_fingerprint(), versions(), snapshots], sort_keys=True)
