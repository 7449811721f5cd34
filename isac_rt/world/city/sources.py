"""From the scenario's `city` to one recentred float64 mesh."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from isac_rt.world import settings
from isac_rt.world.city.materials import CityError, resolve_materials
from isac_rt.world.city.mesh import CityMesh, Surface, clean, empty_city
from isac_rt.world.city.meshfiles import mesh_file, mesh_files
from isac_rt.world.city.mitsuba_xml import builtin_path, mitsuba_file, mitsuba_files
from isac_rt.world.city.place import Place


def _path(city: settings.City, folder: Path) -> Path:
    if city.source == "builtin":
        if not city.name:
            raise CityError(
                "city.source builtin needs city.name, such as munich or simple_street_canyon"
            )
        return builtin_path(city.name)
    if not city.file:
        raise CityError(
            f"city.source {city.source} needs city.file: a path, relative to the scenario's folder"
        )
    path = folder / city.file
    if not os.path.isfile(path):
        raise CityError(
            f"city.file {city.file!r} does not exist in {folder}, or is no file; paths are "
            "relative to the scenario's folder"
        )
    return path


def _terrain(city: settings.City, folder: Path) -> Path | None:
    if city.terrain is None:
        return None
    path = folder / city.terrain
    if not os.path.isfile(path):
        raise CityError(
            f"city.terrain {city.terrain!r} does not exist in {folder}, or is no file; paths are "
            "relative to the scenario's folder"
        )
    return path


def city_files(city: settings.City | None, folder: Path) -> list[Path]:
    """Every file that a city is read from, in an order of their own.

    Raises
    ------
    CityError  If one is missing.
    """
    if city is None or city.source in ("canyon", "blocks"):
        return []
    path = _path(city, folder)
    if city.source == "footprints":
        from isac_rt.world.city.tables import table_files

        terrain = _terrain(city, folder)
        return [*table_files(path), *([] if terrain is None else [terrain])]
    return mesh_files(path) if city.source == "mesh" else mitsuba_files(path)


def _surfaces(
    city: settings.City, folder: Path
) -> tuple[str, list[Surface], list[str], Place | None]:
    if city.source in ("canyon", "blocks"):  # shapely is loaded for cities that are extruded
        from isac_rt.world.city import parametric

        made = parametric.canyon if city.source == "canyon" else parametric.blocks
        return city.name or city.source, made(city), [], None
    path = _path(city, folder)
    name = city.name or path.name
    if city.source == "footprints":
        from isac_rt.world.city.footprints import footprints

        return name, *footprints(city, path, _terrain(city, folder))
    return name, *(mesh_file if city.source == "mesh" else mitsuba_file)(city, path), None


def load_city(
    city: settings.City | None, folder: Path | str, carrier_frequency: float, centre: ArrayLike
) -> CityMesh:
    """The city of a scenario as one float64 mesh about `centre`.

    Parameters
    ----------
    city : settings.City or None
        None: free space, a city without faces.
    folder : path
        Where the scenario file lies; `city.file` is relative to it.
    carrier_frequency : float
        At which the materials are evaluated. [Hz]
    centre : (3,) array-like
        World point that becomes the local origin; keep it within 500 m of whatever flies (Sionna
        traces in float32). [m]

    Returns
    -------
    city : isac_rt.world.city.City

    Raises
    ------
    CityError
        With one message: file, what, value, remedy.
    """
    origin = np.array(centre, dtype=np.float64).reshape(3)
    if not np.isfinite(origin).all():
        raise CityError(f"the centre {origin} is not finite; check the positions of the swarm")
    if city is None:
        return empty_city("free space", origin)
    with np.errstate(all="ignore"):  # what overflows is refused by `clean`
        name, surfaces, notes, place = _surfaces(city, Path(folder))
    uses, materials = resolve_materials(
        [s.material for s in surfaces], carrier_frequency, city.materials
    )
    vertices, faces, owner, cleaning, tolerance = clean(surfaces, name, origin, city.keep_radius_m)
    in_use, face_material = np.unique(np.array(uses)[owner], return_inverse=True)
    counted = [
        text if n == 1 else f"{text} ({n} times)" for text, n in Counter(notes + cleaning).items()
    ]
    return CityMesh(
        name,
        vertices,
        faces,
        face_material.astype(np.int16),
        tuple(materials[i] for i in in_use),
        origin,
        tuple(counted),
        tolerance,
        place=place,
    )
