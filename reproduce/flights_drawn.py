"""Scenes drawn at random free places of six cities, for `reproduce.flights`.

Even draws are for looking at while receivers are built, odd ones for reporting. Six draws of a kind
have all cities and all formations, 36 each formation in each city.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from isac_rt.cli.siting import Site
from isac_rt.document import ScenarioError, ScenarioWarning
from isac_rt.randomness import generator
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import city_of, prepare
from isac_rt.storage import write_whole
from isac_rt.sweep.drawn import MOST_TRIES
from isac_rt.world.passage import hits
from reproduce import SCENES

FRAMES = 20
"""As many that 0.9 of a target's frames leave two for starting its track."""
_BUILT_IN = "munich", "florence", "etoile", "san_francisco", "simple_street_canyon_with_cars"
CITIES = (*({"source": "builtin", "name": name} for name in _BUILT_IN), None)
"""Nodes `city`; None: the blocks of the base scene."""
KINDS = "look", "report"
FORMATIONS = ("facing", "beside", "square", "crossing", "abreast", "hovering")
PT_TURN_DEG = {"facing": (160, 200), "beside": (10, 40), "square": (75, 105)}
"""Angle about the targets from the active to the first passive terminal; else any."""
ARRAYS: tuple[dict[str, Any], ...] = (
    {},
    {
        "tx": {"positions": [[0, 0], [2, 0], [0, 2]]},
        "rx": {"shape": "planar", "columns": 4, "rows": 4},
    },
    {
        "tx": {"positions": [[0, 0], [1, 0.5], [2, 0]]},
        "rx": {"shape": "linear", "columns": 4},
    },
)
"""The L, a plane of 8 by 8 virtual elements less a corner, and a row with little elevation as on
boards of three transmit and four receive antennas."""
MOST_SPEED_MPS, HEIGHT_M, DISTANCE_M, SPACING_M = 25.0, (4.0, 30.0), (12.0, 25.0), 3.0
"""Highest speed over ground; heights over it; from the active terminal to the middle of the
targets; between targets in a row."""


def write_drawn(folder: Path, count: int, seed: int) -> None:
    """Write the draws that a folder lacks: `look_000_facing_munich.yaml` and so on."""
    for number in range(count):
        if not any(folder.glob(f"*_{number:03}_*.yaml")):
            tree = drawn(number, seed)
            write_whole(folder / f"{tree['name']}.yaml", yaml.safe_dump(tree, sort_keys=False))


def drawn(number: int, seed: int) -> dict[str, Any]:
    """Return a scene as plain values, in which the AT sees half of the targets or more.

    Raises
    ------
    ScenarioError  If no free place is found.
    """
    pair, kind = divmod(number, 2)
    formation = FORMATIONS[(pair + pair // 6 + 3 * kind) % 6]
    tree = yaml.safe_load((SCENES / "blocks_swarm.yaml").read_text(encoding="utf-8"))
    tree["city"] = CITIES[pair % 6] or tree["city"]
    tree["name"] = f"{KINDS[kind]}_{number:03}_{formation}_{tree['city'].get('name', 'blocks')}"
    tree |= {"seed": seed + number, "frames": FRAMES}
    tree["array"] = ARRAYS[(pair // 2 + pair // 6 + kind) % 3]
    city = city_of(Scenario.model_validate(tree))
    corners = city.corners + city.origin
    for attempt in range(MOST_TRIES):
        rng = generator(seed, "flight", number, attempt)
        site = _site(corners, rng)
        if site is None:
            continue
        tree["swarm"] = _swarm(formation, site, rng)
        at = np.array(tree["swarm"]["AT"]["position_m"])
        targets = [
            np.array(u["position_m"]) for u in tree["swarm"].values() if "boresight" not in u
        ]
        if np.mean([hits(corners, at, target)[0].size > 0 for target in targets]) > 0.5:
            continue
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ScenarioWarning)
                prepare(Scenario.model_validate(tree))
        except ScenarioError:  # through a wall, or into another
            continue
        return dict(tree)
    raise ScenarioError(f"draw {number} found no free place in {MOST_TRIES} tries; take another")


def _site(corners: np.ndarray, rng: np.random.Generator) -> Site | None:
    """Draw a place over the ground of a city (F, 3, 3) and a heading; None beside its ground."""
    points = corners.reshape(-1, 3)
    x, y, _ = rng.uniform(*np.quantile(points, (0.1, 0.9), axis=0))
    bottom, top = points[:, 2].min() - 1, points[:, 2].max() + 1
    _, share = hits(corners, np.array([x, y, bottom]), np.array([x, y, top]))
    if not share.size:
        return None
    z = bottom + share.min() * (top - bottom) + rng.uniform(*HEIGHT_M)
    return Site(np.array([x, y, z]), rng.uniform(0, 2 * np.pi))


def _swarm(formation: str, site: Site, rng: np.random.Generator) -> dict[str, Any]:
    """Draw a swarm: its targets about a site, and terminals about them that look at it."""
    size = int(rng.integers(3, 13))
    passive = 1 if size < 5 else int(rng.integers(1, 3))
    speed = 0.0 if formation == "hovering" else rng.uniform(0, MOST_SPEED_MPS)
    first, second = rng.uniform(*PT_TURN_DEG.get(formation, (0, 360))), rng.uniform(0, 360)
    places, flights = _targets(formation, size - 1 - passive, rng)
    out = {
        f"U{k}": {"role": "target", **_uav(site, place, speed * flight)}
        for k, (place, flight) in enumerate(zip(places, flights, strict=True), start=1)
    }
    for name, rotate in zip(
        ["AT", "PT1", "PT2"][: 1 + passive], (0.0, first, second), strict=False
    ):
        ahead = np.append(_along(np.deg2rad(rotate)), rng.uniform(-0.1, 0.1))
        moving = ahead * rng.uniform(0, speed / 2)
        out[name] = {"role": "passive" if rotate else "active"}
        out[name] |= _uav(site, -rng.uniform(*DISTANCE_M) * ahead, moving, ahead)
    return out


def _targets(formation: str, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw places about the middle [m] and velocities over the highest (count, 3)."""
    row = SPACING_M * (np.arange(count) - (count - 1) / 2)
    places = rng.uniform(-1, 1, (count, 3)) * [9, 9, 2]
    heading, pace = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 1, count)
    if formation == "abreast":
        places[:, 0], places[:, 1], heading[:], pace[:] = row, 0, heading[0], 1
    elif formation == "crossing":
        heading[:] = np.pi * (np.arange(count) % 2 - 0.5)
        places[:, 0], places[:, 1] = -5 * np.sin(heading), row
    return places, np.column_stack([*(pace * _along(heading)), np.zeros(count)])


def _along(heading: Any) -> np.ndarray:
    """Return unit vectors (2, ...) at angles from north to east [rad]."""
    return np.array([np.sin(heading), np.cos(heading)])


def _uav(site: Site, place: np.ndarray, *vectors: np.ndarray) -> dict[str, list[float]]:
    """Return the place, velocity and boresight of a UAV at a site, rounded for readers."""
    keys = ("position_m", "velocity_mps", "boresight")
    values = np.concatenate([site.place(place[None]), site.rotate(np.array(vectors))]).round(3)
    return dict(zip(keys, values.tolist(), strict=False))
