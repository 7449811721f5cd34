"""Traced paths on disk, by content: runs that differ only in noise, modulation or receivers share
them.

A file holds the paths of all links of one instant, with its key and a checksum: one that is bent,
cut off or another's is traced again. Files are touched when read; when the folder grows beyond its
limit the least recently used go. Several processes may share a folder: a file that another one
takes away is traced again too.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from isac_rt.frame.link import Link
from isac_rt.propagation.model import Census, Propagation, Traced
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.storage import BAD_DATA, Store
from isac_rt.world.swarm import Pose

SUFFIX = ".paths"


@dataclass(frozen=True)
class PathStore:
    """A folder of path sets with a limit on its size [bytes]."""

    folder: Path
    limit: int = 4 * 1024**3

    @property
    def _store(self) -> Store:
        return Store(self.folder, SUFFIX, self.limit)

    def get(self, key: str) -> tuple[Traced, Census] | None:
        """Return the paths traced for a key, and by what; None where it is not here."""
        data = self._store.get(key)
        try:
            return None if data is None else _unpack(data)
        except BAD_DATA:
            return None

    def put(self, key: str, traced: Traced, census: Census) -> None:
        """Keep what was traced for a key; nothing, where the folder cannot be written."""
        self._store.put(key, _pack(traced, census))


class CachedPropagation:
    """A propagation model that looks into a store first, and is made only when something is missing
    there.

    Parameters
    ----------
    make : makes the model
    store : PathStore
    content : all that the model's paths depend on but the instant and the links, as text
    """

    def __init__(self, make: Callable[[], Propagation], store: PathStore, content: str) -> None:
        self._make, self._store, self._content = make, store, content
        self._census: Census | None = None

    @cached_property
    def model(self) -> Propagation:
        """Made when it is first asked for."""
        return self._make()

    def census(self) -> Census:
        """The model's own, or as it was kept with the paths."""
        return self.model.census() if self._census is None else self._census

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """As the model's own, bit for bit."""
        where = {
            name: [
                p.position.tolist(),
                p.velocity.tolist(),
                p.acceleration.tolist(),
                p.rotation.tolist(),
            ]
            for name, p in poses.items()
        }
        text = json.dumps([self._content, epoch, links, where])
        key = hashlib.sha256(text.encode()).hexdigest()
        stored = self._store.get(key)
        if stored is None:
            stored = self.model.trace(poses, epoch, links), self.model.census()
            self._store.put(key, *stored)
        traced, self._census = stored
        return traced


def _pack(traced: Traced, census: Census) -> dict[str, Any]:
    """Path sets as plain values and arrays."""
    links = [
        {"tx": p.tx, "rx": p.rx, "epoch": p.epoch, "target_names": p.target_names, **p.arrays()}
        for p in traced.paths.values()
    ]
    return {"links": links, "dropped": traced.dropped, "census": asdict(census)}


def _unpack(data: dict[str, Any]) -> tuple[Traced, Census]:
    out = {}
    for link in data["links"]:
        names = tuple(link.pop("target_names"))
        paths = PathSet(**link, target_names=names)
        _check(paths)
        out[paths.link] = paths
    census = TypeAdapter(Census).validate_python(data["census"])
    return Traced(out, TypeAdapter(int).validate_python(data["dropped"], strict=True)), census


def _check(paths: PathSet) -> None:
    """Refuse columns that do not fit each other.

    Raises
    ------
    ValueError
    """
    count, depth = len(paths), paths.faces.shape[1]
    wide = {"departure": (3,), "arrival": (3,), "points": (depth, 3), "faces": (depth,)}
    whole = {"kind", "target", "bounces", "faces"}
    for name, column in paths.arrays().items():
        kind = "i" if name in whole else "c" if name == "gain" else "f"
        if column.dtype.kind != kind or column.shape != (count, *wide.get(name, ())):
            raise ValueError(f"{name}: {column.dtype}, {column.shape}")
    if (
        len(paths.arrays()) != len(fields(PathSet)) - len(("epoch", "tx", "rx", "target_names"))
        or not all(isinstance(word, str) for word in (paths.tx, paths.rx, *paths.target_names))
        or not isinstance(paths.epoch, float)
        or not np.isin(paths.kind, [*PathKind]).all()
        or not ((paths.target >= -1) & (paths.target < len(paths.target_names))).all()
    ):
        raise ValueError("no paths")
