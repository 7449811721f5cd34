"""The city about a flight."""

from __future__ import annotations

import hashlib
import json
import logging
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from isac_rt.plain import plain, restored
from isac_rt.settings import plain_tree
from isac_rt.storage import cached
from isac_rt.world import settings
from isac_rt.world.city import CityMesh, city_files, load_city

_LOG = logging.getLogger(__name__)


def city_about(
    centre: np.ndarray,
    city: settings.City | None,
    folder: Path,
    carrier: float,
    radius: float = np.inf,
    digest: str | None = None,
) -> CityMesh:
    """A scenario's city about a place (3,), as far as `radius` [m]; the same object again for equal
    arguments.

    Parameters
    ----------
    folder : of the scenario
    carrier : at which materials are taken [Hz]
    digest : `city_digest`, where it is known already
    """
    text = "" if city is None else json.dumps(plain_tree(city), sort_keys=True)
    digest = city_digest(city, folder) if digest is None else digest
    return _near_city(radius, text, folder, digest, carrier, tuple(centre.tolist()))


@lru_cache(maxsize=2)
def _near_city(radius: float, *of: Any) -> CityMesh:
    return _loaded_city(*of).within(radius)


@lru_cache(maxsize=2)
def _loaded_city(
    text: str, folder: Path, digest: str, carrier: float, centre: tuple[float, ...]
) -> CityMesh:
    tree = settings.City.model_validate(json.loads(text)) if text else None
    if tree is not None:
        _LOG.info("reading the city")
    if not digest:  # made from numbers, in less time than it is read
        return load_city(tree, folder, carrier, centre)
    return restored(
        CityMesh,
        cached(
            "city",
            [text, digest, carrier, centre],
            lambda: plain(load_city(tree, folder, carrier, centre)),
        ),
    )


def city_digest(city: settings.City | None, folder: Path) -> str:
    """SHA-256 of every file that the city is read from, "" without one.

    Raises
    ------
    CityError  If one is missing.
    """
    digests = [file_digest(file) for file in city_files(city, folder)]
    return hashlib.sha256("".join(digests).encode()).hexdigest() if digests else ""


def file_digest(file: Path) -> str:
    """SHA-256 of a file's content."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()
