"""From the scenario's `city` to one recentred float64 mesh."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from isac_rt.registry import CITY_SOURCES, extension
from isac_rt.world import settings
from isac_rt.world.city.files import missing_extra, needs_extra
from isac_rt.world.city.georeference import GeoReference
from isac_rt.world.city.materials import CityError, resolve_materials
from isac_rt.world.city.mesh import CityMesh, Surface, check_size, clean, empty_city
from isac_rt.world.city.meshfiles import mesh_file, mesh_files, mesh_georeference
from isac_rt.world.city.mitsuba_xml import builtin_path, mitsuba_file, mitsuba_files


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
    if city.source not in CITY_SOURCES.own:  # another package's reads the named file alone
        return [_path(city, folder)] if city.file else []
    path = _path(city, folder)
    if city.source == "footprints":
        terrain = _terrain(city, folder)
        return [*_map_reader("map_files", path)(path), *([] if terrain is None else [terrain])]
    return mesh_files(path) if city.source == "mesh" else mitsuba_files(path)


@dataclass(frozen=True)
class CityParts:
    """Result of a source of cities.

    Attributes
    ----------
    name : of the city
    surfaces : in world coordinates, not yet cleaned
    notes : what was left out or assumed, for the report
    georeference : where on Earth the city's origin lies; None where the source does not say
    may_lie : on its side, for the source does not say which axis is up
    """

    name: str
    surfaces: list[Surface]
    notes: list[str] = field(default_factory=list)
    georeference: GeoReference | None = None
    may_lie: bool = False


def _map_reader(part: str, path: Path) -> Any:
    """Return a reader of maps, which needs shapely, pyproj and mapbox_earcut.

    Raises
    ------
    CityError  If they are not installed.
    """
    needs_extra("pyproj", path.name, "maps")
    try:
        return extension(part)
    except ImportError:
        raise missing_extra(path.name, "maps") from None


def canyon(city: settings.City, folder: Path) -> CityParts:
    """A street between two rows of buildings."""
    from isac_rt.world.city import parametric

    return CityParts(city.name or "canyon", parametric.canyon(city))


def blocks(city: settings.City, folder: Path) -> CityParts:
    """A grid of blocks."""
    from isac_rt.world.city import parametric

    return CityParts(city.name or "blocks", parametric.blocks(city))


def footprints(city: settings.City, folder: Path) -> CityParts:
    """Buildings extruded from footprints or read as solids, on their terrain."""
    path = _path(city, folder)
    found = _map_reader("map_buildings", path)(city, path, _terrain(city, folder))
    return CityParts(city.name or path.name, *found)


def mesh(city: settings.City, folder: Path) -> CityParts:
    """A mesh file."""
    path = _path(city, folder)
    return CityParts(city.name or path.name, *mesh_file(city, path))


def mitsuba(city: settings.City, folder: Path) -> CityParts:
    """A scene of Mitsuba, or one that comes with Sionna RT (`builtin`)."""
    path = _path(city, folder)
    return CityParts(city.name or path.name, *mitsuba_file(city, path))


builtin = mitsuba


def city_georeference(city: settings.City, folder: Path) -> GeoReference | None:
    """Where a city from a file lies, without building it; None where it does not say.

    Raises
    ------
    CityError
    """
    if city.source == "mesh":
        return mesh_georeference(city, _path(city, folder))
    if city.source != "footprints":
        return None
    path = _path(city, folder)
    georeference: GeoReference = _map_reader("map_georeference", path)(city, path, [], [])[1]
    return georeference


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
        parts = CITY_SOURCES.load(city.source)(city, Path(folder))
    uses, materials = resolve_materials(
        [s.material for s in parts.surfaces], carrier_frequency, city.materials
    )
    vertices, faces, owner, cleaning, tolerance = clean(
        parts.surfaces, parts.name, origin, city.keep_radius_m
    )
    in_use, face_material = np.unique(np.array(uses)[owner], return_inverse=True)
    notes = Counter(parts.notes + cleaning).items()
    counted = [text if n == 1 else f"{text} ({n} times)" for text, n in notes]
    return CityMesh(
        parts.name,
        vertices,
        faces,
        face_material.astype(np.int16),
        tuple(materials[i] for i in in_use),
        origin,
        tuple(counted),
        tolerance,
        reach=city.keep_radius_m or np.inf,
        georeference=parts.georeference,
        doubts=tuple(check_size(vertices[faces], parts.name, parts.may_lie)),
    )
