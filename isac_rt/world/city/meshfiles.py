"""PLY, OBJ, STL and GLB files, through trimesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isac_rt import scenario
from isac_rt.runtime import available_memory
from isac_rt.world.city.materials import CityError, MaterialUse, canonical_name
from isac_rt.world.city.mesh import Surface

SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".gltf")
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


READING_FACTOR = 6
"""Memory that reading a mesh takes, over the size of its file: text, arrays and their copies;
measured 3 to 5."""


def check_size(path: Path) -> None:
    """Refuse a file that is too large to be read.

    Raises
    ------
    CityError  With the estimate and what is free.
    """
    size, free = path.stat().st_size, available_memory()
    if free is not None and READING_FACTOR * size > free:
        raise CityError(
            f"{path.name}: a file of {size / 1e9:.3g} GB takes about "
            f"{READING_FACTOR * size / 1e9:.3g} GB of memory to read, "
            f"{free / 1e9:.3g} GB are free; simplify it, or cut out what is near the swarm"
        )


def _loaded(path: Path, load: Callable[..., Any]) -> Any:
    """What trimesh makes of a file, or a CityError that says why it cannot."""
    check_size(path)
    try:
        return load(path, process=False)
    except Exception as error:  # trimesh raises whatever its parsers raise
        raise CityError(
            f"{path.name}: not readable as a mesh ({type(error).__name__}: {error}); export it "
            "again"
        ) from None


def read_triangles(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and triangles of a file that holds one mesh, untouched but for the triangulation of
    larger faces."""
    import trimesh

    mesh = _loaded(path, trimesh.load_mesh)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _labels(node: str, geometry: str, mesh: object) -> list[str]:
    """The names by which a piece may be called: node, geometry, material."""
    material = getattr(getattr(mesh, "visual", None), "material", None)
    names = [node, geometry, getattr(material, "name", None)]
    return [str(name) for name in names if name]


def _use(labels: list[str], city: scenario.City) -> MaterialUse:
    for label in labels:
        if label in city.material_map:
            return MaterialUse(city.material_map[label])
    for label in reversed(labels):
        known = canonical_name(label)
        if known is not None:
            return MaterialUse(known)
    return MaterialUse(city.material)


def mesh_file(city: scenario.City, path: Path) -> tuple[list[Surface], list[str]]:
    """The surfaces of a mesh file in world coordinates: node transforms applied, then scaled, then
    turned z-up.

    A piece's material is what `material_map` says of its node, geometry or material name, else a
    known material of that name, else `material`.

    Raises
    ------
    CityError
    """
    import trimesh

    if path.suffix.lower() not in SUFFIXES:
        raise CityError(
            f"{path.name}: {path.suffix!r} is not a mesh format known here; use one of "
            f"{', '.join(SUFFIXES)}"
        )
    scene = _loaded(path, trimesh.load_scene)
    surfaces, seen, notes = [], set(), []
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            notes.append(f"{geometry}: no triangles, left out")
            continue
        vertices = (
            np.asarray(mesh.vertices, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3]
        )
        vertices = vertices * city.scale
        if city.up_axis == "y":
            vertices = vertices @ _Y_UP_TO_Z_UP.T
        labels = _labels(str(node), str(geometry), mesh)
        seen.update(labels)
        surfaces.append(
            Surface(vertices, np.asarray(mesh.faces, dtype=np.int64), _use(labels, city))
        )
    if not surfaces:
        raise CityError(f"{path.name}: there is no triangle in it; export a mesh")
    unused = sorted(set(city.material_map) - seen)
    if unused:
        raise CityError(
            f"{path.name}: city.material_map names {', '.join(unused)}, which the file lacks; "
            f"it has {', '.join(sorted(seen)) or 'no names'}"
        )
    if path.suffix.lower() in (".glb", ".gltf") and city.up_axis == "z":
        notes.append("glTF is y-up by its standard, and city.up_axis is z")
    return surfaces, notes
