"""The city about a flight."""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from isac_rt.scenario.environment import City as CityTree
from isac_rt.scenario.file import plain_tree
from isac_rt.scenario.tree import Scenario
from isac_rt.world.city import City, load_city
from isac_rt.world.swarm import Swarm


def city_of(scenario: Scenario, radius: float = np.inf) -> City:
    """The scenario's city about the middle of the flight, as far as `radius` [m]; the same object
    again for like scenarios."""
    centre, carrier = tuple(flight_centre(scenario).tolist()), scenario.radio.carrier_hz
    text = "" if scenario.city is None else json.dumps(plain_tree(scenario.city), sort_keys=True)
    return _near_city(radius, text, scenario.folder, city_digest(scenario), carrier, centre)


@lru_cache(maxsize=2)
def _near_city(radius: float, *of: Any) -> City:
    return _loaded_city(*of).within(radius)


def flight_centre(scenario: Scenario) -> np.ndarray:
    """(3,) mean position of the swarm over the whole flight [m]."""
    return Swarm.from_scenario(scenario).middle(scenario.flight_duration_s)


@lru_cache(maxsize=2)
def _loaded_city(
    text: str, folder: Path, digest: str, carrier: float, centre: tuple[float, ...]
) -> City:
    tree = CityTree.model_validate(json.loads(text)) if text else None
    return load_city(tree, folder, carrier, centre)


def city_digest(scenario: Scenario) -> str:
    """Of the city's file, "" without one."""
    return (
        ""
        if scenario.city is None or scenario.city.file is None
        else file_digest(scenario.city_path())
    )


def file_digest(file: Path) -> str:
    """SHA-256 of a file's content."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
