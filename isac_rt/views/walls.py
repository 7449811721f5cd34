"""Surfaces of the city behind detections that are no UAV."""

from __future__ import annotations

import numpy as np
import pandas as pd
import xarray as xr

from isac_rt.propagation.pathset import PathKind
from isac_rt.world.city.mesh import CityMesh

MOST_WALLS = 8
_KINDS = {
    "Diffuse": PathKind.DIFFUSE,
    "Ghosts": PathKind.GHOST,
    "Mirror images": PathKind.SPECULAR,
}
_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
_UP = 0.7
"""A surface whose normal rises more faces up or down."""


def walls(dataset: xr.Dataset, city: CityMesh) -> pd.DataFrame:
    """The planes of the city that detections came from, those with most of them first.

    Parameters
    ----------
    dataset : of a run
    city : its city

    Returns
    -------
    a row for each plane: what it is, its middle [m], detections by kind of path, and whose ghosts
    they are
    """
    seen = pd.DataFrame(
        {name: dataset[f"det_{name}"].values.astype(int) for name in ("face", "kind", "target")}
    )
    seen = seen[(seen.face >= 0) & (seen.face < city.num_faces) & seen.kind.isin(_KINDS.values())]
    seen["plane"] = city.plane_of_face[seen.face.to_numpy()]
    names = [str(name) for name in dataset.uav.values]
    rows = []
    for _, mine in seen.groupby("plane"):
        faces = mine.face.to_numpy()
        ghosts = mine.target[(mine.kind == PathKind.GHOST) & (mine.target >= 0)]
        rows.append(
            {
                "Surface": _words(city, int(faces[0])),
                "Middle [m]": ", ".join(
                    f"{x:.0f}" for x in city.corners[faces].mean(axis=(0, 1)) + city.origin
                ),
                **{name: int((mine.kind == kind).sum()) for name, kind in _KINDS.items()},
                "Ghosts of": ", ".join(names[k] for k in sorted(set(ghosts))),
                "all": len(mine),
            }
        )
    found = pd.DataFrame(rows)
    if rows:
        found = found.sort_values("all", ascending=False, kind="stable").drop(columns="all")
    return found


def _words(city: CityMesh, face: int) -> str:
    """Material of a face, and where it looks."""
    material = city.materials[city.face_material[face]].name
    x, y, z = city.normals[face]
    if abs(z) > _UP:
        return f"{material}, level"
    wind = _WINDS[round(np.degrees(np.arctan2(x, y)) / 45) % 8]
    return f"{material}, facing {wind}"
